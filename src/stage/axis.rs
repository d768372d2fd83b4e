//! The two axes, and what each is used for.

use std::fmt;
use std::ops::{Index, IndexMut};

/// One of the two axes of the stage.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Axis {
    /// Pushes the needle; mm.
    Insertion,
    /// Turns the needle about its shaft; rad.
    Rotation,
}

impl Axis {
    /// Both, in the order in which they are served.
    pub const BOTH: [Axis; 2] = [Axis::Insertion, Axis::Rotation];

    /// `value`, mm or rad, in the unit of the configuration and the command line, with that unit.
    pub fn in_unit(self, value: f64) -> (f64, &'static str) {
        let value = if self == Axis::Rotation { value.to_degrees() } else { value };
        (value, self.unit())
    }

    /// The unit of the configuration and the command line.
    pub fn unit(self) -> &'static str {
        ["mm", "deg"][self as usize]
    }

    /// `value`, mm or rad, as text for the operator: `1.500 mm`, `90.000 deg`.
    pub fn shown(self, value: f64) -> String {
        let (value, unit) = self.in_unit(value);
        format!("{value:.3} {unit}")
    }
}

impl fmt::Display for Axis {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(["insertion", "rotation"][*self as usize])
    }
}

/// One value for each axis, indexed by [`Axis`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PerAxis<T> {
    /// The insertion axis's.
    pub insertion: T,
    /// The rotation axis's.
    pub rotation: T,
}

impl<T> PerAxis<T> {
    /// Makes one value for each axis.
    pub fn from_fn(mut make: impl FnMut(Axis) -> T) -> Self {
        PerAxis { insertion: make(Axis::Insertion), rotation: make(Axis::Rotation) }
    }

    /// True when both values pass.
    pub fn all(&self, mut passes: impl FnMut(&T) -> bool) -> bool {
        passes(&self.insertion) && passes(&self.rotation)
    }
}

impl<T> Index<Axis> for PerAxis<T> {
    type Output = T;
    fn index(&self, axis: Axis) -> &T {
        match axis {
            Axis::Insertion => &self.insertion,
            Axis::Rotation => &self.rotation,
        }
    }
}

impl<T> IndexMut<Axis> for PerAxis<T> {
    fn index_mut(&mut self, axis: Axis) -> &mut T {
        match axis {
            Axis::Insertion => &mut self.insertion,
            Axis::Rotation => &mut self.rotation,
        }
    }
}

/// The purpose for which an axis is used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AxisUse {
    /// It steers a needle, or is put to a test: it must be homed, and stand within its soft limits.
    Steer,
    /// It is moved by the operator: it must be homed. If it stands outside its soft limits, it may come back.
    Move,
    /// It is held while the other axis is homed or moved.
    Hold,
    /// It is homed. If it is homed already and stands away from home, only `again` homes it.
    Home {
        /// Home it even if it is homed already and stands away from home.
        again: bool,
    },
}
