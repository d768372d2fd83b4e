//! `[[stage.insertion.sdo]]` and `[[stage.rotation.sdo]]`: what a particular drive needs written.

use serde::Serialize;

use super::error::ConfigError;
use super::section::Section;
use crate::canopen::ObjectAddress;
use crate::stage;
use crate::stage::SdoValue;

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
    pub(super) fn read(s: &mut Section<'_>) -> Self {
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

    pub(super) fn to_stage(self) -> Result<stage::RawSdo, ConfigError> {
        let object = ObjectAddress::new(self.index, self.subindex);
        let value = SdoValue::sized(self.value, self.bits / 8).ok_or_else(|| {
            ConfigError::of(format!("sdo {object}: {} does not fit {} bits", self.value, self.bits))
        })?;
        Ok(stage::RawSdo { object, value, read_back: self.read_back })
    }
}

/// Why an object is not for raw SDOs: it moves the axis, or the bench writes it by itself; with what
/// to set instead. `None` where it may be written.
pub(super) fn reserved(index: u16) -> Option<&'static str> {
    Some(match index {
        0x1016 | 0x1017 => "set can.heartbeat_ms and can.heartbeat_timeout_ms",
        0x1029 => "set communication_error_behaviour",
        0x1400..=0x1BFF => "the bench maps the PDOs it needs, and no others",
        0x6007 => "set abort_connection_option",
        0x6040 => "it is the controlword: the bench alone enables and stops the drive",
        0x605A => "set quick_stop_option",
        0x605E => "set fault_reaction_option",
        0x6060 => "the bench sets the mode that it moves the axis in",
        0x6065 => "set following_error_mm or following_error_deg",
        0x6066 => "set following_error_timeout_ms",
        0x607A | 0x60B0..=0x60B2 | 0x60FF | 0x6071 => "it moves the axis: `needle-bench stage jog`",
        0x607D => "set min_mm and max_mm, or min_deg and max_deg",
        0x60C2 => "set can.sync_ms",
        _ => return None,
    })
}
