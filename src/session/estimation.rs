//! The observers of a run, carried along the stage's measured path.

use super::config::SessionConfig;
use crate::needle::{Increment, TipPosition};
use crate::observer::{CoupledError, Estimate, Observer};
use crate::tracker::{PairingError, Prediction, Refusal, StageHistory, StageIncrement};
use crate::units::Time;
use nalgebra::Vector3;

/// A tip position in the plane frame, with the time at which the tip was there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Measurement {
    pub(crate) acquisition_time: Time,
    pub(crate) insertion_meas_mm: f64,
    pub(crate) tip_meas: TipPosition,
}

/// What the observers say at one instant; `None` where one has no estimate yet.
pub(crate) struct Estimates {
    /// The estimate that steers.
    pub(crate) steering: Option<Estimate>,
    /// The shadows', by name.
    pub(crate) shadows: Vec<(String, Option<Estimate>)>,
}

/// The observer that steers and its shadows. All stand at the same instant; between a measurement
/// and now they are carried forward by estimate only.
pub(crate) struct Estimation {
    steering: Box<dyn Observer>,
    shadows: Vec<(String, Box<dyn Observer>)>,
    /// The instant at which the observers' states stand.
    at: Option<Time>,
    /// Millimetres inserted from the last correction to there.
    since_correction_mm: f64,
}

impl Estimation {
    pub(crate) fn new(config: &SessionConfig) -> Result<Self, CoupledError> {
        let shadows = config
            .shadows
            .iter()
            .map(|shadow| Ok((shadow.name().to_owned(), shadow.build(config.needle)?)))
            .collect::<Result<_, CoupledError>>()?;
        let steering = config.observer.build(config.needle)?;
        Ok(Estimation { steering, shadows, at: None, since_correction_mm: 0.0 })
    }

    /// Carries every observer along `history` to the measurement and corrects it there. Gives the
    /// innovation of the observer that steers, mm; `None` where it had no estimate yet. The
    /// measurement is later than [`Estimation::at`].
    ///
    /// # Errors
    /// [`PairingError`] where the stage's path to the measurement is not known.
    pub(crate) fn take(
        &mut self,
        measurement: &Measurement,
        history: &StageHistory,
    ) -> Result<Option<Vector3<f64>>, PairingError> {
        self.carry_to(measurement.acquisition_time, history)?;
        let predicted = self.steering.estimate();
        self.observers().for_each(|observer| observer.correct(&measurement.tip_meas));
        self.at = Some(measurement.acquisition_time);
        self.since_correction_mm = 0.0;
        Ok(predicted.map(|estimate| measurement.tip_meas.mm() - estimate.x_pb.translation))
    }

    /// Carries every observer along `history` to `time`, unless they stand there or later: for
    /// what no measurement can come from any more, so that the history need not reach back to the
    /// last one.
    ///
    /// # Errors
    /// [`PairingError`] where the stage's path to `time` is not known.
    pub(crate) fn carry_to(
        &mut self,
        time: Time,
        history: &StageHistory,
    ) -> Result<(), PairingError> {
        if self.at.is_some_and(|at| at < time) {
            let increments = self.increments(time, history)?;
            self.since_correction_mm += inserted_mm(&increments);
            self.observers().for_each(|observer| {
                increments.iter().for_each(|&increment| observer.predict(increment));
            });
            self.at = Some(time);
        }
        Ok(())
    }

    /// Where the observer that steers has the tip at `time`, for a position acquired then; `None`
    /// while it has no estimate.
    ///
    /// # Errors
    /// `Late` unless `time` is after the instant at which the observers stand: they cannot go back
    /// to it. `Unpaired` where the stage's path to `time` is not known.
    pub(crate) fn prediction(
        &self,
        time: Time,
        history: &StageHistory,
    ) -> Result<Option<Prediction>, Refusal> {
        if let Some(at) = self.at.filter(|at| *at >= time) {
            return Err(Refusal::Late { by_s: at.seconds_after(time) });
        }
        let increments = self.increments(time, history)?;
        Ok(self.steering.estimate_after(&increments).map(|estimate| Prediction {
            position_mm: estimate.x_pb.translation,
            covariance_mm2: self.steering.position_covariance_mm2(),
            since_correction_mm: self.since_correction_mm + inserted_mm(&increments),
        }))
    }

    /// The estimate that steers and those of the shadows, as they are at `time`.
    ///
    /// # Errors
    /// [`PairingError`] where the stage's path to `time` is not known.
    pub(crate) fn estimates(
        &self,
        time: Time,
        history: &StageHistory,
    ) -> Result<Estimates, PairingError> {
        let increments = self.increments(time, history)?;
        let shadows = self.shadows.iter();
        let shadows = shadows.map(|(name, s)| (name.clone(), s.estimate_after(&increments)));
        let steering = self.steering.estimate_after(&increments);
        Ok(Estimates { steering, shadows: shadows.collect() })
    }

    fn observers(&mut self) -> impl Iterator<Item = &mut Box<dyn Observer>> {
        let shadows = self.shadows.iter_mut().map(|(_, shadow)| shadow);
        std::iter::once(&mut self.steering).chain(shadows)
    }

    /// The stage's measured increments from where the observers stand to `time`. Insertion never
    /// counts backwards: an encoder that steps back by a count has cut no tissue.
    fn increments(
        &self,
        time: Time,
        history: &StageHistory,
    ) -> Result<Vec<Increment>, PairingError> {
        let Some(from) = self.at else { return Ok(Vec::new()) };
        let path = history.between(from, time)?;
        // An increment that is refused is not finite, which the stage's integers cannot be.
        let increment = |moved: StageIncrement| {
            Increment::new(moved.insertion_mm.max(0.0), moved.rotation_rad).ok()
        };
        Ok(path.filter_map(increment).collect())
    }
}

fn inserted_mm(increments: &[Increment]) -> f64 {
    increments.iter().map(Increment::insertion_mm).sum()
}
