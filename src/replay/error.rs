//! Why a run cannot be replayed.

use crate::archive::{InputsError, file};
use crate::session::SessionError;
use crate::tracker::ndjson::LineError;
use std::io;
use thiserror::Error;

/// Why a recorded run cannot be replayed.
#[derive(Debug, Error)]
pub enum ReplayError {
    /// A text file cannot be read.
    #[error("{name}: {source}")]
    File {
        /// The file.
        name: &'static str,
        /// The system's reason.
        source: io::Error,
    },
    /// Records were lost while the run went on.
    #[error(
        "{0} records were dropped while this run was recorded (manifest.json, dropped.text_files): \
         what the session was given is not whole, and no replay of it can be exact"
    )]
    Dropped(u64),
    /// What the session was given cannot be read.
    #[error(transparent)]
    Inputs(#[from] InputsError),
    /// A line of `can.log` is none.
    #[error("{name} line {line}: {text:?} is not a frame as candump -L -x writes it", name = file::CAN)]
    Frame {
        /// Which, from 1.
        line: usize,
        /// The line.
        text: String,
    },
    /// A line of `tracker.ndjson` is none.
    #[error("{name}: {0}", name = file::TRACKER)]
    Sample(#[from] LineError),
    /// `steps.csv` has other columns.
    #[error("{name} begins with {0:?}: not the columns of this bench", name = file::STEPS)]
    Columns(String),
    /// The time at which the run began cannot be read.
    #[error("{name}: started_utc is {0:?}, no time", name = file::MANIFEST)]
    Started(String),
    /// The session refuses the configuration.
    #[error("{name}: {0}", name = file::CONFIG)]
    Session(#[from] SessionError),
    /// Another observer was asked about, in an operation of the stage.
    #[error("an operation of the stage has no observer to ask about")]
    NoObserver,
    /// The files do not belong together.
    #[error("the files are not of one run: {0}")]
    Mixed(String),
}
