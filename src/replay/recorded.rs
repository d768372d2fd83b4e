//! The record of a run, read while it is replayed.

use crate::archive::{
    CandumpLine, Inputs, Lines, Manifest, RecordedColumns, RunOutcome, file, unix_us_of,
};
use crate::canopen::Frame;
use crate::operation::RunConfig;
use crate::session::{Direction, Outcome};
use crate::tracker::ndjson;
use crate::units::Time;
use std::io;

/// A recorded run. Its text files are read line by line during the replay, so that a long run takes no more
/// memory than a short one.
pub struct Recorded<'a> {
    /// Its manifest.
    pub manifest: &'a Manifest,
    /// The settings of the run: an insertion or an operation.
    pub run_config: RunConfig,
    /// Opens the text file of this name.
    pub open: &'a dyn Fn(&str) -> io::Result<Lines>,
}

impl Recorded<'_> {
    pub(super) fn lines(&self, name: &'static str) -> Result<Lines, String> {
        (self.open)(name).map_err(|error| format!("{name}: {error}"))
    }

    /// The inputs of the session.
    pub(super) fn inputs(&self) -> Result<Inputs, String> {
        Inputs::read(self.lines(file::INPUTS)?)
    }

    /// The lines of the file `name` with their numbers, from 1.
    pub(super) fn numbered(&self, name: &'static str) -> Result<NumberedLines, String> {
        let unreadable = move |error: io::Error| format!("{name}: {error}");
        let lines = self.lines(name)?.zip(1..);
        Ok(Box::new(lines.map(move |(text, line)| Ok((line, text.map_err(unreadable)?)))))
    }

    /// UTC of the run's origin, µs since 1970.
    pub(super) fn started_unix_us(&self) -> Result<i64, String> {
        let started_utc = &self.manifest.started_utc;
        unix_us_of(started_utc)
            .ok_or_else(|| format!("{}: started_utc is {started_utc:?}, no time", file::MANIFEST))
    }

    /// The frames of `can.log` in this direction.
    pub(super) fn frames(&self, wanted: Direction) -> Result<Entries<LoggedFrame>, String> {
        let parse = |(line, text): (usize, String)| match CandumpLine::parse(&text) {
            Some(CandumpLine { unix_us, direction, frame, .. }) => {
                Ok((direction, LoggedFrame { line, unix_us, frame, text }))
            }
            None => Err(format!(
                "{} line {line}: {text:?} is not a frame as candump -L -x writes it",
                file::CAN
            )),
        };
        Entries::new(self.numbered(file::CAN)?.filter_map(move |numbered| {
            let logged = numbered.and_then(parse);
            logged.map(|(direction, frame)| (direction == wanted).then_some(frame)).transpose()
        }))
    }

    /// How the run ended; `None` for a truncated record: one that a repair closed, or whose writer failed.
    pub(super) fn outcome(&self) -> Option<Outcome> {
        let Manifest { outcome, stop_reason, repaired_utc, counts, .. } = self.manifest;
        let is_whole = repaired_utc.is_none() && counts.is_some();
        outcome.filter(|_| is_whole).map(|outcome| match outcome {
            RunOutcome::Completed => Outcome::Completed,
            RunOutcome::Stopped => Outcome::Stopped(stop_reason.clone().unwrap_or_default()),
        })
    }

    /// The time of the last entry of the record, in any of its files.
    pub(super) fn end(&self, columns: &RecordedColumns) -> Result<Time, String> {
        let started_unix_us = self.started_unix_us()?;
        let last = |name| -> Result<Option<String>, String> {
            Ok(self.numbered(name)?.last().transpose()?.map(|(_, text)| text))
        };
        let frame = last(file::CAN)?;
        let frame = frame.and_then(|line| Some(CandumpLine::parse(&line)?.time(started_unix_us)));
        let sample = last(file::TRACKER)?.and_then(|line| ndjson::recorded(1, &line).ok());
        let step = last(file::STEPS)?.and_then(|row| columns.time(&row));
        let inputs = self.inputs()?;
        let begun = inputs.begun;
        let input = inputs.last().transpose()?.map(|(time, _)| time);
        let times = [frame, sample.map(|sample| sample.receive_time), step, input];
        Ok(times.into_iter().flatten().fold(begun, Time::max))
    }
}

/// Lines of a file with their numbers, from 1.
type NumberedLines = Box<dyn Iterator<Item = Result<(usize, String), String>>>;

/// A frame of `can.log` with its line.
pub(super) struct LoggedFrame {
    /// Number of the line, from 1.
    pub(super) line: usize,
    pub(super) text: String,
    pub(super) unix_us: i64,
    pub(super) frame: Frame,
}

/// The entries of a file in order; the next one can be peeked at.
pub(super) struct Entries<T> {
    entries: Box<dyn Iterator<Item = Result<T, String>>>,
    next: Option<T>,
    /// Entries taken so far.
    pub(super) taken: usize,
}

impl<T> Entries<T> {
    pub(super) fn new(
        mut entries: impl Iterator<Item = Result<T, String>> + 'static,
    ) -> Result<Self, String> {
        let next = entries.next().transpose()?;
        Ok(Entries { entries: Box::new(entries), next, taken: 0 })
    }

    /// The next entry, which stays.
    pub(super) fn peek(&self) -> Option<&T> {
        self.next.as_ref()
    }

    /// Takes the next entry; `None` at the end of the file.
    pub(super) fn take(&mut self) -> Result<Option<T>, String> {
        let taken = self.next.take();
        if taken.is_some() {
            self.taken += 1;
            self.next = self.entries.next().transpose()?;
        }
        Ok(taken)
    }
}
