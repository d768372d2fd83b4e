//! Whole runs over real SocketCAN, between the public programs alone: `needle-bench run` on one
//! side of vcan0, `vcan-stage` on the other. `vcan/run.sh` provides the interface.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use crate::support::drives::{assert_the_drives_stand, drives};
use crate::support::link::ip;
use crate::support::programs::{self, LONG, Program, Scratch, stage};
use crate::support::replays::assert_it_replays;
use crate::support::vcan;
use needle_bench::canopen::Frame;
use needle_bench::transport::can::{BusEvent, CanBus};
use needle_bench::transport::socketcan::SocketCan;
use serde_json::Value;

/// Counts per mm of the insertion drive in bench-config/vcan.toml.
const COUNTS_PER_MM: f64 = 4646.0;
const SYNC: u16 = 0x080;
const TPDO1_INSERTION: u16 = 0x181;
const RPDO1_INSERTION: u16 = 0x201;
const HEARTBEAT_BENCH: u16 = 0x77F;
const HEARTBEAT_INSERTION: u16 = 0x701;
const EMCY_INSERTION: u16 = 0x081;
/// The speed of the rows of docs/hazards.md.
const SLOWLY: &str = "insertion.speed_mm_per_s=1";

/// A witness on vcan0: no part of the bench, and no part of the stage.
struct Witness {
    bus: SocketCan,
    /// By the insertion drive's own word, in its last TPDO1.
    inserted_mm: f64,
    /// The bench's last set-point for it, in its last RPDO1.
    commanded_mm: f64,
    /// When the bench was last heard.
    bench_heard: Instant,
}

impl Witness {
    fn new() -> Self {
        let bus = SocketCan::open("vcan0").unwrap();
        Witness { bus, inserted_mm: 0.0, commanded_mm: 0.0, bench_heard: Instant::now() }
    }

    /// The next frame.
    fn next(&mut self) -> Frame {
        let frame = loop {
            match self.bus.receive(LONG).unwrap() {
                Some(BusEvent::Frame(frame)) => break frame,
                Some(BusEvent::Error(_)) => {}
                None => panic!("vcan0 is silent"),
            }
        };
        match (frame.cob_id(), frame.data()) {
            // Statusword, then position.
            (Some(TPDO1_INSERTION), &[_, _, a, b, c, d]) => {
                self.inserted_mm = f64::from(i32::from_le_bytes([a, b, c, d])) / COUNTS_PER_MM;
            }
            // Controlword, then target.
            (Some(RPDO1_INSERTION), &[_, _, a, b, c, d]) => {
                self.commanded_mm = f64::from(i32::from_le_bytes([a, b, c, d])) / COUNTS_PER_MM;
            }
            (Some(HEARTBEAT_BENCH), _) => self.bench_heard = Instant::now(),
            _ => {}
        }
        frame
    }

    /// Waits until the needle is `depth_mm` in.
    fn wait_until_inserted(&mut self, depth_mm: f64) {
        let end = Instant::now() + LONG;
        while self.inserted_mm < depth_mm {
            self.next();
            assert!(Instant::now() < end, "the needle was not seen {depth_mm} mm in");
        }
    }
}

