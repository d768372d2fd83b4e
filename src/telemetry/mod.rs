//! The run folder and the recording: everything a run leaves behind.
//!
//! A [`Recorder`] takes [`Entry`]s from the session's thread through bounded queues and never
//! gives anything back. One thread writes the text files (`steps.csv`, `can.log`,
//! `tracker.ndjson`, `inputs.log`, `events.log`), a second one owns rerun and writes `run.rrd`, so that rerun can
//! delay neither the session nor the text files, and a third keeps the folder: it writes the
//! manifest, has the text files put on the disk itself, and sees that the folder is still there.
//! What a full queue refuses is counted and said; what fails, or falls silent, is news for who runs
//! the session ([`Recorder::news`]).
//!
//! What is lost when:
//! - the bench is killed: of the text files what came in the last 50 ms, and never a part of a line
//!   but at the very end; of the recording what came in the last 150 ms; the manifest has no
//!   outcome, until [`repair`] closes the record;
//! - the machine loses power: a second and a quarter more;
//! - the disk fills, or takes nothing: what comes after, counted in the manifest, for which room
//!   was kept.

mod clock;
mod closing;
mod error;
mod folder;
mod keeper;
mod recorder;
mod recording;
mod repair;
mod room;
mod run_folder;
mod silence;
mod text;
mod text_file;
mod vitals;
mod worker;

pub use clock::utc_text;
pub use error::TelemetryError;
pub use folder::{is_being_written, lock, write_manifest};
pub use recorder::{Finished, Recorder, RecorderHandle, Summary};
pub use recording::repair_recording;
pub use repair::{RepairError, Repaired, repair};
pub use room::check_room;
pub use run_folder::{Change, ChangeKind, RunFolder, RunFolderError, seal_file};
pub use vitals::RecordNews;
pub use worker::Backpressure;

use crate::emulator::Truth;
use crate::geometry::Pose;
use crate::session::Record;
use crate::stage::StageConfig;
use std::time::SystemTime;

/// What the recorder is given: a record of the session and, with steps of emulated runs, the truth.
#[derive(Debug, Clone, PartialEq)]
pub struct Entry {
    /// What left the session.
    pub record: Record,
    /// The true tip pose at that moment, where there is one.
    pub truth: Option<Truth>,
}

impl From<Record> for Entry {
    /// A record of a run whose truth nobody knows, or that is no step.
    fn from(record: Record) -> Self {
        Entry { record, truth: None }
    }
}

/// What is known of a run before it starts.
#[derive(Debug, Clone, PartialEq)]
pub struct RunInfo {
    /// Name of the run: the end of the folder's name.
    pub name: String,
    /// What the stage does without a needle to steer; none is an insertion.
    pub operation: Option<String>,
    /// What the operation was told.
    pub arguments: Vec<String>,
    /// The origin of the session's time line in UTC; whole microseconds are kept of it.
    pub started_utc: SystemTime,
    /// The configuration as used, canonical TOML. Its SHA-256 goes into the manifest.
    pub config_toml: String,
    /// SHA-256 of the calibrated part of it, hex.
    pub calibration_sha256: String,
    /// Version of the bench.
    pub version: String,
    /// Git state of the bench, where it is known.
    pub git: Option<String>,
    /// CAN interface, as candump names it: `vcan0`, `can0`, `memory`.
    pub bus: String,
    /// Tracker source, with its address where it has one.
    pub tracker: String,
    /// Seed of the emulator, where there is one.
    pub seed: Option<u64>,
    /// Who runs it.
    pub operator: Option<String>,
    /// What the needle is inserted into.
    pub phantom: Option<String>,
    /// What the operator has to say of it.
    pub note: Option<String>,
    /// What the recording shows besides the records.
    pub scene: Scene,
}

/// What the recording shows besides the records: the still part of the 3-D view, and limits.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// `X_WP`: desired plane P in bench frame W.
    pub x_wp: Pose,
    /// Depth to be inserted, mm: the length of the plane that is drawn.
    pub insertion_mm: f64,
    /// Needle curvature the bench believes, per mm.
    pub curvature_per_mm: f64,
    /// Whether steps come with the truth.
    pub truth: bool,
    /// Observers that run alongside, by name.
    pub shadows: Vec<String>,
    /// The fastest turning that the control law asks for, rad/mm.
    pub rotation_max_rad_per_mm: f64,
    /// Age of the newest believed tip position from which on the needle is held, s.
    pub tip_meas_age_max_s: f64,
    /// The drives, with scales and limits.
    pub stage: StageConfig,
}

#[cfg(test)]
pub(crate) mod tests;
