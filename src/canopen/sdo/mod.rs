//! Service data objects (CiA 301, 7.2.4): reading and writing a node's object dictionary.
//!
//! The bench reads and writes values of 1 to 4 bytes, each in one frame (expedited transfer). The server
//! also sends longer values, such as a device's name, in segments.

use derive_more::Display;
use std::fmt;
use std::time::Duration;

use super::ObjectAddress;

pub mod client;
pub mod codec;
pub mod server;

pub use client::SdoClient;
pub use server::{ObjectAccess, SdoServer};

/// A transfer to start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SdoRequest {
    /// Read the object.
    Upload(ObjectAddress),
    /// Write this value to the object.
    Download(ObjectAddress, SdoValue),
}

impl SdoRequest {
    /// The object read or written.
    pub fn object(self) -> ObjectAddress {
        match self {
            SdoRequest::Upload(object) | SdoRequest::Download(object, _) => object,
        }
    }
}

/// The result of a transfer that succeeded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SdoReply {
    /// The value read.
    Uploaded(SdoValue),
    /// The node confirmed the write.
    Downloaded,
}

/// Why a transfer failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum SdoError {
    /// The node did not answer within this time.
    #[error("no SDO reply within {} ms", .0.as_millis())]
    Timeout(Duration),
    /// The node refused.
    #[error("refused with SDO abort {0}")]
    Aborted(AbortCode),
    /// The value is longer than the 4 bytes of one frame.
    #[error("value longer than 4 bytes, is this the right object of this drive?")]
    TooLong,
    /// The response has a command specifier that the request does not lead to.
    #[error("SDO reply with unexpected command byte 0x{0:02X}")]
    UnexpectedCommand(u8),
}

/// The value of an object of 1 to 4 bytes. As text it is `0x0008`: as many digits as the object has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Display)]
#[display("0x{:0width$X}", self.to_u32(), width = 2 * usize::from(self.len))]
pub struct SdoValue {
    bytes: [u8; 4],
    len: u8,
    /// False for a value written without a size: as many of its four bytes count as the object has.
    is_sized: bool,
}

impl SdoValue {
    /// The little-endian `bytes` of an object; `None` unless there are 1 to 4.
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let mut value = SdoValue { bytes: [0; 4], len: bytes.len() as u8, is_sized: true };
        value.bytes.get_mut(..bytes.len())?.copy_from_slice(bytes);
        (!bytes.is_empty()).then_some(value)
    }

    /// `value` in an object of `size` bytes, signed or unsigned; `None` when it does not fit, or the size is
    /// not 1, 2 or 4.
    pub fn sized(value: i64, size: u8) -> Option<Self> {
        let bits = match size {
            1 | 2 | 4 => u32::from(size) * 8,
            _ => return None,
        };
        let fits = (-(1_i64 << (bits - 1))..1_i64 << bits).contains(&value);
        let mut bytes = (value as u32).to_le_bytes();
        bytes[usize::from(size)..].fill(0);
        fits.then_some(SdoValue { bytes, len: size, is_sized: true })
    }

    /// The bytes as they go on the bus.
    pub fn as_bytes(&self) -> &[u8] {
        &self.bytes[..usize::from(self.len)]
    }

    /// The value as an unsigned number, if there are at least `len` bytes. There may be more than the object has: an
    /// expedited answer need not say how many of its four bytes belong to the object (CiA 301, 7.2.4.3.6).
    pub fn at_least(self, len: u8) -> Option<u32> {
        (self.len >= len).then_some(self.to_u32())
    }

    /// How many bytes it has; `None` if it was written without a size (CiA 301, 7.2.4.3.3).
    pub(super) fn size(self) -> Option<usize> {
        self.is_sized.then_some(self.len.into())
    }

    /// The value as an unsigned number.
    pub const fn to_u32(self) -> u32 {
        u32::from_le_bytes(self.bytes)
    }
}

macro_rules! sdo_values {
    ($($type:ty),*) => {
        $(impl From<$type> for SdoValue {
            fn from(value: $type) -> Self {
                let mut bytes = [0; 4];
                let len = size_of::<$type>();
                bytes[..len].copy_from_slice(&value.to_le_bytes());
                SdoValue { bytes, len: len as u8, is_sized: true }
            }
        })*
    };
}
sdo_values!(u8, i8, u16, i16, u32, i32);

/// Why a transfer was refused: the 32 bits on the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct AbortCode(pub u32);

/// The codes that the bench or its emulated drives send or act on.
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
    /// No data available.
    pub const NO_DATA: Self = AbortCode(0x0800_0024);
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

    #[test]
    fn values_have_the_size_of_their_object_or_are_refused() {
        assert_eq!(SdoValue::sized(-2, 2), Some(SdoValue::from(-2_i16)));
        assert_eq!(SdoValue::sized(65_535, 2), Some(SdoValue::from(65_535_u16)));
        assert_eq!(SdoValue::sized(65_536, 2), None);
        assert_eq!(SdoValue::sized(1, 3), None);
        assert_eq!(SdoValue::from_bytes(&[0x34, 0x12]).unwrap().to_string(), "0x1234");
        assert_eq!(SdoValue::from_bytes(&[0; 5]), None);
        assert_eq!(SdoValue::from_bytes(&[]), None);
    }

    /// Do not edit: this table is from CiA 301.
    #[test]
    fn the_abort_codes_are_those_of_cia_301() {
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
    fn abort_codes_print_their_meaning() {
        assert_eq!(AbortCode::NO_SUCH_OBJECT.to_string(), "0x06020000 object does not exist");
        assert_eq!(AbortCode(0x0f00_ffc0).to_string(), "0x0F00FFC0 unknown abort code");
    }
}
