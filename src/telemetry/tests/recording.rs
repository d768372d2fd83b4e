//! `run.rrd`, read back with rerun's own reader.

use super::*;
use crate::session::{Record, StepRecord};
use rerun::{ChunkStore, ChunkStoreConfig, StoreKind};
use std::collections::BTreeMap;

/// A series of the recording: moments on one of its time lines, and values.
type Series = Vec<(i64, f64)>;

struct ReadBack {
    series: BTreeMap<String, Series>,
    rows: BTreeMap<String, usize>,
    layouts: usize,
}

/// Reads the recording of `run_dir`, scalars by their place on `timeline`.
fn read_back(run_dir: &Path, timeline: &'static str) -> ReadBack {
    let mut file = fs::File::open(run_dir.join("run.rrd")).unwrap();
    let stores = ChunkStore::from_rrd_reader(&ChunkStoreConfig::ALL_DISABLED, &mut file).unwrap();
    let mut read = ReadBack { series: BTreeMap::new(), rows: BTreeMap::new(), layouts: 0 };
    for (id, store) in &stores {
        if id.kind() == StoreKind::Blueprint {
            read.layouts += 1;
            continue;
        }
        for chunk in store.iter_physical_chunks() {
            let path = chunk.entity_path().to_string();
            *read.rows.entry(path.clone()).or_default() += chunk.num_rows();
            let component = rerun::Scalars::descriptor_scalars().component;
            let values = chunk.iter_slices::<f64>(component).flatten().copied();
            if let Some(moments) = chunk.timelines().get(&timeline.into()) {
                let row = moments.times_raw().iter().copied().zip(values);
                read.series.entry(path).or_default().extend(row);
            }
        }
    }
    read.series.values_mut().for_each(|series| series.sort_by_key(|(moment, _)| *moment));
    read.series.retain(|_, series| !series.is_empty());
    read
}

/// The entities that can be read in the recording of `run_dir`.
pub(super) fn readable_paths(run_dir: &Path) -> Vec<String> {
    read_back(run_dir, "step").rows.into_keys().collect()
}

fn steps(entries: &[Entry]) -> impl Iterator<Item = (&StepRecord, [f64; 6], [f64; 6])> {
    entries.iter().filter_map(|entry| match (&entry.record, &entry.truth) {
        (Record::Step(step), Some(truth)) => {
            let estimate = step.estimate.map_or([f64::NAN; 6], |e| coordinates(&e.x_pb));
            Some((step.as_ref(), estimate, coordinates(truth.x_pb())))
        }
        _ => None,
    })
}

#[test]
fn the_recording_holds_what_was_recorded() {
    let scratch = Scratch::new("recording");
    let entries = synthetic::run(30, 5);
    let finished = record(&scratch.0, entries.clone());
    let read = read_back(&finished.run_dir, "step");
    assert_eq!(read.layouts, 1);

    let known: BTreeSet<&str> = read.rows.keys().map(String::as_str).collect();
    for path in [
        "/bench/plane",
        "/bench/plane/path/estimate",
        "/bench/plane/path/measured",
        "/bench/plane/path/true",
        "/bench/plane/target/sheet",
        "/bench/plane/tip/estimate",
        "/bench/plane/tip/true",
        "/can",
        "/config",
        "/events/session",
        "/manifest",
        "/states/session",
        "/states/stage",
    ] {
        assert!(known.contains(path), "{path} is not among {known:?}");
    }

    for (name, n) in [("x_mm", 0), ("y_mm", 1), ("z_mm", 2), ("pitch_deg", 4)] {
        let unit = if name.ends_with("_mm") { 1.0 } else { 1f64.to_degrees() };
        let expected: Series = steps(&entries)
            .map(|(step, estimate, truth)| (i64::from(step.step), (estimate[n] - truth[n]) * unit))
            .collect();
        assert_same(&read.series[&format!("/error/{name}")], &expected);
    }
    let x_true: Series =
        steps(&entries).map(|(step, _, truth)| (i64::from(step.step), truth[0])).collect();
    assert_same(&read.series["/state/x_mm/true"], &x_true);
    let upper: Series = steps(&entries)
        .map(|(step, estimate, _)| {
            let sd = step.estimate.and_then(|e| e.sd).map_or(f64::NAN, |sd| sd[0]);
            (i64::from(step.step), estimate[0] + 2.0 * sd)
        })
        .collect();
    assert_same(&read.series["/state/x_mm/estimate_plus_2_sd"], &upper);
    assert_eq!(read.series["/shadow/finite-difference/error/x_mm"].len(), 30);
    assert!(!read.series.contains_key("/state/pitch_deg/measured"));
}

#[test]
fn every_row_stands_on_all_three_time_lines() {
    let scratch = Scratch::new("time-lines");
    let finished = record(&scratch.0, synthetic::run(10, 5));
    let stage = "/stage/insertion_mm/commanded";
    let by_time = &read_back(&finished.run_dir, "run_time").series[stage];
    let by_depth = &read_back(&finished.run_dir, "insertion_depth").series[stage];
    let by_step = &read_back(&finished.run_dir, "step").series[stage];
    assert_eq!((by_time.len(), by_depth.len(), by_step.len()), (50, 50, 50));
    for (&(run_time_ns, depth_mm), &(depth_um, _)) in by_time.iter().zip(by_depth) {
        assert!((run_time_ns as f64 * 1e-9 - 2.0 - depth_mm).abs() < 1e-9);
        assert_eq!(depth_um, ((depth_mm - 0.01) * 1e3).round() as i64);
    }
    assert!(by_step.iter().all(|&(step, depth_mm)| step == depth_mm.floor() as i64));
}

#[test]
fn cyclic_frames_are_thinned_out_and_others_are_not() {
    let scratch = Scratch::new("cyclic");
    let finished = record(&scratch.0, synthetic::run(10, 50));
    // The bring-up's 24 frames, and one of each of the five identifiers a step.
    assert_eq!(read_back(&finished.run_dir, "step").rows["/can"], 24 + 10 * 5);
    assert_eq!(finished.counts.can_frames, 24 + 10 * 50 * 5);
}

fn assert_same(read: &Series, expected: &Series) {
    assert_eq!(read.len(), expected.len());
    for ((at, value), (at_expected, value_expected)) in read.iter().zip(expected) {
        let same =
            (value - value_expected).abs() < 1e-12 || value.is_nan() && value_expected.is_nan();
        assert!(at == at_expected && same, "{at}: {value}, not {value_expected} at {at_expected}");
    }
}
