//! A recorded stream in place of the emulated tracker: the tracker stalls while the robot goes on, and its last
//! position is sent with new stamps for 59 s.

use crate::support::needed::data;
use crate::support::program::{Scratch, needle_bench};
use serde_json::Value;

/// The recording has two positions a second of another needle, pushed by hand in steps of 5 mm. So the gate
/// against the model is off, and the tip may move fast.
const SETTINGS: [&str; 12] = [
    "tracker.source=csv",
    "tracker.csv.time={s=\"Timestamp sec\",ns=\"Timestamp nanosec\"}",
    "tracker.csv.stamp={s=\"Timestamp sec\",ns=\"Timestamp nanosec\"}",
    "tracker.csv.position=[\"Tip x\",\"Tip y\",\"Tip z\"]",
    "tracker.registration={x_mm=0,y_mm=0,z_mm=0,yaw_deg=0,pitch_deg=0,roll_deg=0}",
    "tracker.stamp=source",
    "tracker.hold_after_s=1.5",
    "tracker.gates.innovation_chi2=1e9",
    "tracker.gates.stream=false",
    "tracker.gates.tip_speed_max_mm_per_s=20",
    "insertion.speed_mm_per_s=0.8",
    "observer.kind=finite-difference",
];

/// Depth at `time_s`, interpolated between the steps.
fn depth_mm(steps_csv: &str, time_s: f64) -> f64 {
    let row = |line: &str| {
        let mut cells = line.split(',').map(|cell| cell.parse::<f64>().ok());
        Some((cells.nth(1)??, cells.next()??))
    };
    let rows: Vec<(f64, f64)> = steps_csv.lines().skip(1).filter_map(row).collect();
    // A position after the last step is extrapolated.
    let after = rows.partition_point(|(at, _)| *at <= time_s).clamp(1, rows.len() - 1);
    let ((t0, d0), (t1, d1)) = (rows[after - 1], rows[after]);
    d0 + (d1 - d0) * (time_s - t0) / (t1 - t0)
}

#[test]
fn a_recorded_stall_of_the_tracker_holds_the_needle_within_1_mm() {
    let Some(file) = data("tracker-recordings/phantomA_closedloop_03.csv") else { return };
    let scratch = Scratch::new();
    let file = format!("tracker.file={:?}", file.display().to_string());
    let sets = SETTINGS.into_iter().chain([file.as_str()]).flat_map(|set| ["--set", set]);
    let arguments: Vec<&str> = ["run", "--json"].into_iter().chain(sets).collect();
    let said = needle_bench(&scratch, &arguments);
    assert_eq!(said.status, 1, "{}{}", said.stdout, said.stderr);
    assert!(said.stderr.contains("; insertion held; "), "{}", said.stderr);
    let json = said.json();
    let reason = json["stop_reason"].as_str().expect("a reason");
    assert!(reason.starts_with("tracker: last tip 1."), "{reason}");
    assert!(reason.contains("; held and stopped; "), "{reason}");
    assert!(reason.ends_with(" in a row; is the tool still in view?"), "{reason}");

    let dir = scratch.path().join(json["run_dir"].as_str().expect("a run folder"));
    let read = |file: &str| std::fs::read_to_string(dir.join(file)).expect("a text");
    let samples: Vec<Value> = read("tracker.ndjson")
        .lines()
        .map(|line| serde_json::from_str(line).expect("an object"))
        .collect();
    assert_eq!(samples[0]["refused"].as_str().map(|text| &text[..5]), Some("zero:"));
    let manifest: Value = serde_json::from_str(&read("manifest.json")).expect("an object");
    let refused = samples.iter().filter(|sample| !sample["refused"].is_null()).count();
    let by_gate = manifest["gates"]["refused"].as_object().expect("counts");
    assert_eq!(by_gate.values().filter_map(Value::as_u64).sum::<u64>(), refused as u64);
    assert_eq!(manifest["gates"], json["tracker_samples"]);
    let seen =
        samples.iter().rfind(|sample| sample["refused"].is_null()).expect("an accepted sample");
    let seen_s = seen["acquisition_time_ns"].as_f64().expect("a time") * 1e-9;
    assert!((31.0..32.5).contains(&seen_s), "the stall is at 31.5 s: {seen_s}");
    let seen_mm = depth_mm(&read("steps.csv"), seen_s);
    let blind_mm = json["insertion_mm"].as_f64().expect("a depth") - seen_mm;
    println!("{blind_mm:.2} mm inserted blind; {reason}");
    assert!((0.5..1.0).contains(&blind_mm), "{blind_mm} mm inserted blind");
}
