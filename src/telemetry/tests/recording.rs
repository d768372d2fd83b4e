//! `run.rrd`, read back with rerun's own reader.

use super::*;
use crate::geometry::coordinates;
use crate::session::{Record, StepRecord};
use rerun::Component as _;
use rerun::external::re_log_encoding::DecoderApp;
use rerun::log::{Chunk, LogMsg};
use std::collections::{BTreeMap, BTreeSet};

/// A series of the recording: places on one of its time lines, and values.
type Series = Vec<(i64, f64)>;

struct ReadBack {
    /// By entity and column.
    series: BTreeMap<(String, String), Series>,
    rows: BTreeMap<String, usize>,
    layouts: usize,
}

/// Reads the recording `path` with its series over `timeline`.
fn read_back(path: &Path, timeline: &'static str) -> ReadBack {
    let file = std::io::BufReader::new(fs::File::open(path).unwrap());
    let mut layouts = BTreeSet::new();
    let mut read = ReadBack { series: BTreeMap::new(), rows: BTreeMap::new(), layouts: 0 };
    for message in DecoderApp::decode_lazy(file) {
        let message = message.unwrap();
        if message.store_id().is_blueprint() {
            layouts.insert(message.store_id().to_string());
            read.layouts = layouts.len();
            continue;
        }
        if let LogMsg::ArrowMsg(_, rows) = message {
            let chunk = Chunk::from_arrow_msg(&rows).unwrap();
            let path = chunk.entity_path().to_string();
            *read.rows.entry(path.clone()).or_default() += chunk.num_rows();
            for (name, column) in chunk.timelines() {
                assert!(column.times_raw().is_sorted(), "{path} on {name}");
            }
            let Some(moments) = chunk.timelines().get(&timeline.into()) else { continue };
            for descriptor in chunk.component_descriptors() {
                if descriptor.component_type != Some(rerun::components::Scalar::name()) {
                    continue;
                }
                let values = chunk.iter_slices::<f64>(descriptor.component).flatten().copied();
                let rows = moments.times_raw().iter().copied().zip(values);
                let column = (path.clone(), descriptor.component.to_string());
                read.series.entry(column).or_default().extend(rows);
            }
        }
    }
    read.series.values_mut().for_each(|series| series.sort_by_key(|(moment, _)| *moment));
    read
}

impl ReadBack {
    fn column(&self, table: &str, column: &str) -> &Series {
        &self.series[&(table.to_owned(), column.to_owned())]
    }
}

/// The entities that can be read in the recording `path`.
pub(super) fn readable_paths(path: &Path) -> Vec<String> {
    read_back(path, "step").rows.into_keys().collect()
}

fn steps(entries: &[Entry]) -> impl Iterator<Item = (&StepRecord, [f64; 6], [f64; 6])> {
    entries.iter().filter_map(|entry| match (&entry.record, &entry.truth) {
        (Record::Step(step), Some(truth)) => {
            let estimate = step.decision.estimate.map_or([f64::NAN; 6], |e| coordinates(&e.x_pb));
            Some((step.as_ref(), estimate, coordinates(&truth.x_pb)))
        }
        _ => None,
    })
}

#[test]
fn the_recording_holds_what_was_recorded() {
    let scratch = Scratch::new("recording");
    let entries = synthetic::run(30, 5);
    let read = read_back(&recording_of(&scratch.0, entries.clone()), "step");
    assert_eq!(read.layouts, 1);

    let known: BTreeSet<&str> = read.rows.keys().map(String::as_str).collect();
    for path in [
        "/bench/plane",
        "/bench/plane/path/estimate",
        "/bench/plane/path/measured",
        "/bench/plane/path/true",
        "/bench/plane/target/sheet",
        "/bench/plane/tip/covariance",
        "/bench/plane/tip/estimate",
        "/bench/plane/tip/true",
        "/can",
        "/config",
        "/events/session",
        "/manifest",
        "/now",
        "/states/drive_insertion",
        "/states/gate",
        "/states/session",
        "/states/stage",
    ] {
        assert!(known.contains(path), "{path} is not among {known:?}");
    }

    for (name, n) in
        [("x_error_mm", 0), ("y_error_mm", 1), ("z_error_mm", 2), ("pitch_error_deg", 4)]
    {
        let unit = if name.ends_with("_mm") { 1.0 } else { 1f64.to_degrees() };
        let expected: Series = steps(&entries)
            .map(|(step, estimate, truth)| (i64::from(step.step), (estimate[n] - truth[n]) * unit))
            .collect();
        assert_same(read.column("/steps", name), &expected);
    }
    let x_true: Series =
        steps(&entries).map(|(step, _, truth)| (i64::from(step.step), truth[0])).collect();
    assert_same(read.column("/steps", "x_true_mm"), &x_true);
    let upper: Series = steps(&entries)
        .map(|(step, estimate, _)| {
            let sd = step.decision.estimate.and_then(|e| e.sd).map_or(f64::NAN, |sd| sd[0]);
            (i64::from(step.step), estimate[0] + 2.0 * sd)
        })
        .collect();
    assert_same(read.column("/steps", "x_high_mm"), &upper);
    assert_eq!(read.column("/shadows/finite-difference", "x_error_mm").len(), 30);
    // Ten rows a second.
    assert_eq!(read.column("/motion", "insertion_lag_mm").len(), 149);
    let limits = read.column("/limits", "insertion_max_mm");
    assert!(limits.len() == 149 && limits.iter().all(|(_, limit)| *limit == 150.0), "{limits:?}");
}

