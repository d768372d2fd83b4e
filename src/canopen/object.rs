//! The address of a value in a node's object dictionary.

use derive_more::Display;

/// Index and subindex of an object: the multiplexer of an SDO, the upper half of a PDO mapping. As text it is
/// `0x6041:00`: both in hexadecimal, as device manuals print them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Display)]
#[display("0x{index:04X}:{subindex:02X}")]
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
}

/// Objects of the communication profile (CiA 301, 7.5.2).
pub mod communication {
    use super::ObjectAddress;

    /// u32: profile number in the lower half.
    pub const DEVICE_TYPE: ObjectAddress = ObjectAddress::new(0x1000, 0);
    /// u8: see [`error_register`](crate::canopen::emcy::error_register).
    pub const ERROR_REGISTER: ObjectAddress = ObjectAddress::new(0x1001, 0);
    /// u32: identifier of SYNC; bit 30 makes the node produce it.
    pub const SYNC_COB_ID: ObjectAddress = ObjectAddress::new(0x1005, 0);
    /// u32: identifier of emergency messages; bit 31 switches them off.
    pub const EMCY_COB_ID: ObjectAddress = ObjectAddress::new(0x1014, 0);
    /// u16, ms: period of the node's heartbeat; 0 is off.
    pub const PRODUCER_HEARTBEAT: ObjectAddress = ObjectAddress::new(0x1017, 0);
    /// u8: what the node does when it misses a heartbeat that it monitors: 0 enters Pre-operational,
    /// 1 changes nothing, 2 enters Stopped.
    pub const COMMUNICATION_ERROR_BEHAVIOUR: ObjectAddress = ObjectAddress::new(0x1029, 1);

    /// u32: the errors, the newest at subindex 1. u8: their number, at subindex 0.
    pub const fn error_history(subindex: u8) -> ObjectAddress {
        ObjectAddress::new(0x1003, subindex)
    }

    /// u32: a monitored node in bits 16 to 23, its heartbeat timeout in ms in bits 0 to 15.
    pub const fn consumer_heartbeat(subindex: u8) -> ObjectAddress {
        ObjectAddress::new(0x1016, subindex)
    }

    /// u32: vendor (1), product (2), revision (3), serial number (4).
    pub const fn identity(subindex: u8) -> ObjectAddress {
        ObjectAddress::new(0x1018, subindex)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prints_as_manuals_do() {
        assert_eq!(ObjectAddress::new(0x60c2, 1).to_string(), "0x60C2:01");
    }
}
