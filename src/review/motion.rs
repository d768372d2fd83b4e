//! The motion of the axes, from the recorded frames.

use super::run::Folder;
use crate::archive::{CandumpLine, unix_us_of};
use crate::canopen::{Frame, NodeId, cob};
use crate::stage::{Axis, AxisConfig, PerAxis, Scale, SetPoint, StageConfig, Unwrapper};
use crate::units::Time;

/// Minimum time between two points of a curve, s.
const POINT_EVERY_S: f64 = 0.02;

/// The time of a frame of `can.log`, UTC, µs since 1970, and the frame.
pub type TimedFrame = (i64, Frame);

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

/// Where the stage was at each SYNC of the run that started at `started_us` (UTC, µs since 1970) after which both
/// axes sent their position. Without a configured zero an axis counts from its first position.
pub fn positions_at_sync(
    frames: impl IntoIterator<Item = TimedFrame>,
    started_us: i64,
    stage: &StageConfig,
) -> Vec<(Time, SetPoint)> {
    let mut axes = PerAxis::from_fn(|axis| Readings::new(axis, stage.axis(axis), cob::tpdo1));
    let mut positions = Vec::new();
    let mut sync_us = None;
    let mut seen = PerAxis::from_fn(|_| None);
    for (unix_us, frame) in frames {
        if frame.cob_id() == Some(cob::SYNC) {
            (sync_us, seen) = (Some(unix_us), PerAxis::from_fn(|_| None));
        }
        for axis in Axis::BOTH {
            let reading = axes[axis].take(&frame);
            seen[axis] = seen[axis].or(reading);
        }
        if let (Some(insertion_mm), Some(rotation_rad)) = (seen.insertion, seen.rotation)
            && let Some(sync_us) = sync_us.take()
        {
            let since_ns = sync_us.saturating_sub(started_us).saturating_mul(1000);
            positions.push((Time::from_nanos(since_ns), SetPoint { insertion_mm, rotation_rad }));
        }
    }
    positions
}

/// The positions that PDOs of one axis carry. The bench maps the counts after two bytes, in RPDO1 and in TPDO1.
struct Readings<'a> {
    axis: Axis,
    config: &'a AxisConfig,
    pdo_id: u16,
    unwrapper: Option<(Unwrapper, Scale)>,
}

impl<'a> Readings<'a> {
    /// Reads the PDOs with the identifier `cob_id` of the axis's node.
    fn new(axis: Axis, config: &'a AxisConfig, cob_id: fn(NodeId) -> u16) -> Self {
        Readings { axis, config, pdo_id: cob_id(config.node), unwrapper: None }
    }

    /// The position in `frame`, mm or rad; `None` if it is another frame.
    fn take(&mut self, frame: &Frame) -> Option<f64> {
        let &[_, _, c0, c1, c2, c3] = frame.data() else { return None };
        if frame.cob_id() != Some(self.pdo_id) {
            return None;
        }
        let reading = i32::from_le_bytes([c0, c1, c2, c3]);
        let (unwrapper, scale) = self.unwrapper.get_or_insert_with(|| {
            (Unwrapper::new(reading), self.config.scale(self.axis, reading.into()))
        });
        Some(scale.value(unwrapper.unwrap(reading)))
    }
}

/// The positions of `axis` in the PDOs with the identifier `cob_id` of its node.
fn course(
    frames: &[TimedFrame],
    started_us: i64,
    stage: &StageConfig,
    axis: Axis,
    cob_id: fn(NodeId) -> u16,
) -> Course {
    let mut readings = Readings::new(axis, stage.axis(axis), cob_id);
    let mut course = Course::new();
    for (unix_us, frame) in frames {
        let Some(position) = readings.take(frame) else { continue };
        let time_s = unix_us.saturating_sub(started_us) as f64 * 1e-6;
        if course.last().is_none_or(|(last_s, _)| time_s - last_s >= POINT_EVERY_S) {
            course.push((time_s, axis.in_unit(position).0));
        }
    }
    course
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
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

    /// A SYNC counts if both axes answer before the next one, and only their first answers.
    #[test]
    fn a_position_belongs_to_the_sync_before_it() {
        let frame = |(ms, id, counts): (i64, u16, i32)| {
            let [a, b, c, d] = counts.to_le_bytes();
            let data: &[u8] = if id == cob::SYNC { &[] } else { &[0x37, 0x02, a, b, c, d] };
            (5_000_000 + 1000 * ms, Frame::new(id, data))
        };
        let stage = Config::from_sources(&[], &[]).unwrap().to_stage().unwrap();
        let [insertion, rotation] = Axis::BOTH.map(|axis| cob::tpdo1(stage.axis(axis).node));
        let frames = [
            (1, insertion, 900),
            (10, cob::SYNC, 0),
            (11, insertion, 1000),
            (12, insertion, 5000),
            (13, rotation, 7),
            (20, cob::SYNC, 0),
            (21, rotation, 7),
            (30, cob::SYNC, 0),
            (31, rotation, 7),
            (32, insertion, 1200),
        ];
        let positions = positions_at_sync(frames.map(frame), 5_000_000, &stage);
        let times: Vec<i64> = positions.iter().map(|(time, _)| time.as_nanos()).collect();
        assert_eq!(times, [10_000_000, 30_000_000]);
        let scale = stage.axis(Axis::Insertion).scale(Axis::Insertion, 0);
        for ((_, at), counts) in positions.iter().zip([1000, 1200]) {
            assert_eq!(at.insertion_mm, scale.value(counts));
            assert_eq!(at.rotation_rad, 0.0);
        }
    }
}
