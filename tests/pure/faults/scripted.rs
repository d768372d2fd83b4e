//! Faults of the stage, scripted in TOML, through the command line: virtual time, 1 mm/s and 10 ms SYNC. Each fault
//! occurs at two phases of the SYNC period, and the row has the worse of the two.

use crate::support::bench::PAPER;
use crate::support::program::{Said, Scratch, needle_bench};
use crate::support::stop::Measured;
use serde_json::Value;

/// The depths at which a fault occurs. The needle moves 0.01 mm in a SYNC period.
const DEPTHS_MM: [f64; 2] = [4.001, 4.006];

/// A run of 6 mm. It also has the paper's observer and law, as the other tests of faults do.
const SETTINGS: [&str; 2] =
    ["insertion={ depth_mm = 6, plane_out_of_reach = \"insert\" }", "insertion.speed_mm_per_s=1"];

/// A run and its record.
struct Run {
    said: Said,
    json: Value,
    /// The frames in can.log: identifier and data.
    frames: Vec<(String, String)>,
    /// The events that the operator saw.
    events: String,
}

/// A run of 6 mm with `faults` at `at_mm`, each an inline table of TOML without braces.
fn run(faults: &[&str], at_mm: f64, sets: &[&str]) -> Run {
    let scratch = Scratch::new();
    let tables = faults.iter().map(|fault| {
        format!("[[emulator.fault]]\nat_mm = {at_mm}\n{}\n", fault.replace(", ", "\n"))
    });
    let file = scratch.write("faults.toml", &tables.collect::<String>());
    let mut arguments = vec!["run", "--json", file.to_str().expect("UTF-8")];
    for set in PAPER.iter().chain(&SETTINGS).chain(sets) {
        arguments.extend(["--set", set]);
    }
    let said = needle_bench(&scratch, &arguments);
    let json = said.json();
    let run_dir = scratch.path().join(json["run_dir"].as_str().unwrap_or_else(|| panic!("{json}")));
    let read = |name: &str| std::fs::read_to_string(run_dir.join(name)).expect("recorded");
    let manifest: Value = serde_json::from_str(&read("manifest.json")).expect("JSON");
    assert_eq!(manifest["stop_reason"], json["stop_reason"], "{manifest}");
    let steps = read("steps.csv");
    assert_eq!(steps.lines().count() as u64, 1 + json["steps"].as_u64().expect("a number"));
    let frame = |line: &str| {
        let (id, data) = line.split(' ').nth(2)?.split_once('#')?;
        Some((id.to_owned(), data.to_owned()))
    };
    let frames = read("can.log").lines().map(|line| frame(line).expect("a frame")).collect();
    let events = said.stderr.clone();
    Run { said, json, frames, events }
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is not a number"))
}

/// Time, s, and true position, mm and rad, of a moment in the JSON of an emulated run.
fn moment(value: &Value) -> (f64, (f64, f64)) {
    let rotation_rad = number(&value["rotation_true_deg"]).to_radians();
    (number(&value["time_s"]), (number(&value["insertion_true_mm"]), rotation_rad))
}

/// Asserts what must hold of every run that a fault stopped.
fn is_stopped(run: &Run, reason: &str) {
    assert_eq!(run.said.status, 1, "{}", run.json);
    assert_eq!(run.json["stop_reason"], reason, "{}", run.events);
    for drive in run.json["emulated"]["drives"].as_array().expect("two") {
        assert_ne!(drive["state"], "operation enabled", "{}", run.json);
    }
    // After the first quick stop nothing is enabled, no target changes, and no node is started.
    let Some(stop) = run.frames.iter().position(|(id, data)| id == "201" && data.starts_with("02"))
    else {
        return;
    };
    for id in ["201", "202"] {
        let after: Vec<&str> = run.frames[stop..]
            .iter()
            .filter(|(other, _)| other == id)
            .map(|(_, data)| data.as_str())
            .collect();
        assert!(after.windows(2).all(|pair| pair[0][4..] == pair[1][4..]), "a new target");
        assert!(!after.iter().any(|data| data.starts_with("0F")), "enabled after the stop");
    }
    let started = |(id, data): &(String, String)| id == "000" && data.starts_with("01");
    assert!(!run.frames[stop..].iter().any(started), "a node was started after the stop");
}

