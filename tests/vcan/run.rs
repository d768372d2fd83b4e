//! Whole runs of `needle-bench run` and `vcan-stage` over real SocketCAN, on vcan0 of `vcan/run.sh`.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use crate::support::drives::{assert_the_drives_stand, drives};
use crate::support::link::ip;
use crate::support::programs::{self, Program, Scratch, stage};
use crate::support::replays::assert_it_replays;
use crate::support::udp_stage::COUNTS_PER_MM;
use crate::support::vcan;
use crate::support::witness::Witness;
use needle_bench::transport::socketcan::SocketCan;
use serde_json::Value;

const SYNC: u16 = 0x080;
const HEARTBEAT_INSERTION: u16 = 0x701;
/// The speed of the rows of docs/hazards.md.
const SLOWLY: &str = "insertion.speed_mm_per_s=1";

fn witness_on_vcan0() -> Witness {
    Witness::new(SocketCan::open("vcan0").unwrap())
}

/// The lines of an NDJSON file without an unfinished last line.
fn ndjson(path: &Path) -> Vec<Value> {
    let text = programs::read(path);
    let whole = text.rfind('\n').map_or("", |end| &text[..end]);
    whole.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// The frames in `can.log` as direction, `T` or `R`, and `id#data`, without an unfinished last line.
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
fn an_insertion_of_150_mm_completes_with_a_complete_record() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let scratch = Scratch::new("whole");
    let truth_csv = scratch.path("truth.csv");
    let stage = stage(&["--truth", truth_csv.to_str().unwrap()]);
    // The default observer takes long in an emulated machine.
    let steered = [
        "observer.kind=\"invariant\"",
        "control.kind=\"nested-saturation\"",
        // Its first steps have held the bench up for 2.2 s.
        "tracker.hold_after_s=5",
        "can.heartbeat_timeout_ms=5000",
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
    // The bench cannot know the truth, which is on the other side of the bus.
    assert_eq!((&json["estimate_rms"], &json["final_error"]), (&Value::Null, &Value::Null));
    assert_eq!(Path::new(json["run_dir"].as_str().unwrap()), run_dir);

    assert_it_replays(&run_dir);

    // The record is complete.
    let manifest = programs::manifest(&run_dir);
    println!("{}", manifest["timing"]);
    assert_eq!(manifest["outcome"], "completed");
    assert_eq!(manifest["drives"].as_array().unwrap().len(), 2);
    assert_eq!(manifest["dropped"]["text_files"], 0);
    assert_eq!(manifest["faults"], serde_json::json!([]));
    let frames = can_log(&run_dir);
    assert_eq!(manifest["counts"]["can_frames"], frames.len());
    let sync_count = frames.iter().filter(|frame| **frame == ("T".into(), "080#".into())).count();
    assert!(sync_count > 2500, "{sync_count} SYNCs in 30 s at 10 ms; a slow machine skips some");
    let samples = ndjson(&run_dir.join("tracker.ndjson"));
    assert_eq!(manifest["counts"]["tracker_samples"], samples.len());
    assert!(samples.len() > 1000, "{} samples in 30 s at 40 Hz", samples.len());
    assert!(fs::read(run_dir.join("run.rrd")).unwrap().starts_with(b"RRF2"));
    let used = run_dir.join("config.toml");
    assert!(programs::read(&used).contains("speed_mm_per_s = 5"), "{}", used.display());

    // The last estimate is compared with the true pose at standstill. The largest errors of 24 seeds in virtual
    // time were 0.4 mm, 1.6° of pitch and 4.3° of roll, and 0.9 mm from the plane.
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

/// Root may use `--realtime`. Without the permission no run begins.
#[test]
fn a_realtime_run_has_priority_80_or_names_the_missing_permission() {
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
fn ctrl_c_stops_the_run_and_closes_its_record() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let scratch = Scratch::new("interrupted");
    let (mut witness, _stage) = (witness_on_vcan0(), stage(&[]));
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
fn drives_stop_by_themselves_when_the_bench_is_killed() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let scratch = Scratch::new("killed");
    let (mut witness, _stage) = (witness_on_vcan0(), stage(&[]));
    let bench = scratch.bench(&[], &[SLOWLY]);
    witness.wait_until_inserted(2.0);
    bench.signal("KILL");
    let ended = bench.end();
    assert_eq!(ended.status.code(), None, "killed by a signal");

    // The drives send an emergency message at their timeout after the last heartbeat.
    witness.wait_for_emergency();
    let missed = witness.heartbeat_at.elapsed();
    println!("the drives reported the missing heartbeat after {missed:?}");
    let bounds = Duration::from_millis(500)..Duration::from_millis(3000);
    assert!(bounds.contains(&missed), "{missed:?} with a timeout of 1 s");
    let [insertion, _] = assert_the_drives_stand(&[]);
    let stands_at_mm = insertion.position_counts as f64 / COUNTS_PER_MM;
    // The following error depends on the machine's load, but no drive passes its last set-point.
    let reach_mm = witness.inserted_mm - 0.01..witness.commanded_mm + 0.01;
    assert!(reach_mm.contains(&stands_at_mm), "{stands_at_mm} mm, outside {reach_mm:?}");

    // The record is open, and can be read.
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
    let (mut witness, stage) = (witness_on_vcan0(), stage(&[]));
    let bench = scratch.bench(&[], &[SLOWLY]);
    witness.wait_until_inserted(2.0);
    stage.signal("KILL");
    let bench = bench.end();
    bench.assert_status(1);
    // Drives and tracker fall silent together, and the bench may notice either first.
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
    let (mut witness, _stage) = (witness_on_vcan0(), stage(&[]));
    let bench = scratch.bench(&[], &[SLOWLY]);
    witness.wait_until_inserted(2.0);
    ip("link set vcan0 down");
    let bench = bench.end();
    ip("link set vcan0 up");
    bench.assert_status(1);
    let reason = bench.last_line();
    assert!(reason.starts_with("stopped: can: interface vcan0 is down"), "{reason}");
    assert_eq!(programs::manifest(&scratch.run_dir())["outcome"], "stopped");

    // The bus is back and the drives send again, but no master commands them.
    let mut witness = witness_on_vcan0();
    let mut heartbeats = 0;
    while heartbeats < 20 {
        let frame = witness.next();
        assert!(!matches!(frame.cob_id(), Some(SYNC | 0x201 | 0x202)), "{frame}");
        heartbeats += u32::from(frame.cob_id() == Some(HEARTBEAT_INSERTION));
    }
    assert_the_drives_stand(&[]);
}

/// The kernel stamps frames with the system clock.
#[test]
fn setting_the_system_clock_during_a_run_changes_nothing() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    if std::env::var("NEEDLE_GUEST").is_err() {
        println!("skipped: only the clock of the virtual machine is set");
        return;
    }
    let scratch = Scratch::new("clock");
    let (mut witness, _stage) = (witness_on_vcan0(), stage(&[]));
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

#[test]
fn a_stop_from_another_process_ends_a_run_on_the_bus() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let scratch = Scratch::new("stopped");
    let (mut witness, _stage) = (witness_on_vcan0(), stage(&[]));
    let bench = scratch.bench(&[], &[SLOWLY]);
    witness.wait_until_inserted(2.0);
    let mut stop = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
    stop.current_dir(env!("CARGO_MANIFEST_DIR"));
    stop.args(["stop", "--config", "bench-config/vcan.toml"]);
    let stop = Program::start(stop.args(["--set", "can.sdo_timeout_ms=1000"])).end();
    stop.assert_status(0);
    let bench = bench.end();
    bench.assert_status(1);
    let reason = bench.last_line();
    assert!(reason.starts_with("stopped: stage: another master on the bus: "), "{reason}");
    assert_the_drives_stand(&[]);
}

/// The stage's process causes the same faults as in virtual time.
#[test]
fn scripted_faults_end_the_run_with_their_reason() {
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
    assert!(programs::csv(&run_dir.join("steps.csv")).is_empty(), "the insertion has begun");
    assert_eq!(assert_the_drives_stand(&[]).map(|drive| drive.position_counts), before);
}

#[test]
fn a_run_without_drives_or_interface_fails_with_the_reason() {
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
