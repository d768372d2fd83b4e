//! The motion of the axis: standing, at constant speed, braking, or with ramps.

use std::time::Duration;

use super::profile::Profile;
use crate::units::Time;

/// A piece of motion, in counts that are not wrapped. The axis stands before it starts and after it
/// ends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Motion {
    /// Standing.
    Hold { at: f64 },
    /// At constant speed.
    Linear { start: Time, end: Time, from: f64, to: f64 },
    /// Slowing down uniformly, to stand where it ends.
    Brake(Profile),
    /// With ramps, to stand where it ends.
    Ramped(Profile),
}

impl Motion {
    /// From `from` to `to` at constant speed, in `period`.
    pub(super) fn linear(now: Time, from: f64, to: f64, period: Duration) -> Self {
        Motion::Linear { start: now, end: now + period, from, to }
    }

    /// Position in counts; exactly the end point from the end on.
    pub(super) fn position_at(&self, now: Time) -> f64 {
        match *self {
            Motion::Hold { at } => at,
            Motion::Linear { end, to, .. } if now >= end => to,
            Motion::Linear { start, end, from, to } => {
                let part = (now.seconds_after(start) / end.seconds_after(start)).max(0.0);
                from + (to - from) * part
            }
            Motion::Brake(profile) | Motion::Ramped(profile) => profile.position_at(now),
        }
    }

    /// Velocity in counts per second. At the end of a linear piece it is still the piece's speed,
    /// because the next piece usually starts there.
    pub(super) fn velocity_at(&self, now: Time) -> f64 {
        match *self {
            Motion::Hold { .. } => 0.0,
            Motion::Linear { end, .. } if now > end => 0.0,
            Motion::Linear { start, end, from, to } => {
                let seconds = end.seconds_after(start);
                if seconds > 0.0 { (to - from) / seconds } else { 0.0 }
            }
            Motion::Brake(profile) | Motion::Ramped(profile) => profile.velocity_at(now),
        }
    }

    /// When the axis will stand; `None` when it stands already.
    pub(super) fn end(&self) -> Option<Time> {
        match *self {
            Motion::Hold { .. } => None,
            Motion::Linear { end, .. } => Some(end),
            Motion::Brake(profile) | Motion::Ramped(profile) => Some(profile.end()),
        }
    }

    /// The profile of a motion with ramps, after which the axis stands.
    pub(super) fn profile(&self) -> Option<&Profile> {
        match self {
            Motion::Brake(profile) | Motion::Ramped(profile) => Some(profile),
            Motion::Hold { .. } | Motion::Linear { .. } => None,
        }
    }

    /// Where the axis will stand; a linear piece usually has a successor.
    pub(super) fn to(&self) -> f64 {
        match *self {
            Motion::Hold { at } => at,
            Motion::Linear { to, .. } => to,
            Motion::Brake(profile) | Motion::Ramped(profile) => profile.to(),
        }
    }

    /// When the axis first reaches `at` between `now` and the end of the piece. `None` when it does not
    /// reach it, or is there or past it already.
    pub(super) fn reaches(&self, now: Time, at: f64) -> Option<Time> {
        let (end, here) = (self.end()?, self.position_at(now));
        let there = |time: Time| (self.position_at(time) - at) * (at - here) >= 0.0;
        if here == at || end <= now || !there(end) {
            return None;
        }
        // To the nanosecond, the resolution of the clock.
        let (mut before, mut after) = (now.as_nanos(), end.as_nanos());
        while after - before > 1 {
            let middle = before + (after - before) / 2;
            if there(Time::from_nanos(middle)) { after = middle } else { before = middle }
        }
        Some(Time::from_nanos(after))
    }

