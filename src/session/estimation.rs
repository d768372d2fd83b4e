//! The steering of a run, carried along the stage's measured path.

use super::config::SessionConfig;
use super::steering::{Decision, Steering};
use crate::geometry::Pose;
use crate::needle::{Increment, Needle, TipPosition};
use crate::tracker::{GateName, Prediction, Refusal, StageHistory, StageIncrement};
use crate::units::Time;
use nalgebra::{Matrix3, Vector3};
use std::time::Duration;

/// A tip position in the plane frame, with the time and the depth at which the tip was there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Measurement {
    pub(crate) acquisition_time: Time,
    /// In the stage's own coordinates. An [insertion](super::insertion::Insertion) counts its depth from
    /// where it began.
    pub(crate) stage_insertion_meas_mm: f64,
    pub(crate) tip_meas: TipPosition,
    /// Number of tracked positions averaged into it.
    pub(crate) positions: u32,
}

/// The corrections of the observers since the last step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Corrections {
    /// The newest measurement.
    pub(crate) newest: Measurement,
    /// Its innovation in the observer that steers, mm; `None` if that observer had no estimate yet.
    pub(crate) innovation_mm: Option<Vector3<f64>>,
    /// Number of tracked positions in all corrections.
    pub(crate) positions: u32,
}

/// The run's steering, along the stage's measured path. The states of all observers belong to the same
/// instant. Estimates for later times are predicted from there and do not change the states.
pub(crate) struct Estimation {
    pub(super) steering: Steering,
    /// The instant to which the observers' states belong.
    observed_to: Option<Time>,
    needle: Needle,
    /// The tip at that instant, by the observer that steers; `None` while it has no estimate.
    predicted: Option<PredictedTip>,
    /// The corrections since the last step.
    pub(super) corrections: Option<Corrections>,
    /// Acquisition time of the last measurement that corrected the observers.
    corrected_at: Option<Time>,
    /// Acquisition time of the newest position, and its interval from the position before, s.
    newest_at: Option<Time>,
    spacing_s: f64,
    /// The instant to which the handedness watch has been predicted.
    watched_to: Option<Time>,
    /// Positions that have not corrected the handedness watch yet.
    batch: Batch,
}

/// Positions that correct the handedness watch as one mean.
#[derive(Debug, Clone, Copy, Default)]
struct Batch {
    first: Option<Time>,
    /// Sum of the acquisition times, counted from the first.
    after: Duration,
    position_sum_mm: Vector3<f64>,
    count: u32,
}

impl Batch {
    fn add(&mut self, measurement: &Measurement) {
        let first = *self.first.get_or_insert(measurement.acquisition_time);
        self.after += measurement.acquisition_time.since(first);
        self.position_sum_mm += measurement.tip_meas.mm();
        self.count += 1;
    }

    /// Mean time of acquisition and mean position; `None` without positions.
    fn mean(&self) -> Option<(Time, TipPosition)> {
        let time = self.first? + self.after / self.count;
        Some((time, TipPosition::new(self.position_sum_mm / f64::from(self.count))?))
    }
}

/// The tip predicted from an estimate by the kinematics of the configured needle alone. Over the millimetre
/// from one correction to the next it differs from the observer's own prediction only by what the observer
/// has learnt about the needle: 0.002 mm for a curvature of 1/122 per mm that is 50% off.
#[derive(Debug, Clone, Copy)]
struct PredictedTip {
    x_pb: Pose,
    covariance_mm2: Option<Matrix3<f64>>,
    since_correction_mm: f64,
}

impl PredictedTip {
    fn after(mut self, needle: &Needle, increments: &[Increment]) -> Self {
        for &increment in increments {
            self.x_pb = needle.step(&self.x_pb, increment);
            self.since_correction_mm += increment.insertion_mm();
        }
        self
    }
}

impl Estimation {
    pub(crate) fn new(config: &SessionConfig) -> Self {
        Estimation {
            steering: Steering::new(config),
            observed_to: None,
            needle: config.needle,
            predicted: None,
            corrections: None,
            corrected_at: None,
            newest_at: None,
            spacing_s: f64::INFINITY,
            watched_to: None,
            batch: Batch::default(),
        }
    }

    /// Predicts every observer along `history` to the measurement and corrects it there. A measurement
    /// that is not newer than the observers' states comes too late and is ignored.
    ///
    /// # Errors
    /// If the stage's path to the measurement is not known.
    pub(crate) fn take(
        &mut self,
        measurement: &Measurement,
        history: &StageHistory,
    ) -> Result<(), String> {
        let time = measurement.acquisition_time;
        if self.observed_to.is_some_and(|at| at >= time) {
            return Ok(());
        }
        self.predict_to(time, history)?;
        self.observed_to = Some(time);
        // The positions of a mean are as far apart as those of the stream.
        let since_s = self.corrected_at.map_or(f64::INFINITY, |last| time.seconds_after(last));
        let spacing_s = if measurement.positions > 1 { self.spacing_s } else { since_s };
        self.corrected_at = Some(time);
        let innovation_mm =
            self.steering.correct(&measurement.tip_meas, measurement.positions, spacing_s);
        let before = self.corrections.map_or(0, |corrections| corrections.positions);
        let positions = before + measurement.positions;
        self.corrections = Some(Corrections { newest: *measurement, innovation_mm, positions });
        self.predicted = self.steering.estimate().map(|estimate| PredictedTip {
            x_pb: estimate.x_pb,
            covariance_mm2: estimate.position_covariance_mm2(),
            since_correction_mm: 0.0,
        });
        Ok(())
    }

