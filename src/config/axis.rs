//! `[stage.insertion]` and `[stage.rotation]`: the same keys, each in the axis's own unit.

use std::time::Duration;

use super::drive::DriveConfig;
use super::error::ConfigError;
use crate::keys::{Rule, hardware_is_decided, over, section, within};
use crate::stage::{AxisConfig, AxisLimits, CountsRatio, HomingConfig};

const COUNTS: Rule = within(1.0, u32::MAX as f64);

/// Declares the section of an axis. First come the names of its types and of its keys, then what
/// differs from axis to axis: ranges, defaults, and the way from the axis's unit to the stage's.
macro_rules! axis {
    (
        $axis:ident, $scale:ident, $homing:ident, $to_stage:expr;
        node $node:literal, zero $zero:literal;
        $counts_per_unit:ident { $unit:ident } => $ratio:literal;
        $min:ident [$min_range:expr] = $min_default:expr;
        $max:ident [$max_range:expr] = $max_default:expr;
        $speed_max:ident [$speed_range:expr] = $speed_default:expr;
        $acceleration_max:ident [$acceleration_range:expr];
        $following_error:ident [$following_range:expr];
        $quick_stop_deceleration:ident = $quick_stop_default:expr;
        $jog_speed:ident = $jog_speed_default:expr, at_most($speed_key:literal);
        $jog_acceleration:ident = $jog_acceleration_default:expr;
        $(withdraw $withdraw_speed:ident = $withdraw_speed_default:expr;)?
        homing => $homing_default:literal;
        $switch_speed:ident, $zero_speed:ident, $homing_acceleration:ident;
        $offset:ident [$offset_range:expr];
    ) => {
        section! {
            /// An axis of the stage.
            pub struct $axis {
                /// What both drives have.
                drive: DriveConfig, flat, defaults(&[("node", $node), ("zero", $zero)]);
                /// Scale, as an exact ratio.
                $counts_per_unit: $scale => $ratio, whole, hardware_must_give;
                /// Soft limit, from zero. The drive keeps it too (607D), a little wider.
                $min: f64 [$min_range] = $min_default, hardware_must_give;
                /// Soft limit, from zero. The drive keeps it too (607D), a little wider.
                $max: f64 [$max_range] = $max_default, hardware_must_give;
                /// Highest speed of any set-point.
                $speed_max: f64 [$speed_range] = $speed_default, hardware_must_give;
                /// Highest acceleration of any set-point; left out, none is checked.
                $acceleration_max: Option<f64> [$acceleration_range], hardware_may_omit;
                /// The drive's following-error window (6065). The bench keeps it too, and allows for 2
                /// SYNC more. Left out, it is what 30 ms do at the highest speed.
                $following_error: Option<f64> [$following_range], hardware_may_omit;
                /// How hard the drive brakes on a quick stop (6085). With hardware it may be left out: it
                /// stays as the drive has it.
                $quick_stop_deceleration: Option<f64> [$acceleration_range] = $quick_stop_default,
                    hardware_must_give;
                /// Speed of `needle-bench stage jog`.
                $jog_speed: f64 [$speed_range] = $jog_speed_default, at_most($speed_key),
                    hardware_may_omit;
                /// Acceleration of `needle-bench stage jog`, and of `withdraw`.
                $jog_acceleration: f64 [$acceleration_range] = $jog_acceleration_default,
                    hardware_may_omit;
                $(/// Speed of `needle-bench stage withdraw`.
                $withdraw_speed: f64 [$speed_range] = $withdraw_speed_default, at_most($speed_key),
                    hardware_may_omit;)?
                /// `needle-bench stage home` (CiA 402 mode 6); without it the axis cannot be homed. With
                /// hardware there is none unless it is given.
                homing: Option<$homing> => $homing_default, hardware_must_give;
            }
        }

        const _: () = assert!(hardware_is_decided($axis::KEYS), "must hardware give each key?");

        section! {
            /// A scale as a ratio of integers: so many counts for so many units.
            #[derive(Copy)]
            pub struct $scale {
                /// So many counts …
                counts: u32 [COUNTS];
                /// … for so many of the unit.
                $unit: u32 [COUNTS];
            }
        }

        section! {
            /// How an axis is homed. What is left out stays as the drive has it.
            pub struct $homing {
                /// How home is found (6098): 33 is back to the encoder's next index pulse, 37 is here.
                method: i8;
                /// Speed towards the switch (6099:1).
                $switch_speed: Option<f64> [$speed_range];
                /// Speed towards zero (6099:2).
                $zero_speed: Option<f64> [$speed_range];
                /// Acceleration (609A).
                $homing_acceleration: Option<f64> [over(0.0, 1e6)];
                /// From home to the drive's zero (607C); home must be inside the limits.
                $offset: Option<f64> [$offset_range];
                /// Longest way home, s. The bits of an earlier homing are distinguished from new ones
                /// after one second.
                timeout_s: f64 [within(2.0, 3600.0)];
                /// The bit of the statusword that says that the axis was homed: 12 is the standard's, in
                /// homing mode; 15 that of some drives.
                homed_bit: u8 [within(8.0, 15.0)];
            }
        }

        impl $axis {
            /// What the stage is told, in mm or rad.
            pub(super) fn to_axis(&self) -> Result<AxisConfig, ConfigError> {
                let convert: fn(f64) -> f64 = $to_stage;
                let $scale { counts, $unit } = self.$counts_per_unit;
                let zero = || ConfigError::of(concat!(stringify!($counts_per_unit), " has a zero"));
                let limits = AxisLimits {
                    min: convert(self.$min),
                    max: convert(self.$max),
                    speed_max: convert(self.$speed_max),
                    acceleration_max: self.$acceleration_max.map(convert),
                };
                let homing = |homing: &$homing| HomingConfig {
                    method: homing.method,
                    speed_switch: homing.$switch_speed.map(convert),
                    speed_zero: homing.$zero_speed.map(convert),
                    acceleration: homing.$homing_acceleration.map(convert),
                    offset: homing.$offset.map(convert),
                    timeout: Duration::try_from_secs_f64(homing.timeout_s).unwrap_or_default(),
                    homed_bit: homing.homed_bit,
                };
                let ratio = CountsRatio::new(counts, $unit).ok_or_else(zero)?;
                Ok(AxisConfig {
                    following_error_max: self.$following_error.map(convert),
                    quick_stop_deceleration: self.$quick_stop_deceleration.map(convert),
                    homing: self.homing.as_ref().map(homing),
                    ..self.drive.to_axis(ratio, limits)?
                })
            }
        }
    };
}

