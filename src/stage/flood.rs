//! Notices a flood on the bus: many more frames than the stage expects.

use std::time::Duration;

use crate::units::Time;

/// How long frames are counted before the count is checked.
const WINDOW: Duration = Duration::from_millis(100);

/// This many frames in a window are a flood: about 5% of a bus at 1 Mbit/s.
const FRAMES_MIN: u64 = 50;

/// Counts the frames that are no part of the SYNC cycle or of the bring-up.
#[derive(Debug, Clone)]
pub(super) struct FloodWatch {
    window_ends: Time,
    /// Such frames in this window. The stage counts every frame, and takes an expected one off again.
    pub(super) frames: u64,
    flooded: bool,
}

impl FloodWatch {
    pub(super) fn new(now: Time) -> Self {
        FloodWatch { window_ends: now + WINDOW, frames: 0, flooded: false }
    }

    /// Returns the number of frames in the first window of a flood, at its end. Call it at least once a window.
    pub(super) fn check(&mut self, now: Time) -> Option<u64> {
        if now < self.window_ends {
            return None;
        }
        // If the check is late, the frames came in more time than a window.
        let on_time = now < self.window_ends + WINDOW;
        let FloodWatch { frames, flooded: was_flooded, .. } = *self;
        let flooded = frames >= FRAMES_MIN && on_time;
        *self = FloodWatch { window_ends: now + WINDOW, frames: 0, flooded };
        (flooded && !was_flooded).then_some(frames)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::at_ms;

    #[test]
    fn a_flood_is_reported_once_each_time_it_begins() {
        let mut watch = FloodWatch::new(at_ms(0));
        let mut check = |ms, frames| {
            watch.frames += frames;
            watch.check(at_ms(ms))
        };
        assert_eq!(check(50, 30), None, "the window is not over");
        assert_eq!(check(100, 19), None);
        assert_eq!(check(200, 50), Some(50));
        assert_eq!(check(300, 900), None, "still the same flood");
        assert_eq!(check(400, 1), None, "the flood has ended");
        assert_eq!(check(500, 200), Some(200));
        assert_eq!(check(5000, 7800), None, "the window is too long to give a rate");
    }
}
