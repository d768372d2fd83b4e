//! Recordings as the source of tip positions.

use crate::support::needed::data;
use crate::support::program::{Said, Scratch, needle_bench};
use std::path::{Path, PathBuf};

const RUN_30_MM: &str = "insertion={ depth_mm = 30, plane_out_of_reach = \"insert\" }";
const REGISTRATION: &str =
    "tracker.registration={x_mm=0,y_mm=0,z_mm=0,yaw_deg=0,pitch_deg=0,roll_deg=0}";

/// A run with the fastest observer, because these tests do not depend on the steering.
fn run(scratch: &Scratch, sets: &[&str]) -> Said {
    let mut arguments = vec!["run", "--json", "--set", "observer.kind=coupled"];
    sets.iter().for_each(|set| arguments.extend(["--set", set]));
    needle_bench(scratch, &arguments)
}

fn text(dir: &Path, file: &str) -> String {
    std::fs::read_to_string(dir.join(file)).expect("text")
}

/// The folder of a run of 30 mm.
fn recorded(scratch: &Scratch, sets: &[&str]) -> PathBuf {
    let said = run(scratch, &[&[RUN_30_MM], sets].concat());
    assert_eq!(said.status, 0, "{}", said.stderr);
    said.run_dir(scratch)
}

/// `steps.csv` as numbers; an empty field is NaN.
fn steps(dir: &Path) -> Vec<Vec<f64>> {
    let number = |field: &str| if field.is_empty() { f64::NAN } else { field.parse().unwrap() };
    text(dir, "steps.csv").lines().skip(1).map(|l| l.split(',').map(number).collect()).collect()
}

#[test]
fn recorded_samples_as_the_tracker_repeat_the_run() {
    let scratch = Scratch::new();
    let first = recorded(&scratch, &[]);
    let file = format!("tracker.file={}", first.join("tracker.ndjson").display());
    let sets = ["tracker.source=ndjson", &file, REGISTRATION];
    let second = recorded(&scratch, &sets);
    let text = text(&second, "steps.csv");
    let names: Vec<&str> = text.lines().next().unwrap().split(',').collect();
    let (first, second) = (steps(&first), steps(&second));
    assert_eq!(first.len(), 31);
    assert_eq!(first.len(), second.len());
    for (first, second) in first.iter().zip(&second) {
        for ((name, a), b) in names.iter().zip(first).zip(second) {
            // A recording does not say where the tip truly was.
            let is_true = name.contains("_true_");
            assert!(!is_true || b.is_nan(), "{name}: {b}");
            assert!(
                is_true || (a - b).abs() < 1e-9 || a.is_nan() && b.is_nan(),
                "{name}: {a}, {b}"
            );
        }
    }
}

/// The default mapping reads a run's own `steps.csv`.
#[test]
fn a_recording_that_ends_stops_the_run() {
    let scratch = Scratch::new();
    let first = recorded(&scratch, &["insertion.speed_mm_per_s=5"]);
    let file = format!("tracker.file={}", first.join("steps.csv").display());
    let said = run(
        &scratch,
        &[
            "insertion.speed_mm_per_s=5",
            "tracker.source=csv",
            &file,
            REGISTRATION,
            "tracker.hold_after_mm=10",
        ],
    );
    assert_eq!(said.status, 1, "{}", said.stderr);
    let reason = said.json()["stop_reason"].as_str().expect("a reason").to_owned();
    assert!(reason.starts_with("tracker: last tip 0.5"), "{reason}");
    assert!(reason.contains("; tracker: the recording ended after 31 samples: "), "{reason}");
    let samples = text(&said.run_dir(&scratch), "tracker.ndjson");
    assert_eq!(samples.lines().count(), 31, "samples of the emulated tracker are among them");
}

#[test]
fn a_malformed_line_is_reported_and_skipped() {
    let scratch = Scratch::new();
    let first = recorded(&scratch, &[]);
    let mut lines: Vec<String> =
        text(&first, "tracker.ndjson").lines().map(str::to_owned).collect();
    lines.insert(100, lines[100].replace("position_tracker_mm", "position_mm"));
    lines.insert(200, "{\"tool\":".to_owned());
    let file = scratch.write("damaged.ndjson", &lines.join("\n"));
    let file = format!("tracker.file={}", file.display());
    let said = run(&scratch, &[RUN_30_MM, "tracker.source=ndjson", &file, REGISTRATION]);
    assert_eq!(said.status, 0, "{}", said.stderr);
    for part in ["ndjson: line 101: unknown field `position_mm`", "ndjson: line 201: EOF"] {
        assert!(said.stderr.contains(part), "{}", said.stderr);
    }
    assert_eq!(steps(&said.run_dir(&scratch)).len(), 31);
}

