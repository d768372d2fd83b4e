//! Rigid motions: SO(3), SE(3) and the paper's fixed-axis angles.
//!
//! Poses are named by monograms: `X_WB` is the pose of frame B in frame W, and `X_WP * X_PB = X_WB`.
//! Frames: W bench, P plane, S sensor or stage, T tracker, B needle tip. Lengths are in mm, angles in rad.

mod angles;
mod se3;
pub mod so3;

pub use angles::{FixedAngles, coordinates};
pub(crate) use angles::{POSITION, TURN};
pub use se3::{Pose, Twist};
