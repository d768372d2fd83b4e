//! Calibrations of the rig: from recordings to numbers in the configuration.
//!
//! Each calibration is a least-squares fit. It refuses a recording that does not determine the
//! result. The error says what is wrong with the recording, with numbers and limits, and what to do.
//! Everything here is pure; `needle-bench calibrate` reads the files.

pub mod needle;
mod record;
pub mod registration;
pub mod tip;
pub mod tracker;

pub use needle::{BendFit, NeedleFit, PathNoise, PosedRow, TorsionFit};
pub use record::{NeedleRecord, Provenance, RegistrationRecord, TipRecord};
pub use registration::{FiducialPair, RegistrationFit};
pub use tip::{SensorMount, TipFit, TurnSample};
pub use tracker::{AxisNoise, DatedBy, Measured, NoiseFit, RestSample, TrackerFit};

use nalgebra::{Matrix3, SymmetricEigen, Vector3};

/// The farthest from its frame's origin that a position may be, mm.
const DISTANCE_MAX_MM: f64 = 5000.0;

/// Refuses a position that is not finite, or farther away than any bench reaches. `what` names the
/// calibration and a position in it.
fn check_distances(what: &str, frame: &str, positions_mm: &[Vector3<f64>]) -> Result<(), String> {
    let mut distances_mm = positions_mm.iter().map(|position| position.norm()).zip(1..);
    match distances_mm.find(|(mm, _)| mm.is_nan() || *mm > DISTANCE_MAX_MM) {
        None => Ok(()),
        Some((mm, number)) => Err(format!(
            "{what} {number} is {mm:?} mm from the {frame}'s origin (limit {DISTANCE_MAX_MM:.0}); give \
             positions in mm"
        )),
    }
}

fn mean(points: &[Vector3<f64>]) -> Vector3<f64> {
    points.iter().sum::<Vector3<f64>>() / points.len() as f64
}

/// The cross-covariance of paired points, both with zero mean.
fn cross_covariance(a: &[Vector3<f64>], b: &[Vector3<f64>]) -> Matrix3<f64> {
    a.iter().zip(b).map(|(a, b)| a * b.transpose()).sum::<Matrix3<f64>>() / a.len() as f64
}

/// The principal axes of points with zero mean: RMS extents along them, largest first, and the axes as
/// columns in that order.
fn principal_axes(points: &[Vector3<f64>]) -> ([f64; 3], Matrix3<f64>) {
    let SymmetricEigen { eigenvalues, eigenvectors } =
        cross_covariance(points, points).symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigenvalues[b].total_cmp(&eigenvalues[a]));
    let extents = order.map(|k| eigenvalues[k].max(0.0).sqrt());
    (extents, Matrix3::from_columns(&order.map(|k| eigenvectors.column(k))))
}
