//! Whole runs of `needle-bench run` and `vcan-stage` over UDP multicast, with python-can and python-canopen on the
//! same bus.
#![cfg(target_os = "linux")]

use crate::support::peers::peer;
use crate::support::programs::{self, LONG, Program, Scratch, alone, beside_others, send_signal};
use crate::support::python_drives;
use crate::support::recorded;
use crate::support::replays::assert_it_replays;
use crate::support::udp_stage::{Stage, group};
use crate::support::witness::Witness;
use needle_bench::transport::can::{BusEvent, CanBus};
use needle_bench::transport::udp::UdpBus;
use serde_json::Value;
use std::f64::consts::TAU;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Half the speed of the tests on vcan, which have a machine to themselves.
const SLOW: &str = "insertion.speed_mm_per_s=2.5";

/// The frames of a log of `candump -L -x` in this direction.
fn frames<'a>(log: &'a str, direction: &str) -> Vec<&'a str> {
    let lines = log.lines().filter(|line| line.ends_with(direction));
    lines.filter_map(|line| line.split(' ').nth(2)).collect()
}

#[test]
fn python_can_and_both_logs_agree_on_the_frames_of_a_run() {
    let _alone = alone();
    let scratch = Scratch::new("udp");
    let log = scratch.path("stage.log");
    let stage = Stage::start(&["--log", log.to_str().unwrap()]);
    let witness = peer("udp_witness.py", &["--group", &stage.group.ip().to_string()]);
    let witness = witness.map(|mut witness| {
        witness.wait_for("listening");
        witness
    });
    let bench = scratch
        .bench(
            &["--json"],
            &stage
                .settings(&["insertion={ depth_mm = 15, plane_out_of_reach = \"insert\" }", SLOW]),
        )
        .end();
    bench.assert_status(0);
    let result = bench.json();
    assert_eq!(result["outcome"], "completed");
    assert!((stage.assert_it_stands() - 15.0).abs() < 0.1);

    let steps = programs::csv(&scratch.run_dir().join("steps.csv"));
    assert_eq!(steps.len(), 16);

    let run_dir = scratch.run_dir();
    let timing = &programs::manifest(&run_dir)["timing"];
    assert_eq!(&result["timing"], timing);
    println!("{timing}");
    let can_log = programs::read(&run_dir.join("can.log"));
    let (sent, received) = (frames(&can_log, "T"), frames(&can_log, "R"));
    let syncs = sent.iter().filter(|frame| **frame == "080#").count();
    assert!(syncs > 400, "{syncs} SYNCs in 6 s at 10 ms; a busy machine skips some");
    assert_eq!(timing["syncs"], syncs);
    assert_eq!(timing["realtime"], Value::Null);

    // The log of each side holds what the other side sent. The stage's log is longer: its drives sent before the
    // bench listened, and `check` asked them after the run.
    let stage_log = programs::read(&log);
    let (stage_sent, stage_received) = (frames(&stage_log, "T"), frames(&stage_log, "R"));
    assert!(received.len() > 500 && stage_received.starts_with(&sent));
    assert!(stage_sent.windows(received.len()).any(|window| window == received));

    let Some(witness) = witness else { return };
    witness.signal("INT");
    let witness = witness.end();
    witness.assert_status(0);
    let seen: Vec<&str> = witness.stdout.lines().skip(1).collect();
    let by_the_bench: Vec<&str> =
        seen.iter().copied().filter(|frame| sent.contains(frame)).collect();
    println!("python-can saw {} frames, {} of the bench's", seen.len(), by_the_bench.len());
    let same = by_the_bench.iter().zip(&sent).take_while(|(seen, sent)| seen == sent).count();
    let next = sent.get(same..).unwrap_or_default().iter().take(3);
    assert_eq!(same, sent.len(), "not seen, or late: {:?}", next.collect::<Vec<_>>());
}

#[test]
fn a_live_run_replays_bit_for_bit() {
    let _machine = beside_others();
    let scratch = Scratch::new("udp-replay");
    let stage = Stage::start(&[]);
    let bench = scratch
        .bench(
            &["--quiet"],
            &stage.settings(&["insertion={ depth_mm = 5, plane_out_of_reach = \"insert\" }", SLOW]),
        )
        .end();
    bench.assert_status(0);
    let run_dir = scratch.run_dir();
    recorded::keep(&run_dir, "live-udp");
    assert_it_replays(&run_dir);
}

