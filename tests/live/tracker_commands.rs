//! `needle-bench tracker` against servers on the loopback: the bench's own server and one of pyigtl.

use crate::support::peers::serving_peer;
use crate::support::program::{Said, Scratch, needle_bench};
use crate::support::programs::{Program, beside_others, free_address, send_signal};
use needle_bench::emulator::WhiteNoise;
use needle_bench::tracker::openigtlink::{Body, IgtlStamp, Message};
use needle_bench::transport::tcp::TransformServer;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpListener;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

/// A server of two tools at rest with 100 messages of each per second. It ends with the test.
struct Server {
    port: u16,
    /// Position of the tools, mm.
    at: Arc<Mutex<[f32; 3]>>,
    ends: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Server {
    fn start() -> Self {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let server = runtime.block_on(TransformServer::bind("127.0.0.1:0")).expect("loopback");
        let port = server.local_addr().port();
        let ends = Arc::new(AtomicBool::new(false));
        let ended = Arc::clone(&ends);
        let at = Arc::new(Mutex::new([0.0; 3]));
        let position = Arc::clone(&at);
        let thread = std::thread::spawn(move || {
            runtime.block_on(async {
                let mut period = tokio::time::interval(Duration::from_millis(10));
                for k in 0.. {
                    period.tick().await;
                    if ended.load(Ordering::Relaxed) {
                        return;
                    }
                    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap();
                    let stamp = IgtlStamp::from_unix_ns(i64::try_from(now.as_nanos()).unwrap());
                    for (n, tool) in (0u16..).zip(["NeedleToTracker", "StylusToTracker"]) {
                        let noise =
                            WhiteNoise::Gaussian(0.1).draw(u64::from(n), k).map(|mm| mm as f32);
                        let [x, y, z] = *position.lock().unwrap();
                        let (x, y, z) = (x + noise.x, y + noise.y, z + noise.z);
                        let x = x + 10.0 * f32::from(n) + 10.0;
                        let pose = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, x, y, z];
                        server.send(&Message::new(tool, stamp, Body::Transform(pose)));
                    }
                }
            });
        });
        Server { port, at, ends, thread: Some(thread) }
    }

    /// `needle-bench tracker COMMAND…` with this server as its tracker.
    fn tracker(&self, scratch: &Scratch, command: &[&str]) -> Said {
        tracker(scratch, self.port, command)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.ends.store(true, Ordering::Relaxed);
        self.thread.take().map(JoinHandle::join);
    }
}

fn tracker(scratch: &Scratch, port: u16, command: &[&str]) -> Said {
    let address = format!("tracker.address=\"127.0.0.1:{port}\"");
    let named = ["--set", &address];
    needle_bench(scratch, &[&["tracker"], command, &named].concat())
}

#[test]
fn the_tools_are_listed_with_type_and_rate() {
    let _machine = beside_others();
    let (server, scratch) = (Server::start(), Scratch::new());
    let said = server.tracker(&scratch, &["list", "--seconds", "2", "--json"]);
    assert_eq!(said.status, 0, "{}", said.stderr);
    let json = said.json();
    let tools = json["tools"].as_array().expect("tools");
    assert_eq!(tools.len(), 2, "{json}");
    for (tool, name) in tools.iter().zip(["Needle", "Stylus"]) {
        assert_eq!(tool["tool"], format!("{name}ToTracker"));
        assert_eq!(
            (&tool["type"], &tool["is_configured"]),
            (&"TRANSFORM".into(), &(name == "Needle").into())
        );
        let rate_hz = tool["rate_hz"].as_f64().expect("a rate");
        assert!((50.0..150.0).contains(&rate_hz), "{rate_hz}");
    }
    let said =
        server.tracker(&scratch, &["list", "--seconds", "0.5", "--set", "tracker.tool=Probe"]);
    assert_eq!(said.status, 0, "{}", said.stderr);
    assert!(said.stdout.starts_with("tool  "), "{}", said.stdout);
    assert!(said.stderr.contains("none of them is tracker.tool = \"Probe\""), "{}", said.stderr);
}

