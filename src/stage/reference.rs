//! How an axis knows where it is.

use std::time::Duration;

use crate::keys::choice;

/// Where the position of a drive (0x6064) comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Reference {
    /// It is right from power-on: an absolute encoder, or an axis of which it does not matter.
    #[default]
    Absolute,
    /// From homing: without it the axis is not enabled, but to be homed.
    Homing,
}

choice! {
    for Reference {
        /// The drive's position is right from power-on.
        Absolute = "absolute",
        /// From homing: before `needle-bench stage home` nothing is moved.
        Homing = "homing",
    }
}

/// Homing by the drive (CiA 402-2, mode 6). What is `None` is left as the drive has it: some take
/// speeds in units of their own.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HomingConfig {
    /// 0x6098: how home is found.
    pub method: i8,
    /// 0x6099:01, but mm/s or rad/s: towards the switch.
    pub speed_switch: Option<f64>,
    /// 0x6099:02, but mm/s or rad/s: towards zero.
    pub speed_zero: Option<f64>,
    /// 0x609A, but mm/s² or rad/s².
    pub acceleration: Option<f64>,
    /// 0x607C, but mm or rad: from the home position to zero, as the drive counts it.
    pub offset: Option<f64>,
    /// Longest way home.
    pub timeout: Duration,
    /// The bit of the statusword that says that the axis was homed. 12 is the standard's and means
    /// that in homing mode only; some drives have one of their own, such as 15, in every mode.
    pub homed_bit: u8,
}

impl HomingConfig {
    /// Bit 12 in homing mode: homing attained.
    pub const ATTAINED_BIT: u8 = 12;
}
