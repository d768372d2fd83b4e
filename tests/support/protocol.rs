//! The worked protocol of docs/rig.md: its commands, and a test that follows it from power-on to the withdrawn
//! needle, on two drives with the habits of EPOS4 and a tracker that pyigtl serves.

use super::peers::peer;
use super::program::repository;
use super::programs::{Ended, Program, Scratch, stage};
use super::replays::assert_it_replays;
use nalgebra::Vector3;
use needle_bench::geometry::{FixedAngles, Pose};
use std::fs;
use std::net::TcpListener;
use std::path::PathBuf;
use std::process::Command;
use std::time::Instant;

/// The commands of the page in its order: each as it is printed, and its words after `needle-bench`.
pub(crate) fn commands() -> Vec<(String, Vec<String>)> {
    let page = std::fs::read_to_string(repository("docs/rig.md")).expect("the page");
    let lines = page.lines().filter_map(|line| line.strip_prefix("needle-bench "));
    let commands = lines.map(|line| {
        let line = line.split(" #").next().unwrap_or_default().trim();
        (line.to_owned(), words(line))
    });
    commands.collect()
}

/// The words of a command line whose quoted argument has no space at its ends.
fn words(line: &str) -> Vec<String> {
    let parts = line.split('\'').enumerate();
    let words = parts.flat_map(|(n, part)| match n % 2 {
        0 => part.split_whitespace().map(str::to_owned).collect(),
        _ => vec![part.to_owned()],
    });
    words.collect()
}

/// Where the tracker truly is on the bench.
const X_WT: &str = "tracker.registration={ x_mm = 120.0, y_mm = -40.0, z_mm = 310.0, yaw_deg = 30.0, \
                    pitch_deg = -20.0, roll_deg = 100.0 }";
const X_WT_MM: [f64; 3] = [120.0, -40.0, 310.0];
const X_WT_DEG: [f64; 3] = [30.0, -20.0, 100.0];

/// The emulated rig: not homed.
const RIG: [&str; 6] = [
    "emulator.rehearse=true",
    "emulator.homed=false",
    "emulator.noise={ sd_mm = 0.1 }",
    "emulator.start={ x_mm = 0.2, y_mm = 0.0, z_mm = 0.0, yaw_deg = 0.0, pitch_deg = 0.0, roll_deg = 30.0 }",
    "emulator.insertion_start_mm=0.5",
    X_WT,
];

/// What differs from bench-config/rig-epos4.toml: speeds that spare time, and limits that a busy machine
/// keeps.
const CHANGES: [(&str, &str); 8] = [
    ("sync_ms = 10 ", "sync_ms = 10\nmissed_feedback_max = 30\nheartbeat_timeout_ms = 1000 "),
    ("speed_mm_per_s = 1.0\nacceleration", "speed_mm_per_s = 2.0\nacceleration"),
    ("jog_speed_mm_per_s = 1.0", "jog_speed_mm_per_s = 2.0"),
    ("withdraw_speed_mm_per_s = 1.0", "withdraw_speed_mm_per_s = 2.0"),
    ("following_error_mm = 0.5", "following_error_mm = 3.0"),
    ("following_error_deg = 2.0", "following_error_deg = 90.0\njog_speed_deg_per_s = 60.0"),
    ("hold_after_s = 0.5", "hold_after_s = 3.0"),
    ("hold_after_mm = 1.0", "hold_after_mm = 6.0"),
];

/// The operator's file and folder.
struct Rig {
    scratch: Scratch,
    text: String,
}

impl Rig {
    fn new(scratch: Scratch, changes: &[(&str, &str)]) -> Self {
        let text =
            fs::read_to_string(repository("bench-config/rig-epos4.toml")).expect("the example");
        let mut rig = Rig { scratch, text };
        rig.change(&CHANGES);
        rig.change(changes);
        rig
    }

    fn file(&self) -> PathBuf {
        self.scratch.path("my-rig.toml")
    }

    /// Edits the file, as the page says.
    #[track_caller]
    fn change(&mut self, changes: &[(&str, &str)]) {
        for (from, to) in changes {
            assert_eq!(self.text.matches(from).count(), 1, "{from:?} in the file");
            self.text = self.text.replace(from, to);
        }
        fs::write(self.file(), &self.text).expect("a file");
    }

    fn run(&self, words: &[&str]) -> Ended {
        let mut command = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
        Program::start(command.args(words).current_dir(self.scratch.path(""))).end()
    }

    /// The fiducials that the operator touched, as the tracker gives them and as they are on the bench.
    fn points(&self) {
        let [yaw, pitch, roll] = X_WT_DEG.map(f64::to_radians);
        let x_wt = Pose {
            rotation: FixedAngles { yaw, pitch, roll }.to_rotation(),
            translation: Vector3::from(X_WT_MM),
        };
        let mut csv =
            "x_tracker_mm,y_tracker_mm,z_tracker_mm,x_bench_mm,y_bench_mm,z_bench_mm\n".to_owned();
        for bench in
            [[0., 0., 0.], [40., 0., 10.], [0., 40., 20.], [-40., 0., 60.], [0., -40., 80.]]
        {
            let [x, y, z]: [f64; 3] = x_wt.inverse().transform(&Vector3::from(bench)).into();
            csv += &format!("{x},{y},{z},{},{},{}\n", bench[0], bench[1], bench[2]);
        }
        fs::write(self.scratch.path("points.csv"), csv).expect("a file");
    }

