//! The figures of a study, over all its trials.

use super::consistency::{Consistency, Nees};
use super::figures::{FigureReport, TipError};
use super::score::TrialResult;
use super::statistics::{quantile, rms};
use crate::emulator::split_mix64;
use crate::session::Outcome;
use serde::Serialize;

/// The seed of trial `trial` in the study with this `seed`. It does not depend on the thread that runs the trial. It
/// has 53 bits, so that every JSON reader represents it exactly.
pub fn trial_seed(seed: u64, trial: u64) -> u64 {
    split_mix64(seed, trial) >> 11
}

/// Order statistics of a distance, mm. A stopped trial counts as infinitely far off. Without trials they are NaN.
/// In JSON, infinite values and NaN are null.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct OffPlane {
    /// Half of the trials are better.
    pub median: f64,
    /// 95% of the trials are better.
    pub p95: f64,
    /// The worst.
    pub max: f64,
}

impl OffPlane {
    fn of(distances_mm: &[f64]) -> Self {
        OffPlane {
            median: order_statistic(distances_mm, 0.5),
            p95: order_statistic(distances_mm, 0.95),
            max: order_statistic(distances_mm, 1.0),
        }
    }
}

/// The `q`-quantile; NaN for no values.
fn order_statistic(values: &[f64], q: f64) -> f64 {
    quantile(values, q).unwrap_or(f64::NAN)
}

/// Order statistics of the settling depth, mm; a trial that does not settle counts as infinite.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Settling {
    /// Half of the trials are faster.
    pub median: f64,
    /// 95% of the trials are faster.
    pub p95: f64,
}

/// The median alone, mm; a start from which the plane is out of reach counts as infinite.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Median {
    /// Half of the trials have less.
    pub median: f64,
}

/// A trial that did not settle.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FailedTrial {
    /// The seed with which `run --seed` repeats it.
    pub seed: u64,
    /// RMS distance from the plane over the last third of the depth that it reached.
    pub off_plane_rms_mm: Option<f64>,
    /// Why it was stopped; `None` if it reached its depth.
    pub stop_reason: Option<String>,
    /// True if the trial did not begin, because there was no path to its target.
    pub refused: bool,
}

/// The figures of a study.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StudySummary {
    /// Number of insertions.
    pub trials: usize,
    /// Share of the trials that reached their depth within 1 mm RMS of the plane over the last
    /// third.
    pub settled_fraction: f64,
    /// Distance from the plane over the last third, RMS.
    pub off_plane_rms_mm: OffPlane,
    /// Depth after which the tip stays within 1 mm of the plane.
    pub settling_mm: Settling,
    /// The length of the shortest way into the plane: no needle can be faster.
    pub shortest_settling_mm: Median,
    /// The estimate's RMS errors over the last third, medians over the trials.
    pub estimate_rms: Option<TipError>,
    /// The estimate's errors divided by the information bound, both RMS over the last third of all
    /// trials: 1 is the best possible. The bound is on mean squares, so the squares of all trials are
    /// pooled; the RMS of a single trial may be under its bound.
    pub bound_ratio: Option<TipError>,
    /// The estimate's errors relative to its own covariance; null without a covariance.
    pub nees: Option<Nees>,
    /// The innovations relative to their predicted covariance, over the last third of each trial.
    pub nis: Option<Consistency>,
    /// Share of the trials in which the observer warned that the positions left its model.
    pub warned_fraction: f64,
    /// The figures of a study with targets; without targets these keys are absent.
    #[serde(flatten)]
    pub target: Option<Targets>,
    /// The trials that did not settle, or did not reach their target, with the seeds that repeat them.
    pub failed: Vec<FailedTrial>,
}

