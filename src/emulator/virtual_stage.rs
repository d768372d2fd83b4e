//! Drives, needle and tracker together: the stage as the bench sees it, from outside.

use super::drive::{Drive, DriveConfig};
use super::tissue::Tissue;
use super::tracker::{EmulatedTracker, TrackedTip, TrackerModel};
use super::truth::Truth;
use crate::canopen::Frame;
use crate::geometry::Pose;
use crate::needle::{Needle, Torsion};
use crate::units::Time;
use std::collections::VecDeque;
use std::f64::consts::TAU;

/// The most frames handed on in one call; the rest waits for the next, so that two drives mapped to
/// answer each other's PDOs cannot hold the caller for ever.
const HANDED_ON_MAX: usize = 256;

/// How an emulated drive's counts turn into motion. The emulator converts by itself, in floating
/// point: an error in the bench's exact scaling must not cancel here.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gearing {
    /// Counts per mm, or per turn; negative where the drive counts the other way.
    pub counts_per_unit: f64,
}

/// What the virtual stage is made of.
#[derive(Debug, Clone)]
pub struct VirtualStageConfig {
    /// The insertion drive, and counts per mm.
    pub insertion: (DriveConfig, Gearing),
    /// The rotation drive, and counts per turn.
    pub rotation: (DriveConfig, Gearing),
    /// The true needle.
    pub needle: Needle,
    /// The true torsion of its shaft.
    pub torsion: Torsion,
    /// True tip pose `X_PB` at the start, plane frame.
    pub start: Pose,
    /// Pose `X_TP` of the plane frame in the tracker frame.
    pub x_tp: Pose,
    /// What the tracker does to positions.
    pub tracker: TrackerModel,
}

/// Something that leaves the virtual stage.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum StageOutput {
    /// A frame of one of the drives.
    Frame(Frame),
    /// A tracked tip position.
    Tip {
        /// What the tracker says.
        tip: TrackedTip,
        /// The true tip pose when it was acquired.
        truth: Truth,
    },
}

/// The virtual stage, sans-IO: `handle_frame`, `handle_timeout`, drain `poll()`, wait until
/// `deadline()`. It knows nothing of who commands it.
#[derive(Debug)]
pub struct VirtualStage {
    insertion: Drive,
    rotation: Drive,
    insertion_gearing: Gearing,
    rotation_gearing: Gearing,
    origin_counts: (f64, f64),
    tissue: Tissue,
    tracker: EmulatedTracker,
    outputs: VecDeque<StageOutput>,
}

impl VirtualStage {
    /// A stage switched on at `now`.
    pub fn new(config: VirtualStageConfig, now: Time) -> Self {
        let (insertion, insertion_gearing) = config.insertion;
        let (rotation, rotation_gearing) = config.rotation;
        let (insertion, rotation) = (Drive::new(insertion), Drive::new(rotation));
        let origin_counts = (insertion.position_counts_at(now), rotation.position_counts_at(now));
        let mut stage = VirtualStage {
            insertion,
            rotation,
            insertion_gearing,
            rotation_gearing,
            origin_counts,
            tissue: Tissue::new(config.needle, config.torsion, config.start),
            tracker: EmulatedTracker::new(config.tracker, config.x_tp, now),
            outputs: VecDeque::new(),
        };
        stage.drain_drives(now);
        stage
    }

    /// Takes a frame from the bus. The needle is first moved to where the drives are now, so that
    /// a target latched by this frame bends the path from here on only.
    pub fn handle_frame(&mut self, now: Time, frame: &Frame) {
        self.handle_timeout(now);
        self.insertion.handle_frame(now, frame);
        self.rotation.handle_frame(now, frame);
        self.drain_drives(now);
    }

    /// Does what is due by `now`.
    pub fn handle_timeout(&mut self, now: Time) {
        while self.tracker.next_acquisition() <= now {
            self.move_needle(self.tracker.next_acquisition());
            self.tracker.acquire(self.tissue.tip_true());
        }
        self.move_needle(now);
        for drive in [&mut self.insertion, &mut self.rotation] {
            if drive.deadline() <= now {
                drive.handle_timeout(now);
            }
        }
        self.drain_drives(now);
        while let Some((tip, truth)) = self.tracker.deliver(now) {
            self.outputs.push_back(StageOutput::Tip { tip, truth });
        }
    }

    /// The next thing to leave the stage.
    pub fn poll(&mut self) -> Option<StageOutput> {
        self.outputs.pop_front()
    }

    /// When the stage next has something to do by itself.
    pub fn deadline(&self) -> Time {
        self.tracker.deadline().min(self.insertion.deadline()).min(self.rotation.deadline())
    }

