//! The recorder: a run folder and the threads that fill it.

use super::keeper::keep;
use super::recording::live;
use super::text::{TEXT_FILES, TextFiles};
use super::vitals::RecordNews;
use super::worker::{Backpressure, Left, Worker};
use super::{Entry, Scene, TelemetryError, folder, utc_text};
use crate::archive::{
    Counts, DriveIdentity, Dropped, FileSeal, Manifest, file, sha256_hex, unix_us_of,
};
use rtrb::Consumer;
use std::fs::{self, File};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime};

/// Entries the queue holds: about half a minute of a run at 10 ms SYNC, 3 s at 1 ms.
const QUEUE_ENTRIES: usize = 32_768;
/// At the end of a run the writer is given up after this long without a sign of life.
const CLOSING_LIMIT: Duration = Duration::from_secs(15);
/// The manifest is given this long after it.
const MANIFEST_LIMIT: Duration = Duration::from_secs(5);

/// The record of a finished run.
#[derive(Debug, Clone, PartialEq)]
pub struct Finished {
    /// The run folder.
    pub run_dir: PathBuf,
    /// Lines of the text files.
    pub counts: Counts,
    /// Records that are in no file.
    pub dropped: Dropped,
    /// Failures, with the reasons; empty if the record is complete.
    pub faults: Vec<String>,
}

/// A run folder that is being filled.
pub struct Recorder {
    run_dir: PathBuf,
    config_toml: String,
    manifest: Manifest,
    text: Worker<Entry>,
    live: Option<Worker<Entry>>,
    keeper: Worker<Box<Manifest>>,
    /// Troubles that the keeper found.
    troubles: Consumer<String>,
    faults: Vec<String>,
    /// Tells other processes that the folder is being written.
    lock: Option<File>,
}

impl Recorder {
    /// Makes a new folder in `parent` for the run that `manifest` describes, with `config_toml`, the
    /// configuration as used, and starts the writer.
    ///
    /// # Errors
    /// The folder or one of its files cannot be made; then there is no folder.
    pub fn create(
        parent: &Path,
        manifest: Manifest,
        config_toml: String,
        backpressure: Backpressure,
    ) -> Result<Recorder, TelemetryError> {
        let started_unix_us = unix_us_of(&manifest.started_utc).unwrap_or_default();
        let run_dir = folder::create(parent, started_unix_us, &manifest.name)?;
        let config_sha256 = sha256_hex(config_toml.as_bytes());
        let manifest = Manifest { config_sha256, ..manifest };
        let fill = |run_dir: PathBuf| {
            let path = run_dir.join(file::CONFIG);
            fs::write(&path, &config_toml).map_err(TelemetryError::file(&path))?;
            let lock = folder::lock(&run_dir)?;
            folder::write_manifest(&run_dir, &manifest)?;
            folder::reserve_manifest(&run_dir)?;
            let (files, mut kept) = TextFiles::create(&run_dir, &manifest)?;
            let config = File::open(&path).map_err(TelemetryError::file(&path))?;
            kept.push((path, config));
            let text = Worker::start(TEXT_FILES, QUEUE_ENTRIES, backpressure, || Ok(files))?;
            let (keeper, troubles) = keep(run_dir.clone(), kept)?;
            let (live, faults) = (None, Vec::new());
            Ok(Recorder {
                run_dir,
                config_toml,
                manifest,
                text,
                live,
                keeper,
                troubles,
                faults,
                lock,
            })
        };
        fill(run_dir.clone()).inspect_err(|_| discard(&run_dir))
    }

    /// Serves the run to viewers at `address` from now on, with what `scene` shows; call it before the
    /// first record. Viewers never affect the run or its files: what the live view cannot take at once
    /// is dropped and counted.
    ///
    /// # Errors
    /// The address cannot be listened at.
    pub fn serve(&mut self, address: SocketAddr, scene: Scene) -> Result<(), TelemetryError> {
        let (manifest, config_toml) = (self.manifest.clone(), self.config_toml.clone());
        self.live = Some(live::serve(address, manifest, config_toml, scene)?);
        Ok(())
    }

    /// Removes the folder of a run that cannot begin.
    pub fn discard(self) {
        discard(&self.run_dir);
    }