#[test]
fn drives_stop_by_themselves_when_the_bench_is_killed() {
    let _machine = beside_others();
    let scratch = Scratch::new("udp-killed");
    let stage = Stage::start(&[]);
    let mut witness = Witness::of(&stage);
    let bench = scratch.bench(&[], &stage.settings(&["can.heartbeat_timeout_ms=400", SLOW]));
    witness.wait_until_inserted(5.0);
    bench.signal("KILL");
    assert_eq!(bench.end().status.code(), None, "killed by a signal");
    witness.wait_for_emergency();
    let further_mm = stage.assert_it_stands() - witness.inserted_mm;
    assert!((-0.01..0.5).contains(&further_mm), "{further_mm} mm after the last SYNC");
    stage.program.signal("INT");
    stage.program.end().assert_status(0);
}

/// A stop without a configuration is refused, with the command that stops the rig of the last run.
#[test]
fn a_stop_is_sent_with_a_configuration_that_no_run_accepts() {
    let _machine = beside_others();
    let scratch = Scratch::new("udp-stop");
    let stage = Stage::start(&[]);
    let mut witness = Witness::of(&stage);
    let stop = |arguments: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
        command.current_dir(scratch.path("")).args(arguments);
        Program::start(&mut command).end()
    };
    let bench = scratch.bench(&["--quiet"], &stage.settings(&[SLOW]));
    witness.wait_until_inserted(2.0);
    let config = scratch.path("rig.toml");
    let text = format!(
        "[can]\ninterface = \"udp:{}\"\nsync = 3\n[stage]\nstop_timeout_s = -1\n\
         [tracker]\nregistration_file = \"absent.toml\"\n",
        stage.group
    );
    std::fs::write(&config, text).unwrap();
    let stopped = stop(&["stop", "--config", config.to_str().unwrap()]);
    stopped.assert_status(0);
    assert!(stopped.stdout.starts_with("insertion   stands without power, at "));
    assert!(stopped.stderr.starts_with("warning: the stop was sent, but "), "{}", stopped.stderr);
    assert!(stopped.stderr.contains("absent.toml"), "{}", stopped.stderr);
    let ended = bench.end();
    ended.assert_status(1);
    assert!(ended.last_line().starts_with("stopped: stage: "), "{}", ended.last_line());
    stage.assert_it_stands();

    let unnamed = stop(&["stop"]);
    unnamed.assert_status(2);
    let named = unnamed.stderr.lines().last().unwrap();
    let named = named.strip_prefix("the last run on a bus: needle-bench ").expect(named);
    assert!(named.starts_with("stop --config runs/2") && named.ends_with("-vcan/config.toml"));
    let stopped = stop(&named.split(' ').collect::<Vec<_>>());
    stopped.assert_status(0);
    assert_eq!(stopped.stderr, "", "the run's own configuration is valid");
    let bus = format!("can.interface=udp:{}", stage.group);
    let stopped = stop(&["stage", "--set", &bus, "stop", "--json"]);
    stopped.assert_status(0);
    assert_eq!(stopped.json()["rotation"]["stands"], true);
    let unnamed = stop(&["stage", "status"]);
    unnamed.assert_status(2);
    assert!(unnamed.stderr.ends_with("-vcan/config.toml\n"), "{}", unnamed.stderr);
}

/// The tracker does not see the tool, or does not answer. The record is closed in both cases.
#[test]
fn without_a_tip_nothing_moves() {
    let _machine = beside_others();
    let stage = Stage::start(&[]);
    for setting in ["tracker.tool=\"Needle\"", "tracker.address=\"127.0.0.1:1\""] {
        let scratch = Scratch::new("no-tip");
        let bench = scratch.bench(&[], &stage.settings(&[setting])).end();
        bench.assert_status(1);
        let reason = "stopped: tracker: no tip within 5.0 s; ";
        assert!(bench.last_line().starts_with(reason), "{}", bench.last_line());
        let run_dir = scratch.run_dir();
        assert_eq!(programs::manifest(&run_dir)["outcome"], "stopped");
        assert!(
            programs::csv(&run_dir.join("steps.csv")).is_empty(),
            "{setting}: the insertion has begun"
        );
    }
    assert_eq!(stage.assert_it_stands(), 0.0);
}

