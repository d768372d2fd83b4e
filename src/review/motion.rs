//! The motion of the axes, from the recorded frames.

use super::run::Folder;
use crate::archive::{CandumpLine, unix_us_of};
use crate::canopen::{Frame, NodeId, cob};
use crate::stage::{Axis, PerAxis, StageConfig, Unwrapper};

/// Minimum time between two points of a curve, s.
const POINT_EVERY_S: f64 = 0.02;

/// The time of a frame of `can.log`, UTC, µs since 1970, and the frame.
pub(super) type TimedFrame = (i64, Frame);

/// Times, s since the start of the run, with positions in mm or degrees.
pub(super) type Course = Vec<(f64, f64)>;

/// The commanded and the measured positions of the axes.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Motion {
    /// The targets (RPDO1).
    pub(super) commanded: PerAxis<Course>,
    /// The positions (TPDO1).
    pub(super) measured: PerAxis<Course>,
}

/// The frame in a `line` of `can.log`; `None` for any other text.
pub fn parse_frame(line: &str) -> Option<TimedFrame> {
    CandumpLine::parse(line).map(|line| (line.unix_us, line.frame))
}

impl Motion {
    /// The motion in the `frames` of the run in `folder`; empty if its configuration or its start time cannot be
    /// read.
    pub fn new(frames: &[TimedFrame], folder: &Folder) -> Self {
        let config = folder.config().ok();
        let stage = config.and_then(|config| config.to_stage().ok());
        let started_us = unix_us_of(&folder.manifest.started_utc);
        let Some((stage, started_us)) = stage.zip(started_us) else { return Motion::default() };
        let courses = |cob_id: fn(NodeId) -> u16| {
            PerAxis::from_fn(|axis| course(frames, started_us, &stage, axis, cob_id))
        };
        Motion { commanded: courses(cob::rpdo1), measured: courses(cob::tpdo1) }
    }
}

/// The positions of `axis` in the PDOs with the identifier `cob_id` of its node. The bench maps the counts
/// after two bytes in both PDOs.
fn course(
    frames: &[TimedFrame],
    started_us: i64,
    stage: &StageConfig,
    axis: Axis,
    cob_id: fn(NodeId) -> u16,
) -> Course {
    let config = stage.axis(axis);
    let pdo_id = Some(cob_id(config.node));
    let pdos = frames.iter().filter(|(_, frame)| frame.cob_id() == pdo_id);
    let mut unwrapper = None::<Unwrapper>;
    let mut scale = None;
    let mut course = Course::new();
    for (unix_us, frame) in pdos {
        let &[_, _, c0, c1, c2, c3] = frame.data() else { continue };
        let reading = i32::from_le_bytes([c0, c1, c2, c3]);
        let position = unwrapper.get_or_insert(Unwrapper::new(reading)).unwrap(reading);
        let scale = scale.get_or_insert_with(|| config.scale(axis, position));
        let time_s = unix_us.saturating_sub(started_us) as f64 * 1e-6;
        if course.last().is_none_or(|(last_s, _)| time_s - last_s >= POINT_EVERY_S) {
            course.push((time_s, axis.in_unit(scale.value(position)).0));
        }
    }
    course
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::review::run::tests::run;

    /// From 110 ms on the first axis reports 0, 1 and 2 mm. A heartbeat and a frame of another length have no
    /// position.
    #[test]
    fn positions_are_read_from_the_pdos() {
        let mut folder = run().folder;
        folder.config_toml = Some(
            "[stage.insertion]\nnode = 5\ncounts_per_mm = { counts = 1000, mm = 1 }\nsign = 1\n\
             zero = 500\n"
                .to_owned(),
        );
        let line = |ms: u32, frame: &str| format!("(1700000000.{ms:03}000) vcan0 {frame} R");
        let lines = [
            line(100, "705#05"),
            line(110, "185#3702F4010000"),
            line(120, "185#3702"),
            line(120, "205#0F00F4010000"),
            line(130, "185#3702DC050000"),
            line(145, "185#3702DD050000"),
            line(160, "185#3702C4090000"),
            // No bench writes this stamp: the file was edited.
            "(-9223372036854.000000) vcan0 185#3702C4090000 R".to_owned(),
        ];
        let frames: Vec<TimedFrame> = lines.iter().filter_map(|line| parse_frame(line)).collect();
        assert_eq!(frames.len(), lines.len());
        let motion = Motion::new(&frames, &folder);
        assert_eq!(motion.measured.insertion, [(0.11, 0.0), (0.13, 1.0), (0.16, 2.0)]);
        assert_eq!(motion.commanded.insertion, [(0.12, 0.0)]);
        assert!(motion.measured.rotation.is_empty());
        folder.config_toml = None;
        assert_eq!(Motion::new(&frames, &folder), Motion::default());
    }
}