    /// The run folder.
    pub fn run_dir(&self) -> &Path {
        &self.run_dir
    }

    /// Records `entry`. It takes some microseconds, most of them to wake the writer; with
    /// [`Backpressure::DropAndCount`] it never waits for a disk or a viewer.
    pub fn record(&mut self, entry: Entry) {
        if let Some(live) = &mut self.live {
            live.give(entry.clone());
        }
        if TextFiles::wants(&entry.record) {
            self.text.give(entry);
        }
    }

    /// The next change in the state of the recording. Call it until it returns `None`, at least twenty times
    /// a second: then a full or stalled disk or a lost folder is reported within a second. Of the time
    /// between two calls at most 50 ms count as silence of a thread.
    pub fn news(&mut self) -> Option<RecordNews> {
        let now = Instant::now();
        let news = self.text.news(now).or_else(|| self.keeper.news(now)).or_else(|| {
            let trouble = self.troubles.pop().ok()?;
            Some(RecordNews::Failed(TelemetryError::Recording(trouble)))
        })?;
        if let RecordNews::Failed(error) = &news {
            self.faults.push(error.to_string());
        }
        Some(news)
    }

    /// Puts the drives found on the bus into the manifest, without waiting for it to be written.
    pub fn identify_drives(&mut self, drives: Vec<DriveIdentity>) {
        self.manifest.drives = drives;
        self.keeper.give(Box::new(self.manifest.clone()));
    }

    /// Completes the text files, seals them and writes the final manifest, to which `sum_up` adds the
    /// outcome and the figures of the run. Takes at most 22 s, even when the disk is stalled, and longer
    /// only while the writer makes progress. What failed is in the manifest and in the result.
    ///
    /// # Errors
    /// [`TelemetryError`] if the final manifest cannot be written, or if it is unknown what the text
    /// files hold: the record stays open.
    pub fn finish(
        mut self,
        sum_up: impl FnOnce(&mut Manifest),
    ) -> Result<Finished, TelemetryError> {
        // Failures since the last call.
        while self.news().is_some() {}
        let open = self.manifest.clone();
        sum_up(&mut self.manifest);
        self.manifest.ended_utc = Some(utc_text(SystemTime::now()));
        let closed = self.text.close(&self.manifest, CLOSING_LIMIT);
        if let Some(live) = &mut self.live {
            live.leave(&self.manifest, live::FAREWELL_MAX);
        }
        let (left, fault) = match &closed {
            Ok((left, fault)) => (Some(left), fault.as_ref()),
            Err(silent) => (None, Some(silent)),
        };
        let fault = fault.map(ToString::to_string).filter(|fault| !self.faults.contains(fault));
        self.faults.extend(fault);
        // An entry that is not in the files is lost, for whatever reason.
        let lost = left.map(|left| self.text.given.saturating_sub(left.entries));
        let dropped = Dropped {
            text_files: lost.unwrap_or(self.text.dropped),
            recording: 0,
            live: self.live.as_ref().map_or(0, |live| live.dropped),
        };
        // The record stays open if it is unknown what the text files hold.
        let mut manifest = match left {
            None => open,
            Some(Left { counts, files, .. }) => {
                let config = FileSeal::of(self.config_toml.as_bytes());
                self.manifest.counts = Some(*counts);
                self.manifest.files.clone_from(files);
                self.manifest.files.insert(file::CONFIG.to_owned(), config);
                self.manifest
            }
        };
        manifest.dropped = Some(dropped);
        manifest.faults.clone_from(&self.faults);
        let kept = self.keeper.close(&manifest, MANIFEST_LIMIT).map(|(_, fault)| fault);
        match (closed, kept) {
            (Ok((left, _)), Ok(None)) => {
                // What the keeper has added to the manifest.
                while let Ok(trouble) = self.troubles.pop() {
                    self.faults.push(trouble);
                }
                let (run_dir, counts, faults) = (self.run_dir, left.counts, self.faults);
                Ok(Finished { run_dir, counts, dropped, faults })
            }
            (Err(error), _) | (_, Err(error) | Ok(Some(error))) => {
                // A writer that was given up may still write: the folder is locked until the process ends.
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
