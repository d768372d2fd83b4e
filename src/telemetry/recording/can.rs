//! Chooses the CAN frames that the viewer shows, and formats their lines.

use crate::canopen::cia402::{DriveState, Statusword};
use crate::canopen::emcy::{Emcy, parse_emcy};
use crate::canopen::{Frame, NodeId, cob};
use crate::session::Direction;
use crate::stage::{Axis, PerAxis, StageConfig};
use std::collections::HashMap;

/// Chooses the frames that a viewer gets.
///
/// `can.log` has every frame. A viewer cannot show a hundred SYNCs a second, so repeated frames are
/// omitted:
/// - SYNC and PDOs: shown once per step, and whenever the control- or statusword changes;
/// - heartbeats: shown whenever the NMT state changes;
/// - all other frames: always shown.
#[derive(Debug)]
pub(super) struct Selection {
    nodes: PerAxis<NodeId>,
    states: PerAxis<Option<DriveState>>,
    /// The last frame that was shown, by COB-ID.
    shown: HashMap<u16, Shown>,
}

/// The last frame of a COB-ID that was shown.
#[derive(Debug)]
struct Shown {
    /// The step during which it was shown; always 0 for heartbeats.
    step: u32,
    /// Its first two bytes.
    word: [u8; 2],
    /// Number of frames with this COB-ID that were omitted since.
    omitted: u32,
}

impl Selection {
    /// Chooses among the frames of this stage.
    pub(super) fn new(stage: &StageConfig) -> Self {
        Selection { nodes: stage.nodes(), states: PerAxis::default(), shown: HashMap::new() }
    }

    /// If `frame` is a TPDO1 that reports a new drive state: the axis and that state.
    pub(super) fn entered(&mut self, frame: &Frame) -> Option<(Axis, DriveState)> {
        let tpdo1 = |axis: &Axis| frame.cob_id() == Some(cob::tpdo1(self.nodes[*axis]));
        let axis = Axis::BOTH.into_iter().find(tpdo1)?;
        let state = Statusword(u16::from_le_bytes(*frame.data().first_chunk()?)).state()?;
        (self.states[axis].replace(state) != Some(state)).then_some((axis, state))
    }

    /// The emergency message that a drive of the stage sent, if `frame` is one.
    pub(super) fn emergency(&self, frame: &Frame) -> Option<(Axis, Emcy)> {
        let (node, emcy) = parse_emcy(frame)?;
        let axis = Axis::BOTH.into_iter().find(|axis| self.nodes[*axis] == node)?;
        Some((axis, emcy))
    }

    /// The log level (as rerun names it) and the text of the line for `frame`, which passed during
    /// `step`; `None` if the frame is omitted.
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
        // The control- or statusword of a PDO, the state of a heartbeat, the error code of an EMCY.
        let word = data.first_chunk().copied().unwrap_or([data.first().copied().unwrap_or(0), 0]);
        // If a step is given, repetitions of the same word within that step are omitted.
        let (level, step) = match (id, data) {
            // SYNC and PDOs.
            (cob::SYNC | 0x181..=0x57F, _) => ("TRACE", Some(step)),
            // Heartbeats: their repetitions are omitted whatever the step.
            (0x701..=0x77F, _) => ("INFO", Some(0)),
            // EMCY. Error code 0 means that the error is gone.
            (0x081..=0x0FF, _) if word != [0, 0] => ("ERROR", None),
            // An SDO abort.
            (0x581..=0x67F, [0x80, ..]) => ("WARN", None),
            (0x581..=0x67F, _) => ("DEBUG", None),
            _ => ("INFO", None),
        };
        let mut omitted = 0;
        if let Some(step) = step {
            match self.shown.get_mut(&id) {
                Some(last) if (last.step, last.word) == (step, word) => {
                    last.omitted += 1;
                    return None;
                }
                last => omitted = last.map_or(0, |last| last.omitted),
            }
            self.shown.insert(id, Shown { step, word, omitted: 0 });
        }
        let note = match omitted {
            0 => String::new(),
            n => format!("  ({n} like it before, only in can.log)"),
        };
        Some((level, format!("{arrow} {frame}{note}")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::tests::scene;

    #[test]
    fn repeated_frames_get_one_line_per_step_or_state() {
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
    fn a_line_has_the_frame_and_how_many_were_omitted() {
        let mut selection = Selection::new(&scene().stage);
        let frame = Frame::new(0x181, &[0x37, 0x16, 1, 0, 0, 0]);
        let mut line = |step| Some(selection.line(step, Direction::Received, &frame)?.1);
        assert_eq!(line(0).unwrap(), "← 181#371601000000");
        assert_eq!((line(0), line(0)), (None, None));
        assert_eq!(line(1).unwrap(), "← 181#371601000000  (2 like it before, only in can.log)");
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
    fn a_change_of_a_drives_state_is_reported_once() {
        let mut selection = Selection::new(&scene().stage);
        let mut entered = |cob_id, data: &[u8]| selection.entered(&Frame::new(cob_id, data));
        let enabled = Some((Axis::Insertion, DriveState::OperationEnabled));
        assert_eq!(entered(0x181, &[0x37, 0x16, 0, 0, 0, 0]), enabled);
        assert_eq!(entered(0x181, &[0x37, 0x16, 9, 0, 0, 0]), None);
        assert_eq!(entered(0x183, &[0x37, 0x16, 0, 0, 0, 0]), None, "not a drive of the stage");
        assert_eq!(entered(0x181, &[0x37]), None, "too short");
    }
}
