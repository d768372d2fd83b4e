//! Cyclic synchronous position (CiA 402-2, mode 8): one target per SYNC.

use std::time::Duration;

use super::axis::{Axis, whole};
use super::device::Device;
use crate::canopen::cia402::{Mode, object};
use crate::canopen::emcy::EmcyCode;
use crate::canopen::object_dictionary::ObjectDictionary;
use crate::units::Time;

use super::motion::Motion;
use super::objects::{ACCELERATION_MAX_COUNTS_PER_S2, MAX_ACCELERATION};

/// The value of 0x6065 that disables the following-error supervision (CiA 402-2).
const WINDOW_OFF: i64 = u32::MAX as i64;

impl Axis {
    /// True while the axis takes targets.
    pub(super) fn follows_targets(&self, device: &Device) -> bool {
        self.may_move(device) && self.mode(&device.objects) == Mode::CSP
    }

    /// Handles the second half of a SYNC, after its TPDOs were sampled and its RPDOs written: an axis that
    /// follows takes the target for the next interpolation period.
    ///
    /// The axis reaches it exactly at the end of the period, unless its maximum speed or acceleration is
    /// too low. Then it lags. When it would lag by more than 0x6065 for longer than 0x6066, it faults
    /// instead of moving.
    pub(super) fn take_target(&mut self, now: Time, device: &mut Device) {
        if !self.follows_targets(device) {
            return;
        }
        let objects = &device.objects;
        let [target, offset] = [object::TARGET_POSITION, object::POSITION_OFFSET]
            .map(|address| objects.integer(address) as i32);
        let target = target.wrapping_add(offset);
        let allowed = within_limits(target, objects);
        self.target_limited = allowed != target;
        // Positions wrap at 32 bits: this takes the nearest one with the target's value.
        let step = allowed.wrapping_sub(self.demand.wrapping_sub(self.zero) as i32);
        self.demand = self.demand.saturating_add(step.into());

        let period = interpolation_period(objects);
        let from = self.motion.position_at(now);
        let to = self.reachable(now, period, objects);
        self.lag = self.demand.saturating_sub(whole(to));
        let window = objects.integer(object::FOLLOWING_ERROR_WINDOW);
        let is_behind = window != WINDOW_OFF && self.lag.unsigned_abs() > window.unsigned_abs();
        self.behind_since = is_behind.then(|| self.behind_since.unwrap_or(now));
        let timeout_ms = objects.integer(object::FOLLOWING_ERROR_TIMEOUT).unsigned_abs();
        let timeout = Duration::from_millis(timeout_ms);
        if self.behind_since.is_some_and(|since| now.since(since) >= timeout) {
            self.fault(now, EmcyCode::FOLLOWING_ERROR, device);
        } else {
            self.motion = Motion::linear(now, from, to, period);
        }
    }

    /// The position nearest to the demand that the axis reaches in `period`.
    fn reachable(&self, now: Time, period: Duration, objects: &ObjectDictionary) -> f64 {
        let from = self.motion.position_at(now);
        if self.is_stalled {
            return from.round();
        }
        let seconds = period.as_secs_f64();
        let distance = self.demand as f64 - from;
        let reach = self.speed_limit(objects) * seconds;
        let acceleration_limit =
            (objects.integer(MAX_ACCELERATION) as f64).min(ACCELERATION_MAX_COUNTS_PER_S2);
        let change = acceleration_limit * seconds * seconds;
        let at_present_speed = self.motion.velocity_at(now) * seconds;
        let travel = distance
            .clamp(-reach, reach)
            .clamp(at_present_speed - change, at_present_speed + change);
        if travel == distance { self.demand as f64 } else { (from + travel).round() }
    }

    pub(super) fn speed_limit(&self, objects: &ObjectDictionary) -> f64 {
        let configured = objects.integer(object::MAX_PROFILE_VELOCITY) as f64;
        configured.min(self.config.speed_max_counts_per_s.into())
    }
}

/// Object 0x60C2: a value times a power of ten, in seconds.
fn interpolation_period(objects: &ObjectDictionary) -> Duration {
    let value = objects.integer(object::INTERPOLATION_PERIOD_VALUE) as f64;
    let exponent = objects.integer(object::INTERPOLATION_PERIOD_EXPONENT) as i32;
    Duration::from_secs_f64(value * 10f64.powi(exponent))
}

/// `target` clamped to 0x607D, which is off while both limits are 0.
fn within_limits(target: i32, objects: &ObjectDictionary) -> i32 {
    let min = objects.integer(object::SOFTWARE_LIMIT_MIN) as i32;
    let max = objects.integer(object::SOFTWARE_LIMIT_MAX) as i32;
    if min == 0 && max == 0 { target } else { target.min(max).max(min) }
}
