//! `run.rrd`.

use super::content::{Content, builder};
use super::progress::Progress;
use super::rewrite::rewrite;
use crate::archive::Manifest;
use crate::session::Record;
use crate::telemetry::folder::Identity;
use crate::telemetry::room::free_there;
use crate::telemetry::worker::{Closing, Left, Sink};
use crate::telemetry::{Entry, RunInfo, TelemetryError};
use rerun::RecordingStreamResult;
use rerun::sink::SinkFlushError;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// A flush is the only call that tells of a full disk, so one is made this often.
const FLUSH_EVERY: Duration = Duration::from_millis(200);
/// A flush is given this long; the next one may succeed. A longer one would be taken for silence.
const FLUSH_LIMIT: Duration = Duration::from_millis(250);
/// The last flush is given this long.
const LAST_FLUSH_LIMIT: Duration = Duration::from_secs(4);
/// Writing the finished file once more, smaller, is given this long.
const REWRITE_LIMIT: Duration = Duration::from_secs(8);

/// The recording of a run. It stays on the thread that opened it.
pub(in crate::telemetry) struct Recording {
    path: PathBuf,
    content: Content,
    next_flush: Instant,
    progress: Progress,
    /// Which file it is, once it is on disk.
    identity: Option<Identity>,
    /// Entries taken; of these, those sent; and of these, those in the file for certain.
    taken: u64,
    sent: u64,
    flushed: u64,
}

impl Recording {
    /// Opens the recording `path` and logs what stands still. Returns when that is on disk, so
    /// that a disk which takes nothing is known before anything moves.
    pub(in crate::telemetry) fn open(
        path: &Path,
        info: &RunInfo,
        manifest: &Manifest,
    ) -> Result<Self, TelemetryError> {
        let failed =
            |reason: String| TelemetryError::Recording { path: path.to_path_buf(), reason };
        let mut recording =
            Self::try_open(path, info, manifest).map_err(|e| failed(e.to_string()))?;
        loop {
            match recording.flush() {
                Ok(true) => {
                    let found = fs::metadata(path).map_err(|e| failed(e.to_string()))?;
                    recording.identity = Some(Identity::of(&found));
                    return Ok(recording);
                }
                Ok(false) => {}
                Err(reason) => {
                    // Its end waits for a writer that is dead, and would wait for ever.
                    std::mem::forget(recording);
                    return Err(failed(reason));
                }
            }
        }
    }

    /// Records that leave something in the recording.
    pub(in crate::telemetry) fn wants(record: &Record) -> bool {
        !matches!(record, Record::Begun { .. } | Record::Input { .. })
    }

    fn try_open(path: &Path, info: &RunInfo, manifest: &Manifest) -> RecordingStreamResult<Self> {
        let content = Content::open(builder(info, manifest).save(path)?, info, manifest)?;
        let now = Instant::now();
        Ok(Recording {
            path: path.to_path_buf(),
            content,
            next_flush: now + FLUSH_EVERY,
            progress: Progress::new(path, now),
            identity: None,
            taken: 0,
            sent: 0,
            flushed: 0,
        })
    }

    /// Whether everything is on its way to the disk. A slow disk or a busy machine is no fault,
    /// since rerun holds what it could not write; a disk that takes nothing for
    /// [`progress::STALL_LIMIT`](super::progress::STALL_LIMIT) is. A full one shows as either.
    fn flush(&mut self) -> Result<bool, String> {
        match self.content.stream().flush_with_timeout(FLUSH_LIMIT) {
            Ok(()) => {
                self.progress.made();
                self.flushed = self.sent;
                Ok(true)
            }
            Err(SinkFlushError::Failed { message }) => Err(message),
            Err(SinkFlushError::Timeout) => self.progress.check().map(|()| false),
        }
    }
}

impl Sink for Recording {
    fn take(&mut self, entry: Entry) -> Result<(), String> {
        self.content.take(entry);
        self.taken += 1;
        Ok(())
    }

    fn tick(&mut self) -> Result<(), String> {
        if self.content.send_when_due().map_err(|e| e.to_string())? {
            self.sent = self.taken;
        }
        if Instant::now() >= self.next_flush {
            let pause = if self.flush()? { FLUSH_EVERY } else { Duration::ZERO };
            self.next_flush = Instant::now() + pause;
        }
        Ok(())
    }

    fn is_stuck(&self) -> bool {
        self.progress.is_stalled()
    }

    fn close(&mut self, closing: &Closing, alive: &dyn Fn()) -> Result<(), String> {
        self.content.end(&closing.manifest).map_err(|e| e.to_string())?;
        alive();
        let stream = self.content.stream();
        // rerun says of a full disk, too, that it took too long.
        let late = |error: SinkFlushError| format!("{error}, {}", free_there(&self.path));
        stream.flush_with_timeout(LAST_FLUSH_LIMIT).map_err(late)?;
        self.flushed = self.taken;
        alive();
        // Writes the footer and waits for it.
        stream.finalize_deferred_sinks();
        alive();
        // What stands there now is written once more, or sealed, if it is this one alone.
        if let Some(identity) = self.identity {
            let failed = |error: io::Error| format!("{}: {error}", self.path.display());
            identity.is_at(&self.path).map_err(failed)?;
        }
        // The file is whole: where there is no time or room to make it smaller, it stays as it is.
        if let Err(error) = rewrite(&self.path, Some(Instant::now() + REWRITE_LIMIT)) {
            tracing::info!("{}: not compacted: {error}", self.path.display());
        }
        Ok(())
    }

    fn left(&self) -> Left {
        Left { entries: Some(self.flushed), ..Left::default() }
    }
}
