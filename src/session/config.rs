//! The configuration of a session.

use super::goal::Goal;
use super::reach::check_reach;
use crate::control::ControlConfig;
use crate::geometry::Pose;
use crate::keys::{choice, over, section, within};
use crate::needle::{Needle, Torsion};
use crate::observer::{InvariantConfig, ObserverConfig, PositionNoise};
use crate::stage::StageConfig;
use crate::tracker::{AcquisitionClock, Gate, TrackSettings};
use nalgebra::Vector3;
use std::time::Duration;

/// The configuration of an insertion, in mm, rad, s and per mm.
#[derive(Debug, Clone)]
pub struct SessionConfig {
    /// Pose `X_WP` of the plane in the bench frame.
    pub x_wp: Pose,
    /// How the needle is inserted.
    pub insertion: InsertionConfig,
    /// The needle, as configured. The real or emulated one may differ.
    pub needle: Needle,
    /// The torsion of its shaft, as configured.
    pub needle_torsion: Torsion,
    /// The observer that steers.
    pub observer: ObserverConfig,
    /// Settings of the handedness watch.
    pub handedness: InvariantConfig,
    /// Observers that run alongside on the same measurements and never steer.
    pub shadows: Vec<ObserverConfig>,
    /// The control law.
    pub control: ControlConfig,
    /// The target; `None` to steer into the plane.
    pub goal: Option<Goal>,
    /// The two drives.
    pub stage: StageConfig,
    /// The tracker stream.
    pub tracker: TrackerConfig,
}

impl SessionConfig {
    /// Checks that the depth suffices to reach the plane from a tip at `tip_mm`, plane frame, and that a path leads
    /// from there to the target, if there is one.
    ///
    /// # Errors
    /// The reason, with its numbers.
    pub fn check_reach(&self, tip_mm: &Vector3<f64>) -> Result<(), String> {
        self.goal.as_ref().map_or(Ok(()), |goal| goal.check_start(tip_mm))?;
        check_reach(self, tip_mm)
    }
}

section! {
    /// `[insertion]`: how far the needle is inserted, and how.
    #[derive(Copy)]
    pub struct InsertionConfig {
        /// How far to insert from where the run starts, mm.
        depth_mm: f64 [over(0.0, 1000.0)] = 250.0, at_most("stage.insertion.max_mm");
        /// Speed of the insertion, mm/s.
        speed_mm_per_s: f64 [within(0.01, 100.0)] = 2.0,
            at_most("stage.insertion.speed_max_mm_per_s");
        /// Acceleration and braking of the insertion, mm/s². A stop must brake as hard, to keep a soft limit.
        acceleration_mm_per_s2: f64 [within(0.01, 1000.0)] = 10.0,
            at_most("stage.insertion.quick_stop_deceleration_mm_per_s2");
        /// How the needle advances.
        mode: InsertionMode = "continuous";
        /// Distance between two estimates and commands, mm.
        step_mm: f64 [within(0.1, 10.0)] = 1.0, at_most("insertion.depth_mm");
        /// Position tolerance at the end: standing this near, the needle counts as there, mm.
        arrival_mm: f64 [within(0.001, 1.0)] = 0.05;
        /// Stepwise: standstill before samples are taken.
        settle as "settle_s": Duration [within(0.0, 60.0)] = 0.2;
        /// Stepwise: samples averaged at each step.
        samples: u32 [within(1.0, 1000.0)] = 1;
        /// What to do when `depth_mm` does not suffice for the shortest way into the plane. An
        /// insertion under 60 mm is a trial, and judged as if it were 60 mm.
        plane_out_of_reach: PlaneOutOfReach = "refuse";
    }
    beside {
        /// Positions that correct the observers.
        pub corrected_by: Samples = Samples::All,
    }
}

impl InsertionConfig {
    /// How far the needle may advance after the step that stops it, mm: its travel in two SYNC periods, and its
    /// braking distance in a quick stop. If no quick-stop deceleration is configured, that of the insertion counts.
    pub fn stopping_mm(&self, stage: &StageConfig) -> f64 {
        let speed = self.speed_mm_per_s;
        let deceleration = stage.insertion.quick_stop_deceleration;
        let deceleration = deceleration.unwrap_or(self.acceleration_mm_per_s2);
        2.0 * speed * stage.bus.sync_period().as_secs_f64() + speed * speed / (2.0 * deceleration)
    }
}

choice! {
    /// Positions that correct the observers.
    pub enum Samples {
        /// Every believed one, at its own depth.
        All = "all",
        /// One at each step, as in the paper.
        OnePerStep = "one-per-step",
    }
}

choice! {
    /// How the needle advances.
    pub enum InsertionMode {
        /// Without stops.
        Continuous = "continuous",
        /// Advance a step, stop, settle, average.
        Stepwise = "stepwise",
    }
}

choice! {
    /// What to do when an insertion cannot reach the plane from where it starts.
    pub enum PlaneOutOfReach {
        /// The insertion is refused before the axes have power.
        Refuse = "refuse",
        /// The needle is inserted all the same.
        Insert = "insert",
    }
}

/// The tracker stream.
#[derive(Debug, Clone)]
pub struct TrackerConfig {
    /// The gate that judges a sample by itself. It holds the registration and the tool's name.
    pub gate: Gate,
    /// The run ends if the stream as a whole contradicts the insertion.
    pub judges_stream: bool,
    /// The tracker is emulated without noise: a coordinate may stay the same to the bit.
    pub is_exact: bool,
    /// Determines the acquisition time of samples.
    pub clock: AcquisitionClock,
    /// Settings of the track, which judges a position against the others and the model.
    pub track: TrackSettings,
    /// The noise of the positions, if it is known.
    pub noise: Option<PositionNoise>,
    /// How long to wait for the tool before giving up.
    pub timeout: Duration,
    /// When the insertion is held.
    pub hold: HoldConfig,
}

section! {
    /// When the insertion is held, and what comes after.
    #[derive(Copy)]
    pub struct HoldConfig {
        /// The insertion is held when the newest tip position is older than this.
        after as "hold_after_s": Duration [within(0.01, 60.0)] = 0.5;
        /// The insertion is held before more than this is inserted without a tip position, mm, braking
        /// included.
        after_mm as "hold_after_mm": f64 [within(0.1, 100.0)] = 1.0;
        /// Braking of the insertion to a hold, mm/s²; both axes stay enabled.
        braking_mm_per_s2 as "hold_braking_mm_per_s2": f64 [within(0.1, 1000.0)] = 40.0,
            at_most("stage.insertion.acceleration_max_mm_per_s2");
        /// The run is stopped when a hold lasts longer.
        timeout as "hold_timeout_s": Duration [within(0.1, 3600.0)] = 5.0;
        /// What comes after a hold.
        resume: Resume = "stop";
    }
}

choice! {
    /// What comes after a hold by the tracker. A hold by the operator ends on the operator's word only.
    pub enum Resume {
        /// The run is stopped once the needle stands.
        Stop = "stop",
        /// The insertion goes on by itself once the tip is found again.
        Automatic = "automatic",
        /// The operator may let the insertion go on once the tip is found again.
        Operator = "operator",
    }
}