fn travel(from: (f64, f64), to: (f64, f64)) -> (f64, f64) {
    ((to.0 - from.0).abs(), (to.1 - from.1).abs())
}

fn worst(measured: impl Iterator<Item = Measured>) -> Measured {
    let none = Measured { detected_ms: 0.0, before: (0.0, 0.0), after: (0.0, 0.0) };
    let most = |a: (f64, f64), b: (f64, f64)| (a.0.max(b.0), a.1.max(b.1));
    measured.fold(none, |a, b| Measured {
        detected_ms: a.detected_ms.max(b.detected_ms),
        before: most(a.before, b.before),
        after: most(a.after, b.after),
    })
}

/// From the first fault to its detection, and from there to standstill.
fn measured(run: &Run) -> Measured {
    let emulated = &run.json["emulated"];
    let (struck_s, struck_at) = moment(&emulated["faults"][0]["struck"]);
    let (detected_s, detected_at) = moment(&emulated["stopping"]);
    let (_, end) = moment(&emulated["end"]);
    Measured {
        detected_ms: (detected_s - struck_s) * 1e3,
        before: travel(struck_at, detected_at),
        after: travel(detected_at, end),
    }
}

/// Asserts that runs with `faults` and `sets` stop for `reason` within `within_ms`, and that the row of
/// `docs/hazards.md` has the measured numbers.
fn hazard(test: &str, faults: &[&str], sets: &[&str], within_ms: f64, reason: &str) -> Vec<Run> {
    let runs: Vec<Run> = DEPTHS_MM.iter().map(|at_mm| run(faults, *at_mm, sets)).collect();
    let measured = worst(runs.iter().map(|run| {
        is_stopped(run, reason);
        measured(run)
    }));
    measured.is_documented(test, within_ms, reason);
    runs
}

/// No frame of the bench reaches the drives any more, as after kill -9.
#[test]
fn a_killed_bench() {
    let silent = r#"kind = "drop", toward = "drives""#;
    let reason =
        "stage: insertion: no TPDO1 for 2 SYNCs in a row, check bus load, cable and the drive";
    let measured = worst(DEPTHS_MM.iter().map(|at_mm| {
        let run = run(&[silent], *at_mm, &[]);
        is_stopped(&run, reason);
        let emulated = &run.json["emulated"];
        let (struck_s, struck_at) = moment(&emulated["faults"][0]["struck"]);
        let (_, end) = moment(&emulated["end"]);
        let drives = emulated["drives"].as_array().expect("two");
        worst(drives.iter().map(|drive| {
            let (stopped_s, stopped_at) = moment(&drive["left_operation"]);
            Measured {
                detected_ms: (stopped_s - struck_s) * 1e3,
                before: travel(struck_at, stopped_at),
                after: travel(stopped_at, end),
            }
        }))
    }));
    assert!(measured.before.0 + measured.after.0 < 0.1, "{measured:?}");
    measured.is_documented("a_killed_bench", 100.0, "none: the drives stop by themselves");
}

/// SYNC and set-points still reach the drives.
#[test]
fn a_heartbeat_of_the_bench_that_is_lost() {
    let lost = r#"kind = "drop", frames = "heartbeat", toward = "drives""#;
    let reason = "stage: insertion: emergency 0x8130 heartbeat or life guard lost (register 0x11, \
                  manufacturer bytes [7F, 00, 00, 00, 00]): the drive missed the bench's heartbeat; \
                  is the bench stalled or unplugged?";
    hazard("a_heartbeat_of_the_bench_that_is_lost", &[lost], &[], 100.0, reason);
}

