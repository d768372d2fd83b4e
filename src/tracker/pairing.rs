//! Where the stage was when a sample was measured, and how it has moved since.

use crate::units::Time;
use std::collections::VecDeque;

/// A measured position of the stage.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StagePoint {
    /// When it was latched: the time of the SYNC.
    pub time: Time,
    /// Insertion depth ℓ, mm.
    pub insertion_mm: f64,
    /// Rotation of the needle's base, rad, not wrapped.
    pub rotation_rad: f64,
}

/// The stage's motion between two times.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct StageIncrement {
    /// Change of depth, mm; negative on withdrawal.
    pub insertion_mm: f64,
    /// Change of rotation, rad.
    pub rotation_rad: f64,
}

/// The stage's measured positions of the last seconds, interpolated linearly.
#[derive(Debug, Clone)]
pub struct StageHistory {
    points: VecDeque<StagePoint>,
    capacity: usize,
}

impl StagePoint {
    /// The position at `time`, on the straight line from `self` to `later`.
    fn interpolate(&self, later: &StagePoint, time: Time) -> StagePoint {
        let fraction = time.seconds_after(self.time) / later.time.seconds_after(self.time);
        let moved = later.since(self);
        StagePoint {
            time,
            insertion_mm: self.insertion_mm + fraction * moved.insertion_mm,
            rotation_rad: self.rotation_rad + fraction * moved.rotation_rad,
        }
    }

    /// The stage's motion from `earlier` to here.
    pub fn since(&self, earlier: &StagePoint) -> StageIncrement {
        StageIncrement {
            insertion_mm: self.insertion_mm - earlier.insertion_mm,
            rotation_rad: self.rotation_rad - earlier.rotation_rad,
        }
    }
}

impl StageHistory {
    /// A history of the last `capacity` positions (at least two; a thousand are 10 s of SYNCs
    /// every 10 ms).
    pub fn new(capacity: usize) -> Self {
        let capacity = capacity.max(2);
        StageHistory { points: VecDeque::with_capacity(capacity), capacity }
    }

    /// Adds the position of a SYNC. A full history drops its oldest.
    ///
    /// # Errors
    /// The position is not later than the newest one. It is not added.
    pub fn push(&mut self, point: StagePoint) -> Result<(), String> {
        if let Some(newest) = self.newest()
            && point.time <= newest.time
        {
            return Err(format!(
                "stage: position of {} came after that of {}",
                point.time, newest.time
            ));
        }
        if self.points.len() == self.capacity {
            self.points.pop_front();
        }
        self.points.push_back(point);
        Ok(())
    }

    /// The last position added.
    pub fn newest(&self) -> Option<&StagePoint> {
        self.points.back()
    }

    /// The stage at `time`: on the line between the positions before and after.
    ///
    /// # Errors
    /// `time` is before the oldest position kept, or after the newest one.
    pub fn at(&self, time: Time) -> Result<StagePoint, String> {
        let (Some(oldest), Some(newest)) = (self.points.front(), self.points.back()) else {
            return Err("tracker: no stage position is known yet to pair a sample with".to_owned());
        };
        if time < oldest.time {
            return Err(format!(
                "tracker: sample of {time} is {:.3} s older than the oldest stage position kept; is \
                 tracker.latency_ms right, and does the sender's clock run?",
                oldest.time.seconds_after(time)
            ));
        }
        if time > newest.time {
            return Err(format!(
                "tracker: sample of {time} is {:.3} s newer than the last stage position; the stage's \
                 positions have stopped",
                time.seconds_after(newest.time)
            ));
        }
        let next = self.points.partition_point(|point| point.time <= time);
        Ok(match self.points.get(next) {
            Some(after) => self.points[next - 1].interpolate(after, time),
            None => *newest,
        })
    }

