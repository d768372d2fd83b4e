//! SDO abort codes (CiA 301, table 22).

use std::fmt;

/// Why a transfer was refused: the 32 bits on the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct AbortCode(pub u32);

/// Those that the bench or its emulated drives send or act on.
impl AbortCode {
    /// Toggle bit not alternated.
    pub const TOGGLE_NOT_ALTERNATED: Self = AbortCode(0x0503_0000);
    /// SDO protocol timed out.
    pub const TIMEOUT: Self = AbortCode(0x0504_0000);
    /// Command specifier not valid or unknown.
    pub const UNKNOWN_SPECIFIER: Self = AbortCode(0x0504_0001);
    /// Out of memory.
    pub const OUT_OF_MEMORY: Self = AbortCode(0x0504_0005);
    /// Unsupported access to an object.
    pub const UNSUPPORTED_ACCESS: Self = AbortCode(0x0601_0000);
    /// Attempt to read a write-only object.
    pub const WRITE_ONLY: Self = AbortCode(0x0601_0001);
    /// Attempt to write a read-only object.
    pub const READ_ONLY: Self = AbortCode(0x0601_0002);
    /// Object does not exist.
    pub const NO_SUCH_OBJECT: Self = AbortCode(0x0602_0000);
    /// Object cannot be mapped to the PDO.
    pub const NOT_MAPPABLE: Self = AbortCode(0x0604_0041);
    /// Mapped objects would exceed the PDO length.
    pub const PDO_LENGTH_EXCEEDED: Self = AbortCode(0x0604_0042);
    /// General parameter incompatibility.
    pub const PARAMETER_INCOMPATIBLE: Self = AbortCode(0x0604_0043);
    /// Data type does not match, length too high.
    pub const LENGTH_TOO_HIGH: Self = AbortCode(0x0607_0012);
    /// Data type does not match, length too low.
    pub const LENGTH_TOO_LOW: Self = AbortCode(0x0607_0013);
    /// Subindex does not exist.
    pub const NO_SUCH_SUBINDEX: Self = AbortCode(0x0609_0011);
    /// Invalid value for the parameter.
    pub const INVALID_VALUE: Self = AbortCode(0x0609_0030);
    /// Value too high.
    pub const VALUE_TOO_HIGH: Self = AbortCode(0x0609_0031);
    /// Value too low.
    pub const VALUE_TOO_LOW: Self = AbortCode(0x0609_0032);
    /// General error.
    pub const GENERAL: Self = AbortCode(0x0800_0000);
}

/// A line for each code that the standard names, sorted; the descriptions are shortened.
const NAMES: &str = include_str!("abort_codes.txt");

/// `0x06020000 object does not exist`.
impl fmt::Display for AbortCode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let code = format!("{:08x} ", self.0);
        let name = NAMES.lines().find_map(|line| line.strip_prefix(code.as_str()));
        write!(f, "0x{:08X} {}", self.0, name.unwrap_or("unknown abort code"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The table in CiA 301. Do not edit: it is the standard's, not ours.
    #[test]
    fn the_table_of_abort_codes_is_the_standards() {
        let table = [
            0x0503_0000_u32,
            0x0504_0000,
            0x0504_0001,
            0x0504_0002,
            0x0504_0003,
            0x0504_0004,
            0x0504_0005,
            0x0601_0000,
            0x0601_0001,
            0x0601_0002,
            0x0602_0000,
            0x0604_0041,
            0x0604_0042,
            0x0604_0043,
            0x0604_0047,
            0x0606_0000,
            0x0607_0010,
            0x0607_0012,
            0x0607_0013,
            0x0609_0011,
            0x0609_0030,
            0x0609_0031,
            0x0609_0032,
            0x0609_0036,
            0x060a_0023,
            0x0800_0000,
            0x0800_0020,
            0x0800_0021,
            0x0800_0022,
            0x0800_0023,
            0x0800_0024,
        ];
        let code = |line: &str| u32::from_str_radix(line.split(' ').next().unwrap(), 16).unwrap();
        assert_eq!(NAMES.lines().map(code).collect::<Vec<_>>(), table);
    }

    #[test]
    fn codes_are_named() {
        assert_eq!(AbortCode::NO_SUCH_OBJECT.to_string(), "0x06020000 object does not exist");
        assert_eq!(AbortCode(0x0f00_ffc0).to_string(), "0x0F00FFC0 unknown abort code");
    }
}
