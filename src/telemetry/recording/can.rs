//! Which CAN frames get a line in a viewer, and the lines.

use crate::canopen::Frame;
use crate::canopen::cia402::{DriveState, Statusword};
use crate::session::Direction;
use crate::stage::{Axis, PerAxis, StageConfig};
use std::collections::HashMap;

const SYNC: u16 = 0x080;

/// Chooses the frames that a viewer gets.
///
/// `can.log` has every frame. A viewer cannot show a hundred SYNCs a second, so of SYNC and each PDO
/// it gets one a step and those with another control- or statusword, of heartbeats those with another
/// state, and of all others every one.
#[derive(Debug)]
pub(super) struct Selection {
    nodes: PerAxis<u8>,
    states: PerAxis<Option<DriveState>>,
    /// By COB-ID: the step and word of the frame shown last, and how many were left out since.
    shown: HashMap<u16, (u32, [u8; 2], u32)>,
}

impl Selection {
    /// Chooses among the frames of this stage.
    pub(super) fn new(stage: &StageConfig) -> Self {
        Selection {
            nodes: PerAxis::from_fn(|axis| stage.axis(axis).node.get()),
            states: PerAxis::from_fn(|_| None),
            shown: HashMap::new(),
        }
    }

    /// The drive that enters another state with `frame`, its TPDO1, and the state.
    pub(super) fn entered(&mut self, frame: &Frame) -> Option<(Axis, DriveState)> {
        let tpdo1 = |axis: &Axis| frame.cob_id() == Some(0x180 + u16::from(self.nodes[*axis]));
        let axis = Axis::BOTH.into_iter().find(tpdo1)?;
        let state = Statusword(u16::from_le_bytes(*frame.data().first_chunk()?)).state()?;
        (self.states[axis].replace(state) != Some(state)).then_some((axis, state))
    }

    /// rerun's level and the text of the line for `frame` during step `step`, where it gets one.
    pub(super) fn line(
        &mut self,
        step: u32,
        direction: Direction,
        frame: &Frame,
    ) -> Option<(&'static str, String)> {
        let arrow = match direction {
            Direction::Sent => '→',
            Direction::Received => '←',
        };
        let (id, data) = (frame.cob_id().unwrap_or(u16::MAX), frame.data());
        let word = data.first_chunk().copied().unwrap_or([data.first().copied().unwrap_or(0), 0]);
        let (level, step) = match (id, data) {
            (SYNC | 0x181..=0x57F, _) => ("TRACE", Some(step)),
            (0x701..=0x77F, _) => ("INFO", Some(0)),
            // Error code 0 says that the error is gone.
            (0x081..=0x0FF, _) if word != [0, 0] => ("ERROR", None),
            // An SDO abort.
            (0x581..=0x67F, [0x80, ..]) => ("WARN", None),
            (0x581..=0x67F, _) => ("DEBUG", None),
            _ => ("INFO", None),
        };
        let mut left_out = 0;
        if let Some(step) = step {
            match self.shown.get_mut(&id) {
                Some((last_step, last_word, more)) if (*last_step, *last_word) == (step, word) => {
                    *more += 1;
                    return None;
                }
                last => left_out = last.map_or(0, |(_, _, more)| *more),
            }
            self.shown.insert(id, (step, word, 0));
        }
        let before = match left_out {
            0 => String::new(),
            n => format!("  ({n} before it in can.log)"),
        };
        Some((level, format!("{arrow} {frame}{before}")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::tests::scene;

    #[test]
    fn of_what_repeats_itself_one_line_a_step_or_state() {
        let mut selection = Selection::new(&scene().stage);
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
    fn a_line_has_the_frame_and_how_many_were_left_out() {
        let mut selection = Selection::new(&scene().stage);
        let frame = Frame::new(0x181, &[0x37, 0x16, 1, 0, 0, 0]);
        let mut line = |step| Some(selection.line(step, Direction::Received, &frame)?.1);
        assert_eq!(line(0).unwrap(), "← 181#371601000000");
        assert_eq!((line(0), line(0)), (None, None));
        assert_eq!(line(1).unwrap(), "← 181#371601000000  (2 before it in can.log)");
    }

    #[test]
    fn errors_and_aborts_have_levels_of_their_own() {
        let mut selection = Selection::new(&scene().stage);
        let mut level = |cob_id, data: &[u8]| {
            selection.line(0, Direction::Sent, &Frame::new(cob_id, data)).unwrap().0
        };
        assert_eq!((level(0x082, &[0x11, 0x86]), level(0x082, &[0, 0])), ("ERROR", "INFO"));
        assert_eq!((level(0x581, &[0x80]), level(0x601, &[0x40])), ("WARN", "DEBUG"));
        assert_eq!((level(0x000, &[1, 0]), level(0x080, &[])), ("INFO", "TRACE"));
    }

    #[test]
    fn a_drive_that_enters_another_state_is_noticed_once() {
        let mut selection = Selection::new(&scene().stage);
        let mut entered = |cob_id, data: &[u8]| selection.entered(&Frame::new(cob_id, data));
        let enabled = Some((Axis::Insertion, DriveState::OperationEnabled));
        assert_eq!(entered(0x181, &[0x37, 0x16, 0, 0, 0, 0]), enabled);
        assert_eq!(entered(0x181, &[0x37, 0x16, 9, 0, 0, 0]), None);
        assert_eq!(entered(0x183, &[0x37, 0x16, 0, 0, 0, 0]), None, "no drive of the stage");
        assert_eq!(entered(0x181, &[0x37]), None, "too short");
    }
}