    /// The true tip pose of now, as of the last call.
    pub fn truth(&self) -> Truth {
        Truth::new(*self.tissue.tip_true())
    }

    /// True depth, mm, and rotation, rad, at `now`, from where the stage was switched on.
    pub fn position_true(&self, now: Time) -> (f64, f64) {
        let insertion_counts = self.insertion.position_counts_at(now) - self.origin_counts.0;
        let rotation_counts = self.rotation.position_counts_at(now) - self.origin_counts.1;
        (
            insertion_counts / self.insertion_gearing.counts_per_unit,
            rotation_counts / self.rotation_gearing.counts_per_unit * TAU,
        )
    }

    /// The insertion drive and the rotation drive.
    pub fn drives(&self) -> [&Drive; 2] {
        [&self.insertion, &self.rotation]
    }

    /// Switches the supplies of the two power stages: an emergency stop takes both, a blown fuse
    /// one. See [`Drive::set_voltage`].
    pub fn set_voltage(&mut self, now: Time, insertion_on: bool, rotation_on: bool) {
        self.handle_timeout(now);
        self.insertion.set_voltage(now, insertion_on);
        self.rotation.set_voltage(now, rotation_on);
        self.drain_drives(now);
    }

    fn move_needle(&mut self, now: Time) {
        let (insertion_mm, rotation_rad) = self.position_true(now);
        self.tissue.advance(insertion_mm, rotation_rad);
    }

    /// Sends what the drives have to send, each frame to the outside and to the other drive, as on
    /// a real bus.
    fn drain_drives(&mut self, now: Time) {
        for _ in 0..HANDED_ON_MAX {
            let frame = if let Some(frame) = self.insertion.poll_transmit() {
                self.rotation.handle_frame(now, &frame);
                frame
            } else if let Some(frame) = self.rotation.poll_transmit() {
                self.insertion.handle_frame(now, &frame);
                frame
            } else {
                return;
            };
            self.outputs.push_back(StageOutput::Frame(frame));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::tracker::Noise;
    use super::*;
    use crate::canopen::NodeId;
    use crate::canopen::node::Identity;
    use std::time::Duration;

    fn stage() -> VirtualStage {
        let drive = |node| {
            let node = NodeId::new(node).unwrap();
            let identity = Identity { vendor: 1, product: 2, revision: 3, serial: 4 };
            (DriveConfig::new(node, identity), Gearing { counts_per_unit: 1000.0 })
        };
        let config = VirtualStageConfig {
            insertion: drive(1),
            rotation: drive(2),
            needle: Needle::new(0.01).unwrap(),
            torsion: Torsion::default(),
            start: Pose::identity(),
            x_tp: Pose::identity(),
            tracker: TrackerModel {
                noise: Noise::None,
                seed: 1,
                period: Duration::from_millis(25),
                latency: Duration::ZERO,
                repeats: 0,
            },
        };
        VirtualStage::new(config, Time::ZERO)
    }

    fn cob_ids(stage: &mut VirtualStage) -> Vec<u16> {
        let outputs = std::iter::from_fn(|| stage.poll());
        outputs
            .filter_map(|output| match output {
                StageOutput::Frame(frame) => frame.cob_id(),
                StageOutput::Tip { .. } => None,
            })
            .collect()
    }

    /// The rotation drive watches the insertion drive's heartbeat, and misses it when it ends.
    #[test]
    fn the_drives_hear_one_another() {
        let mut stage = stage();
        assert_eq!(cob_ids(&mut stage), [0x701, 0x702], "each frame leaves once");
        let heartbeat_ms = |period: u8| Frame::new(0x601, &[0x2B, 0x17, 0x10, 0, period, 0, 0, 0]);
        let watch = Frame::new(0x602, &[0x23, 0x16, 0x10, 1, 100, 0, 1, 0]);
        stage.handle_frame(Time::ZERO, &watch);
        stage.handle_frame(Time::ZERO, &heartbeat_ms(50));
        let run = |stage: &mut VirtualStage, from_s: f64| {
            for n in 0..100u32 {
                stage.handle_timeout(Time::from_secs_f64(from_s + 0.01 * f64::from(n)));
            }
            cob_ids(stage)
        };
        let heard = run(&mut stage, 0.0);
        assert!(heard.iter().filter(|&&id| id == 0x701).count() > 15, "{heard:x?}");
        assert!(!heard.contains(&0x082), "{heard:x?}");
        stage.handle_frame(Time::from_secs_f64(1.0), &heartbeat_ms(0));
        assert!(run(&mut stage, 1.0).contains(&0x082), "an emergency of the one that listened");
    }
}
