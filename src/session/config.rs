//! What a session is told.

use super::error::SessionError;
use crate::control::ControlConfig;
use crate::geometry::Pose;
use crate::needle::{Needle, Torsion};
use crate::observer::{InvariantConfig, ObserverConfig};
use crate::stage::StageConfig;
use crate::tracker::{AcquisitionClock, Gate, TrackSettings};
use std::time::Duration;

/// Everything a run needs to know, in internal units.
#[derive(Debug, Clone)]
pub struct SessionConfig {
    /// Pose `X_WP` of the plane in the bench frame.
    pub x_wp: Pose,
    /// How the needle is inserted.
    pub insertion: InsertionConfig,
    /// What to do when the insertion cannot reach the plane from where it starts.
    pub plane_out_of_reach: PlaneOutOfReach,
    /// The needle as the bench believes it to be.
    pub needle: Needle,
    /// The torsion of its shaft as the bench believes it to be.
    pub needle_torsion: Torsion,
    /// The observer that steers.
    pub observer: ObserverConfig,
    /// What the watch over the stream's handedness is told.
    pub handedness: InvariantConfig,
    /// Observers that run alongside on the same measurements and never steer.
    pub shadows: Vec<ObserverConfig>,
    /// The control law.
    pub control: ControlConfig,
    /// The two drives.
    pub stage: StageConfig,
    /// The tracker stream.
    pub tracker: TrackerConfig,
}

impl SessionConfig {
    /// Says now what [`Session::new`](super::Session::new) would refuse, before a run folder is
    /// made.
    ///
    /// # Errors
    /// As [`Session::new`](super::Session::new).
    pub fn check(&self) -> Result<(), SessionError> {
        for observer in std::iter::once(&self.observer).chain(&self.shadows) {
            observer.build(self.needle, self.needle_torsion)?;
        }
        Ok(self.stage.validate()?)
    }
}

/// How the needle is inserted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InsertionConfig {
    /// Depth to reach from where the run starts, mm.
    pub depth_mm: f64,
    /// Insertion speed, mm/s.
    pub speed_mm_per_s: f64,
    /// Insertion acceleration and braking, mm/s².
    pub acceleration_mm_per_s2: f64,
    /// Depth between two commands, mm.
    pub step_mm: f64,
    /// Which positions correct the observers.
    pub samples: Samples,
    /// Standing this near to the end of its set-points, mm, the needle counts as there.
    pub arrival_mm: f64,
    /// Without a stop at the steps, or with.
    pub mode: InsertionMode,
}

/// Which of the believed positions correct the observers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Samples {
    /// Every one, at its own depth.
    All,
    /// At each step one: the newest, or the mean of the standstill, taken for a single position.
    /// The paper's way.
    OnePerStep,
}

/// Without a stop at the steps, or with.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum InsertionMode {
    /// The needle moves on.
    Continuous,
    /// At each step the needle stands still for `settle`, then `samples` positions are averaged.
    Stepwise {
        /// Standstill before the first position counts.
        settle: Duration,
        /// Positions averaged, at least 1.
        samples: u32,
    },
}

/// What to do when an insertion cannot reach the plane from where it starts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PlaneOutOfReach {
    /// The run is stopped before the axes have power.
    Refuse,
    /// The needle is inserted all the same, with a warning.
    Insert,
}

/// The tracker stream.
#[derive(Debug, Clone)]
pub struct TrackerConfig {
    /// What a sample must pass by itself; registration and tool name are in it.
    pub gate: Gate,
    /// A stream that as a whole contradicts the insertion ends the run.
    pub judges_stream: bool,
    /// Dates samples.
    pub clock: AcquisitionClock,
    /// What a position must pass against the others and the model.
    pub track: TrackSettings,
    /// How long to wait for the tool before giving up.
    pub timeout: Duration,
    /// The insertion is held when the newest position is older than this.
    pub hold_after: Duration,
    /// And before more than this is inserted without one, mm, the way to brake included.
    pub hold_after_mm: f64,
    /// Braking of the insertion when it is held, mm/s².
    pub hold_braking_mm_per_s2: f64,
    /// The longest a hold may last.
    pub hold_timeout: Duration,
    /// What comes after a hold.
    pub resume: Resume,
}

/// What comes after a hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Resume {
    /// The run is stopped as soon as the needle stands.
    Stop,
    /// The insertion goes on by itself once the tip is found again.
    Automatic,
}