/// Asserts that the bench sent nothing for 2 s, and no set-point after that.
#[track_caller]
pub(crate) fn assert_no_set_point_after_the_gap(run_dir: &Path) {
    let can_log = programs::read(&run_dir.join("can.log"));
    let sent: Vec<(f64, &str)> = can_log
        .lines()
        .filter(|line| line.ends_with('T'))
        .map(|line| {
            let mut words = line.split(' ');
            let time = words.next().unwrap().trim_matches(['(', ')']).parse().unwrap();
            (time, words.nth(1).unwrap())
        })
        .collect();
    let gap = sent.windows(2).position(|pair| pair[1].0 - pair[0].0 > 2.0).expect("a gap");
    let (before, after) = sent.split_at(gap + 1);
    // A target that was sent after the last SYNC never took effect.
    let last_sync = before.iter().rposition(|(_, frame)| *frame == "080#").expect("SYNCs");
    for axis in ["201#", "202#"] {
        let of_axis = |(_, frame): &&(f64, &str)| frame.starts_with(axis);
        let last = before[..last_sync].iter().rev().find(of_axis).expect("set-points").1;
        for (_, frame) in after.iter().filter(of_axis) {
            assert_eq!(&frame[8..], &last[8..], "a new target after the gap");
            let controlword = u8::from_str_radix(&frame[4..6], 16).unwrap();
            assert_eq!(controlword & (1 << 3), 0, "enabled after the gap: {frame}");
        }
    }
}

/// The bench is suspended for longer than the drives' heartbeat time. After that it sends only the stop, and the
/// record replays.
#[test]
fn a_bench_that_was_suspended_sends_no_set_point_when_it_resumes() {
    let _machine = beside_others();
    let scratch = Scratch::new("udp-suspended");
    let stage = Stage::start(&[]);
    let bench = scratch.bench(&[], &stage.settings(&["insertion.depth_mm=100", SLOW]));
    scratch.wait_for_event("inserting");
    std::thread::sleep(Duration::from_secs(2));
    bench.signal("STOP");
    std::thread::sleep(Duration::from_millis(2500));
    bench.signal("CONT");
    let ended = bench.end();
    ended.assert_status(1);
    let reason = ended.last_line();
    assert!(reason.starts_with("stopped: bench: was held up for 2"), "{reason}");
    assert_no_set_point_after_the_gap(&scratch.run_dir());
    stage.assert_it_stands();
    assert_it_replays(&scratch.run_dir());
}

/// A full pipe that nothing reads stands for a terminal after Ctrl-S.
#[test]
fn ctrl_c_stops_a_run_whose_stderr_is_blocked() {
    let _machine = beside_others();
    let scratch = Scratch::new("udp-unread");
    let stage = Stage::start(&[]);
    let (_unread, mut full) = std::io::pipe().unwrap();
    let stderr = full.try_clone().unwrap();
    // Fills the pipe, and then blocks until the test ends.
    std::thread::spawn(move || full.write_all(&[b'.'; 4 << 20]));
    let mut command =
        scratch.command(&["--json"], &stage.settings(&["insertion.depth_mm=100", SLOW]));
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(stderr);
    let bench = command.spawn().unwrap();
    drop(command);
    scratch.wait_for_event("inserting");
    let interrupted = Instant::now();
    send_signal(bench.id(), "INT");
    let ended = bench.wait_with_output().unwrap();
    assert!(interrupted.elapsed() < LONG);
    assert_eq!(ended.status.code(), Some(1));
    let result: Value = serde_json::from_slice(&ended.stdout).unwrap();
    assert_eq!(result["stop_reason"], "operator: interrupted");
    stage.assert_it_stands();
}

