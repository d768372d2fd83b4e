//! Soft limits that refuse: a target is sent as asked, or not at all.
//!
//! They are checked on the whole counts that would go to the drive, so a sum such as
//! 0.1 + 0.2 is not refused for its last bit, and what is sent is what was checked.

use std::time::Duration;

use super::{Axis, Scale};

/// How far, how fast and how hard an axis may be commanded, in mm or rad and seconds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AxisLimits {
    /// Lowest target.
    pub min: f64,
    /// Highest target.
    pub max: f64,
    /// Highest speed, per second: bounds the step from one SYNC to the next.
    pub speed_max: f64,
    /// Highest acceleration, per second squared: bounds the change of that step.
    pub acceleration_max: Option<f64>,
}

/// Why a target was refused.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum LimitError {
    /// The target is NaN or infinite.
    #[error("{axis}: the target {target} is not a finite number")]
    NotFinite {
        /// Whose target.
        axis: Axis,
        /// As asked.
        target: f64,
    },
    /// Over the highest position.
    #[error(
        "{axis}: {} is over the limit of {} (stage.{axis}.max_{})",
        axis.shown(*target), axis.shown(*max), axis.in_unit(0.0).1
    )]
    Over {
        /// Whose target.
        axis: Axis,
        /// As asked, mm or rad.
        target: f64,
        /// The limit, mm or rad.
        max: f64,
    },
    /// Under the lowest position.
    #[error(
        "{axis}: {} is under the limit of {} (stage.{axis}.min_{})",
        axis.shown(*target), axis.shown(*min), axis.in_unit(0.0).1
    )]
    Under {
        /// Whose target.
        axis: Axis,
        /// As asked, mm or rad.
        target: f64,
        /// The limit, mm or rad.
        min: f64,
    },
    /// Too far from the last target for one SYNC period.
    #[error(
        "{axis}: a step of {} in one SYNC is {}/s, over the limit of {}/s (stage.{axis}.speed_max_{}_per_s)",
        axis.shown(*step), axis.shown(*speed), axis.shown(*max), axis.in_unit(0.0).1
    )]
    TooFast {
        /// Whose target.
        axis: Axis,
        /// From the last target to this one, mm or rad.
        step: f64,
        /// That step per SYNC period, per second.
        speed: f64,
        /// The limit, per second.
        max: f64,
    },
    /// The step changes by too much from the step before.
    #[error(
        "{axis}: an acceleration of {}/s² is over the limit of {}/s² (stage.{axis}.acceleration_max_{}_per_s2)",
        axis.shown(*acceleration), axis.shown(*max), axis.in_unit(0.0).1
    )]
    TooHard {
        /// Whose target.
        axis: Axis,
        /// As asked, per second squared.
        acceleration: f64,
        /// The limit, per second squared.
        max: f64,
    },
    /// The drive's 32-bit position cannot hold the target.
    #[error(
        "{axis}: {} does not fit the drive's 32-bit position; home it nearer to its zero",
        axis.shown(*target)
    )]
    OutOfCounts {
        /// Whose target.
        axis: Axis,
        /// As asked, mm or rad.
        target: f64,
    },
}

/// Where an axis was last told to be, and how it got there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Commanded {
    /// The last target, counts.
    pub counts: i64,
    /// From the target before to the last one, counts.
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
}

impl LimitCheck {
    /// Checks the targets of `axis`, one for each `sync_period`. `wraps` says that the drive goes
    /// on past the end of its 32-bit position the short way round.
    pub fn new(
        axis: Axis,
        scale: Scale,
        limits: AxisLimits,
        sync_period: Duration,
        wraps: bool,
    ) -> Self {
        LimitCheck { scale, axis, limits, period_s: sync_period.as_secs_f64(), wraps }
    }

    /// The counts of `target` (mm or rad) if the axis may be sent there from `last`.
    ///
    /// One count is allowed for the rounding of each of the targets compared.
    ///
    /// # Errors
    /// The first limit that `target` breaks.
    pub fn check(&self, target: f64, last: Commanded) -> Result<i64, LimitError> {
        let counts = self.counts_of(target)?;
        self.check_position(counts, target)?;
        self.check_motion(target, counts, last)?;
        Ok(counts)
    }

    /// Whether `goal` (mm or rad) is a place where the axis may be.
    ///
    /// # Errors
    /// The position limit that `goal` breaks.
    pub fn check_goal(&self, goal: f64) -> Result<(), LimitError> {
        self.counts_of(goal).and_then(|counts| self.check_position(counts, goal))
    }

    fn counts_of(&self, target: f64) -> Result<i64, LimitError> {
        let axis = self.axis;
        if !target.is_finite() {
            return Err(LimitError::NotFinite { axis, target });
        }
        self.scale.counts(target).ok_or(LimitError::OutOfCounts { axis, target })
    }

