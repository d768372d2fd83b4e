//! The configuration of the stage and its drives.

use std::time::Duration;

use super::limits::{ACCELERATION, SPEED};
use super::scale::CountsPer;
use super::standstill::Standstill;
use super::{Axis, AxisLimits, CountsRatio, HomingConfig, PerAxis, Reference, Scale, Sign};
use crate::canopen::cia402::object::QUICK_STOP_DECELERATION;
use crate::canopen::sdo::SdoValue;
use crate::canopen::{NodeId, ObjectAddress};
use crate::keys::{NO_KEY, Rule, hardware_is_decided, over, section, within};

/// Lag of a servo: without a configured following-error window, the window is the travel in this time at the
/// highest speed.
const FOLLOWING_LAG: Duration = Duration::from_millis(30);

const IDENTITY: Rule = Rule::Or("any", "a 32-bit whole number");
const OBJECT: Rule = within(0x1000 as f64, 0xFFFF as f64);
pub(super) const SPEED_MAX: [&str; 2] =
    ["stage.insertion.speed_max_mm_per_s", "stage.rotation.speed_max_deg_per_s"];
const QUICK_STOP: [&str; 2] = [
    "stage.insertion.quick_stop_deceleration_mm_per_s2",
    "stage.rotation.quick_stop_deceleration_deg_per_s2",
];

section! {
    /// An axis: its drive, scale and limits. Lengths are in mm, angles in rad.
    pub struct AxisConfig of AXIS {
        /// The drive's CANopen node ID.
        node: NodeId => ["1", "2"][AXIS], hardware_must_give;
        /// The expected vendor ID (1018:1), or "any".
        vendor_id: Option<u32> [IDENTITY] = 0x0000_02F1, hardware_must_give;
        /// The expected product code (1018:2), or "any".
        product_code: Option<u32> [IDENTITY] = 0x0000_0402, hardware_must_give;
        /// The expected serial number (1018:4), or "any". It alone distinguishes two drives of the same type.
        serial: Option<u32> [IDENTITY] = "any", hardware_may_omit;
        /// 1, or -1 if the drive counts in the opposite direction to the axis.
        sign: Sign [Rule::Integers(&[1, -1])] = 1, hardware_must_give;
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
        ratio as (["counts_per_mm", "counts_per_turn"][AXIS]): CountsRatio
            => ["{ counts = 4646, mm = 1 }", "{ counts = 378_830, turns = 5 }"][AXIS],
            table(CountsPer::keys_of::<AXIS>()), whole, hardware_must_give;
        /// The soft limits, mm or rad and seconds.
        limits: AxisLimits, table(AxisLimits::keys_of::<AXIS>()), flat;
        /// The drive's following-error window (6065). The bench checks it too, and adds the travel of
        /// two SYNC periods at the highest speed. If omitted: the travel of 30 ms at the highest speed.
        following_error_max as (["following_error_mm", "following_error_deg"][AXIS]): Option<f64>
            [[over(0.0, 100.0), over(0.0, 3600.0)][AXIS]], hardware_may_omit;
        /// Quick-stop deceleration (6085). With hardware it may be omitted: the drive keeps its own, and the bench
        /// does not know it. Beside a raw SDO to 6085, in the drive's unit, it is not written: it then only tells
        /// the bench how the axis brakes.
        quick_stop_deceleration
            as (["quick_stop_deceleration_mm_per_s2", "quick_stop_deceleration_deg_per_s2"][AXIS]):
            Option<f64> [ACCELERATION[AXIS]] => ["21.5239", "475.147"][AXIS], hardware_must_give;
        /// Speed of `needle-bench stage jog`.
        jog_speed as (["jog_speed_mm_per_s", "jog_speed_deg_per_s"][AXIS]): f64 [SPEED[AXIS]]
            => ["2.0", "30.0"][AXIS], at_most(SPEED_MAX[AXIS]), hardware_may_omit;
        /// Acceleration of `needle-bench stage jog`, and of `withdraw`.
        jog_acceleration as (["jog_acceleration_mm_per_s2", "jog_acceleration_deg_per_s2"][AXIS]):
            f64 [ACCELERATION[AXIS]] => ["10.0", "90.0"][AXIS], at_most(QUICK_STOP[AXIS]),
            hardware_may_omit;
        /// Speed of `needle-bench stage withdraw`.
        withdraw_speed as (["withdraw_speed_mm_per_s", NO_KEY][AXIS]): Option<f64> [SPEED[AXIS]]
            = 2.0, at_most(SPEED_MAX[AXIS]), hardware_may_omit;
        /// How `needle-bench stage home` homes the axis (CiA 402 mode 6). Without this key the axis
        /// cannot be homed.
        homing: Option<HomingConfig> => [
            "{ method = 33, timeout_s = 60.0, homed_bit = 12 }",
            "{ method = 37, timeout_s = 10.0, homed_bit = 12 }",
        ][AXIS], table(HomingConfig::keys_of::<AXIS>()), hardware_must_give;
    }
}

