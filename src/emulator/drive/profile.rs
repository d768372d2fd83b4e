//! A move with a ramp at each end, as in homing, and braking.

use std::time::Duration;

use crate::units::Time;

/// Limits of a move in counts and seconds; each is over zero.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Ramps {
    pub(super) speed: f64,
    pub(super) acceleration: f64,
    pub(super) deceleration: f64,
}

/// A move from any speed to standstill at `to`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Profile {
    start: Time,
    from: f64,
    to: f64,
    /// Braking, if the axis moves away from the target or is too fast to stop in time; then
    /// acceleration, constant speed, deceleration.
    phases: [Phase; 4],
}

/// Uniform acceleration for some time.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Phase {
    seconds: f64,
    /// At its beginning, counts/s.
    speed: f64,
    acceleration: f64,
}

impl Phase {
    /// From one speed to another. It takes no time when they are equal.
    fn ramp(from: f64, to: f64, rate: f64) -> Self {
        let acceleration = rate.copysign(to - from);
        Phase { seconds: (to - from) / acceleration, speed: from, acceleration }
    }

    fn distance(&self, seconds: f64) -> f64 {
        self.speed * seconds + 0.5 * self.acceleration * seconds * seconds
    }
}

impl Profile {
    /// The move to `to` of an axis at `from` that has `speed`.
    pub(super) fn new(now: Time, from: f64, speed: f64, to: f64, ramps: Ramps) -> Self {
        let Ramps { speed: speed_max, acceleration, deceleration } = ramps;
        let stops_at = from + speed * speed.abs() / (2.0 * deceleration);
        let overshoots = speed * (to - from) < 0.0 || (to - stops_at) * speed < 0.0;
        let (brake, from_then, speed_then) = if overshoots {
            (Phase::ramp(speed, 0.0, deceleration), stops_at, 0.0)
        } else {
            (Phase::default(), from, speed)
        };
        let direction = if to < from_then { -1.0 } else { 1.0 };
        let (distance, begin) = ((to - from_then).abs(), speed_then.abs());
        // The peak speed of a move without a part at constant speed.
        let peak = ((distance + begin * begin / (2.0 * acceleration))
            / (0.5 / acceleration + 0.5 / deceleration))
            .sqrt();
        let top = peak.min(speed_max);
        let rate = if top < begin { deceleration } else { acceleration };
        let up = Phase::ramp(direction * begin, direction * top, rate);
        let down = Phase::ramp(direction * top, 0.0, deceleration);
        let ramps = (up.distance(up.seconds) + down.distance(down.seconds)).abs();
        let seconds = if top > 0.0 { ((distance - ramps) / top).max(0.0) } else { 0.0 };
        let along = Phase { seconds, speed: direction * top, acceleration: 0.0 };
        Profile { start: now, from, to, phases: [brake, up, along, down] }
    }

    /// Uniform braking from `speed`, to stand at `to` after this time.
    pub(super) fn braking(now: Time, from: f64, speed: f64, to: f64, seconds: f64) -> Self {
        let brake = Phase { seconds, speed, acceleration: -speed / seconds };
        let phases = [brake, Phase::default(), Phase::default(), Phase::default()];
        Profile { start: now, from, to, phases }
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
        let mut left = now.seconds_after(self.start).max(0.0);
        let mut position = self.from;
        for phase in &self.phases {
            let seconds = left.min(phase.seconds);
            position += phase.distance(seconds);
            left -= seconds;
        }
        position
    }

    /// Velocity in counts per second.
    pub(super) fn velocity_at(&self, now: Time) -> f64 {
        let mut left = now.seconds_after(self.start).max(0.0);
        for phase in &self.phases {
            if left < phase.seconds {
                return phase.speed + phase.acceleration * left;
            }
            left -= phase.seconds;
        }
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const RAMPS: Ramps = Ramps { speed: 1000.0, acceleration: 2000.0, deceleration: 4000.0 };

    fn at(seconds: f64) -> Time {
        Time::from_secs_f64(seconds)
    }

    /// Up in 0.5 s (250 counts), along, down in 0.25 s (125 counts).
    #[test]
    fn a_long_move_is_a_trapezoid() {
        let profile = Profile::new(at(0.0), 0.0, 0.0, -1375.0, RAMPS);
        assert!((profile.end().as_secs_f64() - 1.75).abs() < 1e-9);
        assert!((profile.position_at(at(0.5)) + 250.0).abs() < 1e-6);
        assert!((profile.velocity_at(at(1.0)) + 1000.0).abs() < 1e-6);
        assert!((profile.position_at(at(1.5)) + 1250.0).abs() < 1e-6);
        assert_eq!(profile.position_at(at(2.0)), -1375.0);
        assert_eq!(profile.velocity_at(at(2.0)), 0.0);
    }

    /// 1.5 counts: 0.5 at 2000 counts/s² or so up, the rest at twice that down.
    #[test]
    fn a_short_move_is_a_triangle() {
        let profile = Profile::new(at(0.0), 0.0, 0.0, 300.0, RAMPS);
        let peak = (300.0_f64 / (1.0 / 4000.0 + 1.0 / 8000.0)).sqrt();
        assert!(peak < 1000.0);
        let seconds = peak / 2000.0 + peak / 4000.0;
        assert!((profile.end().as_secs_f64() - seconds).abs() < 1e-8);
    }

    proptest! {
        /// Whatever the axis does at the begin: it moves without a jump, never faster than it may
        /// or did, and stands at the target at the end.
        #[test]
        fn moves_are_smooth_and_end_at_their_target(
            from in -5000.0..5000.0f64,
            speed in -3000.0..3000.0f64,
            to in -5000.0..5000.0f64,
        ) {
            let profile = Profile::new(at(0.0), from, speed, to, RAMPS);
            let end = profile.end().as_secs_f64();
            let fastest = speed.abs().max(1000.0) + 1e-6;
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