#[test]
fn python_canopen_drives_the_stage() {
    let _alone = alone();
    let stage = Stage::start(&[]);
    let group = stage.group.ip().to_string();
    let arguments = ["--interface", "udp_multicast", "--channel", &group, "--node", "1"];
    let Some(master) = peer("canopen_enable.py", &arguments) else { return };
    let master = master.end();
    println!("{}", master.stdout);
    master.assert_status(0);
    assert!(master.stdout.contains("\nhomed: "), "{}", master.stdout);
    assert_eq!(master.last_line(), "done");
    stage.assert_it_stands();
}

#[test]
fn the_bench_moves_drives_of_python_canopen() {
    let _alone = alone();
    let group = group();
    python_drives::are_moved_by_the_bench(
        "udp_multicast",
        &group.ip().to_string(),
        &format!("udp:{group}"),
    );
}

#[test]
fn realtime_is_refused_for_a_run_in_virtual_time() {
    let _machine = beside_others();
    let mut command = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
    let ended = Program::start(command.args(["run", "--realtime", "--json"])).end();
    ended.assert_status(2);
    let error = "--realtime: a run with can.interface = \"memory\" is in virtual time";
    assert_eq!(ended.json()["error"], error);
}

/// `needle-bench stage` on this bus with these settings; its words follow.
fn stage_command(scratch: &Scratch, settings: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
    command.current_dir(scratch.path("")).args(["stage", "--config"]);
    command.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/bench-config/vcan.toml"));
    for set in settings {
        command.args(["--set", set]);
    }
    command
}

/// What a machine that stops a process for half a second keeps.
const SLOW_MACHINE: [&str; 2] = ["can.missed_feedback_max=30", "can.heartbeat_timeout_ms=1000"];

/// Without a tracker the jog succeeds all the same.
#[test]
fn a_jog_records_the_samples_of_a_tracker_that_answers() {
    let _machine = beside_others();
    let stage = Stage::start(&[]);
    let absent = ["tracker.address=\"127.0.0.1:1\""];
    for (name, tracker, has_samples) in [("there", &[][..], true), ("absent", &absent, false)] {
        let scratch = Scratch::new(&format!("udp-jog-{name}"));
        let mut jog = stage_command(&scratch, &stage.settings(&[&SLOW_MACHINE, tracker].concat()));
        jog.args(["jog", "--axis", "rotation", "--by", "30deg"]);
        let ended = Program::start(&mut jog).end();
        ended.assert_status(0);
        assert!(!ended.stderr.contains("refused"), "{}", ended.stderr);
        let run_dir = scratch.run_dir();
        let samples = programs::read(&run_dir.join("tracker.ndjson")).lines().count();
        assert_eq!(samples > 10, has_samples, "{samples} samples");
        assert_it_replays(&run_dir);
    }
}

/// The tracker here computes the sensor's position from the drive's TPDO1.
#[test]
fn a_sensor_3_mm_off_the_axis_proves_or_refutes_handedness() {
    const COUNTS_PER_TURN: f64 = 75_766.0;
    let _machine = beside_others();
    let stage = Stage::start(&[]);
    let mut witness = UdpBus::join(stage.group).unwrap();
    let tracker = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("tracker.address=\"{}\"", tracker.local_addr().unwrap());
    // The first proof sees the true x axis, the second a mirrored one.
    std::thread::spawn(move || {
        for mirrored in [1.0, -1.0] {
            let (mut link, _) = tracker.accept().unwrap();
            loop {
                let event = witness.receive(LONG).unwrap();
                let Some(BusEvent::Frame(frame)) = event else { continue };
                let (Some(0x182), &[_, _, a, b, c, d]) = (frame.cob_id(), frame.data()) else {
                    continue;
                };
                let turned = f64::from(i32::from_le_bytes([a, b, c, d])) / COUNTS_PER_TURN * TAU;
                let (sin, cos) = turned.sin_cos();
                let line = format!(
                    "{{\"tool\":\"NeedleToTracker\",\"position_tracker_mm\":[{},{},1]}}\n",
                    mirrored * 3.0 * cos,
                    3.0 * sin
                );
                if link.write_all(line.as_bytes()).is_err() {
                    break;
                }
            }
        }
    });
    let scratch = Scratch::new("udp-hand");
    // The proof does not depend on the period, and a busy machine can keep a long one.
    let tracker = ["tracker.source=\"ndjson\"", "can.sync_ms=50", &address];
    let settings = stage.settings(&[&SLOW_MACHINE[..], &tracker].concat());
    let prove = || {
        let mut prove = stage_command(&scratch, &settings);
        Program::start(prove.args(["prove", "--handedness"])).end()
    };
    let right = prove();
    right.assert_status(0);
    assert!(right.stderr.contains("handedness is right: the sensor, 3.0"), "{}", right.stderr);
    let mirrored = prove();
    mirrored.assert_status(1);
    assert!(
        mirrored.last_line().contains("is a tracker axis mirrored"),
        "{}",
        mirrored.last_line()
    );
    stage.assert_it_stands();
}

