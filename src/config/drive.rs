//! What `[stage.insertion]` and `[stage.rotation]` have in common.

use std::time::Duration;

use serde::{Serialize, Serializer};

use super::choice::choice;
use super::error::ConfigError;
use super::raw_sdo::RawSdo;
use super::section::Section;
use crate::canopen::{NodeId, ObjectAddress};
use crate::stage;
use crate::stage::{AxisConfig, AxisLimits, CountsRatio, Sign, Zero};

choice! {
    /// Where the position of a drive comes from.
    Reference {
        /// It is right from power-on.
        Absolute = "absolute",
        /// From homing, without which nothing is moved but to home.
        Homing = "homing",
    }
}

/// The drive of an axis.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DriveConfig {
    /// Its node number.
    #[serde(serialize_with = "node_number")]
    pub node: NodeId,
    /// Expected in 1018:1; `None` for any.
    #[serde(serialize_with = "identity")]
    pub vendor_id: Option<u32>,
    /// Expected in 1018:2; `None` for any.
    #[serde(serialize_with = "identity")]
    pub product_code: Option<u32>,
    /// 1, or -1 where the drive counts the other way.
    pub sign: i8,
    /// Where the drive's position comes from.
    pub reference: Reference,
    /// The position of the drive, counts, at which the axis reads zero; `None` for where it starts.
    #[serde(serialize_with = "zero")]
    pub zero: Option<i32>,
    /// The drive goes on the short way past the end of its 32-bit position.
    pub wraps: bool,
    /// How long the drive waits beyond its following-error window before it faults (6066), ms; `None`
    /// leaves it as the drive has it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub following_error_timeout_ms: Option<u16>,
    /// How the drive stops on a quick stop (605A).
    pub quick_stop_option: i16,
    /// How the drive stops on a fault of its own (605E).
    pub fault_reaction_option: i16,
    /// What the drive does by itself when the bench falls silent (6007).
    pub abort_connection_option: i16,
    /// Where its node goes when the bench falls silent (1029:1).
    pub communication_error_behaviour: u8,
    /// Indexes of objects that this drive may lack: the bring-up goes on without them.
    pub optional_objects: Vec<u16>,
    /// Written before the bench's own objects, in this order.
    pub sdo: Vec<RawSdo>,
}

impl DriveConfig {
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        DriveConfig {
            node: s.node("node"),
            vendor_id: s.identity("vendor_id"),
            product_code: s.identity("product_code"),
            sign: s.integer_of("sign", &[1, -1], 1),
            reference: s.choice("reference"),
            zero: s.integer_or("zero", "start", "a position in counts", i32::MIN, i32::MAX),
            wraps: s.boolean("wraps"),
            following_error_timeout_ms: s.optional_integer(
                "following_error_timeout_ms",
                0,
                u16::MAX,
            ),
            quick_stop_option: s.integer("quick_stop_option", i16::MIN, i16::MAX),
            fault_reaction_option: s.integer("fault_reaction_option", i16::MIN, i16::MAX),
            abort_connection_option: s.integer("abort_connection_option", i16::MIN, i16::MAX),
            communication_error_behaviour: s.integer("communication_error_behaviour", 0, u8::MAX),
            optional_objects: s.integers("optional_objects", 0x1000, u16::MAX),
            sdo: s.tables("sdo", "index, subindex, value, bits", RawSdo::read),
        }
    }

    /// The axis of this drive, with nothing that has a unit.
    pub(super) fn to_axis(
        &self,
        ratio: CountsRatio,
        limits: AxisLimits,
    ) -> Result<AxisConfig, ConfigError> {
        let raw_sdos = self.sdo.iter().copied().map(RawSdo::to_stage);
        Ok(AxisConfig {
            vendor: self.vendor_id,
            product: self.product_code,
            sign: if self.sign < 0 { Sign::Negative } else { Sign::Positive },
            zero: self.zero.map_or(Zero::Here, Zero::Counts),
            reference: match self.reference {
                Reference::Absolute => stage::Reference::Absolute,
                Reference::Homing => stage::Reference::Homing,
            },
            wraps: self.wraps,
            following_error_timeout: self
                .following_error_timeout_ms
                .map(|ms| Duration::from_millis(ms.into())),
            quick_stop_option: Some(self.quick_stop_option),
            fault_reaction_option: Some(self.fault_reaction_option),
            abort_connection_option: Some(self.abort_connection_option),
            communication_error_behaviour: Some(self.communication_error_behaviour),
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

pub(super) fn node_number<S: Serializer>(node: &NodeId, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_u8(node.get())
}

fn zero<S: Serializer>(zero: &Option<i32>, serializer: S) -> Result<S::Ok, S::Error> {
    match zero {
        Some(counts) => serializer.serialize_i32(*counts),
        None => serializer.serialize_str("start"),
    }
}

fn identity<S: Serializer>(identity: &Option<u32>, serializer: S) -> Result<S::Ok, S::Error> {
    match identity {
        Some(number) => serializer.serialize_u32(*number),
        None => serializer.serialize_str("any"),
    }
}
