//! The true tip pose, which only an emulated run has.

use crate::geometry::Pose;
use nalgebra::Vector3;

/// The true tip pose `X_PB`, plane frame, and the true target if the tracker sees one.
///
/// Only telemetry and studies read it. Observers and controllers cannot name it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Truth {
    /// The true pose `X_PB`.
    pub x_pb: Pose,
    /// The true target, plane frame, mm; `None` if the tracker does not see the target.
    pub target_mm: Option<Vector3<f64>>,
}
