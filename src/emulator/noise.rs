//! The noise of an emulated tracker's positions: a white part, and a part that is correlated in time.
//!
//! Both are functions of the seed and the position's number, so that a study can take one position
//! without those before it.

use crate::math;
use nalgebra::Vector3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

/// Noise added to each coordinate of a tracked position, independent from one to the next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum WhiteNoise {
    /// None: the position is exact.
    None,
    /// Uniform between minus and plus this value, mm.
    Uniform(f64),
    /// Gaussian with this standard deviation, mm.
    Gaussian(f64),
}

impl WhiteNoise {
    /// The noise of position number `k`, mm. It depends only on `self`, the seed and `k`, so the positions
    /// before need not be drawn.
    pub fn draw(self, seed: u64, k: u64) -> Vector3<f64> {
        let rng_at_k = |draws_per_position: u128| {
            let mut rng = Pcg64::seed_from_u64(seed);
            rng.advance(draws_per_position * u128::from(k));
            rng
        };
        match self {
            WhiteNoise::None => Vector3::zeros(),
            WhiteNoise::Uniform(half_mm) => {
                let mut rng = rng_at_k(3);
                Vector3::from_fn(|_, _| half_mm * (2.0 * rng.random::<f64>() - 1.0))
            }
            WhiteNoise::Gaussian(sd_mm) => {
                let mut rng = rng_at_k(6);
                Vector3::from_fn(|_, _| sd_mm * standard_normal(rng.random(), rng.random()))
            }
        }
    }

    /// Variance of each coordinate, mm².
    pub fn variance_mm2(self) -> f64 {
        match self {
            WhiteNoise::None => 0.0,
            WhiteNoise::Uniform(half_mm) => half_mm * half_mm / 3.0,
            WhiteNoise::Gaussian(sd_mm) => sd_mm * sd_mm,
        }
    }
}

/// Gaussian noise whose correlation decays with time as `exp(-t / time_s)`: a stationary
/// Ornstein-Uhlenbeck process, which is AR(1) at positions of one interval.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CorrelatedNoise {
    /// Standard deviation of each coordinate, mm.
    pub sd_mm: f64,
    /// Correlation time, s.
    pub time_s: f64,
}

impl CorrelatedNoise {
    /// Two positions count as independent if they are this many correlation times apart: exp(-40) is under
    /// the rounding of a double.
    const INDEPENDENT_TIMES: f64 = 40.0;
    /// The number of this noise's seed in the sequence [`split_mix64`], so that it is independent of the white part.
    const STREAM: u64 = 0x434F_4C4F_5552_0000;

    /// The noise of position number `k` where positions are `interval_s` apart, mm.
    ///
    /// Positions that are far enough apart are drawn independently. Between two of them the process
    /// is a bridge, which is halved until it ends at `k`: the value in the middle, a time h from
    /// both ends a and b, has the mean `(a + b) ρ / (1 + ρ²)` and the variance
    /// `(1 - ρ²) / (1 + ρ²)` with `ρ = exp(-h / time_s)`.
    pub fn draw(self, seed: u64, k: u64, interval_s: f64) -> Vector3<f64> {
        let seed = split_mix64(seed, Self::STREAM);
        let unit = |k| WhiteNoise::Gaussian(1.0).draw(seed, k);
        let per_interval = interval_s / self.time_s;
        let spacing = (Self::INDEPENDENT_TIMES / per_interval).ceil() as u64;
        let spacing = spacing.clamp(1, 1 << 40).next_power_of_two();
        let (mut first, mut half) = (k - k % spacing, spacing / 2);
        let (mut a, mut b) = (unit(first), unit(first + spacing));
        while first != k {
            let apart = half as f64 * per_interval;
            let rho = math::exp(-apart);
            let divisor = 1.0 + rho * rho;
            let sd = (-math::exp_m1(-2.0 * apart) / divisor).sqrt();
            let middle = (a + b) * (rho / divisor) + unit(first + half) * sd;
            if k < first + half {
                b = middle;
            } else {
                (first, a) = (first + half, middle);
            }
            half /= 2;
        }
        a * self.sd_mm
    }

    /// Variance of each coordinate of a mean of many positions that are `interval_s` apart, times
    /// their number: `sd² (1 + φ) / (1 - φ)` with the correlation φ of neighbours, mm².
    pub fn long_mean_variance_mm2(self, interval_s: f64) -> f64 {
        let apart = interval_s / self.time_s;
        self.sd_mm.powi(2) * (1.0 + math::exp(-apart)) / -math::exp_m1(-apart)
    }
}

/// Number `number` of the SplitMix64 sequence that starts at `seed`.
pub fn split_mix64(seed: u64, number: u64) -> u64 {
    let z = seed.wrapping_add(number.wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15));
    let z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// A standard normal number from two uniform numbers in [0, 1) (Box and Muller).
