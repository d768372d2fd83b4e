//! Calibrates the needle from insertions recorded with orientations: shaft axis, torsion, bend.

mod bend;
mod insertion;
mod scatter;
mod torsion;

pub use bend::{BendFit, PathNoise};
pub use insertion::PosedRow;
pub use torsion::TorsionFit;

use super::CalibrationError;
use insertion::Insertion;
use nalgebra::Vector3;
use std::fmt::Display;

/// Fewer insertions than this do not show how insertions differ.
const INSERTIONS_MIN: usize = 3;

/// A needle with its standard errors, which come from how the insertions differ.
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

fn refused(reason: impl Display) -> CalibrationError {
    CalibrationError(format!("needle: {reason}"))
}

impl NeedleFit {
    /// The needle of `insertions`, each with its rows in the order recorded. `noise` disturbs the
    /// paths.
    ///
    /// # Errors
    /// The insertions do not determine the needle.
    pub fn of(insertions: &[Vec<PosedRow>], noise: &PathNoise) -> Result<Self, CalibrationError> {
        if insertions.len() < INSERTIONS_MIN {
            return Err(refused(format!(
                "{} insertions, at least {INSERTIONS_MIN} needed: how they differ says how sure the \
                 result is",
                insertions.len()
            )));
        }
        let axis = insertion::shaft_axis(insertions)?;
        let r_sa = insertion::shaft_frame(&axis);
        let tracks = insertions
            .iter()
            .enumerate()
            .map(|(index, rows)| Insertion::of(index + 1, rows, &r_sa))
            .collect::<Result<Vec<_>, _>>()?;
        Ok(NeedleFit {
            insertions: insertions.len(),
            axis,
            bend: BendFit::of(&tracks, &r_sa, noise)?,
            torsion: TorsionFit::of(&tracks)?,
        })
    }
}

#[cfg(test)]
mod tests;
