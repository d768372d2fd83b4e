//! Profile position (mode 1) and homing (mode 6) of CiA 402-2: moves with ramps, begun by the
//! rising edge of bit 4 of the controlword.

use super::axis::{Axis, whole};
use super::csp::within_limits;
use super::homing::{self, Homing};
use super::motion::Motion;
use super::objects::MAX_ACCELERATION;
use super::profile::{Profile, Ramps};
use crate::canopen::ObjectAddress;
use crate::canopen::cia402::{Controlword, Mode, object};
use crate::canopen::emcy::{EmcyCode, error_register};
use crate::canopen::node::Device;
use crate::canopen::object_dictionary::ObjectDictionary;
use crate::units::Time;

/// Bit 4 in PP: new set-point; in homing: start, and stop when it falls.
const START_BIT: u16 = 1 << 4;
/// Bit 5 in PP: the new set-point replaces the one under way.
const CHANGE_IMMEDIATELY_BIT: u16 = 1 << 5;
/// Bit 6 in PP: the target counts from the last one.
const RELATIVE_BIT: u16 = 1 << 6;

/// What profile position has been asked for.
#[derive(Debug, Clone, Default)]
pub(super) struct Positioning {
    /// Bit 12 of the statusword: the set-point was taken, and bit 4 is still high or no other can
    /// be taken yet.
    pub(super) acknowledged: bool,
    /// Where the move leads, counts of the encoder; `None` once the axis is there.
    target: Option<i64>,
    /// The set-point that follows it.
    next: Option<i64>,
}

impl Positioning {
    /// Bit 4 low ends the acknowledgement, once another set-point can be taken.
    pub(super) fn see(&mut self, word: Controlword) {
        self.acknowledged &= word.has(START_BIT) || self.next.is_some();
    }

    /// True once there is nothing more to move to.
    pub(super) fn is_done(&self) -> bool {
        self.target.is_none() && self.next.is_none()
    }
}

impl Axis {
    /// The controlword of an enabled drive in a mode of moves, and the one before it.
    pub(super) fn move_commanded(
        &mut self,
        now: Time,
        word: Controlword,
        before: Controlword,
        device: &mut Device,
    ) {
        let (start, started) = (word.has(START_BIT), before.has(START_BIT));
        match self.mode(&device.objects) {
            Mode::ProfilePosition => {
                let released =
                    before.has(Controlword::HALT_BIT) && !word.has(Controlword::HALT_BIT);
                if start && !started && !self.positioning.acknowledged {
                    self.take_set_point(now, word, device);
                } else if released && let Some(target) = self.positioning.target {
                    self.begin_positioning(now, target, device);
                }
            }
            Mode::Homing if start && !started => self.begin_homing(now, device),
            Mode::Homing if !start && started => self.interrupt_homing(now, &device.objects),
            _ => {}
        }
    }

    fn take_set_point(&mut self, now: Time, word: Controlword, device: &mut Device) {
        let objects = &device.objects;
        let given = objects.integer(object::TARGET_POSITION) as i32;
        let last = self.positioning.next.or(self.positioning.target).unwrap_or(self.demand);
        let base = last.wrapping_sub(self.zero) as i32;
        let asked = if word.has(RELATIVE_BIT) { base.wrapping_add(given) } else { given };
        let allowed = within_limits(asked, objects);
        self.target_limited = allowed != asked;
        let target = allowed as i64 + self.zero;
        self.positioning.acknowledged = true;
        if self.positioning.target.is_some() && !word.has(CHANGE_IMMEDIATELY_BIT) {
            self.positioning.next = Some(target);
        } else {
            self.positioning.next = None;
            self.begin_positioning(now, target, device);
        }
    }

    fn begin_positioning(&mut self, now: Time, target: i64, device: &mut Device) {
        self.positioning.target = Some(target);
        let ramps = self.profile_ramps(&device.objects);
        self.begin_move(now, target, ramps, device);
    }

