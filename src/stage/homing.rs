//! Homing: a drive finds its home by itself (CiA 402-2, mode 6), and the stage watches.

use super::config::SPEED_MAX;
use super::limits::SPEED;
use super::machine::Phase;
use super::{Axis, Stage, StageEvent};
use crate::canopen::cia402::{Controlword, Statusword};
use crate::keys::{Rule, choice, over, section, within};
use crate::units::Time;
use std::f64::consts::PI;
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
            [SPEED[AXIS]], at_most(SPEED_MAX[AXIS]);
        /// Speed towards zero (6099:2).
        speed_zero as (["speed_zero_mm_per_s", "speed_zero_deg_per_s"][AXIS]): Option<f64>
            [SPEED[AXIS]], at_most(SPEED_MAX[AXIS]);
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
        /// mode), or one that the standard leaves to the maker (15 on some drives).
        homed_bit: u8 [Rule::Integers(&[8, 12, 14, 15])];
    }
}

impl HomingConfig {
    /// Bit 12 in homing mode: homing attained.
    pub const ATTAINED_BIT: u8 = 12;

    /// True if the direction of the first move does not follow from the method: it depends on the home switch, or is
    /// that of the drive's maker.
    pub fn may_move_either_way(&self) -> bool {
        matches!(self.method, ..0 | 3..=6 | 19..=22)
    }

    /// True if `statusword` has the [homed bit](Self::homed_bit) set.
    pub(super) fn says_homed(&self, statusword: Statusword) -> bool {
        u32::from(statusword.0) >> self.homed_bit.min(31) & 1 != 0
    }
}

/// After this time, if the axis stands, the homing bits of the statusword count as those of this homing even if they
/// were never seen to clear: some methods take no time at all, and no drive takes this long to begin.
const BEGUN_AFTER: Duration = Duration::from_secs(1);

/// How far an axis may stand from its home, mm or rad, and still count as being there: a drive stops a little past the
/// switch or index at which home is.
const HOME_TOLERANCE: [f64; 2] = [1.0, 5.0 * PI / 180.0];
/// After "homing attained", a drive must report a position counted from its new zero within this time.
const POSITION_DELAY: Duration = Duration::from_secs(1);

/// A homing under way.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Homing {
    axis: Axis,
    /// The number of the SYNC that starts the homing, counted from 1.
    first_sync: u64,
    started: Time,
    /// The homing bits of the statusword belong to this homing, not to an earlier one.
    bits_are_valid: bool,
    /// When the drive first said that it is home.
    attained: Option<Time>,
    give_up: Time,
}

impl Stage {
    /// Starts the homing of `axis`; [`StageEvent::Homed`] reports its end. Call it when the stage is
    /// [`StageEvent::Ready`], for one axis at a time.
    ///
    /// # Errors
    /// When the stage is not ready, or `axis` is not in homing mode.
    pub fn home(&mut self, now: Time, axis: Axis) -> Result<(), String> {
        let homing = self.config.axis(axis).homing.filter(|_| self.drives[axis].in_homing_mode());
        let (Phase::Ready, Some(config)) = (self.phase, homing) else {
            return Err("the stage is not ready to home".to_owned());
        };
        let drive = &mut self.drives[axis];
        drive.controlword = Controlword::START_HOMING;
        drive.standstill.watch_from(drive.position.counts());
        self.phase = Phase::Homing(Homing {
            axis,
            first_sync: self.sync_count + 1,
            started: now,
            bits_are_valid: false,
            attained: None,
            give_up: now + config.timeout,
        });
        Ok(())
    }

    /// Stops with a fault if the homing under way has timed out.
    pub(super) fn check_homing_timeout(&mut self, now: Time) {
        let Phase::Homing(Homing { axis, started, give_up, .. }) = self.phase else { return };
        if now >= give_up {
            let timeout_s = give_up.since(started).as_secs_f64();
            let statusword = self.drives[axis].statusword.unwrap_or_default();
            let has = |bits| statusword.has(bits);
            let hint = match has(Statusword::HOMING_ATTAINED) && !has(Statusword::TARGET_REACHED) {
                true => "it is homed by bit 12, but by bit 10 has not reached its target",
                false => "is the switch too far, or the homing speed too low?",
            };
            let fault = format!(
                "{axis}: not home within {timeout_s:.1} s (statusword {statusword}); {hint}"
            );
            self.fail(now, fault);
        }
    }

    /// Takes the statusword of this SYNC. Until its homing bits were seen clear, they may belong to an earlier
    /// homing. The statusword of the SYNC that starts this homing is ignored for the same reason.
    pub(super) fn watch_homing(&mut self, now: Time, mut homing: Homing) {
        let Homing { axis, first_sync, started, .. } = homing;
        if self.sync_count <= first_sync {
            return;
        }
        let Some(statusword) = self.drives[axis].statusword else { return };
        let has_failed = statusword.has(Statusword::HOMING_ERROR);
        let has_ended = has_failed || statusword.has(Statusword::HOMING_ATTAINED);
        let must_have_begun =
            now.since(started) >= BEGUN_AFTER && self.drives[axis].standstill.stands();
        homing.bits_are_valid |= !has_ended || must_have_begun;
        let is_home = homing.bits_are_valid && is_home(statusword);
        homing.attained = homing.attained.or(is_home.then_some(now));
        self.phase = Phase::Homing(homing);
        let off = self.drives[axis].off_home();
        if homing.bits_are_valid && has_failed {
            let fault = format!(
                "{axis}: homing failed (statusword {statusword}); check switches, method (0x6098) and \
                 speeds"
            );
            self.fail(now, fault);
        } else if let Some((here, home)) = off.filter(|_| is_home) {
            if homing.attained.is_some_and(|attained| now.since(attained) >= POSITION_DELAY) {
                let [here, home] = [here, home].map(|at| axis.shown(at));
                let fault = format!(
                    "{axis}: the drive says that it is home, but reads {here}, and home is {home} by its offset \
                     (0x607C; EPOS4: 0x30B0): it did not move, or counts the offset otherwise; set zero instead"
                );
                self.fail(now, fault);
            }
        } else if is_home {
            self.drives[axis].controlword = Controlword::ENABLE_OPERATION;
            let position = self.drives[axis].take_home();
            self.phase = Phase::Ready;
            self.emit(StageEvent::Homed { axis, position });
        }
    }
}

/// True if `apart`, mm or rad, is no farther from home than a drive may stop.
pub(super) fn is_at_home(axis: Axis, apart: f64) -> bool {
    apart.abs() <= HOME_TOLERANCE[axis as usize]
}

/// True if the homing has succeeded and the axis stands (CiA 402-2, bits 12 and 10 in homing mode).
fn is_home(statusword: Statusword) -> bool {
    statusword.has(Statusword::HOMING_ATTAINED) && statusword.has(Statusword::TARGET_REACHED)
}
