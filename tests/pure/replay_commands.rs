//! The command `needle-bench replay`: runs, operations, what-if questions, refusals.

use super::replay::{operated, replayed, run};
use crate::support::program::{Said, Scratch, needle_bench};
use needle_bench::telemetry::{RunFolder, write_manifest};
use serde_json::Value;
use std::path::PathBuf;

#[track_caller]
fn assert_identical(said: &Said) {
    assert_eq!(
        (said.status, said.stdout.lines().last()),
        (0, Some("identical")),
        "{}",
        said.stderr
    );
}

#[test]
fn replay_repeats_a_run_answers_what_if_and_refuses_an_edited_one() {
    let scratch = Scratch::new();
    let run_dir = run(&scratch, "insertion.depth_mm = 5\ninsertion.speed_mm_per_s = 5");
    let said = replayed(&scratch, &run_dir, &[]);
    assert_identical(&said);

    let said = replayed(
        &scratch,
        &run_dir,
        &["--set", "observer.kind=\"coupled\"", "--out", "coupled.csv", "--json"],
    );
    assert_eq!(said.status, 0, "{}", said.stderr);
    let json = said.json();
    assert_eq!((&json["identical"], &json["difference"]), (&Value::Bool(true), &Value::Null));
    assert_eq!(
        (&json["recorded"]["observer"], &json["what_if"]["observer"]),
        (&"invariant".into(), &"coupled".into())
    );
    assert!(json["what_if"]["estimate_rms"]["roll_deg"].is_f64());
    let read = |path: PathBuf| std::fs::read_to_string(path).unwrap();
    let (recorded, coupled) =
        (read(run_dir.join("steps.csv")), read(scratch.path().join("coupled.csv")));
    let mut differing = std::collections::BTreeSet::new();
    let columns: Vec<&str> = recorded.lines().next().unwrap().split(',').collect();
    for (recorded, coupled) in recorded.lines().zip(coupled.lines()) {
        let values = recorded.split(',').zip(coupled.split(',')).zip(&columns);
        differing.extend(values.filter(|((a, b), _)| a != b).map(|(_, column)| *column));
    }
    assert!(differing.contains("roll_est_rad"), "{differing:?}");
    assert!(differing.iter().all(|c| c.contains("_est_") || c.contains("_sd_")), "{differing:?}");

    let refused = |set: &str| {
        let said = replayed(&scratch, &run_dir, &["--set", set]);
        assert_eq!(said.status, 2, "{set}");
        said.stderr
    };
    for set in
        ["control.kind=\"feedback-linearization\"", "needle.radius_mm=100", "tracker.latency_ms=3"]
    {
        assert!(refused(set).contains("takes observer.… alone"), "{set}");
    }
    assert!(refused("observer.shadows=[]").contains("name the observer by observer.kind"));
    assert!(refused("observer.samples=\"all\"").contains("needle-bench evaluate RUN"));
    assert!(refused("observer.knid=\"coupled\"").contains("unknown key"));

    // The run is shorter than the baseline; and a section is given whose observer is not chosen.
    let sets = [
        "--set",
        "observer.kind=\"finite-difference\"",
        "--set",
        "observer.finite_difference.baseline_mm=30",
    ];
    let said = replayed(
        &scratch,
        &run_dir,
        &[&sets[..], &["--set", "observer.coupled.memory_mm=5"]].concat(),
    );
    assert_identical(&said);
    let row = "\nwhat if     finite-difference: no estimate\n";
    assert!(said.stdout.contains(row), "{}", said.stdout);
    let warning = "warning: --set observer.coupled.memory_mm has no effect";
    assert!(said.stderr.contains(warning), "{}", said.stderr);
    let said = replayed(&scratch, &run_dir, &["--out", "coupled.csv"]);
    assert_eq!(said.status, 2, "{}", said.stderr);
    assert!(said.stderr.contains("coupled.csv: "), "{}", said.stderr);

    let (steps, edited) = (run_dir.join("steps.csv"), recorded.replace(",0.0,", ",0.5,"));
    std::fs::write(&steps, edited).unwrap();
    let said = replayed(&scratch, &run_dir, &[]);
    assert_eq!(said.status, 2);
    assert!(said.stderr.contains("steps.csv was edited"), "{}", said.stderr);
    std::fs::write(&steps, &recorded).unwrap();

    // A killed bench leaves the manifest open.
    let mut manifest = RunFolder::open(&run_dir).unwrap().manifest;
    manifest.outcome = None;
    manifest.version = "0.0.9".to_owned();
    manifest.files.clear();
    write_manifest(&run_dir, &manifest).unwrap();
    let said = replayed(&scratch, &run_dir, &[]);
    assert_identical(&said);
    assert!(
        said.stdout.contains("\ncut         the record ends before its run did"),
        "{}",
        said.stdout
    );
    assert!(said.stdout.contains("\nbench       recorded by 0.0.9 ("), "{}", said.stdout);
    let json = replayed(&scratch, &run_dir, &["--json"]).json();
    assert_eq!(json["recorded_by"]["version"], "0.0.9");
    assert_eq!(json["replayed_by"]["version"], env!("CARGO_PKG_VERSION"));
    assert_eq!(json["cut"]["rows_beyond"], 0);
    std::fs::write(run_dir.join("config.toml"), "").unwrap();
    let said = replayed(&scratch, &run_dir, &[]);
    assert_eq!(said.status, 2);
    assert!(said.stderr.contains("config.toml was edited"), "{}", said.stderr);
}