fn standard_normal(u: f64, v: f64) -> f64 {
    (-2.0 * math::ln(1.0 - u)).sqrt() * math::cos(std::f64::consts::TAU * v)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn white_noise_has_its_configured_spread() {
        for (noise, variance) in
            [(WhiteNoise::Uniform(1.0), 1.0 / 3.0), (WhiteNoise::Gaussian(0.5), 0.25)]
        {
            let (mut sum, mut squares) = (0.0, 0.0);
            for k in 0..20_000 {
                let p = noise.draw(7, k);
                assert!(!matches!(noise, WhiteNoise::Uniform(half) if p.amax() > half));
                sum += p.sum();
                squares += p.norm_squared();
            }
            assert!((sum / 60_000.0).abs() < 0.02 && (squares / 60_000.0 - variance).abs() < 0.01);
        }
    }

    #[test]
    fn white_noise_is_uncorrelated_between_numbers_and_between_seeds() {
        let noise = WhiteNoise::Gaussian(1.0);
        let correlation = |next: fn(u64) -> (u64, u64)| {
            let products = (0..20_000).map(|k| {
                let (seed, k_next) = next(k);
                noise.draw(7, k).dot(&noise.draw(seed, k_next))
            });
            products.sum::<f64>() / 60_000.0
        };
        assert!(correlation(|k| (7, k + 1)).abs() < 0.02);
        assert!(correlation(|k| (8, k)).abs() < 0.02);
    }

    const INTERVAL_S: f64 = 0.025;

    /// Autocovariance of one coordinate at `lag` positions, mm².
    fn autocovariance(noise: CorrelatedNoise, lag: u64) -> f64 {
        let at = |k| noise.draw(7, k, INTERVAL_S);
        (0..40_000).map(|k| at(k).dot(&at(k + lag))).sum::<f64>() / 120_000.0
    }

    /// Noise of neighbouring seeds is uncorrelated.
    #[test]
    fn correlated_noise_decays_as_configured() {
        let noise = CorrelatedNoise { sd_mm: 0.5, time_s: 0.2 };
        for lag in [0, 1, 3, 8, 20, 60] {
            let expected = 0.25 * (-INTERVAL_S * lag as f64 / 0.2).exp();
            let seen = autocovariance(noise, lag);
            assert!((seen - expected).abs() < 0.012, "lag {lag}: {seen}, not {expected}");
        }
        let of = |seed, k| noise.draw(seed, k, INTERVAL_S);
        let apart: f64 = (0..40_000).map(|k| of(7, k).dot(&of(8, k))).sum();
        assert!((apart / 120_000.0).abs() < 0.012);
    }

    /// The noise is drawn in bridges. Their ends do not show in the changes from one position to the next.
    #[test]
    fn correlated_noise_is_an_ar1_process() {
        let noise = CorrelatedNoise { sd_mm: 1.0, time_s: 0.2 };
        let phi = (-INTERVAL_S / 0.2f64).exp();
        let left = |k: u64| noise.draw(3, k + 1, INTERVAL_S) - phi * noise.draw(3, k, INTERVAL_S);
        let (mut square, mut neighbours) = (0.0, 0.0);
        let count = 40_000u32;
        for k in 0..u64::from(count) {
            square += left(k).norm_squared();
            neighbours += left(k).dot(&left(k + 1));
        }
        let variance = square / f64::from(3 * count);
        assert!((variance / (1.0 - phi * phi) - 1.0).abs() < 0.02, "{variance}");
        assert!((neighbours / square).abs() < 0.012, "the changes are white");
    }

    #[test]
    fn a_long_mean_has_the_stated_variance() {
        let noise = CorrelatedNoise { sd_mm: 0.5, time_s: 0.2 };
        let (means, of) = (400u64, 400u64);
        let mean = |block: u64| {
            let sum: Vector3<f64> =
                (0..of).map(|k| noise.draw(5, block * 10 * of + k, INTERVAL_S)).sum();
            sum / of as f64
        };
        let variance = (0..means).map(|block| mean(block).norm_squared()).sum::<f64>();
        let variance = variance / (3 * means) as f64 * of as f64;
        let stated = noise.long_mean_variance_mm2(INTERVAL_S);
        assert!((variance / stated - 1.0).abs() < 0.12, "{variance}, stated {stated}");
    }

    /// The first values of SplitMix64 from seed 1234567, as its reference gives them.
    #[test]
    fn split_mix64_gives_the_published_numbers() {
        let values = [0, 1, 2].map(|count| split_mix64(1_234_567, count));
        assert_eq!(
            values,
            [6_457_827_717_110_365_317, 3_203_168_211_198_807_973, 9_817_491_932_198_370_423]
        );
    }
}
