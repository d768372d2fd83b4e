//! The time lines of the recording.

use crate::units::Time;
use rerun::TimeColumn;

/// The run's own time.
pub(super) const RUN_TIME: &str = "run_time";
/// Number of the step, the next one from a step to the next.
pub(super) const STEP: &str = "step";
/// Depth reached so far, µm: where the needle stands or is withdrawn, so does it. A time line that
/// ran back would put the rows of a chunk out of order, for it or for the others.
pub(super) const INSERTION_DEPTH: &str = "insertion_depth";

/// Where a row of the recording stands on every time line.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Moment {
    pub(super) time: Time,
    pub(super) step: u32,
    pub(super) depth_um: i64,
}

impl Moment {
    /// Moves on to the measured depth `insertion_mm`, where it is deeper; a depth that is not a
    /// number is passed over.
    pub(super) fn reach(&mut self, insertion_mm: f64) {
        if insertion_mm.is_finite() {
            self.depth_um = self.depth_um.max((insertion_mm * 1e3).round() as i64);
        }
    }
}

/// The moments of the rows that wait to be sent.
#[derive(Debug, Default)]
pub(super) struct Index(Vec<Moment>);

impl Index {
    pub(super) fn push(&mut self, moment: Moment) {
        self.0.push(moment);
    }

    pub(super) fn len(&self) -> usize {
        self.0.len()
    }

    pub(super) fn clear(&mut self) {
        self.0.clear();
    }

    pub(super) fn columns(&self) -> [TimeColumn; 3] {
        [
            TimeColumn::new_duration_nanos(RUN_TIME, self.0.iter().map(|m| m.time.as_nanos())),
            TimeColumn::new_sequence(STEP, self.0.iter().map(|m| m.step)),
            TimeColumn::new_sequence(INSERTION_DEPTH, self.0.iter().map(|m| m.depth_um)),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_depth_never_runs_back() {
        let mut moment = Moment::default();
        let depths_um = [1.0, 2.5, 2.499, f64::NAN, -3.0, 3.0].map(|insertion_mm| {
            moment.reach(insertion_mm);
            moment.depth_um
        });
        assert_eq!(depths_um, [1000, 2500, 2500, 2500, 2500, 3000]);
    }
}
