//! `[stage.insertion]` and `[stage.rotation]`: the same keys, each in the axis's own unit.

use std::time::Duration;

use super::error::ConfigError;
use crate::canopen::sdo::SdoValue;
use crate::canopen::{NodeId, ObjectAddress};
use crate::keys::{NO_KEY, Rule, hardware_is_decided, over, section, within};
use crate::stage::{
    self, AxisConfig, AxisLimits, CountsRatio, HomingConfig, Reference, Sign, Zero,
};

/// Values of the parameter `AXIS`: the index of the axis in the two-element arrays below.
pub(super) const INSERTION: usize = 0;
pub(super) const ROTATION: usize = 1;

const IDENTITY: Rule = Rule::Or("any", "a 32-bit whole number");
const OBJECT: Rule = within(0x1000 as f64, 0xFFFF as f64);
const COUNTS: Rule = within(1.0, u32::MAX as f64);
const SPEED: [Rule; 2] = [over(0.0, 100.0), over(0.0, 36_000.0)];
const SPEED_MAX: [&str; 2] =
    ["stage.insertion.speed_max_mm_per_s", "stage.rotation.speed_max_deg_per_s"];
const ACCELERATION: [Rule; 2] = [over(0.0, 1e4), over(0.0, 1e6)];

section! {
    /// An axis: its drive, scale and limits. Lengths are in mm, angles in rad.
    pub struct AxisSection<const AXIS: usize> {
        /// The drive's CANopen node ID.
        node: NodeId => ["1", "2"][AXIS], hardware_must_give;
        /// The expected vendor ID (1018:1), or "any".
        vendor_id: Option<u32> [IDENTITY] = 0x0000_02F1, hardware_must_give;
        /// The expected product code (1018:2), or "any".
        product_code: Option<u32> [IDENTITY] = 0x0000_0402, hardware_must_give;
        /// 1, or -1 if the drive counts in the opposite direction to the axis.
        sign: i8 [Rule::Integers(&[1, -1])] = 1, hardware_must_give;
        /// Where the position of the drive comes from.
        reference: Reference = "absolute", hardware_must_give;
        /// The drive's position, in counts, at which the axis reads 0. "start" takes the position at
        /// which each run or operation starts; the limits then count from there. Hardware may use
        /// "start" only if the axis wraps.
        zero: Option<i32> [Rule::Or("start", "a position in counts")] => ["0", "\"start\""][AXIS],
            hardware_must_give;
        /// True if the drive's 32-bit position wraps around and the axis keeps moving.
        wraps: bool = false, hardware_may_omit;
        /// Following-error timeout (6066): how long the drive may be outside its window before it
        /// faults, ms; at most two SYNC periods. If omitted, the drive keeps its own.
        following_error_timeout_ms: Option<u16>, hardware_may_omit;
        /// Quick stop option code (605A): 6 brakes on the quick-stop ramp and stays in Quick Stop Active.
        quick_stop_option: i16 = 6, hardware_may_omit;
        /// Fault reaction option code (605E): 2 brakes on the quick-stop ramp. Skipped if the drive
        /// lacks the object.
        fault_reaction_option: i16 = 2, hardware_may_omit;
        /// Abort connection option code (6007), for a lost bench heartbeat: 3 is a quick stop.
        abort_connection_option: i16 = 3, hardware_may_omit;
        /// NMT state that the node enters when the bench's heartbeat is lost (1029:1): 0 is
        /// Pre-operational.
        communication_error_behaviour: u8 = 0, hardware_may_omit;
        /// Objects that the drive may lack, such as `[0x60C2]`. An object without which the axis cannot be
        /// moved, watched or stopped is refused.
        optional_objects: Vec<u16> [OBJECT] = [], hardware_may_omit;
        /// Objects to write unchanged and in this order, before those that the bench writes. An object
        /// that moves the axis, or that the bench writes itself, is refused.
        sdo: Vec<RawSdo> [Rule::Fields("index, subindex, value, bits")] = [], hardware_may_omit;
        /// Scale, as an exact ratio.
        counts as (["counts_per_mm", "counts_per_turn"][AXIS]): Scale<AXIS>
            => ["{ counts = 4646, mm = 1 }", "{ counts = 378_830, turns = 5 }"][AXIS],
            whole, hardware_must_give;
        /// Lower soft limit, measured from zero. The drive enforces it too (607D:1), a little wider.
        min as (["min_mm", "min_deg"][AXIS]): f64
            [[within(-1000.0, 0.0), within(-360_000.0, 0.0)][AXIS]] => ["-1.0", "-7200.0"][AXIS],
            hardware_must_give;
        /// Upper soft limit, measured from zero. The drive enforces it too (607D:2), a little wider.
        max as (["max_mm", "max_deg"][AXIS]): f64
            [[over(0.0, 1000.0), within(0.0, 360_000.0)][AXIS]] => ["310.0", "7200.0"][AXIS],
            hardware_must_give;
        /// Highest speed of any set-point.
        speed_max as (["speed_max_mm_per_s", "speed_max_deg_per_s"][AXIS]): f64 [SPEED[AXIS]]
            => ["10.0", "360.0"][AXIS], hardware_must_give;
        /// Highest acceleration of any set-point; if omitted, acceleration is not checked.
        acceleration_max as (["acceleration_max_mm_per_s2", "acceleration_max_deg_per_s2"][AXIS]):
            Option<f64> [ACCELERATION[AXIS]], hardware_may_omit;
        /// The drive's following-error window (6065). The bench checks it too, and adds the travel of
        /// two SYNC periods at the highest speed. If omitted: the travel of 30 ms at the highest speed.
        following_error as (["following_error_mm", "following_error_deg"][AXIS]): Option<f64>
            [[over(0.0, 100.0), over(0.0, 3600.0)][AXIS]], hardware_may_omit;
        /// Quick-stop deceleration (6085). With hardware it may be omitted: the drive keeps its own.
        quick_stop_deceleration
            as (["quick_stop_deceleration_mm_per_s2", "quick_stop_deceleration_deg_per_s2"][AXIS]):
            Option<f64> [ACCELERATION[AXIS]] => ["21.5239", "475.147"][AXIS], hardware_must_give;
        /// Speed of `needle-bench stage jog`.
        jog_speed as (["jog_speed_mm_per_s", "jog_speed_deg_per_s"][AXIS]): f64 [SPEED[AXIS]]
            => ["2.0", "30.0"][AXIS], at_most(SPEED_MAX[AXIS]), hardware_may_omit;
        /// Acceleration of `needle-bench stage jog`, and of `withdraw`.
        jog_acceleration as (["jog_acceleration_mm_per_s2", "jog_acceleration_deg_per_s2"][AXIS]):
            f64 [ACCELERATION[AXIS]] => ["10.0", "90.0"][AXIS], hardware_may_omit;
        /// Speed of `needle-bench stage withdraw`.
        withdraw_speed as (["withdraw_speed_mm_per_s", NO_KEY][AXIS]): Option<f64> [SPEED[AXIS]]
            = 2.0, at_most(SPEED_MAX[AXIS]), hardware_may_omit;
        /// How `needle-bench stage home` homes the axis (CiA 402 mode 6). Without this key the axis
        /// cannot be homed.
        homing: Option<Homing<AXIS>> => [
            "{ method = 33, timeout_s = 60.0, homed_bit = 12 }",
            "{ method = 37, timeout_s = 10.0, homed_bit = 12 }",
        ][AXIS], hardware_must_give;
    }
}

