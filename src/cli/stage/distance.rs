//! Distances on the command line: a number and its unit.

use crate::stage::Axis;
use std::str::FromStr;

/// A distance along an axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Distance {
    /// `2mm`.
    Mm(f64),
    /// `10deg`.
    Deg(f64),
}

impl Distance {
    /// In the unit of `axis`, mm or rad.
    pub(super) fn along(self, axis: Axis) -> Result<f64, String> {
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

impl FromStr for Distance {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let number = |unit: &str| -> Option<f64> {
            let number: f64 = text.strip_suffix(unit)?.trim_end().parse().ok()?;
            number.is_finite().then_some(number)
        };
        match (number("mm"), number("deg")) {
            (Some(mm), _) => Ok(Distance::Mm(mm)),
            (_, Some(deg)) => Ok(Distance::Deg(deg)),
            _ => Err("a number with its unit, such as 2mm, -0.5mm or 10deg".to_owned()),
        }
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
    fn an_axis_takes_its_own_unit_alone() {
        assert_eq!(Distance::Mm(2.0).along(Axis::Insertion), Ok(2.0));
        assert_eq!(Distance::Deg(180.0).along(Axis::Rotation), Ok(std::f64::consts::PI));
        assert!(Distance::Mm(2.0).along(Axis::Rotation).is_err());
        assert!(Distance::Deg(2.0).along(Axis::Insertion).is_err());
    }
}
