//! The bytes of SDO frames (CiA 301, 7.2.4.3).
//!
//! Every SDO frame has exactly 8 bytes. Byte 0 holds the command specifier in its upper three bits:
//!
//! | specifier | from the client         | from the server          |
//! |-----------|-------------------------|--------------------------|
//! | 0         | download segment        | upload segment           |
//! | 1         | initiate download       | download segment (reply) |
//! | 2         | initiate upload         | initiate upload          |
//! | 3         | upload segment          | initiate download (reply)|
//! | 4         | abort                   | abort                    |
//!
//! Specifiers 5 and 6 are block transfer; 7 is reserved. Segmented download and block transfer are not
//! supported: nothing that the bench writes is longer than 4 bytes. Segmented upload is supported on
//! the server side only (the emulated drives): the bench's client aborts a segmented upload, because it
//! reads nothing longer than 4 bytes.

use super::{AbortCode, SdoReply, SdoRequest, SdoValue};
use crate::canopen::{Frame, NodeId, ObjectAddress, cob};

/// The 8 bytes of an SDO frame.
pub type SdoBytes = [u8; 8];

/// The object address of an abort that names no object: 0000:00.
pub(super) const NO_OBJECT: ObjectAddress = ObjectAddress::new(0, 0);

/// A frame from a client.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ClientFrame {
    /// Read or write an object.
    Request(SdoRequest),
    /// Ask for the next part of the data read, with a toggle bit: false for the first segment, then
    /// alternating.
    UploadSegment(bool),
    /// End the transfer.
    Abort(ObjectAddress, AbortCode),
    /// A transfer that is not supported, with its object if the frame names one.
    Unsupported(ObjectAddress),
}

/// A frame from a server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ServerFrame {
    /// The object was read or written.
    Reply(ObjectAddress, SdoReply),
    /// The object is longer than 4 bytes: its data follows in segments. The number is its size in bytes,
    /// meaningful only if the server indicated it.
    InitiateUpload(ObjectAddress, u32),
    /// End the transfer.
    Abort(ObjectAddress, AbortCode),
    /// Block transfer or a reserved command, which our client never requests. The value is the command
    /// byte (byte 0).
    Unsupported(u8),
}

impl ClientFrame {
    /// The frame for the server `node`.
    pub fn to_frame(self, node: NodeId) -> Frame {
        Frame::new(cob::sdo_rx(node), &self.encode())
    }

    /// The frame's bytes. [`ClientFrame::Unsupported`] becomes a reserved command.
    pub fn encode(self) -> SdoBytes {
        match self {
            ClientFrame::Request(SdoRequest::Upload(object)) => with_object(2 << 5, object, [0; 4]),
            ClientFrame::Request(SdoRequest::Download(object, value)) => {
                encode_value(1, object, value)
            }
            ClientFrame::UploadSegment(toggle) => {
                [3 << 5 | toggle_bit(toggle), 0, 0, 0, 0, 0, 0, 0]
            }
            ClientFrame::Abort(object, code) => encode_abort(object, code),
            ClientFrame::Unsupported(object) => with_object(7 << 5, object, [0; 4]),
        }
    }

    /// The meaning of `bytes`; `None` unless there are 8.
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let bytes: &SdoBytes = bytes.try_into().ok()?;
        let (command, object) = (bytes[0], object_of(bytes));
        Some(match command >> 5 {
            0 => ClientFrame::Unsupported(NO_OBJECT),
            1 if command & EXPEDITED != 0 => {
                let is_sized = command & SIZE_INDICATED != 0;
                let value = SdoValue { is_sized, ..decode_value(bytes)? };
                ClientFrame::Request(SdoRequest::Download(object, value))
            }
            2 => ClientFrame::Request(SdoRequest::Upload(object)),
            3 => ClientFrame::UploadSegment(command & TOGGLE != 0),
            4 => ClientFrame::Abort(object, abort_code_of(bytes)),
            _ => ClientFrame::Unsupported(object),
        })
    }
}

impl ServerFrame {
    /// The object it names.
    pub fn object(self) -> Option<ObjectAddress> {
        match self {
            ServerFrame::Reply(object, _)
            | ServerFrame::InitiateUpload(object, _)
            | ServerFrame::Abort(object, _) => Some(object),
            ServerFrame::Unsupported(_) => None,
        }
    }

