//! A move with a ramp at each end, as in homing, and braking.

use std::time::Duration;

use crate::units::Time;

/// A move that ends with the axis at rest at `to`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Profile {
    start: Time,
    from: f64,
    to: f64,
    /// Acceleration, constant speed, deceleration.
    phases: [Phase; 3],
}

/// Uniform acceleration for some time.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Phase {
    seconds: f64,
    /// Speed at its beginning, counts/s.
    speed: f64,
    acceleration: f64,
}

impl Phase {
    fn distance(&self, seconds: f64) -> f64 {
        self.speed * seconds + 0.5 * self.acceleration * seconds * seconds
    }
}

impl Profile {
    /// The move to `to` of an axis at rest at `from`, with the limits of speed, counts/s, and of
    /// acceleration, counts/s².
    pub(super) fn new(now: Time, from: f64, to: f64, speed_max: f64, acceleration: f64) -> Self {
        let distance = (to - from).abs();
        let top = (distance * acceleration).sqrt().min(speed_max);
        let ramp_s = top / acceleration;
        let cruise_s = if top > 0.0 { (distance / top - ramp_s).max(0.0) } else { 0.0 };
        let direction = if to < from { -1.0 } else { 1.0 };
        let phase = |seconds, speed: f64, acceleration: f64| Phase {
            seconds,
            speed: direction * speed,
            acceleration: direction * acceleration,
        };
        let up = phase(ramp_s, 0.0, acceleration);
        let phases = [up, phase(cruise_s, top, 0.0), phase(ramp_s, top, -acceleration)];
        Profile { start: now, from, to, phases }
    }

    /// Uniform braking from `speed` to a stop at `to` after `seconds`.
    pub(super) fn braking(now: Time, from: f64, speed: f64, to: f64, seconds: f64) -> Self {
        let brake = Phase { seconds, speed, acceleration: -speed / seconds };
        Profile { start: now, from, to, phases: [brake, Phase::default(), Phase::default()] }
    }

    /// When the axis will stand.
    pub(super) fn end(&self) -> Time {
        let seconds: f64 = self.phases.iter().map(|phase| phase.seconds).sum();
        self.start + Duration::try_from_secs_f64(seconds).unwrap_or_default()
    }

    /// Where the move ends.
    pub(super) fn to(&self) -> f64 {
        self.to
    }

    /// Position in counts; exactly the end point from the end on.
    pub(super) fn position_at(&self, now: Time) -> f64 {
        if now >= self.end() {
            return self.to;
        }
        let mut remaining_s = now.seconds_after(self.start).max(0.0);
        let mut position = self.from;
        for phase in &self.phases {
            let seconds = remaining_s.min(phase.seconds);
            position += phase.distance(seconds);
            remaining_s -= seconds;
        }
        position
    }

    /// Velocity in counts per second.
    pub(super) fn velocity_at(&self, now: Time) -> f64 {
        let mut remaining_s = now.seconds_after(self.start).max(0.0);
        for phase in &self.phases {
            if remaining_s < phase.seconds {
                return phase.speed + phase.acceleration * remaining_s;
            }
            remaining_s -= phase.seconds;
        }
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A move at up to 1000 counts/s, with 2000 counts/s².
    fn profile(from: f64, to: f64) -> Profile {
        Profile::new(at(0.0), from, to, 1000.0, 2000.0)
    }

    fn at(seconds: f64) -> Time {
        Time::from_secs_f64(seconds)
    }

    /// It accelerates in 0.5 s over 250 counts, and brakes in the same.
    #[test]
    fn a_long_move_is_a_trapezoid() {
        let profile = profile(0.0, -1500.0);
        assert!((profile.end().as_secs_f64() - 2.0).abs() < 1e-9);
        assert!((profile.position_at(at(0.5)) + 250.0).abs() < 1e-6);
        assert!((profile.velocity_at(at(1.0)) + 1000.0).abs() < 1e-6);
        assert!((profile.position_at(at(1.5)) + 1250.0).abs() < 1e-6);
        assert_eq!(profile.position_at(at(2.1)), -1500.0);
        assert_eq!(profile.velocity_at(at(2.1)), 0.0);
    }

    #[test]
    fn a_short_move_is_a_triangle() {
        let peak = (300.0_f64 * 2000.0).sqrt();
        assert!(peak < 1000.0);
        let seconds = 2.0 * peak / 2000.0;
        assert!((profile(0.0, 300.0).end().as_secs_f64() - seconds).abs() < 1e-8);
    }

    proptest! {
        /// The axis moves without a jump and within its speed, and stands at the target at the end.
        #[test]
        fn moves_are_smooth_and_end_at_their_target(
            from in -5000.0..5000.0f64,
            to in -5000.0..5000.0f64,
        ) {
            let profile = profile(from, to);
            let end = profile.end().as_secs_f64();
            let fastest = 1000.0 + 1e-6;
            let steps = 500;
            let dt = end / f64::from(steps);
            let mut before = from;
            for n in 0..=steps {
                let now = at(dt * f64::from(n));
                let position = profile.position_at(now);
                prop_assert!((position - before).abs() <= fastest * dt + 1e-3);
                prop_assert!(profile.velocity_at(now).abs() <= fastest);
                before = position;
            }
            prop_assert_eq!(profile.position_at(at(end + 1.0)), to);
            prop_assert!((before - to).abs() <= 1e-3, "{} of {}", before, to);
        }
    }
}
