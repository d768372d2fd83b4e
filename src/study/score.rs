//! The result of one trial of a study, with its bounds.

use super::bound::{InformationBound, Prior};
use super::consistency::{TrialNees, nees};
use super::figures::{OFF_PLANE_LIMIT_MM, RunFigures, TipError};
use super::statistics::rms;
use crate::emulator::{Noise, Truth, VirtualStageConfig};
use crate::needle::{Reduced, shortest_into_plane_mm};
use crate::session::{Outcome, StepRecord};

/// The result of one trial.
#[derive(Debug, Clone)]
pub struct TrialResult {
    /// The seed that repeats it.
    pub seed: u64,
    /// The emulated stage, needle and tracker of the trial.
    pub stage: VirtualStageConfig,
    /// How it ended.
    pub outcome: Outcome,
    /// Depth reached, mm.
    pub insertion_mm: f64,
    /// RMS true distance from the plane over the last third of the depth, mm.
    pub off_plane_rms_mm: Option<f64>,
    /// Depth after which the tip stays within 1 mm of the plane, mm.
    pub settling_mm: Option<f64>,
    /// The shortest path into the plane, mm: two arcs.
    pub shortest_settling_mm: Option<f64>,
    /// RMS of the estimate's errors over the last third.
    pub estimate_rms: Option<TipError>,
    /// The information bound of these errors, as RMS over the last third; `None` without noise.
    pub bound_rms: Option<TipError>,
    /// The estimate's errors relative to its covariance; `None` without a covariance.
    pub nees: Option<TrialNees>,
    /// Mean of the normalised innovation squared over the last third.
    pub nis: Option<f64>,
}

impl TrialResult {
    /// True if the trial reached its depth and stayed within 1 mm RMS of the plane over the last
    /// third.
    pub fn is_settled(&self) -> bool {
        self.outcome == Outcome::Completed
            && self.off_plane_rms_mm.is_some_and(|rms| rms < OFF_PLANE_LIMIT_MM)
    }
}

/// Collects a [`TrialResult`] step by step.
#[derive(Debug)]
pub struct TrialScore {
    seed: u64,
    stage: VirtualStageConfig,
    figures: RunFigures,
    bound: Option<InformationBound>,
    /// Depth, and the bound's standard deviations there, as [`TipError::coordinates`] lists them.
    bounds: Vec<(f64, [f64; 6])>,
    /// Depth, and the squared error normalised there.
    nees: Vec<(f64, f64)>,
    nis: Vec<(f64, f64)>,
}

impl TrialScore {
    /// A score for the trial with this seed and stage, its start drawn from `prior`.
    pub fn new(seed: u64, stage: VirtualStageConfig, prior: &Prior) -> Self {
        let measurement_mm2 = match stage.tracker.noise {
            Noise::None => 0.0,
            Noise::Uniform(half_mm) => half_mm * half_mm / 3.0,
            Noise::Gaussian(sd_mm) => sd_mm * sd_mm,
        };
        let bound = (measurement_mm2 > 0.0).then(|| {
            InformationBound::new(prior, measurement_mm2, stage.start, stage.needle, stage.torsion)
        });
        let (bounds, nees, nis) = (Vec::new(), Vec::new(), Vec::new());
        TrialScore { seed, stage, figures: RunFigures::default(), bound, bounds, nees, nis }
    }

    /// Adds one step.
    pub fn take(&mut self, step: &StepRecord, truth: &Truth) {
        self.figures.take(step, Some(truth));
        let depth_mm = step.insertion_meas_mm;
        if let Some(bound) = &mut self.bound {
            bound.advance(truth.x_pb(), depth_mm, step.rotation_meas_rad);
            if step.tip_positions > 0 {
                bound.measure(step.tip_positions);
            }
            let mut bound = bound.standard_deviations();
            bound.iter_mut().skip(3).for_each(|angle| *angle = angle.to_degrees());
            self.bounds.push((depth_mm, bound));
        }
        let estimate = step.estimate.as_ref();
        let nees = estimate.and_then(|estimate| nees(estimate, truth.x_pb()));
        self.nees.extend(nees.map(|nees| (depth_mm, nees)));
        if step.tip_meas_mm.is_some() {
            let belief = estimate.and_then(|estimate| estimate.belief);
            let nis = belief.and_then(|belief| belief.innovation_square);
            self.nis.extend(nis.map(|nis| (depth_mm, nis)));
        }
    }

    /// The result of a trial with this outcome.
    pub fn finish(self, outcome: Outcome) -> TrialResult {
        let insertion_mm = self.figures.insertion_mm();
        let from_mm = insertion_mm * 2.0 / 3.0;
        let bound_rms = TipError::by_coordinate(|i| {
            let last_third = self.bounds.iter().filter(|(depth_mm, _)| *depth_mm > from_mm);
            rms(last_third.map(|(_, bound)| bound[i]))
        });
        let last_third = self.nees.iter().filter(|(depth_mm, _)| *depth_mm > from_mm);
        let nees = TrialNees::of(last_third.map(|&(_, nees)| nees));
        let last_third = self.nis.iter().filter(|(depth_mm, _)| *depth_mm > from_mm);
        let (count, sum) =
            last_third.fold((0u32, 0.0), |(count, sum), (_, nis)| (count + 1, sum + nis));
        let nis = (count > 0).then(|| sum / f64::from(count));
        let (start, _) = Reduced::split(&self.stage.start);
        TrialResult {
            seed: self.seed,
            outcome,
            insertion_mm,
            off_plane_rms_mm: self.figures.off_plane_rms_mm(),
            settling_mm: self.figures.settling_mm(),
            shortest_settling_mm: shortest_into_plane_mm(&self.stage.needle, &start),
            estimate_rms: self.figures.estimate_rms(),
            bound_rms,
            nees,
            nis,
            stage: self.stage,
        }
    }
}
