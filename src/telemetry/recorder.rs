//! The recorder: a run folder and the threads that fill it.

use super::keeper::keep;
use super::recording::live;
use super::text::{TextFiles, WRITER};
use super::watchdog::RecordNews;
use super::worker::{Backpressure, Worker};
use super::{Entry, Scene, TelemetryError, folder, utc_text};
use crate::archive::{DriveIdentity, Dropped, FileSeal, Manifest, file, sha256_hex};
use rtrb::Consumer;
use std::fs::{self, File};
use std::iter;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime};

/// Capacity of the queue, entries: about half a minute of a run at 10 ms SYNC, 3 s at 1 ms.
const QUEUE_ENTRIES: usize = 32_768;
/// At the end of a run the writer is given up after this long without progress.
const CLOSING_LIMIT: Duration = Duration::from_secs(15);
/// After that, writing the manifest is given up after this long without progress.
const MANIFEST_LIMIT: Duration = Duration::from_secs(5);

/// A run folder that is being filled.
pub struct Recorder {
    /// The run folder.
    pub run_dir: PathBuf,
    config_toml: String,
    /// The manifest so far, with the failures so far.
    manifest: Manifest,
    text: Worker<Entry>,
    live: Option<Worker<Entry>>,
    keeper: Worker<Manifest>,
    /// Problems that the keeper found.
    problems: Consumer<String>,
    /// Shows other processes that the folder is being written.
    lock: Option<File>,
}

impl Recorder {
    /// Creates a new folder in `parent` for the run that `manifest` describes, writes `config_toml`, the
    /// configuration as used, and starts the writer and the keeper.
    ///
    /// # Errors
    /// The folder or one of its files cannot be created, or a thread cannot be started. No folder remains then.
    pub fn create(
        parent: &Path,
        manifest: Manifest,
        config_toml: String,
        backpressure: Backpressure,
    ) -> Result<Recorder, TelemetryError> {
        let run_dir = folder::create(parent, &manifest)?;
        let config_sha256 = sha256_hex(config_toml.as_bytes());
        let manifest = Manifest { config_sha256, ..manifest };
        let fill = |run_dir: PathBuf| {
            let path = run_dir.join(file::CONFIG);
            fs::write(&path, &config_toml).map_err(TelemetryError::file(&path))?;
            let lock = folder::lock(&run_dir)?;
            folder::write_manifest(&run_dir, &manifest)?;
            let files = TextFiles::create(&run_dir, &manifest)?;
            let text = Worker::start(WRITER, QUEUE_ENTRIES, backpressure, files)?;
            let (keeper, problems) = keep(&run_dir)?;
            let live = None;
            Ok(Recorder { run_dir, config_toml, manifest, text, live, keeper, problems, lock })
        };
        fill(run_dir.clone()).inspect_err(|_| discard(&run_dir))
    }

    /// Serves the run to viewers at `address`, with the fixed part of the view in `scene`. Call this before the
    /// first record. Viewers never affect the run or its files: records that the live view cannot take at
    /// once are dropped and counted.
    ///
    /// # Errors
    /// The bench cannot listen at the address.
    pub fn serve(&mut self, address: SocketAddr, scene: &Scene) -> Result<(), TelemetryError> {
        self.live = Some(live::serve(address, &self.manifest, &self.config_toml, scene)?);
        Ok(())
    }

    /// Removes the folder of a run that cannot begin.
    pub fn discard(self) {
        discard(&self.run_dir);
    }

    /// Records `entry`. This takes some microseconds, mostly to wake the writer. With
    /// [`Backpressure::DropAndCount`] it never waits for a disk or a viewer.
    pub fn record(&mut self, entry: Entry) {
        if let Some(live) = &mut self.live {
            live.send(entry.clone());
        }
        if TextFiles::wants(&entry.record) {
            self.text.send(entry);
        }
    }

    /// The next change in the state of the recording. Call this at least twenty times a second, each time until
    /// it returns `None`: then a full or stalled disk or a lost folder is reported within a second. Of the time
    /// between two calls, at most 50 ms count as silence of a thread.
    pub fn news(&mut self) -> Option<RecordNews> {
        let now = Instant::now();
        let news = self.text.news(now).or_else(|| self.keeper.news(now));
        let news = news.or_else(|| self.problems.pop().ok().map(RecordNews::Failed))?;
        if let RecordNews::Failed(error) = &news {
            self.manifest.faults.push(error.clone());
        }
        Some(news)
    }

    /// Puts a drive found on the bus into the manifest, without waiting for it to be written.
    pub fn identify_drive(&mut self, drive: DriveIdentity) {
        self.manifest.drives.push(drive);
        self.keeper.send(self.manifest.clone());
    }

    /// Completes the text files, seals them and writes the final manifest, to which `sum_up` adds the
    /// outcome and the figures of the run. Takes at most 22 s if the disk is stalled, and longer only while
    /// the writer makes progress. Returns the final manifest, which lists the failures.
    ///
    /// # Errors
    /// [`TelemetryError`] if the final manifest cannot be written, or if the content of the text files is
    /// unknown. The record then stays open.
    pub fn finish(
        mut self,
        sum_up: impl FnOnce(&mut Manifest),
    ) -> Result<Manifest, TelemetryError> {
        let closed = self.text.close(&self.manifest, CLOSING_LIMIT);
        // Collects the failures since the last call.
        while self.news().is_some() {}
        let mut manifest = self.manifest.clone();
        sum_up(&mut manifest);
        manifest.ended_utc = Some(utc_text(SystemTime::now()));
        if let Some(live) = &mut self.live {
            live.close_within(&manifest, live::CLOSE_TIMEOUT);
        }
        let mut dropped = Dropped {
            text_files: self.text.dropped,
            recording: 0,
            live: self.live.as_ref().map_or(0, |live| live.dropped),
        };
        match &closed {
            Ok((written, _)) => {
                // An entry that is not in the files is lost, for whatever reason.
                dropped.text_files = self.text.sent.saturating_sub(written.entries);
                manifest.counts = Some(written.counts);
                manifest.files.clone_from(&written.files);
                let config = FileSeal::of(self.config_toml.as_bytes());
                manifest.files.insert(file::CONFIG.to_owned(), config);
            }
            Err(silent) => {
                // The record stays open if the content of the text files is unknown.
                manifest = self.manifest;
                manifest.faults.push(silent.to_string());
            }
        }
        manifest.dropped = Some(dropped);
        match (closed, self.keeper.close(&manifest, MANIFEST_LIMIT)) {
            (Ok(_), Ok((_, None))) => {
                // The keeper has added these to the manifest that it wrote.
                manifest.faults.extend(iter::from_fn(|| self.problems.pop().ok()));
                Ok(manifest)
            }
            (Err(error), _) | (_, Err(error) | Ok((_, Some(error)))) => {
                // A writer that was given up may still write, so the folder stays locked until the process ends.
                std::mem::forget(self.lock);
                Err(error)
            }
        }
    }
}

/// Removes the folder of a run that never began.
fn discard(run_dir: &Path) {
    if let Err(error) = fs::remove_dir_all(run_dir) {
        tracing::warn!("{}: holds no run and could not be removed: {error}", run_dir.display());
    }
}