    /// Adds an accepted position to the batch for the handedness watch.
    pub(crate) fn add_to_batch(&mut self, measurement: &Measurement) {
        let time = measurement.acquisition_time;
        if let Some(last) = self.newest_at.replace(time).filter(|last| *last < time) {
            self.spacing_s = time.seconds_after(last);
        }
        // The handedness watch cannot go back to a position that comes very late.
        if self.watched_to.is_none_or(|watched| watched < time) {
            self.batch.add(measurement);
        }
    }

    /// Corrects the handedness watch with the mean of the batch, once the first position of the batch was acquired
    /// before `due`. The first correction does not wait, because the watch is predicted only from there on: it must
    /// not miss how the needle begins to turn. Without any position the watch is predicted along `history` to
    /// `oldest`, so that the history need not reach back further.
    ///
    /// # Errors
    /// If the stage's path is not known.
    pub(crate) fn correct_watch(
        &mut self,
        due: Time,
        oldest: Time,
        history: &StageHistory,
    ) -> Result<(), String> {
        match self.batch.mean() {
            None => self.predict_watch_to(oldest, history),
            Some((time, tip_meas))
                if self.watched_to.is_none()
                    || self.batch.first.is_some_and(|first| first <= due) =>
            {
                self.predict_watch_to(time, history)?;
                self.watched_to.get_or_insert(time);
                self.steering.correct_handedness(&tip_meas, self.batch.count, self.spacing_s);
                self.batch = Batch::default();
                Ok(())
            }
            Some(_) => Ok(()),
        }
    }

    fn predict_watch_to(&mut self, time: Time, history: &StageHistory) -> Result<(), String> {
        if self.steering.handedness().is_decided() {
            return Ok(());
        }
        if let Some(from) = self.watched_to.filter(|from| *from < time) {
            let watch = self.steering.handedness();
            increments(from, time, history)?.into_iter().for_each(|step| watch.predict(step));
            self.watched_to = Some(time);
        }
        Ok(())
    }

    /// Predicts every observer along `history` to `time`, unless their states are that new already.
    /// Measurements from before `time` then come too late, and the history need not reach back
    /// further.
    ///
    /// # Errors
    /// If the stage's path to `time` is not known.
    pub(crate) fn predict_to(&mut self, time: Time, history: &StageHistory) -> Result<(), String> {
        if self.observed_to.is_some_and(|at| at < time) {
            let increments = self.increments(time, history)?;
            self.predicted = self.predicted.map(|tip| tip.after(&self.needle, &increments));
            increments.into_iter().for_each(|increment| self.steering.predict(increment));
            self.observed_to = Some(time);
        }
        Ok(())
    }

    /// The tip at `time` as the observer that steers predicts it, to judge a position acquired then;
    /// `None` while the observer has no estimate.
    ///
    /// # Errors
    /// [`Refusal`] if the observers' states are as new as `time` or newer, because observers cannot go
    /// back, or if the stage's path to `time` is not known.
    pub(crate) fn prediction(
        &self,
        time: Time,
        history: &StageHistory,
    ) -> Result<Option<Prediction>, Refusal> {
        if let Some(at) = self.observed_to.filter(|at| *at >= time) {
            let by_s = at.seconds_after(time);
            let why =
                format!("came too late: the observers have passed its acquisition by {by_s:.3} s");
            return Err(Refusal::new(GateName::Pairing, why));
        }
        let increments = self.increments(time, history);
        let increments = increments.map_err(|why| Refusal::new(GateName::Pairing, why))?;
        Ok(self.predicted.map(|tip| tip.after(&self.needle, &increments)).map(|tip| Prediction {
            position_mm: tip.x_pb.translation,
            heading: tip.x_pb.rotation * Vector3::z(),
            covariance_mm2: tip.covariance_mm2,
            since_correction_mm: tip.since_correction_mm,
        }))
    }

    /// Decides on the next step from the estimates as they are at `time`.
    ///
    /// # Errors
    /// If the stage's path to `time` is not known.
    pub(crate) fn decide(
        &mut self,
        time: Time,
        history: &StageHistory,
        is_last: bool,
    ) -> Result<Decision, String> {
        let ahead = self.increments(time, history)?;
        Ok(self.steering.decide(&ahead, is_last))
    }

    /// The stage's measured increments from the observers' states to `time`.
    fn increments(&self, time: Time, history: &StageHistory) -> Result<Vec<Increment>, String> {
        self.observed_to.map_or(Ok(Vec::new()), |from| increments(from, time, history))
    }
}

/// The stage's measured increments between two times. Insertion never counts backwards: an encoder
/// that steps back by a count has cut no tissue.
fn increments(from: Time, to: Time, history: &StageHistory) -> Result<Vec<Increment>, String> {
    let path = history.between(from, to)?;
    // An increment is refused only if it is not finite, which cannot result from the stage's integers.
    let increment = |moved: StageIncrement| {
        Increment::new(moved.insertion_mm.max(0.0), moved.rotation_rad).ok()
    };
    Ok(path.filter_map(increment).collect())
}
