//! `run.rrd`.

use super::content::{Content, builder};
use super::pace::Pace;
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

/// A flush is given this long; the next one may succeed. A longer one would be taken for silence.
const FLUSH_LIMIT: Duration = Duration::from_millis(250);
/// The finished file is written once more, smaller, where that is done this long after its end has
/// begun: half of what those who wait for it grant.
const REWRITE_LIMIT: Duration = Duration::from_secs(30);
/// A larger file stays as it is: it would be joined in memory.
const REWRITE_BYTES_MAX: u64 = 512 << 20;
/// No more entries than this wait while others are under way; the next ones stay in the queue.
const WAITING_MAX: u64 = 32_768;

/// The recording of a run. It stays on the thread that opened it.
pub(in crate::telemetry) struct Recording {
    path: PathBuf,
    content: Content,
    pace: Pace,
    /// When the rows were sent that are not in the file yet.
    under_way: Option<Instant>,
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
            pace: Pace::new(now),
            under_way: None,
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
            // Of a full disk rerun says no more than that its writer is gone.
            Err(SinkFlushError::Failed { message }) => {
                Err(format!("{message}, {}", free_there(&self.path)))
            }
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
        let began = Instant::now();
        if self.under_way.is_none() && self.pace.is_due(began) {
            self.content.send().map_err(|e| e.to_string())?;
            self.sent = self.taken;
            self.under_way = Some(began);
        }
        // More is sent when that is in the file. On a slow machine rows wait here, and go in larger
        // chunks; with rerun they would wait as ever more small ones.
        if let Some(began) = self.under_way
            && self.flush()?
        {
            self.pace.sent(began, Instant::now());
            self.under_way = None;
        }
        Ok(())
    }

    fn is_stuck(&self) -> bool {
        self.progress.is_stalled()
    }

    fn is_full(&self) -> bool {
        self.taken - self.sent > WAITING_MAX
    }

    fn close(&mut self, closing: &Closing, alive: &dyn Fn()) -> Result<(), String> {
        let deadline = Instant::now() + REWRITE_LIMIT;
        self.content.end(&closing.manifest).map_err(|e| e.to_string())?;
        alive();
        self.sent = self.taken;
        while !self.flush()? {
            if !self.is_stuck() {
                alive();
            }
        }
        alive();
        // Writes the footer and waits for it.
        self.content.stream().finalize_deferred_sinks();
        alive();
        // What stands there now is written once more, or sealed, if it is this one alone.
        if let Some(identity) = self.identity {
            let failed = |error: io::Error| format!("{}: {error}", self.path.display());
            identity.is_at(&self.path).map_err(failed)?;
        }
        // The file is whole: where there is no time or room to make it smaller, it stays as it is.
        let may_go_on = || {
            alive();
            Instant::now() < deadline
        };
        if let Err(error) = rewrite(&self.path, &closing.manifest, REWRITE_BYTES_MAX, &may_go_on) {
            tracing::info!("{}: not compacted: {error}", self.path.display());
        }
        Ok(())
    }

    fn left(&self) -> Left {
        Left { entries: Some(self.flushed), ..Left::default() }
    }
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;
    use crate::telemetry::folder::tests::Scratch;
    use crate::telemetry::recorder::manifest_of;
    use crate::telemetry::tests::{run_info, synthetic};
    use std::io::Read as _;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::thread;

    /// A slow file would otherwise fall behind for good: ever more chunks would wait for it, in
    /// rerun, and the end of the run with them.
    #[test]
    fn rows_wait_for_those_that_are_under_way() {
        let scratch = Scratch::new("under-way");
        let path = scratch.0.join("run.rrd");
        nix::unistd::mkfifo(&path, nix::sys::stat::Mode::S_IRWXU).unwrap();
        let shut = Arc::new(AtomicBool::new(false));
        let (is_shut, reads_at) = (Arc::clone(&shut), path.clone());
        let reader = thread::spawn(move || {
            let mut pipe = fs::File::open(reads_at).unwrap();
            let mut some = [0; 4096];
            while pipe.read(&mut some).unwrap() > 0 {
                let held = Instant::now();
                while is_shut.load(Ordering::Relaxed) {
                    thread::sleep(Duration::from_millis(1));
                    // Were more sent, this test would wait inside rerun; so it goes on, and fails.
                    if held.elapsed() > Duration::from_secs(10) {
                        is_shut.store(false, Ordering::Relaxed);
                    }
                }
            }
        });
        let info = run_info();
        let mut recording = Recording::open(&path, &info, &manifest_of(&info)).unwrap();
        let entries = synthetic::run(3, 100);
        let round = |recording: &mut Recording| {
            entries.iter().cloned().for_each(|entry| recording.take(entry).unwrap());
            recording.tick().unwrap();
            thread::sleep(Duration::from_millis(10));
        };

        shut.store(true, Ordering::Relaxed);
        while recording.under_way.is_none() {
            round(&mut recording);
        }
        let under_way = recording.sent;
        assert!(recording.is_stuck());
        (0..3).for_each(|_| round(&mut recording));
        assert_eq!(recording.sent, under_way);

        shut.store(false, Ordering::Relaxed);
        while recording.flushed <= under_way {
            recording.tick().unwrap();
        }
        drop(recording);
        reader.join().unwrap();
    }
}