/// The figures of a study with targets.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Targets {
    /// True distance of the tip from the target at the end, mm, of the trials that were not refused; a
    /// stopped trial counts as infinitely far.
    pub target_error_mm: OffPlane,
    /// Share of those trials that ended within the tolerance.
    pub reached_fraction: f64,
    /// Share of all trials without a plan at the start.
    pub refused_fraction: f64,
    /// The least distance of the true tip from an obstacle, mm.
    pub clearance_mm_min: Clearance,
    /// Share of the trials, refused ones left out, in which the true tip touched an obstacle.
    pub touched_fraction: f64,
}

/// Order statistics of a least distance, mm; null without obstacles.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Clearance {
    /// 95% of the trials keep farther away.
    pub p5: f64,
    /// The worst.
    pub min: f64,
}

impl Targets {
    fn of(trials: &[TrialResult]) -> Option<Self> {
        let all: Vec<_> = trials.iter().filter_map(|trial| trial.target).collect();
        if all.is_empty() {
            return None;
        }
        let begun: Vec<_> = all.iter().filter(|target| !target.is_refused).collect();
        let fraction = |count: usize, total: usize| count as f64 / total as f64;
        let errors: Vec<f64> =
            begun.iter().map(|target| target.error_mm.unwrap_or(f64::INFINITY)).collect();
        let clearances: Vec<f64> = begun.iter().map(|target| target.clearance_mm).collect();
        let touched = clearances.iter().filter(|mm| **mm <= 0.0).count();
        Some(Targets {
            target_error_mm: OffPlane::of(&errors),
            reached_fraction: fraction(
                begun.iter().filter(|target| target.is_reached).count(),
                begun.len(),
            ),
            refused_fraction: fraction(all.len() - begun.len(), all.len()),
            clearance_mm_min: Clearance {
                p5: order_statistic(&clearances, 0.05),
                min: order_statistic(&clearances, 0.0),
            },
            touched_fraction: fraction(touched, begun.len()),
        })
    }
}

impl StudySummary {
    /// The figures of these trials; `None` for no trials.
    pub fn of(trials: &[TrialResult]) -> Option<Self> {
        if trials.is_empty() {
            return None;
        }
        let completed = |pick: fn(&FigureReport) -> Option<f64>| -> Vec<f64> {
            let value = |trial: &TrialResult| match trial.outcome {
                Outcome::Completed => pick(&trial.figures).unwrap_or(f64::INFINITY),
                Outcome::Stopped(_) => f64::INFINITY,
            };
            trials.iter().map(value).collect()
        };
        let off_plane = completed(|figures| figures.off_plane_rms_mm);
        let settling = completed(|figures| figures.settling_mm);
        let shortest = trials.iter().map(|trial| trial.shortest_settling_mm);
        let shortest: Vec<f64> = shortest.map(|mm| mm.unwrap_or(f64::INFINITY)).collect();
        let errors = trials.iter().filter_map(|trial| trial.figures.estimate_rms);
        let nis = trials.iter().filter_map(|trial| trial.nis);
        let failed = trials.iter().filter(|trial| !trial.is_settled()).map(|trial| FailedTrial {
            seed: trial.seed,
            off_plane_rms_mm: trial.figures.off_plane_rms_mm,
            stop_reason: trial.outcome.stop_reason().map(str::to_owned),
            refused: trial.target.is_some_and(|target| target.is_refused),
        });
        let settled = trials.iter().filter(|trial| trial.is_settled()).count();
        let warned = trials.iter().filter(|trial| trial.is_warned).count();
        Some(StudySummary {
            trials: trials.len(),
            settled_fraction: settled as f64 / trials.len() as f64,
            off_plane_rms_mm: OffPlane::of(&off_plane),
            settling_mm: Settling {
                median: order_statistic(&settling, 0.5),
                p95: order_statistic(&settling, 0.95),
            },
            shortest_settling_mm: Median { median: order_statistic(&shortest, 0.5) },
            estimate_rms: TipError::by_coordinate(&errors.collect::<Vec<_>>(), |values| {
                quantile(&values, 0.5)
            }),
            bound_ratio: bound_ratio(trials),
            nees: Nees::of(trials.iter().filter_map(|trial| trial.nees)),
            nis: Consistency::of_innovations(&nis.collect::<Vec<_>>()),
            warned_fraction: warned as f64 / trials.len() as f64,
            target: Targets::of(trials),
            failed: failed.collect(),
        })
    }
}