    /// The ramps of 0x6081, 0x6083 and 0x6084.
    fn profile_ramps(&self, objects: &ObjectDictionary) -> Ramps {
        Ramps {
            speed: self.speed(object::PROFILE_VELOCITY, objects),
            acceleration: self.rate(object::PROFILE_ACCELERATION, objects),
            deceleration: self.rate(object::PROFILE_DECELERATION, objects),
        }
    }

    fn homing_ramps(&self, fast: bool, objects: &ObjectDictionary) -> Ramps {
        let speed = if fast { object::HOMING_SPEED_SWITCH } else { object::HOMING_SPEED_ZERO };
        let rate = self.rate(object::HOMING_ACCELERATION, objects);
        Ramps { speed: self.speed(speed, objects), acceleration: rate, deceleration: rate }
    }

    fn speed(&self, set: ObjectAddress, objects: &ObjectDictionary) -> f64 {
        (objects.integer(set) as f64).min(self.speed_limit(objects)).max(1.0)
    }

    fn rate(&self, set: ObjectAddress, objects: &ObjectDictionary) -> f64 {
        let most = objects.integer(MAX_ACCELERATION) as f64;
        (objects.integer(set) as f64).min(most).min(self.acceleration_max_counts_per_s2).max(1.0)
    }

    /// A blocked axis does not begin: the drive finds that it does not follow.
    fn begin_move(&mut self, now: Time, to: i64, ramps: Ramps, device: &mut Device) {
        if self.stalled {
            let register = error_register::PROFILE;
            return self.fault(now, EmcyCode::FOLLOWING_ERROR, register, device);
        }
        let (from, speed) = (self.motion.position_at(now), self.motion.velocity_at(now));
        self.demand = to;
        self.motion = Motion::Ramped(Profile::new(now, from, speed, to as f64, ramps));
    }

    fn begin_homing(&mut self, now: Time, device: &mut Device) {
        self.referenced = false;
        let objects = &device.objects;
        let method = objects.integer(object::HOMING_METHOD);
        let Ramps { speed, deceleration, .. } = self.homing_ramps(true, objects);
        let overrun = whole(speed * speed / (2.0 * deceleration)).max(1);
        let (at, switches) = (whole(self.motion.position_at(now)), &self.inputs.switches);
        self.homing = match homing::plan(method, at, switches, self.index_counts, overrun) {
            Some((legs, home_counts)) => Homing::Under { legs, home_counts },
            None => Homing::Failed,
        };
        self.go_on(now, device);
    }

    /// The axis stands: the next leg of a homing, or the next set-point.
    pub(super) fn go_on(&mut self, now: Time, device: &mut Device) {
        match (self.mode(&device.objects), &mut self.homing) {
            (Mode::Homing, Homing::Under { legs, home_counts }) => {
                let home_counts = *home_counts;
                if legs.is_empty() {
                    // The zero position is the home position and the home offset.
                    self.zero = home_counts + device.objects.integer(object::HOME_OFFSET);
                    self.referenced = true;
                    self.homing = Homing::Idle;
                } else {
                    let leg = legs.remove(0);
                    self.onto = leg.onto;
                    let ramps = self.homing_ramps(leg.fast, &device.objects);
                    self.begin_move(now, leg.to_counts, ramps, device);
                }
            }
            (Mode::ProfilePosition, _) if !self.before.has(Controlword::HALT_BIT) => {
                self.positioning.target = None;
                if let Some(next) = self.positioning.next.take() {
                    self.positioning.acknowledged = self.before.has(START_BIT);
                    self.begin_positioning(now, next, device);
                }
            }
            _ => {}
        }
    }

    /// Ends a homing under way; the axis brakes.
    pub(super) fn interrupt_homing(&mut self, now: Time, objects: &ObjectDictionary) {
        if matches!(self.homing, Homing::Under { .. }) {
            self.homing = Homing::Idle;
            self.brake(now, objects.integer(object::PROFILE_DECELERATION));
        }
    }
}
