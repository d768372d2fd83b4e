//! Calibrates the needle from insertions recorded with orientations: shaft axis, torsion, bend.

mod bend;
mod insertion;
mod scatter;
mod torsion;

pub use bend::{BendFit, PathNoise};
pub use insertion::PosedRow;
pub use torsion::TorsionFit;

use crate::needle::{NeedleError, TorsionError};
use insertion::Insertion;
use nalgebra::Vector3;
use thiserror::Error;

/// Smallest number of insertions from which their spread can be estimated.
const INSERTIONS_MIN: usize = 3;

/// A needle with standard errors, which come from the spread of the insertions.
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

/// Why the insertions do not determine a needle.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum NeedleFitError {
    /// There are too few to estimate standard errors.
    #[error(
        "needle: {insertions} insertions, at least {INSERTIONS_MIN} needed: how they differ says \
         how sure the result is"
    )]
    TooFew {
        /// Number of insertions.
        insertions: usize,
    },
    /// Two insertions are the same recording, which hides the spread.
    #[error(
        "needle: insertions {first} and {second} are the same recording: the standard errors are from \
         how insertions differ, give each once"
    )]
    Same {
        /// Number, from 1.
        first: usize,
        /// Number, from 1.
        second: usize,
    },
    /// An insertion is too short.
    #[error(
        "needle: insertion {insertion} is {depth_mm:.1} mm deep, at least {least_mm:.0} needed; \
         leave it out"
    )]
    TooShort {
        /// Number, from 1.
        insertion: usize,
        /// Its depth, mm.
        depth_mm: f64,
        /// The required depth, mm.
        least_mm: f64,
    },
    /// A row has a number far beyond any needle.
    #[error("needle: insertion {insertion}, line {line}: {source}")]
    Row {
        /// Number, from 1.
        insertion: usize,
        /// Line in its file, from 1.
        line: usize,
        /// What is wrong with it.
        source: NeedleError,
    },
    /// The base did not turn enough.
    #[error(
        "needle: the tip turns back and forth by {rms_rad_per_mm:.3} rad/mm RMS, at least \
         {least_rad_per_mm} needed to tell its axis; turn the base both ways while inserting"
    )]
    NotTurned {
        /// RMS of the tip's rotation rate about its mean, rad/mm.
        rms_rad_per_mm: f64,
        /// The required RMS, rad/mm.
        least_rad_per_mm: f64,
    },
    /// The rotations do not separate the parameters of the torsion.
    #[error(
        "needle: the insertions do not determine its torsion; turn the base both ways, by more \
         than the tip lags, at several depths"
    )]
    Torsion,
    /// The fitted torsion is not valid.
    #[error("needle: {0}")]
    Unphysical(#[from] TorsionError),
    /// The positions show no clear bend.
    #[error(
        "needle: the positions show no clear bend of the path; let the tip keep its roll over \
         some mm now and then, or insert deeper"
    )]
    Bend,
}

impl NeedleFit {
    /// Fits the needle of `insertions`, each with its rows in recorded order; `noise` describes the
    /// disturbances of the paths.
    ///
    /// # Errors
    /// [`NeedleFitError`] if the insertions do not determine the needle.
    pub fn of(insertions: &[Vec<PosedRow>], noise: &PathNoise) -> Result<Self, NeedleFitError> {
        if insertions.len() < INSERTIONS_MIN {
            return Err(NeedleFitError::TooFew { insertions: insertions.len() });
        }
        for (second, rows) in insertions.iter().enumerate() {
            let is_same = |other: &Vec<PosedRow>| insertion::is_same(other, rows);
            if let Some(first) = insertions[..second].iter().position(is_same) {
                return Err(NeedleFitError::Same { first: first + 1, second: second + 1 });
            }
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
