//! The writer of the text files of a run: `steps.csv`, `can.log`, `tracker.ndjson`, `inputs.log` and
//! `events.log`. It writes whole lines only.

use super::keeper::OpenPath;
use super::worker::{Sink, WriterResult};
use super::{Entry, TelemetryError};
use crate::archive::{
    CandumpLine, Counts, EventLine, FileSeal, Manifest, StepRow, file, hex, input_line,
    inputs_header, interface_name, steps_csv_header, tracker_line, unix_us, unix_us_of,
};
use crate::session::Record;
use sha2::{Digest, Sha256};
use std::fs::File;
use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// The writer's name in messages.
pub(super) const WRITER: &str = "text files";

/// Collects lines, passes them to the system at every tick, and syncs them to the disk at the end.
pub(super) struct TextFiles {
    /// In the order of [`file::TEXT_FILES`]: if the bench is killed between two files, every input has its frame.
    files: Vec<TextFile<File>>,
    interface: String,
    started_unix_us: i64,
}

impl TextFiles {
    /// Creates the files in `dir`. Returns the writer, and a second handle of each file for the keeper.
    pub(super) fn create(
        dir: &Path,
        manifest: &Manifest,
    ) -> Result<(Self, Vec<OpenPath>), TelemetryError> {
        let (mut files, mut for_keeper) = (Vec::new(), Vec::new());
        for name in file::TEXT_FILES {
            let path = dir.join(name);
            let storage = File::create_new(&path).map_err(TelemetryError::file(&path))?;
            let second_handle = storage.try_clone().map_err(TelemetryError::file(&path))?;
            for_keeper.push((path.clone(), second_handle));
            files.push(TextFile::new(name, path, storage));
        }
        let mut files = TextFiles {
            files,
            interface: interface_name(&manifest.bus),
            started_unix_us: unix_us_of(&manifest.started_utc).unwrap_or_default(),
        };
        files.line(file::STEPS, &steps_csv_header());
        files.tick().map_err(|reason| TelemetryError::writer_failed(WRITER, reason))?;
        Ok((files, for_keeper))
    }

    /// True if `record` becomes a line of a text file.
    pub(super) fn wants(record: &Record) -> bool {
        !matches!(record, Record::Stage(_) | Record::Drive { .. })
    }

    /// Adds a line to the file `name`.
    fn line(&mut self, name: &str, line: &str) {
        if let Some(file) = self.files.iter_mut().find(|file| file.name == name) {
            file.line(line);
        }
    }
}

impl Sink for TextFiles {
    type Item = Entry;
    /// A killed bench loses at most the lines of one interval.
    const TICK: Duration = Duration::from_millis(50);

    fn take(&mut self, entry: Entry) -> Result<(), String> {
        let (name, line) = match &entry.record {
            Record::Begun { time } => (file::INPUTS, inputs_header(*time)),
            Record::Input { time, input } => (file::INPUTS, input_line(*time, input)),
            Record::Can { time, direction, frame } => {
                let unix_us = unix_us(self.started_unix_us, *time);
                let (interface, direction, frame) = (&*self.interface, *direction, *frame);
                let line = CandumpLine { unix_us, interface, direction, frame };
                (file::CAN, line.to_string())
            }
            Record::Sample(sample) | Record::Target(sample) => {
                let line = tracker_line(sample).map_err(|e| format!("{}: {e}", file::TRACKER))?;
                (file::TRACKER, line)
            }
            Record::Step(step) => {
                (file::STEPS, StepRow::new(step, entry.truth.as_ref()).to_string())
            }
            record => match EventLine::of(record) {
                Some(line) => (file::EVENTS, line.to_string()),
                None => return Ok(()),
            },
        };
        self.line(name, &line);
        Ok(())
    }

    fn tick(&mut self) -> Result<(), String> {
        self.files.iter_mut().try_for_each(TextFile::write_pending)
    }

    fn close(&mut self, _: &Manifest, alive: &dyn Fn()) -> Result<(), String> {
        self.tick()?;
        for file in &self.files {
            alive();
            file.storage.sync_all().map_err(|error| file.explain(&error))?;
        }
        Ok(())
    }

    fn result(&self) -> WriterResult {
        let lines = |name: &str| {
            self.files.iter().filter(|file| file.name == name).map(|file| file.lines).sum()
        };
        // Each entry is one line; the header of `steps.csv` is no entry.
        let entries = self.files.iter().map(|file| file.lines).sum::<u64>().saturating_sub(1);
        let seals = self.files.iter().map(|file| (file.name.to_owned(), file.seal()));
        WriterResult { counts: Counts::of_lines(lines), files: seals.collect(), entries }
    }
}

/// What a text file is written to.
trait Storage: Write {
    /// Truncates to the first `bytes`.
    fn truncate(&self, bytes: u64) -> io::Result<()>;
}

