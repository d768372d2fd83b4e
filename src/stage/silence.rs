//! A test of the drives: the bench sends no heartbeat, and watches what the drives do.

use super::{Axis, PerAxis, Stage};
use crate::units::Time;
use std::time::Duration;

/// A drive may report this much later why it has stopped: its emergency message may come after the statusword.
const EMCY_DELAY: Duration = Duration::from_millis(50);

/// The test under way.
#[derive(Debug, Default)]
pub(super) struct SilenceTest {
    /// The drives that have sent emergency message 0x8130.
    noticed: PerAxis<bool>,
    /// The first fault of a drive that has not sent 0x8130, and the deadline for that message.
    unexplained: PerAxis<Option<(Time, String)>>,
}

impl Stage {
    /// Sends no more heartbeats, while SYNC and set-points go on: drives that monitor them stop by themselves and
    /// send emergency message 0x8130. A drive that has sent it may leave Operation Enabled and NMT Operational, and
    /// may send no TPDO1. Anything else stops the axes as before. Returns when the last heartbeat was sent; `None`
    /// if there was none.
    pub fn stop_heartbeat(&mut self) -> Option<Time> {
        self.silence_test = Some(SilenceTest::default());
        for axis in Axis::BOTH {
            self.drives[axis].restart_emcy_count();
        }
        self.heartbeat.stop()
    }

    /// Takes emergency message 0x8130. Returns false unless the bench is silent on purpose.
    pub(super) fn note_silence_noticed(&mut self, axis: Axis) -> bool {
        let Some(test) = &mut self.silence_test else { return false };
        test.noticed[axis] = true;
        test.unexplained[axis] = None;
        true
    }

    /// True if the drive has noticed that the bench is silent on purpose, and so stops by itself.
    pub(super) fn has_noticed_silence(&self, axis: Axis) -> bool {
        self.silence_test.as_ref().is_some_and(|test| test.noticed[axis])
    }

    /// As [`Stage::fail`], for a fault that may follow from the bench's silence: the drive then explains it by
    /// 0x8130 within `EMCY_DELAY`.
    pub(super) fn fail_drive(&mut self, now: Time, axis: Axis, fault: &str) {
        let fault = format!("{axis}: {fault}");
        match &mut self.silence_test {
            Some(test) if !test.noticed[axis] => {
                test.unexplained[axis].get_or_insert((now + EMCY_DELAY, fault));
            }
            _ => self.fail(now, fault),
        }
    }

    /// Stops for a fault that the drive has not explained in time.
    pub(super) fn check_unexplained_faults(&mut self, now: Time) {
        for axis in Axis::BOTH {
            let test = self.silence_test.as_mut();
            let due = test.and_then(|test| test.unexplained[axis].take_if(|(due, _)| now >= *due));
            if let Some((_, fault)) = due {
                self.fail(now, fault);
            }
        }
    }
}