    /// Slows down from the present speed at `deceleration` counts/s². The deceleration is adjusted so that
    /// the axis stands on a whole count.
    pub(super) fn brake(&self, now: Time, deceleration: f64) -> Self {
        let from = self.position_at(now);
        let speed = self.velocity_at(now);
        let to = (from + speed * speed.abs() / (2.0 * deceleration)).round();
        let seconds = 2.0 * (to - from) / speed;
        if speed == 0.0 || seconds.is_nan() || seconds <= 0.0 {
            return Motion::Hold { at: from };
        }
        Motion::Brake(Profile::braking(now, from, speed, to, seconds))
    }

    /// Shifts a linear piece that is more than half over so that it ends at `now`: the drive's clock follows
    /// a SYNC that comes a little early.
    pub(super) fn align_to_sync(&mut self, now: Time) {
        if let Motion::Linear { start, end, .. } = self
            && now < *end
            && now.since(*start) > end.since(now)
        {
            // Not shortened: the speed at which a stop would begin does not change.
            *start = now - end.since(*start);
            *end = now;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::at_ms;

    const PERIOD: Duration = Duration::from_millis(10);

    #[test]
    fn linear_motion_ends_exactly() {
        let motion = Motion::linear(at_ms(0), 0.1, 1e9 + 1.0, PERIOD);
        assert_eq!(motion.position_at(at_ms(0)), 0.1);
        assert_eq!(motion.position_at(at_ms(10)), 1e9 + 1.0);
        assert_eq!(motion.position_at(at_ms(99)), 1e9 + 1.0);
        assert_eq!(motion.velocity_at(at_ms(11)), 0.0);
        let at_once = Motion::linear(at_ms(5), 1.0, 2.0, Duration::ZERO);
        assert_eq!([at_once.position_at(at_ms(4)), at_once.position_at(at_ms(5))], [1.0, 2.0]);
    }

    #[test]
    fn braking_starts_at_speed_and_stands_on_a_whole_count() {
        let motion = Motion::linear(at_ms(0), 0.0, -100.0, PERIOD);
        let brake = motion.brake(at_ms(5), 1e5);
        assert_eq!(brake.position_at(at_ms(5)), -50.0);
        assert!((brake.velocity_at(at_ms(5)) + 1e4).abs() < 1e-6);
        let end = brake.end().unwrap();
        assert_eq!(brake.position_at(end), -550.0, "v²/2a = 500 counts");
        assert!((end.as_secs_f64() - 0.105).abs() < 1e-9);
        assert!(brake.velocity_at(at_ms(55)) < 0.0 && brake.velocity_at(end) == 0.0);
    }

    #[test]
    fn a_position_on_the_way_has_the_time_at_which_it_is_reached() {
        let motion = Motion::linear(at_ms(0), 0.0, -100.0, PERIOD);
        assert_eq!(motion.reaches(at_ms(0), -40.0), Some(at_ms(4)));
        assert_eq!(motion.reaches(at_ms(6), -40.0), None, "already passed");
        assert_eq!(motion.reaches(at_ms(0), 40.0), None, "in the other direction");
        assert_eq!(motion.reaches(at_ms(0), -100.5), None, "too far");
        assert_eq!(motion.reaches(at_ms(0), -100.0), Some(at_ms(10)));
        let brake = motion.brake(at_ms(5), 1e5);
        let reached = brake.reaches(at_ms(5), -400.0).unwrap();
        assert!((brake.position_at(reached) + 400.0).abs() < 1e-3);
    }

    #[test]
    fn a_standing_axis_does_not_move_to_brake() {
        let hold = Motion::Hold { at: 3.25 };
        assert_eq!(hold.brake(at_ms(1), 1.0), hold);
    }

    #[test]
    fn an_early_sync_ends_the_period_and_a_stray_one_does_not() {
        let mut motion = Motion::linear(at_ms(0), 0.0, 100.0, PERIOD);
        motion.align_to_sync(at_ms(2));
        assert_eq!(motion.position_at(at_ms(2)), 20.0);
        motion.align_to_sync(at_ms(9));
        assert_eq!(motion.position_at(at_ms(9)), 100.0);
        assert_eq!(motion.velocity_at(at_ms(9)), 10_000.0);
    }
}