#[test]
fn a_wrong_file_or_mapping_is_refused_with_the_reason() {
    let scratch = Scratch::new();
    scratch.write("tip.csv", "t,x,y,z\n0,1,2,3\n0.1,1,two,3\n");
    let time = "tracker.csv.time={s=\"t\"}";
    let position = "tracker.csv.position=[\"x\",\"y\",\"z\"]";
    let cases: [&[&str]; 6] = [
        &["tracker.source=csv", "tracker.file=tip.csv", REGISTRATION],
        &["tracker.source=csv", "tracker.file=tip.csv", time, position, REGISTRATION],
        &["tracker.source=ndjson", "tracker.file=tip.csv", REGISTRATION],
        &["tracker.source=csv", "tracker.file=absent.csv", REGISTRATION],
        &["tracker.source=csv", REGISTRATION],
        &["tracker.source=csv", "tracker.file=tip.csv"],
    ];
    let refused = |sets: &[&str]| {
        let said = run(&scratch, sets);
        assert_eq!(said.status, 2, "{sets:?}: {}", said.stderr);
        said.screen()
    };
    insta::assert_snapshot!(cases.map(refused).concat());
    assert!(!scratch.path().join("runs").exists(), "a run folder was left");
}

/// `check --connect` plays the recording at its own pace.
#[test]
fn check_listens_to_a_recording() {
    let scratch = Scratch::new();
    let sample = |ns: u32| {
        format!(
            r#"{{"tool":"NeedleToTracker","position_tracker_mm":[1,2,{ns}],"receive_time_ns":{ns}}}"#
        )
    };
    scratch.write("tip.ndjson", &[sample(0), sample(5)].join("\n"));
    let said = needle_bench(
        &scratch,
        &[
            "check",
            "--connect",
            "--json",
            "--listen",
            "0.5",
            "--set",
            "tracker.source=ndjson",
            "--set",
            "tracker.file=tip.ndjson",
            "--set",
            REGISTRATION,
        ],
    );
    assert_eq!(said.status, 0, "{}", said.stderr);
    assert_eq!(said.json()["tracker"]["accepted"], 2);
    assert_eq!(said.json()["tracker"]["last_position_bench_mm"][2], 5.0);
}

/// A real recording, unchanged: the sender's stamps are frozen, and columns of the robot in metres are among
/// those of the tip.
#[test]
fn a_recording_of_another_lab_is_read_by_its_column_names() {
    let Some(path) = data("tracker-recordings/phantomA_closedloop_03.csv") else { return };
    let scratch = Scratch::new();
    let file = format!("tracker.file={}", path.display());
    let said = run(
        &scratch,
        &[
            "tracker.source=csv",
            &file,
            "tracker.csv.time={ s = \"Timestamp sec\", ns = \"Timestamp nanosec\" }",
            "tracker.csv.stamp={ s = \"AuroraTip sec\", ns = \"AuroraTip nanosec\" }",
            "tracker.csv.position=[\"AuroraTip x\", \"AuroraTip y\", \"AuroraTip z\"]",
            "tracker.csv.quaternion_wxyz=[\"AuroraTip qw\", \"AuroraTip qx\", \"AuroraTip qy\", \"AuroraTip qz\"]",
            "tracker.registration={x_mm=-78,y_mm=-33,z_mm=263,yaw_deg=0,pitch_deg=0,roll_deg=0}",
            "tracker.hold_after_s=1.1",
            "insertion.speed_mm_per_s=0.5",
        ],
    );
    // The recorded needle does not follow the set-points, so the run stops.
    assert_eq!(said.status, 1, "{}", said.stderr);
    let samples = text(&said.run_dir(&scratch), "tracker.ndjson");
    let sample: serde_json::Value =
        serde_json::from_str(samples.lines().nth(1).expect("a second sample")).expect("JSON");
    // The second row has the first position, half a second after the first row.
    assert_eq!(sample["receive_time_ns"], 499_876_128);
    assert_eq!(sample["source_unix_ns"], 1_666_034_109_293_831_946i64);
    assert_eq!(sample["position_tracker_mm"][2], -262.991_180_419_921_9);
    assert!(sample["orientation_tracker_wxyz"][0].as_f64().expect("a number") > 0.999);
    let zero: serde_json::Value =
        serde_json::from_str(samples.lines().next().expect("a sample")).expect("JSON");
    assert!(zero["refused"].as_str().expect("refused").contains("not a rotation"), "{zero}");
}
