//! The writer of the text files.

use super::worker::{Closing, Sink};
use super::{Entry, TelemetryError};
use crate::archive::{
    CandumpLine, Counts, InputLine, InputsHeader, STEPS_CSV_HEADER, StepRow, file, interface_name,
    tracker_line,
};
use crate::session::Record;
use std::fs::OpenOptions;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

/// Writes `steps.csv`, `can.log`, `tracker.ndjson` and `inputs.log`, and puts them on disk at every tick.
pub(super) struct TextFiles {
    steps: TextFile,
    can: TextFile,
    tracker: TextFile,
    inputs: TextFile,
    interface: String,
    started_unix_us: i64,
    counts: Counts,
}

impl TextFiles {
    /// Makes the files in `dir`.
    pub(super) fn create(
        dir: &Path,
        bus: &str,
        started_unix_us: i64,
    ) -> Result<Self, TelemetryError> {
        let mut files = TextFiles {
            steps: TextFile::create(dir.join(file::STEPS))?,
            can: TextFile::create(dir.join(file::CAN))?,
            tracker: TextFile::create(dir.join(file::TRACKER))?,
            inputs: TextFile::create(dir.join(file::INPUTS))?,
            interface: interface_name(bus),
            started_unix_us,
            counts: Counts::default(),
        };
        let path = files.steps.path.clone();
        files
            .steps
            .line(STEPS_CSV_HEADER)
            .and_then(|()| files.steps.writer.flush())
            .map_err(|source| TelemetryError::File { path, source })?;
        Ok(files)
    }

    /// Records that leave a line in a text file.
    pub(super) fn wants(record: &Record) -> bool {
        matches!(
            record,
            Record::Begun { .. }
                | Record::Input { .. }
                | Record::Can { .. }
                | Record::Sample(_)
                | Record::Step(_)
        )
    }
}

impl Sink for TextFiles {
    fn take(&mut self, entry: Entry) -> Result<(), String> {
        match &entry.record {
            Record::Begun { time } => {
                self.inputs.line(InputsHeader { begun: *time }).map_err(|e| self.inputs.explain(&e))
            }
            Record::Input { time, input } => self
                .inputs
                .line(InputLine { time: *time, input })
                .map_err(|e| self.inputs.explain(&e)),
            Record::Can { time, direction, frame } => {
                self.counts.can_frames += 1;
                self.can.line(CandumpLine {
                    started_unix_us: self.started_unix_us,
                    interface: &self.interface,
                    time: *time,
                    direction: *direction,
                    frame,
                })
            }
            .map_err(|e| self.can.explain(&e)),
            Record::Sample(sample) => {
                self.counts.tracker_samples += 1;
                tracker_line(sample)
                    .map_err(io::Error::from)
                    .and_then(|line| self.tracker.line(line))
                    .map_err(|e| self.tracker.explain(&e))
            }
            Record::Step(step) => {
                self.counts.steps += 1;
                self.steps
                    .line(StepRow { step, truth: entry.truth.as_ref() })
                    .map_err(|e| self.steps.explain(&e))
            }
            Record::Stage(_)
            | Record::Drive { .. }
            | Record::State { .. }
            | Record::Event { .. } => Ok(()),
        }
    }

    fn tick(&mut self) -> Result<(), String> {
        for file in [&mut self.steps, &mut self.can, &mut self.tracker, &mut self.inputs] {
            file.writer.flush().map_err(|e| file.explain(&e))?;
        }
        Ok(())
    }

    fn close(&mut self, _: &Closing) -> Result<Counts, String> {
        self.tick()?;
        for file in [&self.steps, &self.can, &self.tracker, &self.inputs] {
            file.writer.get_ref().sync_all().map_err(|e| file.explain(&e))?;
        }
        Ok(self.counts)
    }
}

struct TextFile {
    path: PathBuf,
    writer: BufWriter<std::fs::File>,
}

impl TextFile {
    fn create(path: PathBuf) -> Result<Self, TelemetryError> {
        match OpenOptions::new().write(true).create_new(true).open(&path) {
            Ok(file) => Ok(TextFile { path, writer: BufWriter::new(file) }),
            Err(source) => Err(TelemetryError::File { path, source }),
        }
    }

    fn line(&mut self, line: impl std::fmt::Display) -> io::Result<()> {
        writeln!(self.writer, "{line}")
    }

    fn explain(&self, error: &io::Error) -> String {
        format!("{}: {error}", self.path.display())
    }
}
