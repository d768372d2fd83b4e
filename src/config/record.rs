//! `[record]`, `[calibration]` and `[evaluation]`: where runs are kept, how long calibrations are valid, and how
//! recorded insertions are scored.

use super::{Config, ConfigError};
use crate::keys::{Rule, choice, not_blank, over, section, within};
use crate::study::{Scoring, mount};

section! {
    /// `[record]`.
    pub struct RecordConfig {
        /// The folder in which run folders are made.
        dir: String [not_blank("the path of a folder")] = "runs";
        /// What a run does when its record can no longer be written.
        on_failure: OnFailure = "stop";
        /// A run is refused when `dir` has less free space than this, MB.
        free_mb_min: u32 [within(0.0, u32::MAX as f64)] = 100;
        /// Who runs the bench. It goes into each manifest; `run --operator` replaces it.
        operator: Option<String> [not_blank("a name")];
        /// The phantom that needles are inserted into. It goes into each manifest; `run --phantom` replaces it.
        phantom: Option<String> [not_blank("a description")];
    }
}

choice! {
    /// What a run does when its record can no longer be written: the disk is full or stalled, or the
    /// folder is gone.
    pub enum OnFailure {
        /// The run is stopped, safely.
        Stop = "stop",
        /// The run goes on. The operator is told, and lost records are counted.
        GoOn = "go-on",
    }
}

section! {
    /// `[calibration]`.
    #[derive(Copy)]
    pub struct CalibrationConfig {
        /// The preflight asks to repeat a calibration, or `stage prove`, that is older than this many days.
        max_age_days: f64 [over(0.0, 10_000.0)] = 90.0;
    }
}

const COORDINATE: Rule = within(-1000.0, 1000.0);

section! {
    /// `[evaluation]`.
    #[derive(Copy)]
    pub struct EvaluationConfig {
        /// The shaft's axis, about which the tip rolls, in the sensor's frame; any length.
        axis: [f64; 3] [COORDINATE] = [0.0, 0.0, 1.0];
        /// The axis about which the unturned path bends, in the sensor's frame; any length.
        bend_axis: [f64; 3] [COORDINATE] = [1.0, 0.0, 0.0];
        /// Roll and position are scored from this depth on, mm.
        score_after_mm: f64 [within(0.0, 1000.0)] = 8.0;
    }
}

impl Config {
    /// The settings of an evaluation of recordings.
    ///
    /// # Errors
    /// The two axes of `[evaluation]` determine no orientation.
    pub fn scoring(&self) -> Result<Scoring, ConfigError> {
        let EvaluationConfig { axis, bend_axis, score_after_mm } = self.evaluation;
        let r_sb = mount(axis.into(), bend_axis.into())
            .map_err(|error| format!("evaluation.axis and evaluation.bend_axis: {error}"))?;
        Ok(Scoring {
            r_sb,
            step_mm: self.insertion.step_mm,
            samples: self.observer.samples,
            position_sd_mm: self.observer.invariant.position_sd_mm,
            score_after_mm,
        })
    }
}