    /// The frame's bytes.
    pub fn encode(self) -> SdoBytes {
        match self {
            ServerFrame::Reply(object, SdoReply::Uploaded(value)) => encode_value(2, object, value),
            ServerFrame::Reply(object, SdoReply::Downloaded) => with_object(3 << 5, object, [0; 4]),
            ServerFrame::InitiateUpload(object, size) => {
                with_object(2 << 5 | SIZE_INDICATED, object, size.to_le_bytes())
            }
            ServerFrame::Abort(object, code) => encode_abort(object, code),
            ServerFrame::Unsupported(command) => [command, 0, 0, 0, 0, 0, 0, 0],
        }
    }

    /// The meaning of `bytes`. `None` if there are not 8, or if they are a segment, which our client
    /// never requests.
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let bytes: &SdoBytes = bytes.try_into().ok()?;
        let (command, object) = (bytes[0], object_of(bytes));
        Some(match command >> 5 {
            0 | 1 => return None,
            2 if command & EXPEDITED != 0 => {
                ServerFrame::Reply(object, SdoReply::Uploaded(decode_value(bytes)?))
            }
            2 => ServerFrame::InitiateUpload(object, u32::from_le_bytes(data_of(bytes))),
            3 => ServerFrame::Reply(object, SdoReply::Downloaded),
            4 => ServerFrame::Abort(object, abort_code_of(bytes)),
            _ => ServerFrame::Unsupported(command),
        })
    }
}

/// Bit e of an initiate frame's command byte: the data is in this frame.
const EXPEDITED: u8 = 1 << 1;
/// Bit s of an initiate frame: the frame says how long the data is.
const SIZE_INDICATED: u8 = 1 << 0;
/// Bit t of a segment frame.
const TOGGLE: u8 = 1 << 4;
/// Bit c of a segment frame: no segment follows.
const LAST: u8 = 1 << 0;

fn toggle_bit(toggle: bool) -> u8 {
    if toggle { TOGGLE } else { 0 }
}

fn with_object(command: u8, object: ObjectAddress, data: [u8; 4]) -> SdoBytes {
    let [low, high] = object.index.to_le_bytes();
    let [a, b, c, d] = data;
    [command, low, high, object.subindex, a, b, c, d]
}

fn object_of(bytes: &SdoBytes) -> ObjectAddress {
    ObjectAddress::new(u16::from_le_bytes([bytes[1], bytes[2]]), bytes[3])
}

fn data_of(bytes: &SdoBytes) -> [u8; 4] {
    [bytes[4], bytes[5], bytes[6], bytes[7]]
}

fn encode_abort(object: ObjectAddress, code: AbortCode) -> SdoBytes {
    with_object(4 << 5, object, code.0.to_le_bytes())
}

fn abort_code_of(bytes: &SdoBytes) -> AbortCode {
    AbortCode(u32::from_le_bytes(data_of(bytes)))
}

fn encode_value(specifier: u8, object: ObjectAddress, value: SdoValue) -> SdoBytes {
    let unused = 4 - value.as_bytes().len() as u8;
    let command = specifier << 5 | unused << 2 | EXPEDITED | SIZE_INDICATED;
    with_object(command, object, value.to_u32().to_le_bytes())
}

/// The value in an expedited frame; four bytes when the sender gave no size.
fn decode_value(bytes: &SdoBytes) -> Option<SdoValue> {
    let sized = bytes[0] & SIZE_INDICATED != 0;
    let unused = if sized { usize::from(bytes[0] >> 2 & 3) } else { 0 };
    SdoValue::from_bytes(&bytes[4..8 - unused])
}

