//! The totals of a group of runs, with confidence intervals of 95 %.

use super::compare::Keys;
use super::run::Folder;
use crate::archive::RunOutcome;
use crate::math::{exp, ln};
use crate::study::{FigureReport, OFF_PLANE_LIMIT_MM, quantile};
use serde::Serialize;
use std::collections::BTreeSet;

/// The totals of the runs with the same name, or with the same value of a key.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Group {
    /// The name or the value.
    #[serde(rename = "group")]
    pub label: String,
    /// Number of different configurations.
    pub configurations: usize,
    /// The keys in which the configurations differ.
    pub varied: Vec<String>,
    /// The runs that reached their depth.
    pub completed: Proportion,
    /// The runs without a target that reached it within 1 mm RMS of the plane over the last third.
    pub settled: Proportion,
    /// The distance of these runs from the plane over the last third, RMS, mm; infinite for a run that was
    /// stopped.
    pub off_plane_rms_mm: Option<MedianInterval>,
    /// Depth after which the tip stays within 1 mm of the plane, mm; infinite if it does not.
    pub settling_mm: Option<MedianInterval>,
    /// The runs to a target that ended within its tolerance.
    pub reached: Proportion,
    /// Distance of the tip from the target at the end of these runs, mm: the true one if known, else the
    /// estimated one; infinite for a run that was stopped.
    pub target_error_mm: Option<MedianInterval>,
}

/// The totals of one group. A run that was stopped counts as infinitely far from its plane or target.
pub(super) fn group(label: String, runs: &[(&Folder, Keys)]) -> Group {
    let is_completed = |run: &Folder| run.manifest.outcome == Some(RunOutcome::Completed);
    let completed = runs.iter().filter(|(run, _)| is_completed(run)).count();
    let (to_target, in_plane): (Vec<&Folder>, Vec<&Folder>) =
        runs.iter().map(|(run, _)| *run).partition(|run| run.tolerance_mm().is_some());
    let figure = |run: &Folder, of: fn(&FigureReport) -> Option<f64>| {
        let figures = run.figures().filter(|_| is_completed(run));
        figures.as_ref().and_then(of).unwrap_or(f64::INFINITY)
    };
    let in_plane_figures = |of| in_plane.iter().map(|run| figure(run, of)).collect::<Vec<_>>();
    let off_plane = in_plane_figures(|figures| figures.off_plane_rms_mm);
    let settled = off_plane.iter().filter(|rms_mm| **rms_mm < OFF_PLANE_LIMIT_MM).count();
    let errors = to_target.iter().map(|run| figure(run, FigureReport::target_error));
    let errors: Vec<f64> = errors.collect();
    let tolerances = to_target.iter().filter_map(|run| run.tolerance_mm());
    let reached = errors.iter().zip(tolerances).filter(|(error, limit)| *error <= limit).count();
    let hashes: BTreeSet<&str> =
        runs.iter().map(|(run, _)| run.manifest.config_sha256.as_str()).collect();
    Group {
        label,
        configurations: hashes.len(),
        varied: varied_keys(runs),
        completed: Proportion::new(completed, runs.len()),
        settled: Proportion::new(settled, in_plane.len()),
        off_plane_rms_mm: MedianInterval::of(&off_plane),
        settling_mm: MedianInterval::of(&in_plane_figures(|figures| figures.settling_mm)),
        reached: Proportion::new(reached, to_target.len()),
        target_error_mm: MedianInterval::of(&errors),
    }
}

/// The keys whose values differ between `runs`.
fn varied_keys(runs: &[(&Folder, Keys)]) -> Vec<String> {
    let all: BTreeSet<&String> = runs.iter().flat_map(|(_, keys)| keys.keys()).collect();
    let differs = |key: &&String| {
        let values: BTreeSet<Option<&String>> =
            runs.iter().map(|(_, keys)| keys.get(*key)).collect();
        values.len() > 1
    };
    all.into_iter().filter(differs).cloned().collect()
}

/// The 0.975 quantile of the normal distribution.
const Z: f64 = 1.959_963_984_540_054;
/// The probability outside an interval, at each side.
const TAIL: f64 = 0.025;

/// A share of runs, with its confidence interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Proportion {
    /// Number of runs that have the property.
    pub count: usize,
    /// Number of all runs.
    pub of: usize,
    /// The share; `None` without runs.
    pub fraction: Option<f64>,
    /// Wilson's score interval of 95 % (Wilson 1927; Newcombe 1998, method 3). It stays within 0 to
    /// 1, and still says something when every run succeeded.
    pub wilson_95: Option<[f64; 2]>,
}

