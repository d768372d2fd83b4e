//! Errors of a run folder, while it is filled and when it is read.

use std::fmt::Display;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;
use thiserror::Error;

/// A failure of the run folder or of one of its writers.
#[derive(Debug, Error)]
pub enum TelemetryError {
    /// A file or folder cannot be read or written.
    #[error("{path}: {source}", path = path.display())]
    File {
        /// The file or folder.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// A run cannot be recorded or shown, or recording it failed.
    #[error("{0}")]
    Recording(String),
    /// The path is not a run folder.
    #[error("{path}: not a run folder: {reason}", path = path.display())]
    NotARun {
        /// The path that was named.
        path: PathBuf,
        /// The reason.
        reason: String,
    },
    /// The record cannot be used for this: it was edited, is closed already, or is still being written.
    #[error("{path}: {reason}", path = path.display())]
    Unusable {
        /// The run folder, or its manifest.
        path: PathBuf,
        /// The reason.
        reason: String,
    },
}

impl TelemetryError {
    /// The system's error with the file at `path`.
    pub(super) fn file(path: &Path) -> impl FnOnce(io::Error) -> Self {
        move |source| TelemetryError::File { path: path.to_path_buf(), source }
    }

    /// The system's error with the folder at `path`, which is or contains the run folder.
    pub(super) fn folder(path: &Path) -> impl FnOnce(io::Error) -> Self {
        move |error| {
            let path = path.display();
            TelemetryError::Recording(format!(
                "run folder {path}: {error}; check record.dir and its permissions"
            ))
        }
    }

    /// The record at `path` cannot be used, for this `reason`.
    pub(super) fn unusable(path: &Path, reason: impl Display) -> Self {
        TelemetryError::Unusable { path: path.to_path_buf(), reason: reason.to_string() }
    }

    /// `writer` failed during the run: later records are not on disk.
    pub(super) fn writer_failed(writer: &str, reason: impl Display) -> Self {
        TelemetryError::Recording(format!("{writer}: {reason}; what follows is not recorded"))
    }

    /// `writer` makes no progress, most likely because of a stalled disk or network share.
    pub(super) fn writer_stalled(writer: &str, silent: Duration, limit: Duration) -> Self {
        let (silent_s, limit_s) = (silent.as_secs_f64(), limit.as_secs_f64());
        TelemetryError::Recording(format!(
            "{writer}: no sign of life for {silent_s:.1} s (given up after {limit_s:.1}); is the disk \
             stalled?"
        ))
    }
}
