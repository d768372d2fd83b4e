//! The positive part of a normal variable, and its best linear fit.

use crate::math;
use std::f64::consts::{FRAC_1_SQRT_2, PI};

/// A smaller standard deviation counts as 0: the positive part is then exact.
const SD_MIN: f64 = 1e-9;
/// A variable farther from the kink than this many standard deviations counts as on one side of it.
const SD_FAR: f64 = 8.0;

/// The positive part `q = max(a, 0)` of a normal variable a. An edge of the play acts on an uncertain lag in this way.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PositivePart {
    /// E q.
    pub(super) mean: f64,
    /// P(a > 0), the derivative of E q by the mean of a: the gain of the best linear fit.
    pub(super) gain: f64,
}

fn density(u: f64) -> f64 {
    math::exp(-0.5 * u * u) / (2.0 * PI).sqrt()
}

fn distribution(u: f64) -> f64 {
    0.5 * math::erfc(-u * FRAC_1_SQRT_2)
}

impl PositivePart {
    /// The positive part of a normal variable with this mean and standard deviation.
    pub(super) fn of(mean: f64, sd: f64) -> Self {
        if sd < SD_MIN || mean.abs() > SD_FAR * sd {
            return PositivePart { mean: mean.max(0.0), gain: f64::from(mean > 0.0) };
        }
        let u = mean / sd;
        let gain = distribution(u);
        PositivePart { mean: mean * gain + sd * density(u), gain }
    }

    /// The variance that the best linear fit of `max(a + step, 0) − max(a, 0)` does not explain,
    /// `step` ≥ 0.
    pub(super) fn residual_variance(mean: f64, sd: f64, step: f64) -> f64 {
        let after = mean + step;
        if sd < SD_MIN || mean > SD_FAR * sd || after < -SD_FAR * sd {
            return 0.0;
        }
        let (u, u_after) = (mean / sd, after / sd);
        let (p, p_after) = (distribution(u), distribution(u_after));
        // The square is step² above the kink, and that of a + step where the step crosses it.
        let crossing = (after * after + sd * sd) * (p_after - p)
            + sd * (after * density(u_after) - (after + step) * density(u));
        let moved = Self::of(after, sd).mean - Self::of(mean, sd).mean;
        let gain = p_after - p;
        (step * step * p + crossing - moved * moved - (gain * sd).powi(2)).max(0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// E f(a) for a normal `a`, by numerical integration.
    fn expect(mean: f64, sd: f64, f: impl Fn(f64) -> f64) -> f64 {
        let n = 20_000;
        let width = 20.0 / f64::from(n);
        (0..n)
            .map(|i| -10.0 + (f64::from(i) + 0.5) * width)
            .map(|u| f(mean + sd * u) * density(u) * width)
            .sum()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn agrees_with_the_integrals(mean in -3.0..3.0f64, sd in 0.05..2.0f64, step in 0.0..2.0f64) {
            let part = PositivePart::of(mean, sd);
            prop_assert!((part.mean - expect(mean, sd, |a| a.max(0.0))).abs() < 1e-5);
            let moved = |a: f64| (a + step).max(0.0) - a.max(0.0);
            let first = expect(mean, sd, moved);
            let slope = expect(mean, sd, |a| moved(a) * (a - mean)) / (sd * sd);
            let left = expect(mean, sd, |a| (moved(a) - first - slope * (a - mean)).powi(2));
            prop_assert!((PositivePart::residual_variance(mean, sd, step) - left).abs() < 1e-4);
        }
    }

    #[test]
    fn a_sure_variable_has_the_positive_part_itself() {
        assert_eq!(PositivePart::of(-0.3, 0.0), PositivePart { mean: 0.0, gain: 0.0 });
        assert_eq!(PositivePart::of(0.3, 0.0), PositivePart { mean: 0.3, gain: 1.0 });
        assert_eq!(PositivePart::residual_variance(-0.1, 0.0, 0.3), 0.0);
    }
}
