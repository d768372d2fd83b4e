//! A target that the tracker sees as a tool of its own.

use super::config::TrackerConfig;
use super::record::SampleRecord;
use super::tracking::HoldReason;
use crate::geometry::Pose;
use crate::tracker::gate::is_same_tool;
use crate::tracker::refusal::short;
use crate::tracker::{
    AcquisitionClock, Fix, Gate, GateName, Prediction, Refusal, Sample, Track, TrackState,
};
use crate::units::Time;
use nalgebra::{Matrix3, Vector3};
use std::collections::VecDeque;
use std::time::Duration;

/// The tool that is the target.
#[derive(Debug, Clone, PartialEq)]
pub struct TargetTool {
    /// The gate that judges a sample by itself. It holds the tool's name and the registration.
    pub gate: Gate,
    /// Where the target is expected, plane frame, mm: the end of the path planned before the run.
    pub expected_mm: Vector3<f64>,
    /// How far from there it may be, mm.
    pub range_mm: f64,
    /// Time over which its position is averaged.
    pub average: Duration,
}

/// The mean of the newest positions. It suits a target, which moves by less than the noise of its positions.
#[derive(Debug, Clone)]
pub struct MovingMean {
    over: Duration,
    newest: VecDeque<(Time, Vector3<f64>)>,
}

impl MovingMean {
    /// The mean of positions that were acquired within `over` of the newest one.
    pub fn new(over: Duration) -> Self {
        MovingMean { over, newest: VecDeque::new() }
    }

    /// Adds a position, mm, unless it was the last one added.
    pub fn take(&mut self, acquisition_time: Time, position_mm: Vector3<f64>) {
        if self.newest.back() == Some(&(acquisition_time, position_mm)) {
            return;
        }
        self.newest.push_back((acquisition_time, position_mm));
        let oldest = acquisition_time - self.over;
        while self.newest.pop_front_if(|(time, _)| *time < oldest).is_some() {}
    }

    /// Number of positions.
    pub fn count(&self) -> usize {
        self.newest.len()
    }

    /// The mean, mm, and the variance of each coordinate of one position, mm²; `None` before the first position.
    pub fn mean_and_variance(&self) -> Option<(Vector3<f64>, f64)> {
        let mean_mm = self.mean_mm()?;
        let squares_mm2 = self.newest.iter().map(|(_, mm)| (mm - mean_mm).norm_squared());
        Some((mean_mm, squares_mm2.sum::<f64>() / (3.0 * self.count() as f64)))
    }

    /// The mean, mm; `None` before the first position.
    pub fn mean_mm(&self) -> Option<Vector3<f64>> {
        let sum: Vector3<f64> = self.newest.iter().map(|(_, position_mm)| position_mm).sum();
        (!self.newest.is_empty()).then(|| sum / self.newest.len() as f64)
    }
}

/// The track of the target: the same gates as for the tip, and the mean of the last positions instead of
/// the observer's prediction.
pub(super) struct TargetTracking {
    tool: TargetTool,
    x_pw: Pose,
    clock: AcquisitionClock,
    track: Track,
    mean: MovingMean,
    noise_sd_mm: f64,
    hold_after: Duration,
    last_refusal: Option<Refusal>,
}

impl TargetTracking {
    pub(super) fn new(tool: TargetTool, tracker: &TrackerConfig, x_wp: &Pose) -> Self {
        TargetTracking {
            x_pw: x_wp.inverse(),
            clock: tracker.clock.clone(),
            track: Track::new(tracker.track),
            mean: MovingMean::new(tool.average),
            noise_sd_mm: tracker.track.noise_sd_mm,
            hold_after: tracker.hold.after,
            last_refusal: None,
            tool,
        }
    }

    /// True if `sample` is of the target.
    pub(super) fn is_own(&self, sample: &Sample) -> bool {
        is_same_tool(&sample.tool, &self.tool.gate.tool)
    }

    /// Forgets the offset of the sender's clock: a new connection may be another sender's.
    pub(super) fn reconnected(&mut self) {
        self.clock.reconnected();
    }

    /// Judges a sample of the target, with the needle at `insertion_mm`; `None` before the insertion.
    pub(super) fn take(&mut self, sample: Sample, insertion_mm: Option<f64>) -> SampleRecord {
        let judged = self.judge(&sample, insertion_mm);
        let mut record = SampleRecord::received(sample);
        match judged {
            Ok((acquisition_time, position_mm)) => {
                self.mean.take(acquisition_time, position_mm);
                record.acquisition_time = Some(acquisition_time);
                record.position_plane_mm = Some(position_mm);
                self.last_refusal = None;
            }
            Err(refusal) => {
                // Before the insertion the target may have been moved, so it is searched for again.
                if insertion_mm.is_none() && refusal.gate == GateName::Step {
                    self.mean = MovingMean::new(self.tool.average);
                }
                record.refused = Some(refusal.clone());
                self.last_refusal = Some(refusal);
            }
        }
        record
    }