#[test]
fn position_messages_of_one_drive_missing() {
    let reason =
        "stage: rotation: no TPDO1 for 2 SYNCs in a row, check bus load, cable and the drive";
    let missing = r#"kind = "drop", frames = "pdo", axis = "rotation""#;
    hazard("position_messages_of_one_drive_missing", &[missing], &[], 30.0, reason);
}

#[test]
fn position_messages_of_both_drives_missing() {
    let reason =
        "stage: insertion: no TPDO1 for 2 SYNCs in a row, check bus load, cable and the drive";
    let missing = r#"kind = "drop", frames = "pdo""#;
    hazard("position_messages_of_both_drives_missing", &[missing], &[], 30.0, reason);
}

#[test]
fn a_node_off_the_bus() {
    let reason =
        "stage: insertion: no TPDO1 for 2 SYNCs in a row, check bus load, cable and the drive";
    let silent = r#"kind = "silent", axis = "insertion""#;
    hazard("a_node_off_the_bus", &[silent], &[], 30.0, reason);
}

#[test]
fn a_controller_that_goes_bus_off() {
    hazard("a_controller_that_goes_bus_off", &[r#"kind = "bus-off""#], &[], 0.0, "can: bus off");
}

/// After 50 ms. No queued frame is sent, and nothing moves again.
#[test]
fn a_bus_that_comes_back() {
    let fault = r#"kind = "bus-off", duration_s = 0.05"#;
    hazard("a_bus_that_comes_back", &[fault], &[], 0.0, "can: bus off");
}

/// The cable is out for 50 ms, and the interface still takes frames: those of two cycles at most wait, and leave in a
/// burst when the cable is back. The phase of the heartbeat decides which of two reasons comes first.
#[test]
fn a_bus_that_holds_frames() {
    let missing = "stage: insertion: no TPDO1 for 2 SYNCs in a row";
    let waiting = "can: memory: 4 frames not confirmed on the bus within 2 SYNCs";
    let held = |at_mm: f64, duration_s: f64| {
        let fault = format!(r#"kind = "bus-stuck", duration_s = {duration_s}"#);
        let run = run(&[&fault], at_mm, &[]);
        let reason = run.json["stop_reason"].as_str().expect("stopped").to_owned();
        assert!([missing, waiting].iter().any(|known| reason.starts_with(known)), "{reason}");
        is_stopped(&run, &reason);
        measured(&run)
    };
    let worst = worst(DEPTHS_MM.iter().map(|at_mm| held(*at_mm, 0.05)));
    worst.is_documented("a_bus_that_holds_frames", 30.0, &format!("{missing}, or {waiting}"));
    // Out for longer than the drives' heartbeat timeout: when the frames arrive, the drives stand and stay so.
    let Measured { before, after, .. } = held(DEPTHS_MM[0], 0.3);
    assert!(before.0 + after.0 < 0.03, "{before:?} {after:?}");
}

/// The drives get the stop by SDO. The set-points for the next SYNC have reached them, and RPDO1 with the stop comes
/// late. The emergency message is another node's, so the drives stop only as the bench says.
#[test]
fn set_points_held_back_as_a_stop_begins() {
    let test = "set_points_held_back_as_a_stop_begins";
    let late = r#"kind = "delay", frames = "pdo", toward = "drives", delay_ms = 95"#;
    let emergency = r#"kind = "foreign", frame = "082#1042090000000000""#;
    let reason = "stage: rotation: emergency 0x4210 device over-temperature (register 0x09)";
    for run in hazard(test, &[late, emergency], &[], 0.0, reason) {
        let (stopping_s, _) = moment(&run.json["emulated"]["stopping"]);
        for drive in run.json["emulated"]["drives"].as_array().expect("two") {
            let (left_s, _) = moment(&drive["left_operation"]);
            assert!(left_s - stopping_s < 0.03, "for good: {}", run.json);
        }
    }
}

/// If the configuration tolerates missing TPDOs for longer.
#[test]
fn unconfirmed_frames_stop_the_run() {
    let fault = r#"kind = "bus-stuck", duration_s = 0.05"#;
    for at_mm in DEPTHS_MM {
        let run = run(&[fault], at_mm, &["can.missed_feedback_max=20"]);
        let reason = run.json["stop_reason"].as_str().expect("stopped").to_owned();
        is_stopped(&run, &reason);
        let count = reason.strip_prefix("can: memory: ").and_then(|text| text.split(' ').next());
        let count: usize = count.and_then(|count| count.parse().ok()).expect("a number of frames");
        assert!(
            (4..=6).contains(&count),
            "two SYNCs, two set-points, a heartbeat or two: {reason}"
        );
        assert!(reason.contains("frames not confirmed on the bus within 2 SYNCs"), "{reason}");
        let (struck_s, struck_at) = moment(&run.json["emulated"]["faults"][0]["struck"]);
        let (detected_s, _) = moment(&run.json["emulated"]["stopping"]);
        let (_, end) = moment(&run.json["emulated"]["end"]);
        assert!(detected_s - struck_s <= 0.0301, "{}", run.json);
        assert!(travel(struck_at, end).0 < 0.06, "{}", run.json);
    }
}

#[test]
fn an_interface_that_goes_down() {
    let reason =
        "can: interface memory is down: it is emulated, an [[emulator.fault]] took it down";
    hazard("an_interface_that_goes_down", &[r#"kind = "bus-down""#], &[], 10.0, reason);
}

#[test]
fn a_transmit_queue_that_is_full() {
    let fault = r#"kind = "bus-full", duration_s = 0.05"#;
    for at_mm in DEPTHS_MM {
        let run = run(&[fault], at_mm, &[]);
        // The set-points were sent ahead, so SYNC is the first frame that is refused.
        let reason = run.json["stop_reason"].as_str().expect("stopped").to_owned();
        is_stopped(&run, &reason);
        assert!(
            reason.starts_with("can: memory takes no more frames, 080# was not sent"),
            "{reason}"
        );
        let (struck_s, _) = moment(&run.json["emulated"]["faults"][0]["struck"]);
        let (detected_s, _) = moment(&run.json["emulated"]["stopping"]);
        assert!(detected_s - struck_s <= 0.0101, "{}", run.json);
    }
}

#[test]
fn an_emergency_from_a_drive() {
    let reason = "stage: rotation: emergency 0x4210 device over-temperature (register 0x09)";
    let fault = r#"kind = "drive-fault", code = 0x4210, axis = "rotation""#;
    hazard("an_emergency_from_a_drive", &[fault], &[], 0.0, reason);
}

/// The emergency message is lost, and the statusword shows the fault.
#[test]
fn a_drive_fault_without_a_message() {
    let lost = r#"kind = "drop", frames = "emergency""#;
    let fault = r#"kind = "drive-fault", code = 0x4210, axis = "insertion""#;
    let reason = "stage: insertion: drive in fault (statusword 0x021F fault reaction active)";
    hazard("a_drive_fault_without_a_message", &[lost, fault], &[], 10.0, reason);
}

#[test]
fn a_following_error() {
    let reason = "stage: insertion: emergency 0x8611 following error (register 0x21)";
    let fault = r#"kind = "drive-fault", code = 0x8611, axis = "insertion""#;
    hazard("a_following_error", &[fault], &[], 0.0, reason);
}

/// The drive's own window, 0x6065, is the travel of 30 ms at the highest speed: 0.3 mm.
#[test]
fn a_blocked_axis() {
    let fault = r#"kind = "stall", axis = "insertion""#;
    let reason = "stage: insertion: emergency 0x8611 following error (register 0x21)";
    hazard("a_blocked_axis", &[fault], &[], 310.0, reason);
}

#[test]
fn a_limit_switch() {
    let fault = r#"kind = "positive-switch", axis = "insertion""#;
    let reason = "stage: insertion: drive left operation enabled (statusword 0x0A17 quick stop \
                  active), was an enable or limit switch opened?";
    hazard("a_limit_switch", &[fault], &[], 10.0, reason);
}

/// This drive goes into Fault at its switch, which has a place on the axis.
#[test]
fn a_limit_switch_of_an_epos4() {
    let reason = "stage: insertion: emergency 0xFF07 manufacturer specific (register 0x01)";
    let sets = ["emulator.drives=\"epos4\"", "emulator.insertion_switches_mm={positive=4.5}"];
    let run = run(&[], 0.0, &sets);
    is_stopped(&run, reason);
    let (_, (insertion_mm, _)) = moment(&run.json["emulated"]["stopping"]);
    assert!((insertion_mm - 4.5).abs() < 0.001, "{}", run.json);
    let (_, end) = moment(&run.json["emulated"]["end"]);
    assert!(end.0 - 4.5 < 0.1, "{}", run.json);
}

#[test]
fn an_emergency_stop_button() {
    let reason = "stage: insertion: emergency 0x9000 external error (register 0x01)";
    hazard("an_emergency_stop_button", &[r#"kind = "emergency-stop""#], &[], 0.0, reason);
}

#[test]
fn a_node_that_boots_in_mid_run() {
    let reason =
        "stage: rotation: boot-up message in mid-run, the drive restarted; is its supply stable?";
    let fault = r#"kind = "restart", axis = "rotation""#;
    hazard("a_node_that_boots_in_mid_run", &[fault], &[], 0.0, reason);
}

/// It is pressed before power. Its release must not move the axes, whether faults are reset at the start or not.
#[test]
fn an_emergency_stop_let_go_while_the_axes_are_enabled() {
    for at_s in [0.02, 0.105, 0.115, 0.125, 0.135, 0.145] {
        for reset in ["false", "true"] {
            let scratch = Scratch::new();
            let fault = format!(
                "emulator.fault=[{{ at_s = {at_s}, kind = \"emergency-stop\", duration_s = 1.5 }}]"
            );
            let reset = format!("stage.fault_reset_on_start={reset}");
            let run = needle_bench(&scratch, &["run", "--json", "--set", &fault, "--set", &reset]);
            assert_eq!(run.status, 1, "at {at_s} s, {reset}: {}", run.stderr);
            let emulated = &run.json()["emulated"];
            let (time_s, end) = moment(&emulated["end"]);
            assert!(time_s < 1.5, "at {at_s} s, {reset}: ended at {time_s} s");
            assert_eq!(end, (0.0, 0.0), "at {at_s} s, {reset}");
        }
    }
}

/// Asserts that a run with `fault` completes, and that the operator sees `report`.
fn is_harmless(fault: &str, report: &str) {
    let run = run(&[fault], DEPTHS_MM[0], &[]);
    assert_eq!(run.said.status, 0, "{}", run.json);
    let (_, (insertion_mm, _)) = moment(&run.json["emulated"]["end"]);
    assert!((insertion_mm - 6.0).abs() < 1e-3, "{}", run.json);
    assert!(run.events.contains(report), "no {report:?} in\n{}", run.events);
}

/// The drives follow it, so the run ends at the first frame.
#[test]
fn another_master_s_set_point() {
    let fault = r#"kind = "foreign", frame = "201#0F0000250000""#;
    let reason = "stage: another master on the bus: RPDO1 of a drive (201#0F0000250000); stop it, or \
                  give it other nodes: two masters cannot share an axis";
    hazard("another_master_s_set_point", &[fault], &[], 0.0, reason);
}

/// A quick stop by SDO alone would be lost: in NMT Stopped a node takes none.
#[test]
fn nodes_that_another_master_sends_to_nmt_stopped() {
    let fault = r#"kind = "foreign", frame = "000#0200""#;
    let reason = "stage: another master on the bus: an NMT command (000#0200); stop it, or give it \
                  other nodes: two masters cannot share an axis";
    hazard("nodes_that_another_master_sends_to_nmt_stopped", &[fault], &[], 0.0, reason);
}

#[test]
fn supervision_switched_off_by_another() {
    let fault = r#"kind = "foreign", frame = "601#2316100100000000""#;
    let reason = "stage: another master on the bus: a write to a drive's object dictionary \
                  (601#2316100100000000); stop it, or give it other nodes: two masters cannot share \
                  an axis";
    hazard("supervision_switched_off_by_another", &[fault], &[], 0.0, reason);
}

/// The position is plausible: only the second TPDO1 after a SYNC shows the other node.
#[test]
fn another_node_that_sends_a_drive_s_position() {
    let fault = r#"kind = "foreign", frame = "181#371298480000", period_ms = 1"#;
    let run = run(&[fault], DEPTHS_MM[0], &[]);
    let reason = run.json["stop_reason"].as_str().expect("stopped");
    assert!(reason.starts_with("stage: insertion: two TPDO1 that differ"), "{reason}");
    is_stopped(&run, reason);
    let (struck_s, _) = moment(&run.json["emulated"]["faults"][0]["struck"]);
    let (detected_s, _) = moment(&run.json["emulated"]["stopping"]);
    assert!(detected_s - struck_s <= 0.030, "{} s", detected_s - struck_s);
}

/// Under identifiers of the insertion drive, of the bench and of another node.
#[test]
fn a_foreign_node_on_our_identifiers() {
    let foreign = |frame: &str| format!(r#"kind = "foreign", frame = "{frame}""#);
    let unasked = "position without a SYNC, or answer without a question, 1 so far";
    is_harmless(&foreign("181#370200000000"), unasked);
    is_harmless(&foreign("581#4B41600037020000"), unasked);
    let own = "frame under an identifier of the bench's own, is there another master?, 1 so far";
    is_harmless(&foreign("601#4041600000000000"), own);
    is_harmless(&foreign("000#0100"), own);
    is_harmless(&foreign("185#370200000000"), "frame from elsewhere, 1 so far");
}

#[test]
fn frames_of_the_wrong_length() {
    let foreign = r#"kind = "foreign", frame = "181#3702", period_ms = 20"#;
    is_harmless(foreign, "frame of the wrong length, 1 so far");
    // The drive's own TPDO1 lacks its position once.
    let short = r#"kind = "resize", length = 5, frames = "pdo", axis = "rotation", count = 1"#;
    is_harmless(short, "frame of the wrong length, 1 so far");
}

#[test]
fn a_flood_of_foreign_frames_is_reported_and_tolerated() {
    let flood = r#"kind = "foreign", frame = "333#0011223344556677", period_ms = 0.25"#;
    is_harmless(flood, "a flood on the bus: ");
    // Under identifiers of a drive.
    for frame in ["581#4B41600037020000", "701#05", "081#0000000000000000"] {
        let flood = format!(r#"kind = "foreign", frame = "{frame}", period_ms = 0.25"#);
        is_harmless(&flood, "a flood on the bus: ");
    }
}

#[test]
fn duplicated_late_and_reordered_frames_are_tolerated() {
    for fault in [
        r#"kind = "duplicate", count = 50"#,
        r#"kind = "delay", delay_ms = 4, count = 50"#,
        r#"kind = "reorder", frames = "pdo", count = 1"#,
        r#"kind = "drop", frames = "pdo", count = 1"#,
        r#"kind = "corrupt", byte = 2, frames = "pdo", axis = "rotation", count = 1"#,
    ] {
        is_harmless(fault, "emulated fault: ");
    }
}

/// A delay under the SDO timeout is tolerated, and one over it is not.
#[test]
fn a_slow_sdo_server() {
    let scratch = Scratch::new();
    let slow = |ms: u32| {
        let fault = format!(
            "emulator.fault=[{{ at_s = 0, kind = \"delay\", frames = \"sdo\", delay_ms = {ms} }}]"
        );
        let short = "insertion={ depth_mm = 3, plane_out_of_reach = \"insert\" }";
        needle_bench(&scratch, &["run", "--json", "--set", &fault, "--set", short])
    };
    assert_eq!(slow(100).status, 0);
    let refused = slow(600);
    assert_eq!(refused.status, 1);
    let reason = refused.json()["stop_reason"].as_str().expect("stopped").to_owned();
    assert!(reason.contains("within 150 ms"), "{reason}");
}