/// Ctrl-C while the preflight listens counts as "no", also with `--yes`.
#[test]
fn ctrl_c_during_the_preflight_starts_no_run() {
    let _machine = beside_others();
    let scratch = Scratch::new("preflight-signal");
    let tracker = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let record = format!("record.dir=\"{}\"", scratch.path("runs").display());
    let address = format!("tracker.address=\"{}\"", tracker.local_addr().unwrap());
    let placed = "tracker.registration={ x_mm = 0.0, y_mm = 0.0, z_mm = 0.0, yaw_deg = 0.0, \
                  pitch_deg = 0.0, roll_deg = 0.0 }";
    let mut bench = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
    bench.current_dir(env!("CARGO_MANIFEST_DIR"));
    bench.args(["run", "bench-config/rig-epos4.toml", "--yes"]);
    for set in ["can.interface=can99", placed, &address, &record] {
        bench.args(["--set", set]);
    }
    let bench = Program::start(&mut bench);
    // The preflight listens for 2 s from here on.
    let _connection = tracker.accept().unwrap();
    bench.signal("INT");
    let ended = bench.end();
    let said = ended.stderr.trim_end();
    assert!(said.ends_with("stopped: operator: interrupted; nothing has moved"), "{said}");
    assert!(!scratch.path("runs").exists(), "a record of a run that did not begin");
}

#[test]
fn ctrl_c_in_each_phase_leaves_both_axes_without_power() {
    let _machine = beside_others();
    // Without a tip the bench waits before it enables the axes.
    let blind = ["tracker.tool=Another", "tracker.timeout_s=60"];
    let moments = [
        ("listening for another master", &blind[..], 0.0),
        ("looking for the drive", &blind, 0.0),
        ("checking its identity", &blind, 0.0),
        ("writing the configured objects", &blind, 0.0),
        ("mapping PDOs", &blind, 0.0),
        ("setting its limits", &blind, 0.0),
        ("configured, without power", &blind, 0.0),
        ("enabling both axes", &[], 0.0),
        ("enabling both axes", &[], 0.5),
        ("enabling both axes", &[], 3.0),
    ];
    for (number, (said, settings, depth_mm)) in moments.into_iter().enumerate() {
        let scratch = Scratch::new(&format!("udp-ctrl-c-{number}"));
        let stage = Stage::start(&[]);
        let mut witness = Witness::of(&stage);
        let settings = [&[SLOW], settings].concat();
        let mut bench = scratch.bench(&[], &stage.settings(&settings));
        bench.wait_for(said);
        witness.wait_until_inserted(depth_mm);
        bench.signal("INT");
        let bench = bench.end();
        bench.assert_status(1);
        assert_eq!(bench.last_line(), "stopped: operator: interrupted", "{said} {depth_mm}");
        let stands_at_mm = stage.assert_it_stands();
        println!("{said}, {depth_mm} mm: stands at {stands_at_mm:.3} mm");
        // A busy machine takes half a second at that speed.
        assert!(stands_at_mm < depth_mm + 1.25, "{said}, {depth_mm} mm: {stands_at_mm} mm");
        let was_enabled = settings.len() == 1;
        assert!(was_enabled || stands_at_mm.abs() < 0.001, "{said}: {stands_at_mm} mm");
        assert_eq!(bench.stderr.contains("enabling both axes"), was_enabled, "{}", bench.stderr);
        let manifest = programs::manifest(&scratch.run_dir());
        assert_eq!(manifest["stop_reason"], "operator: interrupted");
    }
}