    fn judge(
        &mut self,
        sample: &Sample,
        insertion_mm: Option<f64>,
    ) -> Result<(Time, Vector3<f64>), Refusal> {
        let (acquisition_time, position_mm) = match self.admit(sample) {
            Ok(admitted) => admitted,
            Err(refusal) => {
                self.track.note_refusal(&refusal);
                return Err(refusal);
            }
        };
        let receive_time = sample.receive_time;
        let fix = Fix { receive_time, acquisition_time, position_mm, insertion_mm };
        match insertion_mm {
            None => self.track.seek(fix)?,
            Some(_) => self.track.judge(fix, self.prediction().as_ref())?,
        }
        Ok((acquisition_time, position_mm))
    }

    /// Applies the gates that judge a sample by itself. Returns its acquisition time and position, plane
    /// frame, mm.
    fn admit(&mut self, sample: &Sample) -> Result<(Time, Vector3<f64>), Refusal> {
        let position_mm = self.x_pw.transform(&self.tool.gate.admit_as("target", sample)?);
        let TargetTool { expected_mm, range_mm: limit_mm, .. } = self.tool;
        let off_mm = (position_mm - expected_mm).norm();
        // Written so that NaN is refused.
        match off_mm <= limit_mm {
            true => Ok((self.clock.acquisition_time(sample)?, position_mm)),
            false => {
                let why = format!(
                    "the target is {} mm from goal.position_mm (limit {limit_mm:.1}, goal.tool_range_mm); \
                     another frame, or tool?",
                    short(off_mm)
                );
                Err(Refusal::new(GateName::Workspace, why))
            }
        }
    }

    /// Where the target is expected to be seen next: at the mean of its last positions.
    fn prediction(&self) -> Option<Prediction> {
        let position_mm = self.mean.mean_mm()?;
        let variance_mm2 = self.noise_sd_mm.powi(2) / self.mean.count() as f64;
        Some(Prediction {
            position_mm,
            heading: Vector3::zeros(),
            covariance_mm2: Some(Matrix3::identity() * variance_mm2),
            since_correction_mm: 0.0,
        })
    }

    /// Where the target is, plane frame, mm, once it is found.
    pub(super) fn position_mm(&self) -> Option<Vector3<f64>> {
        self.mean.mean_mm().filter(|_| self.track.is_established())
    }

    /// When its newest accepted position was acquired.
    pub(super) fn last_acquisition(&self) -> Option<Time> {
        self.track.last_believed().map(|fix| fix.acquisition_time)
    }

    /// Why the needle cannot be steered to the target at `now`; `None` while it can.
    pub(super) fn hold_reason(&self, now: Time) -> Option<HoldReason> {
        let limit_s = self.hold_after.as_secs_f64();
        let what = match self.last_acquisition().map(|last| now.seconds_after(last)) {
            None => "the target has not been seen".to_owned(),
            _ if self.track.state(now) == TrackState::Waiting => {
                "the target is not found yet: too few positions agree".to_owned()
            }
            _ if !self.track.is_established() => {
                let (refused, limit) = (self.track.refused_in_a_row(), self.track.lost_after());
                explain_loss(refused, limit)
            }
            Some(age_s) if age_s > limit_s => {
                format!("the target was last seen {age_s:.2} s ago (limit {limit_s:.2})")
            }
            Some(_) => return None,
        };
        let why = match &self.last_refusal {
            Some(refusal) => refusal.to_string(),
            None => format!("is \"{}\" in view? See goal.tool", self.tool.gate.tool),
        };
        Some(HoldReason { of: "target", what, why })
    }
}

/// Says that the target is lost. Positions that disagree with their mean lose it before `limit` are refused in a row.
fn explain_loss(refused: u32, limit: u32) -> String {
    match refused >= limit {
        true => format!("the target is lost, {refused} refused in a row (limit {limit})"),
        false => "the target is lost".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_count_under_its_limit_is_no_reason() {
        assert_eq!(explain_loss(5, 5), "the target is lost, 5 refused in a row (limit 5)");
        assert_eq!(explain_loss(1, 5), "the target is lost");
    }

    #[test]
    fn the_moving_mean_covers_the_newest_positions() {
        let mut mean = MovingMean::new(Duration::from_millis(100));
        assert_eq!(mean.mean_mm(), None);
        for k in 0..10u32 {
            let time = Time::from_nanos(i64::from(k) * 50_000_000);
            mean.take(time, Vector3::z() * f64::from(k));
        }
        assert_eq!(mean.mean_mm(), Some(Vector3::z() * 8.0), "of 7, 8 and 9");
    }
}
