//! The steering of a run, carried along the stage's measured path.

use super::config::SessionConfig;
use super::steering::{Decision, Steering};
use crate::geometry::Pose;
use crate::needle::{Increment, Needle, TipPosition};
use crate::observer::ObserverError;
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
    /// Tracked positions of which it is the mean.
    pub(crate) positions: u32,
}

/// What corrected the observers since the last step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Corrections {
    /// The newest measurement.
    pub(crate) newest: Measurement,
    /// Its innovation in the observer that steers, mm; `None` where that had no estimate yet.
    pub(crate) innovation_mm: Option<Vector3<f64>>,
    /// Tracked positions in all of them.
    pub(crate) positions: u32,
}

/// The run's steering, along the stage's measured path. All observers stand at the same instant;
/// between a measurement and now they are carried forward by estimate only.
pub(crate) struct Estimation {
    pub(super) steering: Steering,
    /// The instant at which the observers' states stand.
    at: Option<Time>,
    needle: Needle,
    /// Where the observer that steers has the tip there; `None` while it has no estimate.
    expected: Option<Expected>,
    /// What corrected the observers since the last step.
    pub(super) corrections: Option<Corrections>,
    /// When the measurement that corrected last was acquired.
    corrected_at: Option<Time>,
    /// When the newest position was acquired, and its time after the one before, s.
    gathered_at: Option<Time>,
    spacing_s: f64,
    /// The instant at which the watch over the stream's handedness stands.
    watched: Option<Time>,
    /// Positions that it has not been told yet.
    batch: Batch,
}

/// Positions to be told as their mean.
#[derive(Debug, Clone, Copy, Default)]
struct Batch {
    first: Option<Time>,
    /// Acquisition after the first, summed.
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

    /// Mean time of acquisition and mean position; `None` of no positions.
    fn mean(&self) -> Option<(Time, TipPosition)> {
        let time = self.first? + self.after / self.count;
        Some((time, TipPosition::new(self.position_sum_mm / f64::from(self.count))?))
    }
}

/// The tip carried on from an estimate by the needle's kinematics alone. Over the millimetre from one
/// correction to the next this differs from the observer's own prediction only by what the observer has
/// learnt about the needle: 0.002 mm for a curvature of 1/122 per mm that is 50% off.
#[derive(Debug, Clone, Copy)]
struct Expected {
    x_pb: Pose,
    covariance_mm2: Option<Matrix3<f64>>,
    since_correction_mm: f64,
}

impl Expected {
    fn after(mut self, needle: &Needle, increments: &[Increment]) -> Self {
        for &increment in increments {
            self.x_pb = needle.step(&self.x_pb, increment);
            self.since_correction_mm += increment.insertion_mm();
        }
        self
    }
}

impl Estimation {
    pub(crate) fn new(config: &SessionConfig) -> Result<Self, ObserverError> {
        Ok(Estimation {
            steering: Steering::new(config)?,
            at: None,
            needle: config.needle,
            expected: None,
            corrections: None,
            corrected_at: None,
            gathered_at: None,
            spacing_s: f64::INFINITY,
            watched: None,
            batch: Batch::default(),
        })
    }

    /// Carries every observer along `history` to the measurement and corrects it there. A
    /// measurement from before where the observers stand comes too late, and is left out.
    ///
    /// # Errors
    /// Where the stage's path to the measurement is not known.
    pub(crate) fn take(
        &mut self,
        measurement: &Measurement,
        history: &StageHistory,
    ) -> Result<(), String> {
        let time = measurement.acquisition_time;
        if self.at.is_some_and(|at| at >= time) {
            return Ok(());
        }
        self.carry_to(time, history)?;
        self.at = Some(time);
        // The positions of a mean come at the pace of the stream.
        let since = self.corrected_at.map_or(f64::INFINITY, |last| time.seconds_after(last));
        let spacing_s = if measurement.positions > 1 { self.spacing_s } else { since };
        self.corrected_at = Some(time);
        let innovation_mm =
            self.steering.correct(&measurement.tip_meas, measurement.positions, spacing_s);
        let before = self.corrections.map_or(0, |corrections| corrections.positions);
        let positions = before + measurement.positions;
        self.corrections = Some(Corrections { newest: *measurement, innovation_mm, positions });
        self.expected = self.steering.estimate().map(|estimate| Expected {
            x_pb: estimate.x_pb,
            covariance_mm2: estimate.position_covariance_mm2(),
            since_correction_mm: 0.0,
        });
        Ok(())
    }

