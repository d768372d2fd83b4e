//! Homing: a drive finds its home by itself (CiA 402-2, mode 6), and the stage watches.

use super::machine::Phase;
use super::{Axis, CommandError, Stage, StageEvent, StageFault};
use crate::canopen::cia402::{Controlword, Statusword};
use crate::units::Time;
use std::time::Duration;

/// From then on the bits of the statusword are of this homing even where they were never seen to
/// clear, if the axis stands: some methods take no time at all, and no drive takes this long to
/// begin.
const BEGUN_AFTER: Duration = Duration::from_secs(1);

/// A homing under way.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Homing {
    axis: Axis,
    /// The SYNC that began it, counted from 1.
    began: u64,
    since: Time,
    /// Its bits have been seen clear: what they say from now on is of this homing.
    cleared: bool,
    give_up: Time,
}

impl Stage {
    /// Lets `axis` find its home; [`StageEvent::Homed`] says when it has. To be called when the
    /// stage is [`StageEvent::Ready`], for one axis after the other.
    ///
    /// # Errors
    /// When the stage is not ready, or `axis` not in homing mode.
    pub fn home(&mut self, now: Time, axis: Axis) -> Result<(), CommandError> {
        let config = self.config.axis(axis).homing;
        let (Phase::Ready, Some(config), true) = (self.phase, config, self.drives[axis].homes)
        else {
            return Err(CommandError::NotReadyToHome);
        };
        self.drives[axis].controlword = Controlword::START_HOMING;
        let began = self.sync_count + 1;
        self.drives[axis].watch_standstill();
        let (since, give_up) = (now, now + config.timeout);
        self.phase = Phase::Homing(Homing { axis, began, since, cleared: false, give_up });
        Ok(())
    }

    pub(super) fn check_home_in_time(&mut self, now: Time) {
        let Phase::Homing(Homing { axis, since, give_up, .. }) = self.phase else { return };
        if now >= give_up {
            let within = give_up.since(since);
            let statusword = self.drives[axis].statusword().unwrap_or_default();
            self.fail(now, StageFault::HomingTimeout(axis, statusword, within));
        }
    }

    /// Judges the statusword of this SYNC. That of the SYNC which began the homing, and whatever it
    /// says until its bits were seen to clear, may be of the homing before.
    pub(super) fn watch_homing(&mut self, now: Time, mut homing: Homing) {
        let Homing { axis, began, since, .. } = homing;
        if self.sync_count <= began {
            return;
        }
        let Some(statusword) = self.drives[axis].statusword() else { return };
        let over =
            statusword.has(Statusword::HOMING_ATTAINED) || statusword.has(Statusword::HOMING_ERROR);
        let has_begun = now.since(since) >= BEGUN_AFTER && self.drives[axis].stands();
        homing.cleared |= !over || has_begun;
        self.phase = Phase::Homing(homing);
        if homing.cleared && statusword.has(Statusword::HOMING_ERROR) {
            self.fail(now, StageFault::HomingFailed(axis, statusword));
        } else if homing.cleared && is_home(statusword) {
            self.drives[axis].controlword = Controlword::ENABLE_OPERATION;
            let position = self.drives[axis].take_home();
            self.phase = Phase::Ready;
            self.tell(StageEvent::Homed { axis, position });
        }
    }
}

/// Attained, and standing.
fn is_home(statusword: Statusword) -> bool {
    statusword.has(Statusword::HOMING_ATTAINED) && statusword.has(Statusword::TARGET_REACHED)
}
