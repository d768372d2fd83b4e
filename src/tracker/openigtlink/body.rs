//! The contents of the message types that the bench reads and writes.
//!
//! TDATA and QTDATA hold several tools, with matrices or quaternions. A server sends them only after a
//! request (STT_TDATA, STT_QTDATA), until another one ends the stream (STP_…).
//!
//! Source: the specification's tables; `igtl_tdata.h` and `igtl_qtdata.h` of the reference library.

use super::header::{DEVICE_NAME_LEN, padded, text};
use super::message::packet;

/// Bytes of the name of a coordinate system; zeros ask for the server's own.
const COORDINATES_LEN: usize = 32;
/// Name, kind, a reserved byte.
const TOOL_HEAD_LEN: usize = DEVICE_NAME_LEN + 2;

/// One tool of a TDATA or QTDATA message.
///
/// In TDATA `N` is 12, the numbers of a [TRANSFORM](super::Body::Transform). In QTDATA it is 7: the
/// position in mm, then the quaternion x, y, z, w.
#[derive(Debug, Clone, PartialEq)]
pub struct Tool<const N: usize> {
    /// The tool's name, at most 20 bytes. At most 19 are sent, and a zero, since the reference library
    /// reads a name without a zero as empty.
    pub name: String,
    /// The kind of its pose: a [`tool_kind`].
    pub kind: u8,
    /// Its pose.
    pub pose: [f32; N],
}

/// The kinds of a tool's pose. Other codes are kept.
pub mod tool_kind {
    /// The tracker itself.
    pub const TRACKER: u8 = 1;
    /// Position and orientation.
    pub const SIX_D: u8 = 2;
    /// The position of the tip alone; its orientation means nothing.
    pub const THREE_D: u8 = 3;
    /// Tip and axis; the turn about the axis means nothing.
    pub const FIVE_D: u8 = 4;
}

/// A stream of tools that a server sends once it is asked to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ToolStream {
    /// TDATA, with matrices, or QTDATA, with quaternions.
    pub name: &'static str,
    /// Shortest time between two messages, ms; 0 is as fast as the server can.
    pub period_ms: i32,
}

impl ToolStream {
    /// The message that asks a server to begin, in its own coordinate system.
    pub fn start(&self) -> Vec<u8> {
        let content = [&self.period_ms.to_be_bytes()[..], &[0; COORDINATES_LEN]].concat();
        packet(1, &format!("STT_{}", self.name), "", None, &content)
    }

    /// The message that asks it to stop.
    pub fn stop(&self) -> Vec<u8> {
        packet(1, &format!("STP_{}", self.name), "", None, &[])
    }
}

/// The content of a message.
#[derive(Debug, Clone, PartialEq)]
pub enum Body {
    /// TRANSFORM: the pose of a tool. The upper three rows of the homogeneous matrix, column
    /// after column: R11 R21 R31 R12 … R33, then the position in mm.
    Transform([f32; 12]),
    /// POSITION (also sent as QTRANS): a position and, in most forms, a quaternion.
    Position {
        /// Position, mm.
        position_mm: [f32; 3],
        /// Orientation, in the form it was sent.
        quaternion: Quaternion,
    },
    /// TDATA: the poses of several tools, as matrices.
    TrackingData(Vec<Tool<12>>),
    /// QTDATA: the poses of several tools, as quaternions.
    QuaternionTrackingData(Vec<Tool<7>>),
    /// STATUS: the state of the device.
    Status(Status),
    /// A type that the bench does not read, by its name. Its content is skipped. When sent, it has no
    /// content, like requests (`GET_…`).
    Other(String),
}

/// The three forms of a POSITION's orientation, in the order x, y, z, w.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Quaternion {
    /// The 12-byte form: no orientation.
    Absent,
    /// The 24-byte form: x, y, z of a unit quaternion with w ≥ 0.
    Imaginary([f32; 3]),
    /// The 28-byte form.
    Full([f32; 4]),
}

/// A STATUS message's content.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Status {
    /// The protocol's status code: 1 is OK, 0 invalid, 2 an unknown error, 13 device not ready,
    /// others as in its table. Unknown codes are kept.
    pub code: u16,
    /// A code that the device defines.
    pub subcode: i64,
    /// The error's name; 20 bytes at most are sent.
    pub error_name: String,
    /// A message for people.
    pub message: String,
}

