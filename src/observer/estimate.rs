//! The estimate of an observer: the tip's pose and its uncertainty.

use crate::geometry::{FixedAngles, Pose};
use crate::math;
use nalgebra::{Matrix3, Matrix6};

/// A roll with a larger standard deviation than this, rad, counts as unknown: too often half of the
/// bend would point in a wrong direction.
const ROLL_KNOWN_SD_RAD: f64 = 30.0 / 180.0 * std::f64::consts::PI;

/// An estimated tip pose, with its uncertainty.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// `X_PB`: tip B in plane frame P.
    pub x_pb: Pose,
    /// Standard deviations of (x, y, z) in mm and (yaw, pitch, roll) in rad; π for an angle that is not
    /// known. `None` if the observer states none: its roll then counts as known.
    pub sd: Option<[f64; 6]>,
    /// Covariance and estimated parameters; `None` for observers that carry no covariance.
    pub belief: Option<Belief>,
}

/// The uncertainty of an estimate, and the parameters estimated with the pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Belief {
    /// Covariance of the left-invariant error ε, `X_true = X_est Exp(ε)`, a twist (v; w) in the tip
    /// frame; mm and rad.
    pub covariance: Matrix6<f64>,
    /// Length of the mean bevel direction over all hypotheses: 0 if the roll is unknown, 1 if all
    /// hypotheses agree.
    pub roll_agreement: f64,
    /// Roll out of the plane, rad, up to which the positions still correct the roll: π/2 if they do
    /// everywhere.
    pub roll_seen_rad: f64,
    /// Estimated curvature κ, per mm.
    pub curvature_per_mm: f64,
    /// The last innovation's normalised square: χ² with three degrees of freedom for a consistent
    /// observer. `None` before the first innovation.
    pub nis: Option<f64>,
    /// How the shaft passes a turn of the base on to the tip.
    pub shaft: Shaft,
}

/// The estimated transmission from a turn of the base to the tip.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shaft {
    /// Base rotation in the positive direction before the tip starts to turn.
    pub slack_forward: Slack,
    /// Base rotation in the negative direction before the tip starts to turn.
    pub slack_backward: Slack,
    /// Turn that the tip still has to make if the base stands still, rad.
    pub backlog_rad: f64,
    /// Insertion over which the backlog falls to 1/e, mm; 0 if the tip follows at once.
    pub creep_mm: f64,
}

/// Base rotation in one direction before the tip starts to turn, rad.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Slack {
    /// Mean; slightly negative while the edge of the band turns the tip.
    pub mean_rad: f64,
    /// Standard deviation.
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
    /// `R P_vv Rᵀ`; `None` for observers that carry no covariance.
    pub fn position_covariance_mm2(&self) -> Option<Matrix3<f64>> {
        let belief = self.belief.as_ref()?;
        Some(position_covariance(&self.x_pb, &belief.covariance))
    }

    /// Standard deviations in the worst direction, to first order: of the position, mm, and of the heading, rad.
    /// `None` for observers that carry no covariance, and for one that is not finite.
    pub fn worst_sd(&self) -> Option<(f64, f64)> {
        let covariance = self.belief.as_ref()?.covariance;
        let position = covariance.fixed_view::<3, 3>(0, 0).into_owned();
        // The heading is the tip's z axis: a turn about it does not count.
        let heading = covariance.fixed_view::<2, 2>(3, 3).into_owned();
        covariance.iter().all(|value| value.is_finite()).then(|| {
            let sd = |variance: f64| variance.max(0.0).sqrt();
            (sd(position.symmetric_eigenvalues().max()), sd(heading.symmetric_eigenvalues().max()))
        })
    }

    /// The share of a turn that a law may command: 1 if the hypotheses agree on the roll, down to
    /// `1 - caution` if they do not agree at all. It is 1 if the observer states no uncertainty.
    pub fn demand_gain(&self, caution: f64) -> f64 {
        self.belief.map_or(1.0, |belief| 1.0 - caution * (1.0 - belief.roll_agreement))
    }

    /// True if the roll is known well enough to steer by: its standard deviation is at most 30°, or
    /// the observer gives none.
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
    // The body's angular velocity is
    // w = (cos β cos γ, −cos β sin γ, sin β) α′ + (sin γ, cos γ, 0) β′ + (0, 0, 1) γ′.
    // `rates` inverts this. The lower limit of cos β avoids the singularity at ±90° of pitch.
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
    // NaN stays NaN: it must not pass for certainty.
    let sd = |variance: f64| if variance < 0.0 { 0.0 } else { variance.sqrt() };
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

    impl Belief {
        /// The belief of an observer without uncertainty.
        pub(crate) fn certain(curvature_per_mm: f64, shaft: Shaft) -> Self {
            Belief {
                covariance: Matrix6::zeros(),
                roll_agreement: 1.0,
                roll_seen_rad: 0.5 * std::f64::consts::PI,
                curvature_per_mm,
                nis: None,
                shaft,
            }
        }
    }

    #[test]
    fn a_covariance_that_is_not_a_number_gives_no_certainty() {
        let sd = standard_deviations(&Pose::identity(), &Matrix6::from_element(f64::NAN));
        assert!(sd.iter().all(|sd| sd.is_nan()), "{sd:?}");
    }

    #[test]
    fn a_covariance_that_is_not_finite_has_no_worst_direction() {
        for value in [f64::NAN, f64::INFINITY] {
            let covariance = Matrix6::from_diagonal_element(value);
            let belief = Belief { covariance, ..Belief::certain(0.01, Shaft::RIGID) };
            assert_eq!(Estimate::of_belief(Pose::identity(), belief).worst_sd(), None);
        }
    }

    proptest! {
        /// For the covariance e eᵀ the worst directions are those in which e moves the tip and its heading.
        #[test]
        fn the_worst_direction_is_that_of_the_error(
            yaw in -3.0..3.0f64, pitch in -1.5..1.5f64, roll in -3.0..3.0f64,
            e in prop::array::uniform6(-1.0..1.0f64),
        ) {
            let rotation = FixedAngles { yaw, pitch, roll }.to_rotation();
            let x_pb = Pose { rotation, translation: Vector3::zeros() };
            let e = Vector6::from(e);
            let covariance = e * e.transpose();
            let belief = Belief { covariance, ..Belief::certain(0.01, Shaft::RIGID) };
            let (position_mm, heading_rad) = Estimate::of_belief(x_pb, belief).worst_sd().unwrap();
            let h = 1e-6;
            let moved = x_pb * Pose::exp(&Twist::from_vector(&(e * h)));
            let turned = (moved.rotation * Vector3::z()).cross(&(rotation * Vector3::z())).norm();
            prop_assert!((position_mm - moved.translation.norm() / h).abs() < 1e-3);
            prop_assert!((heading_rad - turned / h).abs() < 1e-3);
        }

        /// For the covariance e eᵀ the deviations are the changes of the coordinates along e.
        #[test]
        fn standard_deviations_are_those_of_the_coordinates(
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
