//! Soft limits: a target within them is sent unchanged, any other is refused.
//!
//! They are checked in the whole counts that would go to the drive. So a sum such as 0.1 + 0.2 is not
//! refused for its last bit, and the checked value is the one that is sent.

use std::time::Duration;

use super::{Axis, Scale};
use crate::keys::{Rule, over, section, within};

pub(super) const SPEED: [Rule; 2] = [over(0.0, 100.0), over(0.0, 36_000.0)];
pub(super) const ACCELERATION: [Rule; 2] = [over(0.0, 1e4), over(0.0, 1e6)];

section! {
    /// How far, how fast and how hard an axis may be commanded, in mm or rad and seconds.
    #[derive(Copy)]
    pub struct AxisLimits of AXIS {
        /// Lower soft limit, measured from zero. The drive enforces it too (607D:1), a little wider, and as wide as
        /// the axis stands.
        min as (["min_mm", "min_deg"][AXIS]): f64
            [[within(-1000.0, 0.0), within(-360_000.0, 0.0)][AXIS]] => ["-1.0", "-7200.0"][AXIS],
            hardware_must_give;
        /// Upper soft limit, measured from zero. The drive enforces it too (607D:2), a little wider, and as wide as
        /// the axis stands.
        max as (["max_mm", "max_deg"][AXIS]): f64
            [[over(0.0, 1000.0), within(0.0, 360_000.0)][AXIS]] => ["310.0", "7200.0"][AXIS],
            hardware_must_give;
        /// Highest speed of any set-point.
        speed_max as (["speed_max_mm_per_s", "speed_max_deg_per_s"][AXIS]): f64 [SPEED[AXIS]]
            => ["10.0", "360.0"][AXIS], hardware_must_give;
        /// Highest acceleration of any set-point; if omitted, acceleration is not checked.
        acceleration_max as (["acceleration_max_mm_per_s2", "acceleration_max_deg_per_s2"][AXIS]):
            Option<f64> [ACCELERATION[AXIS]], hardware_may_omit;
    }
}

impl AxisLimits {
    /// Checks `target` (mm or rad) against the position limits of `axis`. NaN passes.
    ///
    /// # Errors
    /// The position limit that `target` exceeds.
    pub fn check_range(&self, axis: Axis, target: f64) -> Result<(), String> {
        self.check_rounded(axis, target, |value| value)
    }

    /// As [`check_range`](Self::check_range), with the target and the limits rounded to whole counts of `scale`.
    ///
    /// # Errors
    /// The position limit that `target` exceeds.
    pub fn check_counts(&self, axis: Axis, target: f64, scale: &Scale) -> Result<(), String> {
        let to_whole_counts =
            |value| scale.counts(value).map_or(value, |counts| scale.value(counts));
        self.check_rounded(axis, target, to_whole_counts)
    }

    /// As [`check_range`](Self::check_range), with `round` applied to the target and to the limits.
    fn check_rounded(
        &self,
        axis: Axis,
        target: f64,
        round: impl Fn(f64) -> f64,
    ) -> Result<(), String> {
        let (rounded, unit) = (round(target), axis.unit());
        let (side, limit, key) = if rounded > round(self.max) {
            ("over", self.max, "max")
        } else if rounded < round(self.min) {
            ("under", self.min, "min")
        } else {
            return Ok(());
        };
        let [target, limit] = [target, limit].map(|value| axis.shown(value));
        Err(format!("{axis}: {target} is {side} the limit of {limit} (stage.{axis}.{key}_{unit})"))
    }
}

/// The last target of an axis, and the step to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Commanded {
    /// The last target, counts.
    pub counts: i64,
    /// The last target minus the one before, counts.
    pub step_counts: i64,
}

/// The limits of one axis, ready to check targets.
#[derive(Debug, Clone, Copy)]
pub struct LimitCheck {
    pub(super) scale: Scale,
    axis: Axis,
    limits: AxisLimits,
    period_s: f64,
    wraps: bool,
    quick_stop_deceleration: Option<f64>,
}

