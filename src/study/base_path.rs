//! The path of the needle's base: rotation over depth, piecewise linear.

use crate::needle::Increment;

/// Commanded rotation of the base over depth. It starts at 0 at depth 0.
#[derive(Debug, Clone)]
pub(super) struct BasePath {
    /// Depth, mm, and rotation, rad, at which a new rotation rate started.
    knots: Vec<(f64, f64)>,
    /// The rate since the last knot.
    rate_rad_per_mm: f64,
}

impl BasePath {
    pub(super) fn new() -> Self {
        BasePath { knots: vec![(0.0, 0.0)], rate_rad_per_mm: 0.0 }
    }

    /// Sets the rotation rate from `from_mm` on, which must not be before the start of the last rate.
    pub(super) fn set_rate(&mut self, from_mm: f64, rate_rad_per_mm: f64) {
        self.knots.push((from_mm, self.rotation_at(from_mm)));
        self.rate_rad_per_mm = rate_rad_per_mm;
    }

    /// The base's rotation at `depth_mm`, rad.
    pub(super) fn rotation_at(&self, depth_mm: f64) -> f64 {
        let after = self.knots.iter().rposition(|&(knot_mm, _)| knot_mm <= depth_mm);
        let Some((index, &(from_mm, from_rad))) =
            after.and_then(|index| Some((index, self.knots.get(index)?)))
        else {
            return 0.0;
        };
        match self.knots.get(index + 1) {
            Some(&(to_mm, to_rad)) => {
                from_rad + (to_rad - from_rad) * (depth_mm - from_mm) / (to_mm - from_mm)
            }
            None => from_rad + self.rate_rad_per_mm * (depth_mm - from_mm),
        }
    }

    /// The increments from `from_mm` to `to_mm`, one for each linear piece; none if `to_mm` is
    /// smaller.
    pub(super) fn between(&self, from_mm: f64, to_mm: f64) -> Vec<Increment> {
        let first = self.knots.partition_point(|&(knot_mm, _)| knot_mm <= from_mm);
        let inner = self.knots.iter().skip(first).take_while(|&&(knot_mm, _)| knot_mm < to_mm);
        let ends = inner.map(|&(knot_mm, _)| knot_mm).chain((to_mm > from_mm).then_some(to_mm));
        let mut at_mm = from_mm;
        let mut increments = Vec::new();
        for end_mm in ends {
            let turned_rad = self.rotation_at(end_mm) - self.rotation_at(at_mm);
            increments.extend(Increment::new(end_mm - at_mm, turned_rad).ok());
            at_mm = end_mm;
        }
        increments
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_is_straight_between_its_knots() {
        let mut path = BasePath::new();
        path.set_rate(0.0, 0.1);
        path.set_rate(2.0, -0.3);
        path.set_rate(3.0, 0.0);
        for (depth_mm, rotation_rad) in
            [(0.0, 0.0), (1.0, 0.1), (2.0, 0.2), (2.5, 0.05), (4.0, -0.1)]
        {
            assert!((path.rotation_at(depth_mm) - rotation_rad).abs() < 1e-15, "{depth_mm}");
        }
        let increments = path.between(1.5, 3.5);
        let expected = [(0.5, 0.05), (1.0, -0.3), (0.5, 0.0)];
        assert_eq!(increments.len(), expected.len());
        for (increment, (insertion_mm, rotation_rad)) in increments.iter().zip(expected) {
            assert!((increment.insertion_mm() - insertion_mm).abs() < 1e-15);
            assert!((increment.rotation_rad() - rotation_rad).abs() < 1e-15);
        }
        assert_eq!(path.between(2.0, 2.0), []);
        assert_eq!(path.between(3.0, 2.0), []);
    }
}
