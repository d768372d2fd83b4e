//! The run folder and the recording of a run.
//!
//! A [`Recorder`] passes [`Entry`]s from the session's thread through a bounded queue to a writer thread, which
//! appends to the text files (`steps.csv`, `can.log`, `tracker.ndjson`, `inputs.log`, `events.log`). A second
//! thread, the keeper, syncs the text files, writes the manifest, and checks that the folder is still there. The
//! writer does not sync, because a sync may take longer than the 200 ms of lines that a kill may cost. If the
//! queue is full, entries are dropped, counted and reported. The recorder reports a thread that fails or stalls to
//! the runtime ([`Recorder::news`]). The live view is a lossy tap with a queue of its own.
//!
//! `run.rrd` is made from the text files when they are closed ([`Recording`]): it can be made again at
//! any time.
//!
//! Losses:
//! - if the bench is killed: the last 50 ms of the text files, and at most a part of the last line; the
//!   manifest has no outcome until [`repair`] closes the record;
//! - if the machine loses power: 1.25 s more;
//! - if the disk fills or stalls: everything after that. The lost records are counted in the manifest, for
//!   which space is reserved.

mod error;
mod folder;
mod keeper;
mod recorder;
mod recording;
mod repair;
mod run_folder;
mod text;
mod watchdog;
mod worker;

pub use error::TelemetryError;
pub use folder::{check_room, free_mb, is_being_written, lock, try_to_write, write_manifest};
pub use recorder::Recorder;
pub use recording::Recording;
pub use repair::{Repaired, note_recording, repair};
pub use run_folder::{RunFolder, open_regular};
pub use watchdog::RecordNews;
pub use worker::Backpressure;

use crate::archive::rfc3339;
use crate::emulator::Truth;
use crate::geometry::Pose;
use crate::plan::{Problem, World};
use crate::session::Record;
use crate::stage::StageConfig;
use jiff::Timestamp;
use std::time::SystemTime;

/// An input of the recorder: a record of the session and, with steps of emulated runs, the truth.
#[derive(Debug, Clone, PartialEq)]
pub struct Entry {
    /// The record.
    pub record: Record,
    /// The truth at that moment, for a step of an emulated run.
    pub truth: Option<Truth>,
}

/// `time` in the format of a run's files, RFC 3339: `2026-03-01T14:30:00.123456Z`.
pub fn utc_text(time: SystemTime) -> String {
    rfc3339(Timestamp::try_from(time).unwrap_or_default().as_microsecond())
}

/// The part of the recording that is not in the records: the fixed part of the 3-D view, and the limits.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// `X_WP`: desired plane P in bench frame W.
    pub x_wp: Pose,
    /// Depth of the insertion, mm: the length of the plane that is drawn.
    pub insertion_mm: f64,
    /// Needle curvature in the bench's model, per mm.
    pub curvature_per_mm: f64,
    /// The obstacles, and the target with its tolerance.
    pub goal: Option<(World, Problem)>,
    /// True if the steps come with the truth.
    pub truth: bool,
    /// Observers that run alongside, by name.
    pub shadows: Vec<String>,
    /// Upper bound of the control law's rotation command, rad/mm.
    pub rotation_max_rad_per_mm: f64,
    /// The insertion is held when the newest accepted tip position is older than this, s.
    pub tip_meas_age_max_s: f64,
    /// The drives, with scales and limits.
    pub stage: StageConfig,
}

#[cfg(test)]
pub(crate) mod tests;
