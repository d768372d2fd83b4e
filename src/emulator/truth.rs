//! What only an emulated run knows.

use crate::geometry::Pose;

/// The true tip pose `X_PB`, plane frame.
///
/// It is made by the emulator and opened by telemetry and studies only; observers and controllers
/// cannot name it.
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
