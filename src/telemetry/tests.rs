//! Whole runs through the recorder.

mod live;
mod recording;
pub(in crate::telemetry) mod synthetic;

use super::*;
use crate::archive::{Counts, EventLine, Manifest, StepRow, file, steps_csv_header};
use crate::canopen::NodeId;
use crate::session::{Outcome, Record};
use crate::stage::{AxisConfig, AxisLimits, CountsRatio};
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// A folder for one test, removed with it.
pub(crate) struct Scratch(pub(crate) PathBuf);

impl Scratch {
    pub(crate) fn new(test: &str) -> Self {
        let path = std::env::temp_dir().join(format!("needle-bench-{}-{test}", std::process::id()));
        fs::create_dir_all(&path).unwrap();
        Scratch(path)
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

pub(crate) const CONFIG_TOML: &str = "[insertion]\ndepth_mm = 150.0\n";

/// The manifest of a run before it starts.
pub(crate) fn manifest() -> Manifest {
    Manifest {
        version: "0.1.0".to_owned(),
        git: Some("abc1234".to_owned()),
        bus: "memory".to_owned(),
        tracker: "emulated".to_owned(),
        seed: Some(7),
        ..Manifest::new("virtual", "2023-11-14T22:13:20.000000Z".to_owned())
    }
}

pub(crate) fn scene() -> Scene {
    Scene {
        x_wp: Pose::identity(),
        insertion_mm: 150.0,
        curvature_per_mm: 1.0 / 122.0,
        goal: None,
        truth: true,
        shadows: vec!["finite-difference".to_owned()],
        rotation_max_rad_per_mm: 0.3,
        tip_meas_age_max_s: 0.1,
        stage: StageConfig::new(axis(1, 1000, 150.0), axis(2, 36_000, 100.0)),
    }
}

/// A recorder of a run in `parent`.
fn recorder(parent: &Path, backpressure: Backpressure) -> Recorder {
    Recorder::create(parent, manifest(), CONFIG_TOML.to_owned(), backpressure).unwrap()
}

/// An axis with limits −1 and `max`.
fn axis(node: u8, counts: u32, max: f64) -> AxisConfig {
    let limits = AxisLimits { min: -1.0, max, speed_max: 10.0, acceleration_max: None };
    AxisConfig::new(NodeId::new(node).unwrap(), CountsRatio::new(counts, 1).unwrap(), limits)
}

/// Records `entries` as one run in `parent`; returns its folder and the lines of its text files.
fn record(parent: &Path, entries: impl IntoIterator<Item = Entry>) -> (PathBuf, Counts) {
    let mut recorder = recorder(parent, Backpressure::Block);
    entries.into_iter().for_each(|entry| recorder.record(entry));
    assert!(recorder.news().is_none());
    let run_dir = recorder.run_dir.clone();
    (run_dir, recorder.finish(completed).unwrap().counts.unwrap())
}

/// The end of a run that reached its depth.
fn completed(manifest: &mut Manifest) {
    manifest.set_outcome(&Outcome::Completed);
    manifest.duration_s = Some(12.5);
}

/// Makes `run.rrd` of `entries` in `dir`, and returns its path.
fn recording_of(dir: &Path, entries: impl IntoIterator<Item = Entry>) -> PathBuf {
    let mut recording = Recording::create(dir, &manifest(), CONFIG_TOML, &scene()).unwrap();
    entries.into_iter().for_each(|entry| recording.take(entry).unwrap());
    recording.finish().unwrap();
    dir.join(file::RECORDING)
}

#[test]
fn a_run_leaves_every_file() {
    let scratch = Scratch::new("run");
    let entries = synthetic::run(30, 5);
    let (run_dir, counts) = record(&scratch.0, entries.clone());
    let dir = run_dir.as_path();
    let text = |name: &str| fs::read_to_string(dir.join(name)).unwrap();

    let names: BTreeSet<String> = fs::read_dir(dir)
        .unwrap()
        .map(|file| file.unwrap().file_name().into_string().unwrap())
        .collect();
    let expected = [
        file::CAN,
        file::CONFIG,
        file::EVENTS,
        file::INPUTS,
        file::MANIFEST,
        file::STEPS,
        file::TRACKER,
    ];
    assert_eq!(names, expected.map(str::to_owned).into());
    assert_eq!(text("config.toml"), CONFIG_TOML);

    let rows = entries.iter().filter_map(|entry| match &entry.record {
        Record::Step(step) => Some(StepRow::new(step, entry.truth.as_ref()).to_string()),
        _ => None,
    });
    let expected: Vec<String> = [steps_csv_header()].into_iter().chain(rows).collect();
    assert_eq!(text("steps.csv").lines().collect::<Vec<_>>(), expected);

    let count = |name: &str| text(name).lines().count() as u64;
    assert_eq!(count("can.log"), counts.can_frames);
    assert_eq!(text("can.log").lines().next(), Some("(1700000000.001000) memory 000#8200 T"));
    assert_eq!(count("tracker.ndjson"), counts.tracker_samples);
    for line in text("tracker.ndjson").lines() {
        serde_json::from_str::<serde_json::Value>(line).unwrap();
    }

    let manifest: serde_json::Value = serde_json::from_str(&text("manifest.json")).unwrap();
    assert_eq!(manifest["outcome"], "completed");
    assert_eq!(manifest["duration_s"], 12.5);
    assert_eq!(manifest["counts"]["steps"], 30);
    assert_eq!(manifest["dropped"]["text_files"], 0);
    assert_eq!(manifest["faults"], serde_json::json!([]));

    let events: Vec<Record> = entries
        .iter()
        .filter(|entry| matches!(entry.record, Record::State { .. } | Record::Event { .. }))
        .map(|entry| entry.record.clone())
        .collect();
    let expected: Vec<EventLine<'_>> = events.iter().filter_map(EventLine::of).collect();
    let log = text("events.log");
    assert!(!expected.is_empty());
    assert_eq!(log.lines().filter_map(EventLine::parse).collect::<Vec<_>>(), expected);

    // The seals cover every file and agree with it.
    let run = RunFolder::open(dir).unwrap();
    run.verify().unwrap();
    let sealed: BTreeSet<String> = run.manifest.files.keys().cloned().collect();
    assert_eq!(sealed.len() + 1, names.len(), "all but the manifest: {sealed:?}");
}

#[test]
fn a_run_folder_cannot_be_repaired_while_it_is_written() {
    let scratch = Scratch::new("locked");
    let recorder = recorder(&scratch.0, Backpressure::Block);
    let dir = recorder.run_dir.clone();
    let said = repair(&dir).unwrap_err().to_string();
    assert!(said.contains("a bench is still writing this record"), "{said}");

    // A kill leaves all files and releases the lock.
    let left = scratch.0.join("left");
    fs::create_dir(&left).unwrap();
    for file in fs::read_dir(&dir).unwrap().flatten() {
        fs::copy(file.path(), left.join(file.file_name())).unwrap();
    }
    let reason = repair(&left).unwrap().stop_reason;
    assert_eq!(reason, "the bench ended without closing its record; no step was taken");
    let run = RunFolder::open(&left).unwrap();
    run.verify().unwrap();
    assert_eq!(run.manifest.files.len(), 6);
}

#[test]
fn a_run_that_cannot_begin_leaves_no_folder() {
    let scratch = Scratch::new("discarded");
    let recorder = recorder(&scratch.0, Backpressure::DropAndCount);
    recorder.discard();
    assert_eq!(fs::read_dir(&scratch.0).unwrap().count(), 0);
}

#[test]
fn a_removed_run_folder_is_reported_and_cannot_be_closed() {
    let scratch = Scratch::new("removed");
    let mut recorder = recorder(&scratch.0, Backpressure::DropAndCount);
    fs::remove_dir_all(&recorder.run_dir).unwrap();
    let end = std::time::Instant::now() + Duration::from_secs(60);
    let said = loop {
        assert!(std::time::Instant::now() < end, "no news");
        match recorder.news() {
            Some(RecordNews::Failed(error)) => break error.to_string(),
            _ => std::thread::yield_now(),
        }
    };
    assert!(said.starts_with("run folder: ") && said.contains("No such file"), "{said}");
    let error = recorder.finish(completed).unwrap_err();
    assert!(error.to_string().contains("virtual: No such file"), "{error}");
}

/// A writer that was given up may still write, so a repair must not cut its files.
#[test]
fn a_record_left_open_stays_locked_while_its_bench_lives() {
    let scratch = Scratch::new("left-locked");
    let recorder = recorder(&scratch.0, Backpressure::DropAndCount);
    let moved = scratch.0.join("moved");
    fs::rename(&recorder.run_dir, &moved).unwrap();
    let error = recorder.finish(completed).unwrap_err();
    assert!(error.to_string().contains("No such file"), "{error}");
    let said = repair(&moved).unwrap_err().to_string();
    assert!(said.contains("a bench is still writing this record"), "{said}");
}

#[test]
fn the_manifest_of_a_run_that_was_not_closed_has_no_outcome() {
    let scratch = Scratch::new("abandoned");
    let recorder = recorder(&scratch.0, Backpressure::Block);
    let manifest = fs::read(recorder.run_dir.join("manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_slice(&manifest).unwrap();
    assert_eq!(manifest["outcome"], serde_json::Value::Null);
    assert_eq!(manifest["ended_utc"], serde_json::Value::Null);
}

#[test]
fn two_runs_never_share_a_folder() {
    let scratch = Scratch::new("twice");
    let (first, _) = record(&scratch.0, synthetic::run(1, 1));
    let steps = fs::read(first.join("steps.csv")).unwrap();
    let (second, _) = record(&scratch.0, synthetic::run(3, 1));
    assert_ne!(first, second);
    assert_eq!(fs::read(first.join("steps.csv")).unwrap(), steps);
}

#[test]
fn nan_and_infinity_break_no_file() {
    let scratch = Scratch::new("hostile");
    let mut entries = synthetic::run(3, 2);
    for entry in &mut entries {
        for value in [f64::NAN, f64::INFINITY] {
            synthetic::spoil(entry, value);
        }
    }
    let (run_dir, recorded) = record(&scratch.0, entries.clone());
    assert_eq!(recorded.steps, 3);
    let steps = fs::read_to_string(run_dir.join("steps.csv")).unwrap();
    let columns = steps_csv_header().matches(',').count();
    assert!(steps.lines().all(|row| row.matches(',').count() == columns));
    let tracker = fs::read_to_string(run_dir.join("tracker.ndjson")).unwrap();
    assert_eq!(tracker.lines().count() as u64, recorded.tracker_samples);
    assert!(!tracker.is_empty());
    for line in tracker.lines() {
        let sample: serde_json::Value = serde_json::from_str(line).unwrap();
        assert_eq!(sample["position_tracker_mm"][0], "inf");
    }
    assert!(!recording::readable_paths(&recording_of(&scratch.0, entries)).is_empty());
}
