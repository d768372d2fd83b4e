//! The faults that stop a run stop `stage home`, `jog` and `withdraw` too. They are scripted in TOML.

use crate::support::program::{Scratch, needle_bench};
use serde_json::Value;

/// Faults without their depth, and the beginning of the reason for the stop.
const CAUSES: [(&str, &str); 7] = [
    (r#"kind = "emergency-stop""#, "stage: insertion: emergency 0x9000 external error"),
    (r#"kind = "silent", axis = "rotation""#, "stage: rotation: no TPDO1 for 2 SYNCs in a row"),
    (r#"kind = "bus-off""#, "can: bus off"),
    (r#"kind = "restart", axis = "rotation""#, "stage: rotation: boot-up message in mid-run"),
    (r#"kind = "stall", axis = "insertion""#, "stage: insertion: emergency 0x8611 following error"),
    (
        r#"kind = "drive-fault", code = 0x4210, axis = "rotation""#,
        "stage: rotation: emergency 0x4210 device over-temperature",
    ),
    (
        r#"kind = "drop", frames = "pdo", axis = "rotation""#,
        "stage: rotation: no TPDO1 for 2 SYNCs in a row",
    ),
];

/// Runs the operation `arguments` once for each cause, which acts at `at_mm` from the start of the operation.
fn every_cause_stops(arguments: &[&str], at_mm: f64, sets: &[&str]) {
    for (fault, reason) in CAUSES {
        let scratch = Scratch::new();
        let fault = format!("emulator.fault=[{{ at_mm = {at_mm}, {fault} }}]");
        let mut all = [&["stage", "--virtual"], arguments].concat();
        for set in sets.iter().chain([&fault.as_str()]) {
            all.extend(["--set", set]);
        }
        let said = needle_bench(&scratch, &[&all[..], &["-q"]].concat());
        assert_eq!(said.status, 1, "{fault}\n{}{}", said.stdout, said.stderr);
        let last = said.stdout.lines().last().expect("a last line");
        assert!(last.starts_with(&format!("stopped: {reason}")), "{fault}\n{last}");

        // The same again, with its figures.
        let json = needle_bench(&scratch, &[&all[..], &["--json", "-q"]].concat()).json();
        is_stopped(&scratch, &json, &last["stopped: ".len()..]);
    }
}

/// Both axes left Operation Enabled and stood, nothing was enabled or started after the stop, and the record is
/// closed with the reason.
fn is_stopped(scratch: &Scratch, json: &Value, reason: &str) {
    assert_eq!((&json["outcome"], &json["stop_reason"]), (&"stopped".into(), &reason.into()));
    let emulated = &json["emulated"];
    for drive in emulated["drives"].as_array().expect("two") {
        assert_ne!(drive["state"], "operation enabled", "{json}");
    }
    let depth = |moment: &Value| moment["insertion_true_mm"].as_f64().expect("a number");
    let struck = &emulated["faults"][0]["struck"];
    let travel = (depth(&emulated["end"]) - depth(struck)).abs();
    assert!(travel < 0.3, "{travel} mm after the fault: {json}");

    let dir = scratch.path().join(json["run_dir"].as_str().expect("recorded"));
    let read = |name: &str| std::fs::read_to_string(dir.join(name)).expect("recorded");
    let manifest: Value = serde_json::from_str(&read("manifest.json")).expect("closed");
    assert_eq!(
        (&manifest["outcome"], &manifest["stop_reason"]),
        (&"stopped".into(), &reason.into())
    );
    let log = read("can.log");
    let frames: Vec<&str> = log.lines().filter_map(|line| line.split(' ').nth(2)).collect();
    let stop = frames.iter().position(|frame| frame.starts_with("201#02")).unwrap_or(frames.len());
    let again = |frame: &&&str| {
        ["201#0F", "202#0F", "201#1F", "202#1F", "000#01"].iter().any(|id| frame.starts_with(id))
    };
    assert_eq!(frames[stop..].iter().find(again), None, "enabled or started after the stop");
}

#[test]
fn what_stops_a_run_stops_a_homing() {
    // The switch is 20 mm away.
    let sets = [
        "emulator.insertion_switches_mm={ negative = -20 }",
        "stage.insertion.homing={ method = 17, timeout_s = 60, homed_bit = 12, \
         speed_switch_mm_per_s = 2, speed_zero_mm_per_s = 0.5, acceleration_mm_per_s2 = 10 }",
    ];
    every_cause_stops(&["home"], -3.0, &sets);
}

#[test]
fn what_stops_a_run_stops_a_jog() {
    every_cause_stops(&["jog", "--axis", "insertion", "--by", "8mm"], 3.0, &[]);
}

#[test]
fn what_stops_a_run_stops_a_withdrawal() {
    every_cause_stops(&["withdraw"], -3.0, &["emulator.insertion_start_mm=20"]);
}