/// The next segment of `unsent`, the rest of an upload, and the data that remains after it.
pub(super) fn encode_segment(unsent: &[u8], toggle: bool) -> (SdoBytes, &[u8]) {
    let (data, remaining) = unsent.split_at(unsent.len().min(7));
    let unused = 7 - data.len() as u8;
    let last = if remaining.is_empty() { LAST } else { 0 };
    let mut bytes = [0; 8];
    bytes[0] = toggle_bit(toggle) | unused << 1 | last;
    bytes[1..=data.len()].copy_from_slice(data);
    (bytes, remaining)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const VENDOR: ObjectAddress = ObjectAddress::new(0x1018, 1);

    /// Do not edit: these bytes are from CiA 301.
    #[test]
    fn sdo_frames_have_the_bytes_of_cia_301() {
        let write = |object, value| ClientFrame::Request(SdoRequest::Download(object, value));
        let client = [
            (
                ClientFrame::Request(SdoRequest::Upload(VENDOR)),
                [0x40, 0x18, 0x10, 0x01, 0, 0, 0, 0],
            ),
            (
                write(ObjectAddress::new(0x1017, 0), 1000u16.into()),
                [0x2b, 0x17, 0x10, 0x00, 0xe8, 0x03, 0, 0],
            ),
            (
                write(ObjectAddress::new(0x6060, 0), 8_u8.into()),
                [0x2f, 0x60, 0x60, 0x00, 0x08, 0, 0, 0],
            ),
            (
                write(ObjectAddress::new(0x1400, 1), 0x8000_0205u32.into()),
                [0x23, 0x00, 0x14, 0x01, 0x05, 0x02, 0x00, 0x80],
            ),
            (ClientFrame::UploadSegment(false), [0x60, 0, 0, 0, 0, 0, 0, 0]),
            (ClientFrame::UploadSegment(true), [0x70, 0, 0, 0, 0, 0, 0, 0]),
            (
                ClientFrame::Abort(VENDOR, AbortCode::TIMEOUT),
                [0x80, 0x18, 0x10, 0x01, 0x00, 0x00, 0x04, 0x05],
            ),
        ];
        for (frame, bytes) in client {
            assert_eq!(frame.encode(), bytes, "{frame:?}");
            assert_eq!(ClientFrame::decode(&bytes), Some(frame));
        }
        let server = [
            (
                ServerFrame::Reply(VENDOR, SdoReply::Uploaded(0x0000_00fb_u32.into())),
                [0x43, 0x18, 0x10, 0x01, 0xfb, 0, 0, 0],
            ),
            (
                ServerFrame::InitiateUpload(ObjectAddress::new(0x1008, 0), 26),
                [0x41, 0x08, 0x10, 0x00, 26, 0, 0, 0],
            ),
            (
                ServerFrame::Reply(ObjectAddress::new(0x1017, 0), SdoReply::Downloaded),
                [0x60, 0x17, 0x10, 0, 0, 0, 0, 0],
            ),
            (
                ServerFrame::Abort(VENDOR, AbortCode::NO_SUCH_OBJECT),
                [0x80, 0x18, 0x10, 0x01, 0x00, 0x00, 0x02, 0x06],
            ),
        ];
        for (frame, bytes) in server {
            assert_eq!(frame.encode(), bytes, "{frame:?}");
            assert_eq!(ServerFrame::decode(&bytes), Some(frame));
        }
        let (first, rest) = encode_segment(b"0123456789", false);
        assert_eq!((first, rest), (*b"\x000123456", &b"789"[..]));
        assert_eq!(encode_segment(rest, true), (*b"\x19789\0\0\0\0", &b""[..]));
    }

    #[test]
    fn an_expedited_answer_without_size_has_four_bytes() {
        let decoded = ServerFrame::decode(&[0x42, 0x18, 0x10, 0x01, 1, 2, 3, 4]);
        let value = 0x0403_0201_u32.into();
        assert_eq!(decoded, Some(ServerFrame::Reply(VENDOR, SdoReply::Uploaded(value))));
    }

    proptest! {
        #[test]
        fn anything_decodes_without_panic_and_short_frames_to_nothing(
            bytes in proptest::collection::vec(any::<u8>(), 0..=8),
        ) {
            prop_assert_eq!(ClientFrame::decode(&bytes).is_some(), bytes.len() == 8);
            let is_segment = bytes.first().is_some_and(|command| command >> 5 < 2);
            let is_answer = bytes.len() == 8 && !is_segment;
            prop_assert_eq!(ServerFrame::decode(&bytes).is_some(), is_answer);
        }
    }
}