/// Another version of the bench may have recorded it, so it need not replay.
#[test]
fn a_run_is_evaluated_from_its_frames_and_samples_alone() {
    let scratch = Scratch::new();
    let run_dir = run(&scratch, "insertion.depth_mm = 30\ninsertion.speed_mm_per_s = 5");
    let evaluated = || {
        let said =
            needle_bench(&scratch, &["evaluate", run_dir.to_str().expect("UTF-8"), "--json"]);
        (said.status, said.stdout, said.stderr)
    };
    let (status, stdout, stderr) = evaluated();
    assert_eq!(status, 0, "{stderr}");
    let mut manifest = RunFolder::open(&run_dir).unwrap().manifest;
    // A record that was left open has no seals.
    manifest.outcome = None;
    manifest.files.clear();
    for name in ["inputs.log", "steps.csv"] {
        std::fs::remove_file(run_dir.join(name)).unwrap();
    }
    write_manifest(&run_dir, &manifest).unwrap();
    assert_eq!(evaluated(), (0, stdout, stderr));
    manifest.dropped.get_or_insert_default().text_files = 3;
    write_manifest(&run_dir, &manifest).unwrap();
    let (status, _, stderr) = evaluated();
    assert_eq!(status, 2);
    assert!(stderr.contains("3 records were dropped"), "{stderr}");
}

#[test]
fn a_folder_that_is_not_a_run_is_refused() {
    let scratch = Scratch::new();
    let said = replayed(&scratch, scratch.path(), &["--json"]);
    assert_eq!(said.status, 2);
    assert!(said.json()["error"].as_str().unwrap().contains("not a run folder"), "{}", said.stdout);
}

/// Completed ones, a refused one, and one that a fault stops.
#[test]
fn every_operation_replays() {
    let scratch = Scratch::new();
    let deep = ["--set", "emulator.insertion_start_mm=30"];
    let faulty = [
        "--set",
        "emulator.fault=[{kind=\"drive-fault\", axis=\"rotation\", at_mm=1.0, code=0x8611}]",
    ];
    for operation in [
        &["home"][..],
        &["home", "--axis", "insertion"],
        &["jog", "--axis", "insertion", "--by", "2mm"],
        &["jog", "--axis", "insertion", "--by", "311mm"],
        &[&["jog", "--axis", "insertion", "--by", "3mm"][..], &faulty].concat(),
        &[&["withdraw"][..], &deep].concat(),
        &[&["withdraw", "--by", "0.1mm"][..], &deep].concat(),
        &["prove", "--handedness", "--set", "stage.rotation.jog_speed_deg_per_s=60"],
    ] {
        let run_dir = operated(&scratch, operation);
        let said = replayed(&scratch, &run_dir, &["--json"]);
        let json = said.json();
        assert_eq!(json["identical"], true, "{operation:?}: {json} {}", said.stderr);
        assert_ne!(json["frames_sent"], 0, "{operation:?}");
        let manifest = RunFolder::open(&run_dir).unwrap().manifest;
        assert_eq!(manifest.operation.unwrap().split('-').next(), Some(operation[0]));
        assert_ne!(json["samples"], 0, "{operation:?} recorded no sample of the tracker: {json}");
    }
}

#[test]
fn a_replay_reports_a_changed_operation() {
    let scratch = Scratch::new();
    let run_dir = operated(&scratch, &["jog", "--axis", "insertion", "--by", "2mm"]);
    let rewrite = |arguments: &[&str]| {
        let mut manifest = RunFolder::open(&run_dir).unwrap().manifest;
        manifest.arguments = arguments.iter().map(|word| (*word).to_owned()).collect();
        write_manifest(&run_dir, &manifest).unwrap();
    };
    rewrite(&["--axis", "insertion", "--by", "2.1mm"]);
    let said = replayed(&scratch, &run_dir, &[]);
    assert_eq!(said.status, 1, "{}", said.stdout);
    let last = said.stdout.lines().last().unwrap();
    assert!(last.starts_with("differs: can.log line "), "{last}");
    rewrite(&[]);
    let said = replayed(&scratch, &run_dir, &[]);
    assert_eq!(said.status, 2);
    assert!(said.stderr.contains("does not say what `stage jog` was to do"), "{}", said.stderr);
    rewrite(&["--axis", "insertion", "--by", "2mm"]);
    let said = replayed(&scratch, &run_dir, &["--set", "observer.kind=\"coupled\""]);
    assert_eq!(said.status, 2);
    assert!(said.stderr.contains("has no observer to ask about"), "{}", said.stderr);
}
