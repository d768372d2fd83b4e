//! The worked protocol of docs/rig.md: its commands, and an operator who follows it from power-on to the
//! calibrated needle, on two emulated EPOS4 drives and a tracker that pyigtl serves.

use super::peers::serving_peer;
use super::program::repository;
use super::programs::{Ended, LONG, Program, Scratch, free_address, manifest, read, stage};
use super::replays::assert_it_replays;
use super::terminal::OnTerminal;
use nalgebra::Vector3;
use needle_bench::geometry::{FixedAngles, Pose};
use std::fs;
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

/// The commands of the page in order: each as printed there, and as words after `needle-bench`.
pub(crate) fn commands() -> Vec<(String, Vec<String>)> {
    let page = read(Path::new(&repository("docs/rig.md")));
    let lines = page.lines().filter_map(|line| line.strip_prefix("needle-bench "));
    let commands = lines.map(|line| {
        let line = line.split(" #").next().unwrap_or_default().trim();
        (line.to_owned(), words(line))
    });
    commands.collect()
}

/// Whether this command needs neither bus nor tracker.
pub(crate) fn is_without_rig(line: &str) -> bool {
    ["--rehearse", "--virtual", "emulator."].iter().any(|word| line.contains(word))
}

/// Splits a command line into words. A quoted argument must not begin or end with a space.
fn words(line: &str) -> Vec<String> {
    let parts = line.split('\'').enumerate();
    let words = parts.flat_map(|(n, part)| match n % 2 {
        0 => part.split_whitespace().map(str::to_owned).collect(),
        _ => vec![part.to_owned()],
    });
    words.collect()
}

/// True pose of the tracker on the bench.
const X_WT: &str = "tracker.registration={ x_mm = 120.0, y_mm = -40.0, z_mm = 310.0, yaw_deg = 30.0, \
                    pitch_deg = -20.0, roll_deg = 100.0 }";
const X_WT_MM: [f64; 3] = [120.0, -40.0, 310.0];
const X_WT_DEG: [f64; 3] = [30.0, -20.0, 100.0];
/// The fiducials on the bench, mm.
const FIDUCIALS_MM: [[f64; 3]; 5] =
    [[0., 0., 0.], [40., 0., 10.], [0., 40., 20.], [-40., 0., 60.], [0., -40., 80.]];

/// The emulated rig: EPOS4 drives that are not homed, a sensor 3 mm off the needle's axis and 7 mm behind the
/// tip.
const RIG: [&str; 8] = [
    "emulator.rehearse=true",
    "emulator.homed=false",
    "emulator.noise={ sd_mm = 0.1 }",
    "emulator.start={ x_mm = 0.2, y_mm = 0.0, z_mm = 0.0, yaw_deg = 0.0, pitch_deg = 0.0, roll_deg = 30.0 }",
    "emulator.insertion_start_mm=0.5",
    "emulator.sensor.x_mm=3.0",
    "emulator.sensor.z_mm=-7.0",
    X_WT,
];

/// The changes of bench-config/rig-epos4.toml on every bus, with their reasons, as in docs/rig.md.
const CHANGES: [Change; 11] = [
    // Shorter runs: a shorter insertion, the highest speed that the limits allow, and a faster withdrawal.
    ("depth_mm = 50.0", "depth_mm = 25.0"),
    ("speed_mm_per_s = 1.0\nacceleration", "speed_mm_per_s = 2.0\nacceleration"),
    ("jog_speed_mm_per_s = 1.0", "jog_speed_mm_per_s = 2.0"),
    ("speed_max_mm_per_s = 2.0", "speed_max_mm_per_s = 5.0"),
    ("withdraw_speed_mm_per_s = 1.0", "withdraw_speed_mm_per_s = 5.0"),
    // A busy or emulated machine deschedules a thread for 200 ms now and then: answers and heartbeats come late,
    // the following error grows, and the needle moves on without tip positions.
    (
        "sync_ms = 10 ",
        "sync_ms = 10\nsdo_timeout_ms = 1000\nmissed_feedback_max = 100\nheartbeat_timeout_ms = 3000 ",
    ),
    ("following_error_mm = 0.5", "following_error_mm = 3.0"),
    ("following_error_deg = 2.0", "following_error_deg = 90.0\njog_speed_deg_per_s = 60.0"),
    ("hold_after_s = 0.5", "hold_after_s = 3.0"),
    ("hold_after_mm = 1.0", "hold_after_mm = 6.0"),
    // In an emulated machine the default observer stalls the bench for longer than a heartbeat when it starts.
    // It also turns the base nearly all the time, and such paths are too straight to calibrate the needle.
    (
        "[needle]\nradius_mm",
        "[observer]\nkind = \"coupled\"\nshadows = []\n[observer.coupled]\ngains = \"placed\"\n\n\
         [needle]\nradius_mm",
    ),
];

