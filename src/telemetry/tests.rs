//! Whole runs through the recorder.

mod recording;
mod synthetic;

use super::folder::tests::Scratch;
use super::*;
use crate::session::Outcome;
use crate::units::Time;
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::time::{Duration, UNIX_EPOCH};

pub(super) fn run_info() -> RunInfo {
    RunInfo {
        name: "virtual".to_owned(),
        started_utc: UNIX_EPOCH + Duration::from_secs(1_700_000_000),
        config_toml: "[insertion]\ndepth_mm = 150.0\n".to_owned(),
        version: "0.1.0".to_owned(),
        git: Some("abc1234".to_owned()),
        bus: "memory".to_owned(),
        tracker: "emulated".to_owned(),
        seed: Some(7),
        scene: Scene { x_wp: Pose::identity(), insertion_mm: 150.0, curvature_per_mm: 1.0 / 122.0 },
    }
}

/// Records `entries` as one run in `parent`.
fn record(parent: &Path, entries: impl IntoIterator<Item = Entry>) -> Finished {
    let recorder = Recorder::create(parent, run_info(), Backpressure::Block).unwrap();
    entries.into_iter().for_each(|entry| recorder.record(entry));
    recorder.health().unwrap();
    let summary = Summary { end: Time::from_secs_f64(12.5), ..Summary::default() };
    recorder.finish(&Outcome::Completed, summary).unwrap()
}

#[test]
#[ignore]
fn big() {
    let dir = std::env::var("OUT").unwrap();
    let t = std::time::Instant::now();
    let entries = synthetic::run(150, 100);
    println!("{} entries made in {:?}", entries.len(), t.elapsed());
    let t = std::time::Instant::now();
    let done = record(Path::new(&dir), entries);
    println!("{done:?} {:?}", t.elapsed());
}
