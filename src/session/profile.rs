//! The commanded depth over time: one axis, with constant acceleration and braking.

use std::time::Duration;

/// A trapezoidal speed profile towards a goal, sampled once a SYNC.
#[derive(Debug, Clone, Default)]
pub(crate) struct Profile {
    /// Speed limit, mm/s; a higher present speed is braked down to it.
    pub(super) speed_max_mm_per_s: f64,
    acceleration_mm_per_s2: f64,
    position_mm: f64,
    speed_mm_per_s: f64,
    goal_mm: f64,
    /// Depth at which a single step ends, short of the goal, mm.
    step_end_mm: Option<f64>,
    /// Braking while the insertion is held, mm/s².
    hold_braking_mm_per_s2: Option<f64>,
}

impl Profile {
    /// At rest at 0 mm, with the goal at 0 mm.
    pub(crate) fn new(speed_max_mm_per_s: f64, acceleration_mm_per_s2: f64) -> Self {
        Profile { speed_max_mm_per_s, acceleration_mm_per_s2, ..Profile::default() }
    }

    /// Sets the depth to stop at, or the stopping depth if that is deeper.
    pub(crate) fn go_to(&mut self, goal_mm: f64) {
        self.goal_mm = goal_mm.max(self.stopping_depth_mm());
    }

    /// The depth at which braking from now on would end, mm, at most the goal.
    pub(crate) fn stopping_depth_mm(&self) -> f64 {
        let braking_mm =
            0.5 * self.speed_mm_per_s * self.speed_mm_per_s / self.acceleration_mm_per_s2;
        (self.position_mm + braking_mm).min(self.goal_mm)
    }

    /// Brakes to a standstill short of the goal, at `braking_mm_per_s2`, until [`Profile::release`].
    pub(crate) fn hold(&mut self, braking_mm_per_s2: f64) {
        self.hold_braking_mm_per_s2 = Some(braking_mm_per_s2);
    }

    /// Goes on after a hold: to the goal, or by a single step of `step_mm`.
    pub(crate) fn release(&mut self, step_mm: Option<f64>) {
        self.hold_braking_mm_per_s2 = None;
        self.step_end_mm = step_mm.map(|mm| self.position_mm + mm);
    }

    /// True from the start of a single step until the next release.
    pub(crate) fn is_stepping(&self) -> bool {
        self.step_end_mm.is_some()
    }

    /// True when a single step has reached its end.
    pub(crate) fn has_finished_step(&self) -> bool {
        self.step_end_mm.is_some_and(|end_mm| self.position_mm >= end_mm)
    }

    /// How long a motion of `distance_mm` from rest to rest takes, s.
    pub(crate) fn motion_s(&self, distance_mm: f64) -> f64 {
        let (speed, a) = (self.speed_max_mm_per_s, self.acceleration_mm_per_s2);
        let ramps_mm = (speed * speed / a).min(distance_mm.max(0.0));
        2.0 * (ramps_mm / a).sqrt() + (distance_mm - ramps_mm) / speed
    }

    /// Depth at which the present motion ends, mm: the goal, or the end of a single step.
    fn end_mm(&self) -> f64 {
        self.step_end_mm.map_or(self.goal_mm, |end_mm| end_mm.min(self.goal_mm))
    }

    /// True while the commanded depth does not change.
    pub(crate) fn is_at_rest(&self) -> bool {
        self.speed_mm_per_s == 0.0
    }

    /// The depth at which a hold that starts one `period` from now would end, mm, at most. Braking once a
    /// period takes no more than the `v² / 2a` of continuous braking.
    pub(crate) fn hold_depth_mm(&self, braking_mm_per_s2: f64, period: Duration) -> f64 {
        let next = (self.speed_mm_per_s + self.acceleration_mm_per_s2 * period.as_secs_f64())
            .min(self.speed_max_mm_per_s.max(self.speed_mm_per_s));
        let braking_mm = 0.5 * next * next / braking_mm_per_s2;
        (self.position_mm + next * period.as_secs_f64() + braking_mm).min(self.end_mm())
    }

