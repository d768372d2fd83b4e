//! The recorder: a run folder and the threads that fill it.

use super::clock::{unix_us, utc_text};
use super::closing::{Patience, close_all};
use super::keeper::{KEEPER, Keeper};
use super::recording::{Live, Recording};
use super::text::{TEXT_FILES, TextFiles};
use super::vitals::{RecordNews, Watch};
use super::worker::{Backpressure, Closing, Ended, Intake, Left, Worker};
use super::{Entry, RunInfo, TelemetryError, folder};
use crate::archive::{Counts, DriveIdentity, Dropped, FileSeal, Manifest, file, sha256_hex};
use crate::session::Outcome;
use crate::units::Time;
use serde_json::{Map, Value};
use std::fs::{self, File};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

/// Entries a queue holds: about half a minute of a run at 10 ms SYNC, 3 s at 1 ms.
const QUEUE_ENTRIES: usize = 32_768;
/// The recording's name in messages.
const RECORDING: &str = "recording";
/// The live view's.
const LIVE: &str = "live view";
/// Writers are given this long to complete their files at the end of a run.
const CLOSING: Patience =
    Patience { silence: Duration::from_secs(15), total: Duration::from_secs(60) };
/// Viewers are given this long to take the end of a run; one that is wedged takes all of it.
const FAREWELL: Patience =
    Patience { silence: Duration::from_secs(2), total: Duration::from_secs(2) };
/// The manifest is given this long after them.
const MANIFEST_LIMIT: Duration = Duration::from_secs(5);

/// What the runtime knows at the end of a run.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Summary {
    /// Where the run's own time line ended.
    pub end: Time,
    /// What became of the tracker's samples, by gate: as it is into the manifest.
    pub gates: Map<String, Value>,
    /// What the run came to, units in the keys: as it is into the manifest.
    pub figures: Map<String, Value>,
    /// Timing figures, units in the keys: they go into the manifest as they are.
    pub timing: Map<String, Value>,
}

/// What a finished run left behind.
#[derive(Debug, Clone, PartialEq)]
pub struct Finished {
    /// The run folder.
    pub run_dir: PathBuf,
    /// Lines of the text files.
    pub counts: Counts,
    /// Records that are in no file.
    pub dropped: Dropped,
    /// What failed of the record, each with its reason; nothing of a whole one.
    pub faults: Vec<String>,
    /// Size of the folder, bytes.
    pub bytes: u64,
}

/// Gives records to the writers from any thread.
#[derive(Clone)]
pub struct RecorderHandle {
    text: Intake,
    recording: Intake,
    live: Option<Intake>,
}

impl RecorderHandle {
    /// Keeps `entry`. Takes some microseconds, most of them to wake a writer; with
    /// [`Backpressure::DropAndCount`] it waits for no disk and no viewer.
    pub fn record(&self, entry: Entry) {
        if TextFiles::wants(&entry.record) {
            self.text.give(entry.clone());
        }
        if Recording::wants(&entry.record) {
            if let Some(live) = &self.live {
                live.give(entry.clone());
            }
            self.recording.give(entry);
        }
    }

    /// Records lost so far.
    pub fn dropped(&self) -> Dropped {
        Dropped {
            text_files: self.text.dropped(),
            recording: self.recording.dropped(),
            live: self.live.as_ref().map_or(0, Intake::dropped),
        }
    }
}

/// A run folder that is being filled.
pub struct Recorder {
    run_dir: PathBuf,
    info: Arc<RunInfo>,
    manifest: Manifest,
    text: Worker,
    recording: Worker,
    live: Option<Worker>,
    keeper: Keeper,
    handle: RecorderHandle,
    watches: [Watch; 3],
    faults: Vec<String>,
    /// Tells other processes that the folder is being written.
    lock: Option<File>,
}

impl Recorder {
    /// Makes a new folder in `parent` for the run `info`, with `config.toml` and a manifest
    /// without an outcome, and starts the writers.
    ///
    /// # Errors
    /// [`TelemetryError::Folder`], [`TelemetryError::File`] and [`TelemetryError::Recording`]
    /// when the folder or one of its files cannot be made; then there is no folder.
    pub fn create(
        parent: &Path,
        info: RunInfo,
        backpressure: Backpressure,
    ) -> Result<Recorder, TelemetryError> {
        let run_dir = folder::create(parent, unix_us(info.started_utc), &info.name)?;
        let recorder = Self::fill(run_dir.clone(), info, backpressure);
        recorder.inspect_err(|_| discard(&run_dir))
    }