impl LimitCheck {
    /// Checks the targets of `axis`, one for each `sync_period`. `wraps`: the axis keeps moving while the
    /// drive's 32-bit position wraps around, so targets may exceed 32 bits.
    pub fn new(
        axis: Axis,
        scale: Scale,
        limits: AxisLimits,
        sync_period: Duration,
        wraps: bool,
    ) -> Self {
        let period_s = sync_period.as_secs_f64();
        LimitCheck { scale, axis, limits, period_s, wraps, quick_stop_deceleration: None }
    }

    /// Also refuses a target from which a quick stop with this deceleration, per second squared, would end beyond
    /// a limit.
    pub fn with_quick_stop(self, deceleration: Option<f64>) -> Self {
        LimitCheck { quick_stop_deceleration: deceleration, ..self }
    }

    /// The counts of `target` (mm or rad) if the axis may be sent there from `last`. An axis that stands outside
    /// its limits may be held, and may come back.
    ///
    /// Rounding to whole counts changes a step by up to 1 count, and the difference of two steps by up to 2.
    /// The check allows that.
    ///
    /// # Errors
    /// The first limit that `target` breaks.
    pub fn check(&self, target: f64, last: Commanded) -> Result<i64, String> {
        let counts = self.check_position_from(target, last.counts)?;
        self.check_motion(target, counts, last)?;
        self.check_stop(target, counts, last)?;
        Ok(counts)
    }

    /// As [`check_position`](Self::check_position), but allows a target outside the limits that is no farther out than
    /// `held`, in counts, where the axis is held.
    ///
    /// # Errors
    /// The position limit that `target` breaks.
    pub(super) fn check_position_from(&self, target: f64, held: i64) -> Result<i64, String> {
        self.check_position(target).or_else(|error| {
            let (held, AxisLimits { min, max, .. }) = (self.scale.value(held), self.limits);
            let limits = AxisLimits { min: min.min(held), max: max.max(held), ..self.limits };
            LimitCheck { limits, ..*self }.check_position(target).map_err(|_| error)
        })
    }

    /// The counts of `target` (mm or rad) if the axis may be there.
    ///
    /// # Errors
    /// The position limit that `target` breaks.
    pub fn check_position(&self, target: f64) -> Result<i64, String> {
        let axis = self.axis;
        if !target.is_finite() {
            return Err(format!("{axis}: the target {target} is not a finite number"));
        }
        let does_not_fit = || {
            let target = axis.shown(target);
            format!(
                "{axis}: {target} does not fit the drive's 32-bit position; home it nearer to its zero"
            )
        };
        let counts = self.scale.counts(target).ok_or_else(does_not_fit)?;
        self.limits.check_counts(axis, target, &self.scale)?;
        if !self.wraps && i32::try_from(counts).is_err() {
            return Err(does_not_fit());
        }
        Ok(counts)
    }

    /// Checks that a quick stop that begins at `target` ends within the limit ahead. Half a step more than that is
    /// allowed: a set-point has the mean speed of its step, and the axis may be slowing down to the limit.
    fn check_stop(&self, target: f64, counts: i64, last: Commanded) -> Result<(), String> {
        let Some(deceleration) = self.quick_stop_deceleration else { return Ok(()) };
        let (axis, per_unit) = (self.axis, self.scale.counts_per_unit());
        let step_counts = counts.saturating_sub(last.counts);
        // Rounding to whole counts changes a step by up to 1 count.
        let moved_counts = step_counts.unsigned_abs().saturating_sub(1) as f64;
        let speed = moved_counts / (per_unit * self.period_s);
        let beyond_counts = speed * speed / (2.0 * deceleration) * per_unit - 0.5 * moved_counts;
        if beyond_counts <= 1.0 {
            return Ok(());
        }
        let end_counts = counts.saturating_add(beyond_counts as i64 * step_counts.signum());
        let end = self.check_position_from(self.scale.value(end_counts), last.counts);
        end.map(drop).map_err(|error| {
            let [target, speed] = [target, speed].map(|value| axis.shown(value));
            format!("{error}: there a quick stop from {target} at {speed}/s would end")
        })
    }

