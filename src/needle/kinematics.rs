//! The tip's motion under insertion and rotation (paper Eq. 1), in exact steps. An error names the argument that was
//! refused, its value and the limit.

use crate::geometry::{Pose, Twist};
use nalgebra::Vector3;

/// The largest magnitude of any argument, in mm, rad or per mm. It is far beyond any needle, and so
/// small that products of a few arguments do not overflow.
pub(crate) const MAGNITUDE_MAX: f64 = 1e6;

/// The error of a `quantity` far beyond any needle.
pub fn too_large(quantity: &str, value: f64) -> String {
    format!("{quantity} is {value:e}, allowed is up to {MAGNITUDE_MAX:e} in magnitude")
}

/// Refuses a value that is not finite or over [`MAGNITUDE_MAX`] in magnitude.
pub(super) fn bounded(quantity: &str, value: f64) -> Result<(), String> {
    if !value.is_finite() {
        return Err(format!("{quantity} is {value}: not a finite number"));
    }
    match value.abs() <= MAGNITUDE_MAX {
        true => Ok(()),
        false => Err(too_large(quantity, value)),
    }
}

/// An increment of insertion and rotation, both within ±1e6; the insertion is never negative.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Increment {
    insertion_mm: f64,
    rotation_rad: f64,
}

impl Increment {
    /// An increment of `insertion_mm` ≥ 0 and `rotation_rad`.
    ///
    /// # Errors
    /// A value that is not finite or over 1e6, and an insertion below zero: the model holds only while
    /// the needle cuts tissue.
    pub fn new(insertion_mm: f64, rotation_rad: f64) -> Result<Self, String> {
        bounded("insertion increment in mm", insertion_mm)?;
        bounded("rotation increment in rad", rotation_rad)?;
        if insertion_mm < 0.0 {
            return Err(format!(
                "insertion increment is {insertion_mm} mm, the least is 0; withdrawal retraces the \
                 inserted path"
            ));
        }
        Ok(Increment { insertion_mm, rotation_rad })
    }

    /// The fraction `part` of the insertion, 0 to 1, with another, finite rotation.
    pub(super) fn part(&self, part: f64, rotation_rad: f64) -> Increment {
        Increment { insertion_mm: self.insertion_mm * part, rotation_rad }
    }

    /// The same insertion, with the base turned in the opposite direction.
    pub fn with_rotation_reversed(&self) -> Increment {
        Increment { rotation_rad: -self.rotation_rad, ..*self }
    }

    /// Insertion, mm.
    pub fn insertion_mm(&self) -> f64 {
        self.insertion_mm
    }

    /// Rotation, rad.
    pub fn rotation_rad(&self) -> f64 {
        self.rotation_rad
    }
}

/// A bevel-tip needle: the curvature κ of the arc it cuts when it is not turned, and how far the
/// tip is ahead of the point that moves along the shaft's axis.
///
/// The paper calls κ the radius; κ is the inverse of the radius (122 mm there, so κ = 1/122 per
/// mm). The paper's needle is a unicycle, `a = 0`. A real needle moves like a bicycle (Webster et
/// al. 2006, where a is ℓ₂): one point of the shaft, which corresponds to the rear wheel, moves along the shaft's
/// axis. The tip is ahead of that point by `a`, and slips sideways by the angle a κ; the direction of the slip turns
/// with the roll.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Needle {
    curvature_per_mm: f64,
    tip_ahead_mm: f64,
}

impl Needle {
    /// A needle of curvature κ ≥ 0, per mm.
    ///
    /// # Errors
    /// A curvature that is not finite, over 1e6 or negative.
    pub fn new(curvature_per_mm: f64) -> Result<Self, String> {
        bounded("needle curvature per mm", curvature_per_mm)?;
        if curvature_per_mm < 0.0 {
            return Err(format!(
                "needle curvature is {curvature_per_mm}/mm, the least is 0; turn the bevel zero by \
                 180 deg for a needle that bends the other way"
            ));
        }
        Ok(Needle { curvature_per_mm, tip_ahead_mm: 0.0 })
    }

    /// The same needle with its tip `tip_ahead_mm` ahead of the point that moves along the shaft's axis, mm
    /// (negative: behind it).
    ///
    /// # Errors
    /// A distance that is not finite or over 1e6.
    pub fn with_tip_ahead(self, tip_ahead_mm: f64) -> Result<Self, String> {
        bounded("needle tip_ahead in mm", tip_ahead_mm)?;
        Ok(Needle { tip_ahead_mm, ..self })
    }