    fn fill(
        run_dir: PathBuf,
        info: RunInfo,
        backpressure: Backpressure,
    ) -> Result<Recorder, TelemetryError> {
        let started_unix_us = unix_us(info.started_utc);
        let config = run_dir.join(file::CONFIG);
        fs::write(&config, &info.config_toml)
            .map_err(|source| TelemetryError::File { path: config, source })?;
        let lock = folder::lock(&run_dir)?;
        let manifest = manifest_of(&info);
        folder::write_manifest(&run_dir, &manifest)?;
        folder::reserve_manifest(&run_dir)?;
        let (files, mut kept) = TextFiles::create(&run_dir, &info.bus, started_unix_us)?;
        let text = Worker::start(TEXT_FILES, QUEUE_ENTRIES, backpressure, move || Ok(files))?;
        let info = Arc::new(info);
        let recording = {
            let (path, info) = (run_dir.join(file::RECORDING), Arc::clone(&info));
            let manifest = manifest.clone();
            Worker::start(RECORDING, QUEUE_ENTRIES, backpressure, move || {
                Recording::open(&path, &info, &manifest)
            })?
        };
        for name in [file::CONFIG, file::RECORDING] {
            let path = run_dir.join(name);
            let opened = File::open(&path);
            kept.push((name, opened.map_err(|source| TelemetryError::File { path, source })?));
        }
        let keeper = Keeper::start(run_dir.clone(), kept)?;
        let handle = RecorderHandle {
            text: text.intake.clone(),
            recording: recording.intake.clone(),
            live: None,
        };
        let now = Instant::now();
        let watches = [TEXT_FILES, RECORDING, KEEPER]
            .map(|writer| Watch::new(writer, writer == TEXT_FILES, now));
        let faults = Vec::new();
        Ok(Recorder {
            run_dir,
            info,
            manifest,
            text,
            recording,
            live: None,
            keeper,
            handle,
            watches,
            faults,
            lock,
        })
    }

    /// Serves the run to viewers at `address` from now on; call it before the first record. Viewers
    /// never affect the run or its files: what the live view cannot take at once is dropped and
    /// counted.
    ///
    /// # Errors
    /// [`TelemetryError::Live`] when the address cannot be listened at.
    pub fn serve(&mut self, address: SocketAddr) -> Result<(), TelemetryError> {
        let (info, manifest) = (Arc::clone(&self.info), self.manifest.clone());
        let live = Worker::start(LIVE, QUEUE_ENTRIES, Backpressure::DropAndCount, move || {
            Live::open(address, &info, &manifest)
        })?;
        self.handle.live = Some(live.intake.clone());
        self.live = Some(live);
        Ok(())
    }

    /// Takes the folder away again, of a run that cannot begin.
    pub fn discard(self) {
        discard(&self.run_dir);
    }

    /// The run folder.
    pub fn run_dir(&self) -> &Path {
        &self.run_dir
    }

    /// As [`RecorderHandle::record`].
    pub fn record(&self, entry: Entry) {
        self.handle.record(entry);
    }

    /// What has changed of the record since it was last asked; to be asked again until it is
    /// nothing, and some ten times a second at least. A disk that is full, stalls or loses the
    /// folder shows here within a second.
    pub fn news(&mut self) -> Option<RecordNews> {
        let now = Instant::now();
        let [text, recording, keeper] = &mut self.watches;
        let of_writer = |watch: &mut Watch, worker: &Worker| {
            watch.look(&worker.intake.vitals, worker.intake.dropped(), now)
        };
        let news = of_writer(text, &self.text)
            .or_else(|| of_writer(recording, &self.recording))
            .or_else(|| keeper.look(&self.keeper.vitals, 0, now))
            .or_else(|| self.keeper.trouble().map(RecordNews::Failed))?;
        if let RecordNews::Failed(error) = &news {
            self.faults.push(error.to_string());
        }
        Some(news)
    }

    /// Puts the drives found on the bus into the manifest, in its keeper's own time.
    pub fn identify_drives(&mut self, drives: Vec<DriveIdentity>) {
        self.manifest.drives = drives;
        self.keeper.write(&self.manifest);
    }