    /// Whether the axis may be held at `counts`.
    ///
    /// # Errors
    /// The position limit that `counts` breaks.
    pub fn check_standing(&self, counts: i64) -> Result<(), LimitError> {
        self.check_position(counts, self.scale.value(counts))
    }

    fn check_position(&self, counts: i64, target: f64) -> Result<(), LimitError> {
        let (axis, AxisLimits { min, max, .. }) = (self.axis, self.limits);
        // Compared on the grid of counts, along the axis.
        let value = self.scale.value(counts);
        let on_grid = |limit: f64| self.scale.counts(limit).map_or(limit, |c| self.scale.value(c));
        if value > on_grid(max) {
            return Err(LimitError::Over { axis, target, max });
        }
        if value < on_grid(min) {
            return Err(LimitError::Under { axis, target, min });
        }
        if !self.wraps && i32::try_from(counts).is_err() {
            return Err(LimitError::OutOfCounts { axis, target });
        }
        Ok(())
    }

    fn check_motion(&self, target: f64, counts: i64, last: Commanded) -> Result<(), LimitError> {
        let (axis, per_unit, period_s) = (self.axis, self.scale.counts_per_unit(), self.period_s);
        let step_counts = counts.saturating_sub(last.counts);
        let speed_max = self.limits.speed_max;
        if step_counts.unsigned_abs() as f64 > speed_max * period_s * per_unit + 1.0 {
            let step = target - self.scale.value(last.counts);
            let speed = step.abs() / period_s;
            return Err(LimitError::TooFast { axis, step, speed, max: speed_max });
        }
        let Some(max) = self.limits.acceleration_max else { return Ok(()) };
        let change_counts = step_counts.saturating_sub(last.step_counts).unsigned_abs() as f64;
        if change_counts > max * period_s * period_s * per_unit + 2.0 {
            let acceleration = change_counts / (per_unit * period_s * period_s);
            return Err(LimitError::TooHard { axis, acceleration, max });
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

    fn text(result: Result<i64, LimitError>) -> String {
        result.expect_err("refused").to_string()
    }

    #[test]
    fn refuses_by_name_number_and_limit() {
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
        let axis = Axis::Rotation;
        let past = LimitError::Under { axis, target: -0.5, min: -20_f64.to_radians() };
        assert_eq!(
            past.to_string(),
            "rotation: -28.648 deg is under the limit of -20.000 deg (stage.rotation.min_deg)"
        );
    }

    #[test]
    fn the_limit_itself_and_its_last_bit_are_allowed() {
        let check = check(Sign::Positive, 0);
        let last = at(149.95);
        assert_eq!(check.check(150.0, last), Ok(150_000));
        assert_eq!(check.check(150.000_000_000_000_03, last), Ok(150_000));
        assert_eq!(check.check(0.1 + 0.2, at(0.25)), Ok(300));
        let moving = Commanded { counts: 0, step_counts: 100 };
        assert_eq!(check.check(0.1 + 1e-12, moving), Ok(100));
    }

    #[test]
    fn a_reversed_axis_keeps_its_ends_apart() {
        let check = check(Sign::Negative, 5);
        assert_eq!(
            check.check(150.0, Commanded { counts: 5 - 149_950, step_counts: 0 }),
            Ok(-149_995)
        );
        assert!(matches!(
            check.check(-1.01, Commanded { counts: 1000, step_counts: 0 }),
            Err(LimitError::Under { .. })
        ));
        assert!(check.check_standing(5 - 150_001).is_err());
        assert!(check.check_standing(5 - 150_000).is_ok());
    }

    #[test]
    fn a_target_past_32_bits_is_refused_unless_the_drive_wraps() {
        let near_the_end = check(Sign::Positive, i64::from(i32::MAX) - 10);
        let last = Commanded { counts: i64::from(i32::MAX) - 10, step_counts: 0 };
        assert!(near_the_end.check(0.010, last).is_ok());
        assert!(matches!(near_the_end.check(0.011, last), Err(LimitError::OutOfCounts { .. })));
        let wrapping = LimitCheck { wraps: true, ..near_the_end };
        assert_eq!(wrapping.check(0.011, last), Ok(i64::from(i32::MAX) + 1));
    }

    proptest! {
        #[test]
        fn what_passes_is_within_every_limit(target in -2.0..151.0_f64, last in -1.0..150.0_f64) {
            let last = at(last);
            if let Ok(counts) = check(Sign::Positive, 0).check(target, last) {
                prop_assert!((-1000..=150_000).contains(&counts));
                prop_assert!((counts - last.counts).abs() <= 52);
                prop_assert!((counts as f64 / 1000.0 - target).abs() <= 0.000_5 + 1e-9);
            }
        }
    }
}
