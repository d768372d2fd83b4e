//! The address of a value in a node's object dictionary.

use std::fmt;

/// Index and subindex of an object: the multiplexer of an SDO, the upper half of a PDO mapping.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ObjectAddress {
    /// Index, 0x0000 to 0xFFFF.
    pub index: u16,
    /// Subindex, 0 for a plain variable.
    pub subindex: u8,
}

impl ObjectAddress {
    /// The object `index:subindex`.
    pub const fn new(index: u16, subindex: u8) -> Self {
        ObjectAddress { index, subindex }
    }

    /// The name that CiA 301 (7.5) and CiA 402 give the object's index; `None` for one that
    /// neither defines or the bench never uses.
    pub fn name(self) -> Option<&'static str> {
        match self.index {
            0x1400..=0x15ff => Some("RPDO communication parameter"),
            0x1600..=0x17ff => Some("RPDO mapping parameter"),
            0x1800..=0x19ff => Some("TPDO communication parameter"),
            0x1a00..=0x1bff => Some("TPDO mapping parameter"),
            index => NAMES.iter().find(|(known, _)| *known == index).map(|(_, name)| *name),
        }
    }
}

const NAMES: &[(u16, &str)] = &[
    (0x1000, "device type"),
    (0x1001, "error register"),
    (0x1002, "manufacturer status register"),
    (0x1003, "pre-defined error field"),
    (0x1005, "COB-ID SYNC"),
    (0x1006, "communication cycle period"),
    (0x1007, "synchronous window length"),
    (0x1008, "manufacturer device name"),
    (0x1009, "manufacturer hardware version"),
    (0x100a, "manufacturer software version"),
    (0x1010, "store parameters"),
    (0x1011, "restore default parameters"),
    (0x1014, "COB-ID EMCY"),
    (0x1016, "consumer heartbeat time"),
    (0x1017, "producer heartbeat time"),
    (0x1018, "identity object"),
    (0x1019, "synchronous counter overflow value"),
    (0x1029, "error behaviour"),
    (0x1200, "SDO server parameter"),
    (0x6007, "abort connection option code"),
    (0x603f, "error code"),
    (0x6040, "controlword"),
    (0x6041, "statusword"),
    (0x605a, "quick stop option code"),
    (0x605b, "shutdown option code"),
    (0x605c, "disable operation option code"),
    (0x605d, "halt option code"),
    (0x605e, "fault reaction option code"),
    (0x6060, "modes of operation"),
    (0x6061, "modes of operation display"),
    (0x6062, "position demand value"),
    (0x6064, "position actual value"),
    (0x6065, "following error window"),
    (0x6066, "following error time out"),
    (0x606c, "velocity actual value"),
    (0x607a, "target position"),
    (0x607b, "position range limit"),
    (0x607c, "home offset"),
    (0x607d, "software position limit"),
    (0x607f, "max profile velocity"),
    (0x6081, "profile velocity"),
    (0x6083, "profile acceleration"),
    (0x6084, "profile deceleration"),
    (0x6085, "quick stop deceleration"),
    (0x6098, "homing method"),
    (0x6099, "homing speeds"),
    (0x609a, "homing acceleration"),
    (0x60c2, "interpolation time period"),
    (0x60f4, "following error actual value"),
    (0x60fd, "digital inputs"),
    (0x6502, "supported drive modes"),
];

/// `0x6041:00`: both in hexadecimal, as device manuals print them.
impl fmt::Display for ObjectAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "0x{:04X}:{:02X}", self.index, self.subindex)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prints_as_manuals_do() {
        assert_eq!(ObjectAddress::new(0x60c2, 1).to_string(), "0x60C2:01");
    }

    #[test]
    fn every_object_of_the_drive_profile_has_its_name() {
        use crate::canopen::cia402::object;
        assert_eq!(object::STATUSWORD.name(), Some("statusword"));
        assert_eq!(object::SOFTWARE_LIMIT_MAX.name(), Some("software position limit"));
        assert_eq!(ObjectAddress::new(0x1a00, 2).name(), Some("TPDO mapping parameter"));
        assert_eq!(ObjectAddress::new(0x2000, 0).name(), None);
        assert!(NAMES.is_sorted_by_key(|(index, _)| index));
    }
}
