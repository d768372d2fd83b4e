//! The orientation of the tracker's sensor on the needle of a recording.

use nalgebra::{Matrix3, Rotation3, Vector3};

/// `R_SB`, the orientation of the tip frame B in the sensor frame S, from two vectors of any length in the sensor
/// frame: the shaft's axis, about which the tip rolls (the z axis of B), and the axis about which the path
/// bends while the base does not turn (the x axis of B, made orthogonal to the shaft's axis).
///
/// # Errors
/// The two vectors do not span a plane; the text says why.
pub fn mount(axis: Vector3<f64>, bend_axis: Vector3<f64>) -> Result<Rotation3<f64>, &'static str> {
    let no_axis = "the shaft's axis in the sensor frame is zero";
    let z = axis.try_normalize(1e-9).ok_or(no_axis)?;
    let no_bend = "the bend axis in the sensor frame is zero or along the shaft's";
    let x = (bend_axis - z * bend_axis.dot(&z)).try_normalize(1e-9).ok_or(no_bend)?;
    Ok(Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, z.cross(&x), z])))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mount_needs_two_directions() {
        let refused = mount(Vector3::zeros(), Vector3::x()).unwrap_err();
        assert_eq!(refused, "the shaft's axis in the sensor frame is zero");
        let refused = mount(Vector3::z(), Vector3::z() * 2.0).unwrap_err();
        assert_eq!(refused, "the bend axis in the sensor frame is zero or along the shaft's");
    }
}
