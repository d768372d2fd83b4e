//! Recorded insertions, from CSV files and from run folders alike; and what a run folder tells of stage
//! and tracker.

use super::Failure;
use super::recording::recorded_plan;
use super::sources::text_of;
use crate::archive::file;
use crate::config::{Config, Source};
use crate::replay::{Recorded, replay_to};
use crate::session::{Record, SampleRecord};
use crate::stage::SetPoint;
use crate::study::{RecordedRow, Recording};
use crate::telemetry::RunFolder;
use crate::tracker::{Registration, Sample};
use crate::units::Time;
use std::path::{Path, PathBuf};

/// Rows of a run are this far apart at least, mm: a hold gives one.
const ROWS_APART_MM: f64 = 0.05;

/// The insertions in `paths`, each with the text that it was read from. The same one twice says nothing
/// more, and is refused.
pub(super) fn insertions(paths: &[PathBuf]) -> Result<Vec<(String, Recording)>, Failure> {
    let mut all: Vec<(String, Recording)> = Vec::new();
    for path in paths {
        let read = insertion(path)?;
        if let Some(first) = all.iter().position(|(_, other)| other.is_same(&read.1)) {
            let first = paths[first].display();
            let error =
                format!("the same recording as {first}: it would count twice, give each once");
            return Err(Failure::in_file(path, error));
        }
        all.push(read);
    }
    Ok(all)
}

/// The insertion in `path`, a CSV file or a run folder, and the text that it was read from.
fn insertion(path: &Path) -> Result<(String, Recording), Failure> {
    let refused = |error: &dyn std::fmt::Display| Failure::in_file(path, error);
    if !path.is_dir() {
        let text = text_of(path)?;
        let recording = Recording::parse(&text).map_err(|error| refused(&error))?;
        return Ok((text, recording));
    }
    let Followed { folder, config, stage, samples } = follow(path)?;
    let registration = config.tracker.to_registration().map_err(Failure::configuration)?;
    let samples = samples.into_iter();
    let dated = samples.filter_map(|sample| Some((sample.acquisition_time?, sample.received)));
    let rows = rows(&stage, &registration, dated);
    match rows.is_empty() {
        true => Err(refused(&"no position was believed while the needle was inserted")),
        false => Ok((folder.text(file::TRACKER)?, Recording { rows })),
    }
}

/// What a run folder tells of the stage and of the tracker.
pub(super) struct Followed {
    folder: RunFolder,
    pub(super) config: Config,
    /// Where the stage was at each SYNC.
    pub(super) stage: Vec<(Time, SetPoint)>,
    /// What the tracker sent.
    pub(super) samples: Vec<SampleRecord>,
}

/// Replays the run in the folder `path`.
pub(super) fn follow(path: &Path) -> Result<Followed, Failure> {
    let refused = |error: &dyn std::fmt::Display| Failure::in_file(path, error);
    let folder = RunFolder::open(path)?;
    folder.verify()?;
    let text = folder.text(file::CONFIG)?;
    let source = Source { name: file::CONFIG, text: &text };
    let config = Config::from_sources(&[source], &[]).map_err(Failure::configuration)?;
    let plan = recorded_plan(folder.manifest(), &config)?;
    let recorded = Recorded { manifest: folder.manifest(), plan, open: &|name| folder.lines(name) };
    let (mut stage, mut samples) = (Vec::new(), Vec::new());
    let replayed = replay_to(&recorded, None, &mut |record, _| match record {
        Record::Stage(feedback) => stage.push((feedback.time, feedback.measured)),
        Record::Sample(sample) => samples.push(sample),
        _ => {}
    });
    match replayed.map_err(|error| refused(&error))?.difference {
        Some(difference) => Err(refused(&format!("does not replay: {difference}"))),
        None => Ok(Followed { folder, config, stage, samples }),
    }
}

/// The tip on the bench, and the stage when it was there, as far as the insertion advances.
fn rows(
    stage: &[(Time, SetPoint)],
    registration: &Registration,
    samples: impl Iterator<Item = (Time, Sample)>,
) -> Vec<RecordedRow> {
    let mut rows: Vec<RecordedRow> = Vec::new();
    for (n, (time, sample)) in samples.enumerate() {
        let Some(at) = position_at(stage, time) else { continue };
        let next_mm =
            rows.last().map_or(f64::NEG_INFINITY, |row| row.insertion_meas_mm + ROWS_APART_MM);
        if at.insertion_mm < next_mm {
            continue;
        }
        let Ok(position_meas_mm) = registration.tip_mm(&sample) else { continue };
        rows.push(RecordedRow {
            line: n + 1,
            insertion_meas_mm: at.insertion_mm,
            rotation_meas_rad: at.rotation_rad,
            position_meas_mm,
            rotation_true: registration.rotation(&sample),
        });
    }
    rows
}

/// Between the two SYNCs around `time`; `None` outside of all.
pub(super) fn position_at(stage: &[(Time, SetPoint)], time: Time) -> Option<SetPoint> {
    let after = stage.partition_point(|(at, _)| *at <= time);
    let ((t0, a), (t1, b)) = (stage.get(after.checked_sub(1)?)?, stage.get(after)?);
    let part = time.seconds_after(*t0) / t1.seconds_after(*t0).max(1e-9);
    Some(SetPoint {
        insertion_mm: a.insertion_mm + part * (b.insertion_mm - a.insertion_mm),
        rotation_rad: a.rotation_rad + part * (b.rotation_rad - a.rotation_rad),
    })
}