    /// The newest run's folder.
    fn newest_run(&self) -> PathBuf {
        let runs = fs::read_dir(self.scratch.path("runs")).expect("runs").flatten();
        runs.map(|run| run.path()).max().expect("a run")
    }
}

/// How a test follows the page.
pub(crate) struct Protocol<'a> {
    /// Changes of the operator's file.
    pub(crate) changes: &'a [(&'a str, &'a str)],
    /// Settings of the emulated rig.
    pub(crate) rig: &'a [&'a str],
    /// Further arguments of each `run`.
    pub(crate) run: &'a [&'a str],
    /// Commands of the page that are left out, by how they begin; "replay" stands for the replay of the run.
    pub(crate) leaves_out: &'a [&'a str],
}

/// Follows the page, and gives the commands that were run: none where there is no Python for the tracker.
pub(crate) fn follow(protocol: &Protocol<'_>) -> Vec<String> {
    let mut done = Vec::new();
    let free = TcpListener::bind("127.0.0.1:0").expect("a free port").local_addr().expect("a port");
    let of_drives = format!("tracker.address=\"{free}\"");
    let mut rig = Rig::new(Scratch::new("protocol"), protocol.changes);
    let file = rig.file();
    let sets = RIG.iter().chain(protocol.rig).copied().chain([&*of_drives]);
    let sets = sets.flat_map(|set| ["--set", set]);
    let drives =
        stage(&[file.to_str().expect("UTF-8")].into_iter().chain(sets).collect::<Vec<_>>());
    let port = free.port().to_string();
    let relay = ["--from-port", &port, "--port", "0", "--stay", "--duration", "900"];
    let Some(mut tracker) = peer("pyigtl_relay.py", &relay) else { return done };
    tracker.wait_for("listening ");
    let said = tracker.said();
    let port = said.lines().find_map(|line| line.strip_prefix("listening ")).expect("a port");
    rig.change(&[("127.0.0.1:18944", &format!("127.0.0.1:{port}"))]);

    for (line, words) in commands() {
        // What is tried without the rig, and points that a hand has to touch, have tests of their own.
        if !words.contains(&"my-rig.toml".to_owned())
            || line.contains("--rehearse")
            || line.contains("--collect")
            || protocol.leaves_out.iter().any(|begin| line.starts_with(begin))
        {
            continue;
        }
        let mut words: Vec<&str> = words.iter().map(String::as_str).collect();
        let is = |begin: &str| line.starts_with(begin);
        if is("tracker rest") {
            words.extend(["--seconds", "6"]);
        }
        if is("calibrate registration") {
            rig.points();
        } else if is("run") {
            words.push("--yes");
            words.extend(protocol.run);
        }
        let begun = Instant::now();
        let ended = rig.run(&words);
        let is_registered = rig.text.contains("\nregistration_file");
        let expected = if is("check") && !is_registered { 2 } else { 0 };
        let took_s = begun.elapsed().as_secs_f64();
        println!("$ needle-bench {line}  # {took_s:.1} s\n{}{}", ended.stdout, ended.stderr);
        ended.assert_status(expected);
        if is("check my-rig.toml --connect") {
            assert!(ended.stdout.contains("FAIL  registration "), "{}", ended.stdout);
            assert_eq!(ended.stdout.matches("FAIL ").count(), 1, "{}", ended.stdout);
        } else if is("stage prove my-rig.toml") {
            rig.run(&["stage", "reset", "my-rig.toml"]).assert_status(0);
        } else if is("tracker rest") {
            let noise = fs::read_to_string(rig.scratch.path("noise.toml")).expect("measured");
            let gates = rig.text.find("[tracker.gates]").expect("the table");
            rig.text.replace_range(gates.., &noise);
            rig.change(&[]);
        } else if is("calibrate registration") {
            rig.change(&[("# registration_file", "registration_file")]);
        } else if is("calibrate tip") {
            rig.change(&[("tip_offset_mm = [0.0, 0.0, 0.0] ", "# "), ("# tip_file", "tip_file")]);
        } else if is("run") {
            assert!(
                ended.stdout.contains("needle      20.0 mm in; both axes stand"),
                "{}",
                ended.stdout
            );
            if !protocol.leaves_out.contains(&"replay") {
                assert_it_replays(&rig.newest_run());
            }
        }
        done.push(line);
    }
    assert!(done.last().expect("some").starts_with("stage withdraw"), "{done:#?}");
    let status = rig.run(&["stage", "status", "my-rig.toml", "--json"]).json();
    let stands_at_mm = status["insertion"]["position_mm"].as_f64().expect("a position");
    assert!(stands_at_mm.abs() < 0.1, "{status}");
    drives.signal("INT");
    drives.end().assert_status(0);
    done
}