#[test]
fn watch_prints_a_line_a_second() {
    let _machine = beside_others();
    let (server, scratch) = (Server::start(), Scratch::new());
    let said = server.tracker(&scratch, &["watch", "--seconds", "2.5"]);
    assert_eq!(said.status, 0, "{}", said.stderr);
    let lines: Vec<&str> = said.stdout.lines().collect();
    assert!((2..=4).contains(&lines.len()), "{}", said.stdout);
    for part in
        [" s  x ", " mm (tracker, not registered)  ", " Hz  age 0.0", " accepted, 0 refused"]
    {
        assert!(lines[1].contains(part), "no {part:?} in {}", said.stdout);
    }
}

/// `calibrate tracker` reads both formats of `record`.
#[test]
fn recordings_and_rest_measure_the_same_noise() {
    let _machine = beside_others();
    let (server, scratch) = (Server::start(), Scratch::new());
    let rest = std::thread::scope(|scope| {
        for file in ["rest.csv", "rest.ndjson"] {
            scope.spawn(|| {
                let said = server.tracker(&scratch, &["record", file, "--seconds", "7"]);
                assert_eq!(said.status, 0, "{}", said.stderr);
                assert!(
                    said.stderr.contains(" samples of \"NeedleToTracker\" in rest."),
                    "{}",
                    said.stderr
                );
            });
        }
        server.tracker(&scratch, &["rest", "--seconds", "7", "--json"])
    });
    let csv = std::fs::read_to_string(scratch.path().join("rest.csv")).expect("a recording");
    assert!(
        csv.starts_with("receive_time_ns,stamp_unix_ns,x_mm,y_mm,z_mm,qw,qx,qy,qz\n"),
        "{}",
        &csv[..200]
    );
    let calibrated = ["rest.csv", "rest.ndjson"]
        .map(|file| needle_bench(&scratch, &["calibrate", "tracker", file, "--json"]));
    for said in calibrated.iter().chain([&rest]) {
        assert_eq!(said.status, 0, "{}", said.stderr);
        let json = said.json();
        let sd_mm = json["tracker"]["gates"]["noise_sd_mm"].as_f64().expect("a number");
        assert!((sd_mm - 0.1).abs() < 0.015, "{json}");
        assert!(json["fit"]["latency_jitter_ms"]["value"].as_f64().expect("stamps") < 50.0);
    }
}