/// The lines of an ndjson file; an unfinished last one is left out.
fn ndjson(path: &Path) -> Vec<Value> {
    let text = programs::read(path);
    let whole = text.rfind('\n').map_or("", |end| &text[..end]);
    whole.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// The frames in `can.log`, as `T` or `R` and `id#data`; an unfinished last line is left out.
fn can_log(run_dir: &Path) -> Vec<(String, String)> {
    let text = programs::read(&run_dir.join("can.log"));
    let whole = text.rfind('\n').map_or("", |end| &text[..end]);
    let frame = |line: &str| match line.split(' ').collect::<Vec<_>>()[..] {
        [stamp, "vcan0", frame, direction] if stamp.starts_with('(') => {
            (direction.to_owned(), frame.to_owned())
        }
        _ => panic!("not a line of candump -L: {line}"),
    };
    whole.lines().map(frame).collect()
}

fn number(row: &std::collections::HashMap<String, String>, column: &str) -> f64 {
    row[column].parse().unwrap_or_else(|_| panic!("{column}: {:?}", row[column]))
}

#[test]
fn a_whole_insertion() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let scratch = Scratch::new("whole");
    let truth_csv = scratch.path("truth.csv");
    let stage = stage(&["--truth", truth_csv.to_str().unwrap()]);
    // The default observer takes long there.
    let steered = [
        "observer.kind=\"invariant\"",
        "control.kind=\"nested-saturation\"",
        "tracker.hold_after_s=2",
        "can.heartbeat_timeout_ms=2000",
    ];
    let bench = scratch.bench(&["--json"], &steered).end();
    bench.assert_status(0);
    assert_the_drives_stand(&[]);
    stage.signal("INT");
    stage.end().assert_status(0);

    let run_dir = scratch.run_dir();
    let json = bench.json();
    assert_eq!(json["outcome"], "completed");
    assert_eq!(json["stop_reason"], Value::Null);
    assert!((json["insertion_mm"].as_f64().unwrap() - 150.0).abs() < 0.1, "{json}");
    assert!(json["off_plane_rms_mm"].as_f64().unwrap() < 4.0, "{json}");
    // Truth is on the other side of the bus.
    assert_eq!((&json["estimate_rms"], &json["final_error"]), (&Value::Null, &Value::Null));
    assert_eq!(Path::new(json["run_dir"].as_str().unwrap()), run_dir);

    assert_it_replays(&run_dir);

    // The record is whole.
    let manifest = programs::manifest(&run_dir);
    println!("{}", manifest["timing"]);
    assert_eq!(manifest["outcome"], "completed");
    assert_eq!(manifest["drives"].as_array().unwrap().len(), 2);
    assert_eq!(manifest["dropped"]["text_files"], 0);
    assert_eq!(manifest["faults"], serde_json::json!([]));
    let frames = can_log(&run_dir);
    assert_eq!(manifest["counts"]["can_frames"], frames.len());
    let sync_count = frames.iter().filter(|frame| **frame == ("T".into(), "080#".into())).count();
    assert!(sync_count > 2500, "30 s at 10 ms, less what a slow machine skips: {sync_count}");
    let samples = ndjson(&run_dir.join("tracker.ndjson"));
    assert_eq!(manifest["counts"]["tracker_samples"], samples.len());
    assert!(samples.len() > 1000, "30 s at 40 Hz: {}", samples.len());
    assert!(fs::read(run_dir.join("run.rrd")).unwrap().starts_with(b"RRF2"));
    let used = run_dir.join("config.toml");
    assert!(programs::read(&used).contains("speed_mm_per_s = 5"), "{}", used.display());

    // The estimate at the end, against where the stage's needle truly came to rest. Of 24 seeds in
    // virtual time the worst was 0.4 mm, 1.6 degrees of pitch and 4.3 of roll, and 0.9 mm from the
    // plane.
    let steps = programs::csv(&run_dir.join("steps.csv"));
    assert_eq!(steps.len(), 151);
    for (n, step) in steps.iter().enumerate() {
        assert_eq!(step["step"], n.to_string());
        assert!((number(step, "insertion_mm") - n as f64).abs() < 0.5, "{step:?}");
    }
    let (last, truth) = (&steps[150], programs::csv(&truth_csv).pop().unwrap());
    let bounds = [
        ("x", "mm", 1.0),
        ("y", "mm", 1.0),
        ("z", "mm", 1.0),
        ("yaw", "rad", 0.07),
        ("pitch", "rad", 0.07),
        ("roll", "rad", 0.2),
    ];
    for (quantity, unit, bound) in bounds {
        let estimated = number(last, &format!("{quantity}_est_{unit}"));
        let truly = number(&truth, &format!("{quantity}_true_{unit}"));
        let error = estimated - truly;
        println!("{quantity}: estimated {estimated:.3}, true {truly:.3} {unit}");
        assert!(error.abs() < bound, "{quantity}: {estimated} estimated, {truly} true, {unit}");
    }
    assert!(number(&truth, "x_true_mm").abs() < 2.0, "{truth:?}");
}

/// Root has the rights; whoever has not is told which they are, and nothing moves.
#[test]
fn in_real_time() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let scratch = Scratch::new("realtime");
    let _stage = stage(&[]);
    let bench = scratch
        .bench(
            &["--json", "--realtime"],
            &["insertion={ depth_mm = 5, plane_out_of_reach = \"insert\" }"],
        )
        .end();
    if bench.status.code() == Some(3) {
        let error = bench.json()["error"].to_string();
        assert!(error.contains("--realtime: ") && error.contains("limits.conf"), "{error}");
        assert!(!scratch.path("runs").exists());
        return;
    }
    bench.assert_status(0);
    let timing = &programs::manifest(&scratch.run_dir())["timing"];
    println!("{timing}");
    assert_eq!(timing["realtime"]["priority"], 80);
    assert!(timing["realtime"]["cpu"].is_u64(), "{timing}");
    assert!(timing["syncs"].as_u64().unwrap() > 50, "{timing}");
}

