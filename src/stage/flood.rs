//! Notices a bus that carries much more than belongs there.

use std::time::Duration;

use crate::units::Time;

/// Over how long frames are counted.
const WINDOW: Duration = Duration::from_millis(100);

/// So many frames without effect in a window are a flood: some 5% of a bus at 1 Mbit/s.
const FRAMES_MIN: u64 = 50;

/// Counts frames by windows.
#[derive(Debug, Clone)]
pub(super) struct FloodWatch {
    window_ends: Time,
    /// All frames that were counted before this window.
    before: u64,
    flooded: bool,
}

impl FloodWatch {
    pub(super) fn new(now: Time) -> Self {
        FloodWatch { window_ends: now + WINDOW, before: 0, flooded: false }
    }

    /// Takes how many frames have come so far in all, at least once a window; gives the number of
    /// those in the window that ends with the first window of a flood.
    pub(super) fn look(&mut self, now: Time, so_far: u64) -> Option<u64> {
        if now < self.window_ends {
            return None;
        }
        let frames = so_far.saturating_sub(self.before);
        // What a late look has missed was spread over more than a window.
        let on_time = now < self.window_ends + WINDOW;
        let was_flooded = self.flooded;
        let flooded = frames >= FRAMES_MIN && on_time;
        *self = FloodWatch { window_ends: now + WINDOW, before: so_far, flooded };
        (flooded && !was_flooded).then_some(frames)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_is_told_once_each_time_it_begins() {
        let at = |ms: i64| Time::from_nanos(ms * 1_000_000);
        let mut watch = FloodWatch::new(at(0));
        assert_eq!(watch.look(at(50), 1000), None, "the window is not over");
        assert_eq!(watch.look(at(100), 49), None);
        assert_eq!(watch.look(at(200), 99), Some(50));
        assert_eq!(watch.look(at(300), 999), None, "it goes on");
        assert_eq!(watch.look(at(400), 1000), None, "it is over");
        assert_eq!(watch.look(at(500), 1200), Some(200));
        assert_eq!(watch.look(at(5000), 9000), None, "of an unknown rate");
    }
}
