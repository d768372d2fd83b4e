//! The highest accelerations that set-points can command. The limits of the axes must allow them.

use std::time::Duration;

/// The highest acceleration in the set-points of a profile, relative to the configured acceleration. It
/// exceeds 1 because set-points are one SYNC apart and the last of them is cut to end at the goal.
///
/// Take speeds in units of acceleration times period. The speed falls by 1 each period until the distance to
/// the goal is shorter than the next step. If the next speed were u, the distance is u(u + 1)/2, and the speed
/// before was 1 + u. The difference is 1 + u/2 - u²/2, at most 9/8.
pub const PROFILE_PEAK: f64 = 1.125;

/// The highest acceleration of the rotation, in the unit of `rate_max` times mm per s². At one SYNC the law may
/// change from `rate_max` per mm in one direction to as much in the other, inserting at `speed_mm_per_s`.
pub fn rotation_peak(rate_max: f64, speed_mm_per_s: f64, sync_period: Duration) -> f64 {
    2.0 * rate_max * speed_mm_per_s / sync_period.as_secs_f64()
}

#[cfg(test)]
mod tests {
    use super::super::insertion::Insertion;
    use super::super::profile::Profile;
    use super::super::{InsertionConfig, InsertionMode, PlaneOutOfReach, Samples};
    use super::*;
    use crate::stage::{
        Axis, AxisLimits, Commanded, CountsRatio, LimitCheck, Scale, SetPoint, Sign,
    };
    use proptest::prelude::*;

    /// An axis with limits, and its last target.
    struct Limited {
        check: LimitCheck,
        last: Commanded,
    }

    impl Limited {
        fn new(
            axis: Axis,
            counts_per_unit: u32,
            [speed_max, peak]: [f64; 2],
            period: Duration,
        ) -> Self {
            let ratio = CountsRatio::new(counts_per_unit, 1).expect("not zero");
            let scale = Scale::new(axis, ratio, Sign::Positive, 0);
            let limits =
                AxisLimits { min: -1e6, max: 1e6, speed_max, acceleration_max: Some(peak) };
            let check = LimitCheck::new(axis, scale, limits, period, false);
            Limited { check, last: Commanded { counts: 0, step_counts: 0 } }
        }

        fn command(&mut self, target: f64) -> Result<(), String> {
            let counts = self.check.check(target, self.last)?;
            self.last = Commanded { counts, step_counts: counts - self.last.counts };
            Ok(())
        }
    }