/// A view of states with its own axis does not grow after it was opened.
#[test]
fn plots_and_states_share_one_time_axis() {
    let scratch = Scratch::new("axis");
    let path = recording_of(&scratch.0, synthetic::run(1, 1));
    let file = std::io::BufReader::new(fs::File::open(path).unwrap());
    let (mut linked, mut ranges, mut views) = (BTreeSet::new(), BTreeSet::new(), BTreeMap::new());
    for message in DecoderApp::decode_lazy(file) {
        let message = message.unwrap();
        let LogMsg::ArrowMsg(id, rows) = &message else { continue };
        if !id.is_blueprint() {
            continue;
        }
        let chunk = Chunk::from_arrow_msg(rows).unwrap();
        let path = chunk.entity_path().to_string();
        for descriptor in chunk.component_descriptors() {
            match descriptor.component.as_str() {
                "TimeAxis:link" => linked.insert(path.replace("/TimeAxis", "")),
                "TimeAxis:view_range" => ranges.insert(path.clone()),
                "ViewBlueprint:class_identifier" => {
                    let class = chunk.iter_slices::<String>(descriptor.component).flatten().next();
                    views.insert(path.clone(), class.expect("a class").to_string()).is_some()
                }
                _ => continue,
            };
        }
    }
    let on_an_axis =
        views.iter().filter(|(_, c)| ["TimeSeries", "StateTimeline"].contains(&c.as_str()));
    let on_an_axis: BTreeSet<String> = on_an_axis.map(|(path, _)| path.clone()).collect();
    assert!(on_an_axis.len() > 10 && linked == on_an_axis, "{linked:?}, of {on_an_axis:?}");
    let shared = "/view/5c0dca6a-e63f-9cf7-f657-2602590474cc/TimeAxis";
    assert_eq!(ranges.into_iter().collect::<Vec<_>>(), [shared]);
}

#[test]
fn an_unfinished_recording_leaves_the_earlier_one() {
    let scratch = Scratch::new("unfinished");
    let path = recording_of(&scratch.0, synthetic::run(1, 1));
    let whole = fs::read(&path).unwrap();
    let mut unfinished = Recording::create(&scratch.0, &manifest(), CONFIG_TOML, &scene()).unwrap();
    synthetic::run(3, 5).into_iter().for_each(|entry| unfinished.take(entry).unwrap());
    drop(unfinished);
    assert_eq!(fs::read(&path).unwrap(), whole);
    assert_eq!(fs::read_dir(&scratch.0).unwrap().count(), 1, "a temporary file was left");
    let error = Recording::create(&path, &manifest(), CONFIG_TOML, &scene()).err().unwrap();
    assert!(error.to_string().contains("run.rrd: Not a directory"), "{error}");
}

#[test]
fn a_full_disk_fails_the_recording_and_leaves_no_file() {
    let scratch = Scratch::new("rrd-full");
    std::os::unix::fs::symlink("/dev/full", scratch.0.join("run.rrd.new")).unwrap();
    let recording = Recording::create(&scratch.0, &manifest(), CONFIG_TOML, &scene());
    let error = recording.and_then(Recording::finish).unwrap_err().to_string();
    assert!(error.contains("run.rrd: ") && error.contains("No space left"), "{error}");
    assert!(!scratch.0.join("run.rrd").exists());
}

#[test]
fn every_row_is_on_all_three_time_lines() {
    let scratch = Scratch::new("time-lines");
    let path = recording_of(&scratch.0, synthetic::run(10, 5));
    let by = |timeline| read_back(&path, timeline);
    let (by_time, by_depth, by_step) = (by("run_time"), by("insertion_depth"), by("step"));
    let commanded = |read: &ReadBack| read.column("/stage", "insertion_cmd_mm").clone();
    let (by_time, by_depth) = (commanded(&by_time), commanded(&by_depth));
    let by_step = commanded(&by_step);
    assert_eq!((by_time.len(), by_depth.len(), by_step.len()), (50, 50, 50));
    for (&(run_time_ns, depth_mm), &(depth_um, _)) in by_time.iter().zip(&by_depth) {
        assert!((run_time_ns as f64 * 1e-9 - 2.0 - depth_mm).abs() < 1e-9);
        // The stage lags 10 µm behind what the steps reach.
        let lag_um = (depth_mm * 1e3).round() as i64 - depth_um;
        assert!((0..=10).contains(&lag_um), "{lag_um}");
    }
    assert!(by_step.iter().all(|&(step, depth_mm)| step == depth_mm.floor() as i64));
}

#[test]
fn cyclic_frames_are_thinned_out_and_others_are_not() {
    let scratch = Scratch::new("cyclic");
    let path = recording_of(&scratch.0, synthetic::run(10, 50));
    // The 24 frames of the bring-up, and one frame of each of the five identifiers per step.
    assert_eq!(read_back(&path, "step").rows["/can"], 24 + 10 * 5);
}

fn assert_same(read: &Series, expected: &Series) {
    assert_eq!(read.len(), expected.len());
    for ((at, value), (at_expected, value_expected)) in read.iter().zip(expected) {
        let same =
            (value - value_expected).abs() < 1e-12 || value.is_nan() && value_expected.is_nan();
        assert!(at == at_expected && same, "{at}: {value}, not {value_expected} at {at_expected}");
    }
}
