//! The value of an object, as one SDO frame carries it.

use std::fmt;

/// The value of an object of 1 to 4 bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SdoValue {
    bytes: [u8; 4],
    len: u8,
}

impl SdoValue {
    /// The little-endian `bytes` of an object; `None` unless there are 1 to 4.
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let mut value = SdoValue { bytes: [0; 4], len: bytes.len() as u8 };
        value.bytes.get_mut(..bytes.len())?.copy_from_slice(bytes);
        (!bytes.is_empty()).then_some(value)
    }

    /// `value` in an object of `size` bytes, signed or not; `None` when it does not fit or the
    /// size is none of 1, 2 and 4.
    pub fn sized(value: i64, size: u8) -> Option<Self> {
        let bits = match size {
            1 | 2 | 4 => u32::from(size) * 8,
            _ => return None,
        };
        let fits = (-(1_i64 << (bits - 1))..1_i64 << bits).contains(&value);
        let mut bytes = (value as u32).to_le_bytes();
        bytes[usize::from(size)..].fill(0);
        fits.then_some(SdoValue { bytes, len: size })
    }

    /// The bytes as they go on the bus.
    pub fn as_bytes(&self) -> &[u8] {
        &self.bytes[..usize::from(self.len)]
    }

    /// As an unsigned number.
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
                SdoValue { bytes, len: len as u8 }
            }
        })*
    };
}
sdo_values!(u8, i8, u16, i16, u32, i32);

/// `0x0008`: as many digits as the object has.
impl fmt::Display for SdoValue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "0x{:0width$X}", self.to_u32(), width = 2 * usize::from(self.len))
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
}
