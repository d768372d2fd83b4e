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
}

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
}
