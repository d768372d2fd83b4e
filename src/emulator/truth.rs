//! The true tip pose, which only an emulated run has.

use crate::geometry::Pose;
use nalgebra::Vector3;

/// The true tip pose `X_PB`, plane frame, and the true target if the tracker sees one.
///
/// Only telemetry and studies read it. Observers and controllers cannot name it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Truth {
    x_pb: Pose,
    target_mm: Option<Vector3<f64>>,
}

impl Truth {
    /// The true tip pose, without a target.
    pub(crate) fn new(x_pb: Pose) -> Self {
        Truth { x_pb, target_mm: None }
    }

    /// The same with this target, plane frame, mm.
    pub(crate) fn with_target(self, target_mm: Option<Vector3<f64>>) -> Self {
        Truth { target_mm, ..self }
    }

    /// The true pose `X_PB`.
    pub fn x_pb(&self) -> &Pose {
        &self.x_pb
    }

    /// The true target, plane frame, mm; `None` if the tracker does not see the target.
    pub fn target_mm(&self) -> Option<&Vector3<f64>> {
        self.target_mm.as_ref()
    }
}
