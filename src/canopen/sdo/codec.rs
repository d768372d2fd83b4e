//! The bytes of SDO frames (CiA 301, 7.2.4.3).
//!
//! Every SDO frame has exactly 8 bytes. Byte 0 holds the command specifier in its upper three bits:
//!
//! | specifier | from the client         | from the server          |
//! |-----------|-------------------------|--------------------------|
//! | 0         | download segment        | upload segment           |
//! | 1         | initiate download       | download segment, done   |
//! | 2         | initiate upload         | initiate upload          |
//! | 3         | upload segment          | initiate download, done  |
//! | 4         | abort                   | abort                    |
//!
//! Specifiers 5 and 6 are block transfer, which is not supported; 7 is reserved.

use super::AbortCode;
use crate::canopen::ObjectAddress;

/// The 8 bytes of an SDO frame.
pub type SdoBytes = [u8; 8];

/// Up to seven bytes carried by one frame: four when expedited, seven in a segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Chunk {
    bytes: [u8; 7],
    len: u8,
}

impl Chunk {
    /// The first seven bytes of `data`, or all when there are fewer.
    pub fn of(data: &[u8]) -> Self {
        let len = data.len().min(7);
        let mut bytes = [0; 7];
        bytes[..len].copy_from_slice(&data[..len]);
        Chunk { bytes, len: len as u8 }
    }

    /// The bytes carried.
    pub fn as_slice(&self) -> &[u8] {
        &self.bytes[..usize::from(self.len)]
    }
}

/// How a transfer begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Initiate {
    /// All data, 1 to 4 bytes, is in this frame. It is four bytes when the sender gave no size.
    Expedited(Chunk),
    /// Segments follow; their total size in bytes when the sender announced it.
    Segmented(Option<u32>),
}

impl Initiate {
    /// Expedited when `data` fits, else segmented with its size.
    pub fn for_data(data: &[u8]) -> Self {
        match data.len() {
            1..=4 => Initiate::Expedited(Chunk::of(data)),
            len => Initiate::Segmented(u32::try_from(len).ok()),
        }
    }
}

/// A segment of a transfer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Segment {
    /// False in the first segment, then alternating.
    pub toggle: bool,
    /// 0 to 7 bytes.
    pub chunk: Chunk,
    /// No segment follows.
    pub last: bool,
}

impl Segment {
    /// The segment of `data` that starts at `offset`.
    pub fn at(data: &[u8], offset: usize, toggle: bool) -> Self {
        let rest = data.get(offset..).unwrap_or_default();
        Segment { toggle, chunk: Chunk::of(rest), last: rest.len() <= 7 }
    }
}

/// What a client sends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ClientFrame {
    /// Write an object.
    InitiateDownload(ObjectAddress, Initiate),
    /// The next part of the data written.
    DownloadSegment(Segment),
    /// Read an object.
    InitiateUpload(ObjectAddress),
    /// Ask for the next part of the data read.
    UploadSegment {
        /// False for the first segment, then alternating.
        toggle: bool,
    },
    /// End the transfer.
    Abort(ObjectAddress, AbortCode),
    /// An unsupported specifier, 5 to 7: byte 0, and the object if the frame names one.
    Unsupported(u8, ObjectAddress),
}

/// What a server sends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ServerFrame {
    /// The object is readable: its data, or segments follow.
    InitiateUpload(ObjectAddress, Initiate),
    /// The next part of the data read.
    UploadSegment(Segment),
    /// The write is accepted; when expedited it is done.
    InitiateDownload(ObjectAddress),
    /// The segment was taken.
    DownloadSegment {
        /// As in the segment.
        toggle: bool,
    },
    /// End the transfer.
    Abort(ObjectAddress, AbortCode),
    /// An unsupported specifier, 5 to 7: byte 0.
    Unsupported(u8),
}