impl Storage for File {
    fn truncate(&self, bytes: u64) -> io::Result<()> {
        self.set_len(bytes)
    }
}

/// A file whose lines are collected, written together, and hashed.
struct TextFile<S> {
    name: &'static str,
    path: PathBuf,
    storage: S,
    /// Whole lines that were not written yet.
    pending: String,
    hash: Sha256,
    bytes: u64,
    /// Number of lines written.
    lines: u64,
}

impl<S: Storage> TextFile<S> {
    /// The file `name` at `path`, with an empty `storage`.
    fn new(name: &'static str, path: PathBuf, storage: S) -> Self {
        let (pending, hash) = (String::new(), Sha256::new());
        TextFile { name, path, storage, pending, hash, bytes: 0, lines: 0 }
    }

    /// Adds a line, to be written by [`TextFile::write_pending`].
    fn line(&mut self, line: &str) {
        self.pending.push_str(line);
        self.pending.push('\n');
    }

    /// Writes all pending lines to the operating system: from then on they survive the end of this process. A
    /// partial line is truncated if possible.
    ///
    /// # Errors
    /// The system's error, with the file's path. Lines that were not written are lost.
    fn write_pending(&mut self) -> Result<(), String> {
        let bytes = self.pending.as_bytes();
        let (taken, result) = write_until_error(&mut self.storage, bytes);
        let mut kept = &bytes[..taken];
        if result.is_err() {
            let whole = kept.iter().rposition(|byte| *byte == b'\n').map_or(0, |end| end + 1);
            if self.storage.truncate(self.bytes + whole as u64).is_ok() {
                kept = &kept[..whole];
            }
        }
        self.hash.update(kept);
        self.bytes += kept.len() as u64;
        self.lines += kept.iter().filter(|byte| **byte == b'\n').count() as u64;
        self.pending.clear();
        result.map_err(|error| self.explain(&error))
    }

    /// The seal of the bytes that were written.
    fn seal(&self) -> FileSeal {
        FileSeal { bytes: self.bytes, sha256: hex(&self.hash.clone().finalize()) }
    }

    fn explain(&self, error: &io::Error) -> String {
        format!("{}: {error}", self.path.display())
    }
}

/// Writes `bytes`. Returns how many were written, and the error that stopped it.
fn write_until_error(storage: &mut impl Write, bytes: &[u8]) -> (usize, io::Result<()>) {
    let mut taken = 0;
    while taken < bytes.len() {
        match storage.write(&bytes[taken..]) {
            Ok(0) => return (taken, Err(ErrorKind::WriteZero.into())),
            Ok(n) => taken += n,
            Err(e) if e.kind() == ErrorKind::Interrupted => {}
            Err(e) => return (taken, Err(e)),
        }
    }
    (taken, Ok(()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::archive::sha256_hex;
    use std::sync::{Arc, Mutex};

    /// A disk with room for `room` bytes.
    #[derive(Clone)]
    struct SmallDisk {
        content: Arc<Mutex<Vec<u8>>>,
        room: usize,
        can_cut: bool,
    }

    impl SmallDisk {
        fn new(room: usize) -> Self {
            SmallDisk { content: Arc::default(), room, can_cut: true }
        }
    }

    impl Write for SmallDisk {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            let mut content = self.content.lock().unwrap();
            let taken = bytes.len().min(self.room - content.len());
            content.extend(&bytes[..taken]);
            if taken > 0 { Ok(taken) } else { Err(ErrorKind::StorageFull.into()) }
        }
        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    impl Storage for SmallDisk {
        fn truncate(&self, bytes: u64) -> io::Result<()> {
            if !self.can_cut {
                return Err(ErrorKind::ReadOnlyFilesystem.into());
            }
            self.content.lock().unwrap().truncate(bytes as usize);
            Ok(())
        }
    }

    #[test]
    fn a_full_disk_keeps_whole_lines_and_the_seal_covers_what_is_left() {
        for (can_cut, left) in [(true, "first\nsecond\n"), (false, "first\nsecond\nthi")] {
            let disk = SmallDisk { can_cut, ..SmallDisk::new(16) };
            let mut file = TextFile::new(file::STEPS, "run/steps.csv".into(), disk.clone());
            file.line("first");
            file.write_pending().unwrap();
            file.line("second");
            file.line("third");
            assert_eq!(file.write_pending().unwrap_err(), "run/steps.csv: no storage space");
            assert_eq!(*disk.content.lock().unwrap(), left.as_bytes());
            assert_eq!(file.lines, 2);
            let seal = FileSeal { bytes: left.len() as u64, sha256: sha256_hex(left.as_bytes()) };
            assert_eq!(file.seal(), seal);
        }
    }
}
