//! The 58-byte header that every message starts with.

use super::decoder::DecodeError;
use super::stamp::IgtlStamp;
use crate::text::escaped;

/// Bytes of a header.
pub const HEADER_LEN: usize = 58;

/// The largest body that is kept, bytes: room for 14,000 tools in a TDATA. TRANSFORM and POSITION
/// take under a thousandth of it.
pub const BODY_LIMIT: u64 = 1 << 20;

/// The largest body that is skipped, bytes. Ultrasound images may come on the same connection and
/// must not end it.
pub const SKIPPED_BODY_LIMIT: u64 = 1 << 28;

pub(super) const TYPE_LEN: usize = 12;
pub(super) const NAME_LEN: usize = 20;

/// A header as it stands on the wire: version, type, device name, stamp, body size, CRC.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Header {
    pub(super) version: u16,
    message_type: [u8; TYPE_LEN],
    device_name: [u8; NAME_LEN],
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

    /// The device name as far as the header holds it.
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

/// `text` in a field of `N` bytes, padded with zeros; cut at a character if it is too long.
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

/// The text of a field up to its first zero, [escaped]; bytes that are not UTF-8 are replaced.
pub(super) fn text(field: &[u8]) -> String {
    escaped(&String::from_utf8_lossy(unpadded(field))).into_owned()
}

#[cfg(test)]
mod tests {
    use super::super::{Body, Message, encode};
    use super::*;

    #[test]
    fn a_header_is_58_bytes_and_comes_back() {
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
    fn something_else_on_the_port_is_named_by_its_version() {
        let bytes = [b'G'; HEADER_LEN];
        let error = Header::parse(&bytes).unwrap_err().to_string();
        assert!(
            error.starts_with("openigtlink: header version 18247 (1 or 2 expected)"),
            "{error}"
        );
    }
}