const _: () = assert!(
    hardware_is_decided(AxisConfig::keys_of::<{ Axis::Insertion as usize }>())
        && hardware_is_decided(AxisConfig::keys_of::<{ Axis::Rotation as usize }>()),
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
        /// another value than was written.
        read_back: bool = true, everywhere;
    }
}

impl RawSdo {
    /// True if it sets the quick-stop deceleration.
    pub fn is_quick_stop(&self) -> bool {
        ObjectAddress::new(self.index, self.subindex) == QUICK_STOP_DECELERATION
    }

    /// The object, and the value to write to it.
    ///
    /// # Errors
    /// The value does not fit the bits.
    pub(super) fn to_write(self) -> Result<(ObjectAddress, SdoValue), String> {
        let object = ObjectAddress::new(self.index, self.subindex);
        let value = SdoValue::sized(self.value, self.bits / 8).ok_or_else(|| {
            format!("sdo {object}: {} does not fit {} bits", self.value, self.bits)
        })?;
        Ok((object, value))
    }
}

impl AxisConfig {
    /// The drive's following-error window: how far its position may be from its demand, mm or rad.
    pub fn following_error_window(&self) -> f64 {
        let lag = self.limits.speed_max * FOLLOWING_LAG.as_secs_f64();
        self.following_error_max.unwrap_or(lag)
    }

    /// How far the measured position may be from the target at a SYNC, mm or rad: more stops the
    /// run.
    ///
    /// This is the drive's own window and the travel of the target in two SYNC periods: the axis reaches the
    /// target of one SYNC at the next at the earliest, and a drive that interpolates takes one more.
    pub fn following_error_limit(&self, sync_period: Duration) -> f64 {
        let travel = self.limits.speed_max * 2.0 * sync_period.as_secs_f64();
        self.following_error_window() + travel
    }

    /// The scale of `axis`. Its zero is the configured one, or `here_counts` if none is configured.
    pub fn scale(&self, axis: Axis, here_counts: i64) -> Scale {
        let zero_counts = self.zero.map_or(here_counts, i64::from);
        Scale::new(axis, self.ratio, self.sign, zero_counts)
    }
}

section! {
    /// CANopen settings of the bench: SYNC, heartbeats, timeouts and attempts.
    #[derive(Copy)]
    pub struct BusConfig {
        /// Period of SYNC, ms.
        sync_ms: u16 [within(1.0, 100.0)] = 10;
        /// The bench's own node number: the drives watch its heartbeat.
        bench_node: NodeId = 127;
        /// Period of the bench's and the drives' heartbeats, ms.
        heartbeat_ms: u16 [within(5.0, 10_000.0)] = 25;
        /// A heartbeat that is missing for this long stops the run, and the drives, ms.
        heartbeat_timeout_ms: u16 [within(10.0, 60_000.0)] = 100;
        /// Longest wait for the answer to one SDO request, ms.
        sdo_timeout_ms: u16 [within(10.0, 10_000.0)] = 150;
        /// How often an SDO request is sent before giving up.
        sdo_attempts: u8 [within(1.0, 20.0)] = 3;
        /// Longest wait for a drive to boot, s.
        boot_timeout as "boot_timeout_s": Duration [within(0.1, 120.0)] = 2.0;
        /// How often the bring-up of a drive is begun, if the drive restarts in the middle of it.
        boot_attempts: u8 [within(1.0, 20.0)] = 3;
        /// SYNCs in a row without both drives' answers that are tolerated.
        missed_feedback_max: u8 [within(0.0, 100.0)] = 1;
    }
}

impl BusConfig {
    /// Period of SYNC.
    pub fn sync_period(&self) -> Duration {
        Duration::from_millis(self.sync_ms.into())
    }