const _: () = assert!(
    hardware_is_decided(AxisSection::<INSERTION>::KEYS)
        && hardware_is_decided(AxisSection::<ROTATION>::KEYS),
    "declare for each key whether hardware must give it, may omit it, or takes the default"
);

section! {
    /// One object to write to a drive, unchanged.
    #[derive(Copy)]
    pub struct RawSdo {
        /// Size of the object in bits.
        bits: u8 [Rule::Integers(&[8, 16, 32])];
        /// Index.
        index: u16 [OBJECT];
        /// Subindex.
        subindex: u8;
        /// Value, signed or unsigned; it must fit `bits`.
        value: i64 [within(i32::MIN as f64, u32::MAX as f64)];
        /// Whether the bench reads the object back and compares. Use false for objects that read back
        /// another value than was written, such as 1010.
        read_back: bool = true, everywhere;
    }
}

section! {
    /// A scale as a ratio of integers: `counts` per `per` units.
    #[derive(Copy)]
    pub struct Scale<const AXIS: usize> {
        /// Number of counts.
        counts: u32 [COUNTS];
        /// Number of units that these counts make.
        per as (["mm", "turns"][AXIS]): u32 [COUNTS];
    }
}

section! {
    /// How an axis is homed. For an omitted key the drive keeps its own value.
    #[derive(Copy)]
    pub struct Homing<const AXIS: usize> {
        /// Homing method (6098): 33 is the next index pulse in the negative direction, 37 the current
        /// position.
        method: i8;
        /// Speed towards the switch (6099:1).
        speed_switch as (["speed_switch_mm_per_s", "speed_switch_deg_per_s"][AXIS]): Option<f64>
            [SPEED[AXIS]];
        /// Speed towards zero (6099:2).
        speed_zero as (["speed_zero_mm_per_s", "speed_zero_deg_per_s"][AXIS]): Option<f64>
            [SPEED[AXIS]];
        /// Acceleration (609A).
        acceleration as (["acceleration_mm_per_s2", "acceleration_deg_per_s2"][AXIS]): Option<f64>
            [over(0.0, 1e6)];
        /// Home offset (607C): from the home position to the drive's zero. Home must be inside the
        /// limits.
        offset as (["offset_mm", "offset_deg"][AXIS]): Option<f64>
            [[within(-1000.0, 1000.0), within(-360_000.0, 360_000.0)][AXIS]];
        /// Timeout of a homing. Bits left set by an earlier homing are ignored until they clear, or
        /// until the axis stands one second after the start.
        timeout as "timeout_s": Duration [within(2.0, 3600.0)];
        /// The statusword bit that says that the axis is homed: 12 by the standard (valid only in homing
        /// mode), 15 on some drives.
        homed_bit: u8 [within(8.0, 15.0)];
    }
}

