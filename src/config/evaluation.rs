//! `[evaluation]`: how recorded insertions are read and scored.

use super::{Config, ConfigError};
use crate::keys::{Rule, section, within};
use crate::study::{Mount, Scoring};

const COORDINATE: Rule = within(-1000.0, 1000.0);

section! {
    /// `[evaluation]`.
    #[derive(Copy)]
    pub struct EvaluationConfig {
        /// The shaft's axis, about which the tip rolls, in the sensor's frame; any length.
        axis: [f64; 3] [COORDINATE] = [0.0, 0.0, 1.0];
        /// The axis about which the unturned path bends, in the sensor's frame; any length.
        bend_axis: [f64; 3] [COORDINATE] = [1.0, 0.0, 0.0];
        /// Roll and position count from this depth on, mm.
        score_after_mm: f64 [within(0.0, 1000.0)] = 8.0;
    }
}

impl Config {
    /// How an evaluation goes through recordings.
    ///
    /// # Errors
    /// A mount that spans no plane.
    pub fn scoring(&self) -> Result<Scoring, ConfigError> {
        let EvaluationConfig { axis, bend_axis, score_after_mm } = self.evaluation;
        let mount = Mount::new(axis.into(), bend_axis.into()).map_err(|error| {
            ConfigError::of(format!("evaluation.axis and evaluation.bend_axis: {error}"))
        })?;
        Ok(Scoring {
            mount,
            step_mm: self.insertion.step_mm,
            samples: self.observer.samples,
            position_sd_mm: self.observer.invariant.position_sd_mm,
            score_after_mm,
        })
    }
}
