//! Maximum-likelihood noise of recorded positions: a white part, and a part whose correlation decays
//! with time.

use crate::math;

/// Rounds of the search, each over half the range of the round before.
const ROUNDS: usize = 14;
/// Points of the search along each coordinate: of the first round, and of the others.
const POINTS_FIRST: [usize; 2] = [13, 9];
const POINTS: [usize; 2] = [5, 5];
/// A correlated part is reported if it raises twice the log likelihood by at least this. One white recording
/// in 1000 reaches it (χ² with 2 degrees of freedom).
const LIKELIHOOD_RATIO_MIN: f64 = 13.8;
/// Steps of the numerical derivatives: of the correlated share, and of the logarithm of the time.
const STEPS: [f64; 2] = [0.01, 0.02];

/// A value with its standard error.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize)]
pub struct Measured {
    /// The value.
    pub value: f64,
    /// Its standard error.
    pub error: f64,
}

/// The noise of one coordinate, or of several together.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct NoiseFit {
    /// Standard deviation of a coordinate, mm.
    pub sd_mm: Measured,
    /// Standard deviation of its white part, mm.
    pub white_sd_mm: Measured,
    /// Standard deviation of its correlated part, mm; 0 if none is found.
    pub correlated_sd_mm: Measured,
    /// Correlation time, s; 0 if none is found.
    pub correlation_time_s: Measured,
}

impl NoiseFit {
    /// Variance of a mean of many positions that are `spacing_s` apart, times their number, mm².
    pub(super) fn long_mean_variance_mm2(&self, spacing_s: f64) -> f64 {
        let apart = spacing_s / self.correlation_time_s.value;
        let growth = (1.0 + math::exp(-apart)) / -math::exp_m1(-apart);
        self.white_sd_mm.value.powi(2) + self.correlated_sd_mm.value.powi(2) * growth
    }
}

/// Coordinates of positions at rest, without their mean and drift, and the times between them.
pub(super) struct Residuals<'a> {
    /// Time from the previous position to each position, s. The first value is not used.
    pub(super) gaps_s: &'a [f64],
    /// One series for each coordinate, mm.
    pub(super) series: &'a [Vec<f64>],
    /// The longest correlation time to look for, s.
    pub(super) time_max_s: f64,
    /// The shortest correlation time to look for, s.
    pub(super) time_min_s: f64,
}

