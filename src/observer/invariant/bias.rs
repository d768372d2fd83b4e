//! The bias of the innovations across the heading: it shows that needle or tissue are no longer as the observer
//! estimates them. A lag along the heading is left to the gates of the track.

use crate::math;
use nalgebra::Vector3;

/// An innovation counts for `exp(-d / MEMORY_MM)` after another d mm: 200 positions at 2 mm/s and 40 Hz.
const MEMORY_MM: f64 = 10.0;

/// The sum of the last innovations. If the observer's model is right they are independent, so that their sum does
/// not grow faster than that of noise.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct InnovationBias {
    sum: Vector3<f64>,
    /// Variance of each coordinate of the sum if the model is right.
    variance: f64,
    /// Depth of the last innovation, mm.
    at_mm: f64,
}

impl InnovationBias {
    /// Adds the part of an innovation across the heading, plane frame, in units of its standard deviation, made at the
    /// depth `at_mm`.
    pub(super) fn take(&mut self, across: &Vector3<f64>, at_mm: f64) {
        let keep = math::exp((self.at_mm - at_mm) / MEMORY_MM);
        self.sum = self.sum * keep + across;
        self.variance = self.variance * keep * keep + 1.0;
        self.at_mm = at_mm;
    }

    /// χ² of the sum: two degrees of freedom if the model is right; 0 before the first innovation.
    pub(super) fn chi_squared(&self) -> f64 {
        if self.variance > 0.0 { self.sum.norm_squared() / self.variance } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    /// The largest χ² of 20,000 innovations, 20 a mm, with this bias.
    fn largest(bias: Vector3<f64>) -> f64 {
        let (mut rng, mut watch) = (Pcg64::seed_from_u64(1), InnovationBias::default());
        let mut draw = || Vector3::from_fn(|_, _| (2.0 * rng.random::<f64>() - 1.0) * 3f64.sqrt());
        let each = (0..20_000).map(|k| {
            watch.take(&(draw() + bias), f64::from(k) / 20.0);
            watch.chi_squared()
        });
        each.fold(0.0, f64::max)
    }

    #[test]
    fn a_bias_stands_out_of_the_noise() {
        assert_eq!(InnovationBias::default().chi_squared(), 0.0);
        assert!(largest(Vector3::zeros()) < 20.0);
        assert!(largest(Vector3::new(0.0, 0.5, 0.0)) > 60.0);
    }

    /// Positions at a standstill all count, and old ones fade with the depth.
    #[test]
    fn innovations_fade_with_the_depth() {
        let mut bias = InnovationBias::default();
        (0..50).for_each(|_| bias.take(&Vector3::x(), 100.0));
        assert!((bias.chi_squared() - 50.0).abs() < 1e-9);
        bias.take(&Vector3::zeros(), 200.0);
        assert!(bias.chi_squared() < 1e-5);
    }
}