impl ClientFrame {
    /// The object it names; `None` for the later frames of a transfer.
    pub fn object(self) -> Option<ObjectAddress> {
        match self {
            ClientFrame::InitiateDownload(object, _)
            | ClientFrame::InitiateUpload(object)
            | ClientFrame::Abort(object, _)
            | ClientFrame::Unsupported(_, object) => Some(object),
            ClientFrame::DownloadSegment(_) | ClientFrame::UploadSegment { .. } => None,
        }
    }

    /// The frame's bytes.
    pub fn encode(self) -> SdoBytes {
        match self {
            ClientFrame::InitiateDownload(object, initiate) => encode_initiate(1, object, initiate),
            ClientFrame::DownloadSegment(segment) => encode_segment(0, segment),
            ClientFrame::InitiateUpload(object) => with_object(2 << 5, object, [0; 4]),
            ClientFrame::UploadSegment { toggle } => only(3, toggle),
            ClientFrame::Abort(object, code) => encode_abort(object, code),
            ClientFrame::Unsupported(command, object) => with_object(command, object, [0; 4]),
        }
    }

    /// The meaning of `bytes`; `None` unless there are 8.
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let bytes: &SdoBytes = bytes.try_into().ok()?;
        let (command, object) = (bytes[0], object_of(bytes));
        Some(match command >> 5 {
            0 => ClientFrame::DownloadSegment(decode_segment(bytes)),
            1 => ClientFrame::InitiateDownload(object, decode_initiate(bytes)),
            2 => ClientFrame::InitiateUpload(object),
            3 => ClientFrame::UploadSegment { toggle: toggle_of(command) },
            4 => ClientFrame::Abort(object, abort_code_of(bytes)),
            _ => ClientFrame::Unsupported(command, object),
        })
    }
}

impl ServerFrame {
    /// The object it names; `None` for the later frames of a transfer.
    pub fn object(self) -> Option<ObjectAddress> {
        match self {
            ServerFrame::InitiateUpload(object, _)
            | ServerFrame::InitiateDownload(object)
            | ServerFrame::Abort(object, _) => Some(object),
            ServerFrame::UploadSegment(_)
            | ServerFrame::DownloadSegment { .. }
            | ServerFrame::Unsupported(_) => None,
        }
    }

    /// The frame's bytes.
    pub fn encode(self) -> SdoBytes {
        match self {
            ServerFrame::InitiateUpload(object, initiate) => encode_initiate(2, object, initiate),
            ServerFrame::UploadSegment(segment) => encode_segment(0, segment),
            ServerFrame::InitiateDownload(object) => with_object(3 << 5, object, [0; 4]),
            ServerFrame::DownloadSegment { toggle } => only(1, toggle),
            ServerFrame::Abort(object, code) => encode_abort(object, code),
            ServerFrame::Unsupported(command) => [command, 0, 0, 0, 0, 0, 0, 0],
        }
    }

    /// The meaning of `bytes`; `None` unless there are 8.
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let bytes: &SdoBytes = bytes.try_into().ok()?;
        let (command, object) = (bytes[0], object_of(bytes));
        Some(match command >> 5 {
            0 => ServerFrame::UploadSegment(decode_segment(bytes)),
            1 => ServerFrame::DownloadSegment { toggle: toggle_of(command) },
            2 => ServerFrame::InitiateUpload(object, decode_initiate(bytes)),
            3 => ServerFrame::InitiateDownload(object),
            4 => ServerFrame::Abort(object, abort_code_of(bytes)),
            _ => ServerFrame::Unsupported(command),
        })
    }
}

const EXPEDITED: u8 = 1 << 1;
const SIZE_INDICATED: u8 = 1 << 0;
const TOGGLE: u8 = 1 << 4;
const LAST: u8 = 1 << 0;

fn with_object(command: u8, object: ObjectAddress, data: [u8; 4]) -> SdoBytes {
    let [low, high] = object.index.to_le_bytes();
    let [a, b, c, d] = data;
    [command, low, high, object.subindex, a, b, c, d]
}

