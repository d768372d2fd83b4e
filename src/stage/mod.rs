//! The master of the two-axis stage, sans-IO.

mod axis;
mod limits;
mod scale;

pub use axis::{Axis, PerAxis};
pub use limits::{AxisLimits, Commanded, LimitCheck, LimitError};
pub use scale::{CountsRatio, Scale, Sign, Unwrapper};