    /// Completes the files, seals them and writes the final manifest. Takes at most 22 s, even when
    /// a writer or the disk is wedged, and longer only while they show that they go on; entries given
    /// by handles after this are lost. What failed of the record is in the manifest and in what is
    /// given back.
    ///
    /// # Errors
    /// [`TelemetryError`] when the final manifest could not be written, or nobody knows what is in the
    /// text files: the record stays open.
    pub fn finish(
        mut self,
        outcome: &Outcome,
        summary: Summary,
    ) -> Result<Finished, TelemetryError> {
        // What has failed since one last looked.
        while self.news().is_some() {}
        let open = self.manifest.clone();
        self.manifest.set_outcome(outcome);
        self.manifest.ended_utc = Some(utc_text(SystemTime::now()));
        self.manifest.duration_s = Some(summary.end.as_nanos() as f64 / 1e9);
        self.manifest.gates = summary.gates;
        self.manifest.figures = summary.figures;
        self.manifest.timing = summary.timing;
        let [text, recording] = self.close_writers();
        let mut dropped = self.handle.dropped();
        // Whatever became of an entry, it is in the files or it is lost.
        if let Some(entries) = text.left.entries {
            dropped.text_files = self.text.intake.given().saturating_sub(entries);
        }
        let is_recording_done = recording.fault.is_none();
        if let (false, Some(entries)) = (is_recording_done, recording.left.entries) {
            dropped.recording = self.recording.intake.given().saturating_sub(entries);
        }
        let Left { counts, files, entries } = text.left.clone();
        self.note_faults([text.fault.as_ref(), recording.fault.as_ref()]);
        let manifest = Manifest { faults: self.faults.clone(), dropped: Some(dropped), ..open };
        let deadline = Instant::now() + MANIFEST_LIMIT;
        if let (None, Some(silent)) = (entries, text.fault) {
            // The manifest as it was, as far as the keeper gets with it.
            let _ = self.keeper.close(manifest, Vec::new(), deadline);
            self.stay_locked();
            return Err(silent);
        }
        self.manifest.counts = Some(counts);
        self.manifest.dropped = Some(dropped);
        self.manifest.faults = manifest.faults;
        self.manifest.files = files;
        let config = FileSeal::of(self.info.config_toml.as_bytes());
        self.manifest.files.insert(file::CONFIG.to_owned(), config);
        // One whose writer was given up has no seal: rerun may still write to it.
        let read_back = if is_recording_done { vec![file::RECORDING] } else { Vec::new() };
        let manifest = self.manifest.clone();
        match self.keeper.close(manifest, read_back, deadline) {
            Ok(troubles) => self.faults.extend(troubles),
            Err(error) => {
                self.stay_locked();
                return Err(error);
            }
        }
        let bytes = folder_bytes(&self.run_dir);
        Ok(Finished { run_dir: self.run_dir, counts, dropped, faults: self.faults, bytes })
    }

    /// Keeps the lock until the process is gone: a writer that was given up may still write.
    fn stay_locked(&mut self) {
        std::mem::forget(self.lock.take());
    }

    /// Has every writer complete its files. How the text files and the recording ended: a viewer that
    /// fails, or that is left behind, is no fault of the record.
    fn close_writers(&self) -> [Ended; 2] {
        self.keeper.writers_close();
        let closing = Arc::new(Closing { manifest: self.manifest.clone() });
        let [text, recording] = [&self.text, &self.recording].map(|writer| (writer, CLOSING));
        match &self.live {
            None => close_all([text, recording], &closing),
            Some(live) => {
                let [text, recording, _] = close_all([text, recording, (live, FAREWELL)], &closing);
                [text, recording]
            }
        }
    }

    /// Notes what failed and was not noted when it did.
    fn note_faults(&mut self, faults: [Option<&TelemetryError>; 2]) {
        for fault in faults.into_iter().flatten().map(ToString::to_string) {
            if !self.faults.contains(&fault) {
                self.faults.push(fault);
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

/// The manifest of a run that begins.
pub(super) fn manifest_of(info: &RunInfo) -> Manifest {
    Manifest {
        operation: info.operation.clone(),
        arguments: info.arguments.clone(),
        operator: info.operator.clone(),
        phantom: info.phantom.clone(),
        note: info.note.clone(),
        version: info.version.clone(),
        git: info.git.clone(),
        config_sha256: sha256_hex(info.config_toml.as_bytes()),
        calibration_sha256: Some(info.calibration_sha256.clone()),
        bus: info.bus.clone(),
        tracker: info.tracker.clone(),
        seed: info.seed,
        ..Manifest::new(&info.name, utc_text(info.started_utc))
    }
}

/// The size of the files in `dir`; a file that cannot be seen counts as empty.
fn folder_bytes(dir: &Path) -> u64 {
    let Ok(files) = fs::read_dir(dir) else { return 0 };
    files.flatten().filter_map(|file| file.metadata().ok()).map(|file| file.len()).sum()
}