    /// The same needle with `share` ≥ 0 of its curvature.
    pub(crate) fn with_share_of_curvature(self, share: f64) -> Self {
        Needle { curvature_per_mm: self.curvature_per_mm * share, ..self }
    }

    /// Curvature κ, per mm.
    pub fn curvature_per_mm(&self) -> f64 {
        self.curvature_per_mm
    }

    /// How far the tip is ahead of the point that moves along the shaft's axis, a, mm.
    pub fn tip_ahead_mm(&self) -> f64 {
        self.tip_ahead_mm
    }

    /// The body twist of `increment`: `(v; w) = (0, −a κ Δℓ, Δℓ; κ Δℓ, 0, Δθ)`. This is paper Eq. 1 for the point that
    /// moves along the shaft's axis, expressed at the tip: `v = e₃ Δℓ + w × a e₃`.
    pub fn twist(&self, increment: Increment) -> Twist {
        let Increment { insertion_mm, rotation_rad } = increment;
        let bend_rad = self.curvature_per_mm * insertion_mm;
        Twist {
            v: Vector3::new(0.0, -self.tip_ahead_mm * bend_rad, insertion_mm),
            w: Vector3::new(bend_rad, 0.0, rotation_rad),
        }
    }

    /// The twist's derivative with respect to κ at `insertion_mm`: `(0, −a Δℓ, 0; Δℓ, 0, 0)`.
    pub fn twist_by_curvature(&self, insertion_mm: f64) -> Twist {
        Twist {
            v: Vector3::new(0.0, -self.tip_ahead_mm * insertion_mm, 0.0),
            w: Vector3::new(insertion_mm, 0.0, 0.0),
        }
    }

