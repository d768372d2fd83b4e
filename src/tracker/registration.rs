//! From the tracker's frame to the bench's, and from the sensor to the needle's tip.

use super::refusal::{GateName, Refusal};
use super::sample::Sample;
use crate::geometry::Pose;
use nalgebra::{Rotation3, Vector3};

/// Where the tracker stands on the bench, and where the tip is on the sensor.
///
/// `p_WB = X_WT (p_TS + R_TS p_SB)` and `R_WB = R_WT R_TS R_SB`, with W the bench, T the tracker, S the sensor, B the tip.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Registration {
    x_wt: Pose,
    x_sb: Pose,
}

impl Registration {
    /// The registration with the tracker at `x_wt` on the bench, finite; the sensor is the tip.
    pub fn new(x_wt: Pose) -> Self {
        Registration { x_wt, x_sb: Pose::identity() }
    }

    /// The same registration with the tip at `x_sb` in the sensor's frame: mm, finite.
    pub fn with_tip(self, x_sb: Pose) -> Self {
        Registration { x_sb, ..self }
    }

    /// `X_WT`: the tracker's pose on the bench.
    pub fn x_wt(&self) -> &Pose {
        &self.x_wt
    }

    /// `p_WB`: the tip's position on the bench, mm. It is finite if the sample's position is, unless it
    /// overflows.
    ///
    /// # Errors
    /// [`Refusal`] if the tip is off the sensor and the sample has no orientation.
    pub fn tip_mm(&self, sample: &Sample) -> Result<Vector3<f64>, Refusal> {
        let p_sb_mm = self.x_sb.translation;
        let offset_mm = match sample.orientation {
            _ if p_sb_mm == Vector3::zeros() => Vector3::zeros(),
            Some(orientation) => orientation * p_sb_mm,
            None => {
                let offset_mm = p_sb_mm.norm();
                let why = format!(
                    "a tip offset of {offset_mm:.2} mm needs the sensor's orientation, which the tracker did not \
                     send (OpenIGTLink has it in TRANSFORM)"
                );
                return Err(Refusal::new(GateName::Registration, why));
            }
        };
        Ok(self.x_wt.transform(&(sample.position_mm + offset_mm)))
    }

    /// The tip's heading on the bench, the z axis of `R_WB`, a unit vector; `None` if the sample has no
    /// orientation. The roll does not matter: a sensor with five degrees of freedom gives it as well, if
    /// its axis is the needle's.
    pub fn heading(&self, sample: &Sample) -> Option<Vector3<f64>> {
        Some(self.rotation(sample)? * Vector3::z())
    }

    /// `R_WB`: the tip's orientation on the bench; `None` if the sample has none.
    pub fn rotation(&self, sample: &Sample) -> Option<Rotation3<f64>> {
        let r_ts = sample.orientation?.to_rotation_matrix();
        Some(self.x_wt.rotation * r_ts * self.x_sb.rotation)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::FixedAngles;
    use nalgebra::UnitQuaternion;
    use std::f64::consts::FRAC_PI_2;

    fn sample(orientation: Option<UnitQuaternion<f64>>) -> Sample {
        Sample { orientation, ..Sample::valid("Tip", Vector3::new(1.0, 2.0, 3.0)) }
    }

    #[test]
    fn the_tracker_pose_moves_a_position_into_the_bench() {
        // A quarter turn about x: y becomes z, z becomes −y.
        let angles = FixedAngles { yaw: FRAC_PI_2, pitch: 0.0, roll: 0.0 };
        let registration = Registration::new(Pose {
            rotation: angles.to_rotation(),
            translation: Vector3::new(10.0, 20.0, 30.0),
        });
        let tip = registration.tip_mm(&sample(None)).expect("no offset");
        assert!((tip - Vector3::new(11.0, 17.0, 32.0)).norm() < 1e-12);
    }

    #[test]
    fn the_tip_offset_turns_with_the_sensor() {
        let registration = Registration::new(Pose::identity())
            .with_tip(Pose { translation: Vector3::new(0.0, 0.0, 5.0), ..Pose::identity() });
        let turned = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), FRAC_PI_2);
        let tip = registration.tip_mm(&sample(Some(turned))).expect("has orientation");
        assert!((tip - Vector3::new(6.0, 2.0, 3.0)).norm() < 1e-12);
    }

    /// The sensor is mounted at a quarter turn about x: its −y axis points along the needle.
    #[test]
    fn the_heading_is_the_tips_and_not_the_sensors() {
        let tilt = Rotation3::from_axis_angle(&Vector3::x_axis(), FRAC_PI_2);
        let on_bench = Rotation3::from_axis_angle(&Vector3::z_axis(), FRAC_PI_2);
        let pose = |rotation| Pose { rotation, ..Pose::identity() };
        let registration = Registration::new(pose(on_bench)).with_tip(pose(tilt));
        let heading =
            registration.heading(&sample(Some(UnitQuaternion::identity()))).expect("oriented");
        assert!((heading - Vector3::x()).norm() < 1e-12, "{heading}");
        assert_eq!(registration.heading(&sample(None)), None);
        let tip = registration.tip_mm(&sample(None)).expect("a tilt moves nothing");
        assert!((tip - Vector3::new(-2.0, 1.0, 3.0)).norm() < 1e-12);
    }
}