    /// The stage's path from `from` to `to`, in order: one increment from each position to the
    /// next, the first and last cut to the times asked for. Their sum is the whole motion.
    ///
    /// # Errors
    /// As [`StageHistory::at`] for either end; `to` is before `from`.
    pub fn between(
        &self,
        from: Time,
        to: Time,
    ) -> Result<impl Iterator<Item = StageIncrement> + '_, String> {
        if to < from {
            return Err(format!("tracker: no stage motion from {from} back to {to}"));
        }
        let (start, end) = (self.at(from)?, self.at(to)?);
        let first = self.points.partition_point(|point| point.time <= from);
        let last = self.points.partition_point(|point| point.time < to).max(first);
        let within = self.points.range(first..last).copied();
        Ok(within.chain([end]).scan(start, |previous, next| {
            let increment = next.since(previous);
            *previous = next;
            Some(increment)
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::time::Duration;

    fn ms(ms: f64) -> Time {
        Time::from_secs_f64(ms * 1e-3)
    }

    fn point(at_ms: f64, insertion_mm: f64, rotation_rad: f64) -> StagePoint {
        StagePoint { time: ms(at_ms), insertion_mm, rotation_rad }
    }

    fn history() -> StageHistory {
        let mut history = StageHistory::new(4);
        for (i, depth, turn) in [(0, 0.0, 0.0), (1, 1.0, 2.0), (2, 3.0, 2.0), (3, 3.0, -4.0)] {
            history.push(point(f64::from(i) * 10.0, depth, turn)).expect("in order");
        }
        history
    }

    #[test]
    fn positions_are_interpolated() {
        let history = history();
        assert_eq!(history.at(ms(5.0)), Ok(point(5.0, 0.5, 1.0)));
        assert_eq!(history.at(ms(10.0)), Ok(point(10.0, 1.0, 2.0)));
        assert_eq!(history.at(ms(30.0)), Ok(point(30.0, 3.0, -4.0)));
    }

    #[test]
    fn times_outside_are_refused_with_numbers() {
        assert_eq!(
            StageHistory::new(4).at(ms(0.0)).expect_err("no position"),
            "tracker: no stage position is known yet to pair a sample with"
        );
        let mut history = history();
        assert_eq!(
            history.at(ms(50.0)).expect_err("too new"),
            "tracker: sample of 0.050 s is 0.020 s newer than the last stage position; the stage's \
             positions have stopped"
        );
        history.push(point(40.0, 3.0, 0.0)).expect("in order"); // drops the oldest
        let old =
            "tracker: sample of 0.004 s is 0.006 s older than the oldest stage position kept; ";
        let error = history.at(ms(4.0)).expect_err("too old");
        assert!(error.starts_with(old), "{error}");
        assert_eq!(
            history.push(point(40.0, 4.0, 0.0)).expect_err("out of order"),
            "stage: position of 0.040 s came after that of 0.040 s"
        );
    }

    #[test]
    fn the_path_keeps_every_corner() {
        let history = history();
        let path: Vec<_> = history.between(ms(5.0), ms(25.0)).expect("known").collect();
        let increment = |insertion_mm, rotation_rad| StageIncrement { insertion_mm, rotation_rad };
        assert_eq!(path, [increment(0.5, 1.0), increment(2.0, 0.0), increment(0.0, -3.0)]);
        let whole: Vec<_> = history.between(ms(10.0), ms(20.0)).expect("known").collect();
        assert_eq!(whole, [increment(2.0, 0.0)]);
        let still: Vec<_> = history.between(ms(30.0), ms(30.0)).expect("known").collect();
        assert_eq!(still, [increment(0.0, 0.0)]);
        let back = history.between(ms(2.0), ms(1.0)).err();
        let expected = "tracker: no stage motion from 0.002 s back to 0.001 s";
        assert_eq!(back.as_deref(), Some(expected));
    }

    proptest! {
        #[test]
        fn a_path_adds_up_to_the_motion(
            motions in prop::collection::vec((0.1..30.0f64, -2.0..2.0f64, -7.0..7.0f64), 1..60),
            a in 0.0..1.0f64,
            b in 0.0..1.0f64,
        ) {
            let mut history = StageHistory::new(32);
            let mut at = point(0.0, 0.0, 0.0);
            for (step_ms, depth, turn) in motions {
                history.push(at).expect("in order");
                at = StagePoint {
                    time: at.time + Duration::from_secs_f64(step_ms * 1e-3),
                    insertion_mm: at.insertion_mm + depth,
                    rotation_rad: at.rotation_rad + turn,
                };
            }
            let (oldest, newest) = (history.points[0].time, history.points.back().map(|p| p.time));
            let span = newest.expect("not empty").since(oldest);
            let (from, to) = (oldest + span.mul_f64(a.min(b)), oldest + span.mul_f64(a.max(b)));
            let sum = history.between(from, to).expect("known").fold(
                StageIncrement::default(),
                |sum, step| StageIncrement {
                    insertion_mm: sum.insertion_mm + step.insertion_mm,
                    rotation_rad: sum.rotation_rad + step.rotation_rad,
                },
            );
            let moved = history.at(to).expect("known").since(&history.at(from).expect("known"));
            prop_assert!((sum.insertion_mm - moved.insertion_mm).abs() < 1e-9);
            prop_assert!((sum.rotation_rad - moved.rotation_rad).abs() < 1e-9);
            prop_assert!(history.points.len() <= 32);
        }
    }
}
