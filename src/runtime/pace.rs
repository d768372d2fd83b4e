//! Virtual time at the pace of real time, for an operator who practises.

use crate::units::Time;
use std::thread;
use std::time::{Duration, Instant};

/// Longest wait: a key is served at least this often.
const STRIDE: Duration = Duration::from_millis(20);
/// A delay up to this long is caught up on; after a longer one, such as a suspended program, virtual time
/// goes on from where it was.
const CATCH_UP_MAX: Duration = Duration::from_millis(100);

/// Keeps virtual time from running ahead of the clock.
#[derive(Debug)]
pub struct Pace {
    /// When virtual time was zero.
    origin: Instant,
}

impl Pace {
    /// Virtual time is zero now.
    pub fn begin() -> Self {
        Pace { origin: Instant::now() }
    }

    /// Waits at `now` for `due`, at most a stride. Returns the time that is reached.
    pub(super) fn wait(&mut self, now: Time, due: Time) -> Time {
        let reached = due.min(now + STRIDE);
        let at = self.origin + reached.since(Time::ZERO);
        let late = at.elapsed();
        if late > CATCH_UP_MAX {
            self.origin += late;
        }
        thread::sleep(at.saturating_duration_since(Instant::now()));
        reached
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: i64) -> Time {
        Time::from_nanos(ms * 1_000_000)
    }

    #[test]
    fn virtual_time_is_never_ahead_of_the_clock() {
        let begun = Instant::now();
        let mut pace = Pace::begin();
        let mut now = Time::ZERO;
        // A deadline may have passed already.
        for due in [at(0), at(7), at(3), at(40), Time::NEVER, Time::NEVER] {
            now = now.max(pace.wait(now, due));
            assert!(begun.elapsed() >= now.since(Time::ZERO), "{now:?}");
        }
        assert_eq!(now, at(67), "in strides of 20 ms");
    }

    #[test]
    fn a_suspended_program_does_not_hurry_afterwards() {
        let mut pace = Pace::begin();
        thread::sleep(CATCH_UP_MAX * 2);
        pace.wait(at(0), at(1));
        let resumed = Instant::now();
        pace.wait(at(1), at(16));
        assert!(resumed.elapsed() >= Duration::from_millis(14), "{:?}", resumed.elapsed());
    }
}
