//! The recorder: a run folder and the threads that fill it.

use super::recording::Recording;
use super::text::TextFiles;
use super::worker::{Backpressure, Closing, Intake, Worker};
use super::{Entry, RunInfo, TelemetryError, folder};
use crate::archive::{
    Counts, DriveIdentity, Dropped, Manifest, file, rfc3339, sha256_hex, unix_us,
};
use crate::session::Outcome;
use crate::units::Time;
use serde_json::{Map, Value};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

/// Entries a queue holds: about 13 s of a run at 10 ms SYNC.
const QUEUE_ENTRIES: usize = 8192;
/// Writers are given this long to complete their files at the end of a run.
const CLOSE_LIMIT: Duration = Duration::from_secs(15);

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
    /// Records lost to full queues.
    pub dropped: Dropped,
    /// Size of the folder, bytes.
    pub bytes: u64,
}

/// Gives records to the writers from any thread.
#[derive(Clone)]
pub struct RecorderHandle {
    text: Intake,
    recording: Intake,
}

impl RecorderHandle {
    /// Keeps `entry`. Takes about a microsecond; with [`Backpressure::DropAndCount`] it never waits.
    pub fn record(&self, entry: Entry) {
        if TextFiles::wants(&entry.record) {
            self.text.give(entry.clone());
        }
        self.recording.give(entry);
    }

    /// Whether both writers live. A full disk shows here within a second, a stalled one within
    /// three.
    ///
    /// # Errors
    /// [`TelemetryError::WriterFailed`] and [`TelemetryError::WriterSilent`]: what is recorded
    /// from now on is lost, so a live run should be stopped.
    pub fn health(&self) -> Result<(), TelemetryError> {
        self.text.health().and_then(|()| self.recording.health())
    }

    /// Records lost so far.
    pub fn dropped(&self) -> Dropped {
        Dropped { text_files: self.text.dropped(), recording: self.recording.dropped() }
    }
}

/// A run folder that is being filled.
pub struct Recorder {
    run_dir: PathBuf,
    manifest: Manifest,
    text: Worker,
    recording: Worker,
    handle: RecorderHandle,
}

impl Recorder {
    /// Makes a new folder in `parent` for the run `info`, with `config.toml` and a manifest
    /// without an outcome, and starts the writers.
    ///
    /// # Errors
    /// [`TelemetryError::Folder`], [`TelemetryError::File`] and [`TelemetryError::Recording`]
    /// when the folder or one of its files cannot be made.
    pub fn create(
        parent: &Path,
        info: RunInfo,
        backpressure: Backpressure,
    ) -> Result<Recorder, TelemetryError> {
        let started_unix_us = unix_us(info.started_utc);
        let run_dir = folder::create(parent, started_unix_us, &info.name)?;
        let config = run_dir.join(file::CONFIG);
        fs::write(&config, &info.config_toml)
            .map_err(|source| TelemetryError::File { path: config, source })?;
        let manifest = manifest_of(&info);
        folder::write_manifest(&run_dir, &manifest)?;
        let text = {
            let (dir, bus) = (run_dir.clone(), info.bus.clone());
            Worker::start("text files", QUEUE_ENTRIES, backpressure, move || {
                TextFiles::create(&dir, &bus, started_unix_us)
            })?
        };
        let recording = {
            let (path, manifest) = (run_dir.join(file::RECORDING), manifest.clone());
            Worker::start("recording", QUEUE_ENTRIES, backpressure, move || {
                Recording::open(&path, &info, &manifest)
            })?
        };
        let handle =
            RecorderHandle { text: text.intake.clone(), recording: recording.intake.clone() };
        Ok(Recorder { run_dir, manifest, text, recording, handle })
    }

    /// The run folder.
    pub fn run_dir(&self) -> &Path {
        &self.run_dir
    }

    /// A handle for another thread.
    pub fn handle(&self) -> RecorderHandle {
        self.handle.clone()
    }

    /// As [`RecorderHandle::record`].
    pub fn record(&self, entry: Entry) {
        self.handle.record(entry);
    }

    /// As [`RecorderHandle::health`].
    ///
    /// # Errors
    /// As [`RecorderHandle::health`].
    pub fn health(&self) -> Result<(), TelemetryError> {
        self.handle.health()
    }

    /// Puts the drives found on the bus into the manifest. Writes a small file: for the bring-up,
    /// before anything moves.
    ///
    /// # Errors
    /// [`TelemetryError::File`].
    pub fn identify_drives(&mut self, drives: Vec<DriveIdentity>) -> Result<(), TelemetryError> {
        self.manifest.drives = drives;
        folder::write_manifest(&self.run_dir, &self.manifest)
    }

    /// Completes the files and writes the final manifest. Takes at most 15 s, even when a writer
    /// is wedged; entries given by handles after this are lost.
    ///
    /// # Errors
    /// The first failure of a writer or of the manifest; the manifest names them all where it
    /// could still be written.
    pub fn finish(
        mut self,
        outcome: &Outcome,
        summary: Summary,
    ) -> Result<Finished, TelemetryError> {
        self.manifest.set_outcome(outcome);
        self.manifest.ended_utc = Some(rfc3339(unix_us(SystemTime::now())));
        self.manifest.duration_s = Some(summary.end.as_nanos() as f64 / 1e9);
        self.manifest.gates = summary.gates;
        self.manifest.figures = summary.figures;
        self.manifest.timing = summary.timing;
        let closing = Arc::new(Closing { manifest: self.manifest.clone() });
        let deadline = Instant::now() + CLOSE_LIMIT;
        self.text.close(&closing, deadline);
        self.recording.close(&closing, deadline);
        let (text, recording) = (self.text.join(deadline), self.recording.join(deadline));
        let dropped = self.handle.dropped();
        self.manifest.counts = text.as_ref().ok().copied();
        self.manifest.dropped = Some(dropped);
        let faults = [text.as_ref().err(), recording.as_ref().err()];
        self.manifest.faults = faults.into_iter().flatten().map(ToString::to_string).collect();
        folder::write_manifest(&self.run_dir, &self.manifest)?;
        let counts = text?;
        recording?;
        let bytes = folder_bytes(&self.run_dir);
        Ok(Finished { run_dir: self.run_dir, counts, dropped, bytes })
    }
}

/// The manifest of a run that begins.
pub(super) fn manifest_of(info: &RunInfo) -> Manifest {
    Manifest {
        operation: info.operation.clone(),
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
        ..Manifest::new(&info.name, rfc3339(unix_us(info.started_utc)))
    }
}

/// The size of the files in `dir`; a file that cannot be seen counts as empty.
fn folder_bytes(dir: &Path) -> u64 {
    let Ok(files) = fs::read_dir(dir) else { return 0 };
    files.flatten().filter_map(|file| file.metadata().ok()).map(|file| file.len()).sum()
}
