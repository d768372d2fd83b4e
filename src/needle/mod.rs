//! The needle: how its tip moves per mm of insertion.
//!
//! The tip is a nonholonomic unicycle in SE(3) (paper Eq. 1), or a bicycle if the tip is ahead of the
//! point that moves along the shaft's axis. The independent variable is the insertion depth; seconds do
//! not appear here.

mod kinematics;
mod measurement;
mod path;
mod reduction;
mod torsion;
mod two_arc;

pub use kinematics::{Increment, Needle, too_large};
pub use measurement::TipPosition;
pub use path::{Cut, InsertedPath};
pub use reduction::{Fibre, Reduced};
pub(crate) use torsion::{HALF_WIDTH, HALF_WIDTH_PER_MM, OFFSET};
pub use torsion::{Play, Torsion, TorsionConfig};
pub use two_arc::{approach_max_mm, shortest_into_plane_mm};