impl Status {
    /// The code of a device without a fault.
    pub const OK: u16 = 1;
}

const STATUS_NAME_LEN: usize = 20;

/// True for the types whose content is decoded.
pub(super) fn is_read(message_type: &[u8]) -> bool {
    !matches!(Body::decode(message_type, &[]), Ok(Body::Other(_)))
}

impl Body {
    /// The type's name in the header.
    pub fn type_name(&self) -> &str {
        match self {
            Body::Transform(_) => "TRANSFORM",
            Body::Position { .. } => "POSITION",
            Body::TrackingData(_) => "TDATA",
            Body::QuaternionTrackingData(_) => "QTDATA",
            Body::Status(_) => "STATUS",
            Body::Other(name) => name,
        }
    }

    pub(super) fn decode(message_type: &[u8], content: &[u8]) -> Result<Self, String> {
        let (body, expected) = match message_type {
            b"TRANSFORM" => (floats(content).map(Body::Transform), "48"),
            b"POSITION" | b"QTRANS" => (decode_position(content), "12, 24 or 28"),
            b"TDATA" => (decode_tools(content).map(Body::TrackingData), "a multiple of 70"),
            b"QTDATA" => {
                (decode_tools(content).map(Body::QuaternionTrackingData), "a multiple of 50")
            }
            b"STATUS" => (decode_status(content).map(Body::Status), "30 or more"),
            _ => (Some(Body::Other(text(message_type))), ""),
        };
        body.ok_or_else(|| format!("content of {} bytes ({expected} expected)", content.len()))
    }

    pub(super) fn encode(&self) -> Vec<u8> {
        match self {
            Body::Transform(elements) => bytes(elements),
            Body::Position { position_mm, quaternion } => {
                let orientation: &[f32] = match quaternion {
                    Quaternion::Absent => &[],
                    Quaternion::Imaginary(xyz) => xyz,
                    Quaternion::Full(xyzw) => xyzw,
                };
                bytes(&[position_mm, orientation].concat())
            }
            Body::TrackingData(tools) => encode_tools(tools),
            Body::QuaternionTrackingData(tools) => encode_tools(tools),
            Body::Status(Status { code, subcode, error_name, message }) => [
                &code.to_be_bytes()[..],
                &subcode.to_be_bytes(),
                &padded::<STATUS_NAME_LEN>(error_name),
                message.as_bytes(),
                &[0],
            ]
            .concat(),
            Body::Other(_) => Vec::new(),
        }
    }
}

fn bytes(floats: &[f32]) -> Vec<u8> {
    floats.iter().flat_map(|value| value.to_be_bytes()).collect()
}

/// Exactly `N` floats; `None` if there are more or fewer.
fn floats<const N: usize>(bytes: &[u8]) -> Option<[f32; N]> {
    let (chunks, rest) = bytes.as_chunks::<4>();
    let chunks: &[[u8; 4]; N] = chunks.try_into().ok()?;
    rest.is_empty().then(|| chunks.map(f32::from_be_bytes))
}

/// The tools of a TDATA (`N` = 12) or QTDATA (7) message; `None` if its length is not a multiple of a
/// tool's.
fn decode_tools<const N: usize>(content: &[u8]) -> Option<Vec<Tool<N>>> {
    let chunks = content.chunks_exact(TOOL_HEAD_LEN + 4 * N);
    if !chunks.remainder().is_empty() {
        return None;
    }
    chunks.map(decode_tool).collect()
}

fn decode_tool<const N: usize>(bytes: &[u8]) -> Option<Tool<N>> {
    let (name, rest) = bytes.split_first_chunk::<DEVICE_NAME_LEN>()?;
    let ([kind, _reserved], numbers) = rest.split_first_chunk()?;
    let pose = floats(numbers)?;
    Some(Tool { name: text(name), kind: *kind, pose })
}

fn encode_tools<const N: usize>(tools: &[Tool<N>]) -> Vec<u8> {
    let tool = |tool: &Tool<N>| {
        let name = padded::<{ DEVICE_NAME_LEN - 1 }>(&tool.name);
        [&name[..], &[0, tool.kind, 0], &bytes(&tool.pose)].concat()
    };
    tools.iter().flat_map(tool).collect()
}

