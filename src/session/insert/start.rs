//! Whether an insertion may begin from where the tip and the target are seen.

use super::InsertTask;
use crate::session::config::PlaneOutOfReach;
use crate::session::reach::check_reach;
use crate::session::record::{Lane, Severity};
use crate::session::shell::Shell;
use crate::session::target::{MovingMean, TargetTracking};
use crate::units::Time;
use nalgebra::Vector3;
use std::time::Duration;

/// A start is refused only by the mean of the positions over this time, because of their noise.
const AVERAGE: Duration = Duration::from_millis(500);
/// Two positions are the same place if they are no farther apart than this many standard deviations of the noise
/// of a coordinate. Uniform noise cannot put two positions of the same place farther apart.
const SAME_PLACE_SDS: f64 = 6.0;

/// Where the tip and the target are seen, plane frame, mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Seen {
    tip_mm: Vector3<f64>,
    /// `None` if the target is not a tool of its own.
    target_mm: Option<Vector3<f64>>,
}

impl Seen {
    /// True if tip and target are no farther from where they are in `other` than `noise_mm`. False for NaN.
    fn is_near(&self, other: &Seen, noise_mm: f64) -> bool {
        let is_near = |(a, b): (Vector3<f64>, Vector3<f64>)| (a - b).norm() <= noise_mm;
        is_near((self.tip_mm, other.tip_mm))
            && self.target_mm.zip(other.target_mm).is_none_or(is_near)
    }
}

/// The bench's judgement of the start.
#[derive(Debug, Clone)]
pub(super) enum Start {
    /// The tip, or the target, is not seen.
    Unknown,
    /// In doubt since this time, with the mean of the positions since then.
    InDoubt(Time, MovingMean),
    /// Good, with tip and target at these positions.
    Accepted(Seen),
}

impl Start {
    /// The deadline of the wait for a start: `due`, or later if a doubt that began before `due` is not decided yet.
    pub(super) fn decided_by(&self, due: Time) -> Time {
        match self {
            Start::InDoubt(since, _) => due.max((*since).min(due) + AVERAGE),
            Start::Unknown | Start::Accepted(_) => due,
        }
    }
}

impl InsertTask {
    /// True if tip and target are seen, and the insertion may begin with them there. An accepted start is judged
    /// anew once one of them has moved by more than noise can.
    ///
    /// # Errors
    /// Why the insertion must not begin: the reason to stop the run.
    pub(super) fn accepts_start(&mut self, shell: &mut Shell) -> Result<bool, String> {
        let newest =
            self.tracking.track.last_believed().copied().filter(|_| self.is_seen(shell.now));
        let Some(newest) = newest else {
            self.start = Start::Unknown;
            return Ok(false);
        };
        let target_mm = self.target.as_ref().and_then(TargetTracking::position_mm);
        let seen = Seen { tip_mm: newest.position_mm, target_mm };
        let noise_mm = SAME_PLACE_SDS * self.config.tracker.track.noise_sd_mm;
        match &mut self.start {
            Start::Accepted(accepted) if seen.is_near(accepted, noise_mm) => return Ok(true),
            Start::InDoubt(since, mean) => {
                mean.take(newest.acquisition_time, newest.position_mm);
                if shell.now.since(*since) < AVERAGE {
                    return Ok(false);
                }
                let tip_mm = mean.mean_mm().unwrap_or(newest.position_mm);
                let on_average = Seen { tip_mm, ..seen };
                self.check_start(shell, &on_average)?;
                if seen.is_near(&on_average, noise_mm) {
                    self.start = Start::Accepted(on_average);
                    return Ok(true);
                }
            }
            Start::Accepted(_) | Start::Unknown => {}
        }
        let is_good = self.check_start(shell, &seen).is_ok();
        self.start = match is_good {
            true => Start::Accepted(seen),
            false => Start::InDoubt(shell.now, MovingMean::new(AVERAGE)),
        };
        Ok(is_good)
    }

    /// Checks that the plane, and the target if there is one, can be reached from where the tip is seen.
    fn check_start(&mut self, shell: &mut Shell, seen: &Seen) -> Result<(), String> {
        let steering = &mut self.estimation.steering;
        seen.target_mm.into_iter().for_each(|target_mm| steering.set_target(target_mm));
        steering.check_start(&seen.tip_mm).map_err(|why| format!("goal: {why}"))?;
        let Err(why) = check_reach(&self.config, &seen.tip_mm) else { return Ok(()) };
        match self.config.insertion.plane_out_of_reach {
            // The operator was warned when the start was first accepted.
            PlaneOutOfReach::Insert if matches!(self.start, Start::Accepted(_)) => Ok(()),
            PlaneOutOfReach::Insert => {
                shell.report(Lane::Session, Severity::Warning, why);
                Ok(())
            }
            PlaneOutOfReach::Refuse => {
                Err(format!("insertion: {why}; see insertion.plane_out_of_reach"))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_that_is_not_finite_is_near_no_other() {
        let seen = |tip_mm: f64, target_mm: f64| Seen {
            tip_mm: Vector3::x() * tip_mm,
            target_mm: Some(Vector3::z() * target_mm),
        };
        assert!(seen(1.0, 60.0).is_near(&seen(3.0, 62.0), 2.0));
        for other in [seen(3.1, 60.0), seen(1.0, 62.1), seen(f64::NAN, 60.0), seen(1.0, f64::NAN)] {
            assert!(!seen(1.0, 60.0).is_near(&other, 2.0), "{other:?}");
        }
    }
}
