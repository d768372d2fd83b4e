//! CAN frames in words, and which of them are worth a line in a viewer.

use crate::canopen::Frame;
use crate::session::Direction;
use std::collections::HashMap;
use std::fmt::{self, Write as _};

/// What a frame is for, by its function code (CiA 301, 7.3.5: pre-defined connection set).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Service {
    Nmt,
    Sync,
    Time,
    Emergency(u8),
    /// Transmit PDO (from the drive) 1 to 4 of a node.
    Tpdo(u8, u8),
    /// Receive PDO (to the drive) 1 to 4 of a node.
    Rpdo(u8, u8),
    SdoAnswer(u8),
    SdoRequest(u8),
    Heartbeat(u8),
    Other,
}

impl Service {
    fn of(frame: &Frame) -> Self {
        let Some(cob_id) = frame.cob_id() else { return Service::Other };
        let node = (cob_id & 0x7F) as u8;
        match (cob_id >> 7, node) {
            (0x0, 0) => Service::Nmt,
            (0x1, 0) => Service::Sync,
            (0x2, 0) => Service::Time,
            (_, 0) => Service::Other,
            (0x1, _) => Service::Emergency(node),
            (0xB, _) => Service::SdoAnswer(node),
            (0xC, _) => Service::SdoRequest(node),
            (0xE, _) => Service::Heartbeat(node),
            (code @ 0x3..=0xA, _) if code % 2 == 1 => Service::Tpdo((code as u8 - 1) / 2, node),
            (code @ 0x3..=0xA, _) => Service::Rpdo((code as u8 - 2) / 2, node),
            _ => Service::Other,
        }
    }

    /// Sent again and again, whether it says something new or not.
    fn is_cyclic(self) -> bool {
        matches!(self, Service::Sync | Service::Tpdo(..) | Service::Rpdo(..))
    }
}

/// A line of the CAN log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Line {
    /// How loud.
    pub(super) level: &'static str,
    /// The frame in words and in bytes.
    pub(super) text: String,
}

/// Chooses the frames that a viewer gets.
///
/// `can.log` has every frame. A viewer cannot show a hundred SYNCs a second, so of cyclic frames
/// (SYNC, PDO) it gets one of each identifier a step, of heartbeats those with a new state, and of
/// all others every one.
#[derive(Debug, Default)]
pub(super) struct Selection {
    cyclic_shown_at: HashMap<u16, u32>,
    heartbeat: HashMap<u16, u8>,
}

impl Selection {
    /// The line for `frame`, where it is worth one, during step `step`.
    pub(super) fn line(&mut self, step: u32, direction: Direction, frame: &Frame) -> Option<Line> {
        let service = Service::of(frame);
        let repeats = match (frame.cob_id(), service) {
            (Some(id), service) if service.is_cyclic() => {
                self.cyclic_shown_at.insert(id, step) == Some(step)
            }
            (Some(id), Service::Heartbeat(_)) => {
                let state = frame.data().first().copied().unwrap_or(u8::MAX);
                self.heartbeat.insert(id, state) == Some(state)
            }
            _ => false,
        };
        (!repeats).then(|| describe(service, direction, frame))
    }
}

fn describe(service: Service, direction: Direction, frame: &Frame) -> Line {
    let arrow = match direction {
        Direction::Sent => "→",
        Direction::Received => "←",
    };
    let data = frame.data();
    let hex = Hex(data);
    let line = |level, words: String| Line {
        level,
        text: format!("{arrow} {:<34} {}#{hex}", words, frame.id()),
    };
    match service {
        Service::Nmt => line("INFO", nmt(data)),
        Service::Sync => line("TRACE", "SYNC".to_owned()),
        Service::Time => line("TRACE", "TIME".to_owned()),
        Service::Emergency(node) => line(emergency_level(data), emergency(node, data)),
        Service::Tpdo(n, node) => line("TRACE", format!("TPDO{n} node {node}")),
        Service::Rpdo(n, node) => line("TRACE", format!("RPDO{n} node {node}")),
        Service::SdoAnswer(node) => line(sdo_level(data), sdo(node, data, false)),
        Service::SdoRequest(node) => line(sdo_level(data), sdo(node, data, true)),
        Service::Heartbeat(node) => line("INFO", heartbeat(node, data)),
        Service::Other => line("WARN", "not of the pre-defined set".to_owned()),
    }
}

/// NMT commands (CiA 301, 7.2.8.3.1).
fn nmt(data: &[u8]) -> String {
    let &[command, node, ..] = data else { return "NMT, too short".to_owned() };
    let command = match command {
        0x01 => "start".to_owned(),
        0x02 => "stop".to_owned(),
        0x80 => "enter pre-operational".to_owned(),
        0x81 => "reset node".to_owned(),
        0x82 => "reset communication".to_owned(),
        unknown => format!("command {unknown:#04x}"),
    };
    if node == 0 { format!("NMT {command}, all") } else { format!("NMT {command}, node {node}") }
}

