//! Consistency of an observer: its errors relative to its own covariance.

use super::statistics::{mean, rms};
use crate::geometry::Pose;
use crate::observer::Estimate;
use serde::Serialize;

/// Degrees of freedom of a pose.
const FREEDOM: f64 = 6.0;
/// Degrees of freedom of a position.
const POSITION_FREEDOM: f64 = 3.0;
/// Trials whose bounds are wider than this many times the freedom differ too much to be judged.
const SPREAD_MAX: f64 = 10.0;
/// 95 % of a normal distribution lie within this many standard deviations.
const WITHIN_95: f64 = 1.96;
/// The same for Student's t with 1, 2 … degrees of freedom.
const STUDENT_T_95: [f64; 9] = [12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262];

/// The normalised estimation error squared, `εᵀ P⁻¹ ε`, with the left-invariant error `ε =
/// log(X_est⁻¹ X_true)` and its covariance P; `None` for an estimate without covariance.
///
/// For a consistent estimate it has a χ² distribution with 6 degrees of freedom and mean 6.
pub(super) fn nees(estimate: &Estimate, x_pb_true: &Pose) -> Option<f64> {
    let error = (estimate.x_pb.inverse() * *x_pb_true).log().to_vector();
    let solved = estimate.belief?.covariance.cholesky()?.solve(&error);
    Some(error.dot(&solved))
}

/// The normalised estimation error squared of one trial.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrialNees {
    /// At the last step.
    pub end: f64,
    /// Mean over the last third.
    pub mean: f64,
}

impl TrialNees {
    /// The figures of a trial from the values at the steps of its last third; `None` without values.
    pub(super) fn of(steps: impl Iterator<Item = f64>) -> Option<Self> {
        let steps: Vec<f64> = steps.collect();
        Some(TrialNees { end: *steps.last()?, mean: mean(steps)? })
    }
}

/// The verdict on an observer: its errors compared with its covariance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// The errors are as large as the covariance says.
    Consistent,
    /// The errors are larger than the covariance says, or not finite.
    OverConfident,
    /// The errors are smaller than the covariance says.
    UnderConfident,
}

/// A mean of normalised errors, with the 95 % acceptance interval of a consistent observer.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Consistency {
    /// Mean over the trials.
    pub mean: f64,
    /// Lower bound.
    pub lo95: f64,
    /// Upper bound.
    pub hi95: f64,
    /// The verdict; `None` for a single trial, or if the trials differ too much.
    pub verdict: Option<Verdict>,
}

impl Consistency {
    /// Judges independent values, one per trial. For a consistent observer they have a χ² distribution with 6 degrees
    /// of freedom. The bounds of the mean follow Wilson and Hilferty.
    fn of_independent(values: &[f64]) -> Option<Self> {
        let freedom = FREEDOM * values.len() as f64;
        let part = 2.0 / (9.0 * freedom);
        let bound = |deviations: f64| FREEDOM * (1.0 - part + deviations * part.sqrt()).powi(3);
        Self::judge(values, bound(-WITHIN_95), bound(WITHIN_95))
    }

    /// Judges the normalised innovation squared, averaged over the last third of each trial; its mean is 3 for a
    /// consistent observer.
    pub(super) fn of_innovations(values: &[f64]) -> Option<Self> {
        Self::of_means(values, POSITION_FREEDOM)
    }

    /// Judges means over correlated steps: the bounds follow from the spread of the trials, by Student's t. Means of χ²
    /// are skewed: with 3 to 20 trials, 7 % of consistent observers are outside the bounds.
    fn of_means(values: &[f64], freedom: f64) -> Option<Self> {
        let mean = mean(values.iter().copied())?;
        let spread = rms(values.iter().map(|value| value - mean))?;
        // One trial has no spread.
        let within = match values {
            [_] => f64::INFINITY,
            _ => student_95(values.len() - 1) * spread / (values.len() as f64 - 1.0).sqrt(),
        };
        let judged = Self::judge(values, (freedom - within).max(0.0), freedom + within)?;
        let verdict = judged.verdict.filter(|_| within <= SPREAD_MAX * freedom);
        Some(Consistency { verdict, ..judged })
    }

    fn judge(values: &[f64], lo95: f64, hi95: f64) -> Option<Self> {
        let mean = mean(values.iter().copied())?;
        let verdict = if (lo95..=hi95).contains(&mean) {
            Verdict::Consistent
        } else if mean < lo95 {
            Verdict::UnderConfident
        } else {
            Verdict::OverConfident
        };
        let verdict = (values.len() > 1).then_some(verdict);
        Some(Consistency { mean, lo95, hi95, verdict })
    }
}

/// The normalised estimation error squared over the trials of a study.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Nees {
    /// At the end of each trial.
    #[serde(flatten)]
    pub end: Consistency,
    /// Mean over the last third of each trial.
    pub last_third: Consistency,
}

