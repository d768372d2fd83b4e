//! Checks from the innovations whether the positions' noise is white and as large as configured.

use crate::keys::{Rule, section, within};
use crate::math;
use nalgebra::Vector3;
use std::collections::VecDeque;
use std::time::Duration;

/// Innovations that come faster are summed until they span this time, s: so the lags span as much at any rate.
const SPACING_TAKEN_S: f64 = 0.02;
/// Number of lags, in positions: 0.8 s at 40 Hz.
const LAGS: usize = 32;
/// Memory of the fading sums, in positions: half an insertion of 100 mm at 2 mm/s and 40 Hz.
const MEMORY: f64 = 1000.0;
/// Inflation assumed at first.
const PRIOR_INFLATION: f64 = 2.0;
/// Number of innovations that have the same weight as this assumption.
const PRIOR_WEIGHT: f64 = 100.0;

/// A standard deviation, mm.
const SD: Rule = within(0.0, 100.0);
/// Shortest time between two positions that counts, s.
const SPACING_MIN_S: f64 = 1e-4;

section! {
    /// `[tracker.noise]`: the noise of each coordinate of a position, as `needle-bench calibrate
    /// tracker` measures it: a white part, and a part whose correlation decays with time.
    #[derive(Copy)]
    pub struct PositionNoise {
        /// Standard deviation of the white part, mm.
        white_sd_mm: f64 [SD];
        /// Standard deviation of the correlated part, mm.
        correlated_sd_mm: f64 [SD];
        /// Its correlation time: after so long the correlation is 1/e. At most the length of the run.
        correlation_time as "correlation_time_s": Duration [within(0.0, 3600.0)];
    }
}

impl PositionNoise {
    /// Standard deviation of each coordinate, mm.
    pub fn sd_mm(&self) -> f64 {
        math::hypot(self.white_sd_mm, self.correlated_sd_mm)
    }

    /// How many positions that are `spacing_s` apart carry as much information as one independent position: the
    /// variance of their mean, relative to that of as many independent positions. At least 1.
    pub fn inflation(&self, spacing_s: f64) -> f64 {
        (self.long_mean_variance_mm2(spacing_s) / self.sd_mm().powi(2)).max(1.0)
    }

    /// Variance of each coordinate of a mean of many positions that are `spacing_s` apart, times
    /// their number, mm²: `w² + c² (1 + φ) / (1 - φ)` with the correlation
    /// `φ = exp(-spacing / time)` of neighbours.
    fn long_mean_variance_mm2(&self, spacing_s: f64) -> f64 {
        let apart = spacing_s.max(SPACING_MIN_S) / self.correlation_time.as_secs_f64();
        let growth = (1.0 + math::exp(-apart)) / -math::exp_m1(-apart);
        self.white_sd_mm.powi(2) + self.correlated_sd_mm.powi(2) * growth
    }
}

/// Detects from the innovations noise that is correlated, or larger than configured.
///
/// With white noise the mean of n positions has the variance σ²/n. With correlated noise the
/// variance is f times as large, `f = (c₀ + 2 Σ cₖ) / σ²`, with the autocovariances cₖ at the lags
/// k. An observer that treats each position as independent is over-confident by this factor. Errors
/// of the model also correlate the innovations, and then lower the observers' confidence in the
/// same way.
///
/// If the noise is configured ([`PositionNoise`]), its f replaces the inflation assumed at first, and
/// is the lower limit of the inflation.
#[derive(Debug, Clone)]
pub struct Whiteness {
    /// σ², as configured.
    variance_mm2: f64,
    /// The sum of the innovations that span less than [`SPACING_TAKEN_S`] so far, their number, and what they span, s.
    waiting: (Vector3<f64>, u32, f64),
    /// The last innovations, newest first.
    last: VecDeque<Vector3<f64>>,
    /// Sum of the squares of the innovations, and of twice their products at each lag with Bartlett's weights (the
    /// estimate of Newey and West, times their number); old ones fade.
    long_run_sum_mm2: f64,
    /// Number of innovations in the sums; old ones fade.
    count: f64,
    /// The configured noise of the positions, and the variance that the observer assumes, mm².
    noise: Option<(PositionNoise, f64)>,
}

impl Whiteness {
    /// Starts without innovations; `position_sd_mm` is the configured standard deviation of each
    /// coordinate.
    pub fn new(position_sd_mm: f64) -> Self {
        Whiteness {
            variance_mm2: position_sd_mm.powi(2),
            waiting: (Vector3::zeros(), 0, 0.0),
            last: VecDeque::with_capacity(LAGS),
            long_run_sum_mm2: 0.0,
            count: 0.0,
            noise: None,
        }
    }

    /// Sets the noise of the positions, if it is configured. `observer_sd_mm` is the standard
    /// deviation that the observer assumes for each coordinate.
    #[must_use]
    pub fn with_noise(self, noise: Option<PositionNoise>, observer_sd_mm: f64) -> Self {
        Whiteness { noise: noise.map(|noise| (noise, observer_sd_mm.powi(2))), ..self }
    }

