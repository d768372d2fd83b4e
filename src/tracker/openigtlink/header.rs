//! The 58-byte header that every message starts with, its time stamp and its checksum.

use super::decoder::DecodeError;
use crate::text::{clipped, escaped};
use std::sync::LazyLock;

/// Bytes of a header.
pub const HEADER_LEN: usize = 58;

/// The largest body that is kept, bytes: room for 14,000 tools in a TDATA. TRANSFORM and POSITION
/// take under a thousandth of it.
pub const BODY_LIMIT: u64 = 1 << 20;

/// The largest body that is skipped, bytes. Ultrasound images may come on the same connection and
/// must not end it.
pub const SKIPPED_BODY_LIMIT: u64 = 1 << 28;

pub(super) const TYPE_LEN: usize = 12;
/// The longest device name that fits the header; a longer one is truncated.
pub const DEVICE_NAME_LEN: usize = 20;

/// A header as on the wire: version, type, device name, stamp, body size, CRC.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Header {
    pub(super) version: u16,
    message_type: [u8; TYPE_LEN],
    device_name: [u8; DEVICE_NAME_LEN],
    stamp_bits: u64,
    pub(super) body_size: u64,
    pub(super) crc: u64,
}

impl Header {
    /// Reads a header and checks its version. The caller checks its sizes.
    pub(super) fn parse(bytes: &[u8; HEADER_LEN]) -> Result<Self, DecodeError> {
        let (version, rest) = take(bytes);
        let (message_type, rest) = take(rest);
        let (device_name, rest) = take(rest);
        let (stamp, rest) = take(rest);
        let (body_size, rest) = take(rest);
        let (crc, _) = take(rest);
        let version = u16::from_be_bytes(version);
        if !matches!(version, 1 | 2) {
            return Err(DecodeError::framing(format!(
                "header version {version} (1 or 2 expected); is that port an OpenIGTLink server?"
            )));
        }
        Ok(Header {
            version,
            message_type,
            device_name,
            stamp_bits: u64::from_be_bytes(stamp),
            body_size: u64::from_be_bytes(body_size),
            crc: u64::from_be_bytes(crc),
        })
    }

    /// The type's bytes without their padding.
    pub(super) fn type_bytes(&self) -> &[u8] {
        unpadded(&self.message_type)
    }

    pub(super) fn message_type(&self) -> String {
        text(&self.message_type)
    }

    /// The device name, truncated to what the header holds.
    pub(super) fn device_name(&self) -> String {
        text(&self.device_name)
    }

    pub(super) fn timestamp(&self) -> Option<IgtlStamp> {
        IgtlStamp::from_bits(self.stamp_bits)
    }

    /// Names the message in an error.
    pub(super) fn type_and_device(&self) -> String {
        format!("{} \"{}\"", self.message_type(), self.device_name())
    }
}

/// The first `N` of a header's bytes and what follows them.
fn take<const N: usize>(bytes: &[u8]) -> ([u8; N], &[u8]) {
    // The header is as long as its fields together, so there is always a chunk.
    bytes.split_first_chunk().map_or(([0; N], bytes), |(head, rest)| (*head, rest))
}

/// `text` in a field of `N` bytes, padded with zeros; truncated at a character if it is too long.
pub(super) fn padded<const N: usize>(text: &str) -> [u8; N] {
    let fitting = &text.as_bytes()[..text.floor_char_boundary(N)];
    let mut field = [0; N];
    field[..fitting.len()].copy_from_slice(fitting);
    field
}

/// The bytes of a field up to its first zero.
pub(super) fn unpadded(field: &[u8]) -> &[u8] {
    field.split(|byte| *byte == 0).next().unwrap_or_default()
}

/// The longest text of a peer that is kept, characters: each status and each name is recorded.
pub(super) const TEXT_MAX: usize = 1000;

/// `bytes` as text, [escaped] and [clipped]; bytes that are not UTF-8 are replaced.
pub(super) fn printable(bytes: &[u8]) -> String {
    clipped(&escaped(&String::from_utf8_lossy(bytes)), TEXT_MAX).into_owned()
}

/// The text of a field up to its first zero.
pub(super) fn text(field: &[u8]) -> String {
    printable(unpadded(field))
}

/// A time stamp as sent: 32.32 fixed-point seconds since 1970-01-01 UTC.
///
/// Zero means "no stamp" and is not an `IgtlStamp` but `None` in a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct IgtlStamp(u64);

const NANOS_PER_S: u64 = 1_000_000_000;

impl IgtlStamp {
    /// The stamp of the raw 64 bits; `None` for zero.
    pub fn from_bits(bits: u64) -> Option<Self> {
        (bits != 0).then_some(IgtlStamp(bits))
    }

    /// The raw 64 bits: seconds in the upper half, 2⁻³² seconds in the lower.
    pub fn bits(self) -> u64 {
        self.0
    }