/// A text that occurs once in the operator's file, and its replacement.
pub(crate) type Change = (&'static str, &'static str);

/// The operator's configuration file and its folder.
struct Rig {
    scratch: Scratch,
    interface: String,
    text: String,
}

impl Rig {
    fn new(scratch: Scratch, interface: &str, changes: &[Change]) -> Self {
        let text = read(Path::new(&repository("bench-config/rig-epos4.toml")));
        let mut rig = Rig { scratch, interface: interface.to_owned(), text };
        rig.change(&[("interface = \"can0\"", &format!("interface = \"{interface}\""))]);
        rig.change(&CHANGES);
        rig.change(changes);
        rig
    }

    fn is_hardware(&self) -> bool {
        self.text.contains("\nhardware = true")
    }

    fn path(&self, name: &str) -> PathBuf {
        self.scratch.path(name)
    }

    /// Edits the file as the page says.
    #[track_caller]
    fn change(&mut self, changes: &[(&str, &str)]) {
        for (from, to) in changes {
            assert_eq!(self.text.matches(from).count(), 1, "{from:?} in the file");
            self.text = self.text.replace(from, to);
        }
        fs::write(self.path("my-rig.toml"), &self.text).expect("a file");
    }

    fn command(&self, words: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
        command.args(words).current_dir(self.path(""));
        command
    }

    fn run(&self, words: &[&str]) -> Ended {
        Program::start(&mut self.command(words)).end()
    }

    /// The fiducials in the tracker's frame, mm.
    fn seen_mm() -> [[f64; 3]; 5] {
        let [yaw, pitch, roll] = X_WT_DEG.map(f64::to_radians);
        let x_wt = Pose {
            rotation: FixedAngles { yaw, pitch, roll }.to_rotation(),
            translation: Vector3::from(X_WT_MM),
        };
        FIDUCIALS_MM.map(|bench| x_wt.inverse().transform(&Vector3::from(bench)).into())
    }

    /// Writes the file of points that an operator measured by hand.
    fn write_points(&self) {
        let mut csv =
            "x_tracker_mm,y_tracker_mm,z_tracker_mm,x_bench_mm,y_bench_mm,z_bench_mm\n".to_owned();
        for ([x, y, z], [u, v, w]) in Self::seen_mm().into_iter().zip(FIDUCIALS_MM) {
            csv += &format!("{x},{y},{z},{u},{v},{w}\n");
        }
        fs::write(self.path("points.csv"), csv).expect("a file");
    }

    /// Holds the tool's tip at this position of the tracker's frame until the file `carried` is removed.
    fn carry(&self, [x, y, z]: [f64; 3]) {
        fs::write(self.path("new"), format!("{x} {y} {z}")).expect("a file");
        fs::rename(self.path("new"), self.path("carried")).expect("a file");
    }

    /// Touches one fiducial after the other and types its position.
    fn collect(&self, words: &[&str]) -> Ended {
        let mut command = self.command(words);
        let piped = || Stdio::piped();
        let mut child =
            command.stdin(piped()).stdout(piped()).stderr(piped()).spawn().expect("the program");
        let mut keyboard = child.stdin.take().expect("a pipe");
        let mut screen = BufReader::new(child.stderr.take().expect("a pipe")).lines();
        let mut stderr = String::new();
        let mut until = |part: &str| loop {
            let line = screen.next().unwrap_or_else(|| panic!("no {part:?} in {stderr}"));
            let line = line.expect("text");
            stderr += &format!("{line}\n");
            if line.contains(part) {
                return line;
            }
        };
        for (seen, [x, y, z]) in Self::seen_mm().into_iter().zip(FIDUCIALS_MM) {
            until(": touch it");
            self.carry(seen);
            // The tool arrives before its position is typed.
            thread::sleep(Duration::from_millis(500));
            writeln!(keyboard, "{x} {y} {z}").expect("typed");
            until("taken: ");
        }
        until(": touch it");
        writeln!(keyboard).expect("typed");
        let ended = child.wait_with_output().expect("it ends");
        fs::remove_file(self.path("carried")).expect("let go");
        let stdout = String::from_utf8(ended.stdout).expect("UTF-8");
        stderr += &screen.map_while(Result::ok).collect::<Vec<_>>().join("\n");
        Ended { status: ended.status, stdout, stderr }
    }

    fn on_terminal(&self, words: &[&str]) -> OnTerminal {
        let keyboard = self.path("keyboard");
        let _ = fs::remove_file(&keyboard);
        OnTerminal::start(&self.command(words), &keyboard, [24, 80]).expect("a terminal")
    }

