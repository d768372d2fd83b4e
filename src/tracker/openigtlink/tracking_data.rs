//! TDATA and QTDATA: several tools in one message, and the requests that start and stop such a
//! stream.
//!
//! A server of TDATA sends nothing before it is asked to (STT_TDATA); STP_TDATA ends it. QTDATA is
//! the same with quaternions in place of matrices.
//!
//! Source: the specification's tables; `igtl_tdata.h` and `igtl_qtdata.h` of the reference library.

use super::header::{padded, text};

const NAME_LEN: usize = super::header::NAME_LEN;
const COORDINATES_LEN: usize = 32;
/// Name, kind, a reserved byte.
const TOOL_HEAD_LEN: usize = NAME_LEN + 2;

/// One tool of a TDATA or QTDATA message.
///
/// In TDATA `N` is 12, the numbers of a [TRANSFORM](super::Body::Transform). In QTDATA it is 7: the
/// position in mm, then the quaternion x, y, z, w.
#[derive(Debug, Clone, PartialEq)]
pub struct Tool<const N: usize> {
    /// The tool's name, 20 bytes at most; 19 are sent, and a zero, since the reference library takes
    /// a name without one for none.
    pub name: String,
    /// What is known of it.
    pub kind: ToolKind,
    /// Its pose.
    pub pose: [f32; N],
}

/// What a tool's pose says, as its kind defines it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ToolKind {
    /// 1: the tracker itself.
    Tracker,
    /// 2: position and orientation.
    SixD,
    /// 3: the position of the tip alone; its orientation means nothing.
    ThreeD,
    /// 4: tip and axis; the turn about the axis means nothing.
    FiveD,
    /// Another code.
    Unknown(u8),
}

impl ToolKind {
    fn from_code(code: u8) -> Self {
        match code {
            1 => ToolKind::Tracker,
            2 => ToolKind::SixD,
            3 => ToolKind::ThreeD,
            4 => ToolKind::FiveD,
            code => ToolKind::Unknown(code),
        }
    }

    fn code(self) -> u8 {
        match self {
            ToolKind::Tracker => 1,
            ToolKind::SixD => 2,
            ToolKind::ThreeD => 3,
            ToolKind::FiveD => 4,
            ToolKind::Unknown(code) => code,
        }
    }
}

/// A stream of tools that a server sends once it is asked to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ToolStream {
    /// TDATA, with matrices.
    Tdata,
    /// QTDATA, with quaternions.
    Qtdata,
}

/// STT_TDATA or STT_QTDATA: asks a server to begin.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StartStream {
    /// Which stream.
    pub stream: ToolStream,
    /// Shortest time between two messages, ms; 0 is as fast as the server can.
    pub period_ms: i32,
    /// The coordinate system to send in; empty for the server's own. 32 bytes at most are sent.
    pub coordinates: String,
}

/// The tools of a TDATA (`N` = 12) or QTDATA (7) message; none if its length is no multiple of a
/// tool's.
pub(super) fn tools<const N: usize>(content: &[u8]) -> Option<Vec<Tool<N>>> {
    let chunks = content.chunks_exact(TOOL_HEAD_LEN + 4 * N);
    if !chunks.remainder().is_empty() {
        return None;
    }
    chunks.map(tool).collect()
}

fn tool<const N: usize>(bytes: &[u8]) -> Option<Tool<N>> {
    let (name, rest) = bytes.split_first_chunk::<NAME_LEN>()?;
    let ([kind, _reserved], numbers) = rest.split_first_chunk()?;
    let pose = super::body::floats(numbers)?;
    Some(Tool { name: text(name), kind: ToolKind::from_code(*kind), pose })
}

pub(super) fn put_tools<const N: usize>(tools: &[Tool<N>], out: &mut Vec<u8>) {
    for tool in tools {
        out.extend_from_slice(&padded::<{ NAME_LEN - 1 }>(&tool.name));
        out.extend_from_slice(&[0, tool.kind.code(), 0]);
        out.extend(tool.pose.iter().flat_map(|number| number.to_be_bytes()));
    }
}

/// The content of an STT message; none if it is not 36 bytes long.
pub(super) fn start(stream: ToolStream, content: &[u8]) -> Option<StartStream> {
    let (period_ms, coordinates) = content.split_first_chunk()?;
    let coordinates: &[u8; COORDINATES_LEN] = coordinates.try_into().ok()?;
    Some(StartStream {
        stream,
        period_ms: i32::from_be_bytes(*period_ms),
        coordinates: text(coordinates),
    })
}

pub(super) fn put_start(start: &StartStream, out: &mut Vec<u8>) {
    out.extend_from_slice(&start.period_ms.to_be_bytes());
    out.extend_from_slice(&padded::<COORDINATES_LEN>(&start.coordinates));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tools_come_whole_or_not_at_all() {
        let sent: Vec<Tool<7>> = [ToolKind::SixD, ToolKind::ThreeD, ToolKind::Unknown(9)]
            .into_iter()
            .map(|kind| Tool { name: format!("{kind:?}"), kind, pose: [1.0; 7] })
            .collect();
        let mut bytes = Vec::new();
        put_tools(&sent, &mut bytes);
        assert_eq!(bytes.len(), 3 * 50);
        assert_eq!(tools(&bytes), Some(sent));
        assert_eq!(tools::<7>(&[]), Some(Vec::new()));
        for len in [1, 49, 51, 149] {
            assert_eq!(tools::<7>(&bytes[..len]), None, "{len} bytes");
        }
    }

    #[test]
    fn a_name_of_20_bytes_is_read_and_sent_with_a_zero_at_its_end() {
        let name = "ReferenceToTrackerBa".to_owned();
        let sent = Tool { name: name.clone(), kind: ToolKind::SixD, pose: [0.0; 7] };
        let mut bytes = Vec::new();
        put_tools(&[sent], &mut bytes);
        assert_eq!(bytes[..22], *b"ReferenceToTrackerB\0\x02\0");
        bytes[19] = b'a';
        assert_eq!(
            tools::<7>(&bytes).and_then(|tools| Some(tools.first()?.name.clone())),
            Some(name)
        );
    }

    #[test]
    fn a_start_is_36_bytes() {
        let sent = StartStream {
            stream: ToolStream::Tdata,
            period_ms: 25,
            coordinates: "Patient".to_owned(),
        };
        let mut bytes = Vec::new();
        put_start(&sent, &mut bytes);
        assert_eq!(bytes.len(), 36);
        assert_eq!(start(ToolStream::Tdata, &bytes), Some(sent));
        assert_eq!(start(ToolStream::Tdata, &bytes[..35]), None);
        assert_eq!(start(ToolStream::Tdata, &[0; 37]), None);
    }
}
