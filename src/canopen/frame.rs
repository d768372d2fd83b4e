//! Classic CAN frames and the identifiers of CANopen.

use std::fmt;

/// A CAN identifier. CANopen uses base (11-bit) identifiers only; extended ones are kept so that
/// foreign traffic can be seen, counted and named.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum CanId {
    /// 11-bit identifier, 0 to 0x7FF.
    Base(u16),
    /// 29-bit identifier, 0 to 0x1FFF_FFFF.
    Extended(u32),
}

impl fmt::Display for CanId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            CanId::Base(id) => write!(f, "{id:03X}"),
            CanId::Extended(id) => write!(f, "{id:08X}"),
        }
    }
}

/// A CANopen node number, 1 to 127 (CiA 301, 7.2.2).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
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

impl fmt::Display for NodeId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
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
    /// With an identifier over 0x7FF or more than 8 bytes: both are mistakes of the program,
    /// never of its input. Input comes in through [`Frame::from_parts`].
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

    /// The identifier.
    pub fn id(&self) -> CanId {
        self.id
    }

    /// The base identifier of a data frame: what a CANopen device looks at. `None` for extended
    /// and remote frames.
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

    /// The payload, 0 to 8 bytes.
    pub fn data(&self) -> &[u8] {
        &self.data[..usize::from(self.len)]
    }
}

/// candump's notation, `123#DEADBEEF`; remote frames `123#R`.
impl fmt::Display for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}#", self.id)?;
        if self.remote {
            return write!(
                f,
                "R{}",
                if self.len == 0 { String::new() } else { self.len.to_string() }
            );
        }
        self.data().iter().try_for_each(|byte| write!(f, "{byte:02X}"))
    }
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
    fn refuses_what_does_not_fit() {
        assert!(Frame::from_parts(CanId::Base(0x800), false, &[]).is_none());
        assert!(Frame::from_parts(CanId::Base(1), false, &[0; 9]).is_none());
        assert!(
            NodeId::new(0).is_none() && NodeId::new(128).is_none() && NodeId::new(127).is_some()
        );
    }
}
