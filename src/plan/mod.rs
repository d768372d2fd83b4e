//! Planning a path of the needle to a target, around obstacles: geometry, distances, search.
//!
//! Everything is in the plane frame, in mm. Results depend only on the arguments: the budget of a search is a
//! number of expansions, never a time, so a plan is the same on every machine.

mod arc;
mod field;
mod lattice;
mod mask;
mod nearest;
mod obstacle;
mod path;
mod problem;
mod reach;
mod replanner;
mod reserve;
mod route;
mod search;

pub use arc::{Arc, Tip};
pub use field::CLEARANCE_MIN_MM;
pub use mask::Mask;
pub use obstacle::{Obstacle, Workspace, World};
pub use path::Path;
pub use problem::Problem;
pub use reach::{Reach, reach_around};
pub use replanner::{Replanner, StartRefused, Steer, Step, StopReason, TipEstimate};
pub use reserve::{RoomyPath, plan_with_reserve};
pub use search::{Answer, Status, plan};
