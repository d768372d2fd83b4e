//! What `[stage.insertion]` and `[stage.rotation]` have in common.

use std::time::Duration;

use super::error::ConfigError;
use crate::canopen::sdo::SdoValue;
use crate::canopen::{NodeId, ObjectAddress};
use crate::keys::{Rule, choice, hardware_is_decided, section, within};
use crate::stage;
use crate::stage::{AxisConfig, AxisLimits, CountsRatio, Reference, Sign, Zero};

const IDENTITY: Rule = Rule::Or("any", "a whole number of 32 bits");
const OBJECT: Rule = within(0x1000 as f64, 0xFFFF as f64);

section! {
    /// The drive of an axis.
    pub struct DriveConfig {
        /// Its node number.
        node: NodeId, hardware_must_give;
        /// The vendor to expect (1018:1), or "any".
        vendor_id: Option<u32> [IDENTITY] = 0x0000_02F1, hardware_must_give;
        /// The product to expect (1018:2), or "any".
        product_code: Option<u32> [IDENTITY] = 0x0000_0402, hardware_must_give;
        /// 1, or -1 where the drive counts the other way.
        sign: i8 [Rule::Integers(&[1, -1])] = 1, hardware_must_give;
        /// Where the position of the drive comes from.
        reference: Reference = "absolute", hardware_must_give;
        /// The drive's counts where the axis reads 0. "start" is where each run or operation starts, and
        /// the limits count from there; with hardware only where the axis wraps.
        zero: Option<i32> [Rule::Or("start", "a position in counts")], hardware_must_give;
        /// True where the drive goes on past the end of its 32-bit position.
        wraps: bool = false, hardware_may_omit;
        /// How long the drive waits beyond its following-error window before it faults (6066), ms, up to
        /// 2 SYNC. Left out, it stays as the drive has it.
        following_error_timeout_ms: Option<u16>, hardware_may_omit;
        /// How the drive stops on a quick stop (605A): 6 brakes on its ramp, and stays in quick stop.
        quick_stop_option: i16 = 6, hardware_may_omit;
        /// How the drive stops on a fault of its own (605E): 2 brakes on that ramp. Skipped where a drive
        /// has none.
        fault_reaction_option: i16 = 2, hardware_may_omit;
        /// What the drive does by itself when the bench falls silent (6007): 3 is a quick stop.
        abort_connection_option: i16 = 3, hardware_may_omit;
        /// Where its node goes when the bench falls silent (1029:1): 0 is Pre-operational.
        communication_error_behaviour: u8 = 0, hardware_may_omit;
        /// Objects that the drive may lack, such as `[0x60C2]`. An object without which the axis cannot be
        /// moved, watched or stopped is refused.
        optional_objects: Vec<u16> [OBJECT] = [], hardware_may_omit;
        /// Objects to write as they stand, before the bench's own and in this order. An object that moves
        /// the axis, or that the bench writes itself, is refused.
        sdo: Vec<RawSdo> [Rule::Fields("index, subindex, value, bits")] = [], hardware_may_omit;
    }
}

const _: () = assert!(hardware_is_decided(DriveConfig::KEYS), "must hardware give each key?");

choice! {
    for Reference {
        /// The drive's position is right from power-on.
        Absolute = "absolute",
        /// From homing: before `needle-bench stage home` nothing is moved.
        Homing = "homing",
    }
}

section! {
    /// One object of a drive to write as it stands.
    #[derive(Copy)]
    pub struct RawSdo {
        /// 8, 16 or 32.
        bits: u8 [Rule::Integers(&[8, 16, 32])];
        /// Index.
        index: u16 [OBJECT];
        /// Subindex.
        subindex: u8;
        /// Signed or unsigned: it fits `bits` as either.
        value: i64 [within(i32::MIN as f64, u32::MAX as f64)];
        /// Read back and compared; false for objects that do not read as written.
        read_back: bool = true, everywhere;
    }
}

impl DriveConfig {
    /// The axis of this drive, with nothing that has a unit.
    pub(super) fn to_axis(
        &self,
        ratio: CountsRatio,
        limits: AxisLimits,
    ) -> Result<AxisConfig, ConfigError> {
        let timeout_ms = self.following_error_timeout_ms;
        let raw_sdos = self.sdo.iter().copied().map(RawSdo::to_stage);
        Ok(AxisConfig {
            vendor: self.vendor_id,
            product: self.product_code,
            sign: if self.sign < 0 { Sign::Negative } else { Sign::Positive },
            zero: self.zero.map_or(Zero::Here, Zero::Counts),
            reference: self.reference,
            wraps: self.wraps,
            following_error_timeout: timeout_ms.map(|ms| Duration::from_millis(ms.into())),
            quick_stop_option: self.quick_stop_option,
            fault_reaction_option: self.fault_reaction_option,
            abort_connection_option: self.abort_connection_option,
            communication_error_behaviour: self.communication_error_behaviour,
            optional_objects: self.optional_objects.iter().copied().flat_map(entries).collect(),
            raw_sdos: raw_sdos.collect::<Result<_, _>>()?,
            ..AxisConfig::new(self.node, ratio, limits)
        })
    }
}

/// All entries of the object `index`.
fn entries(index: u16) -> impl Iterator<Item = ObjectAddress> {
    (0..=u8::MAX).map(move |subindex| ObjectAddress::new(index, subindex))
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