axis! {
    InsertionAxisConfig, CountsPerMm, InsertionHomingConfig, |mm| mm;
    node "1", zero "0";
    counts_per_mm { mm } => "{ counts = 4646, mm = 1 }";
    min_mm [within(-1000.0, 0.0)] = -1.0;
    max_mm [over(0.0, 1000.0)] = 310.0;
    speed_max_mm_per_s [over(0.0, 100.0)] = 10.0;
    acceleration_max_mm_per_s2 [over(0.0, 1e4)];
    following_error_mm [over(0.0, 100.0)];
    quick_stop_deceleration_mm_per_s2 = 21.5239;
    jog_speed_mm_per_s = 2.0, at_most("stage.insertion.speed_max_mm_per_s");
    jog_acceleration_mm_per_s2 = 10.0;
    withdraw withdraw_speed_mm_per_s = 2.0;
    homing => "{ method = 33, timeout_s = 60.0, homed_bit = 12 }";
    speed_switch_mm_per_s, speed_zero_mm_per_s, acceleration_mm_per_s2;
    offset_mm [within(-1000.0, 1000.0)];
}

axis! {
    RotationAxisConfig, CountsPerTurn, RotationHomingConfig, f64::to_radians;
    node "2", zero "\"start\"";
    counts_per_turn { turns } => "{ counts = 378_830, turns = 5 }";
    min_deg [within(-360_000.0, 0.0)] = -7200.0;
    max_deg [within(0.0, 360_000.0)] = 7200.0;
    speed_max_deg_per_s [over(0.0, 36_000.0)] = 360.0;
    acceleration_max_deg_per_s2 [over(0.0, 1e6)];
    following_error_deg [over(0.0, 3600.0)];
    quick_stop_deceleration_deg_per_s2 = 475.147;
    jog_speed_deg_per_s = 30.0, at_most("stage.rotation.speed_max_deg_per_s");
    jog_acceleration_deg_per_s2 = 90.0;
    homing => "{ method = 37, timeout_s = 10.0, homed_bit = 12 }";
    speed_switch_deg_per_s, speed_zero_deg_per_s, acceleration_deg_per_s2;
    offset_deg [within(-360_000.0, 360_000.0)];
}
