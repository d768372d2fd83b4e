//! Why a calibration was refused.

use nalgebra::Vector3;
use thiserror::Error;

/// The farthest from its frame's origin that a position may be, mm.
const DISTANCE_MAX_MM: f64 = 5000.0;

/// A recording that does not determine the result: what is wrong, with its numbers and limits, and
/// what to do.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("{0}")]
pub struct CalibrationError(pub(super) String);

/// Refuses a position that is not finite, or that no bench reaches. `what` names the calibration and
/// a position in it.
pub(super) fn check_distances(
    what: &str,
    frame: &str,
    positions_mm: impl Iterator<Item = Vector3<f64>>,
) -> Result<(), CalibrationError> {
    let mut distances_mm = positions_mm.map(|position| position.norm()).zip(1..);
    match distances_mm.find(|(mm, _)| mm.is_nan() || *mm > DISTANCE_MAX_MM) {
        None => Ok(()),
        Some((mm, number)) => Err(CalibrationError(format!(
            "{what} {number} is {mm} mm from the {frame}'s origin (limit {DISTANCE_MAX_MM:.0}); give \
             positions in mm"
        ))),
    }
}