    /// Takes note of a believed position for the watch over the stream's handedness.
    pub(crate) fn gather(&mut self, measurement: &Measurement) {
        let time = measurement.acquisition_time;
        if let Some(last) = self.gathered_at.replace(time).filter(|last| *last < time) {
            self.spacing_s = time.seconds_after(last);
        }
        // It cannot go back to one that comes very late.
        if self.watched.is_none_or(|watched| watched < time) {
            self.batch.add(measurement);
        }
    }

    /// Tells the watch over the stream's handedness the mean of the positions gathered, once the
    /// first of them was acquired before `due`; without any it is carried along `history` to
    /// `oldest`, so that the history need not reach back further.
    ///
    /// # Errors
    /// Where the stage's path is not known.
    pub(crate) fn watch(
        &mut self,
        due: Time,
        oldest: Time,
        history: &StageHistory,
    ) -> Result<(), String> {
        match self.batch.mean() {
            None => self.carry_watch_to(oldest, history),
            Some((time, tip_meas)) if self.batch.first.is_some_and(|first| first <= due) => {
                self.carry_watch_to(time, history)?;
                self.watched.get_or_insert(time);
                self.steering.watch(&tip_meas, self.batch.count, self.spacing_s);
                self.batch = Batch::default();
                Ok(())
            }
            Some(_) => Ok(()),
        }
    }

    fn carry_watch_to(&mut self, time: Time, history: &StageHistory) -> Result<(), String> {
        if self.steering.handedness().is_decided() {
            return Ok(());
        }
        if let Some(from) = self.watched.filter(|from| *from < time) {
            let watch = self.steering.handedness();
            increments(from, time, history)?.into_iter().for_each(|step| watch.predict(step));
            self.watched = Some(time);
        }
        Ok(())
    }

    /// Carries every observer along `history` to `time`, unless they stand there or later: for
    /// what no measurement can come from any more, so that the history need not reach back to the
    /// last one.
    ///
    /// # Errors
    /// Where the stage's path to `time` is not known.
    pub(crate) fn carry_to(&mut self, time: Time, history: &StageHistory) -> Result<(), String> {
        if self.at.is_some_and(|at| at < time) {
            let increments = self.increments(time, history)?;
            self.expected = self.expected.map(|tip| tip.after(&self.needle, &increments));
            increments.into_iter().for_each(|increment| self.steering.predict(increment));
            self.at = Some(time);
        }
        Ok(())
    }

    /// Where the observer that steers has the tip at `time`, for a position acquired then; `None`
    /// while it has no estimate.
    ///
    /// # Errors
    /// [`Refusal`] unless `time` is after the instant at which the observers stand: they cannot go
    /// back to it; and where the stage's path to `time` is not known.
    pub(crate) fn prediction(
        &self,
        time: Time,
        history: &StageHistory,
    ) -> Result<Option<Prediction>, Refusal> {
        if let Some(at) = self.at.filter(|at| *at >= time) {
            let by_s = at.seconds_after(time);
            let why =
                format!("came too late: the observers have passed its acquisition by {by_s:.3} s");
            return Err(Refusal::new(GateName::Pairing, why));
        }
        let increments = self.increments(time, history);
        let increments = increments.map_err(|why| Refusal::new(GateName::Pairing, why))?;
        Ok(self.expected.map(|tip| tip.after(&self.needle, &increments)).map(|tip| Prediction {
            position_mm: tip.x_pb.translation,
            heading: tip.x_pb.rotation * Vector3::z(),
            covariance_mm2: tip.covariance_mm2,
            since_correction_mm: tip.since_correction_mm,
        }))
    }

    /// Decides on the next step from the estimates as they are at `time`.
    ///
    /// # Errors
    /// Where the stage's path to `time` is not known.
    pub(crate) fn decide(
        &mut self,
        time: Time,
        history: &StageHistory,
        is_last: bool,
    ) -> Result<Decision, String> {
        let ahead = self.increments(time, history)?;
        Ok(self.steering.decide(&ahead, is_last))
    }

    /// The stage's measured increments from where the observers stand to `time`.
    fn increments(&self, time: Time, history: &StageHistory) -> Result<Vec<Increment>, String> {
        self.at.map_or(Ok(Vec::new()), |from| increments(from, time, history))
    }
}

/// The stage's measured increments between two times. Insertion never counts backwards: an encoder
/// that steps back by a count has cut no tissue.
fn increments(from: Time, to: Time, history: &StageHistory) -> Result<Vec<Increment>, String> {
    let path = history.between(from, to)?;
    // An increment that is refused is not finite, which the stage's integers cannot be.
    let increment = |moved: StageIncrement| {
        Increment::new(moved.insertion_mm.max(0.0), moved.rotation_rad).ok()
    };
    Ok(path.filter_map(increment).collect())
}