fn only(specifier: u8, toggle: bool) -> SdoBytes {
    [specifier << 5 | if toggle { TOGGLE } else { 0 }, 0, 0, 0, 0, 0, 0, 0]
}

fn object_of(bytes: &SdoBytes) -> ObjectAddress {
    ObjectAddress::new(u16::from_le_bytes([bytes[1], bytes[2]]), bytes[3])
}

fn data_of(bytes: &SdoBytes) -> [u8; 4] {
    [bytes[4], bytes[5], bytes[6], bytes[7]]
}

fn toggle_of(command: u8) -> bool {
    command & TOGGLE != 0
}

fn encode_abort(object: ObjectAddress, code: AbortCode) -> SdoBytes {
    with_object(4 << 5, object, code.to_u32().to_le_bytes())
}

fn abort_code_of(bytes: &SdoBytes) -> AbortCode {
    AbortCode::from_u32(u32::from_le_bytes(data_of(bytes)))
}

fn encode_initiate(specifier: u8, object: ObjectAddress, initiate: Initiate) -> SdoBytes {
    let command = specifier << 5;
    match initiate {
        Initiate::Expedited(chunk) => {
            let [a, b, c, d, ..] = chunk.bytes;
            let unused = 4 - chunk.len.min(4);
            with_object(command | unused << 2 | EXPEDITED | SIZE_INDICATED, object, [a, b, c, d])
        }
        Initiate::Segmented(None) => with_object(command, object, [0; 4]),
        Initiate::Segmented(Some(size)) => {
            with_object(command | SIZE_INDICATED, object, size.to_le_bytes())
        }
    }
}

fn decode_initiate(bytes: &SdoBytes) -> Initiate {
    let (command, data) = (bytes[0], data_of(bytes));
    let sized = command & SIZE_INDICATED != 0;
    if command & EXPEDITED != 0 {
        let unused = if sized { usize::from(command >> 2 & 3) } else { 0 };
        Initiate::Expedited(Chunk::of(&data[..4 - unused]))
    } else {
        Initiate::Segmented(sized.then_some(u32::from_le_bytes(data)))
    }
}

fn encode_segment(specifier: u8, segment: Segment) -> SdoBytes {
    let mut bytes = only(specifier, segment.toggle);
    bytes[0] |= (7 - segment.chunk.len) << 1 | if segment.last { LAST } else { 0 };
    bytes[1..].copy_from_slice(&segment.chunk.bytes);
    bytes
}

