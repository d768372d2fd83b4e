//! The tracker's samples: delays, rates, and refusals by each gate.

use super::states::{Meaning, States};
use super::{Logged, log_row};
use crate::session::SampleRecord;
use crate::tracker::GateName;
use crate::units::Time;
use rerun::{RecordingStream, TextLog};
use std::time::Duration;

/// Rates are means over this interval.
const RATE_INTERVAL: Duration = Duration::from_millis(500);

/// Logs records of samples as rows, lines and states.
#[derive(Default)]
pub(super) struct Samples {
    window_begin: Option<Time>,
    accepted: u32,
    refused: u32,
    /// The gate that refused the last sample; the inner `None` if it was accepted.
    last_gate: Option<Option<GateName>>,
}

impl Samples {
    pub(super) fn log(
        &mut self,
        stream: &RecordingStream,
        sample: &SampleRecord,
        states: &mut States,
    ) -> Logged {
        if let Some(acquisition_time) = sample.acquisition_time {
            let delay_ms = sample.received.receive_time.seconds_after(acquisition_time) * 1e3;
            log_row(stream, "samples", [("delay_ms", delay_ms)])?;
        }
        let gate = sample.refused.as_ref().map(|refusal| refusal.gate);
        if gate == Some(GateName::Tool) {
            return Ok(());
        }
        log_refused(stream, sample)?;
        match gate {
            None => self.accepted += 1,
            Some(_) => self.refused += 1,
        }
        if self.last_gate.replace(gate) != Some(gate) {
            let (state, meaning) = match gate {
                None => ("accepted".to_owned(), Meaning::Good),
                Some(gate) => (format!("refused: {gate}"), Meaning::Fault),
            };
            states.log_lane(stream, "gate", &state, meaning)?;
        }
        let time = sample.received.receive_time;
        let begin = *self.window_begin.get_or_insert(time);
        if time < begin + RATE_INTERVAL {
            return Ok(());
        }
        let interval_s = time.seconds_after(begin);
        let rates = [("accepted_per_s", self.accepted), ("refused_per_s", self.refused)];
        let rates = rates.map(|(name, n)| (name, f64::from(n) / interval_s));
        (self.accepted, self.refused) = (0, 0);
        self.window_begin = Some(time);
        log_row(stream, "sample_rates", rates)
    }
}

/// Logs a line if the sample was refused.
pub(super) fn log_refused(stream: &RecordingStream, sample: &SampleRecord) -> Logged {
    let Some(reason) = &sample.refused else { return Ok(()) };
    let text = format!("sample of {:?} refused: {reason}", sample.received.tool);
    stream.log("events/samples", &TextLog::new(text).with_level("WARN"))
}
