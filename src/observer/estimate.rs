//! What an observer says.

use crate::geometry::{FixedAngles, Pose};

/// An estimated tip pose, with its standard deviations where the observer knows them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// `X_PB`: tip B in plane frame P.
    pub x_pb: Pose,
    /// Standard deviations of (x, y, z) in mm and (yaw, pitch, roll) in rad; `None` for observers
    /// that carry no covariance.
    pub sd: Option<[f64; 6]>,
}

impl Estimate {
    /// An estimate without standard deviations.
    pub fn of_pose(x_pb: Pose) -> Self {
        Estimate { x_pb, sd: None }
    }

    /// Yaw, pitch and roll of the estimated tip, rad.
    pub fn angles(&self) -> FixedAngles {
        FixedAngles::from_rotation(&self.x_pb.rotation)
    }
}