    /// Depth to stop at, mm.
    pub(crate) fn goal_mm(&self) -> f64 {
        self.goal_mm
    }

    /// Depth commanded last, mm.
    pub(crate) fn position_mm(&self) -> f64 {
        self.position_mm
    }

    /// The depth to command one `period` later, mm. It never passes the goal and never recedes.
    pub(crate) fn advance(&mut self, period: Duration) -> f64 {
        let dt = period.as_secs_f64();
        let end_mm = self.end_mm();
        let remaining_mm = end_mm - self.position_mm;
        let a = self.acceleration_mm_per_s2;
        // The speed from which braking once a period still ends at the goal.
        let half = 0.5 * a * dt;
        let braking = (half * half + 2.0 * a * remaining_mm).sqrt() - half;
        let speed_mm_per_s = match self.hold_braking_mm_per_s2 {
            Some(hold_braking_mm_per_s2) => {
                (self.speed_mm_per_s - hold_braking_mm_per_s2 * dt).max(0.0)
            }
            None if self.speed_mm_per_s > self.speed_max_mm_per_s => {
                (self.speed_mm_per_s - a * dt).max(self.speed_max_mm_per_s)
            }
            None => (self.speed_mm_per_s + a * dt).min(self.speed_max_mm_per_s),
        };
        self.speed_mm_per_s = speed_mm_per_s.min(braking);
        if remaining_mm <= self.speed_mm_per_s * dt || remaining_mm < 1e-9 {
            self.position_mm = end_mm;
            self.speed_mm_per_s = 0.0;
        } else {
            self.position_mm += self.speed_mm_per_s * dt;
        }
        self.position_mm
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// The goal is reached exactly, in about the time of the trapezoid.
        #[test]
        fn reaches_the_goal_within_the_limits(goal in 0.01..300.0f64, speed in 0.1..10.0f64, acceleration in 1.0..100.0f64) {
            let period = Duration::from_millis(10);
            let mut profile = Profile::new(speed, acceleration);
            profile.go_to(goal);
            let (mut last, mut last_speed, mut periods) = (0.0, 0.0, 0);
            while profile.position_mm() < goal {
                let at = profile.advance(period);
                let now = (at - last) / 0.01;
                prop_assert!(at >= last && at <= goal && now <= speed * (1.0 + 1e-9));
                prop_assert!((now - last_speed).abs() <= 0.01 * acceleration * 1.5 + 1e-6 || at == goal, "{last_speed} to {now}");
                (last, last_speed, periods) = (at, now, periods + 1);
                prop_assert!(periods < 400_000);
            }
            prop_assert!((f64::from(periods) * 0.01) < 1.1 * profile.motion_s(goal) + 0.1);
            prop_assert_eq!(profile.advance(period), goal);
        }

        /// The hold ends at most at `hold_depth_mm`, and at most the travel of a period before it. After its
        /// release the profile goes on to the goal.
        #[test]
        fn holds_within_its_braking_distance(speed in 0.1..10.0f64, braking in 1.0..100.0f64, after in 1..300u32) {
            let period = Duration::from_millis(10);
            let mut profile = Profile::new(speed, 10.0);
            profile.go_to(100.0);
            (0..after).for_each(|_| { profile.advance(period); });
            let hold_depth_mm = profile.hold_depth_mm(braking, period);
            profile.advance(period);
            profile.hold(braking);
            let mut periods = 0;
            while !profile.is_at_rest() {
                let before = profile.position_mm();
                prop_assert!(profile.advance(period) >= before);
                periods += 1;
                prop_assert!(periods <= 1001);
            }
            let spare_mm = hold_depth_mm - profile.position_mm();
            prop_assert!((-1e-9..=1.01 * speed * 0.01).contains(&spare_mm), "{spare_mm} mm");
            prop_assert_eq!(profile.advance(period), profile.position_mm());
            profile.release(None);
            (0..200_000).for_each(|_| { profile.advance(period); });
            prop_assert_eq!(profile.position_mm(), 100.0);
        }
    }
}