    fn check_motion(&self, target: f64, counts: i64, last: Commanded) -> Result<(), String> {
        let (axis, per_unit, period_s) = (self.axis, self.scale.counts_per_unit(), self.period_s);
        let unit = axis.unit();
        let step_counts = counts.saturating_sub(last.counts);
        let speed_max = self.limits.speed_max;
        if step_counts.unsigned_abs() as f64 > speed_max * period_s * per_unit + 1.0 {
            let step = target - self.scale.value(last.counts);
            let speed = step.abs() / period_s;
            let [step, speed, max] = [step, speed, speed_max].map(|value| axis.shown(value));
            return Err(format!(
                "{axis}: a step of {step} in one SYNC is {speed}/s, over the limit of {max}/s \
                 (stage.{axis}.speed_max_{unit}_per_s)"
            ));
        }
        let Some(max) = self.limits.acceleration_max else { return Ok(()) };
        let change_counts = step_counts.saturating_sub(last.step_counts).unsigned_abs() as f64;
        if change_counts > max * period_s * period_s * per_unit + 2.0 {
            let acceleration = change_counts / (per_unit * period_s * period_s);
            let [acceleration, max] = [acceleration, max].map(|value| axis.shown(value));
            return Err(format!(
                "{axis}: an acceleration of {acceleration}/s² is over the limit of {max}/s² \
                 (stage.{axis}.acceleration_max_{unit}_per_s2)"
            ));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stage::{CountsRatio, Sign};
    use proptest::prelude::*;

    const STANDING: Commanded = Commanded { counts: 0, step_counts: 0 };

    fn check(sign: Sign, zero: i64) -> LimitCheck {
        let ratio = CountsRatio::new(1000, 1).expect("not zero");
        let limits =
            AxisLimits { min: -1.0, max: 150.0, speed_max: 10.0, acceleration_max: Some(500.0) };
        let scale = Scale::new(Axis::Insertion, ratio, sign, zero);
        LimitCheck::new(Axis::Insertion, scale, limits, Duration::from_millis(10), false)
    }

    fn at(mm: f64) -> Commanded {
        Commanded { counts: (mm * 1000.0).round() as i64, step_counts: 0 }
    }

    fn text(result: Result<i64, String>) -> String {
        result.expect_err("refused")
    }

    #[test]
    fn a_refusal_names_the_axis_the_value_and_the_limit() {
        let check = check(Sign::Positive, 0);
        assert_eq!(
            text(check.check(151.2, at(150.0))),
            "insertion: 151.200 mm is over the limit of 150.000 mm (stage.insertion.max_mm)"
        );
        assert_eq!(
            text(check.check(-1.5, STANDING)),
            "insertion: -1.500 mm is under the limit of -1.000 mm (stage.insertion.min_mm)"
        );
        assert_eq!(
            text(check.check(0.25, STANDING)),
            "insertion: a step of 0.250 mm in one SYNC is 25.000 mm/s, over the limit of 10.000 mm/s \
             (stage.insertion.speed_max_mm_per_s)"
        );
        assert_eq!(
            text(check.check(0.09, STANDING)),
            "insertion: an acceleration of 900.000 mm/s² is over the limit of 500.000 mm/s² \
             (stage.insertion.acceleration_max_mm_per_s2)"
        );
        assert_eq!(
            text(check.check(f64::NAN, STANDING)),
            "insertion: the target NaN is not a finite number"
        );
        let limits = AxisLimits { min: -20_f64.to_radians(), ..check.limits };
        assert_eq!(
            limits.check_range(Axis::Rotation, -0.5).expect_err("refused"),
            "rotation: -28.648 deg is under the limit of -20.000 deg (stage.rotation.min_deg)"
        );
    }

    #[test]
    fn the_limit_itself_and_its_last_bit_are_allowed() {
        let check = check(Sign::Positive, 0).with_quick_stop(Some(500.0));
        let last = at(149.95);
        assert_eq!(check.check(150.0, last), Ok(150_000));
        assert_eq!(check.check(150.000_000_000_000_03, last), Ok(150_000));
        assert_eq!(check.check(0.1 + 0.2, at(0.25)), Ok(300));
        let moving = Commanded { counts: 0, step_counts: 100 };
        assert_eq!(check.check(0.1 + 1e-12, moving), Ok(100));
    }

    #[test]
    fn a_reversed_axis_is_refused_at_the_right_end() {
        let check = check(Sign::Negative, 5);
        assert_eq!(
            check.check(150.0, Commanded { counts: 5 - 149_950, step_counts: 0 }),
            Ok(-149_995)
        );
        let under = text(check.check(-1.01, Commanded { counts: 1000, step_counts: 0 }));
        assert!(under.contains("is under the limit"), "{under}");
        let standing_at = |counts| check.check_position(check.scale.value(counts));
        assert!(standing_at(5 - 150_001).is_err());
        assert_eq!(standing_at(5 - 150_000), Ok(5 - 150_000));
    }

    #[test]
    fn a_target_past_32_bits_is_refused_unless_the_drive_wraps() {
        let near_the_end = check(Sign::Positive, i64::from(i32::MAX) - 10);
        let last = Commanded { counts: i64::from(i32::MAX) - 10, step_counts: 0 };
        assert!(near_the_end.check(0.010, last).is_ok());
        let refused = text(near_the_end.check(0.011, last));
        assert!(refused.contains("does not fit the drive's 32-bit position"), "{refused}");
        let wrapping = LimitCheck { wraps: true, ..near_the_end };
        assert_eq!(wrapping.check(0.011, last), Ok(i64::from(i32::MAX) + 1));
    }

    /// An axis that stands outside may be held and may come back, but goes no farther out, and not back out again.
    #[test]
    fn an_axis_outside_its_limits_may_only_come_back() {
        let check = check(Sign::Negative, 0).with_quick_stop(Some(5.0));
        let held = |mm: f64| Commanded { counts: -(mm * 1000.0).round() as i64, step_counts: 0 };
        for mm in [150.002, -1.002] {
            let outward = mm + 0.001_f64.copysign(mm);
            assert!(check.check(mm, held(mm)).is_ok(), "{mm}");
            assert!(check.check(mm - 0.001_f64.copysign(mm), held(mm)).is_ok(), "{mm}");
            let refused = text(check.check(outward, held(mm)));
            assert!(refused.contains("the limit of"), "{refused}");
            assert!(check.check(mm, held(mm - 0.001_f64.copysign(mm))).is_err(), "{mm}");
        }
        // A target between two counts is no step outwards.
        let held_between = held(-1.25);
        assert_eq!(check.check(-1.250_4, held_between), Ok(1250));
        assert_eq!(check.check(-1.249_6, held_between), Ok(1250));
        let across = check.check_position_from(-1.001, held(150.1).counts);
        assert!(text(across).contains("is under the limit of -1.000 mm"));
    }

    /// From 149.9 mm at 5 mm/s a deceleration of 100 mm/s² needs 0.125 mm.
    #[test]
    fn a_set_point_from_which_a_quick_stop_would_end_outside_is_refused() {
        let last = Commanded { counts: 149_850, step_counts: 50 };
        let check = check(Sign::Positive, 0);
        assert_eq!(check.check(149.9, last), Ok(149_900));
        assert_eq!(check.with_quick_stop(Some(200.0)).check(149.9, last), Ok(149_900));
        assert_eq!(
            text(check.with_quick_stop(Some(50.0)).check(149.9, last)),
            "insertion: 150.115 mm is over the limit of 150.000 mm (stage.insertion.max_mm): there a quick \
             stop from 149.900 mm at 4.900 mm/s would end"
        );
        // Away from the limit it may be as fast.
        let back = Commanded { counts: 149_950, step_counts: -50 };
        assert_eq!(check.with_quick_stop(Some(1.0)).check(149.9, back), Ok(149_900));
    }

    proptest! {
        #[test]
        fn a_target_is_accepted_exactly_if_it_is_within_every_limit(
            last_counts in -1000..=150_000_i64,
            last_step_counts in -101..=101_i64,
            step_mm in -0.12..0.12_f64,
        ) {
            let last = Commanded { counts: last_counts, step_counts: last_step_counts };
            let target_mm = last_counts as f64 / 1000.0 + step_mm;
            let counts = (target_mm * 1000.0).round() as i64;
            let step_counts = counts - last_counts;
            let is_within = (-1000..=150_000).contains(&counts)
                && step_counts.abs() <= 100 + 1
                && (step_counts - last_step_counts).abs() <= 50 + 2;
            let accepted = check(Sign::Positive, 0).check(target_mm, last).ok();
            prop_assert_eq!(accepted, is_within.then_some(counts));
        }
    }
}
