//! Calibrates the needle from insertions recorded with orientations: shaft axis, torsion, bend.

mod bend;
mod insertion;
mod torsion;

pub use bend::{BendFit, PathNoise};
pub use insertion::PosedRow;
pub use torsion::TorsionFit;

use insertion::RecordedInsertion;
use nalgebra::{SMatrix, SVector, Vector3};
use std::fmt::Display;

/// Fewest insertions: the standard errors come from their scatter.
const INSERTIONS_MIN: usize = 3;

/// Largest element of the inverse of the scaled Hessian; above it the data do not separate the parameters.
const CONDITION_MAX: f64 = 1e8;

/// A needle with its standard errors, which come from the scatter of the insertions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NeedleFit {
    /// Number of insertions.
    pub insertions: usize,
    /// The shaft's axis in the sensor frame, of length 1.
    pub axis: Vector3<f64>,
    /// Curvature, tip, bend axis.
    pub bend: BendFit,
    /// Torsion.
    pub torsion: TorsionFit,
}

fn needle_error(reason: impl Display) -> String {
    format!("needle: {reason}")
}

impl NeedleFit {
    /// The needle of `insertions`, each with its rows in the order recorded. `noise` is the noise of the positions
    /// and the paths; `name` returns the name of an insertion, by its index, for errors.
    ///
    /// # Errors
    /// The insertions do not determine the needle.
    pub fn of(
        insertions: &[Vec<PosedRow>],
        name: impl Fn(usize) -> String,
        noise: &PathNoise,
    ) -> Result<Self, String> {
        if insertions.len() < INSERTIONS_MIN {
            return Err(needle_error(format!(
                "{} insertions, at least {INSERTIONS_MIN} needed: their scatter gives the \
                 standard errors",
                insertions.len()
            )));
        }
        let axis = insertion::shaft_axis(insertions)?;
        let r_sa = insertion::shaft_frame(&axis);
        let tracks = insertions.iter().enumerate();
        let tracks = tracks.map(|(index, rows)| RecordedInsertion::of(&name(index), rows, &r_sa));
        let tracks = tracks.collect::<Result<Vec<_>, _>>()?;
        Ok(NeedleFit {
            insertions: insertions.len(),
            axis,
            bend: BendFit::of(&tracks, &r_sa, noise)?,
            torsion: TorsionFit::of(&tracks)?,
        })
    }
}

/// What one insertion adds to a least-squares fit, linearised at its result: `JᵀJ` and `Jᵀr`.
#[derive(Clone, Copy)]
struct Part<const N: usize> {
    hessian: SMatrix<f64, N, N>,
    gradient: SVector<f64, N>,
}

/// Covariance of the parameters of a least-squares fit with residuals that are correlated within each insertion
/// and independent between insertions. The jackknife: without insertion i the parameters would change by
/// `dᵢ = (H − Hᵢ)⁻¹ gᵢ`, and the covariance is `(n − 1)/n Σᵢ dᵢ dᵢᵀ`.
///
/// `None` if all insertions together do not determine the parameters. If the insertions without i do not determine
/// them, `dᵢ` is a step of the whole fit, `H⁻¹ gᵢ`, which is too small.
fn jackknife_covariance<const N: usize>(parts: &[Part<N>]) -> Option<SMatrix<f64, N, N>> {
    let hessian: SMatrix<f64, N, N> = parts.iter().map(|part| part.hessian).sum();
    // Scaled to a unit diagonal first, so that the test for singularity does not depend on units.
    let scale = SVector::<f64, N>::from_fn(|i, _| hessian[(i, i)].sqrt());
    if !scale.iter().all(|s| s.is_finite() && *s > 0.0) {
        return None;
    }
    let inverse = |matrix: &SMatrix<f64, N, N>| {
        let scaled = SMatrix::<f64, N, N>::from_fn(|i, j| matrix[(i, j)] / (scale[i] * scale[j]));
        scaled.try_inverse().filter(|inverse| inverse.amax() <= CONDITION_MAX)
    };
    let of_all = inverse(&hessian)?;
    let n = parts.len() as f64;
    let mut covariance = SMatrix::<f64, N, N>::zeros();
    for part in parts {
        let without = inverse(&(hessian - part.hessian)).unwrap_or(of_all);
        let change = (without * part.gradient.component_div(&scale)).component_div(&scale);
        covariance += change * change.transpose() * ((n - 1.0) / n);
    }
    Some(covariance)
}

#[cfg(test)]
mod tests;