    /// A run on hardware, which asks for confirmation: the operator first answers Ctrl-C, then yes. A yes that was
    /// typed before the question does not count.
    fn confirmed(&self, words: &[&str]) -> Ended {
        let asked = |run: &mut OnTerminal| {
            // The last row of the list. The question after it has no end of line.
            run.program.wait_for("  configuration ");
            thread::sleep(Duration::from_millis(500));
        };
        let mut unsure = self.on_terminal(words);
        unsure.press("y\n");
        asked(&mut unsure);
        unsure.press("\x03");
        let refused = unsure.program.end();
        refused.assert_status(1);
        assert!(refused.stdout.contains("nothing has moved"), "{}", refused.stdout);
        assert!(self.insertions().is_empty(), "a record of a run that did not begin");
        let mut sure = self.on_terminal(words);
        asked(&mut sure);
        sure.press("y\n");
        sure.program.end()
    }

    /// A run on the console: the operator holds and resumes it, and leaves the console after its end.
    fn on_console(&self, words: &[&str]) -> Ended {
        let earlier = self.insertions().len();
        let mut bench = self.on_terminal(words);
        let wait_for = |text: &str, bench: &OnTerminal| {
            let end = Instant::now() + LONG;
            let said = || {
                let run = self.insertions().into_iter().nth(earlier);
                run.map(|run| fs::read_to_string(run.join("events.log")).unwrap_or_default())
            };
            while !said().is_some_and(|said| said.contains(text)) {
                let screen = bench.program.said();
                assert!(Instant::now() < end, "not recorded: {text:?}, but {:?}\n{screen}", said());
                thread::sleep(Duration::from_millis(20));
            }
        };
        wait_for("inserting", &bench);
        bench.press(" ");
        wait_for("operator: hold at ", &bench);
        thread::sleep(Duration::from_secs(1));
        bench.press("r");
        wait_for("operator: resume at ", &bench);
        wait_for("completed", &bench);
        bench.press_to_the_end(&["q"]);
        bench.program.end()
    }

    /// Makes two more runs, each from another angle of the base, and calibrates the needle from all of them.
    fn calibrate_needle(&self, words: &[&str]) -> Ended {
        for angle in ["-90deg", "0deg"] {
            let turn = ["stage", "jog", "my-rig.toml", "--axis", "rotation", "--to", angle];
            self.run(&turn).assert_status(0);
            self.run(&["run", "my-rig.toml", "--yes"]).assert_status(0);
            self.run(&["stage", "withdraw", "my-rig.toml"]).assert_status(0);
        }
        // The run in air was too short.
        let runs = self.insertions().split_off(1);
        let runs: Vec<&str> = runs.iter().map(|run| run.to_str().expect("UTF-8")).collect();
        let with_runs = words.iter().flat_map(|word| match *word {
            "RUNS…" => runs.clone(),
            word => vec![word],
        });
        self.run(&with_runs.collect::<Vec<_>>())
    }

    /// The folders of the insertions so far, the oldest first.
    fn insertions(&self) -> Vec<PathBuf> {
        let runs = fs::read_dir(self.path("runs")).into_iter().flatten().flatten();
        let runs = runs.map(|run| run.path()).filter(|run| run.join("manifest.json").exists());
        let mut runs: Vec<_> = runs.filter(|run| manifest(run)["operation"].is_null()).collect();
        runs.sort();
        runs
    }

    /// Writes into the file the values that the page allows in place of a calibration.
    fn type_in(&mut self, line: &str) {
        if line.starts_with("calibrate registration points.csv my-rig.toml --out") {
            let typed = X_WT.strip_prefix("tracker.").expect("a key of the tracker");
            self.change(&[("# registration = {", &format!("{typed} # "))]);
        } else if line.starts_with("calibrate tip") {
            // From the sensor of the emulated rig.
            self.change(&[("tip_offset_mm = [0.0, 0.0, 0.0]", "tip_offset_mm = [-3.0, 0.0, 7.0]")]);
        }
    }

