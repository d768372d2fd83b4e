//! The writer of the text files.

use super::keeper::Kept;
use super::text_file::{Storage, TextFile};
use super::worker::{Closing, Left, Sink};
use super::{Entry, TelemetryError};
use crate::archive::{
    CandumpLine, Counts, EventLine, InputLine, InputsHeader, STEPS_CSV_HEADER, StepRow, file,
    interface_name, tracker_line,
};
use crate::session::Record;
use std::fs::{File, OpenOptions};
use std::io;
use std::path::Path;

/// The writer's name in messages.
pub(super) const TEXT_FILES: &str = "text files";

/// Writes `steps.csv`, `can.log`, `tracker.ndjson`, `inputs.log` and `events.log`: hands them over to
/// the system at every tick, and puts them on the disk at the end.
pub(super) struct TextFiles<S = File> {
    steps: TextFile<S>,
    can: TextFile<S>,
    tracker: TextFile<S>,
    inputs: TextFile<S>,
    events: TextFile<S>,
    interface: String,
    started_unix_us: i64,
}

impl TextFiles {
    /// Makes the files in `dir`; gives them, and what they are kept in, by name.
    pub(super) fn create(
        dir: &Path,
        bus: &str,
        started_unix_us: i64,
    ) -> Result<(Self, Vec<Kept>), TelemetryError> {
        let mut kept = Vec::new();
        let files = TextFiles::open(dir, bus, started_unix_us, |name| {
            let storage = OpenOptions::new().write(true).create_new(true).open(dir.join(name))?;
            kept.push((name, storage.try_clone()?));
            Ok(storage)
        })?;
        Ok((files, kept))
    }

    /// Records that leave a line in a text file.
    pub(super) fn wants(record: &Record) -> bool {
        !matches!(record, Record::Stage(_) | Record::Drive { .. })
    }
}

impl<S: Storage> TextFiles<S> {
    /// The files in `dir`, each in what `storage` gives for its name.
    fn open(
        dir: &Path,
        bus: &str,
        started_unix_us: i64,
        mut storage: impl FnMut(&'static str) -> io::Result<S>,
    ) -> Result<Self, TelemetryError> {
        let mut text_file = |name| match storage(name) {
            Ok(storage) => Ok(TextFile::new(dir, name, storage)),
            Err(source) => Err(TelemetryError::File { path: dir.join(name), source }),
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
        files.steps.line(STEPS_CSV_HEADER);
        match files.tick() {
            Ok(()) => Ok(files),
            Err(reason) => Err(TelemetryError::WriterFailed { writer: TEXT_FILES, reason }),
        }
    }

    /// Each after those it speaks of: a kill in the midst of them leaves no input without its frame.
    fn each(&mut self) -> [&mut TextFile<S>; 5] {
        let TextFiles { steps, can, tracker, inputs, events, .. } = self;
        [can, tracker, inputs, steps, events]
    }
}

impl<S: Storage> Sink for TextFiles<S> {
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
            Record::Sample(sample) => {
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

    fn close(&mut self, _: &Closing, alive: &dyn Fn()) -> Result<(), String> {
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
        let entries = Some(lines.saturating_sub(header));
        Left { counts, files: files.map(TextFile::seal).into(), entries }
    }
}