impl Residuals<'_> {
    /// The maximum-likelihood noise, the same in every series.
    pub(super) fn fit(&self) -> NoiseFit {
        let [share, ln_time] = self.search();
        let gain = self.ln_likelihood(share, ln_time) - self.ln_likelihood(0.0, 0.0);
        if 2.0 * gain >= LIKELIHOOD_RATIO_MIN {
            return self.with_errors(share, ln_time);
        }
        let sd = self.variance_mm2(0.0, 0.0).sqrt();
        let sd_mm = Measured { value: sd, error: sd / (2.0 * self.count()).sqrt() };
        let none = Measured::default();
        NoiseFit { sd_mm, white_sd_mm: sd_mm, correlated_sd_mm: none, correlation_time_s: none }
    }

    fn count(&self) -> f64 {
        self.series.iter().map(Vec::len).sum::<usize>() as f64
    }

    /// The Kalman filter of the sum of an AR(1) process of variance `share` and white noise of variance
    /// `1 - share`: the mean of the squared, normalised innovations, which is the maximum-likelihood variance
    /// of the sum, and the sum of the logarithms of their variances.
    fn filter(&self, share: f64, ln_time: f64) -> (f64, f64) {
        let time_s = math::exp(ln_time);
        let mut expected = vec![0.0; self.series.len()];
        let (mut variance, mut squares, mut ln_determinant) = (share, 0.0, 0.0);
        for (k, gap_s) in self.gaps_s.iter().enumerate() {
            if k > 0 {
                let phi = math::exp(-gap_s / time_s);
                expected.iter_mut().for_each(|expected| *expected *= phi);
                variance = phi * phi * variance + share * (1.0 - phi * phi);
            }
            let innovation_variance = variance + 1.0 - share;
            let gain = variance / innovation_variance;
            for (expected, series) in expected.iter_mut().zip(self.series) {
                let innovation = series[k] - *expected;
                squares += innovation * innovation / innovation_variance;
                *expected += gain * innovation;
            }
            variance *= 1.0 - gain;
            ln_determinant += math::ln(innovation_variance) * self.series.len() as f64;
        }
        (squares / self.count(), ln_determinant)
    }

    /// The maximum-likelihood variance of a coordinate, mm².
    fn variance_mm2(&self, share: f64, ln_time: f64) -> f64 {
        self.filter(share, ln_time).0
    }

    /// Logarithm of the likelihood with the maximum-likelihood variance, except for a constant.
    fn ln_likelihood(&self, share: f64, ln_time: f64) -> f64 {
        let (variance_mm2, ln_determinant) = self.filter(share, ln_time);
        -0.5 * (self.count() * math::ln(variance_mm2) + ln_determinant)
    }

    /// The correlated share and the logarithm of the time at the maximum of the likelihood, by grids
    /// that close in on it.
    fn search(&self) -> [f64; 2] {
        let limits = [(0.0, 1.0), (math::ln(self.time_min_s), math::ln(self.time_max_s))];
        let mut best = (f64::NEG_INFINITY, [0.0, limits[1].0]);
        let mut half = limits.map(|(low, high)| 0.5 * (high - low));
        let mut centre = limits.map(|(low, high)| 0.5 * (low + high));
        let mut points = POINTS_FIRST;
        for _ in 0..ROUNDS {
            let along = |i: usize| {
                let ((low, high), count) = (limits[i], points[i]);
                let step = 2.0 * half[i] / (count - 1) as f64;
                (0..count).map(move |n| (centre[i] - half[i] + step * n as f64).clamp(low, high))
            };
            for share in along(0) {
                for ln_time in along(1) {
                    // At a share of 0 the likelihood does not depend on the time; a small share shows which time
                    // is better.
                    let share = share.max(1e-6);
                    let ln_likelihood = self.ln_likelihood(share, ln_time);
                    if ln_likelihood > best.0 {
                        best = (ln_likelihood, [share, ln_time]);
                    }
                }
            }
            centre = best.1;
            half = half.map(|half| 0.5 * half);
            points = POINTS;
        }
        best.1
    }

    /// Standard errors from the curvature of the likelihood at its maximum.
    fn with_errors(&self, best_share: f64, ln_time: f64) -> NoiseFit {
        let [h, g] = STEPS;
        // So that a step to either side stays within 0 and 1.
        let share = best_share.clamp(2.0 * h, 1.0 - 2.0 * h);
        let l = |i: f64, j: f64| self.ln_likelihood(share + i * h, ln_time + j * g);
        let centre = l(0.0, 0.0);
        let a = -(l(1.0, 0.0) - 2.0 * centre + l(-1.0, 0.0)) / (h * h);
        let b = -(l(0.0, 1.0) - 2.0 * centre + l(0.0, -1.0)) / (g * g);
        let c = -(l(1.0, 1.0) - l(1.0, -1.0) - l(-1.0, 1.0) + l(-1.0, -1.0)) / (4.0 * h * g);
        let determinant = a * b - c * c;
        // If the likelihood has no peak, each variance comes from its own curvature, with a standard error of at
        // most 0.5 for the share and 2 for the logarithm of the time.
        let (share2, time2, both) = match determinant > 0.0 && a > 0.0 {
            true => (b / determinant, a / determinant, -c / determinant),
            false => (1.0 / a.max(4.0), 1.0 / b.max(0.25), 0.0),
        };
        let n = self.count();
        // The error of a logarithm of a variance that depends on share, time and the scale.
        let error = |ln_variance: &dyn Fn(f64, f64) -> f64| {
            let by_share =
                (ln_variance(share + h, ln_time) - ln_variance(share - h, ln_time)) / (2.0 * h);
            let by_time =
                (ln_variance(share, ln_time + g) - ln_variance(share, ln_time - g)) / (2.0 * g);
            let variance = by_share * by_share * share2
                + by_time * by_time * time2
                + 2.0 * by_share * by_time * both
                + 2.0 / n;
            0.5 * variance.max(0.0).sqrt()
        };
        let scale = |share, ln_time| math::ln(self.variance_mm2(share, ln_time));
        let variance_mm2 = self.variance_mm2(best_share, ln_time);
        let sd = |part: f64, error: f64| {
            let value = (variance_mm2 * part).sqrt();
            Measured { value, error: value * error }
        };
        let white = |share: f64, ln_time| scale(share, ln_time) + math::ln(1.0 - share);
        let correlated = |share: f64, ln_time| scale(share, ln_time) + math::ln(share);
        let time_s = math::exp(ln_time);
        NoiseFit {
            sd_mm: sd(1.0, error(&scale)),
            white_sd_mm: sd(1.0 - best_share, error(&white)),
            correlated_sd_mm: sd(best_share, error(&correlated)),
            correlation_time_s: Measured { value: time_s, error: time_s * time2.max(0.0).sqrt() },
        }
    }
}
