//! The writer of the text files of a run: `steps.csv`, `can.log`, `tracker.ndjson`, `inputs.log` and
//! `events.log`. It writes whole lines only.

use super::worker::{Sink, WriterResult};
use super::{Entry, TelemetryError};
use crate::archive::{
    CandumpLine, Counts, EventLine, FileSeal, Manifest, StepRow, file, hex, input_line,
    inputs_header, interface_name, steps_csv_header, tracker_line, unix_us, unix_us_of,
};
use crate::session::Record;
use sha2::{Digest, Sha256};
use std::fs::File;
use std::io::{self, Seek as _, Write as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// The writer's name in messages.
pub(super) const WRITER: &str = "text files";

/// Collects lines, passes them to the system at every tick, and syncs them to the disk at the end.
pub(super) struct TextFiles {
    /// In the order of [`file::TEXT_FILES`], so that every recorded input has its frame and sample even if the bench
    /// is killed between the writes of two files.
    files: Vec<TextFile>,
    interface: String,
    started_unix_us: i64,
}

impl TextFiles {
    /// Creates the files in `dir`.
    pub(super) fn create(dir: &Path, manifest: &Manifest) -> Result<Self, TelemetryError> {
        let files = file::TEXT_FILES.map(|name| TextFile::create(name, dir.join(name)));
        let mut files = TextFiles {
            files: files.into_iter().collect::<Result<_, _>>()?,
            interface: interface_name(&manifest.bus),
            started_unix_us: unix_us_of(&manifest.started_utc).unwrap_or_default(),
        };
        files.line(file::STEPS, &steps_csv_header());
        files.tick().map_err(|reason| TelemetryError::writer_failed(WRITER, reason))?;
        Ok(files)
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
            file.file.sync_all().map_err(|error| file.explain(&error))?;
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

/// A file whose lines are collected, written together, and hashed.
struct TextFile {
    name: &'static str,
    path: PathBuf,
    file: File,
    /// Whole lines that were not written yet.
    pending: String,
    hash: Sha256,
    bytes: u64,
    /// Number of lines written.
    lines: u64,
}

impl TextFile {
    /// Creates the file `name` at `path`.
    fn create(name: &'static str, path: PathBuf) -> Result<Self, TelemetryError> {
        let file = File::create_new(&path).map_err(TelemetryError::file(&path))?;
        let (pending, hash) = (String::new(), Sha256::new());
        Ok(TextFile { name, path, file, pending, hash, bytes: 0, lines: 0 })
    }

    /// Adds a line, to be written by [`TextFile::write_pending`].
    fn line(&mut self, line: &str) {
        self.pending.push_str(line);
        self.pending.push('\n');
    }

    /// Writes all pending lines to the operating system: then they survive the end of this process. If the write
    /// fails, a partial line is truncated where possible.
    ///
    /// # Errors
    /// The system's error, with the file's path. Lines that were not written are lost.
    fn write_pending(&mut self) -> Result<(), String> {
        let written = self.file.write_all(self.pending.as_bytes());
        let mut kept = self.pending.as_bytes();
        if written.is_err() {
            // The position shows how much was written before the error.
            let end = self.file.stream_position().unwrap_or(self.bytes);
            kept = &kept[..(end.saturating_sub(self.bytes) as usize).min(kept.len())];
            let whole = kept.iter().rposition(|byte| *byte == b'\n').map_or(0, |end| end + 1);
            if self.file.set_len(self.bytes + whole as u64).is_ok() {
                kept = &kept[..whole];
            }
        }
        self.hash.update(kept);
        self.bytes += kept.len() as u64;
        self.lines += kept.iter().filter(|byte| **byte == b'\n').count() as u64;
        self.pending.clear();
        written.map_err(|error| self.explain(&error))
    }

    /// The seal of the bytes that were written.
    fn seal(&self) -> FileSeal {
        FileSeal { bytes: self.bytes, sha256: hex(&self.hash.clone().finalize()) }
    }

    fn explain(&self, error: &io::Error) -> String {
        format!("{}: {error}", self.path.display())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nix::fcntl::{FcntlArg, SealFlag, fcntl};
    use nix::sys::memfd::{MFdFlags, memfd_create};
    use std::io::{Read as _, SeekFrom};

    /// A file in memory that cannot grow beyond 4096 bytes, as on a full disk.
    fn full_disk(can_cut: bool) -> TextFile {
        let flags = MFdFlags::MFD_CLOEXEC | MFdFlags::MFD_ALLOW_SEALING;
        let file = File::from(memfd_create("full-disk", flags).unwrap());
        file.set_len(4096).unwrap();
        let shrink = if can_cut { SealFlag::empty() } else { SealFlag::F_SEAL_SHRINK };
        fcntl(&file, FcntlArg::F_ADD_SEALS(SealFlag::F_SEAL_GROW | shrink)).unwrap();
        let (name, path) = (file::STEPS, "run/steps.csv".into());
        let (pending, hash) = (String::new(), Sha256::new());
        TextFile { name, path, file, pending, hash, bytes: 0, lines: 0 }
    }

    #[test]
    fn a_full_disk_keeps_whole_lines_and_the_seal_covers_what_is_left() {
        let lines = ["first".to_owned(), "second".to_owned(), "third".repeat(1000)];
        for (can_cut, left_bytes) in [(true, 13), (false, 4096)] {
            let mut file = full_disk(can_cut);
            file.line(&lines[0]);
            file.write_pending().unwrap();
            file.line(&lines[1]);
            file.line(&lines[2]);
            let error = file.write_pending().unwrap_err();
            assert_eq!(error, "run/steps.csv: Operation not permitted (os error 1)");
            let left = &lines.join("\n")[..left_bytes];
            let mut content = String::new();
            file.file.seek(SeekFrom::Start(0)).unwrap();
            file.file.read_to_string(&mut content).unwrap();
            assert_eq!(content, left);
            assert_eq!(file.lines, 2);
            assert_eq!(file.seal(), FileSeal::of(left.as_bytes()));
        }
    }
}
