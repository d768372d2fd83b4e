//! `[insertion]`: how far the needle is inserted, and how.

use std::time::Duration;

use super::schema::{choice, over, section, within};
use crate::session::{self, PlaneOutOfReach, Samples};

section! {
    /// `[insertion]`.
    pub struct InsertionConfig {
        /// How far to insert from where the run starts, mm.
        depth_mm: f64 [over(0.0, 1000.0)] = 250.0, at_most("stage.insertion.max_mm");
        /// Speed of the insertion, mm/s.
        speed_mm_per_s: f64 [over(0.0, 100.0)] = 2.0,
            at_most("stage.insertion.speed_max_mm_per_s");
        /// Acceleration and braking of the insertion, mm/s².
        acceleration_mm_per_s2: f64 [over(0.0, 1000.0)] = 10.0;
        /// How the needle advances.
        mode: InsertionMode = "continuous";
        /// Distance between two estimates and commands, mm.
        step_mm: f64 [within(0.1, 10.0)] = 1.0, at_most("insertion.depth_mm");
        /// Position tolerance at the end: standing this near, the needle counts as there, mm.
        arrival_mm: f64 [within(0.001, 1.0)] = 0.05;
        /// Stepwise: standstill before samples are taken, s.
        settle_s: f64 [within(0.0, 60.0)] = 0.2;
        /// Stepwise: samples averaged at each step.
        samples: u32 [within(1.0, 1000.0)] = 1;
        /// What to do when `depth_mm` does not suffice for the shortest way into the plane. An
        /// insertion under 60 mm is a trial, and judged as if it were 60 mm.
        plane_out_of_reach: PlaneOutOfReach = "refuse";
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
    for PlaneOutOfReach {
        /// The insertion is refused before the axes have power.
        Refuse = "refuse",
        /// The needle is inserted all the same.
        Insert = "insert",
    }
}

impl InsertionConfig {
    /// What a session is told.
    pub(super) fn to_session(&self, samples: Samples) -> session::InsertionConfig {
        session::InsertionConfig {
            depth_mm: self.depth_mm,
            speed_mm_per_s: self.speed_mm_per_s,
            acceleration_mm_per_s2: self.acceleration_mm_per_s2,
            step_mm: self.step_mm,
            samples,
            arrival_mm: self.arrival_mm,
            mode: match self.mode {
                InsertionMode::Continuous => session::InsertionMode::Continuous,
                InsertionMode::Stepwise => session::InsertionMode::Stepwise {
                    settle: Duration::from_secs_f64(self.settle_s),
                    samples: self.samples,
                },
            },
        }
    }
}
