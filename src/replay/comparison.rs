//! Compares the output of a replayed session with the record.

use super::inputs::unsent_unix_us;
use super::recorded::{Entries, LoggedFrame, Recorded};
use crate::archive::{
    CandumpLine, RecordedColumns, StepRow, file, is_truth_column, steps_csv_header, tracker_line,
    unix_us,
};
use crate::canopen::Frame;
use crate::session::{Direction, Input, Outcome, SampleRecord, StepRecord};
use crate::units::Time;

/// Compares frames, samples and steps in the order in which the session outputs them, and keeps the first
/// difference.
pub(super) struct Comparison<'a> {
    recorded: &'a Recorded<'a>,
    started_unix_us: i64,
    /// How the run ended; `None` for a truncated record, which ends before its run did.
    outcome: Option<Outcome>,
    unsent_unix_us: Vec<i64>,
    pub(super) sent: Entries<LoggedFrame>,
    pub(super) samples: Entries<String>,
    pub(super) columns: RecordedColumns,
    pub(super) rows: Entries<String>,
    /// The first difference, in words.
    pub(super) difference: Option<String>,
    /// In a truncated record: the first file that ended, and the time of its first missing entry.
    pub(super) first_end: Option<(Time, &'static str)>,
}

impl<'a> Comparison<'a> {
    pub(super) fn open(recorded: &'a Recorded<'a>) -> Result<Self, String> {
        let text = |numbered: Result<(usize, String), String>| Ok(numbered?.1);
        let mut rows = recorded.numbered(file::STEPS)?.map(text);
        let columns = match rows.next().transpose()? {
            None => RecordedColumns::default(),
            // An older record lacks the columns that were added at the end since.
            Some(header) if !(steps_csv_header() + ",").starts_with(&format!("{header},")) => {
                return Err(format!(
                    "{} begins with {header:?}: not the columns of this bench",
                    file::STEPS
                ));
            }
            Some(header) => RecordedColumns::of(&header),
        };
        Ok(Comparison {
            recorded,
            started_unix_us: recorded.started_unix_us()?,
            outcome: recorded.outcome(),
            unsent_unix_us: unsent_unix_us(recorded)?,
            sent: recorded.frames(Direction::Sent)?,
            samples: Entries::new(recorded.numbered(file::TRACKER)?.map(text))?,
            columns,
            rows: Entries::new(rows)?,
            difference: None,
            first_end: None,
        })
    }

    /// True for a truncated record: what the replay outputs after its end is no difference.
    pub(super) fn is_truncated(&self) -> bool {
        self.outcome.is_none()
    }

    /// Notes that `file` of a truncated record holds nothing from `time` on.
    pub(super) fn note_end(&mut self, file: &'static str, time: Time) {
        self.first_end.get_or_insert((time, file));
    }

    /// Notes that a line of `file`, numbered from 1, differs from the replayed one. A side that has no such
    /// line is `None`.
    fn note_difference(
        &mut self,
        file: &str,
        line: usize,
        recorded: Option<&str>,
        replayed: Option<&str>,
    ) {
        let [recorded, replayed] = [recorded, replayed].map(|text| text.unwrap_or("nothing more"));
        let words = format!("{file} line {line}: recorded {recorded}, replayed {replayed}");
        self.difference.get_or_insert(words);
    }

    /// Compares a frame that the session sends in answer to `input`.
    pub(super) fn check_sent(
        &mut self,
        time: Time,
        frame: &Frame,
        input: Option<&Input>,
    ) -> Result<(), String> {
        let recorded = self.sent.peek();
        let logged = recorded.and_then(|logged| CandumpLine::parse(&logged.text));
        let interface = logged.map_or("can", |logged| logged.interface);
        let (unix_us, direction) = (unix_us(self.started_unix_us, time), Direction::Sent);
        let line = CandumpLine { unix_us, interface, direction, frame: *frame }.to_string();
        match recorded {
            Some(logged) if logged.text == line => drop(self.sent.take()?),
            _ if self.may_be_unsent(time, input) => {}
            None if self.is_truncated() => self.note_end(file::CAN, time),
            _ => {
                let (number, recorded) = match self.sent.take()? {
                    Some(logged) => (logged.line, Some(logged.text)),
                    None => (self.recorded.lines(file::CAN)?.count() + 1, None),
                };
                self.note_difference(file::CAN, number, recorded.as_deref(), Some(&line));
            }
        }
        Ok(())
    }