    const ORIGIN: SetPoint = SetPoint { insertion_mm: 0.0, rotation_rad: 0.0 };

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2000))]

        /// The limits are the peaks themselves. The insertion is steered from one extreme to the other, held and
        /// released at any moment.
        #[test]
        fn an_insertion_keeps_to_its_peaks(
            depth_mm in 0.05..20.0f64,
            speed in 0.1..10.0f64,
            acceleration in 0.5..200.0f64,
            braking in 0.5..200.0f64,
            rate in 0.0..1.1f64,
            period_ms in prop::sample::select(vec![1u64, 4, 10, 50]),
            counts in prop::sample::select(vec![(100u32, 200u32), (4646, 12_058), (1_000_000, 300_000)]),
            events in prop::collection::vec((0..6u8, 1..400u32, -1.0..1.0f64), 1..12),
        ) {
            let period = Duration::from_millis(period_ms);
            let config = InsertionConfig {
                depth_mm,
                speed_mm_per_s: speed,
                acceleration_mm_per_s2: acceleration,
                step_mm: depth_mm,
                mode: InsertionMode::Continuous,
                arrival_mm: 0.05,
                settle: Duration::ZERO,
                samples: 1,
                plane_out_of_reach: PlaneOutOfReach::Refuse,
                corrected_by: Samples::All,
            };
            let peaks = [
                [speed, (PROFILE_PEAK * acceleration).max(braking)],
                [rate * speed, rotation_peak(rate, speed, period)].map(|x: f64| x.max(1e-9)),
            ];
            let mut along = Limited::new(Axis::Insertion, counts.0, peaks[0], period);
            let mut about = Limited::new(Axis::Rotation, counts.1, peaks[1], period);
            let mut insertion = Insertion::new(config, ORIGIN, ORIGIN);
            insertion.steer(rate);
            let mut last_mm = 0.0;
            for (event, periods, part) in events {
                match event {
                    0 => insertion.profile.hold(braking),
                    1 => insertion.profile.release(None),
                    // A step begins at standstill.
                    4 if insertion.is_standing(last_mm) => insertion.profile.release(Some(part.abs())),
                    4 => {}
                    5 => insertion.set_speed(speed * (1.0 - 0.9 * part.abs())).expect("within"),
                    2 => insertion.steer(rate * part),
                    _ => insertion.steer(rate * part.signum()),
                }
                for _ in 0..periods {
                    let SetPoint { insertion_mm, rotation_rad } = insertion.advance(period);
                    last_mm = insertion_mm;
                    prop_assert!(along.command(insertion_mm).is_ok(), "{:?}", along.command(insertion_mm));
                    prop_assert!(about.command(rotation_rad).is_ok(), "{:?}", about.command(rotation_rad));
                }
            }
        }
    }

    proptest! {
        /// A move that brakes at most as hard as a quick stop may end at the limit itself.
        #[test]
        fn a_profile_to_the_limit_could_stop_before_it(
            start in -20.0..20.0f64,
            distance in -20.0..20.0f64,
            speed in 0.1..10.0f64,
            acceleration in 0.5..200.0f64,
            counts in 50..20_000u32,
            period_ms in prop::sample::select(vec![1u64, 4, 10, 50]),
        ) {
            let period = Duration::from_millis(period_ms);
            let ratio = CountsRatio::new(counts, 1).expect("not zero");
            let scale = Scale::new(Axis::Insertion, ratio, Sign::Positive, 0);
            let goal = start + distance;
            let (min, max) = (start.min(goal), start.max(goal));
            let limits = AxisLimits { min, max, speed_max: 10.0, acceleration_max: None };
            let check = LimitCheck::new(Axis::Insertion, scale, limits, period, false)
                .with_quick_stop(Some(acceleration));
            let standing = scale.counts(start).expect("within");
            let mut limited = Limited { check, last: Commanded { counts: standing, step_counts: 0 } };
            let mut profile = Profile::new(speed, acceleration);
            profile.go_to(distance.abs());
            while profile.position_mm() < profile.goal_mm() {
                let gone = profile.advance(period);
                let target = if gone < distance.abs() { start + gone.copysign(distance) } else { start + distance };
                prop_assert_eq!(limited.command(target), Ok(()));
            }
            // Held there.
            prop_assert_eq!(limited.command(goal), Ok(()));
        }
    }

    /// This shows that the bound is not too high.
    #[test]
    fn a_profile_reaches_its_peak_acceleration() {
        let mut highest = 0.0f64;
        let period = Duration::from_millis(10);
        for n in 0..2000 {
            let mut profile = Profile::new(2.0, 10.0);
            profile.go_to(1.0 + f64::from(n) * 1e-4);
            let (mut at, mut speed) = (0.0, 0.0);
            while profile.position_mm() < profile.goal_mm() {
                let next = profile.advance(period);
                let now = (next - at) / 0.01;
                highest = highest.max((now - speed).abs() / 0.01);
                (at, speed) = (next, now);
            }
        }
        assert!((11.2..=11.25 + 1e-6).contains(&highest), "{highest} mm/s²");
    }

    #[test]
    fn the_rotation_peaks_when_it_reverses_from_one_sync_to_the_next() {
        let period = Duration::from_millis(10);
        // 60° a mm at 2 mm/s.
        assert!((rotation_peak(60.0, 2.0, period) - 24_000.0).abs() < 1e-9);
    }
}
