//! `[stage.insertion.homing]` and `[stage.rotation.homing]`.

use std::time::Duration;

use serde::Serialize;

use super::rule::Range;
use super::section::Section;
use crate::stage;

/// Declares the section of an axis: the same keys, each in the axis's own unit.
macro_rules! homing_section {
    (
        $name:ident, $unit:literal, $to_stage:expr, $speed_max:literal, $offset_max:literal,
        $speed_switch:ident, $speed_zero:ident, $acceleration:ident, $offset:ident
    ) => {
        #[doc = concat!("How the axis is homed (CiA 402 mode 6), in ", $unit, ". What is left out stays as the drive has it.")]
        #[derive(Debug, Clone, PartialEq, Serialize)]
        pub struct $name {
            /// 6098: how home is found.
            pub method: i8,
            /// 6099:1: towards the switch, per second.
            #[serde(skip_serializing_if = "Option::is_none")]
            pub $speed_switch: Option<f64>,
            /// 6099:2: towards zero, per second.
            #[serde(skip_serializing_if = "Option::is_none")]
            pub $speed_zero: Option<f64>,
            /// 609A, per second squared.
            #[serde(skip_serializing_if = "Option::is_none")]
            pub $acceleration: Option<f64>,
            /// 607C: from the home position to the drive's zero.
            #[serde(skip_serializing_if = "Option::is_none")]
            pub $offset: Option<f64>,
            /// Longest way home, s.
            pub timeout_s: f64,
            /// The bit of the statusword that says that the axis was homed.
            pub homed_bit: u8,
        }

        impl $name {
            pub(super) fn read(s: &mut Section<'_>) -> Self {
                let speed = Range::over(0.0, $speed_max);
                $name {
                    method: s.integer("method", i8::MIN, i8::MAX),
                    $speed_switch: s.optional_number(stringify!($speed_switch), speed),
                    $speed_zero: s.optional_number(stringify!($speed_zero), speed),
                    $acceleration: s.optional_number(stringify!($acceleration), Range::over(0.0, 1e6)),
                    $offset: s.optional_number(
                        stringify!($offset),
                        Range::within(-$offset_max, $offset_max),
                    ),
                    // The bits of an earlier homing are distinguished from new ones after one second.
                    timeout_s: s.number("timeout_s", Range::within(2.0, 3600.0)),
                    homed_bit: s.integer("homed_bit", 8, 15),
                }
            }

            /// What the stage is told, in mm or rad.
            pub(super) fn to_stage(&self) -> stage::HomingConfig {
                let convert: fn(f64) -> f64 = $to_stage;
                stage::HomingConfig {
                    method: self.method,
                    speed_switch: self.$speed_switch.map(convert),
                    speed_zero: self.$speed_zero.map(convert),
                    acceleration: self.$acceleration.map(convert),
                    offset: self.$offset.map(convert),
                    timeout: Duration::try_from_secs_f64(self.timeout_s).unwrap_or_default(),
                    homed_bit: self.homed_bit,
                }
            }
        }
    };
}

homing_section!(
    InsertionHomingConfig,
    "mm",
    |mm| mm,
    100.0,
    1000.0,
    speed_switch_mm_per_s,
    speed_zero_mm_per_s,
    acceleration_mm_per_s2,
    offset_mm
);
homing_section!(
    RotationHomingConfig,
    "degrees",
    f64::to_radians,
    36_000.0,
    360_000.0,
    speed_switch_deg_per_s,
    speed_zero_deg_per_s,
    acceleration_deg_per_s2,
    offset_deg
);