    /// True if a frame that the session output at `time` in answer to `input` may be missing from `can.log`. The
    /// log lacks frames that the bus refused, and frames that the bench discarded because its control loop had
    /// stalled. In both cases the session gets an input that says so before it sends anything else. The bus may
    /// also refuse a frame that answers a fault of the bus.
    fn may_be_unsent(&self, time: Time, input: Option<&Input>) -> bool {
        let sent_us = unix_us(self.started_unix_us, time);
        let next_us = self.sent.peek().map_or(i64::MAX, |logged| logged.unix_us);
        let mut faults = self.unsent_unix_us.iter();
        matches!(input, Some(Input::BusFault(_)))
            || faults.any(|fault_us| (sent_us..=next_us).contains(fault_us))
    }

    /// Compares a sample as the session records it.
    pub(super) fn check_sample(&mut self, sample: &SampleRecord) -> Result<(), String> {
        // A sample that JSON cannot hold could not have been recorded either.
        let line = tracker_line(sample).unwrap_or_default();
        let number = self.samples.taken + 1;
        match self.samples.take()? {
            Some(recorded) if recorded == line => {}
            None if self.is_truncated() => {
                self.note_end(file::TRACKER, sample.received.receive_time);
            }
            recorded => {
                self.note_difference(file::TRACKER, number, recorded.as_deref(), Some(&line))
            }
        }
        Ok(())
    }

    /// Compares a step of the session; returns its recorded row.
    pub(super) fn check_step(&mut self, step: &StepRecord) -> Result<Option<String>, String> {
        let replayed = StepRow::new(step, None).to_string();
        // The header is line 1.
        let line = self.rows.taken + 2;
        let Some(recorded) = self.rows.take()? else {
            match self.is_truncated() {
                true => self.note_end(file::STEPS, step.time),
                false => self.note_difference(file::STEPS, line, None, Some(&replayed)),
            }
            return Ok(None);
        };
        if recorded.split(',').count() != self.columns.0.len() {
            self.note_difference(file::STEPS, line, Some(&recorded), Some(&replayed));
        } else if let Some(difference) = self.differing_value(line, &recorded, &replayed) {
            self.difference.get_or_insert(difference);
        }
        Ok(Some(recorded))
    }

    /// The first value in which two rows differ, in words; the truth is not compared.
    fn differing_value(&self, line: usize, recorded: &str, replayed: &str) -> Option<String> {
        let step = recorded.split(',').next().unwrap_or_default();
        let values = recorded.split(',').zip(replayed.split(','));
        let (column, (recorded, replayed)) =
            self.columns.0.iter().zip(values).find(|(column, (recorded, replayed))| {
                !is_truth_column(column) && recorded != replayed
            })?;
        let more = match (recorded.parse::<f64>(), replayed.parse::<f64>()) {
            (Ok(was), Ok(is)) => format!(" ({:.1e} more)", is - was),
            _ => String::new(),
        };
        let [recorded, replayed] =
            [recorded, replayed].map(|value| if value.is_empty() { "nothing" } else { value });
        let place = format!("{} line {line}, step {step}, {column}", file::STEPS);
        Some(format!("{place}: recorded {recorded}, replayed {replayed}{more}"))
    }

    /// Compares the end, after the session was given all inputs and ended with `outcome`. Recorded entries that
    /// remain are a difference.
    pub(super) fn close(&mut self, outcome: Option<&Outcome>) -> Result<(), String> {
        let Some(recorded) = self.outcome.take() else { return Ok(()) };
        for (file, line, text) in [
            (file::STEPS, self.rows.taken + 2, self.rows.take()?),
            (file::TRACKER, self.samples.taken + 1, self.samples.take()?),
        ] {
            if text.is_some() {
                self.note_difference(file, line, text.as_deref(), None);
            }
        }
        if let Some(LoggedFrame { line, text, .. }) = self.sent.take()? {
            self.note_difference(file::CAN, line, Some(&text), None);
        }
        if outcome != Some(&recorded) {
            let words = |outcome: &Outcome| match outcome.stop_reason() {
                None => "completed".to_owned(),
                Some(reason) => format!("stopped: {reason}"),
            };
            let replayed = outcome.map_or("not ended".to_owned(), words);
            let recorded = words(&recorded);
            let words = format!("outcome: recorded {recorded}, replayed {replayed}");
            self.difference.get_or_insert(words);
        }
        Ok(())
    }
}