    /// The tip pose after `increment`, with rotation and insertion in constant proportion:
    /// `g⁺ = g Exp(ξ)`, exact. Without insertion this is the pure rotation `Exp((0; 0, 0, Δθ))`.
    ///
    /// It agrees with independently computed matrix exponentials within 1e-9 for steps of 1e-6 to 8 mm.
    pub fn step(&self, tip: &Pose, increment: Increment) -> Pose {
        (*tip * Pose::exp(&self.twist(increment))).renormalized()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::FixedAngles;
    use proptest::prelude::*;
    use std::f64::consts::TAU;

    fn pose() -> impl Strategy<Value = Pose> {
        (prop::array::uniform3(-50.0..50.0f64), -3.0..3.0f64, -1.5..1.5f64, -3.0..3.0f64).prop_map(
            |(p, yaw, pitch, roll)| Pose {
                rotation: FixedAngles { yaw, pitch, roll }.to_rotation(),
                translation: Vector3::from(p),
            },
        )
    }

    fn increment(insertion_mm: f64, rotation_rad: f64) -> Increment {
        Increment::new(insertion_mm, rotation_rad).unwrap()
    }

    fn distance(a: &Pose, b: &Pose) -> f64 {
        (a.translation - b.translation).norm() + (a.rotation.matrix() - b.rotation.matrix()).norm()
    }

    proptest! {
        #[test]
        fn steps_compose(g in pose(), k in 0.0..0.05f64, w in -3.0..3.0f64, l in 0.0..5.0f64, f in 0.0..1.0f64) {
            let needle = Needle::new(k).unwrap();
            let whole = needle.step(&g, increment(l, w * l));
            let part = needle.step(&g, increment(l * f, w * l * f));
            let parts = needle.step(&part, increment(l * (1.0 - f), w * l * (1.0 - f)));
            prop_assert!(distance(&whole, &parts) < 1e-12);
        }

        #[test]
        fn kinematics_are_left_invariant(h in pose(), g in pose(), w in -3.0..3.0f64, l in 0.0..5.0f64) {
            let needle = Needle::new(1.0 / 122.0).unwrap();
            let i = increment(l, w * l);
            prop_assert!(distance(&(h * needle.step(&g, i)), &needle.step(&(h * g), i)) < 1e-10);
        }

        #[test]
        fn extreme_arguments_give_finite_poses(g in pose(), k in prop::sample::select(vec![0.0, 1e-300, 1e-12, 1.0, 1e3]),
            l in prop::sample::select(vec![0.0, 1e-300, 1e-12, 1.0, 1e4]), r in prop::sample::select(vec![0.0, 1e-300, -1e-12, 7.0, 1e6])) {
            prop_assert!(Needle::new(k).unwrap().step(&g, increment(l, r)).is_finite());
        }
    }

    /// Without rotation the tip follows a circle of radius 1/κ towards −y.
    #[test]
    fn an_unturned_needle_cuts_a_circle() {
        let radius_mm = 122.0;
        let needle = Needle::new(1.0 / radius_mm).unwrap();
        let quarter = needle.step(&Pose::identity(), increment(radius_mm * TAU / 4.0, 0.0));
        assert!((quarter.translation - Vector3::new(0.0, -radius_mm, radius_mm)).norm() < 1e-10);
        let full = needle.step(&Pose::identity(), increment(radius_mm * TAU, 0.0));
        assert!(distance(&full, &Pose::identity()) < 1e-10);
    }

    /// Turned at a constant rate ω the tip follows a helix about the axis of the constant twist:
    /// radius κ/(κ²+ω²), advance ω/√(κ²+ω²) per mm.
    #[test]
    fn a_turning_needle_cuts_a_helix() {
        let (k, w) = (0.02, 0.3f64);
        let needle = Needle::new(k).unwrap();
        let axis = Vector3::new(k, 0.0, w).normalize();
        let rate = k.hypot(w);
        let centre = axis.cross(&Vector3::z()) / rate;
        let turn_mm = TAU / rate;
        let whole = needle.step(&Pose::identity(), increment(turn_mm, w * turn_mm)).translation;
        assert!((whole - axis * (w / rate * turn_mm)).norm() < 1e-9);
        for n in 1..=40 {
            let l = 0.7 * f64::from(n);
            let p = needle.step(&Pose::identity(), increment(l, w * l)).translation - centre;
            let from_axis = (p - axis * p.dot(&axis)).norm();
            assert!((from_axis - k / (rate * rate)).abs() < 1e-9, "{from_axis}");
        }
    }

    /// The tip is the point `a_mm` ahead of the point on the shaft that moves along its own axis.
    #[test]
    fn a_tip_ahead_moves_as_in_the_bicycle_model() {
        let (rear, a_mm) = (Needle::new(0.011).unwrap(), 6.5);
        let needle = rear.with_tip_ahead(a_mm).unwrap();
        let ahead = Pose { translation: Vector3::z() * a_mm, ..Pose::identity() };
        let start = Pose {
            rotation: FixedAngles { yaw: 0.3, pitch: -0.2, roll: 1.0 }.to_rotation(),
            translation: Vector3::new(1.0, 2.0, 3.0),
        };
        for i in [increment(3.0, 0.0), increment(0.0, 2.0), increment(2.0, -3.0)] {
            let tip = needle.step(&(start * ahead), i);
            assert!(distance(&tip, &(rear.step(&start, i) * ahead)) < 1e-12);
        }
        let (l_mm, by_k) = (0.7, needle.twist_by_curvature(0.7).to_vector());
        let more = Needle::new(1.011).unwrap().with_tip_ahead(a_mm).unwrap();
        let xi = |n: &Needle| n.twist(increment(l_mm, 0.4)).to_vector();
        assert!((xi(&more) - xi(&needle) - by_k).norm() < 1e-12);
    }

    #[test]
    fn arguments_out_of_range_are_refused_with_the_limit() {
        let needle = Needle::new(0.01).unwrap();
        for error in [
            needle.with_tip_ahead(f64::NAN).unwrap_err(),
            Needle::new(f64::NAN).unwrap_err(),
            Increment::new(0.0, f64::INFINITY).unwrap_err(),
        ] {
            assert!(error.contains("not a finite number"));
        }
        assert!(Needle::new(-0.01).unwrap_err().starts_with("needle curvature is -0.01/mm"));
        assert!(Needle::new(1.1e6).unwrap_err().contains("up to 1e6"));
        assert!(Increment::new(1e308, 0.0).unwrap_err().contains("up to 1e6"));
        assert!(Increment::new(-1e-9, 0.0).unwrap_err().contains("the least is 0"));
        assert_eq!(
            Increment::new(0.0, -1e308).unwrap_err(),
            "rotation increment in rad is -1e308, allowed is up to 1e6 in magnitude"
        );
    }
}
