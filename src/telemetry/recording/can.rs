//! Which CAN frames are worth a line in a viewer, and the lines.

use crate::canopen::Frame;
use crate::canopen::cia402::{DriveState, Statusword};
use crate::session::Direction;
use crate::stage::{Axis, PerAxis, StageConfig};
use std::collections::HashMap;
use std::fmt::{self, Write as _};

/// A line of the CAN log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Line {
    /// rerun's level.
    pub(super) level: &'static str,
    /// Direction, service, node and bytes of the frame.
    pub(super) text: String,
}

/// Chooses the frames that a viewer gets.
///
/// `can.log` has every frame. A viewer cannot show a hundred SYNCs a second, so of cyclic frames
/// (SYNC, PDO) it gets one of each identifier a step and those with another control- or statusword,
/// with the number of those left out; of heartbeats those with a new state, of all others every one.
#[derive(Debug)]
pub(super) struct Selection {
    nodes: PerAxis<u8>,
    states: PerAxis<Option<DriveState>>,
    cyclic: HashMap<u16, Cyclic>,
    heartbeat: HashMap<u16, u8>,
}

/// What was last shown of an identifier.
#[derive(Debug, Clone, Copy)]
struct Cyclic {
    step: u32,
    word: Option<u16>,
    left_out: u32,
}

impl Selection {
    /// Of the frames of this stage.
    pub(super) fn new(stage: &StageConfig) -> Self {
        Selection {
            nodes: PerAxis::from_fn(|axis| stage.axis(axis).node.get()),
            states: PerAxis::from_fn(|_| None),
            cyclic: HashMap::new(),
            heartbeat: HashMap::new(),
        }
    }

    /// The drive that enters another state with `frame`, its TPDO1, and the state.
    pub(super) fn entered(&mut self, frame: &Frame) -> Option<(Axis, DriveState)> {
        let (Service::Tpdo1, node) = service(frame) else { return None };
        let axis = Axis::BOTH.into_iter().find(|&axis| self.nodes[axis] == node)?;
        let state = Statusword(u16::from_le_bytes(*frame.data().first_chunk()?)).state()?;
        (self.states[axis].replace(state) != Some(state)).then_some((axis, state))
    }

    /// The line for `frame`, where it is worth one, during step `step`.
    pub(super) fn line(&mut self, step: u32, direction: Direction, frame: &Frame) -> Option<Line> {
        let (service, node) = service(frame);
        let mut left_out = 0;
        match frame.cob_id() {
            Some(id) if service.is_cyclic() => left_out = self.cyclic(id, step, frame)?,
            Some(id) if service == Service::Heartbeat => {
                let state = frame.data().first().copied().unwrap_or(u8::MAX);
                if self.heartbeat.insert(id, state) == Some(state) {
                    return None;
                }
            }
            _ => {}
        }
        let arrow = match direction {
            Direction::Sent => "→",
            Direction::Received => "←",
        };
        let mut text = format!("{arrow} {}", service.name());
        if node != 0 {
            let _ = write!(text, " node {node}");
        }
        if left_out > 0 {
            let _ = write!(text, " ({left_out} before it in can.log)");
        }
        let _ = write!(text, "  [{}#{}]", frame.id(), Hex(frame.data()));
        Some(Line { level: service.level(frame.data()), text })
    }

    /// How many of a cyclic frame's kind were left out before it; `None` where it is left out too.
    fn cyclic(&mut self, id: u16, step: u32, frame: &Frame) -> Option<u32> {
        let word = frame.data().first_chunk().map(|bytes| u16::from_le_bytes(*bytes));
        let shown = Cyclic { step, word, left_out: 0 };
        let Some(last) = self.cyclic.get_mut(&id) else {
            self.cyclic.insert(id, shown);
            return Some(0);
        };
        if (last.step, last.word) == (step, word) {
            last.left_out += 1;
            return None;
        }
        Some(std::mem::replace(last, shown).left_out)
    }
}

/// What a frame is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Service {
    Nmt,
    Sync,
    Time,
    Emergency,
    Tpdo1,
    Rpdo1,
    OtherPdo,
    SdoAnswer,
    SdoRequest,
    Heartbeat,
    Other,
}

/// The service of a frame by its identifier (CiA 301, 7.3.5: pre-defined connection set), and the
/// node; 0 where it is of none.
fn service(frame: &Frame) -> (Service, u8) {
    let Some(cob_id) = frame.cob_id() else { return (Service::Other, 0) };
    let node = (cob_id & 0x7F) as u8;
    let service = match (cob_id >> 7, node) {
        (0x0, 0) => Service::Nmt,
        (0x1, 0) => Service::Sync,
        (0x2, 0) => Service::Time,
        (_, 0) => Service::Other,
        (0x1, _) => Service::Emergency,
        (0x3, _) => Service::Tpdo1,
        (0x4, _) => Service::Rpdo1,
        (0x5..=0xA, _) => Service::OtherPdo,
        (0xB, _) => Service::SdoAnswer,
        (0xC, _) => Service::SdoRequest,
        (0xE, _) => Service::Heartbeat,
        _ => Service::Other,
    };
    (service, if service == Service::Other { 0 } else { node })
}

