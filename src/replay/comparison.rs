//! What leaves a session, set against what the record holds.

use super::difference::Difference;
use super::recorded::Recorded;
use crate::archive::{CandumpLine, StepRow, file, is_of_truth, tracker_line};
use crate::canopen::Frame;
use crate::emulator::Truth;
use crate::session::{Direction, Input, Outcome, SampleRecord, StepRecord};
use crate::units::Time;

/// Compares in the order in which things leave; the first difference stands.
pub(super) struct Comparison<'a> {
    recorded: &'a Recorded<'a>,
    unsent_unix_us: Vec<i64>,
    /// Lines of each file compared so far.
    pub(super) frames: usize,
    pub(super) samples: usize,
    pub(super) rows: usize,
    pub(super) difference: Option<Difference>,
    /// Of a record that was cut: the first file that holds no more, and since when.
    pub(super) ended: Option<(Time, &'static str)>,
}

impl<'a> Comparison<'a> {
    pub(super) fn new(recorded: &'a Recorded<'a>) -> Self {
        let unsent_unix_us = recorded.unsent_unix_us();
        let (frames, samples, rows) = (0, 0, 0);
        Comparison {
            recorded,
            unsent_unix_us,
            frames,
            samples,
            rows,
            difference: None,
            ended: None,
        }
    }

    /// Of a record that was cut, what the replay has beyond it is no difference.
    fn is_cut(&self) -> bool {
        self.recorded.outcome.is_none()
    }

    /// `file`, of a record that was cut, holds nothing from `time` on.
    pub(super) fn ends(&mut self, file: &'static str, time: Time) {
        self.ended.get_or_insert((time, file));
    }

    /// `file` holds another line, from 1, than was replayed; `None` where one side has no more.
    fn differs(
        &mut self,
        file: &'static str,
        line: usize,
        recorded: Option<&str>,
        replayed: Option<String>,
    ) {
        let recorded = recorded.map(str::to_owned);
        self.difference.get_or_insert(Difference::Line { file, line, recorded, replayed });
    }

    /// A frame that the session sends, in answer to `input`.
    pub(super) fn sent(&mut self, time: Time, frame: &Frame, input: Option<&Input>) {
        let recorded = self.recorded.sent.get(self.frames);
        let interface = recorded.map_or("can", |logged| logged.interface);
        let started_unix_us = self.recorded.started_unix_us;
        let line =
            CandumpLine { started_unix_us, interface, time, direction: Direction::Sent, frame };
        let line = line.to_string();
        match recorded {
            Some(logged) if logged.text == line => self.frames += 1,
            _ if self.was_refused(time, input) => {}
            None if self.is_cut() => self.ends(file::CAN, time),
            _ => {
                let at = recorded.map_or(self.recorded.can_lines + 1, |logged| logged.line);
                self.differs(file::CAN, at, recorded.map(|logged| logged.text), Some(line));
                self.frames += 1;
            }
        }
    }

    /// A frame that the bus refuses, or that was made before the bench was held up, is in no log; the
    /// session is then told of it before anything else is sent. Of what it answers to a fault of the
    /// bus, any may be refused as well.
    fn was_refused(&self, time: Time, input: Option<&Input>) -> bool {
        let sent_us = self.recorded.unix_us(time);
        let next_us = self.recorded.sent.get(self.frames).map_or(i64::MAX, |logged| logged.unix_us);
        let mut faults = self.unsent_unix_us.iter();
        matches!(input, Some(Input::BusFault(_)))
            || faults.any(|fault_us| (sent_us..=next_us).contains(fault_us))
    }

    /// A sample that the session is done with.
    pub(super) fn sample(&mut self, sample: &SampleRecord) {
        // A sample that JSON cannot hold could not have been recorded either.
        let line = tracker_line(sample).unwrap_or_default();
        let recorded = self.recorded.samples.get(self.samples).map(|(_, text)| *text);
        self.samples += 1;
        if recorded.is_none() && self.is_cut() {
            self.ends(file::TRACKER, sample.receive_time);
        } else if recorded != Some(&line) {
            self.differs(file::TRACKER, self.samples, recorded, Some(line));
        }
    }

    /// A step that the session takes; gives the truth at it, as recorded.
    pub(super) fn step(&mut self, step: &StepRecord) -> Option<Truth> {
        let row = StepRow { step, truth: None }.to_string();
        // The header is line 1.
        let line = self.rows + 2;
        let Some(recorded) = self.recorded.steps.rows.get(self.rows) else {
            match self.is_cut() {
                true => self.ends(file::STEPS, step.time),
                false => self.differs(file::STEPS, line, None, Some(row)),
            }
            return None;
        };
        self.rows += 1;
        if recorded.len() != self.recorded.steps.columns.len() {
            self.differs(file::STEPS, line, Some(&recorded.join(",")), Some(row));
        } else if let Some(difference) = self.first_value(line, recorded, &row) {
            self.difference.get_or_insert(difference);
        }
        self.recorded.steps.truth(recorded)
    }

    fn first_value(&self, line: usize, recorded: &[&str], replayed: &str) -> Option<Difference> {
        let values = recorded.iter().zip(replayed.split(','));
        let (column, (recorded_value, replayed)) =
            self.recorded.steps.columns.iter().zip(values).find(
                |(column, (recorded, replayed))| !is_of_truth(column) && *recorded != replayed,
            )?;
        Some(Difference::Value {
            line,
            step: recorded.first().copied().unwrap_or_default().to_owned(),
            column: (*column).to_owned(),
            recorded: (*recorded_value).to_owned(),
            replayed: replayed.to_owned(),
        })
    }

    /// The session has been given everything and has ended as `outcome`; what the record holds
    /// beyond that is a difference.
    pub(super) fn close(&mut self, outcome: Option<&Outcome>) {
        let Recorded { outcome: Some(recorded), sent, samples, steps, .. } = self.recorded else {
            return;
        };
        if let Some(row) = steps.rows.get(self.rows) {
            self.differs(file::STEPS, self.rows + 2, Some(&row.join(",")), None);
        }
        if let Some((_, text)) = samples.get(self.samples) {
            self.differs(file::TRACKER, self.samples + 1, Some(text), None);
        }
        if let Some(logged) = sent.get(self.frames) {
            self.differs(file::CAN, logged.line, Some(logged.text), None);
        }
        if outcome != Some(recorded) {
            let words = |outcome: &Outcome| match outcome {
                Outcome::Completed => "completed".to_owned(),
                Outcome::Stopped(reason) => format!("stopped: {reason}"),
            };
            self.difference.get_or_insert(Difference::Outcome {
                recorded: words(recorded),
                replayed: outcome.map_or("not ended".to_owned(), words),
            });
        }
    }
}