#[test]
fn interrupted_by_the_operator() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let scratch = Scratch::new("interrupted");
    let (mut witness, _stage) = (Witness::new(), stage(&[]));
    let bench = scratch.bench(&[], &[SLOWLY]);
    witness.wait_until_inserted(2.0);
    bench.signal("INT");
    let bench = bench.end();
    bench.assert_status(1);
    assert_eq!(bench.last_line(), "stopped: operator: interrupted");
    assert_the_drives_stand(&[]);

    let run_dir = scratch.run_dir();
    let manifest = programs::manifest(&run_dir);
    assert_eq!(manifest["outcome"], "stopped");
    assert_eq!(manifest["stop_reason"], "operator: interrupted");
    assert_eq!(manifest["counts"]["can_frames"], can_log(&run_dir).len());
    assert!(manifest["ended_utc"].is_string(), "{manifest}");
}

#[test]
fn a_killed_bench_leaves_drives_that_stop_by_themselves() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let scratch = Scratch::new("killed");
    let (mut witness, _stage) = (Witness::new(), stage(&[]));
    let bench = scratch.bench(&[], &[SLOWLY]);
    witness.wait_until_inserted(2.0);
    bench.signal("KILL");
    let ended = bench.end();
    assert_eq!(ended.status.code(), None, "killed by a signal");

    // The drives say when they miss the bench: their time-out after its last heartbeat.
    while witness.next().cob_id() != Some(EMCY_INSERTION) {}
    let missed = witness.bench_heard.elapsed();
    println!("the drives missed the bench after {missed:?}");
    let bounds = Duration::from_millis(500)..Duration::from_millis(3000);
    assert!(bounds.contains(&missed), "the time-out is 1 s, and it was {missed:?}");
    let [insertion, _] = assert_the_drives_stand(&[]);
    let stands_at_mm = insertion.position_counts as f64 / COUNTS_PER_MM;
    // How far the drive lags behind its set-points is the machine's load; past the last of them no
    // drive goes.
    let reach_mm = witness.inserted_mm - 0.01..witness.commanded_mm + 0.01;
    assert!(reach_mm.contains(&stands_at_mm), "{stands_at_mm} mm, outside {reach_mm:?}");

    // Nobody closed the record, and it can be read.
    let run_dir = scratch.run_dir();
    assert_eq!(programs::manifest(&run_dir)["outcome"], Value::Null);
    let (steps, frames) = (programs::csv(&run_dir.join("steps.csv")), can_log(&run_dir));
    assert!(steps.len() >= 2, "{} steps", steps.len());
    assert!(frames.len() > 500, "{} frames", frames.len());
    assert!(ndjson(&run_dir.join("tracker.ndjson")).len() > 20);
}

#[test]
fn a_stage_that_vanishes_ends_the_run() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let scratch = Scratch::new("vanished");
    let (mut witness, stage) = (Witness::new(), stage(&[]));
    let bench = scratch.bench(&[], &[SLOWLY]);
    witness.wait_until_inserted(2.0);
    stage.signal("KILL");
    let bench = bench.end();
    bench.assert_status(1);
    // Drives and tracker fall silent together; whichever is missed first.
    let reason = bench.last_line();
    let silent = ["no TPDO1", "no heartbeat", "tracker: last tip"];
    assert!(silent.iter().any(|what| reason.contains(what)), "{reason}");
    let manifest = programs::manifest(&scratch.run_dir());
    assert_eq!(format!("stopped: {}", manifest["stop_reason"].as_str().unwrap()), reason);
}

#[test]
fn an_interface_that_goes_down_ends_the_run_for_good() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let scratch = Scratch::new("down");
    let (mut witness, _stage) = (Witness::new(), stage(&[]));
    let bench = scratch.bench(&[], &[SLOWLY]);
    witness.wait_until_inserted(2.0);
    ip("link set vcan0 down");
    let bench = bench.end();
    ip("link set vcan0 up");
    bench.assert_status(1);
    let reason = bench.last_line();
    assert!(reason.starts_with("stopped: can: interface vcan0 is down"), "{reason}");
    assert_eq!(programs::manifest(&scratch.run_dir())["outcome"], "stopped");

    // The cable is back and the drives are heard again; nobody commands them.
    let mut witness = Witness::new();
    let mut heartbeats = 0;
    while heartbeats < 20 {
        let frame = witness.next();
        assert!(!matches!(frame.cob_id(), Some(SYNC | 0x201 | 0x202)), "{frame}");
        heartbeats += u32::from(frame.cob_id() == Some(HEARTBEAT_INSERTION));
    }
    assert_the_drives_stand(&[]);
}