    /// Adds the next innovation, mm, `spacing_s` after the one before. An innovation that is not finite comes from a
    /// lost estimate and is ignored.
    pub fn take(&mut self, innovation_mm: Vector3<f64>, spacing_s: f64) {
        if !innovation_mm.iter().all(|component| component.is_finite()) {
            return;
        }
        let (sum_mm, count, span_s) = &mut self.waiting;
        *sum_mm += innovation_mm;
        *count += 1;
        *span_s += spacing_s;
        if *span_s < SPACING_TAKEN_S {
            return;
        }
        // If the innovations are independent this sum has the variance of one.
        let innovation_mm = *sum_mm / f64::from(*count).sqrt();
        self.waiting = (Vector3::zeros(), 0, 0.0);
        let keep = 1.0 - 1.0 / MEMORY;
        self.count = keep * self.count + 1.0;
        // With Bartlett's weights the sum is the variance of a mean, so it is never negative.
        let weight = |lag: u32| 1.0 - f64::from(lag) / (LAGS + 1) as f64;
        let earlier: Vector3<f64> = (1..).zip(&self.last).map(|(lag, i)| i * weight(lag)).sum();
        self.long_run_sum_mm2 =
            keep * self.long_run_sum_mm2 + innovation_mm.dot(&(innovation_mm + earlier * 2.0));
        self.last.truncate(LAGS - 1);
        self.last.push_front(innovation_mm);
    }

