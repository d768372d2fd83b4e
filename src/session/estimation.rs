//! The observers of a run, carried along the stage's measured path.

use super::config::SessionConfig;
use crate::needle::{Increment, TipPosition};
use crate::observer::{CoupledError, Estimate, Observer};
use crate::tracker::StageHistory;
use crate::units::Time;
use nalgebra::Vector3;

/// A tip position in the plane frame, with the time at which the tip was there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Measurement {
    pub(crate) acquisition_time: Time,
    pub(crate) insertion_meas_mm: f64,
    pub(crate) tip_meas: TipPosition,
}

/// The observer that steers and its shadows. All stand at the same instant; between a measurement
/// and now they are carried forward by estimate only.
pub(crate) struct Estimation {
    steering: Box<dyn Observer>,
    shadows: Vec<(String, Box<dyn Observer>)>,
    /// The instant at which the observers' states stand.
    at: Option<Time>,
}

impl Estimation {
    pub(crate) fn new(config: &SessionConfig) -> Result<Self, CoupledError> {
        let shadows = config
            .shadows
            .iter()
            .map(|shadow| Ok((shadow.name().to_owned(), shadow.build(config.needle)?)))
            .collect::<Result<_, CoupledError>>()?;
        Ok(Estimation { steering: config.observer.build(config.needle)?, shadows, at: None })
    }

    /// Carries every observer along `history` to the measurement and corrects it there. Gives the
    /// innovation of the observer that steers, mm; `None` where it had no estimate yet.
    pub(crate) fn take(
        &mut self,
        measurement: &Measurement,
        history: &StageHistory,
    ) -> Option<Vector3<f64>> {
        let increments = self.increments(measurement.acquisition_time, history);
        let predicted = self.steering.estimate_after(&increments);
        let observers = self.shadows.iter_mut().map(|(_, shadow)| shadow);
        for observer in std::iter::once(&mut self.steering).chain(observers) {
            increments.iter().for_each(|&increment| observer.predict(increment));
            observer.correct(&measurement.tip_meas);
        }
        self.at = Some(measurement.acquisition_time);
        predicted.map(|estimate| measurement.tip_meas.mm() - estimate.x_pb.translation)
    }

    /// The estimate that steers, as it is at `time`.
    pub(crate) fn estimate(&self, time: Time, history: &StageHistory) -> Option<Estimate> {
        self.steering.estimate_after(&self.increments(time, history))
    }

    /// The shadows' estimates as they are at `time`.
    pub(crate) fn shadows(
        &self,
        time: Time,
        history: &StageHistory,
    ) -> Vec<(String, Option<Estimate>)> {
        let increments = self.increments(time, history);
        let estimate = |shadow: &dyn Observer| shadow.estimate_after(&increments);
        self.shadows
            .iter()
            .map(|(name, shadow)| (name.clone(), estimate(shadow.as_ref())))
            .collect()
    }

    /// The stage's measured increments from where the observers stand to `time`. Insertion never
    /// counts backwards: an encoder that steps back by a count has cut no tissue.
    fn increments(&self, time: Time, history: &StageHistory) -> Vec<Increment> {
        let Some(from) = self.at else { return Vec::new() };
        let Ok(path) = history.between(from, time) else { return Vec::new() };
        path.filter_map(|moved| {
            Increment::new(moved.insertion_mm.max(0.0), moved.rotation_rad).ok()
        })
        .collect()
    }
}
