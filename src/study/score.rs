//! The result of one trial of a study, with its bounds.

use super::bound::{InformationBound, Prior};
use super::consistency::{TrialNees, nees};
use super::figures::{ByDepth, FigureReport, OFF_PLANE_LIMIT_MM, RunFigures, TipError, last_third};
use super::statistics::{mean, rms};
use crate::emulator::{Truth, VirtualStageConfig};
use crate::geometry::Pose;
use crate::needle::{Reduced, shortest_into_plane_mm};
use crate::plan::World;
use crate::session::{Goal, Outcome, StepRecord};

/// The result of one trial.
#[derive(Debug, Clone)]
pub struct TrialResult {
    /// The seed that repeats the trial.
    pub seed: u64,
    /// The emulated stage, needle and tracker of the trial.
    pub stage: VirtualStageConfig,
    /// How the trial ended.
    pub outcome: Outcome,
    /// The figures of the insertion, by the true tip.
    pub figures: FigureReport,
    /// The length of the shortest path into the plane, mm: two arcs, and far from the plane a straight between them.
    pub shortest_settling_mm: Option<f64>,
    /// The information bound of the estimate's errors, as RMS over the last third; `None` without noise.
    pub bound_rms: Option<TipError>,
    /// The estimate's errors relative to its covariance; `None` without a covariance.
    pub nees: Option<TrialNees>,
    /// Mean of the normalised innovation squared over the last third.
    pub nis: Option<f64>,
    /// How near the tip came to its target; `None` without a target.
    pub target: Option<TargetScore>,
    /// True if the observer warned that the positions left its model.
    pub is_warned: bool,
}

/// The result of a trial with a target.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TargetScore {
    /// True if there was no path with which a run may begin.
    pub is_refused: bool,
    /// True distance of the tip from the target at the end, mm; `None` if the trial was stopped.
    pub error_mm: Option<f64>,
    /// True if the trial ended within the tolerance.
    pub is_reached: bool,
    /// The least distance of the true tip from an obstacle, mm; infinite without obstacles.
    pub clearance_mm: f64,
}

impl TrialResult {
    /// True if the trial reached its target; without one, if it reached its depth and stayed within 1 mm RMS of
    /// the plane over the last third.
    pub fn is_settled(&self) -> bool {
        match self.target {
            Some(target) => target.is_reached,
            None => {
                self.outcome == Outcome::Completed
                    && self.figures.off_plane_rms_mm.is_some_and(|rms| rms < OFF_PLANE_LIMIT_MM)
            }
        }
    }

    /// The result of a trial that was refused before the insertion.
    pub fn refused(seed: u64, stage: VirtualStageConfig, prior: &Prior, why: &str) -> Self {
        let target = TargetScore {
            is_refused: true,
            error_mm: None,
            is_reached: false,
            clearance_mm: f64::INFINITY,
        };
        let scorer = TrialScorer::new(seed, stage, prior, None);
        TrialResult { target: Some(target), ..scorer.finish(Outcome::Stopped(why.to_string())) }
    }
}

/// Collects a [`TrialResult`] step by step.
#[derive(Debug)]
pub struct TrialScorer {
    seed: u64,
    stage: VirtualStageConfig,
    figures: RunFigures,
    bound: Option<InformationBound>,
    /// The bound's standard deviations, as [`TipError::coordinates`] lists them.
    bounds: ByDepth<TipError>,
    /// The normalised estimation error squared at each step.
    nees: ByDepth<f64>,
    /// The normalised innovation squared at each step with a position.
    nis: ByDepth<f64>,
    goal: Option<GoalScore>,
    is_warned: bool,
}

#[derive(Debug)]
struct GoalScore {
    obstacles: World,
    tolerance_mm: f64,
    /// The true tip at the last step.
    tip_before: Option<Pose>,
    /// The least distance of the true tip from an obstacle so far, mm.
    clearance_mm: f64,
}

impl TrialScorer {
    /// A scorer for the trial with this seed and stage, its start drawn from `prior`.
    pub fn new(seed: u64, stage: VirtualStageConfig, prior: &Prior, goal: Option<&Goal>) -> Self {
        // Noise with a correlation much shorter than the memory of the estimate acts like white noise of
        // this variance.
        let measurement_mm2 = stage.tracker.long_mean_variance_mm2();
        let bound = (measurement_mm2 > 0.0).then(|| {
            InformationBound::new(prior, measurement_mm2, stage.start, stage.needle, stage.torsion)
        });
        TrialScorer {
            seed,
            stage,
            figures: RunFigures::default(),
            bound,
            bounds: ByDepth::new(),
            nees: ByDepth::new(),
            nis: ByDepth::new(),
            goal: goal.map(|goal| GoalScore {
                obstacles: goal.world.clone(),
                tolerance_mm: goal.problem.tolerance_mm,
                tip_before: None,
                clearance_mm: f64::INFINITY,
            }),
            is_warned: false,
        }
    }

    /// Adds one step.
    pub fn take(&mut self, step: &StepRecord, truth: &Truth) {
        self.figures.take_step(step, Some(truth));
        self.is_warned |= step.decision.warning.is_some();
        if let Some(goal) = &mut self.goal {
            let tip = truth.x_pb;
            let before = goal.tip_before.replace(tip).unwrap_or(tip);
            let distance_mm = goal.obstacles.distance_on_way_mm(&before, &tip);
            goal.clearance_mm = goal.clearance_mm.min(distance_mm);
        }
        let depth_mm = step.insertion_meas_mm;
        if let Some(bound) = &mut self.bound {
            bound.advance(&truth.x_pb, depth_mm, step.rotation_meas_rad);
            if step.tip_positions > 0 {
                bound.measure(step.tip_positions);
            }
            let mut bound = bound.standard_deviations();
            bound.iter_mut().skip(3).for_each(|angle| *angle = angle.to_degrees());
            self.bounds.push((depth_mm, TipError::from(bound)));
        }
        let estimate = step.decision.estimate.as_ref();
        let nees = estimate.and_then(|estimate| nees(estimate, &truth.x_pb));
        self.nees.extend(nees.map(|nees| (depth_mm, nees)));
        if step.tip_meas_mm.is_some() {
            let belief = estimate.and_then(|estimate| estimate.belief);
            let nis = belief.and_then(|belief| belief.nis);
            self.nis.extend(nis.map(|nis| (depth_mm, nis)));
        }
    }

    /// The result of a trial with this outcome.
    pub fn finish(self, outcome: Outcome) -> TrialResult {
        let figures = self.figures.report();
        let insertion_mm = figures.insertion_mm;
        let error_mm = figures.target_error_mm.filter(|_| outcome == Outcome::Completed);
        let target = self.goal.as_ref().map(|goal| TargetScore {
            is_refused: false,
            error_mm,
            is_reached: error_mm.is_some_and(|error_mm| error_mm <= goal.tolerance_mm),
            clearance_mm: goal.clearance_mm,
        });
        let bounds: Vec<TipError> = last_third(&self.bounds, insertion_mm).collect();
        let (start, _) = Reduced::split(&self.stage.start);
        TrialResult {
            seed: self.seed,
            outcome,
            shortest_settling_mm: shortest_into_plane_mm(&self.stage.needle, &start),
            bound_rms: TipError::by_coordinate(&bounds, rms),
            nees: TrialNees::of(last_third(&self.nees, insertion_mm)),
            nis: mean(last_third(&self.nis, insertion_mm)),
            is_warned: self.is_warned,
            figures,
            target,
            stage: self.stage,
        }
    }
}
