//! The true tip pose, which only an emulated run has.

use crate::geometry::Pose;

/// The true tip pose `X_PB`, plane frame.
///
/// The emulator makes it, and only telemetry and studies read it. Observers and controllers cannot name
/// it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Truth(Pose);

impl Truth {
    /// The truth `x_pb`.
    pub(crate) fn new(x_pb: Pose) -> Self {
        Truth(x_pb)
    }

    /// The true pose `X_PB`.
    pub fn x_pb(&self) -> &Pose {
        &self.0
    }
}
