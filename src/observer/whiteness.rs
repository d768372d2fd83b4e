//! Checks from the innovations whether the positions' noise is white and as large as configured.

use nalgebra::Vector3;
use std::collections::VecDeque;

/// Number of lags, in positions: 0.8 s at 40 Hz.
const LAGS: usize = 32;
/// Memory of the fading sums, in positions: half an insertion of 100 mm at 2 mm/s and 40 Hz.
const MEMORY: f64 = 1000.0;
/// Inflation assumed at first, and the number of innovations that has the same weight.
const PRIOR_INFLATION: f64 = 2.0;
const PRIOR_WEIGHT: f64 = 100.0;

/// Detects from the innovations noise that is correlated, or larger than configured.
///
/// With white noise the mean of n positions has the variance σ²/n. With correlated noise the
/// variance is f times as large, `f = (c₀ + 2 Σ cₖ) / σ²`, with the autocovariances cₖ at the lags
/// k. An observer that treats each position as independent is over-confident by this factor. Errors
/// of the model also correlate the innovations, and then lower the observers' confidence in the
/// same way.
#[derive(Debug, Clone)]
pub struct Whiteness {
    /// σ², as configured.
    variance_mm2: f64,
    /// The last innovations, newest first.
    last: VecDeque<Vector3<f64>>,
    /// Sums of products at each lag, from 0; old products fade.
    products_mm2: [f64; LAGS + 1],
    /// Innovations in the sums.
    count: f64,
}

impl Whiteness {
    /// No innovations yet; `position_sd_mm` is the configured standard deviation of each
    /// coordinate.
    pub fn new(position_sd_mm: f64) -> Self {
        Whiteness {
            variance_mm2: position_sd_mm.powi(2),
            last: VecDeque::with_capacity(LAGS + 1),
            products_mm2: [0.0; LAGS + 1],
            count: 0.0,
        }
    }

    /// Adds the next innovation, mm. An innovation that is not finite comes from a lost estimate
    /// and is ignored.
    pub fn take(&mut self, innovation_mm: Vector3<f64>) {
        if !innovation_mm.iter().all(|component| component.is_finite()) {
            return;
        }
        self.last.truncate(LAGS);
        self.last.push_front(innovation_mm);
        let keep = 1.0 - 1.0 / MEMORY;
        self.count = keep * self.count + 1.0;
        for (product, earlier) in self.products_mm2.iter_mut().zip(&self.last) {
            *product = keep * *product + innovation_mm.dot(earlier);
        }
    }

    /// How many positions carry as much information as one with white noise as configured; at least
    /// 1.
    pub fn inflation(&self) -> f64 {
        // Bartlett's weights: the sum is the variance of a mean, so it is never negative.
        let part = |lag: usize| 1.0 - lag as f64 / (LAGS + 1) as f64;
        let [alone, lagged @ ..] = &self.products_mm2;
        let correlated: f64 = (1..).zip(lagged).map(|(lag, product)| part(lag) * product).sum();
        let seen = (alone + 2.0 * correlated) / (3.0 * self.variance_mm2);
        let sum = PRIOR_WEIGHT * PRIOR_INFLATION + seen;
        (sum / (PRIOR_WEIGHT + self.count)).max(1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    /// Uniform noise in each coordinate.
    fn draw(rng: &mut Pcg64) -> Vector3<f64> {
        Vector3::from_fn(|_, _| 2.0 * rng.random::<f64>() - 1.0)
    }

    fn inflation(noise: impl FnMut() -> Vector3<f64>, count: usize) -> f64 {
        // Uniform within 1 mm.
        let mut whiteness = Whiteness::new((1.0f64 / 3.0).sqrt());
        std::iter::repeat_with(noise).take(count).for_each(|noise| whiteness.take(noise));
        whiteness.inflation()
    }

    #[test]
    fn half_of_the_positions_count_before_any_is_seen() {
        assert_eq!(Whiteness::new(1.0).inflation(), PRIOR_INFLATION);
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
        (0..1000).for_each(|_| whiteness.take(Vector3::x()));
        let before = whiteness.inflation();
        whiteness.take(Vector3::new(0.0, f64::NAN, f64::INFINITY));
        assert!(before > 100.0 && whiteness.inflation() == before);
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
}
