//! The file formats of a run folder: pure text and types.
//!
//! Each format has one source file here, which writes and reads it. `telemetry` fills and opens run folders;
//! `replay` and `review` read them through the types here.

mod candump;
mod events;
mod inputs;
mod lines;
mod manifest;
mod steps_csv;
mod steps_table;
mod tracker_ndjson;
mod utc;

pub use candump::{CandumpLine, interface_name, unix_us};
pub use events::{EventKind, EventLine, proof};
pub use inputs::{Inputs, RecordedInput, input_line, inputs_header};
pub use lines::Lines;
pub use manifest::{
    Counts, DriveIdentity, Dropped, FileSeal, Manifest, RunOutcome, Verdict, VerdictKind, hex,
    sha256_hex,
};
pub use steps_csv::{
    RecordedColumns, STEP_COLUMNS, StepColumn, StepRow, is_truth_column, steps_csv_header,
};
pub use steps_table::StepsTable;
pub use tracker_ndjson::{TrackerTimes, line as tracker_line};
pub use utc::{compact, rfc3339, unix_us_of};

/// The files of a run folder.
pub mod file {
    /// The configuration as used.
    pub const CONFIG: &str = "config.toml";
    /// The settings of the run, and how it ended.
    pub const MANIFEST: &str = "manifest.json";
    /// Space reserved during the run for the final manifest, so that it can be written even on a full disk.
    pub const NEW_MANIFEST: &str = "manifest.json.new";
    /// One row for each step.
    pub const STEPS: &str = "steps.csv";
    /// Every CAN frame.
    pub const CAN: &str = "can.log";
    /// Every tracker sample.
    pub const TRACKER: &str = "tracker.ndjson";
    /// The session's inputs, in order and with their times.
    pub const INPUTS: &str = "inputs.log";
    /// States and events, for people.
    pub const EVENTS: &str = "events.log";
    /// The run for the rerun viewer.
    pub const RECORDING: &str = "run.rrd";
    /// The page that a review makes. It is not part of the record.
    pub const REPORT: &str = "report.html";
    /// The text files that are filled during the run, in the order in which they are written.
    pub const TEXT_FILES: [&str; 5] = [CAN, TRACKER, INPUTS, STEPS, EVENTS];
}
