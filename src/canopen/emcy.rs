//! Emergency messages (CiA 301, 7.2.7; drive codes from CiA 402).

use derive_more::Display;
use std::fmt;

use super::{Frame, NodeId, cob};

/// Bits of the error register, object 0x1001 (CiA 301, 7.5.2.2).
pub mod error_register {
    /// Set whenever any error is present.
    pub const GENERIC: u8 = 1 << 0;
    /// Current.
    pub const CURRENT: u8 = 1 << 1;
    /// Voltage.
    pub const VOLTAGE: u8 = 1 << 2;
    /// Temperature.
    pub const TEMPERATURE: u8 = 1 << 3;
    /// Communication: overrun, error state.
    pub const COMMUNICATION: u8 = 1 << 4;
    /// Specific to the device profile, here CiA 402.
    pub const PROFILE: u8 = 1 << 5;
    /// Specific to the manufacturer.
    pub const MANUFACTURER: u8 = 1 << 7;
}

/// An emergency error code. As text it is `0x8611 following error`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Display)]
#[display("0x{_0:04X} {}", self.name().unwrap_or("unknown error code"))]
pub struct EmcyCode(pub u16);

impl EmcyCode {
    /// All errors are gone.
    pub const NO_ERROR: Self = EmcyCode(0x0000);
    /// The DC link's voltage is too low.
    pub const UNDERVOLTAGE: Self = EmcyCode(0x3220);
    /// Communication, without detail.
    pub const COMMUNICATION: Self = EmcyCode(0x8100);
    /// A heartbeat or life guard was missed.
    pub const HEARTBEAT: Self = EmcyCode(0x8130);
    /// A PDO was shorter than its mapping and was not processed.
    pub const PDO_LENGTH: Self = EmcyCode(0x8210);
    /// The position left the following-error window.
    pub const FOLLOWING_ERROR: Self = EmcyCode(0x8611);

    /// The code's name, or that of its class; `None` when neither is in the table.
    pub fn name(self) -> Option<&'static str> {
        let find = |code: u16| {
            let code = format!("{code:04x} ");
            NAMES.lines().find_map(|line| line.strip_prefix(code.as_str()))
        };
        let class = (self.0 & 0xf000 != 0).then_some(self.0 & 0xf000);
        find(self.0).or_else(|| find(self.0 & 0xff00)).or_else(|| find(class?))
    }

    /// The bits of the [`error_register`] that belong to the code's class.
    pub const fn register_bits(self) -> u8 {
        match self.0 >> 8 {
            0x20..=0x2f => error_register::CURRENT,
            0x30..=0x3f => error_register::VOLTAGE,
            0x40..=0x4f => error_register::TEMPERATURE,
            0x81 | 0x82 => error_register::COMMUNICATION,
            0x83..=0x8f => error_register::PROFILE,
            // An EPOS4's limit switches show the generic bit alone.
            0xff if !matches!(self.0, 0xff06 | 0xff07) => error_register::MANUFACTURER,
            _ => error_register::GENERIC,
        }
    }
}

/// A line for each code, sorted. A code that ends in 00 names its class.
const NAMES: &str = include_str!("emcy_codes.txt");

/// An emergency message: 8 bytes, sent once when an error begins or ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Emcy {
    /// The error; [`EmcyCode::NO_ERROR`] when all errors are gone.
    pub code: EmcyCode,
    /// Object 0x1001 at that moment, see [`error_register`].
    pub register: u8,
    /// Manufacturer-specific.
    pub manufacturer: [u8; 5],
}

impl Emcy {
    /// The message as `node` sends it.
    pub fn to_frame(self, node: NodeId) -> Frame {
        let [low, high] = self.code.0.to_le_bytes();
        let [a, b, c, d, e] = self.manufacturer;
        Frame::new(cob::emcy(node), &[low, high, self.register, a, b, c, d, e])
    }
}

/// `0x8611 following error (register 0x21)`, and the manufacturer's bytes unless all are zero.
impl fmt::Display for Emcy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} (register 0x{:02X}", self.code, self.register)?;
        if self.manufacturer != [0; 5] {
            write!(f, ", manufacturer bytes {:02X?}", self.manufacturer)?;
        }
        f.write_str(")")
    }
}

/// The sender and content of an emergency message; `None` for any other frame.
pub fn parse_emcy(frame: &Frame) -> Option<(NodeId, Emcy)> {
    let node = cob::node_of(frame.cob_id()?, 0x080)?;
    let &[low, high, register, a, b, c, d, e] = frame.data() else { return None };
    let code = EmcyCode(u16::from_le_bytes([low, high]));
    Some((node, Emcy { code, register, manufacturer: [a, b, c, d, e] }))
}

#[cfg(test)]
mod tests {
    use super::*;

    const NODE: NodeId = NodeId::new(5).unwrap();

    #[test]
    fn the_emergency_of_a_following_error_has_the_bytes_of_cia_301() {
        let emcy =
            Emcy { code: EmcyCode::FOLLOWING_ERROR, register: 0x21, manufacturer: [1, 2, 3, 4, 5] };
        let frame = emcy.to_frame(NODE);
        assert_eq!(frame.to_string(), "085#1186210102030405");
        assert_eq!(parse_emcy(&frame), Some((NODE, emcy)));
    }

    #[test]
    fn an_emergency_code_prints_its_name_or_that_of_its_class() {
        assert_eq!(EmcyCode(0x8611).to_string(), "0x8611 following error");
        assert_eq!(EmcyCode(0x8130).to_string(), "0x8130 heartbeat or life guard lost");
        assert_eq!(EmcyCode(0x4215).to_string(), "0x4215 device temperature");
        assert_eq!(EmcyCode(0x5912).to_string(), "0x5912 device hardware");
        assert_eq!(EmcyCode(0xff01).to_string(), "0xFF01 manufacturer specific");
        assert_eq!(EmcyCode(0xa000).to_string(), "0xA000 unknown error code");
        assert_eq!(EmcyCode(0x0500).to_string(), "0x0500 unknown error code");
        assert!(NAMES.lines().is_sorted());
    }

    #[test]
    fn sync_short_and_other_frames_are_no_emergencies() {
        assert_eq!(parse_emcy(&Frame::new(0x080, &[0; 8])), None);
        assert_eq!(parse_emcy(&Frame::new(0x085, &[0; 7])), None);
        assert_eq!(parse_emcy(&Frame::new(0x185, &[0; 8])), None);
    }
}
