//! Distances and speeds on the command line: a number and its unit.

use crate::stage::{Axis, CountsRatio};
use derive_more::Display;

/// Longest distance along each axis, in its unit: the largest limits that the configuration allows.
const DISTANCE_MAX: [(Axis, f64); 2] = [(Axis::Insertion, 1000.0), (Axis::Rotation, 360_000.0)];

/// A distance along an axis, such as `2mm` or `10deg`; or a speed, the distance a second. As text it is written as on
/// the command line.
#[derive(Debug, Clone, Copy, PartialEq, Display)]
#[display("{value}{}", self.axis.unit())]
pub(in crate::cli) struct Distance {
    /// In the unit of `axis`: mm or deg.
    value: f64,
    axis: Axis,
}

impl Distance {
    /// Reads a distance.
    pub(super) fn parse(text: &str) -> Result<Self, String> {
        for (axis, max) in DISTANCE_MAX {
            let number = text.strip_suffix(axis.unit());
            let number = number.and_then(|number| number.trim_end().parse().ok());
            match number.filter(|value: &f64| value.is_finite()) {
                Some(value) if value.abs() <= max => return Ok(Distance { value, axis }),
                Some(_) => return Err("at most 1000mm or 360000deg, either way".to_owned()),
                None => {}
            }
        }
        Err("a number with its unit, such as 2mm, -0.5mm or 10deg".to_owned())
    }

    /// Reads a speed.
    pub(super) fn parse_speed(text: &str) -> Result<Self, String> {
        let distance = text.strip_suffix("/s").and_then(|text| Distance::parse(text).ok());
        distance.ok_or_else(|| "a number with its unit, such as 0.5mm/s or 20deg/s, at most 1000mm/s or 360000deg/s".to_owned())
    }

    /// The distance along `axis`, mm or rad.
    ///
    /// # Errors
    /// The unit is that of the other axis.
    pub(super) fn along(self, axis: Axis) -> Result<f64, String> {
        match axis {
            _ if self.axis != axis => {
                let unit = axis.unit();
                Err(format!(
                    "{self} is not for the {axis} axis: give {unit}, or {unit}/s for a speed"
                ))
            }
            Axis::Insertion => Ok(self.value),
            Axis::Rotation => Ok(self.value.to_radians()),
        }
    }

    /// As [`along`](Self::along), for an axis with `ratio` counts per mm or per turn.
    ///
    /// # Errors
    /// Also a distance that rounds to 0 counts.
    pub(super) fn nonzero_along(self, axis: Axis, ratio: CountsRatio) -> Result<f64, String> {
        let distance = self.along(axis)?;
        let per_unit = if axis == Axis::Rotation { 360.0 } else { 1.0 };
        match ratio.nearest_count(self.value / per_unit) {
            Some(0) => {
                let smallest = format!("{:.2e}", ratio.value_of(1) * per_unit);
                let unit = axis.unit();
                Err(format!(
                    "the {axis} axis would not move: --by is under half of its smallest step, \
                     {smallest}{unit}"
                ))
            }
            _ => Ok(distance),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MM: Axis = Axis::Insertion;
    const DEG: Axis = Axis::Rotation;

    fn distance(value: f64, axis: Axis) -> Distance {
        Distance { value, axis }
    }

    #[test]
    fn a_distance_has_a_unit() {
        assert_eq!(Distance::parse("2mm"), Ok(distance(2.0, MM)));
        assert_eq!(Distance::parse("-0.5 mm"), Ok(distance(-0.5, MM)));
        assert_eq!(Distance::parse("1e1deg"), Ok(distance(10.0, DEG)));
        assert_eq!(Distance::parse_speed("20deg/s"), Ok(distance(20.0, DEG)));
        for wrong in ["2", "mm", "2m", "2 cm", "NaNmm", "infdeg", "1,5mm", "", "2mm/s"] {
            let refused = Distance::parse(wrong).unwrap_err();
            assert_eq!(refused, "a number with its unit, such as 2mm, -0.5mm or 10deg", "{wrong}");
            assert!(Distance::parse_speed(wrong).is_err() || wrong == "2mm/s", "{wrong}");
        }
    }

    #[test]
    fn a_distance_beyond_any_stage_is_refused() {
        assert_eq!(Distance::parse("-1000mm"), Ok(distance(-1000.0, MM)));
        for far in ["1e300mm", "-1000.1mm", "1e9deg"] {
            let message = Distance::parse(far).unwrap_err();
            assert_eq!(message, "at most 1000mm or 360000deg, either way");
        }
    }

    #[test]
    fn an_axis_takes_its_own_unit_alone() {
        assert_eq!(distance(2.0, MM).along(MM), Ok(2.0));
        assert_eq!(distance(180.0, DEG).along(DEG), Ok(std::f64::consts::PI));
        let error = distance(2.0, MM).along(DEG).unwrap_err();
        assert_eq!(error, "2mm is not for the rotation axis: give deg, or deg/s for a speed");
        let error = distance(2.0, DEG).along(MM).unwrap_err();
        assert_eq!(error, "2deg is not for the insertion axis: give mm, or mm/s for a speed");
    }

    #[test]
    fn a_move_under_half_a_count_is_refused_with_the_smallest_step() {
        let ratio = CountsRatio::new(4646, 1).unwrap();
        assert_eq!(distance(-0.0002, MM).nonzero_along(MM, ratio), Ok(-0.0002));
        assert_eq!(
            distance(0.00001, MM).nonzero_along(MM, ratio).unwrap_err(),
            "the insertion axis would not move: --by is under half of its smallest step, 2.15e-4mm"
        );
        assert_eq!(
            distance(0.0, DEG).nonzero_along(DEG, ratio).unwrap_err(),
            "the rotation axis would not move: --by is under half of its smallest step, 7.75e-2deg"
        );
    }
}
