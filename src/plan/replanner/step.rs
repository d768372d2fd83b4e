//! Input and output of the replanner at a step.

use crate::plan::arc::Tip;
use crate::plan::search::Status;
use derive_more::Display;
use nalgebra::Vector3;

/// The estimate of the tip.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TipEstimate {
    /// Position and heading.
    pub tip: Tip,
    /// Curvature of the needle, over 0, per mm.
    pub curvature_per_mm: f64,
    /// Standard deviation of the position, mm.
    pub position_sd_mm: f64,
    /// Standard deviation of the heading, rad.
    pub heading_sd_rad: f64,
}

/// What to do in the next step.
#[derive(Debug, Clone, PartialEq)]
pub enum Step {
    /// Steer and insert.
    Steer(Steer),
    /// The tip is as near to the target as it will come: insert no further.
    Arrived {
        /// Distance from the target, mm.
        error_mm: f64,
    },
    /// The insertion must stop.
    Stop(StopReason),
}

/// How to steer in the next step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Steer {
    /// The path bends toward this unit vector across the heading.
    pub bend: Vector3<f64>,
    /// The wanted mean curvature, at most that of the needle, per mm; negative if the path soon bends to the
    /// other side.
    pub curvature_per_mm: f64,
    /// Remaining length of the path, mm.
    pub remaining_mm: f64,
    /// Distance from the target at the end of the path, mm.
    pub error_mm: f64,
}

/// Why the insertion must stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Display)]
pub enum StopReason {
    /// The tip is nearer to an obstacle than the clearance.
    #[display("the tip is nearer to an obstacle than goal.clearance_mm")]
    TipNearObstacle,
    /// The tip is outside the workspace.
    #[display("the tip is outside goal.workspace_mm; widen it, or choose another target")]
    TipOutside,
    /// A step straight ahead, or the stop after it, may lead nearer to an obstacle than the clearance.
    #[display(
        "the next step, or a stop after it, may lead nearer to an obstacle than goal.clearance_mm; insert \
         slower, or raise goal.reserve_mm"
    )]
    ObstacleAhead,
    /// A step straight ahead, or the stop after it, may lead out of the workspace.
    #[display(
        "the next step, or a stop after it, may lead out of goal.workspace_mm; insert slower, or widen it"
    )]
    WallAhead,
    /// Neither a new path nor the last one leads to the target.
    #[display(
        "no path to the target is left; a larger goal.curvature_margin, or around obstacles goal.reserve_mm, \
         leaves room for a needle that bends less than needle.radius_mm says"
    )]
    NoPath,
}

/// A start from which no path leads to the target.
#[derive(Debug, Clone, PartialEq)]
pub struct StartRefused {
    /// The reason, in words.
    pub reason: String,
    /// The reachable point nearest to the target, mm, of those that were found; `None` if even the start is not
    /// allowed.
    pub nearest_mm: Option<Vector3<f64>>,
    /// How the search ended.
    pub status: Status,
}
