//! The covariance of a fit over several insertions, from how the insertions differ.

use nalgebra::{SMatrix, SVector};

/// Covariance of the parameters of a least-squares fit with residuals that are correlated within
/// each insertion and independent between insertions: `H⁻¹ (Σᵢ gᵢ gᵢᵀ) H⁻¹ n / (n − 1)`, the
/// sandwich estimator (Liang and Zeger 1986).
///
/// `hessian` is `H = JᵀJ` over all n insertions, `gradients` holds `gᵢ = Jᵢᵀ rᵢ` of each insertion
/// at the fit. `None` if H has no inverse: the insertions do not determine the parameters.
pub(super) fn covariance<const N: usize>(
    hessian: &SMatrix<f64, N, N>,
    gradients: &[SVector<f64, N>],
) -> Option<SMatrix<f64, N, N>> {
    // Scaled to a unit diagonal first, so that the test for singularity does not depend on units.
    let scale = SVector::<f64, N>::from_fn(|i, _| hessian[(i, i)].sqrt());
    if !scale.iter().all(|s| s.is_finite() && *s > 0.0) {
        return None;
    }
    let scaled = SMatrix::<f64, N, N>::from_fn(|i, j| hessian[(i, j)] / (scale[i] * scale[j]));
    let inverse = scaled.try_inverse()?;
    if inverse.amax() > CONDITION_MAX {
        return None;
    }
    let n = gradients.len() as f64;
    let mut meat = SMatrix::<f64, N, N>::zeros();
    for gradient in gradients {
        let gradient = gradient.component_div(&scale);
        meat += gradient * gradient.transpose();
    }
    let covariance = inverse * meat * inverse * (n / (n - 1.0));
    Some(SMatrix::from_fn(|i, j| covariance[(i, j)] / (scale[i] * scale[j])))
}

/// Above this the data do not separate the parameters.
const CONDITION_MAX: f64 = 1e8;

#[cfg(test)]
mod tests {
    use super::*;

    /// For a mean, with one residual for each insertion, this is the standard error of the mean.
    #[test]
    fn of_a_mean_it_is_the_standard_error() {
        let values = [1.0, 2.0, 4.0, 9.0];
        let gradients = values.map(|value| SVector::<f64, 1>::new(value - 4.0));
        let squares: f64 = gradients.iter().map(|g| g.x * g.x).sum();
        let found = covariance(&SMatrix::<f64, 1, 1>::new(4.0), &gradients).unwrap();
        assert!((found.x - squares / (4.0 * 3.0)).abs() < 1e-12);
    }

    #[test]
    fn parameters_that_cannot_be_told_apart_have_none() {
        let gradients = [SVector::<f64, 2>::new(1.0, 1.0); 3];
        assert_eq!(covariance(&SMatrix::<f64, 2, 2>::new(1.0, 1.0, 1.0, 1.0), &gradients), None);
        assert_eq!(covariance(&SMatrix::<f64, 2, 2>::new(1.0, 0.0, 0.0, 0.0), &gradients), None);
    }
}