impl Nees {
    /// Over these trials; `None` if none has a covariance.
    pub(super) fn of(trials: impl Iterator<Item = TrialNees>) -> Option<Self> {
        let (ends, means): (Vec<f64>, Vec<f64>) = trials.map(|nees| (nees.end, nees.mean)).unzip();
        Some(Nees {
            end: Consistency::of_independent(&ends)?,
            last_third: Consistency::of_means(&means, FREEDOM)?,
        })
    }
}

/// 95 % of Student's t with `freedom` degrees of freedom lie within plus or minus this. From 10 degrees on it is the
/// asymptotic expansion (Abramowitz and Stegun 26.7.5), accurate to 0.2 %.
pub fn student_95(freedom: usize) -> f64 {
    let few = freedom.checked_sub(1).and_then(|at| STUDENT_T_95.get(at));
    let part = 1.0 / freedom as f64;
    few.copied().unwrap_or(WITHIN_95 + 2.37 * part + 2.82 * part * part)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::emulator::WhiteNoise;
    use crate::geometry::Twist;
    use crate::observer::{Belief, Shaft};
    use nalgebra::{Matrix6, Vector6};

    #[test]
    fn trials_too_different_to_be_judged_have_no_verdict() {
        let judged = Consistency::of_innovations(&[1.0, 9000.0, 20.0]).unwrap();
        assert_eq!((judged.verdict, judged.lo95), (None, 0.0));
    }

    #[test]
    fn one_trial_is_never_judged() {
        for of in [Consistency::of_innovations, Consistency::of_independent] {
            let verdict = |values: &[f64]| of(values).expect("a mean").verdict;
            assert_eq!(verdict(&[60.0]), None);
            assert_eq!(verdict(&[60.0, 60.1]), Some(Verdict::OverConfident));
        }
    }

    /// 95 % of consistent observers are found to be consistent, also with few trials.
    #[test]
    fn the_bounds_hold_for_few_trials() {
        for trials in [2, 5, 15] {
            let is_consistent = |study: u64| {
                let draw = |trial| 3.0 + WhiteNoise::Gaussian(1.0).draw(study, trial).x;
                let values: Vec<f64> = (0..trials).map(draw).collect();
                let judged = Consistency::of_innovations(&values).unwrap();
                judged.verdict == Some(Verdict::Consistent)
            };
            let found = (0..2000).filter(|&study| is_consistent(study)).count();
            assert!((1870..1930).contains(&found), "{trials} trials: {found} of 2000");
        }
    }

    #[test]
    fn an_error_that_is_not_finite_counts_as_over_confident() {
        let nees = Consistency::of_independent(&[6.0, f64::NAN]).unwrap();
        assert_eq!(nees.verdict, Some(Verdict::OverConfident));
    }

    /// Errors `scale` times as large as their covariance says.
    fn verdicts(scale: f64) -> Nees {
        let factor =
            Matrix6::from_fn(|i, j| if i >= j { 0.01 * (i + 2 * j + 1) as f64 } else { 0.0 });
        let covariance = factor * factor.transpose();
        let belief = Belief { covariance, ..Belief::certain(0.01, Shaft::RIGID) };
        let x_pb = Pose::exp(&Twist::from_vector(&Vector6::new(1.0, 2.0, 3.0, 0.1, 0.2, 0.3)));
        let estimate = Estimate::of_belief(x_pb, belief);
        let trials = (0..500).filter_map(|trial| {
            let [a, b] = [0, 1].map(|half| WhiteNoise::Gaussian(scale).draw(trial, half));
            let error = factor * Vector6::new(a.x, a.y, a.z, b.x, b.y, b.z);
            let truth = x_pb * Pose::exp(&Twist::from_vector(&error));
            TrialNees::of(nees(&estimate, &truth).into_iter())
        });
        Nees::of(trials).unwrap()
    }

    #[test]
    fn verdicts_tell_consistent_from_over_and_under_confident() {
        for (scale, verdict) in [
            (1.0, Verdict::Consistent),
            (1.1, Verdict::OverConfident),
            (0.9, Verdict::UnderConfident),
        ] {
            let nees = verdicts(scale);
            assert_eq!(
                [nees.end, nees.last_third].map(|c| c.verdict),
                [Some(verdict); 2],
                "{nees:?}"
            );
        }
    }

    /// χ² with 6000 degrees of freedom lies between 5787 and 6217 with 95 % probability.
    #[test]
    fn bounds_are_those_of_chi_squared() {
        let nees = Consistency::of_independent(&[6.0; 1000]).unwrap();
        assert!((nees.lo95 - 5.787).abs() < 0.002 && (nees.hi95 - 6.217).abs() < 0.002, "{nees:?}");
        assert_eq!(Consistency::of_independent(&[]), None);
    }
}
