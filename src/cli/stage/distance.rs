//! Distances on the command line: a number and its unit.

use crate::stage::{Axis, CountsRatio};
use std::f64::consts::TAU;
use std::fmt;
use std::str::FromStr;

/// No axis of a stage goes further, mm or degrees: the bounds of its limits in the configuration.
const MM_MAX: f64 = 1000.0;
const DEG_MAX: f64 = 360_000.0;

/// A distance along an axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::cli) enum Distance {
    /// `2mm`.
    Mm(f64),
    /// `10deg`.
    Deg(f64),
}

impl Distance {
    /// In the unit of `axis`, mm or rad.
    ///
    /// # Errors
    /// A distance of the other axis, or one that is no count of this one, of which `ratio` go into
    /// a mm or a turn.
    pub(super) fn along(self, axis: Axis, ratio: CountsRatio) -> Result<f64, String> {
        let distance = self.in_unit_of(axis)?;
        let (smallest, in_ratio_unit) = match axis {
            Axis::Insertion => (format!("{:.2e}mm", ratio.value_of(1)), distance),
            Axis::Rotation => (format!("{:.2e}deg", ratio.value_of(1) * 360.0), distance / TAU),
        };
        match ratio.nearest_count(in_ratio_unit) {
            Some(0) => Err(format!(
                "the {axis} axis would not move: --by is under half of its smallest step, {smallest}"
            )),
            _ => Ok(distance),
        }
    }

    pub(super) fn in_unit_of(self, axis: Axis) -> Result<f64, String> {
        match (self, axis) {
            (Distance::Mm(mm), Axis::Insertion) => Ok(mm),
            (Distance::Deg(deg), Axis::Rotation) => Ok(deg.to_radians()),
            (Distance::Mm(mm), Axis::Rotation) => {
                Err(format!("the rotation axis does not move by {mm}mm: give degrees, as in 10deg"))
            }
            (Distance::Deg(deg), Axis::Insertion) => {
                Err(format!("the insertion axis does not move by {deg}deg: give mm, as in 2mm"))
            }
        }
    }
}

/// As it is written on the command line.
impl fmt::Display for Distance {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Distance::Mm(mm) => write!(f, "{mm}mm"),
            Distance::Deg(deg) => write!(f, "{deg}deg"),
        }
    }
}

impl FromStr for Distance {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let number = |unit: &str| -> Option<f64> {
            let number: f64 = text.strip_suffix(unit)?.trim_end().parse().ok()?;
            number.is_finite().then_some(number)
        };
        match (number("mm"), number("deg")) {
            (Some(mm), _) if mm.abs() <= MM_MAX => Ok(Distance::Mm(mm)),
            (_, Some(deg)) if deg.abs() <= DEG_MAX => Ok(Distance::Deg(deg)),
            (None, None) => Err("a number with its unit, such as 2mm, -0.5mm or 10deg".to_owned()),
            _ => Err(format!("at most {MM_MAX}mm or {DEG_MAX}deg, either way")),
        }
    }
}

/// A speed along an axis: a distance a second.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::cli) struct Speed(Distance);

impl Speed {
    /// In the unit of `axis` a second, over 0 and up to `max`.
    ///
    /// # Errors
    /// Another unit or a speed out of range, in the unit of the command line.
    pub(super) fn along(self, axis: Axis, max: f64) -> Result<f64, String> {
        let speed = self.0.in_unit_of(axis)?;
        let (max_shown, unit) = axis.in_unit(max);
        match speed > 0.0 && speed <= max {
            true => Ok(speed),
            false => Err(format!("--speed is {self}, allowed: over 0, up to {max_shown}{unit}/s")),
        }
    }
}

impl fmt::Display for Speed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/s", self.0)
    }
}

impl FromStr for Speed {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let distance = text.strip_suffix("/s").and_then(|distance| distance.parse().ok());
        distance
            .map(Speed)
            .ok_or_else(|| "a number with its unit, such as 0.5mm/s or 20deg/s".to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_distance_has_a_unit() {
        assert_eq!("2mm".parse(), Ok(Distance::Mm(2.0)));
        assert_eq!("-0.5 mm".parse(), Ok(Distance::Mm(-0.5)));
        assert_eq!("1e1deg".parse(), Ok(Distance::Deg(10.0)));
        for wrong in ["2", "mm", "2m", "2 cm", "NaNmm", "infdeg", "1,5mm", ""] {
            assert!(wrong.parse::<Distance>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_distance_is_one_of_a_stage() {
        assert_eq!("-1000mm".parse(), Ok(Distance::Mm(-1000.0)));
        for far in ["1e300mm", "-1000.1mm", "1e9deg"] {
            let message = far.parse::<Distance>().unwrap_err();
            assert_eq!(message, "at most 1000mm or 360000deg, either way");
        }
    }

    #[test]
    fn an_axis_takes_its_own_unit_alone() {
        let ratio = CountsRatio::new(1000, 1).unwrap();
        assert_eq!(Distance::Mm(2.0).along(Axis::Insertion, ratio), Ok(2.0));
        assert_eq!(Distance::Deg(180.0).along(Axis::Rotation, ratio), Ok(std::f64::consts::PI));
        assert!(Distance::Mm(2.0).along(Axis::Rotation, ratio).is_err());
        assert!(Distance::Deg(2.0).along(Axis::Insertion, ratio).is_err());
    }

    #[test]
    fn what_moves_no_count_is_refused_with_the_smallest_step() {
        let ratio = CountsRatio::new(4646, 1).unwrap();
        assert_eq!(Distance::Mm(-0.0002).along(Axis::Insertion, ratio), Ok(-0.0002));
        assert_eq!(
            Distance::Mm(0.00001).along(Axis::Insertion, ratio).unwrap_err(),
            "the insertion axis would not move: --by is under half of its smallest step, 2.15e-4mm"
        );
        assert_eq!(
            Distance::Deg(0.0).along(Axis::Rotation, ratio).unwrap_err(),
            "the rotation axis would not move: --by is under half of its smallest step, 7.75e-2deg"
        );
    }
}
