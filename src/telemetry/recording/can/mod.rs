//! Which CAN frames are worth a line in a viewer, and the lines.

mod drives;
mod service;
mod words;

use self::drives::Drives;
use self::service::Service;
use self::words::describe;
use crate::canopen::Frame;
use crate::canopen::cia402::DriveState;
use crate::session::{Direction, StageRecord};
use crate::stage::{Axis, StageConfig};
use std::collections::HashMap;
use std::fmt::{self, Write as _};

/// A line of the CAN log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Line {
    /// How loud.
    pub(super) level: &'static str,
    /// The frame in words and in bytes.
    pub(super) text: String,
}

/// Chooses the frames that a viewer gets, and puts them in words.
///
/// `can.log` has every frame. A viewer cannot show a hundred SYNCs a second, so of cyclic frames
/// (SYNC, PDO) it gets one of each identifier a step and those with another control- or statusword,
/// with the number of those left out; of heartbeats those with a new state, of all others every one.
#[derive(Debug)]
pub(super) struct Selection {
    drives: Drives,
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
        Selection { drives: Drives::new(stage), cyclic: HashMap::new(), heartbeat: HashMap::new() }
    }

    /// The stage stood so at the SYNC that the last frames answered.
    pub(super) fn locate(&mut self, stage: &StageRecord) {
        self.drives.locate(stage);
    }

    /// The drive that enters another state with `frame`, and the state.
    pub(super) fn entered(&mut self, frame: &Frame) -> Option<(Axis, DriveState)> {
        self.drives.follow(Service::of(frame), frame)
    }

    /// The line for `frame`, where it is worth one, during step `step`.
    pub(super) fn line(&mut self, step: u32, direction: Direction, frame: &Frame) -> Option<Line> {
        let service = Service::of(frame);
        let mut left_out = 0;
        match (frame.cob_id(), service) {
            (Some(id), service) if service.is_cyclic() => {
                left_out = self.cyclic(id, step, frame)?
            }
            (Some(id), Service::Heartbeat(_)) => {
                let state = frame.data().first().copied().unwrap_or(u8::MAX);
                if self.heartbeat.insert(id, state) == Some(state) {
                    return None;
                }
            }
            _ => {}
        }
        let (level, words) = describe(service, frame, &self.drives);
        let arrow = match direction {
            Direction::Sent => "→",
            Direction::Received => "←",
        };
        let mut text = format!("{arrow} {words}  ");
        if left_out > 0 {
            let _ = write!(text, "({left_out} before it in can.log) ");
        }
        let _ = write!(text, "[{}#{}]", frame.id(), Hex(frame.data()));
        Some(Line { level, text })
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
    fn a_line_has_words_bytes_and_what_was_left_out() {
        let mut selection = Selection::new(&run_info().scene.stage);
        let frame = Frame::new(0x181, &[0x37, 0x16, 1, 0, 0, 0]);
        let mut line = |step| selection.line(step, Direction::Received, &frame);
        let first = line(0).unwrap();
        let words = "← TPDO1 node 1: statusword 0x1637 operation enabled, position 1 counts  ";
        let bytes = "[181#37 16 01 00 00 00]";
        assert_eq!(first.text, format!("{words}{bytes}"));
        assert_eq!((line(0), line(0)), (None, None));
        let left_out = "(2 before it in can.log) ";
        assert_eq!(line(1).unwrap().text, format!("{words}{left_out}{bytes}"));
    }
}