fn decode_position(content: &[u8]) -> Option<Body> {
    let (position, rest) = content.split_at_checked(12)?;
    let quaternion = match rest.len() {
        0 => Quaternion::Absent,
        12 => Quaternion::Imaginary(floats(rest)?),
        _ => Quaternion::Full(floats(rest)?),
    };
    Some(Body::Position { position_mm: floats(position)?, quaternion })
}

fn decode_status(content: &[u8]) -> Option<Status> {
    let (code, rest) = content.split_first_chunk()?;
    let (subcode, rest) = rest.split_first_chunk()?;
    let (error_name, message) = rest.split_first_chunk::<STATUS_NAME_LEN>()?;
    Some(Status {
        code: u16::from_be_bytes(*code),
        subcode: i64::from_be_bytes(*subcode),
        error_name: text(error_name),
        message: text(message),
    })
}

#[cfg(test)]
mod tests {
    use super::super::header::TEXT_MAX;
    use super::*;

    #[test]
    fn a_position_is_decoded_by_its_length() {
        let bytes: Vec<u8> = (1..=7).flat_map(|i| (i as f32).to_be_bytes()).collect();
        let quaternion = |len: usize| match Body::decode(b"POSITION", &bytes[..len]) {
            Ok(Body::Position { position_mm: [1.0, 2.0, 3.0], quaternion }) => Ok(quaternion),
            other => Err(other),
        };
        assert_eq!(quaternion(12), Ok(Quaternion::Absent));
        assert_eq!(quaternion(24), Ok(Quaternion::Imaginary([4.0, 5.0, 6.0])));
        assert_eq!(quaternion(28), Ok(Quaternion::Full([4.0, 5.0, 6.0, 7.0])));
        for len in [0, 11, 13, 20, 25, 27] {
            let refused = format!("content of {len} bytes (12, 24 or 28 expected)");
            assert_eq!(quaternion(len), Err(Err(refused)));
        }
    }

    #[test]
    fn a_status_needs_its_fixed_part_only() {
        let status = |len| Body::decode(b"STATUS", &[0; 64][..len]);
        assert_eq!(status(29), Err("content of 29 bytes (30 or more expected)".to_owned()));
        assert!(matches!(status(30), Ok(Body::Status(s)) if s.message.is_empty()));
    }

    #[test]
    fn a_long_status_is_cut() {
        let content = [&[0; 30][..], &[b'x'; 100_000]].concat();
        let Ok(Body::Status(status)) = Body::decode(b"STATUS", &content) else {
            panic!("a status")
        };
        assert_eq!(status.message.chars().count(), TEXT_MAX);
    }

    #[test]
    fn tools_are_decoded_whole_or_refused() {
        let sent = [tool_kind::SIX_D, tool_kind::THREE_D, 9];
        let sent =
            sent.map(|kind| Tool { name: format!("Tool{kind}"), kind, pose: [1.0; 7] }).to_vec();
        let bytes = encode_tools(&sent);
        assert_eq!(bytes.len(), 3 * 50);
        assert_eq!(decode_tools(&bytes), Some(sent));
        assert_eq!(decode_tools::<7>(&[]), Some(Vec::new()));
        for len in [1, 49, 51, 149] {
            assert_eq!(decode_tools::<7>(&bytes[..len]), None, "{len} bytes");
        }
    }

    #[test]
    fn a_name_of_20_bytes_is_read_and_sent_with_a_zero_at_its_end() {
        let name = "ReferenceToTrackerBa".to_owned();
        let sent = Tool { name: name.clone(), kind: tool_kind::SIX_D, pose: [0.0; 7] };
        let mut bytes = encode_tools(&[sent]);
        assert_eq!(bytes[..22], *b"ReferenceToTrackerB\0\x02\0");
        bytes[19] = b'a';
        assert_eq!(
            decode_tools::<7>(&bytes).and_then(|tools| Some(tools.first()?.name.clone())),
            Some(name)
        );
    }

    #[test]
    fn a_start_request_has_36_bytes_of_content() {
        let stream = ToolStream { name: "QTDATA", period_ms: 25 };
        let bytes = stream.start();
        assert_eq!(bytes.len(), 58 + 36);
        assert_eq!(bytes[2..14], *b"STT_QTDATA\0\0");
        assert_eq!(bytes[58..64], [0, 0, 0, 25, 0, 0]);
        assert_eq!(stream.stop()[..14], *b"\0\x01STP_QTDATA\0\0");
    }
}
