//! Classic CAN frames and the identifiers of CANopen.

use derive_more::Display;
use std::fmt;

/// A CAN identifier. CANopen uses base (11-bit) identifiers only; extended ones are kept so that
/// foreign frames can be counted and printed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Display)]
pub enum CanId {
    /// 11-bit identifier, 0 to 0x7FF.
    #[display("{_0:03X}")]
    Base(u16),
    /// 29-bit identifier, 0 to 0x1FFF_FFFF.
    #[display("{_0:08X}")]
    Extended(u32),
}

/// A CANopen node number, 1 to 127.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Display)]
pub struct NodeId(u8);

impl NodeId {
    /// `id` as a node number; `None` outside 1 to 127.
    pub const fn new(id: u8) -> Option<Self> {
        if id >= 1 && id <= 127 { Some(NodeId(id)) } else { None }
    }

    /// The number itself.
    pub const fn get(self) -> u8 {
        self.0
    }
}

/// A classic CAN data or remote frame of 0 to 8 bytes.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct Frame {
    id: CanId,
    remote: bool,
    len: u8,
    data: [u8; 8],
}

impl Frame {
    /// A data frame with the base identifier `cob_id`.
    ///
    /// # Panics
    /// With an identifier over 0x7FF or more than 8 bytes, which are programming errors. Input
    /// goes through [`Frame::from_parts`].
    pub fn new(cob_id: u16, data: &[u8]) -> Self {
        match Self::from_parts(CanId::Base(cob_id), false, data) {
            Some(frame) => frame,
            None => panic!("not a CAN frame: identifier {cob_id:#x}, {} bytes", data.len()),
        }
    }

    /// Any frame; `None` when the identifier or the length is out of range.
    pub fn from_parts(id: CanId, remote: bool, payload: &[u8]) -> Option<Self> {
        let in_range = match id {
            CanId::Base(id) => id <= 0x7FF,
            CanId::Extended(id) => id <= 0x1FFF_FFFF,
        };
        if !in_range || payload.len() > 8 {
            return None;
        }
        let mut data = [0; 8];
        data[..payload.len()].copy_from_slice(payload);
        Some(Frame { id, remote, len: payload.len() as u8, data })
    }

    /// Reads candump's notation: three hexadecimal digits of a base identifier or eight of an extended one, `#`,
    /// then two digits for each byte. In a remote frame, `R` and at most one digit, its length, replace the bytes.
    pub fn parse(text: &str) -> Option<Self> {
        let (id, data) = text.split_once('#')?;
        let id = match id.len() {
            3 => CanId::Base(u16::try_from(hex(id)?).ok()?),
            8 => CanId::Extended(hex(id)?),
            _ => return None,
        };
        if let Some(len) = data.strip_prefix('R') {
            let len = match len.as_bytes() {
                [] => 0,
                [digit @ b'0'..=b'8'] => usize::from(digit - b'0'),
                _ => return None,
            };
            return Frame::from_parts(id, true, &[0; 8][..len]);
        }
        if !data.is_ascii() || data.len() % 2 != 0 {
            return None;
        }
        let byte = |n: usize| hex(data.get(n..n + 2)?)?.try_into().ok();
        let bytes = (0..data.len()).step_by(2).map(byte).collect::<Option<Vec<u8>>>()?;
        Frame::from_parts(id, false, &bytes)
    }

    /// The identifier.
    pub fn id(&self) -> CanId {
        self.id
    }

    /// The base identifier of a data frame, which is all that most CANopen services use. `None`
    /// for extended and remote frames.
    pub fn cob_id(&self) -> Option<u16> {
        match self.id {
            CanId::Base(id) if !self.remote => Some(id),
            _ => None,
        }
    }

    /// True for a remote transmission request.
    pub fn is_remote(&self) -> bool {
        self.remote
    }

    /// The payload, 0 to 8 bytes. A remote frame has no payload: for it, these are as many zeros as the
    /// bytes that it requests.
    pub fn data(&self) -> &[u8] {
        &self.data[..usize::from(self.len)]
    }
}

/// candump's notation: `123#DEADBEEF`; a remote frame is `123#R`, with its length as in `123#R8` unless
/// that is 0.
impl fmt::Display for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}#", self.id)?;
        if self.remote {
            return match self.len {
                0 => f.write_str("R"),
                len => write!(f, "R{len}"),
            };
        }
        self.data().iter().try_for_each(|byte| write!(f, "{byte:02X}"))
    }
}

fn hex(digits: &str) -> Option<u32> {
    let all_hex = digits.bytes().all(|digit| digit.is_ascii_hexdigit());
    if all_hex { u32::from_str_radix(digits, 16).ok() } else { None }
}

impl fmt::Debug for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prints_as_candump_does() {
        assert_eq!(Frame::new(0x601, &[0x40, 0x18, 0x10, 0x01]).to_string(), "601#40181001");
        assert_eq!(Frame::new(0x80, &[]).to_string(), "080#");
        let remote = Frame::from_parts(CanId::Extended(0x1234567), true, &[]);
        assert_eq!(remote.map(|f| f.to_string()).as_deref(), Some("01234567#R"));
    }

    #[test]
    fn reads_what_candump_writes() {
        let texts = ["181#370200000000", "080#", "7FF#0102030405060708", "00000181#00", "123#R"];
        for text in texts.into_iter().chain(["01234567#R8"]) {
            assert_eq!(Frame::parse(text).map(|frame| frame.to_string()).as_deref(), Some(text));
        }
        for text in ["", "181", "1#00", "800#", "181#0", "181#é0", "181#010203040506070809", "+81#"]
        {
            assert_eq!(Frame::parse(text), None, "{text}");
        }
        for text in ["181#R9", "181#R+8", "181#R08", "181#R8 "] {
            assert_eq!(Frame::parse(text), None, "{text}");
        }
    }

    #[test]
    fn an_identifier_payload_or_node_out_of_range_is_refused() {
        assert!(Frame::from_parts(CanId::Base(0x800), false, &[]).is_none());
        assert!(Frame::from_parts(CanId::Base(1), false, &[0; 9]).is_none());
        assert!(
            NodeId::new(0).is_none() && NodeId::new(128).is_none() && NodeId::new(127).is_some()
        );
    }
}