    /// The stamp nearest to `ns` nanoseconds since 1970; `None` at or before 1970 and after 2106.
    pub fn from_unix_ns(ns: i64) -> Option<Self> {
        let ns = u64::try_from(ns).ok()?;
        let seconds = u32::try_from(ns / NANOS_PER_S).ok()?;
        // Under a second, so the fraction stays under 2³².
        let fraction = (((ns % NANOS_PER_S) << 32) + NANOS_PER_S / 2) / NANOS_PER_S;
        Self::from_bits((u64::from(seconds) << 32) + fraction)
    }

    /// Nanoseconds since 1970, rounded. Inverts [`IgtlStamp::from_unix_ns`] exactly.
    pub fn unix_ns(self) -> i64 {
        let (seconds, fraction) = (self.0 >> 32, self.0 & 0xFFFF_FFFF);
        let ns = seconds * NANOS_PER_S + ((fraction * NANOS_PER_S + (1 << 31)) >> 32);
        // Under 2³² seconds: fits.
        ns as i64
    }
}

const POLYNOMIAL: u64 = 0x42F0_E1EB_A9EA_3693;

/// The checksum's change for each value of the leading byte.
static TABLE: LazyLock<[u64; 256]> = LazyLock::new(|| {
    std::array::from_fn(|byte| {
        (0..8).fold((byte as u64) << 56, |crc, _| match crc >> 63 {
            1 => (crc << 1) ^ POLYNOMIAL,
            _ => crc << 1,
        })
    })
});

/// CRC-64 of `bytes` as OpenIGTLink uses it: ECMA-182 polynomial, not reflected, zero at the start
/// and no final inversion.
pub fn crc64(bytes: &[u8]) -> u64 {
    let table = &*TABLE;
    bytes.iter().fold(0, |crc, byte| (crc << 8) ^ table[usize::from((crc >> 56) as u8 ^ byte)])
}

#[cfg(test)]
mod tests {
    use super::super::{Body, Message, encode};
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_header_of_58_bytes_is_read_as_it_was_written() {
        let stamp = IgtlStamp::from_unix_ns(1_700_000_000_123_456_789);
        let bytes = encode(&Message::new("NeedleToTracker", stamp, Body::Transform([0.0; 12])));
        let header = Header::parse(bytes.first_chunk().expect("58 bytes")).expect("a header");
        assert_eq!((header.version, header.body_size), (1, 48));
        assert_eq!(header.message_type(), "TRANSFORM");
        assert_eq!(header.device_name(), "NeedleToTracker");
        assert_eq!(header.timestamp(), stamp);
    }

    #[test]
    fn names_are_cut_at_a_character_and_may_fill_the_field() {
        assert_eq!(text(&padded::<4>("abcdef")), "abcd");
        assert_eq!(text(&padded::<4>("abcé")), "abc");
        assert_eq!(text(&[b'a', 0, b'b', 0]), "a");
        assert_eq!(text(b"a\x1b[2J\nb"), "a\\u{1b}[2J\\nb");
    }

    #[test]
    fn another_protocol_on_the_port_is_refused_by_its_header_version() {
        let bytes = [b'G'; HEADER_LEN];
        let error = Header::parse(&bytes).unwrap_err().to_string();
        assert!(
            error.starts_with("openigtlink: header version 18247 (1 or 2 expected)"),
            "{error}"
        );
    }

    #[test]
    fn crc64_gives_the_check_value_of_the_catalogue() {
        // CRC-64/ECMA-182 in the RevEng catalogue of parametrised CRC algorithms.
        assert_eq!(crc64(b"123456789"), 0x6C40_DF5F_0B49_7347);
    }

    proptest! {
        #[test]
        fn a_stamp_keeps_its_nanoseconds(ns in 1..=i64::from(u32::MAX) * 1_000_000_000 + 999_999_999) {
            let stamp = IgtlStamp::from_unix_ns(ns).expect("in range");
            prop_assert_eq!(stamp.unix_ns(), ns);
        }

        #[test]
        fn any_bits_are_a_time_to_the_nearest_nanosecond(bits in 1..=u64::MAX) {
            let stamp = IgtlStamp::from_bits(bits).expect("not zero");
            let exact_ns = (u128::from(bits) * 1_000_000_000) as f64 / 2f64.powi(32);
            // A float holds such a time to 512 ns.
            prop_assert!((stamp.unix_ns() as f64 - exact_ns).abs() <= 512.0);
        }
    }

    #[test]
    fn half_a_second_is_half_the_range_of_the_fraction() {
        let stamp = IgtlStamp::from_unix_ns(1_500_000_000).expect("in range");
        assert_eq!(stamp.bits(), 0x0000_0001_8000_0000);
    }

    #[test]
    fn zero_and_times_outside_the_range_are_no_stamp() {
        assert_eq!(IgtlStamp::from_bits(0), None);
        assert_eq!(IgtlStamp::from_unix_ns(0), None);
        assert_eq!(IgtlStamp::from_unix_ns(-1), None);
        assert_eq!(IgtlStamp::from_unix_ns(i64::MAX), None);
    }
}