    /// Runs a command of the page, with what the page says to do before and after it.
    fn follow(&mut self, line: &str, words: Vec<String>) {
        let is = |begin: &str| line.starts_with(begin);
        let bus = format!("={}", self.interface);
        let mut words: Vec<String> = words.iter().map(|word| word.replace("=can0", &bus)).collect();
        let mut add = |more: &[&str]| words.extend(more.iter().map(|word| word.to_string()));
        if is("tracker watch") {
            add(&["--seconds", "2"]);
        } else if is("tracker rest") {
            add(&["--seconds", "6"]);
        } else if is("run") && !line.contains("--console") && !self.is_hardware() {
            add(&["--yes"]);
        } else if is("calibrate registration points.csv my-rig.toml --out") {
            // The page offers another way to the same two files.
            fs::remove_file(self.path("registration.toml")).expect("collected");
            self.write_points();
        }
        let words: Vec<&str> = words.iter().map(String::as_str).collect();
        let begun = Instant::now();
        let ended = match line {
            _ if line.contains("--collect") => self.collect(&words),
            _ if line.contains("--console") => self.on_console(&words),
            _ if is("run") && self.is_hardware() => self.confirmed(&words),
            _ if is("calibrate needle") => self.calibrate_needle(&words),
            _ => self.run(&words),
        };
        // Output is printed only on failure: all of it would hide the reason.
        println!("$ needle-bench {line}  # {:.1} s", begun.elapsed().as_secs_f64());
        // `check` fails until the registration is measured, as the page says.
        let is_registered = self.text.contains("\nregistration");
        ended.assert_status(if is("check") && !is_registered { 2 } else { 0 });
        if is("check my-rig.toml --connect") {
            assert!(ended.stdout.contains("FAIL  registration "), "{}", ended.stdout);
            assert_eq!(ended.stdout.matches("FAIL ").count(), 1, "{}", ended.stdout);
        } else if is("tracker rest") {
            let noise = read(&self.path("noise.toml"));
            let gates = self.text.find("[tracker.gates]").expect("the table");
            self.text.replace_range(gates.., &noise);
            self.change(&[]);
        } else if is("calibrate registration points.csv my-rig.toml --out") {
            self.change(&[("# registration_file", "registration_file")]);
        } else if is("calibrate tip") {
            self.change(&[("tip_offset_mm = [0.0, 0.0, 0.0] ", "# "), ("# tip_file", "tip_file")]);
        } else if line.contains("insertion.depth_mm=20") {
            // It went in from the 2 mm of the jog.
            let stands = "needle      22.0 mm in; both axes stand";
            assert!(ended.stdout.contains(stands), "{}", ended.stdout);
            assert_it_replays(&self.insertions()[0]);
        } else if line.contains("--console") {
            assert_it_replays(self.insertions().last().expect("a run"));
        } else if is("stage withdraw") {
            let status = self.run(&["stage", "status", "my-rig.toml", "--json"]).json();
            let stands_at_mm = status["insertion"]["position_mm"].as_f64().expect("a position");
            assert!(stands_at_mm.abs() < 0.1, "{status}");
        } else if is("calibrate needle") {
            let found: toml::Table = read(&self.path("needle.toml")).parse().expect("TOML");
            let radius_mm = 1.0 / found["needle"]["curvature_per_mm"].as_float().expect("a number");
            // In 30 emulated rigs it was 114 to 130 mm.
            assert!((radius_mm - 122.0).abs() < 30.0, "{found}");
            self.change(&[("radius_mm = 122.0 ", "# "), ("# needle_file", "needle_file")]);
            self.run(&["check", "my-rig.toml"]).assert_status(0);
        }
    }
}

/// Follows the page on this bus, with `changes` of the operator's file. Runs those commands that need a rig and
/// that `is_followed` accepts, and returns them.
pub(crate) fn follow(
    interface: &str,
    changes: &[Change],
    mut is_followed: impl FnMut(&str) -> bool,
) -> Vec<String> {
    let source = free_address();
    let address = format!("tracker.address=\"{source}\"");
    let mut rig = Rig::new(Scratch::new("protocol"), interface, changes);
    let file = rig.path("my-rig.toml");
    let sets = RIG.into_iter().chain([&*address]).flat_map(|set| ["--set", set]);
    let drives =
        stage(&[file.to_str().expect("UTF-8")].into_iter().chain(sets).collect::<Vec<_>>());
    let (port, carried) = (source.port().to_string(), rig.path("carried"));
    let relay = ["--from-port", &port, "--port", "0", "--stay", "--duration", "3600", "--carried"];
    let relay = [&relay[..], &[carried.to_str().expect("UTF-8"), "--tip", "-3", "0", "7"]].concat();
    let (_tracker, port) = serving_peer("pyigtl_relay.py", &relay).expect("NEEDLE_PEERS_PYTHON");
    rig.change(&[("127.0.0.1:18944", &format!("127.0.0.1:{port}"))]);

    let mut done = Vec::new();
    for (line, words) in commands() {
        if is_without_rig(&line) {
            continue;
        } else if is_followed(&line) {
            rig.follow(&line, words);
            done.push(line);
        } else {
            rig.type_in(&line);
        }
    }
    drives.signal("INT");
    drives.end().assert_status(0);
    done
}