    /// Silence that counts as loss, for the bench and for each drive.
    pub fn heartbeat_timeout(&self) -> Duration {
        Duration::from_millis(self.heartbeat_timeout_ms.into())
    }

    /// Longest wait for the answer to one SDO request.
    pub fn sdo_timeout(&self) -> Duration {
        Duration::from_millis(self.sdo_timeout_ms.into())
    }
}

section! {
    /// How power is switched on and off.
    #[derive(Copy)]
    pub struct PowerConfig {
        /// Reset a drive that is found in fault, once, instead of refusing to start.
        fault_reset_on_start: bool = false;
        /// Longest wait for both drives to be enabled, brakes included, s.
        enable_timeout as "enable_timeout_s": Duration [within(0.1, 60.0)] = 3.0;
        /// Of that, the longest wait for each step up to "switched on", charging included, s. A drive
        /// that takes longer is held, for example by its safety input, and the start is given up.
        state_transition_timeout as "let_on_s": Duration [within(0.05, 60.0)] = 0.5;
        /// Longest wait for both axes to stand after a stop, s.
        stop_timeout as "stop_timeout_s": Duration [within(0.1, 60.0)] = 2.0;
    }
}

section! {
    /// The whole stage.
    pub struct StageConfig {
        /// True for a real stage: it refuses buses made for tests, and its drives' node, identity, scale
        /// and limits have no defaults. False is for "memory", "udp" and interfaces named vcan... or
        /// vxcan... alone.
        hardware: bool = false;
        /// Timeouts of power on and stop.
        power: PowerConfig, flat;
        /// The axis that pushes the needle.
        insertion: AxisConfig;
        /// The axis that turns the needle about its shaft.
        rotation: AxisConfig, table(AxisConfig::keys_of::<{ Axis::Rotation as usize }>());
    }
    beside {
        /// SYNC, heartbeats, timeouts and attempts.
        pub bus: BusConfig = BusConfig::take(None),
        /// How long the stage listens for another master before it sends its first frame: the longest
        /// interval between two heartbeats of a master that is alive.
        pub listen_first: Duration = Duration::ZERO,
    }
}

impl StageConfig {
    /// The configuration of `axis`.
    pub fn axis(&self, axis: Axis) -> &AxisConfig {
        match axis {
            Axis::Insertion => &self.insertion,
            Axis::Rotation => &self.rotation,
        }
    }

    /// How long the position of `axis` must be watched to see that it stands.
    pub fn standstill_window(&self, axis: Axis) -> Duration {
        self.standstill(axis).window(self.bus.sync_period())
    }

    pub(super) fn standstill(&self, axis: Axis) -> Standstill {
        Standstill::new(self.axis(axis).scale(axis, 0).counts_per_unit())
    }

    /// The nodes of the drives.
    pub fn nodes(&self) -> PerAxis<NodeId> {
        PerAxis { insertion: self.insertion.node, rotation: self.rotation.node }
    }

    /// Checks what the ranges of the keys, and one key against another, cannot express: the order of the limits,
    /// and what must fit in counts. Node numbers, periods and homing are checked with the configuration.
    ///
    /// # Errors
    /// The first setting that the stage cannot work with.
    pub fn validate(&self) -> Result<(), String> {
        Axis::BOTH.into_iter().try_for_each(|axis| self.validate_axis(axis))
    }

