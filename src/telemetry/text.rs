//! The text files of a run: the writer of `steps.csv`, `can.log`, `tracker.ndjson`, `inputs.log` and
//! `events.log`.

use super::keeper::Kept;
use super::text_file::TextFile;
use super::worker::{Left, Sink};
use super::{Entry, TelemetryError};
use crate::archive::{
    CandumpLine, Counts, EventLine, InputLine, InputsHeader, Manifest, StepRow, file,
    interface_name, steps_csv_header, tracker_line,
};
use crate::session::Record;
use std::fs::{File, OpenOptions};
use std::path::Path;

/// The writer's name in messages.
pub(super) const TEXT_FILES: &str = "text files";

/// Collects lines, hands them to the system at every tick, and syncs them to the disk at the end.
pub(super) struct TextFiles {
    steps: TextFile<File>,
    can: TextFile<File>,
    tracker: TextFile<File>,
    inputs: TextFile<File>,
    events: TextFile<File>,
    interface: String,
    started_unix_us: i64,
}

impl TextFiles {
    /// Makes the files in `dir`; gives them, and their handles by name for the keeper.
    pub(super) fn create(
        dir: &Path,
        bus: &str,
        started_unix_us: i64,
    ) -> Result<(Self, Vec<Kept>), TelemetryError> {
        let mut kept = Vec::new();
        let mut text_file = |name| {
            let path = dir.join(name);
            let mut open = || {
                let storage = OpenOptions::new().write(true).create_new(true).open(&path)?;
                kept.push((name, storage.try_clone()?));
                Ok(TextFile::new(dir, name, storage))
            };
            open().map_err(TelemetryError::file(&path))
        };
        let mut files = TextFiles {
            steps: text_file(file::STEPS)?,
            can: text_file(file::CAN)?,
            tracker: text_file(file::TRACKER)?,
            inputs: text_file(file::INPUTS)?,
            events: text_file(file::EVENTS)?,
            interface: interface_name(bus),
            started_unix_us,
        };
        files.steps.line(steps_csv_header());
        match files.tick() {
            Ok(()) => Ok((files, kept)),
            Err(reason) => Err(TelemetryError::WriterFailed { writer: TEXT_FILES, reason }),
        }
    }

    /// Whether `record` leaves a line in a text file.
    pub(super) fn wants(record: &Record) -> bool {
        !matches!(record, Record::Stage(_) | Record::Drive { .. })
    }

    /// In this order, so that a kill between two of them leaves no input without its frame.
    fn each(&mut self) -> [&mut TextFile<File>; 5] {
        let TextFiles { steps, can, tracker, inputs, events, .. } = self;
        [can, tracker, inputs, steps, events]
    }
}

impl Sink for TextFiles {
    fn take(&mut self, entry: Entry) -> Result<(), String> {
        match &entry.record {
            Record::Begun { time } => self.inputs.line(InputsHeader { begun: *time }),
            Record::Input { time, input } => self.inputs.line(InputLine { time: *time, input }),
            Record::Can { time, direction, frame } => self.can.line(CandumpLine {
                started_unix_us: self.started_unix_us,
                interface: &self.interface,
                time: *time,
                direction: *direction,
                frame,
            }),
            Record::Sample(sample) | Record::Target(sample) => {
                let line = tracker_line(sample).map_err(|e| format!("{}: {e}", file::TRACKER))?;
                self.tracker.line(line);
            }
            Record::Step(step) => {
                self.steps.line(StepRow { step, truth: entry.truth.as_ref() });
            }
            Record::State { .. } | Record::Event { .. } => {
                EventLine::of(&entry.record).into_iter().for_each(|line| self.events.line(line));
            }
            Record::Stage(_) | Record::Drive { .. } => {}
        }
        Ok(())
    }

    fn tick(&mut self) -> Result<(), String> {
        self.each().into_iter().try_for_each(TextFile::hand_over)
    }

    fn close(&mut self, _: &Manifest, alive: &dyn Fn()) -> Result<(), String> {
        self.tick()?;
        self.each().into_iter().try_for_each(|file| {
            alive();
            file.sync()
        })
    }

    fn left(&self) -> Left {
        let header = 1;
        let counts = Counts {
            can_frames: self.can.lines(),
            tracker_samples: self.tracker.lines(),
            steps: self.steps.lines().saturating_sub(header),
            events: self.events.lines(),
        };
        let files = [&self.can, &self.tracker, &self.inputs, &self.steps, &self.events];
        // A line an entry, and the header.
        let lines: u64 = files.iter().map(|file| file.lines()).sum();
        Left {
            counts,
            files: files.map(TextFile::seal).into(),
            entries: lines.saturating_sub(header),
        }
    }
}
