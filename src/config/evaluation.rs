//! `[evaluation]`: how recorded insertions are read and scored.

use super::{Config, ConfigError};
use crate::keys::{Rule, section, within};
use crate::needle::{Needle, Torsion};
use crate::session::ObserverConfig;
use crate::study::{Mount, Scoring};

const COORDINATE: Rule = within(-1000.0, 1000.0);

section! {
    /// `[evaluation]`.
    pub struct EvaluationConfig {
        /// The shaft's axis, about which the tip rolls, in the sensor's frame; any length.
        axis: [f64; 3] [COORDINATE] = [0.0, 0.0, 1.0];
        /// The axis about which the unturned path bends, in the sensor's frame; any length.
        bend_axis: [f64; 3] [COORDINATE] = [1.0, 0.0, 0.0];
        /// Roll and position count from this depth on, mm.
        score_after_mm: f64 [within(0.0, 1000.0)] = 8.0;
    }
}

/// What an evaluation is told.
#[derive(Debug, Clone)]
pub struct EvaluationSettings {
    /// The needle as the observers believe it to be.
    pub needle: Needle,
    /// The torsion of its shaft as the bench believes it to be.
    pub torsion: Torsion,
    /// The observers to score, the one that would steer first.
    pub observers: Vec<ObserverConfig>,
    /// How the recordings are gone through.
    pub scoring: Scoring,
}

impl Config {
    /// What an evaluation is told.
    ///
    /// # Errors
    /// A mount that spans no plane, or a curvature that no needle has.
    pub fn evaluation(&self) -> Result<EvaluationSettings, ConfigError> {
        let EvaluationConfig { axis, bend_axis, score_after_mm } = &self.evaluation;
        let mount = Mount::new((*axis).into(), (*bend_axis).into()).map_err(|error| {
            ConfigError::of(format!("evaluation.axis and evaluation.bend_axis: {error}"))
        })?;
        Ok(EvaluationSettings {
            needle: self.believed_needle()?,
            torsion: self.believed_torsion()?,
            observers: self.observers().collect(),
            scoring: Scoring {
                mount,
                step_mm: self.insertion.step_mm,
                samples: self.observer.samples,
                position_sd_mm: self.observer.invariant.position_sd_mm,
                score_after_mm: *score_after_mm,
            },
        })
    }
}