/// `calibrate registration --collect` with this server as its tracker.
fn collecting(server: &Server, scratch: &Scratch) -> Child {
    Command::new(env!("CARGO_BIN_EXE_needle-bench"))
        .current_dir(scratch.path())
        .args(["calibrate", "registration", "points.csv", "--collect", "--json"])
        .args(["--set", &format!("tracker.address=\"127.0.0.1:{}\"", server.port)])
        .args(["--set", "can.interface=vcan0", "--set", "tracker.source=openigtlink"])
        .args(["--set", "tracker.gates.noise_sd_mm=0.1"])
        // The tip touches the points, not the sensor.
        .args(["--set", "tracker.tip_offset_mm=[0.0, 0.0, 7.0]"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts")
}

/// A terminal that closes sends this signal. It must not leave a registration of half of the points.
#[test]
fn an_interrupted_collection_keeps_its_points_and_writes_no_registration() {
    let _machine = beside_others();
    let (server, scratch) = (Server::start(), Scratch::new());
    let mut collecting = collecting(&server, &scratch);
    let mut operator = collecting.stdin.take().expect("a pipe");
    let mut screen = BufReader::new(collecting.stderr.take().expect("a pipe")).lines();
    let mut until = |part: &str| {
        let mut lines = screen.by_ref().map_while(Result::ok);
        lines.find(|line| line.contains(part)).unwrap_or_else(|| panic!("no {part:?}"))
    };
    for (n, [x, y]) in (1..).zip([[0.0f32, 0.0], [50.0, 0.0], [0.0, 40.0]]) {
        until(&format!("point {n}: touch it"));
        *server.at.lock().unwrap() = [x, y, 0.0];
        std::thread::sleep(Duration::from_millis(300));
        writeln!(operator, "{x} {y} 0").unwrap();
        until("taken: ");
    }
    until("point 4: touch it");
    send_signal(collecting.id(), "HUP");
    until("interrupted, or the tracker's stream has ended; 3 points are in points.csv: ");
    assert_eq!(collecting.wait().unwrap().code(), Some(1));
    let points = std::fs::read_to_string(scratch.path().join("points.csv")).unwrap();
    assert_eq!(points.lines().count(), 4, "{points}");
}

/// The tool touches one point after the other, and the operator types the position of each.
#[test]
fn a_registration_is_collected_point_by_point() {
    let _machine = beside_others();
    let (server, scratch) = (Server::start(), Scratch::new());
    let mut collecting = collecting(&server, &scratch);
    let mut operator = collecting.stdin.take().expect("a pipe");
    let mut screen = BufReader::new(collecting.stderr.take().expect("a pipe")).lines();
    let mut said = Vec::new();
    let mut until = |part: &str| {
        let line = screen.by_ref().map_while(Result::ok).inspect(|line| said.push(line.clone()));
        let found = line.into_iter().any(|line| line.contains(part));
        assert!(found, "no {part:?} in {said:#?}");
    };
    let points: [[f32; 3]; 4] =
        [[0.0, 0.0, 0.0], [50.0, 0.0, 0.0], [0.0, 40.0, 0.0], [0.0, 0.0, 30.0]];
    for (n, [x, y, z]) in points.into_iter().enumerate() {
        until(&format!("point {}: touch it", n + 1));
        *server.at.lock().unwrap() = [x, y, z];
        std::thread::sleep(Duration::from_millis(300));
        if n == 1 {
            // A malformed line takes no point, and `undo` removes a mistyped one.
            writeln!(operator, "fifty").unwrap();
            until("not three numbers: fifty");
            until("point 2: touch it");
            writeln!(operator, "500 20 -3").unwrap();
            until("taken: ");
            until("point 3: touch it");
            writeln!(operator, "undo").unwrap();
            until("point 2: touch it");
        }
        writeln!(operator, "{} {}, {}", x + 110.0, y + 20.0, z - 3.0).unwrap();
        if n == 2 {
            // The tool slips while it should rest, and is put back.
            std::thread::sleep(Duration::from_millis(400));
            *server.at.lock().unwrap() = [x + 9.0, y, z];
            until("the tool moves: hold it still");
            *server.at.lock().unwrap() = [x, y, z];
        }
        until("taken: ");
    }
    until("point 5: touch it");
    writeln!(operator).unwrap();
    let mut result = String::new();
    collecting.stdout.take().expect("a pipe").read_to_string(&mut result).unwrap();
    assert!(collecting.wait().unwrap().success());
    let json: serde_json::Value = serde_json::from_str(&result).unwrap();
    let registration = &json["registration"];
    for (key, expected) in [("x_mm", 100.0), ("y_mm", 20.0), ("z_mm", -10.0)] {
        let found = registration[key].as_f64().unwrap();
        assert!((found - expected).abs() < 0.5, "{json}");
    }
    assert_eq!(registration["fit"]["points"], 4);
    assert_eq!(registration["fit"]["tool"], "NeedleToTracker");
    assert_eq!(registration["fit"]["tip_offset_mm"], serde_json::json!([0.0, 0.0, 7.0]));
    let points = std::fs::read_to_string(scratch.path().join("points.csv")).unwrap();
    assert_eq!(points.lines().count(), 5, "{points}");
}

#[test]
fn commands_without_a_tracker_or_its_tool_fail_with_the_reason() {
    let _machine = beside_others();
    let (server, scratch) = (Server::start(), Scratch::new());
    let fails = |said: Said, status: i32, part: &str| {
        assert_eq!(said.status, status, "{}", said.stderr);
        assert!(said.stderr.contains(part), "no {part:?} in {}", said.stderr);
        said.screen();
    };
    for command in [&["list"][..], &["watch"], &["record", "a.csv"], &["rest"]] {
        let said = needle_bench(&scratch, &[&["tracker"], command].concat());
        fails(said, 2, "tracker: none is named; give --config my-rig.toml, or --set");
    }
    let emulated =
        ["tracker", "list", "--set", "tracker.source=emulated", "--set", "can.interface=memory"];
    fails(
        needle_bench(&scratch, &emulated),
        2,
        "is \"emulated\": that tracker exists in a run alone",
    );
    let closed = free_address().port();
    let gone = ["--seconds", "1", "--set", "tracker.timeout_s=1"];
    for command in [&["list"][..], &["watch"], &["record", "a.csv"]] {
        fails(tracker(&scratch, closed, &[command, &gone].concat()), 3, "refused");
    }
    let other = ["--set", "tracker.tool=Probe", "--set", "tracker.timeout_s=1"];
    for command in [&["watch", "--seconds", "1"][..], &["record", "a.csv"], &["rest"]] {
        let said = server.tracker(&scratch, &[command, &other].concat());
        fails(said, 3, "saw \"NeedleToTracker\", \"StylusToTracker\"; set tracker.tool");
    }
    assert!(!scratch.path().join("a.csv").exists(), "an empty file is left behind");
    fails(server.tracker(&scratch, &["record", "a.txt"]), 2, "ends in .csv or .ndjson");
    scratch.write("a.csv", "precious");
    fails(server.tracker(&scratch, &["record", "a.csv"]), 2, "is not overwritten");
}

/// Exit status, stdout and stderr of `needle-bench tracker COMMAND…` with `input` as its tracker.
fn piped(scratch: &Scratch, input: &str, command: &[&str]) -> (i32, String, String) {
    let input = std::fs::File::open(scratch.write("input", input)).expect("an input");
    let output = Command::new(env!("CARGO_BIN_EXE_needle-bench"))
        .args([&["tracker"], command].concat())
        .args(["--set", "tracker.source=ndjson", "--set", "tracker.address=-"])
        .current_dir(scratch.path())
        .stdin(input)
        .output()
        .expect("the program starts");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    for line in String::from_utf8_lossy(&output.stderr).lines() {
        assert!(line.chars().count() <= 200, "{line}");
    }
    (output.status.code().expect("a status"), text(&output.stdout), text(&output.stderr))
}

fn line(tool: &str, position: &str, more: &str) -> String {
    format!("{{\"tool\":\"{tool}\",\"position_tracker_mm\":{position}{more}}}\n")
}

const NEEDLE: &str = "NeedleToTracker";

/// The end of the stream is not the reason.
#[test]
fn a_stream_that_ended_without_the_tool_is_explained() {
    let scratch = Scratch::new();
    let other_key = "{\"tool\":\"NeedleToTracker\",\"position_mm\":[1,2,3]}\n".repeat(50);
    let other_tool = line("Stylus", "[1,2,3]", "").repeat(50);
    for (input, expected) in [
        (&other_key, "none of \"NeedleToTracker\"; 50 refused: ndjson: line 50: unknown field"),
        (&other_tool, "none of \"NeedleToTracker\"; saw \"Stylus\"; set tracker.tool"),
    ] {
        for command in [&["list"][..], &["watch"], &["record", "a.csv"], &["rest"]] {
            if command == ["list"] && input == &other_tool {
                continue;
            }
            let (status, _, said) = piped(&scratch, input, command);
            assert_eq!(status, 3, "{command:?}: {said}");
            assert!(said.contains("tracker: standard input sent 50 messages, "), "{said}");
            assert!(said.contains(expected), "{command:?}: no {expected:?} in {said}");
        }
    }
    // Stamps that stand still date no position, and the last refusal says what to do.
    let stuck = |x: usize| line(NEEDLE, &format!("[{x},2,3]"), ",\"source_unix_ns\":5");
    let by_stamp = ["watch", "--set", "tracker.stamp=source"];
    let (status, _, said) = piped(&scratch, &(1..50).map(stuck).collect::<String>(), &by_stamp);
    assert_eq!(status, 3, "{said}");
    let refused =
        "no position of \"NeedleToTracker\" was accepted; the last: duplicate: sent twice";
    assert!(said.contains(refused), "{said}");
}

#[test]
fn lines_that_cannot_be_read_are_counted_and_no_other_is_lost() {
    let scratch = Scratch::new();
    let good = |x: usize| line(NEEDLE, &format!("[{x},2,3]"), "");
    let lines: String = (1..=100)
        .map(|x| if x % 2 == 0 { good(x)[..30].to_owned() + "\n" } else { good(x) })
        .collect();
    // With a byte order mark, and without the last end of line.
    let input = format!("\u{feff}{lines}{}", good(101).trim_end());
    let unreadable =
        "warning: 50 messages could not be read; the last: ndjson: line 100: EOF while";
    for command in [&["list"][..], &["record", "a.csv"], &["record", "a.ndjson"], &["rest"]] {
        let (_, _, said) = piped(&scratch, &input, command);
        assert!(said.contains(unreadable), "{command:?}: {said}");
        if command[0] == "record" {
            assert!(said.contains("tracker: 51 samples of"), "{command:?}: {said}");
        }
    }
    let recorded = std::fs::read_to_string(scratch.path().join("a.ndjson")).expect("recorded");
    scratch.write("b.ndjson", &format!("{recorded}garbage\n"));
    let said = needle_bench(&scratch, &["calibrate", "tracker", "b.ndjson"]);
    let unreadable = "warning: 1 messages could not be read; the last: ndjson: line 52: ";
    assert!(said.stderr.contains(unreadable), "{}", said.stderr);
}

/// The configured tool is listed however many there are, and as valid only what `record` takes.
#[test]
fn the_list_agrees_with_the_gates() {
    let scratch = Scratch::new();
    let others: String = (0..70).map(|n| line(&format!("A{n}"), "[1,2,3]", "")).collect();
    let wrong = line("AA", "[\"NaN\",2,3]", "") + &line("AB", "[0,0,0]", "");
    let input = wrong + &others + &line(NEEDLE, "[1,2,3]", "").repeat(3);
    let (status, screen, said) = piped(&scratch, &input, &["list"]);
    assert_eq!((status, said.as_str()), (0, ""), "{screen}");
    for part in [
        "1 of 1 invalid: finite: position (NaN, 2.0, 3.0) mm",
        "1 of 1 invalid: zero: the exact zero pose",
        "valid, tracker.tool",
    ] {
        assert!(screen.contains(part), "no {part:?} in {screen}");
    }
    assert!(!screen.contains(" Hz"), "the rate of a stream that is over at once: {screen}");
}

/// As in a run, the configuration decides what is a measurement.
#[test]
fn checks_that_are_switched_off_are_off_for_every_command() {
    let scratch = Scratch::new();
    let more = ",\"orientation_tracker_wxyz\":[0,0,0,0],\"status\":\"OK\"";
    let input = (1..=20).map(|x| line(NEEDLE, &format!("[{x},2,3]"), more)).collect::<String>();
    let (status, _, said) = piped(&scratch, &input, &["record", "a.csv"]);
    assert_eq!(status, 3, "{said}");
    let off = ["--set", "tracker.gates.rotation=false"];
    let (status, _, said) = piped(&scratch, &input, &[&["record", "a.csv"], &off[..]].concat());
    assert_eq!(status, 0, "{said}");
    assert!(said.contains("tracker: 20 samples of"), "{said}");
    let (_, screen, said) = piped(&scratch, &input, &[&["list"], &off[..]].concat());
    assert!(screen.contains("valid, tracker.tool"), "{screen}{said}");
    let (_, _, said) = piped(&scratch, &input, &[&["rest"], &off[..]].concat());
    assert!(said.contains(": 20 new positions in 0.0 s, at least 100"), "{said}");
}

/// A server that closes each of its connections after one position, and goes away after three.
#[test]
fn connections_that_are_lost_are_told() {
    let _machine = beside_others();
    let scratch = Scratch::new();
    let tracker = |command: &[&str]| {
        let listener = TcpListener::bind("127.0.0.1:0").expect("loopback");
        let address = format!("tracker.address=\"{}\"", listener.local_addr().expect("a port"));
        let server = std::thread::spawn(move || {
            for x in 0..3 {
                let (mut peer, _) = listener.accept().expect("the bench connects");
                peer.write_all(line(NEEDLE, &format!("[{x},2,3]"), "").as_bytes()).expect("sent");
            }
        });
        let source = ["--set", "tracker.source=ndjson", "--set", &address];
        let said = needle_bench(&scratch, &[&["tracker"], command, &source].concat());
        server.join().expect("three connections");
        assert_eq!(said.status, 0, "{}", said.stderr);
        said
    };
    let said = tracker(&["record", "a.ndjson", "--seconds", "3"]);
    let lost = "warning: the connection was lost 3 times; the last: 127.0.0.1:";
    assert!(said.stderr.contains(lost), "{}", said.stderr);
    let said = tracker(&["watch", "--seconds", "3.5"]);
    let gone = "; not connected: cannot connect to 127.0.0.1:";
    assert!(said.stdout.contains(gone), "{}", said.stdout);
}

#[test]
fn a_recording_without_end_is_whole_after_ctrl_c() {
    let _machine = beside_others();
    let (server, scratch) = (Server::start(), Scratch::new());
    let file = scratch.path().join("rest.csv");
    let mut command = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
    command.args(["tracker", "record", "rest.csv", "--set"]);
    command.arg(format!("tracker.address=\"127.0.0.1:{}\"", server.port));
    let recording = Program::start(command.current_dir(scratch.path()));
    let written = || std::fs::metadata(&file).map_or(0, |file| file.len());
    let end = Instant::now() + Duration::from_secs(30);
    while written() == 0 {
        assert!(Instant::now() < end, "nothing is written: {}", recording.said());
        std::thread::sleep(Duration::from_millis(20));
    }
    recording.signal("INT");
    let ended = recording.end();
    assert_eq!(ended.status.code(), Some(0), "{}", ended.stderr);
    let csv = std::fs::read_to_string(&file).expect("a recording");
    let columns: Vec<usize> = csv.lines().map(|line| line.split(',').count()).collect();
    assert!(columns.len() > 50 && columns.iter().all(|columns| *columns == 9), "{columns:?}");
    let said = format!("tracker: {} samples of \"NeedleToTracker\"", columns.len() - 1);
    assert!(ended.stderr.contains(&said), "no {said:?} in {}", ended.stderr);
}

/// A limit of the file size has the effect of a full disk.
#[test]
fn a_disk_that_is_full_ends_a_recording() {
    let _machine = beside_others();
    let (server, scratch) = (Server::start(), Scratch::new());
    let command = format!(
        "ulimit -f 8; exec {} tracker record rest.csv --set 'tracker.address=\"127.0.0.1:{}\"'",
        env!("CARGO_BIN_EXE_needle-bench"),
        server.port
    );
    let output =
        Command::new("sh").args(["-c", &command]).current_dir(scratch.path()).output().expect("sh");
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(3), "{said}");
    assert!(
        said.contains("rest.csv: recording failed after ") && said.contains("; make room"),
        "{said}"
    );
}

#[test]
fn rest_refuses_a_tool_of_pyigtl_that_moves() {
    let _machine = beside_others();
    let args = ["--port", "0", "--device", "NeedleToTracker", "--rate", "50", "--duration", "60"];
    let Some((_server, port)) = serving_peer("pyigtl_server.py", &args) else { return };
    let scratch = Scratch::new();
    let port = port.parse().expect("a port");
    let said = tracker(&scratch, port, &["rest", "--seconds", "6"]);
    assert_eq!(said.status, 2, "{}", said.stderr);
    assert!(said.stderr.contains("the sensor moves by "), "{}", said.stderr);
}
