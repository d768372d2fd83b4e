//! SDO abort codes (CiA 301, table 22).

use std::fmt;

macro_rules! abort_codes {
    ($($name:ident = $code:literal, $text:literal;)*) => {
        /// Why a transfer was refused.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        pub enum AbortCode {
            $(#[doc = concat!("`", stringify!($code), "`: ", $text, ".")] $name,)*
            /// A code the standard does not define.
            Unknown(u32),
        }

        impl AbortCode {
            /// Every code the standard names.
            #[cfg(test)]
            pub const ALL: &[AbortCode] = &[$(AbortCode::$name,)*];

            /// The abort code of these 32 bits.
            pub const fn from_u32(code: u32) -> Self {
                match code {
                    $($code => AbortCode::$name,)*
                    other => AbortCode::Unknown(other),
                }
            }

            /// The 32 bits on the bus.
            pub const fn to_u32(self) -> u32 {
                match self {
                    $(AbortCode::$name => $code,)*
                    AbortCode::Unknown(other) => other,
                }
            }

            /// The standard's description, shortened.
            pub const fn description(self) -> &'static str {
                match self {
                    $(AbortCode::$name => $text,)*
                    AbortCode::Unknown(_) => "unknown abort code",
                }
            }
        }
    };
}

abort_codes! {
    ToggleNotAlternated = 0x0503_0000, "toggle bit not alternated";
    Timeout = 0x0504_0000, "SDO protocol timed out";
    UnknownSpecifier = 0x0504_0001, "command specifier not valid or unknown";
    InvalidBlockSize = 0x0504_0002, "invalid block size";
    InvalidSequenceNumber = 0x0504_0003, "invalid sequence number";
    CrcError = 0x0504_0004, "CRC error";
    OutOfMemory = 0x0504_0005, "out of memory";
    UnsupportedAccess = 0x0601_0000, "unsupported access to an object";
    WriteOnly = 0x0601_0001, "attempt to read a write-only object";
    ReadOnly = 0x0601_0002, "attempt to write a read-only object";
    NoSuchObject = 0x0602_0000, "object does not exist";
    NotMappable = 0x0604_0041, "object cannot be mapped to the PDO";
    PdoLengthExceeded = 0x0604_0042, "mapped objects would exceed the PDO length";
    ParameterIncompatible = 0x0604_0043, "general parameter incompatibility";
    InternalIncompatible = 0x0604_0047, "general internal incompatibility in the device";
    HardwareError = 0x0606_0000, "access failed because of a hardware error";
    LengthMismatch = 0x0607_0010, "data type does not match, length does not match";
    LengthTooHigh = 0x0607_0012, "data type does not match, length too high";
    LengthTooLow = 0x0607_0013, "data type does not match, length too low";
    NoSuchSubindex = 0x0609_0011, "subindex does not exist";
    InvalidValue = 0x0609_0030, "invalid value for the parameter";
    ValueTooHigh = 0x0609_0031, "value too high";
    ValueTooLow = 0x0609_0032, "value too low";
    MaximumLessThanMinimum = 0x0609_0036, "maximum is less than minimum";
    ResourceUnavailable = 0x060a_0023, "resource not available, no SDO connection";
    General = 0x0800_0000, "general error";
    CannotTransfer = 0x0800_0020, "data cannot be transferred or stored";
    LocalControl = 0x0800_0021, "data cannot be transferred because of local control";
    DeviceState = 0x0800_0022, "data cannot be transferred in the present device state";
    NoObjectDictionary = 0x0800_0023, "no object dictionary, or its generation failed";
    NoData = 0x0800_0024, "no data available";
}

/// `0x06020000 object does not exist`.
impl fmt::Display for AbortCode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "0x{:08X} {}", self.to_u32(), self.description())
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
        let ours: Vec<u32> = AbortCode::ALL.iter().map(|code| code.to_u32()).collect();
        assert_eq!(ours, table);
    }

    #[test]
    fn codes_survive_the_trip_and_are_named() {
        for &code in AbortCode::ALL {
            assert_eq!(AbortCode::from_u32(code.to_u32()), code);
        }
        assert_eq!(AbortCode::from_u32(0x0601_0002), AbortCode::ReadOnly);
        assert_eq!(AbortCode::NoSuchObject.to_string(), "0x06020000 object does not exist");
        let foreign = AbortCode::from_u32(0x0f00_ffc0);
        assert_eq!(foreign, AbortCode::Unknown(0x0f00_ffc0));
        assert_eq!(foreign.to_string(), "0x0F00FFC0 unknown abort code");
    }
}