    /// Checks the limits of `axis`, and what goes to its drive in counts.
    fn validate_axis(&self, axis: Axis) -> Result<(), String> {
        let config = self.axis(axis);
        let AxisLimits { min, max, .. } = config.limits;
        if min >= max {
            let [min, max] = [min, max].map(|value| axis.shown(value));
            return Err(format!("{axis}: limits {min} to {max}: the axis could not move"));
        }
        let homing = config.homing.as_ref();
        let default_window = match config.following_error_max {
            Some(_) => String::new(),
            None => format!(
                "; it is that of 30 ms at the highest speed: set following_error_{}",
                axis.unit()
            ),
        };
        let window = Some(config.following_error_window());
        let values = [
            (window, "a following error", "", default_window.as_str()),
            (config.quick_stop_deceleration, "a quick-stop deceleration", "/s²", ""),
            (homing.and_then(|homing| homing.speed_switch), "a homing speed", "/s", ""),
            (homing.and_then(|homing| homing.speed_zero), "a homing speed", "/s", ""),
            (homing.and_then(|homing| homing.acceleration), "a homing acceleration", "/s²", ""),
        ];
        let scale = config.scale(axis, 0);
        for (value, what, per, hint) in values {
            if let Some(value) = value.filter(|value| unsigned_counts(scale, *value).is_none()) {
                let (value, unit) = axis.in_unit(value);
                return Err(format!(
                    "{axis}: {what} of {value} {unit}{per}: less than half a count, or more than 32 bits \
                     hold{hint}"
                ));
            }
        }
        let offset = homing.and_then(|homing| homing.offset);
        if let Some(offset) = offset.filter(|offset| scale.relative_counts(*offset).is_none()) {
            let offset = axis.shown(offset);
            return Err(format!(
                "{axis}: a home offset of {offset}: more than 32 bits hold in counts"
            ));
        }
        if !config.wraps
            && let Some(zero) = config.zero
        {
            let ends = [min, max].map(|end| scale.counts(end).map(i32::try_from));
            if !ends.iter().all(|end| matches!(end, Some(Ok(_)))) {
                let [min, max] = [min, max].map(|value| axis.shown(value));
                return Err(format!(
                    "{axis}: limits {min} to {max} with zero at {zero}: more than the 32 bits of the drive's \
                     position; set nearer limits, another zero, or wraps"
                ));
            }
        }
        // The axis brakes first, and the answer to a SYNC counts only when the next is due.
        let braking_s =
            config.quick_stop_deceleration.map_or(0.0, |by| config.limits.speed_max / by);
        let needed = Duration::try_from_secs_f64(braking_s)
            .unwrap_or(Duration::MAX)
            .saturating_add(self.standstill_window(axis) + 2 * self.bus.sync_period());
        if needed >= self.power.stop_timeout {
            return Err(format!(
                "{axis}: more than {:.0} ms are needed to brake from the highest speed and to see it stand, \
                 and stop_timeout_s is {:.3}: set a longer one",
                needed.as_secs_f64() * 1e3,
                self.power.stop_timeout.as_secs_f64()
            ));
        }
        Ok(())
    }
}

/// `value`, in mm or rad (per second, per second squared), in counts for an unsigned 32-bit object; `None` if
/// they round to 0 or do not fit.
pub(super) fn unsigned_counts(scale: Scale, value: f64) -> Option<u32> {
    let counts = (value * scale.counts_per_unit()).round();
    (1.0..=f64::from(u32::MAX)).contains(&counts).then_some(counts as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config() -> StageConfig {
        let node = |id| NodeId::new(id).expect("in range");
        let ratio = CountsRatio::new(1000, 1).expect("not zero");
        let limits = AxisLimits { min: 0.0, max: 150.0, speed_max: 5.0, acceleration_max: None };
        StageConfig::new(
            AxisConfig::new(node(1), ratio, limits),
            AxisConfig::new(node(2), ratio, limits),
        )
    }

    #[test]
    fn an_invalid_stage_configuration_is_refused_with_the_reason() {
        assert_eq!(config().validate(), Ok(()));
        let text = |change: fn(&mut StageConfig)| {
            let mut config = config();
            change(&mut config);
            config.validate().expect_err("refused").to_string()
        };
        assert!(
            text(|c| c.rotation.following_error_max = Some(0.0))
                .starts_with("rotation: a following error of 0 deg: ")
        );
        // The travel in 30 ms at the highest speed is less than half a count.
        assert!(text(|c| c.insertion.limits.speed_max = 0.01).ends_with(
            "a following error of 0.0003 mm: less than half a count, or more than 32 bits hold; \
                     it is that of 30 ms at the highest speed: set following_error_mm"
        ));
        assert!(
            text(|c| c.insertion.quick_stop_deceleration = Some(1e9))
                .starts_with("insertion: a quick-stop deceleration of 1000000000 mm/s²: ")
        );
        assert!(
            text(|c| c.insertion.zero = Some(i32::MAX))
                .contains("with zero at 2147483647: more than the 32 bits")
        );
        assert_eq!(
            text(|c| c.insertion.ratio = CountsRatio::new(20, 1).expect("not zero")),
            "insertion: more than 2520 ms are needed to brake from the highest speed and to see it stand, and \
             stop_timeout_s is 2.000: set a longer one"
        );
        // From 5 mm/s at 2 mm/s².
        assert!(
            text(|c| c.insertion.quick_stop_deceleration = Some(2.0))
                .starts_with("insertion: more than 2570 ms are needed to brake")
        );
    }
}