impl Service {
    /// Sent again and again, whether it says something new or not.
    fn is_cyclic(self) -> bool {
        matches!(self, Service::Sync | Service::Tpdo1 | Service::Rpdo1 | Service::OtherPdo)
    }

    fn name(self) -> &'static str {
        match self {
            Service::Nmt => "NMT",
            Service::Sync => "SYNC",
            Service::Time => "TIME",
            Service::Emergency => "EMCY",
            Service::Tpdo1 => "TPDO1",
            Service::Rpdo1 => "RPDO1",
            Service::OtherPdo => "PDO",
            Service::SdoAnswer => "SDO response",
            Service::SdoRequest => "SDO request",
            Service::Heartbeat => "heartbeat",
            Service::Other => "not in the pre-defined set",
        }
    }

    /// An emergency whose error code is 0 says that the error is gone; 0x80 is an SDO abort.
    fn level(self, data: &[u8]) -> &'static str {
        match (self, data) {
            (Service::Emergency, [0, 0, ..]) => "INFO",
            (Service::Emergency, _) => "ERROR",
            (Service::SdoAnswer | Service::SdoRequest, [0x80, ..]) | (Service::Other, _) => "WARN",
            (Service::SdoAnswer | Service::SdoRequest, _) => "DEBUG",
            (Service::Nmt | Service::Heartbeat, _) => "INFO",
            _ => "TRACE",
        }
    }
}

struct Hex<'a>(&'a [u8]);

impl fmt::Display for Hex<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (n, byte) in self.0.iter().enumerate() {
            if n > 0 {
                f.write_char(' ')?;
            }
            write!(f, "{byte:02X}")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::tests::run_info;

    #[test]
    fn of_what_repeats_itself_one_line_a_step_or_state() {
        let mut selection = Selection::new(&run_info().scene.stage);
        let mut shown = |step, cob_id, data: &[u8]| {
            selection.line(step, Direction::Received, &Frame::new(cob_id, data)).is_some()
        };
        assert!(shown(0, 0x080, &[]) && !shown(0, 0x080, &[]) && shown(1, 0x080, &[]));
        assert!(shown(1, 0x181, &[1, 0, 5]) && !shown(1, 0x181, &[1, 0, 6]));
        assert!(shown(1, 0x181, &[2, 0, 7]) && shown(1, 0x182, &[2, 0, 7]));
        assert!(shown(1, 0x701, &[5]) && !shown(2, 0x701, &[5]) && shown(2, 0x701, &[0]));
        assert!(shown(2, 0x581, &[0x60; 8]) && shown(2, 0x581, &[0x60; 8]));
    }

    #[test]
    fn a_line_has_service_node_bytes_and_what_was_left_out() {
        let mut selection = Selection::new(&run_info().scene.stage);
        let frame = Frame::new(0x181, &[0x37, 0x16, 1, 0, 0, 0]);
        let mut line = |step| selection.line(step, Direction::Received, &frame);
        let bytes = "[181#37 16 01 00 00 00]";
        assert_eq!(line(0).unwrap().text, format!("← TPDO1 node 1  {bytes}"));
        assert_eq!((line(0), line(0)), (None, None));
        let expected = format!("← TPDO1 node 1 (2 before it in can.log)  {bytes}");
        assert_eq!(line(1).unwrap().text, expected);
    }

    #[test]
    fn a_line_is_as_loud_as_what_it_says() {
        let mut selection = Selection::new(&run_info().scene.stage);
        let mut line = |cob_id, data: &[u8]| {
            let line = selection.line(0, Direction::Sent, &Frame::new(cob_id, data)).unwrap();
            format!("{} {}", line.level, line.text)
        };
        assert_eq!(line(0x000, &[1, 0]), "INFO → NMT  [000#01 00]");
        assert_eq!(line(0x080, &[]), "TRACE → SYNC  [080#]");
        assert_eq!(line(0x082, &[0x11, 0x86]), "ERROR → EMCY node 2  [082#11 86]");
        assert_eq!(line(0x082, &[0, 0]), "INFO → EMCY node 2  [082#00 00]");
        assert_eq!(line(0x601, &[0x40]), "DEBUG → SDO request node 1  [601#40]");
        assert_eq!(line(0x581, &[0x80]), "WARN → SDO response node 1  [581#80]");
        assert_eq!(line(0x501, &[]), "TRACE → PDO node 1  [501#]");
        assert_eq!(line(0x701, &[5]), "INFO → heartbeat node 1  [701#05]");
        assert_eq!(line(0x7E5, &[0]), "WARN → not in the pre-defined set  [7E5#00]");
    }

    #[test]
    fn a_drive_that_enters_another_state_is_noticed_once() {
        let mut selection = Selection::new(&run_info().scene.stage);
        let mut entered = |cob_id, data: &[u8]| selection.entered(&Frame::new(cob_id, data));
        let enabled = Some((Axis::Insertion, DriveState::OperationEnabled));
        assert_eq!(entered(0x181, &[0x37, 0x16, 0, 0, 0, 0]), enabled);
        assert_eq!(entered(0x181, &[0x37, 0x16, 9, 0, 0, 0]), None);
        assert_eq!(entered(0x183, &[0x37, 0x16, 0, 0, 0, 0]), None, "no drive of the stage");
        assert_eq!(entered(0x181, &[0x37]), None, "too short");
    }
}