/// The kernel stamps frames by a clock that may be set in a run, either way.
#[test]
fn a_clock_that_is_set_in_a_run_changes_nothing() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    if std::env::var("NEEDLE_CAN").is_err() {
        println!("not the emulated machine: the clock of this one is not set");
        return;
    }
    let scratch = Scratch::new("clock");
    let (mut witness, _stage) = (Witness::new(), stage(&[]));
    let bench = scratch.bench(&["--json"], &["insertion.depth_mm=25"]);
    for (depth_mm, by_s) in [(5.0, 3600), (10.0, -7200), (15.0, 3600)] {
        witness.wait_until_inserted(depth_mm);
        let set = format!("date -s @$(($(date +%s) + {by_s}))");
        let status = Command::new("sh").args(["-c", &set]).status().unwrap();
        assert!(status.success(), "{set}: {status}");
    }
    let bench = bench.end();
    bench.assert_status(0);
    assert_eq!(bench.json()["outcome"], "completed");
    assert_the_drives_stand(&[]);
    assert_it_replays(&scratch.run_dir());
}

/// From another process, as an operator in a hurry does.
#[test]
fn a_stop_ends_a_run_on_the_bus() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let scratch = Scratch::new("stopped");
    let (mut witness, _stage) = (Witness::new(), stage(&[]));
    let bench = scratch.bench(&[], &[SLOWLY]);
    witness.wait_until_inserted(2.0);
    let mut stop = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
    stop.current_dir(env!("CARGO_MANIFEST_DIR"));
    let stop = Program::start(stop.args(["stop", "--config", "bench-config/vcan.toml"])).end();
    stop.assert_status(0);
    let bench = bench.end();
    bench.assert_status(1);
    let reason = bench.last_line();
    assert!(reason.starts_with("stopped: stage: another master on the bus: "), "{reason}");
    assert_the_drives_stand(&[]);
}

/// The same script as in virtual time, struck by the stage's own process on a real bus.
#[test]
fn scripted_faults_end_the_run_by_name() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    // Bit 9 of the statusword.
    let remote = r#"kind = "corrupt", frames = "pdo", axis = "insertion", byte = 1, mask = 0x02"#;
    for (fault, reason) in [
        (r#"kind = "bus-off", duration_s = 2"#, "stopped: can: bus off"),
        (r#"kind = "restart", axis = "rotation""#, "stopped: stage: rotation: boot-up message"),
        (r#"kind = "emergency-stop""#, "stopped: stage: insertion: emergency 0x9000"),
        (r#"kind = "silent", axis = "rotation""#, "stopped: stage: rotation: no "),
        (remote, "stopped: stage: insertion: the drive no longer obeys the bus (statusword 0x1037"),
    ] {
        let scratch = Scratch::new("scripted");
        let script = format!("emulator.fault=[{{ at_mm = 2, {fault} }}]");
        let _stage = stage(&["--set", &script]);
        let bench = scratch.bench(&[], &[SLOWLY]).end();
        bench.assert_status(1);
        assert!(bench.last_line().starts_with(reason), "{fault}: {}", bench.last_line());
        if !fault.contains("silent") {
            assert_the_drives_stand(&[]);
        }
    }
}

#[test]
fn another_drive_than_configured_is_refused_before_anything_moves() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let _stage = stage(&[]);
    let before = drives(&[]).map(|drive| drive.position_counts);
    let scratch = Scratch::new("refused");
    let bench = scratch.bench(&[], &["stage.insertion.vendor_id=0x1234"]).end();
    bench.assert_status(1);
    let reason = "stopped: stage: node 1 (insertion): 0x1018:01: expected 0x00001234, received \
                  0x000002F1, is this the drive of the configuration?";
    assert_eq!(bench.last_line(), reason);
    let run_dir = scratch.run_dir();
    assert_eq!(programs::manifest(&run_dir)["outcome"], "stopped");
    assert!(programs::csv(&run_dir.join("steps.csv")).is_empty(), "it has begun");
    assert_eq!(assert_the_drives_stand(&[]).map(|drive| drive.position_counts), before);
}

#[test]
fn without_drives_or_interface_there_is_no_run() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let scratch = Scratch::new("absent");
    let bench = scratch.bench(&[], &[]).end();
    bench.assert_status(1);
    let reason = "stopped: stage: node 1 (insertion): no answer on 601h within 2.0 s, ";
    assert!(bench.last_line().starts_with(reason), "{}", bench.last_line());
    assert_eq!(programs::manifest(&scratch.run_dir())["outcome"], "stopped");

    let scratch = Scratch::new("no-interface");
    let bench = scratch.bench(&[], &["can.interface=\"vcan9\""]).end();
    bench.assert_status(3);
    assert!(bench.stderr.contains("error: no interface vcan9: "), "{}", bench.stderr);
    assert!(!scratch.path("runs").exists(), "a run folder without a run");
}