/// NMT states in heartbeats (CiA 301, 7.2.8.3.2.2).
fn heartbeat(node: u8, data: &[u8]) -> String {
    let state = match data.first().copied() {
        Some(0x00) => "boot-up".to_owned(),
        Some(0x04) => "stopped".to_owned(),
        Some(0x05) => "operational".to_owned(),
        Some(0x7F) => "pre-operational".to_owned(),
        Some(unknown) => format!("state {unknown:#04x}"),
        None => "without a state".to_owned(),
    };
    format!("heartbeat node {node}: {state}")
}

/// Emergencies (CiA 301, 7.2.7): error code 0 says that the error is gone.
fn emergency(node: u8, data: &[u8]) -> String {
    match data {
        [low, high, register, ..] => {
            let code = u16::from_le_bytes([*low, *high]);
            format!("EMCY node {node}: {code:04X}h, register {register:02X}h")
        }
        _ => format!("EMCY node {node}, too short"),
    }
}

fn emergency_level(data: &[u8]) -> &'static str {
    if data.starts_with(&[0, 0]) { "INFO" } else { "ERROR" }
}

/// SDO transfers (CiA 301, 7.2.4.3): object, direction and kind.
fn sdo(node: u8, data: &[u8], request: bool) -> String {
    let &[command, low, high, sub, ..] = data else { return format!("SDO node {node}, too short") };
    let object = format!("{:04X}:{sub:02X}", u16::from_le_bytes([low, high]));
    let what = match (command >> 5, request) {
        (1, true) => format!("write {object}"),
        (3, false) => format!("{object} written"),
        (2, true) => format!("read {object}"),
        (2, false) => format!("{object} read"),
        (4, _) => format!("abort {object}"),
        (0, _) | (1, false) | (3, true) => "segment".to_owned(),
        _ => format!("command {command:02X}h"),
    };
    format!("SDO node {node}: {what}")
}

fn sdo_level(data: &[u8]) -> &'static str {
    if data.first() == Some(&0x80) { "WARN" } else { "DEBUG" }
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
    use crate::canopen::CanId;

    fn words(cob_id: u16, data: &[u8]) -> String {
        let frame = Frame::new(cob_id, data);
        let line = describe(Service::of(&frame), Direction::Sent, &frame);
        let text = line.text.trim_start_matches("→ ");
        format!("{} {}", line.level, text.split("  ").next().unwrap_or(text))
    }

    #[test]
    fn frames_in_words() {
        assert_eq!(words(0x000, &[0x01, 0]), "INFO NMT start, all");
        assert_eq!(words(0x000, &[0x80, 2]), "INFO NMT enter pre-operational, node 2");
        assert_eq!(words(0x080, &[]), "TRACE SYNC");
        assert_eq!(words(0x181, &[0; 6]), "TRACE TPDO1 node 1");
        assert_eq!(words(0x202, &[0; 6]), "TRACE RPDO1 node 2");
        assert_eq!(words(0x481, &[]), "TRACE TPDO4 node 1");
        assert_eq!(words(0x501, &[]), "TRACE RPDO4 node 1");
        assert_eq!(
            words(0x601, &[0x2F, 0x60, 0x60, 0, 8, 0, 0, 0]),
            "DEBUG SDO node 1: write 6060:00"
        );
        assert_eq!(
            words(0x581, &[0x80, 0x18, 0x10, 1, 0, 0, 2, 6]),
            "WARN SDO node 1: abort 1018:01"
        );
        assert_eq!(
            words(0x082, &[0x11, 0x86, 0x20, 0, 0, 0, 0, 0]),
            "ERROR EMCY node 2: 8611h, register 20h"
        );
        assert_eq!(words(0x701, &[0x7F]), "INFO heartbeat node 1: pre-operational");
        assert_eq!(words(0x7E5, &[0]), "WARN not of the pre-defined set");
    }

    #[test]
    fn short_and_foreign_frames_have_words_too() {
        for cob_id in 0..=0x7FF {
            assert!(!words(cob_id, &[]).is_empty());
        }
        let extended = Frame::from_parts(CanId::Extended(0x1234), true, &[]).unwrap();
        assert_eq!(Service::of(&extended), Service::Other);
    }

    #[test]
    fn of_what_repeats_itself_one_line_a_step_or_state() {
        let mut selection = Selection::default();
        let mut shown = |step, cob_id, data: &[u8]| {
            selection.line(step, Direction::Received, &Frame::new(cob_id, data)).is_some()
        };
        assert!(shown(0, 0x080, &[]) && !shown(0, 0x080, &[]) && shown(1, 0x080, &[]));
        assert!(shown(1, 0x181, &[1]) && shown(1, 0x182, &[1]) && !shown(1, 0x181, &[2]));
        assert!(shown(1, 0x701, &[5]) && !shown(2, 0x701, &[5]) && shown(2, 0x701, &[0]));
        assert!(shown(2, 0x581, &[0x60; 8]) && shown(2, 0x581, &[0x60; 8]));
    }
}
