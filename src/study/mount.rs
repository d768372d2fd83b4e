//! How the tracker's sensor sits on the needle of a recording.

use nalgebra::{Matrix3, Rotation3, Vector3};
use thiserror::Error;

/// How the tip frame B sits in the sensor frame S.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mount {
    /// `R_SB`.
    pub r_sb: Rotation3<f64>,
}

/// Why a mount was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum MountError {
    /// The shaft's axis has no length.
    #[error("the shaft's axis in the sensor frame is zero")]
    NoAxis,
    /// The bend axis has no length across the shaft's axis.
    #[error("the bend axis in the sensor frame is zero or along the shaft's")]
    NoBend,
}

impl Mount {
    /// The mount from two vectors of any length in the sensor frame: the shaft's axis, about which
    /// the tip rolls (the z axis of B), and the axis about which the path bends while the base does
    /// not turn (the x axis of B, made orthogonal to the shaft's axis).
    ///
    /// # Errors
    /// [`MountError`] if the two vectors do not span a plane.
    pub fn new(axis: Vector3<f64>, bend_axis: Vector3<f64>) -> Result<Self, MountError> {
        let z = axis.try_normalize(1e-9).ok_or(MountError::NoAxis)?;
        let x =
            (bend_axis - z * bend_axis.dot(&z)).try_normalize(1e-9).ok_or(MountError::NoBend)?;
        let columns = Matrix3::from_columns(&[x, z.cross(&x), z]);
        Ok(Mount { r_sb: Rotation3::from_matrix_unchecked(columns) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mount_needs_two_directions() {
        assert_eq!(Mount::new(Vector3::zeros(), Vector3::x()), Err(MountError::NoAxis));
        assert_eq!(Mount::new(Vector3::z(), Vector3::z() * 2.0), Err(MountError::NoBend));
    }
}
