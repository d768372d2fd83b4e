//! What `[stage.insertion]` and `[stage.rotation]` have in common.

use serde::{Serialize, Serializer};

use super::error::ConfigError;
use super::section::Section;
use crate::canopen::{NodeId, ObjectAddress};
use crate::stage;
use crate::stage::{AxisConfig, AxisLimits, CountsRatio, SdoValue, Sign, Zero};

/// The following-error window of CiA 402, counts.
const FOLLOWING_ERROR_WINDOW: ObjectAddress = ObjectAddress::new(0x6065, 0);

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
    /// The drive goes on the short way past the end of its 32-bit position.
    pub wraps: bool,
    /// How the drive stops on a quick stop (605A).
    pub quick_stop_option: i16,
    /// What the drive does by itself when the bench falls silent (6007).
    pub abort_connection_option: i16,
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
            wraps: s.boolean("wraps"),
            quick_stop_option: s.integer("quick_stop_option", i16::MIN, i16::MAX),
            abort_connection_option: s.integer("abort_connection_option", i16::MIN, i16::MAX),
            optional_objects: s.integers("optional_objects", 0x1000, u16::MAX),
            sdo: s.tables("sdo", "index, subindex, value, bits", RawSdo::read),
        }
    }

    /// The axis of this drive; `following_error_max` in mm or rad, `following_error_window` the
    /// same in counts.
    pub(super) fn to_axis(
        &self,
        ratio: CountsRatio,
        limits: AxisLimits,
        following_error_max: Option<f64>,
        following_error_window: Option<f64>,
    ) -> Result<AxisConfig, ConfigError> {
        let window = following_error_window.map(window).transpose()?;
        let written =
            self.sdo.iter().copied().map(RawSdo::to_stage).collect::<Result<Vec<_>, _>>()?;
        Ok(AxisConfig {
            node: self.node,
            vendor: self.vendor_id,
            product: self.product_code,
            ratio,
            sign: if self.sign < 0 { Sign::Negative } else { Sign::Positive },
            zero: Zero::Here,
            wraps: self.wraps,
            limits,
            following_error_max,
            quick_stop_option: Some(self.quick_stop_option),
            abort_connection_option: Some(self.abort_connection_option),
            optional_objects: self.optional_objects.iter().copied().flat_map(entries).collect(),
            raw_sdos: window.into_iter().chain(written).collect(),
        })
    }
}

/// The following-error window of `counts`.
fn window(counts: f64) -> Result<stage::RawSdo, ConfigError> {
    let rounded = counts.round();
    if !(1.0..=f64::from(u32::MAX)).contains(&rounded) {
        let object = FOLLOWING_ERROR_WINDOW;
        let message =
            format!("following error of {counts:.1} counts: {object} holds 1 to 2^32 - 1");
        return Err(ConfigError::of(message));
    }
    let value = SdoValue::from(rounded as u32);
    Ok(stage::RawSdo { object: FOLLOWING_ERROR_WINDOW, value, read_back: true })
}

/// All entries of the object `index`.
fn entries(index: u16) -> impl Iterator<Item = ObjectAddress> {
    (0..=u8::MAX).map(move |subindex| ObjectAddress::new(index, subindex))
}

/// One object of a drive to write as it stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct RawSdo {
    /// Index.
    pub index: u16,
    /// Subindex.
    pub subindex: u8,
    /// Signed or unsigned: it fits `bits` as either.
    pub value: i64,
    /// 8, 16 or 32.
    pub bits: u8,
    /// Read back and compared. False for objects that do not read as written.
    pub read_back: bool,
}

impl RawSdo {
    fn read(s: &mut Section<'_>) -> Self {
        let bits = s.integer_of("bits", &[8, 16, 32], 32u8);
        let (low, high) = (-(1i64 << (bits - 1)), (1i64 << bits) - 1);
        RawSdo {
            index: s.integer("index", 0x1000, u16::MAX),
            subindex: s.integer("subindex", 0, u8::MAX),
            value: s.integer("value", low, high),
            bits,
            read_back: s.optional_boolean("read_back").unwrap_or(true),
        }
    }

    fn to_stage(self) -> Result<stage::RawSdo, ConfigError> {
        let object = ObjectAddress::new(self.index, self.subindex);
        let value = SdoValue::sized(self.value, self.bits / 8).ok_or_else(|| {
            ConfigError::of(format!("sdo {object}: {} does not fit {} bits", self.value, self.bits))
        })?;
        Ok(stage::RawSdo { object, value, read_back: self.read_back })
    }
}

pub(super) fn node_number<S: Serializer>(node: &NodeId, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_u8(node.get())
}

fn identity<S: Serializer>(identity: &Option<u32>, serializer: S) -> Result<S::Ok, S::Error> {
    match identity {
        Some(number) => serializer.serialize_u32(*number),
        None => serializer.serialize_str("any"),
    }
}
