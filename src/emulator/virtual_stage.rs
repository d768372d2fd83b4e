//! Drives, needle and tracker together: the stage as the bench sees it, from outside.

use super::drive::{Drive, DriveConfig};
use super::tissue::Tissue;
use super::tracker::{EmulatedTracker, Noise, TrackedTip};
use super::truth::Truth;
use crate::canopen::Frame;
use crate::geometry::Pose;
use crate::needle::Needle;
use crate::units::Time;
use std::collections::VecDeque;
use std::f64::consts::TAU;
use std::time::Duration;

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
    /// True tip pose `X_PB` at the start, plane frame.
    pub start: Pose,
    /// Pose `X_TP` of the plane frame in the tracker frame.
    pub x_tp: Pose,
    /// Noise of the tracked position.
    pub noise: Noise,
    /// Seed of the noise.
    pub seed: u64,
    /// Time between two tracked positions.
    pub tracker_period: Duration,
    /// How long a tracked position takes to reach the bench.
    pub tracker_latency: Duration,
}

/// Something that leaves the virtual stage.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum StageOutput {
    /// A frame of one of the drives.
    Frame(Frame),
    /// A tracked tip position.
    Tip(TrackedTip),
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
            tissue: Tissue::new(config.needle, config.start),
            tracker: EmulatedTracker::new(
                config.tracker_period,
                config.tracker_latency,
                config.noise,
                config.seed,
                config.x_tp,
                now,
            ),
            outputs: VecDeque::new(),
        };
        stage.drain_drives();
        stage
    }

    /// Takes a frame from the bus. The needle is first moved to where the drives are now, so that
    /// a target latched by this frame bends the path from here on only.
    pub fn handle_frame(&mut self, now: Time, frame: &Frame) {
        self.handle_timeout(now);
        self.insertion.handle_frame(now, frame);
        self.rotation.handle_frame(now, frame);
        // The drives hear one another, as on a real bus.
        self.drain_drives();
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
        self.drain_drives();
        while let Some(tip) = self.tracker.deliver(now) {
            self.outputs.push_back(StageOutput::Tip(tip));
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
        self.drain_drives();
    }

    fn move_needle(&mut self, now: Time) {
        let (insertion_mm, rotation_rad) = self.position_true(now);
        self.tissue.advance(insertion_mm, rotation_rad);
    }

    fn drain_drives(&mut self) {
        let mut quiet = false;
        while !quiet {
            quiet = true;
            while let Some(frame) = self.insertion.poll_transmit() {
                self.outputs.push_back(StageOutput::Frame(frame));
                quiet = false;
            }
            while let Some(frame) = self.rotation.poll_transmit() {
                self.outputs.push_back(StageOutput::Frame(frame));
                quiet = false;
            }
        }
    }
}