fn decode_segment(bytes: &SdoBytes) -> Segment {
    let unused = usize::from(bytes[0] >> 1 & 7);
    Segment {
        toggle: toggle_of(bytes[0]),
        chunk: Chunk::of(&bytes[1..8 - unused]),
        last: bytes[0] & LAST != 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const VENDOR: ObjectAddress = ObjectAddress::new(0x1018, 1);

    /// Frames as CiA 301 lays them out. Do not edit: they are the standard's, not ours.
    #[test]
    fn frozen_bytes() {
        let client = [
            (ClientFrame::InitiateUpload(VENDOR), [0x40, 0x18, 0x10, 0x01, 0, 0, 0, 0]),
            (
                ClientFrame::InitiateDownload(
                    ObjectAddress::new(0x1017, 0),
                    Initiate::for_data(&1000u16.to_le_bytes()),
                ),
                [0x2b, 0x17, 0x10, 0x00, 0xe8, 0x03, 0, 0],
            ),
            (
                ClientFrame::InitiateDownload(
                    ObjectAddress::new(0x6060, 0),
                    Initiate::for_data(&[8]),
                ),
                [0x2f, 0x60, 0x60, 0x00, 0x08, 0, 0, 0],
            ),
            (
                ClientFrame::InitiateDownload(
                    ObjectAddress::new(0x1400, 1),
                    Initiate::for_data(&0x8000_0205u32.to_le_bytes()),
                ),
                [0x23, 0x00, 0x14, 0x01, 0x05, 0x02, 0x00, 0x80],
            ),
            (
                ClientFrame::InitiateDownload(
                    ObjectAddress::new(0x2000, 0),
                    Initiate::Segmented(Some(10)),
                ),
                [0x21, 0x00, 0x20, 0x00, 10, 0, 0, 0],
            ),
            (
                ClientFrame::DownloadSegment(Segment::at(b"0123456789", 0, false)),
                [0x00, b'0', b'1', b'2', b'3', b'4', b'5', b'6'],
            ),
            (
                ClientFrame::DownloadSegment(Segment::at(b"0123456789", 7, true)),
                [0x19, b'7', b'8', b'9', 0, 0, 0, 0],
            ),
            (ClientFrame::UploadSegment { toggle: false }, [0x60, 0, 0, 0, 0, 0, 0, 0]),
            (ClientFrame::UploadSegment { toggle: true }, [0x70, 0, 0, 0, 0, 0, 0, 0]),
            (
                ClientFrame::Abort(VENDOR, AbortCode::Timeout),
                [0x80, 0x18, 0x10, 0x01, 0x00, 0x00, 0x04, 0x05],
            ),
        ];
        for (frame, bytes) in client {
            assert_eq!(frame.encode(), bytes, "{frame:?}");
            assert_eq!(ClientFrame::decode(&bytes), Some(frame));
        }
        let server = [
            (
                ServerFrame::InitiateUpload(
                    VENDOR,
                    Initiate::for_data(&0x0000_00fbu32.to_le_bytes()),
                ),
                [0x43, 0x18, 0x10, 0x01, 0xfb, 0, 0, 0],
            ),
            (
                ServerFrame::InitiateUpload(
                    ObjectAddress::new(0x1008, 0),
                    Initiate::Segmented(Some(26)),
                ),
                [0x41, 0x08, 0x10, 0x00, 26, 0, 0, 0],
            ),
            (
                ServerFrame::UploadSegment(Segment::at(b"0123456789", 7, true)),
                [0x19, b'7', b'8', b'9', 0, 0, 0, 0],
            ),
            (
                ServerFrame::InitiateDownload(ObjectAddress::new(0x1017, 0)),
                [0x60, 0x17, 0x10, 0, 0, 0, 0, 0],
            ),
            (ServerFrame::DownloadSegment { toggle: false }, [0x20, 0, 0, 0, 0, 0, 0, 0]),
            (ServerFrame::DownloadSegment { toggle: true }, [0x30, 0, 0, 0, 0, 0, 0, 0]),
            (
                ServerFrame::Abort(VENDOR, AbortCode::NoSuchObject),
                [0x80, 0x18, 0x10, 0x01, 0x00, 0x00, 0x02, 0x06],
            ),
        ];
        for (frame, bytes) in server {
            assert_eq!(frame.encode(), bytes, "{frame:?}");
            assert_eq!(ServerFrame::decode(&bytes), Some(frame));
        }
    }

    #[test]
    fn an_expedited_answer_without_size_has_four_bytes() {
        let decoded = ServerFrame::decode(&[0x42, 0x18, 0x10, 0x01, 1, 2, 3, 4]);
        let expected = Initiate::Expedited(Chunk::of(&[1, 2, 3, 4]));
        assert_eq!(decoded, Some(ServerFrame::InitiateUpload(VENDOR, expected)));
    }

    proptest! {
        #[test]
        fn anything_decodes_without_panic_and_short_frames_to_nothing(
            bytes in proptest::collection::vec(any::<u8>(), 0..=8),
        ) {
            prop_assert_eq!(ClientFrame::decode(&bytes).is_some(), bytes.len() == 8);
            prop_assert_eq!(ServerFrame::decode(&bytes).is_some(), bytes.len() == 8);
        }
    }
}