impl<const AXIS: usize> AxisSection<AXIS> {
    /// Counts per mm or turn.
    pub(super) fn ratio(&self) -> Result<CountsRatio, ConfigError> {
        let Scale { counts, per } = self.counts;
        CountsRatio::new(counts, per).ok_or_else(|| {
            ConfigError::of("scale: counts and its number of units must be at least 1")
        })
    }

    /// The configuration of this axis for the stage.
    pub(super) fn to_axis(&self) -> Result<AxisConfig, ConfigError> {
        let timeout_ms = self.following_error_timeout_ms;
        let entries =
            |&index: &u16| (0..=u8::MAX).map(move |subindex| ObjectAddress::new(index, subindex));
        let limits = AxisLimits {
            min: self.min,
            max: self.max,
            speed_max: self.speed_max,
            acceleration_max: self.acceleration_max,
        };
        Ok(AxisConfig {
            node: self.node,
            ratio: self.ratio()?,
            limits,
            vendor: self.vendor_id,
            product: self.product_code,
            sign: if self.sign < 0 { Sign::Negative } else { Sign::Positive },
            zero: self.zero.map_or(Zero::Here, Zero::Counts),
            reference: self.reference,
            homing: self.homing.map(Homing::to_stage),
            wraps: self.wraps,
            following_error_max: self.following_error,
            following_error_timeout: timeout_ms.map(|ms| Duration::from_millis(ms.into())),
            quick_stop_deceleration: self.quick_stop_deceleration,
            quick_stop_option: self.quick_stop_option,
            fault_reaction_option: self.fault_reaction_option,
            abort_connection_option: self.abort_connection_option,
            communication_error_behaviour: self.communication_error_behaviour,
            optional_objects: self.optional_objects.iter().flat_map(entries).collect(),
            raw_sdos: self.sdo.iter().copied().map(RawSdo::to_stage).collect::<Result<_, _>>()?,
        })
    }
}

impl<const AXIS: usize> Homing<AXIS> {
    fn to_stage(self) -> HomingConfig {
        let Homing { method, speed_switch, speed_zero, acceleration, offset, timeout, homed_bit } =
            self;
        HomingConfig { method, speed_switch, speed_zero, acceleration, offset, timeout, homed_bit }
    }
}

impl RawSdo {
    fn to_stage(self) -> Result<stage::RawSdo, ConfigError> {
        let object = ObjectAddress::new(self.index, self.subindex);
        let value = SdoValue::sized(self.value, self.bits / 8).ok_or_else(|| {
            ConfigError::of(format!("sdo {object}: {} does not fit {} bits", self.value, self.bits))
        })?;
        Ok(stage::RawSdo { object, value, read_back: self.read_back })
    }
}