fn bound_ratio(trials: &[TrialResult]) -> Option<TipError> {
    let both = trials.iter().filter_map(|trial| trial.figures.estimate_rms.zip(trial.bound_rms));
    let (errors, bounds): (Vec<_>, Vec<_>) = both.unzip();
    let [errors, bounds] = [errors, bounds].map(|all| TipError::by_coordinate(&all, rms));
    let (errors, bounds) = (errors?.coordinates(), bounds?.coordinates());
    Some(TipError::from(std::array::from_fn(|i| errors[i] / bounds[i])))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    fn trial(off_plane_rms_mm: f64, estimate: f64, outcome: Outcome) -> TrialResult {
        let error = |value| Some(TipError::from([value; 6]));
        TrialResult {
            seed: 7,
            stage: Config::from_sources(&[], &[]).unwrap().virtual_stage().unwrap(),
            outcome,
            figures: FigureReport {
                insertion_mm: 300.0,
                off_plane_rms_mm: Some(off_plane_rms_mm),
                settling_mm: (off_plane_rms_mm < 1.0).then_some(80.0),
                estimate_rms: error(estimate),
                ..FigureReport::default()
            },
            shortest_settling_mm: Some(47.0),
            bound_rms: error(0.1),
            nees: None,
            nis: None,
            target: None,
            is_warned: false,
        }
    }

    #[test]
    fn stopped_trials_count_as_infinitely_far_off() {
        let trials = [
            trial(0.1, 0.05, Outcome::Completed),
            trial(0.2, 0.1, Outcome::Completed),
            trial(5.0, 0.15, Outcome::Completed),
            trial(0.1, 0.1, Outcome::Stopped("control: lost".to_owned())),
        ];
        let summary = StudySummary::of(&trials).unwrap();
        assert_eq!((summary.trials, summary.settled_fraction), (4, 0.5));
        assert_eq!(summary.failed.len(), 2);
        assert_eq!(summary.failed[1].stop_reason.as_deref(), Some("control: lost"));
        // Stopped trials are infinitely far off: half of the trials lie within 0.2 and 5 mm.
        assert!((summary.off_plane_rms_mm.median - 2.6).abs() < 1e-12);
        let pooled = (f64::mul_add(0.05, 0.05, 0.15 * 0.15 + 2.0 * 0.01) / 4.0).sqrt() / 0.1;
        assert!((summary.bound_ratio.unwrap().roll_deg - pooled).abs() < 1e-12);
        let json = serde_json::to_value(&summary).unwrap();
        assert_eq!(json["off_plane_rms_mm"]["max"], serde_json::Value::Null);
        assert_eq!(json["settling_mm"]["p95"], serde_json::Value::Null);
        assert_eq!(StudySummary::of(&[]), None);
    }

    #[test]
    fn a_start_out_of_reach_counts_as_never_in_the_plane() {
        let reach = |shortest_settling_mm| TrialResult {
            shortest_settling_mm,
            ..trial(0.1, 0.1, Outcome::Completed)
        };
        let median =
            |trials: &[TrialResult]| StudySummary::of(trials).unwrap().shortest_settling_mm.median;
        assert_eq!(median(&[reach(Some(40.0)), reach(Some(50.0)), reach(None)]), 50.0);
        assert_eq!(median(&[reach(Some(40.0)), reach(None), reach(None)]), f64::INFINITY);
    }

    #[test]
    fn trial_seeds_are_exact_in_json_and_distinct() {
        let mut seeds: Vec<u64> = (0..1000).map(|trial| trial_seed(1, trial)).collect();
        assert!(seeds.iter().all(|&seed| seed < 1 << 53 && seed as f64 as u64 == seed));
        seeds.sort_unstable();
        seeds.dedup();
        assert_eq!(seeds.len(), 1000);
    }
}
