//! What goes wrong with a run folder, while it is filled and when it is read.

use crate::archive::ManifestError;
use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use thiserror::Error;

/// A failure of the run folder or of one of its writers.
#[derive(Debug, Error)]
pub enum TelemetryError {
    /// The folder could not be made.
    #[error("run folder {path}: {source}; check record.dir and its permissions", path = path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// A file of the folder cannot be read or written.
    #[error("{path}: {source}", path = path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The recording could not be opened.
    #[error("{path}: {reason}", path = path.display())]
    Recording {
        /// The recording.
        path: PathBuf,
        /// rerun's reason.
        reason: String,
    },
    /// The run cannot be served to viewers.
    #[error("--live: {address}: {reason}; is the port free?")]
    Live {
        /// Where it was to be served.
        address: SocketAddr,
        /// The system's reason.
        reason: String,
    },
    /// A writer failed during the run: what came after is not on disk.
    #[error("{writer}: {reason}; what follows is not recorded")]
    WriterFailed {
        /// Which writer.
        writer: &'static str,
        /// Its reason.
        reason: String,
    },
    /// The folder was changed during the run; what comes after is recorded as far as possible.
    #[error("{writer}: {reason}")]
    Amiss {
        /// The thread that found it.
        writer: &'static str,
        /// What.
        reason: String,
    },
    /// A queue was full: entries are missing in the record.
    #[error("{writer}: {lost} records lost, its queue is full; is the disk too slow for this run?")]
    Lost {
        /// Which writer.
        writer: &'static str,
        /// How many so far.
        lost: u64,
    },
    /// A writer makes no progress: a stalled disk or network share.
    #[error(
        "{writer}: no sign of life for {silent_s:.1} s (given up after {limit_s:.1}); is the disk \
         stalled?"
    )]
    WriterSilent {
        /// Which writer.
        writer: &'static str,
        /// How long it has been silent, s.
        silent_s: f64,
        /// How long it may be, s.
        limit_s: f64,
    },
    /// Too little room for a run.
    #[error(
        "record.dir {path}: {free_mb} MB free, record.free_mb_min asks for {free_mb_min}; free some, \
         or set another record.dir", path = path.display()
    )]
    NoRoom {
        /// The folder in which run folders are made.
        path: PathBuf,
        /// What is free there, MB.
        free_mb: u64,
        /// What has to be, MB.
        free_mb_min: u32,
    },
    /// The disk filled while the run went on.
    #[error("{path}: {free_kb} kB free: the disk is full", path = path.display())]
    Full {
        /// The run folder.
        path: PathBuf,
        /// What is free there, kB.
        free_kb: u64,
    },
    /// Nothing that looks like a run.
    #[error("{path}: not a run folder: {reason}", path = path.display())]
    NotARun {
        /// What was named.
        path: PathBuf,
        /// What is missing.
        reason: String,
    },
    /// Its manifest cannot be used.
    #[error("{path}: {source}", path = path.display())]
    Manifest {
        /// The manifest.
        path: PathBuf,
        /// What is wrong with it.
        source: ManifestError,
    },
    /// Files were changed since the record was closed.
    #[error("{path}: {what}; what it holds is not the record of that run",
            path = path.display(), what = changes.join("; "))]
    Changed {
        /// The folder.
        path: PathBuf,
        /// What became of each, at least of one.
        changes: Vec<String>,
    },
    /// There is nothing to repair.
    #[error("{path}: the record is closed: there is nothing to repair", path = path.display())]
    Closed {
        /// The folder.
        path: PathBuf,
    },
    /// The run is still going on.
    #[error("{path}: a bench is still writing this record; wait for it, or end it with Ctrl-C",
            path = path.display())]
    BeingWritten {
        /// The folder.
        path: PathBuf,
    },
}

impl TelemetryError {
    /// The system's error with the file at `path`.
    pub(super) fn file(path: &Path) -> impl FnOnce(io::Error) -> Self {
        move |source| TelemetryError::File { path: path.to_path_buf(), source }
    }

    /// The system's error with the folder at `path`.
    pub(super) fn folder(path: &Path) -> impl FnOnce(io::Error) -> Self {
        move |source| TelemetryError::Folder { path: path.to_path_buf(), source }
    }
}
