//! Units and time.
//!
//! Inside the bench every quantity is an `f64` in mm, rad or per mm and says so in its name.
//! Degrees and drive counts appear only at the edges (config, command line, stage).

use std::f64::consts::PI;
use std::fmt;
use std::ops::{Add, Sub};
use std::time::Duration;

/// The hint for positions whose distances are a thousandth of the expected ones.
pub(crate) const IN_METRES: &str = "the positions look like metres; OpenIGTLink is in mm";

/// A point on the session's own time line, in nanoseconds since the run's origin.
///
/// Pure code takes a `Time` as an argument; it never reads a clock. The origin is the start of the
/// run, so a stamp from before the run is negative.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Time(i64);

impl Time {
    /// The origin of the run.
    pub const ZERO: Time = Time(0);
    /// Later than any other time: the deadline of a machine that waits for nothing.
    pub const NEVER: Time = Time(i64::MAX);

    /// The time `ns` nanoseconds after the origin.
    pub const fn from_nanos(ns: i64) -> Self {
        Time(ns)
    }

    /// The time `s` seconds after the origin, rounded to the nanosecond; saturates.
    pub fn from_secs_f64(s: f64) -> Self {
        Time((s * 1e9).round() as i64)
    }

    /// Nanoseconds since the origin.
    pub const fn as_nanos(self) -> i64 {
        self.0
    }

    /// Seconds since the origin.
    pub fn as_secs_f64(self) -> f64 {
        self.0 as f64 * 1e-9
    }

    /// Time elapsed since `earlier`; zero when `earlier` is later.
    pub fn since(self, earlier: Time) -> Duration {
        Duration::from_nanos(u64::try_from(self.0.saturating_sub(earlier.0)).unwrap_or(0))
    }

    /// Signed seconds from `earlier` to `self`.
    pub fn seconds_after(self, earlier: Time) -> f64 {
        self.0.saturating_sub(earlier.0) as f64 * 1e-9
    }
}

impl Add<Duration> for Time {
    type Output = Time;
    fn add(self, d: Duration) -> Time {
        Time(self.0.saturating_add(i64::try_from(d.as_nanos()).unwrap_or(i64::MAX)))
    }
}

impl Sub<Duration> for Time {
    type Output = Time;
    fn sub(self, d: Duration) -> Time {
        Time(self.0.saturating_sub(i64::try_from(d.as_nanos()).unwrap_or(i64::MAX)))
    }
}

impl fmt::Display for Time {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.3} s", self.as_secs_f64())
    }
}

/// The time `ms` milliseconds after the origin.
#[cfg(test)]
pub(crate) const fn at_ms(ms: i64) -> Time {
    Time::from_nanos(ms * 1_000_000)
}

/// The angle equal to `angle_rad` modulo 2π in (−π, π].
pub fn wrap_angle(angle_rad: f64) -> f64 {
    let wrapped = angle_rad - 2.0 * PI * (angle_rad / (2.0 * PI)).round();
    if wrapped <= -PI { wrapped + 2.0 * PI } else { wrapped }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_wrap_into_the_half_open_interval() {
        assert_eq!(wrap_angle(PI), PI);
        assert_eq!(wrap_angle(-PI), PI);
        assert!((wrap_angle(7.0) - (7.0 - 2.0 * PI)).abs() < 1e-15);
        assert!((wrap_angle(-1e3).sin() - (-1e3f64).sin()).abs() < 1e-12);
    }

    #[test]
    fn time_saturates_at_never_and_elapsed_time_at_zero() {
        assert_eq!(Time::NEVER + Duration::from_secs(1), Time::NEVER);
        assert_eq!(Time::ZERO.since(Time::from_secs_f64(1.0)), Duration::ZERO);
        assert_eq!(Time::from_secs_f64(1.5).since(Time::ZERO), Duration::from_millis(1500));
    }
}
