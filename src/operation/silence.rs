//! The bench silent on purpose: who notices, and when.

use std::time::Duration;

use crate::stage::{Axis, PerAxis, StageConfig};
use crate::units::Time;

/// A drive may look at its watch this much later than the bench.
const MARGIN: Duration = Duration::from_millis(200);

/// A silence under way.
#[derive(Debug, Clone, Copy)]
pub(super) struct Silence {
    since: Time,
    /// The longest that a drive may take.
    within: Duration,
    noticed_after: PerAxis<Option<Duration>>,
}

impl Silence {
    /// A silence from `since` on. The last heartbeat may have gone out just then.
    pub(super) fn new(config: &StageConfig, since: Time) -> Self {
        let within = config.heartbeat.consumer_time + MARGIN;
        Silence { since, within, noticed_after: PerAxis::default() }
    }

    /// When nobody is waited for any longer.
    pub(super) fn deadline(&self) -> Time {
        self.since + self.within
    }

    /// The drive of `axis` has said that it misses the bench.
    pub(super) fn notice(&mut self, now: Time, axis: Axis) -> Duration {
        *self.noticed_after[axis].get_or_insert(now.since(self.since))
    }

    /// Who has not noticed in time. An error names them.
    pub(super) fn verdict(&self) -> Result<(), String> {
        let in_time =
            |axis: &Axis| self.noticed_after[*axis].is_some_and(|after| after <= self.within);
        let deaf: Vec<String> =
            Axis::BOTH.iter().filter(|axis| !in_time(axis)).map(Axis::to_string).collect();
        if deaf.is_empty() {
            return Ok(());
        }
        Err(format!(
            "{}: no emergency 0x8130 within {} ms of the bench's last heartbeat: if the bench dies, \
             this axis may go on; does the drive watch a heartbeat (0x1016), and send emergencies?",
            deaf.join(", "),
            self.within.as_millis()
        ))
    }
}
