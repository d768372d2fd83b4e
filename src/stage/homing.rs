//! Homing: a drive finds its home by itself (CiA 402-2, mode 6), and the stage watches.

use super::limits::SPEED;
use super::machine::Phase;
use super::{Axis, Stage, StageEvent};
use crate::canopen::cia402::{Controlword, Statusword};
use crate::keys::{choice, over, section, within};
use crate::units::Time;
use std::time::Duration;

choice! {
    /// Where the position of a drive (0x6064) comes from. It is right from power-on with an absolute encoder,
    /// or where it does not matter. An axis that needs homing is not enabled without it, except to be homed.
    pub enum Reference {
        /// The drive's position is right from power-on.
        Absolute = "absolute",
        /// From homing: before `needle-bench stage home` nothing is moved.
        Homing = "homing",
    }
}

section! {
    /// How an axis is homed by its drive (CiA 402-2, mode 6). Lengths are in mm, angles in rad, times in s.
    /// For an omitted key the drive keeps its own value.
    #[derive(Copy)]
    pub struct HomingConfig of AXIS {
        /// Homing method (6098): 33 is the next index pulse in the negative direction, 37 the current
        /// position.
        method: i8;
        /// Speed towards the switch (6099:1).
        speed_switch as (["speed_switch_mm_per_s", "speed_switch_deg_per_s"][AXIS]): Option<f64>
            [SPEED[AXIS]];
        /// Speed towards zero (6099:2).
        speed_zero as (["speed_zero_mm_per_s", "speed_zero_deg_per_s"][AXIS]): Option<f64>
            [SPEED[AXIS]];
        /// Acceleration (609A).
        acceleration as (["acceleration_mm_per_s2", "acceleration_deg_per_s2"][AXIS]): Option<f64>
            [over(0.0, 1e6)];
        /// Home offset (607C): from the home position to the drive's zero. Home must be inside the
        /// limits.
        offset as (["offset_mm", "offset_deg"][AXIS]): Option<f64>
            [[within(-1000.0, 1000.0), within(-360_000.0, 360_000.0)][AXIS]];
        /// Timeout of a homing. Bits left set by an earlier homing are ignored until they clear, or
        /// until the axis stands one second after the start.
        timeout as "timeout_s": Duration [within(2.0, 3600.0)];
        /// The statusword bit that says that the axis is homed: 12 by the standard (valid only in homing
        /// mode), 15 on some drives.
        homed_bit: u8 [within(8.0, 15.0)];
    }
}

impl HomingConfig {
    /// Bit 12 in homing mode: homing attained.
    pub const ATTAINED_BIT: u8 = 12;

    /// True if the bit that says so is set in `statusword`.
    pub(super) fn is_set(&self, statusword: Statusword) -> bool {
        u32::from(statusword.0) >> self.homed_bit.min(31) & 1 != 0
    }
}

/// After this time the bits of the statusword belong to this homing, if the axis stands, even if they were
/// never seen to clear: some methods take no time at all, and no drive takes this long to begin.
const BEGUN_AFTER: Duration = Duration::from_secs(1);

/// A homing under way.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Homing {
    axis: Axis,
    /// The SYNC that began it, counted from 1.
    began: u64,
    since: Time,
    /// Its bits were seen clear, so that from now on they belong to this homing.
    cleared: bool,
    give_up: Time,
}

impl Stage {
    /// Lets `axis` find its home; [`StageEvent::Homed`] says when it has. To be called when the
    /// stage is [`StageEvent::Ready`], for one axis after the other.
    ///
    /// # Errors
    /// When the stage is not ready, or `axis` not in homing mode.
    pub fn home(&mut self, now: Time, axis: Axis) -> Result<(), String> {
        let config = self.config.axis(axis).homing;
        let (Phase::Ready, Some(config), true) =
            (self.phase, config, self.drives[axis].homing_mode)
        else {
            return Err("the stage is not ready to home".to_owned());
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
            let timeout_s = give_up.since(since).as_secs_f64();
            let statusword = self.drives[axis].statusword.unwrap_or_default();
            let fault = format!(
                "{axis}: not home within {timeout_s:.1} s (statusword {statusword}); is the switch too \
                 far, or the homing speed too low?"
            );
            self.fail(now, fault);
        }
    }

    /// Judges the statusword of this SYNC. Until its bits were seen to clear, they may belong to an earlier
    /// homing; so may the statusword of the SYNC that began this one.
    pub(super) fn watch_homing(&mut self, now: Time, mut homing: Homing) {
        let Homing { axis, began, since, .. } = homing;
        if self.sync_count <= began {
            return;
        }
        let Some(statusword) = self.drives[axis].statusword else { return };
        let over =
            statusword.has(Statusword::HOMING_ATTAINED) || statusword.has(Statusword::HOMING_ERROR);
        let has_begun = now.since(since) >= BEGUN_AFTER && self.drives[axis].stands();
        homing.cleared |= !over || has_begun;
        self.phase = Phase::Homing(homing);
        if homing.cleared && statusword.has(Statusword::HOMING_ERROR) {
            let fault = format!(
                "{axis}: homing failed (statusword {statusword}); check switches, method (0x6098) and \
                 speeds"
            );
            self.fail(now, fault);
        } else if homing.cleared && is_home(statusword) {
            self.drives[axis].controlword = Controlword::ENABLE_OPERATION;
            let position = self.drives[axis].take_home();
            self.phase = Phase::Ready;
            self.emit(StageEvent::Homed { axis, position });
        }
    }
}

/// Attained, and standing.
fn is_home(statusword: Statusword) -> bool {
    statusword.has(Statusword::HOMING_ATTAINED) && statusword.has(Statusword::TARGET_REACHED)
}
