//! The inputs of a recorded session, from `inputs.log` and the files that it refers to.

use super::recorded::{Entries, LoggedFrame, Recorded};
use crate::archive::{Inputs, RecordedInput, file, unix_us};
use crate::session::{Direction, Input, STALLED};
use crate::tracker::ndjson;
use crate::tracker::{Event, Sample};
use crate::units::Time;

/// The inputs of a recorded session, read one by one.
pub(super) struct RecordedInputs {
    started_unix_us: i64,
    inputs: Inputs,
    /// The received frames that `inputs.log` has not referred to yet.
    pub(super) received: Entries<LoggedFrame>,
    samples: Entries<Sample>,
}

/// The next entry of `inputs.log`.
pub(super) enum Next {
    /// An input at this time.
    Input(Time, Input),
    /// An input at this time that is missing in this file.
    Missing(Time, &'static str),
}

impl RecordedInputs {
    pub(super) fn open(recorded: &Recorded<'_>) -> Result<Self, String> {
        let samples = recorded.numbered(file::TRACKER)?.map(|numbered| {
            let (line, text) = numbered?;
            ndjson::recorded(line as u64, &text)
                .map_err(|error| format!("{}: {error}", file::TRACKER))
        });
        Ok(RecordedInputs {
            started_unix_us: recorded.started_unix_us()?,
            inputs: recorded.inputs()?,
            received: recorded.frames(Direction::Received)?,
            samples: Entries::new(samples)?,
        })
    }

    /// When the session was created.
    pub(super) fn begun(&self) -> Time {
        self.inputs.begun
    }

    /// The next input; `None` after the last.
    pub(super) fn next(&mut self) -> Result<Option<Next>, String> {
        let Some((time, recorded)) = self.inputs.next().transpose()? else { return Ok(None) };
        Ok(Some(match recorded {
            RecordedInput::Input(input) => Next::Input(time, input),
            RecordedInput::Frame => match self.received.take()? {
                Some(logged) => Next::Input(time, self.frame(time, &logged)?),
                None => Next::Missing(time, file::CAN),
            },
            RecordedInput::Sample => match self.samples.take()? {
                Some(sample) => Next::Input(time, self.sample(time, sample)?),
                None => Next::Missing(time, file::TRACKER),
            },
        }))
    }

    fn frame(&self, time: Time, logged: &LoggedFrame) -> Result<Input, String> {
        let difference_us = logged.unix_us.abs_diff(unix_us(self.started_unix_us, time));
        if difference_us > 0 {
            let (name, line) = (file::CAN, logged.line);
            return Err(
                self.mismatch(&format!("and {name} line {line} are {difference_us} us apart"))
            );
        }
        Ok(Input::Frame(logged.frame))
    }

    fn sample(&self, time: Time, sample: Sample) -> Result<Input, String> {
        if sample.receive_time > time {
            let early_s = sample.receive_time.seconds_after(time);
            let (name, line) = (file::TRACKER, self.samples.taken);
            return Err(self.mismatch(&format!("was given {early_s} s before {name} line {line}")));
        }
        Ok(Input::Tracker(Event::Sample(sample)))
    }

    /// The error for files that do not belong together; `what` says how the last input contradicts the others.
    pub(super) fn mismatch(&self, what: &str) -> String {
        format!("the files are not of one run: {} line {} {what}", file::INPUTS, self.inputs.line)
    }
}

/// The times at which frames of the session may have remained unsent, UTC in µs since 1970: the bus failed, or the
/// control loop stalled.
pub(super) fn unsent_unix_us(recorded: &Recorded<'_>) -> Result<Vec<i64>, String> {
    let started_unix_us = recorded.started_unix_us()?;
    let mut unsent = Vec::new();
    for input in recorded.inputs()? {
        let (time, recorded) = input?;
        let is_fault = match recorded {
            RecordedInput::Input(Input::BusFault(_)) => true,
            RecordedInput::Input(Input::Stop(reason)) => reason.starts_with(STALLED),
            _ => false,
        };
        unsent.extend(is_fault.then(|| unix_us(started_unix_us, time)));
    }
    Ok(unsent)
}
