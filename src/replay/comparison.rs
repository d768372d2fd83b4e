//! Compares what leaves a replayed session with what the record holds.

use super::inputs::unsent_unix_us;
use super::recorded::{Entries, Logged, Recorded};
use crate::archive::{
    CandumpLine, RecordedColumns, StepRow, file, is_truth_column, steps_csv_header, tracker_line,
    unix_us,
};
use crate::canopen::Frame;
use crate::session::{Direction, Input, Outcome, SampleRecord, StepRecord};
use crate::units::Time;

/// Compares frames, samples and steps in the order in which they leave, and keeps the first difference.
pub(super) struct Comparison<'a> {
    recorded: &'a Recorded<'a>,
    started_unix_us: i64,
    /// How the run ended; `None` of a record that was cut, which ends before its run did.
    outcome: Option<Outcome>,
    unsent_unix_us: Vec<i64>,
    pub(super) sent: Entries<Logged>,
    pub(super) samples: Entries<String>,
    pub(super) columns: RecordedColumns,
    pub(super) rows: Entries<String>,
    /// The first difference, in words.
    pub(super) difference: Option<String>,
    /// Of a record that was cut: the first file that ended, and the time of what it lacks.
    pub(super) ended: Option<(Time, &'static str)>,
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
            ended: None,
        })
    }

    /// Of a record that was cut, what the replay has beyond it is no difference.
    pub(super) fn is_cut(&self) -> bool {
        self.outcome.is_none()
    }

    /// `file`, of a record that was cut, holds nothing from `time` on.
    pub(super) fn ends(&mut self, file: &'static str, time: Time) {
        self.ended.get_or_insert((time, file));
    }

    /// `file` holds another line, from 1, than was replayed; `None` where one side has no more.
    fn differs(&mut self, file: &str, line: usize, recorded: Option<&str>, replayed: Option<&str>) {
        let [recorded, replayed] = [recorded, replayed].map(|text| text.unwrap_or("nothing more"));
        let words = format!("{file} line {line}: recorded {recorded}, replayed {replayed}");
        self.difference.get_or_insert(words);
    }

    /// A frame that the session sends, in answer to `input`.
    pub(super) fn sent(
        &mut self,
        time: Time,
        frame: &Frame,
        input: Option<&Input>,
    ) -> Result<(), String> {
        let recorded = self.sent.next();
        let logged = recorded.and_then(|logged| CandumpLine::parse(&logged.text));
        let interface = logged.map_or("can", |logged| logged.interface);
        let (unix_us, direction) = (unix_us(self.started_unix_us, time), Direction::Sent);
        let line = CandumpLine { unix_us, interface, direction, frame: *frame }.to_string();
        match recorded {
            Some(logged) if logged.text == line => drop(self.sent.take()?),
            _ if self.was_refused(time, input) => {}
            None if self.is_cut() => self.ends(file::CAN, time),
            _ => {
                let (at, recorded) = match self.sent.take()? {
                    Some(logged) => (logged.line, Some(logged.text)),
                    None => (self.recorded.lines(file::CAN)?.count() + 1, None),
                };
                self.differs(file::CAN, at, recorded.as_deref(), Some(&line));
            }
        }
        Ok(())
    }

    /// A frame that the bus refuses, or that was made before the bench was held up, is in no log; the
    /// session is then told of it before anything else is sent. Of what it answers to a fault of the
    /// bus, any may be refused as well.
    fn was_refused(&self, time: Time, input: Option<&Input>) -> bool {
        let sent_us = unix_us(self.started_unix_us, time);
        let next_us = self.sent.next().map_or(i64::MAX, |logged| logged.unix_us);
        let mut faults = self.unsent_unix_us.iter();
        matches!(input, Some(Input::BusFault(_)))
            || faults.any(|fault_us| (sent_us..=next_us).contains(fault_us))
    }

    /// A sample that the session is done with.
    pub(super) fn sample(&mut self, sample: &SampleRecord) -> Result<(), String> {
        // A sample that JSON cannot hold could not have been recorded either.
        let line = tracker_line(sample).unwrap_or_default();
        let number = self.samples.taken + 1;
        match self.samples.take()? {
            Some(recorded) if recorded == line => {}
            None if self.is_cut() => self.ends(file::TRACKER, sample.received.receive_time),
            recorded => self.differs(file::TRACKER, number, recorded.as_deref(), Some(&line)),
        }
        Ok(())
    }

    /// A step that the session takes; gives its row, as recorded.
    pub(super) fn step(&mut self, step: &StepRecord) -> Result<Option<String>, String> {
        let replayed = StepRow::new(step, None).to_string();
        // The header is line 1.
        let line = self.rows.taken + 2;
        let Some(recorded) = self.rows.take()? else {
            match self.is_cut() {
                true => self.ends(file::STEPS, step.time),
                false => self.differs(file::STEPS, line, None, Some(&replayed)),
            }
            return Ok(None);
        };
        if recorded.split(',').count() != self.columns.0.len() {
            self.differs(file::STEPS, line, Some(&recorded), Some(&replayed));
        } else if let Some(difference) = self.first_value(line, &recorded, &replayed) {
            self.difference.get_or_insert(difference);
        }
        Ok(Some(recorded))
    }

    /// The first value in which two rows differ, in words.
    fn first_value(&self, line: usize, recorded: &str, replayed: &str) -> Option<String> {
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
        let at = format!("{} line {line}, step {step}, {column}", file::STEPS);
        Some(format!("{at}: recorded {recorded}, replayed {replayed}{more}"))
    }

    /// The session has been given everything and has ended as `outcome`; what the record holds
    /// beyond that is a difference.
    pub(super) fn close(&mut self, outcome: Option<&Outcome>) -> Result<(), String> {
        let Some(recorded) = self.outcome.take() else { return Ok(()) };
        for (file, line, text) in [
            (file::STEPS, self.rows.taken + 2, self.rows.take()?),
            (file::TRACKER, self.samples.taken + 1, self.samples.take()?),
        ] {
            if text.is_some() {
                self.differs(file, line, text.as_deref(), None);
            }
        }
        if let Some(Logged { line, text, .. }) = self.sent.take()? {
            self.differs(file::CAN, line, Some(&text), None);
        }
        if outcome != Some(&recorded) {
            let words = |outcome: &Outcome| match outcome {
                Outcome::Completed => "completed".to_owned(),
                Outcome::Stopped(reason) => format!("stopped: {reason}"),
            };
            let replayed = outcome.map_or("not ended".to_owned(), words);
            let recorded = words(&recorded);
            let words = format!("outcome: recorded {recorded}, replayed {replayed}");
            self.difference.get_or_insert(words);
        }
        Ok(())
    }
}
