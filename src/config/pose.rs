//! Poses and angles as they are written: mm and degrees.

use nalgebra::{Rotation3, Vector3};
use serde::Serialize;

use super::rule::Range;
use super::section::Section;
use crate::geometry::{FixedAngles, Pose};

pub(super) const POSITION: Range = Range::within(-10_000.0, 10_000.0);
pub(super) const TURN: Range = Range::within(-360.0, 360.0);
/// Of the fixed-axis angles only pitch is bounded, short of where yaw and roll become one.
pub(super) const PITCH: Range = Range::within(-85.0, 85.0);
const PITCH_OF_FRAME: Range = Range::within(-90.0, 90.0);

/// A pose: position, then fixed-axis angles, `R = Rx(yaw) Ry(pitch) Rz(roll)`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PoseConfig {
    /// Position, mm.
    pub x_mm: f64,
    /// Position, mm.
    pub y_mm: f64,
    /// Position, mm.
    pub z_mm: f64,
    /// α, degrees.
    pub yaw_deg: f64,
    /// β, degrees.
    pub pitch_deg: f64,
    /// γ, degrees.
    pub roll_deg: f64,
}

impl PoseConfig {
    /// The pose of a frame, at any angle.
    pub(super) fn read_frame(s: &mut Section<'_>) -> Self {
        Self::read(s, PITCH_OF_FRAME)
    }

    /// The pose of a needle's tip.
    pub(super) fn read_tip(s: &mut Section<'_>) -> Self {
        Self::read(s, PITCH)
    }

    fn read(s: &mut Section<'_>, pitch: Range) -> Self {
        PoseConfig {
            x_mm: s.number("x_mm", POSITION),
            y_mm: s.number("y_mm", POSITION),
            z_mm: s.number("z_mm", POSITION),
            yaw_deg: s.number("yaw_deg", TURN),
            pitch_deg: s.number("pitch_deg", pitch),
            roll_deg: s.number("roll_deg", TURN),
        }
    }

    /// As `pose` is written.
    pub fn of(pose: &Pose) -> Self {
        let AnglesConfig { yaw_deg, pitch_deg, roll_deg } = AnglesConfig::of(&pose.rotation);
        let [x_mm, y_mm, z_mm] = pose.translation.into();
        PoseConfig { x_mm, y_mm, z_mm, yaw_deg, pitch_deg, roll_deg }
    }

    /// The pose in mm and rad.
    pub fn to_pose(&self) -> Pose {
        let angles = AnglesConfig {
            yaw_deg: self.yaw_deg,
            pitch_deg: self.pitch_deg,
            roll_deg: self.roll_deg,
        };
        Pose {
            rotation: angles.to_fixed_angles().to_rotation(),
            translation: Vector3::new(self.x_mm, self.y_mm, self.z_mm),
        }
    }
}

/// Fixed-axis angles.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct AnglesConfig {
    /// α, degrees.
    pub yaw_deg: f64,
    /// β, degrees.
    pub pitch_deg: f64,
    /// γ, degrees.
    pub roll_deg: f64,
}

impl AnglesConfig {
    /// The angles of a needle's tip in the plane frame.
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        Self::read_within(s, Range::within(-80.0, 80.0))
    }

    /// The angles of a frame, whatever they are.
    pub(super) fn read_frame(s: &mut Section<'_>) -> Self {
        Self::read_within(s, PITCH_OF_FRAME)
    }

    fn read_within(s: &mut Section<'_>, pitch: Range) -> Self {
        AnglesConfig {
            yaw_deg: s.number("yaw_deg", TURN),
            pitch_deg: s.number("pitch_deg", pitch),
            roll_deg: s.number("roll_deg", TURN),
        }
    }

    /// As `rotation` is written.
    pub fn of(rotation: &Rotation3<f64>) -> Self {
        let FixedAngles { yaw, pitch, roll } = FixedAngles::from_rotation(rotation);
        AnglesConfig {
            yaw_deg: yaw.to_degrees(),
            pitch_deg: pitch.to_degrees(),
            roll_deg: roll.to_degrees(),
        }
    }

    /// The angles in rad.
    pub fn to_fixed_angles(&self) -> FixedAngles {
        FixedAngles {
            yaw: self.yaw_deg.to_radians(),
            pitch: self.pitch_deg.to_radians(),
            roll: self.roll_deg.to_radians(),
        }
    }
}
