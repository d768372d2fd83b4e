//! What an observer says.

use crate::geometry::{FixedAngles, Pose};
use crate::math;
use nalgebra::{Matrix3, Matrix6};

/// A roll of a larger standard deviation than this, rad, is not known: half of what it bends is
/// then bent the wrong way too often.
const ROLL_KNOWN_SD_RAD: f64 = 30.0 / 180.0 * std::f64::consts::PI;

/// An estimated tip pose, with what else the observer knows of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// `X_PB`: tip B in plane frame P.
    pub x_pb: Pose,
    /// Standard deviations of (x, y, z) in mm and (yaw, pitch, roll) in rad; `None` for observers
    /// that carry no covariance.
    pub sd: Option<[f64; 6]>,
    /// What an observer with a model of its own uncertainty says besides.
    pub belief: Option<Belief>,
}

/// The uncertainty of an estimate, and the parameters estimated with the pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Belief {
    /// Covariance of the left-invariant error ε, `X_true = X_est Exp(ε)`, a twist (v; w) in the tip
    /// frame; mm and rad.
    pub covariance: Matrix6<f64>,
    /// Length of the mean bevel direction over all hypotheses: 0 where nothing is known of the
    /// roll, 1 where all agree.
    pub roll_agreement: f64,
    /// Estimated curvature κ, per mm.
    pub curvature_per_mm: f64,
    /// The last innovation squared over its covariance: χ² of three degrees of freedom where the
    /// observer is right about itself. `None` before there was one.
    pub innovation_square: Option<f64>,
    /// The shaft.
    pub shaft: Shaft,
}

/// What a turn of the base does to the tip, as estimated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shaft {
    /// Base rotation in the positive direction that does not turn the tip yet.
    pub slack_forward: Slack,
    /// Base rotation in the negative direction that does not turn the tip yet.
    pub slack_backward: Slack,
    /// Turn of the tip that is still to come when the base stands, rad.
    pub backlog_rad: f64,
    /// Insertion over which that falls to 1/e, mm; 0 where the tip follows at once.
    pub creep_mm: f64,
}

/// Base rotation that does not turn the tip yet, rad.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Slack {
    /// Estimated; a little under 0 where the tip is being pushed.
    pub mean_rad: f64,
    /// Its standard deviation.
    pub sd_rad: f64,
}

impl Shaft {
    /// A shaft that does not twist.
    pub const RIGID: Shaft = Shaft {
        slack_forward: Slack { mean_rad: 0.0, sd_rad: 0.0 },
        slack_backward: Slack { mean_rad: 0.0, sd_rad: 0.0 },
        backlog_rad: 0.0,
        creep_mm: 0.0,
    };
}

impl Estimate {
    /// An estimate without standard deviations.
    pub fn of_pose(x_pb: Pose) -> Self {
        Estimate { x_pb, sd: None, belief: None }
    }

    /// An estimate with its uncertainty.
    pub fn of_belief(x_pb: Pose, belief: Belief) -> Self {
        let sd = Some(standard_deviations(&x_pb, &belief.covariance));
        Estimate { x_pb, sd, belief: Some(belief) }
    }

    /// Covariance of the estimated position, plane frame, mm², to first order in the error ε:
    /// `R P_vv Rᵀ`; `None` for observers that carry none.
    pub fn position_covariance_mm2(&self) -> Option<Matrix3<f64>> {
        let belief = self.belief.as_ref()?;
        Some(position_covariance(&self.x_pb, &belief.covariance))
    }

    /// True where the roll is good enough to steer by: its standard deviation, where the observer
    /// gives one, is within 30°.
    pub fn is_roll_known(&self) -> bool {
        self.sd.is_none_or(|sd| sd[5] <= ROLL_KNOWN_SD_RAD)
    }
}

fn position_covariance(x_pb: &Pose, covariance: &Matrix6<f64>) -> Matrix3<f64> {
    let r = x_pb.rotation.matrix();
    r * covariance.fixed_view::<3, 3>(0, 0) * r.transpose()
}

/// Standard deviations of (x, y, z) in the plane frame, mm, and of (yaw, pitch, roll), rad, of a tip
/// at `x_pb` whose error ε has this covariance, to first order.
pub fn standard_deviations(x_pb: &Pose, covariance: &Matrix6<f64>) -> [f64; 6] {
    let position = position_covariance(x_pb, covariance);
    let FixedAngles { pitch, roll, .. } = FixedAngles::from_rotation(&x_pb.rotation);
    let (sin_b, cos_b) = math::sin_cos(pitch);
    let (sin_g, cos_g) = math::sin_cos(roll);
    // The body's angular velocity w by the rates of yaw, pitch and roll is
    // (cos β cos γ, −cos β sin γ, sin β) α′ + (sin γ, cos γ, 0) β′ + (0, 0, 1) γ′; inverted. Yaw
    // and roll are told apart down to this cos β.
    let cos_b = cos_b.max(1e-3);
    let rates = Matrix3::new(
        cos_g / cos_b,
        -sin_g / cos_b,
        0.0,
        sin_g,
        cos_g,
        0.0,
        -cos_g * sin_b / cos_b,
        sin_g * sin_b / cos_b,
        1.0,
    );
    let angles = rates * covariance.fixed_view::<3, 3>(3, 3) * rates.transpose();
    let sd = |variance: f64| variance.max(0.0).sqrt();
    [
        sd(position[(0, 0)]),
        sd(position[(1, 1)]),
        sd(position[(2, 2)]),
        sd(angles[(0, 0)]),
        sd(angles[(1, 1)]),
        sd(angles[(2, 2)]),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Twist;
    use nalgebra::{Vector3, Vector6};
    use proptest::prelude::*;

    proptest! {
        /// A covariance of one direction has the coordinates' changes along it for deviations.
        #[test]
        fn deviations_are_those_of_the_coordinates(
            p in prop::array::uniform3(-50.0..50.0f64), yaw in -3.0..3.0f64, pitch in -1.3..1.3f64,
            roll in -3.0..3.0f64, e in prop::array::uniform6(-1.0..1.0f64),
        ) {
            let rotation = FixedAngles { yaw, pitch, roll }.to_rotation();
            let x_pb = Pose { rotation, translation: Vector3::from(p) };
            let e = Vector6::from(e);
            let sd = standard_deviations(&x_pb, &(e * e.transpose()));
            let h = 1e-6;
            let moved = x_pb * Pose::exp(&Twist::from_vector(&(e * h)));
            let to = FixedAngles::from_rotation(&moved.rotation);
            let by = moved.translation - x_pb.translation;
            let turned = [to.yaw - yaw, to.pitch - pitch, to.roll - roll];
            for (sd, by) in sd.iter().zip(by.iter().chain(&turned)) {
                prop_assert!((sd - by.abs() / h).abs() < 1e-3 * (1.0 + sd), "{} {}", sd, by / h);
            }
        }
    }
}
