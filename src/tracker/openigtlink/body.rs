//! The contents of the message types that the bench reads and writes.

use super::header::{padded, text};
use super::tracking_data::{self, StartStream, Tool, ToolStream};

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
    /// STT_TDATA or STT_QTDATA: asks a server to send that stream.
    Start(StartStream),
    /// STP_TDATA or STP_QTDATA: asks a server to stop that stream.
    Stop(ToolStream),
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
    matches!(
        message_type,
        b"TRANSFORM"
            | b"POSITION"
            | b"QTRANS"
            | b"STATUS"
            | b"TDATA"
            | b"QTDATA"
            | b"STT_TDATA"
            | b"STT_QTDATA"
            | b"STP_TDATA"
            | b"STP_QTDATA"
    )
}

impl Body {
    /// The type's name in the header.
    pub fn type_name(&self) -> &str {
        match self {
            Body::Transform(_) => "TRANSFORM",
            Body::Position { .. } => "POSITION",
            Body::TrackingData(_) => "TDATA",
            Body::QuaternionTrackingData(_) => "QTDATA",
            Body::Start(StartStream { stream: ToolStream::Tdata, .. }) => "STT_TDATA",
            Body::Start(StartStream { stream: ToolStream::Qtdata, .. }) => "STT_QTDATA",
            Body::Stop(ToolStream::Tdata) => "STP_TDATA",
            Body::Stop(ToolStream::Qtdata) => "STP_QTDATA",
            Body::Status(_) => "STATUS",
            Body::Other(name) => name,
        }
    }

    pub(super) fn decode(message_type: &[u8], content: &[u8]) -> Result<Self, String> {
        let length = |expected| format!("content of {} bytes ({expected} expected)", content.len());
        let start =
            |stream| tracking_data::start(stream, content).map(Body::Start).ok_or(length("36"));
        let stop = |stream| content.is_empty().then_some(Body::Stop(stream)).ok_or(length("none"));
        match message_type {
            b"TRANSFORM" => floats(content).map(Body::Transform).ok_or(length("48")),
            b"POSITION" | b"QTRANS" => position(content).ok_or(length("12, 24 or 28")),
            b"TDATA" => tracking_data::tools(content)
                .map(Body::TrackingData)
                .ok_or(length("a multiple of 70")),
            b"QTDATA" => tracking_data::tools(content)
                .map(Body::QuaternionTrackingData)
                .ok_or(length("a multiple of 50")),
            b"STT_TDATA" => start(ToolStream::Tdata),
            b"STT_QTDATA" => start(ToolStream::Qtdata),
            b"STP_TDATA" => stop(ToolStream::Tdata),
            b"STP_QTDATA" => stop(ToolStream::Qtdata),
            b"STATUS" => status(content).map(Body::Status).ok_or(length("30 or more")),
            _ => Ok(Body::Other(text(message_type))),
        }
    }

    pub(super) fn encode(&self, out: &mut Vec<u8>) {
        let mut put = |floats: &[f32]| {
            out.extend(floats.iter().flat_map(|value| value.to_be_bytes()));
        };
        match self {
            Body::Transform(elements) => put(elements),
            Body::Position { position_mm, quaternion } => {
                put(position_mm);
                match quaternion {
                    Quaternion::Absent => {}
                    Quaternion::Imaginary(xyz) => put(xyz),
                    Quaternion::Full(xyzw) => put(xyzw),
                }
            }
            Body::TrackingData(tools) => tracking_data::put_tools(tools, out),
            Body::QuaternionTrackingData(tools) => tracking_data::put_tools(tools, out),
            Body::Start(start) => tracking_data::put_start(start, out),
            Body::Status(status) => {
                out.extend_from_slice(&status.code.to_be_bytes());
                out.extend_from_slice(&status.subcode.to_be_bytes());
                out.extend_from_slice(&padded::<STATUS_NAME_LEN>(&status.error_name));
                out.extend_from_slice(status.message.as_bytes());
                out.push(0);
            }
            Body::Stop(_) | Body::Other(_) => {}
        }
    }
}

/// Exactly `N` floats; `None` if there are more or fewer.
pub(super) fn floats<const N: usize>(bytes: &[u8]) -> Option<[f32; N]> {
    let (chunks, rest) = bytes.as_chunks::<4>();
    let chunks: &[[u8; 4]; N] = chunks.try_into().ok()?;
    rest.is_empty().then(|| chunks.map(f32::from_be_bytes))
}

fn position(content: &[u8]) -> Option<Body> {
    let (position, rest) = content.split_at_checked(12)?;
    let quaternion = match rest.len() {
        0 => Quaternion::Absent,
        12 => Quaternion::Imaginary(floats(rest)?),
        _ => Quaternion::Full(floats(rest)?),
    };
    Some(Body::Position { position_mm: floats(position)?, quaternion })
}

fn status(content: &[u8]) -> Option<Status> {
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
    use super::*;

    #[test]
    fn each_length_of_a_position_has_its_form() {
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
}