impl Proportion {
    /// `count` of `of` runs.
    pub fn new(count: usize, of: usize) -> Self {
        let n = of as f64;
        let fraction = (of > 0).then(|| count as f64 / n);
        let wilson_95 = fraction.map(|p| {
            let middle = p + Z * Z / (2.0 * n);
            let half = Z * (p * (1.0 - p) / n + Z * Z / (4.0 * n * n)).sqrt();
            let scale = 1.0 + Z * Z / n;
            [((middle - half) / scale).max(0.0), ((middle + half) / scale).min(1.0)]
        });
        Proportion { count, of, fraction, wilson_95 }
    }
}

/// A median, with its confidence interval. Infinite values are null in JSON.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MedianInterval {
    /// The median; infinite if half of the values are.
    #[serde(rename = "median")]
    pub value: f64,
    /// A distribution-free interval of at least 95 %, between two of the values; `None` with fewer than six
    /// runs.
    #[serde(rename = "order_statistics_95")]
    pub interval: Option<[f64; 2]>,
}

impl MedianInterval {
    /// The median of `values`; `None` without values.
    ///
    /// The interval goes from the k-th smallest to the k-th largest value. k is the largest number
    /// with P(B < k) ≤ 2.5 %, for B binomial with n and 1/2 (David and Nagaraja, Order Statistics,
    /// 7.1).
    pub fn of(values: &[f64]) -> Option<Self> {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        let rank = median_rank(sorted.len());
        let interval =
            rank.and_then(|k| Some([*sorted.get(k - 1)?, *sorted.get(sorted.len() - k)?]));
        Some(MedianInterval { value: quantile(&sorted, 0.5)?, interval })
    }
}

/// The rank k, from 1, of the lower end of the median's interval among `n` values.
fn median_rank(n: usize) -> Option<usize> {
    // Uses the logarithm of P(B = i), since 2^-n underflows for some thousand runs.
    let mut log_mass = -(n as f64) * std::f64::consts::LN_2;
    let mut below = 0.0;
    for i in 0..n {
        below += exp(log_mass);
        if below > TAIL {
            return (i > 0).then_some(i);
        }
        log_mass += ln((n - i) as f64 / (i + 1) as f64);
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Newcombe 1998, table I: 81 of 263, 15 of 148, 0 of 20, 1 of 29.
    #[test]
    fn wilsons_interval_has_its_published_values() {
        for (count, of, low, high) in [
            (81, 263, 0.2553, 0.3662),
            (15, 148, 0.0624, 0.1605),
            (0, 20, 0.0000, 0.1611),
            (1, 29, 0.0061, 0.1718),
        ] {
            let [l, h] = Proportion::new(count, of).wilson_95.unwrap();
            assert!((l - low).abs() < 5e-5 && (h - high).abs() < 5e-5, "{count} of {of}: {l} {h}");
        }
        assert_eq!(Proportion::new(0, 0).wilson_95, None);
        assert_eq!(Proportion::new(7, 7).wilson_95.unwrap()[1], 1.0);
    }

    /// Ranks from tables of the sign test at 5 %, two-sided.
    #[test]
    fn the_medians_interval_has_the_ranks_of_the_sign_test() {
        for (n, rank) in
            [(6, 1), (8, 1), (9, 2), (10, 2), (12, 3), (15, 4), (20, 6), (25, 8), (100, 40)]
        {
            assert_eq!(median_rank(n), Some(rank), "{n}");
        }
        assert_eq!((0..6).map(median_rank).collect::<Vec<_>>(), [None; 6]);
        assert!(median_rank(5000).is_some());
    }

    #[test]
    fn medians_may_include_infinite_values() {
        let values: Vec<f64> = (0..9).map(f64::from).chain([f64::INFINITY]).collect();
        let median = MedianInterval::of(&values).unwrap();
        assert_eq!((median.value, median.interval), (4.5, Some([1.0, 8.0])));
        assert_eq!(
            MedianInterval::of(&[f64::INFINITY; 6]).unwrap().interval,
            Some([f64::INFINITY; 2])
        );
        assert_eq!(MedianInterval::of(&[]), None);
        assert_eq!(MedianInterval::of(&[3.0]).unwrap().interval, None);
    }
}
