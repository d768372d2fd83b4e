//! Finds a coordinate that never changes while the others do: a tracker of two dimensions, a dead axis, or a transform
//! with a row of zeros.

use nalgebra::Vector3;
use std::collections::BTreeSet;
use std::fmt;

/// Positions that differ from one another are counted up to this number.
const COUNTED_MAX: usize = 100;
/// If no coordinate ever changes by less than this, mm, the stream is rounded, and a coordinate of a tool at rest may
/// stay the same.
const ROUNDED_MM: f64 = 0.009;

/// Watches the positions of a stream, in the tracker's frame, from the first on.
#[derive(Debug, Clone, Default)]
pub struct CoordinateWatch {
    first_mm: Option<Vector3<f64>>,
    last_mm: Vector3<f64>,
    has_changed: [bool; 3],
    /// The least change of a coordinate from one position to the next, mm.
    finest_mm: Option<f64>,
    distinct: BTreeSet<[u64; 3]>,
}

/// A coordinate that never changes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConstantCoordinate {
    axis: char,
    value_mm: f64,
    positions: usize,
}

impl fmt::Display for ConstantCoordinate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ConstantCoordinate { axis, value_mm, positions } = self;
        write!(
            f,
            "{axis} of the tracker is {value_mm:.2} mm to the bit in {positions} different positions"
        )
    }
}

impl CoordinateWatch {
    /// The fewest positions that show a constant coordinate of a tool at rest.
    pub const POSITIONS_AT_REST: usize = 10;
    /// The fewest that show it during an insertion.
    pub const POSITIONS_INSERTED: usize = COUNTED_MAX;
    /// Advice to the operator.
    pub const ADVICE: &str = "has it two dimensions, or its transform a row of zeros?";

    /// Takes the next position, mm, finite.
    pub fn take(&mut self, position_mm: &Vector3<f64>) {
        let first_mm = *self.first_mm.get_or_insert(*position_mm);
        if self.distinct.is_empty() {
            self.last_mm = first_mm;
        }
        for axis in 0..3 {
            self.has_changed[axis] |= position_mm[axis] != first_mm[axis];
        }
        let changes_mm = (position_mm - self.last_mm).abs();
        let finest_mm = changes_mm.iter().copied().filter(|mm| *mm > 0.0).chain(self.finest_mm);
        self.finest_mm = finest_mm.reduce(f64::min);
        self.last_mm = *position_mm;
        if self.distinct.len() < COUNTED_MAX {
            self.distinct.insert(position_mm.map(f64::to_bits).into());
        }
    }

    /// The coordinate that is the same to the bit in every position so far, of which at least `positions` differ from
    /// one another; the first one, if there are two. `None` for a stream that is rounded to 0.01 mm or more.
    pub fn constant(&self, positions: usize) -> Option<ConstantCoordinate> {
        let is_fine = self.finest_mm.is_some_and(|mm| mm < ROUNDED_MM);
        let axis = self.has_changed.iter().position(|has_changed| !has_changed)?;
        let value_mm = self.first_mm?[axis];
        let found = self.distinct.len();
        let constant =
            ConstantCoordinate { axis: ['x', 'y', 'z'][axis], value_mm, positions: found };
        (is_fine && found >= positions).then_some(constant)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is found in `count` positions.
    fn found(count: u32, position: impl Fn(f64) -> Vector3<f64>) -> Option<String> {
        let mut watch = CoordinateWatch::default();
        (0..count).for_each(|k| watch.take(&position(f64::from(k))));
        watch.constant(CoordinateWatch::POSITIONS_AT_REST).map(|constant| constant.to_string())
    }

    /// Noise of ±0.5.
    fn noise(k: f64) -> f64 {
        (k * 0.618_034).fract() - 0.5
    }

    #[test]
    fn a_coordinate_that_never_changes_is_named() {
        let flat = |k: f64| Vector3::new(noise(k), 0.003 * k, 7.25);
        let text = "z of the tracker is 7.25 mm to the bit in 10 different positions";
        assert_eq!(found(10, flat).as_deref(), Some(text));
        assert_eq!(found(9, flat), None);
        assert!(found(300, flat).unwrap().contains("in 100 different"));
        // One other value, however late, is enough.
        let once = |k: f64| Vector3::new(noise(k), 0.003 * k, if k == 299.0 { 7.3 } else { 7.25 });
        assert_eq!(found(300, once), None);
    }

    #[test]
    fn a_stream_that_rounds_or_repeats_may_have_one() {
        for step_mm in [0.01, 0.1, 0.5, 1.0] {
            let rounded = |k: f64| {
                let p = Vector3::new(0.009 * noise(k), noise(k + 5.0), 0.05 * k);
                p.map(|mm| (mm / step_mm).round() * step_mm)
            };
            assert_eq!(found(3000, rounded), None, "{step_mm}");
        }
        // A precise tracker with a step of 0.01 mm, at rest.
        let at_rest =
            |k: f64| Vector3::new(0.0, 0.01 * noise(k).round(), 0.01 * noise(3.0 * k).round());
        assert_eq!(found(3000, at_rest), None);
        assert_eq!(found(3000, |_| Vector3::new(1.0, 2.0, 3.0)), None, "the repeat gate sees it");
    }
}