    /// The variance inflation f: how many positions, `spacing_s` apart, carry as much information as one
    /// position with the configured white noise. It is at least 1, and at least the f of the configured noise.
    pub fn inflation(&self, spacing_s: f64) -> f64 {
        let measured = self.long_run_sum_mm2 / (3.0 * self.variance_mm2);
        let configured = self.noise.map(|(noise, variance_mm2)| {
            (noise.long_mean_variance_mm2(spacing_s) / variance_mm2).max(1.0)
        });
        let sum = PRIOR_WEIGHT * configured.unwrap_or(PRIOR_INFLATION) + measured;
        (sum / (PRIOR_WEIGHT + self.count)).max(configured.unwrap_or(1.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    const SPACING_S: f64 = 0.025;

    /// Uniform noise in each coordinate.
    fn draw(rng: &mut Pcg64) -> Vector3<f64> {
        Vector3::from_fn(|_, _| 2.0 * rng.random::<f64>() - 1.0)
    }

    fn inflation(noise: impl FnMut() -> Vector3<f64>, count: usize) -> f64 {
        // Uniform within 1 mm.
        let mut whiteness = Whiteness::new((1.0f64 / 3.0).sqrt());
        std::iter::repeat_with(noise)
            .take(count)
            .for_each(|noise| whiteness.take(noise, SPACING_S));
        whiteness.inflation(SPACING_S)
    }

    /// Positions with φ = e⁻¹ between neighbours, and noise without a size or without a time.
    #[test]
    fn positions_of_slow_noise_count_for_less() {
        let inflation = |white_sd_mm, correlated_sd_mm, time_s, spacing_s| {
            let correlation_time = Duration::from_secs_f64(time_s);
            PositionNoise { white_sd_mm, correlated_sd_mm, correlation_time }.inflation(spacing_s)
        };
        let half = 0.5 * (1.0 + (1.0 + (-1f64).exp()) / (1.0 - (-1f64).exp()));
        assert!((inflation(0.3, 0.3, 0.1, 0.1) - half).abs() < 1e-9);
        for (white, correlated, time_s, spacing_s) in [
            (0.3, 0.0, 1.0, 0.025),
            (0.3, 0.3, 0.0, 0.025),
            (0.0, 0.0, 0.0, 0.0),
            (0.3, 0.3, 1.0, f64::INFINITY),
        ] {
            let one = inflation(white, correlated, time_s, spacing_s);
            assert!((one - 1.0).abs() < 1e-9, "{one}");
        }
        assert!(inflation(0.3, 0.3, 1.0, -1.0).is_finite());
    }

    #[test]
    fn half_of_the_positions_count_before_any_is_measured() {
        assert_eq!(Whiteness::new(1.0).inflation(SPACING_S), PRIOR_INFLATION);
    }

    /// Less noise than configured does not raise the confidence; more noise lowers it.
    #[test]
    fn noise_counts_if_it_is_larger_than_configured() {
        let mut rng = Pcg64::seed_from_u64(4);
        assert_eq!(inflation(Vector3::zeros, 1000), 1.0);
        let twice = inflation(|| draw(&mut rng) * 2.0, 4000);
        assert!((3.2..4.5).contains(&twice), "{twice}");
    }

    /// Without a guard one NaN would make every later position count in full.
    #[test]
    fn an_innovation_that_is_not_finite_is_left_out() {
        let mut whiteness = Whiteness::new(0.1);
        (0..1000).for_each(|_| whiteness.take(Vector3::x(), SPACING_S));
        let before = whiteness.inflation(SPACING_S);
        whiteness.take(Vector3::new(0.0, f64::NAN, f64::INFINITY), SPACING_S);
        assert!(before > 100.0 && whiteness.inflation(SPACING_S) == before);
    }

    #[test]
    fn white_noise_counts_in_full() {
        let mut rng = Pcg64::seed_from_u64(1);
        let inflation = inflation(|| draw(&mut rng), 4000);
        assert!((1.0..1.25).contains(&inflation), "{inflation}");
    }

    /// Half of the noise is white, half has a correlation length of 8 positions: the variance of a
    /// long mean is 0.5 + 0.5 (1 + r) / (1 - r) = 8.5 times that of white noise. Bartlett's weights
    /// lower this by a fifth.
    #[test]
    fn correlated_noise_counts_for_less() {
        let mut rng = Pcg64::seed_from_u64(2);
        let kept = (-1.0f64 / 8.0).exp();
        let mut slow = Vector3::zeros();
        let inflation = inflation(
            || {
                slow = slow * kept + draw(&mut rng) * (1.0 - kept * kept).sqrt();
                (slow + draw(&mut rng)) * 0.5f64.sqrt()
            },
            4000,
        );
        assert!((5.0..9.0).contains(&inflation), "{inflation}");
    }

    /// Half of the variance is correlated over 0.2 s. A position counts for as little as one of 200.
    #[test]
    fn correlated_noise_is_seen_at_a_high_rate() {
        let (mut rng, mut slow, spacing_s) = (Pcg64::seed_from_u64(6), Vector3::zeros(), 1e-3);
        let kept = (-spacing_s / 0.2f64).exp();
        let mut whiteness = Whiteness::new((1.0f64 / 3.0).sqrt());
        for _ in 0..20_000 {
            slow = slow * kept + draw(&mut rng) * (1.0 - kept * kept).sqrt();
            whiteness.take((slow + draw(&mut rng)) * 0.5f64.sqrt(), spacing_s);
        }
        let inflation = whiteness.inflation(spacing_s);
        assert!((100.0..220.0).contains(&inflation), "{inflation}");
    }

    /// A position that is sent five times counts once.
    #[test]
    fn repeated_positions_count_once() {
        let mut rng = Pcg64::seed_from_u64(3);
        let (mut sent, mut position) = (0, Vector3::zeros());
        let inflation = inflation(
            || {
                if sent % 5 == 0 {
                    position = draw(&mut rng);
                }
                sent += 1;
                position
            },
            4000,
        );
        assert!((4.0..5.5).contains(&inflation), "{inflation}");
    }

    /// Half of the variance is correlated over 0.2 s: as much as one independent position is worth 8.5 positions
    /// that are 25 ms apart, or 1.007 that are 1 s apart.
    #[test]
    fn configured_noise_counts_at_once_and_always() {
        let noise = PositionNoise {
            white_sd_mm: 0.5f64.sqrt(),
            correlated_sd_mm: 0.5f64.sqrt(),
            correlation_time: Duration::from_millis(200),
        };
        assert!((noise.sd_mm() - 1.0).abs() < 1e-12);
        let mut whiteness = Whiteness::new(1.0).with_noise(Some(noise), 1.0);
        let expected = 0.5 + 0.5 / (0.025f64 / 0.4).tanh();
        let close = |seen: f64, expected: f64| (seen / expected - 1.0).abs() < 1e-9;
        assert!(close(whiteness.inflation(0.025), expected), "{expected}");
        assert!((whiteness.inflation(1.0) - 1.007).abs() < 1e-3);
        assert!(close(whiteness.inflation(f64::INFINITY), 1.0), "the first counts in full");
        assert!(whiteness.inflation(0.0).is_finite());
        (0..4000).for_each(|_| whiteness.take(Vector3::zeros(), SPACING_S));
        assert!(
            close(whiteness.inflation(0.025), expected),
            "less noise than configured does not count"
        );
        let white = PositionNoise { correlation_time: Duration::ZERO, ..noise };
        let whiteness = Whiteness::new(1.0).with_noise(Some(white), 0.5);
        assert!(close(whiteness.inflation(0.025), 4.0), "the observer assumes a quarter");
    }

    #[test]
    fn measured_noise_over_the_configured_counts() {
        let mut rng = Pcg64::seed_from_u64(5);
        let white = PositionNoise {
            white_sd_mm: 0.1,
            correlated_sd_mm: 0.0,
            correlation_time: Duration::ZERO,
        };
        let mut whiteness = Whiteness::new((1.0f64 / 3.0).sqrt()).with_noise(Some(white), 0.577);
        assert_eq!(whiteness.inflation(SPACING_S), 1.0);
        (0..4000).for_each(|_| whiteness.take(draw(&mut rng) * 2.0, SPACING_S));
        assert!(whiteness.inflation(SPACING_S) > 3.2);
    }
}
