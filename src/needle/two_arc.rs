//! The shortest possible path into the plane.

use super::{Needle, Reduced};
use crate::math;
use std::f64::consts::FRAC_PI_2;

/// Rounding tolerance for an arc of length zero.
const TOLERANCE: f64 = 1e-12;

/// The least insertion, mm, that brings a tip at (x, β) into the plane with pitch 0 when the bevel
/// may be turned at will: two arcs of the needle's curvature κ.
///
/// With s = ±1 the first arc bends the pitch by β′ = sκ to β_m = s|β_m| and the second bends it
/// back to 0. Integrating x′ = sin β along both gives `cos β_m = (κ s x + cos β + 1) / 2` and the
/// length `(s (β_m − β) + |β_m|) / κ`; the shorter of the two signs counts.
///
/// `None` if no two arcs with |β_m| ≤ π/2 reach the plane: the tip is too far out (over 1/κ), or the
/// needle is straight and not already in the plane.
pub fn shortest_into_plane_mm(needle: &Needle, state: &Reduced) -> Option<f64> {
    let Reduced { x_mm, pitch_rad, .. } = *state;
    let curvature = needle.curvature_per_mm();
    if x_mm == 0.0 && pitch_rad == 0.0 {
        return Some(0.0);
    }
    if curvature == 0.0 {
        return None;
    }
    [1.0, -1.0]
        .into_iter()
        .filter_map(|s| {
            let cos_turn = 0.5 * (curvature * s * x_mm + math::cos(pitch_rad) + 1.0);
            if !(0.0..=1.0 + TOLERANCE).contains(&cos_turn) || pitch_rad.abs() > FRAC_PI_2 {
                return None;
            }
            let turn_rad = math::acos(cos_turn.min(1.0));
            let first_rad = turn_rad - s * pitch_rad;
            (first_rad >= -TOLERANCE).then(|| (first_rad.max(0.0) + turn_rad) / curvature)
        })
        .min_by(f64::total_cmp)
}

/// An upper bound of how much nearer to the plane a needle comes over `length_mm`, mm, that heads for the
/// plane at `toward_rad`: it bends toward it all the way, and `sin(β + κ s) ≤ sin β + κ s`.
pub fn approach_max_mm(needle: &Needle, toward_rad: f64, length_mm: f64) -> f64 {
    length_mm * math::sin(toward_rad.clamp(-FRAC_PI_2, FRAC_PI_2))
        + 0.5 * needle.curvature_per_mm() * length_mm.powi(2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::needle::{Fibre, Increment};
    use proptest::prelude::*;

    /// Follows the two arcs of sign `s` with the exact kinematics; the bevel turns at standstill.
    fn follow(needle: &Needle, start: Reduced, s: f64, turn_rad: f64) -> Reduced {
        let k = needle.curvature_per_mm();
        let mut state = start;
        let arcs = [(s, turn_rad - s * start.pitch_rad), (-s, turn_rad)];
        for (sign, angle_rad) in arcs {
            state.roll_rad = sign * FRAC_PI_2;
            let tip = state.join(&Fibre::default());
            state =
                Reduced::split(&needle.step(&tip, Increment::new(angle_rad / k, 0.0).unwrap())).0;
        }
        state
    }

    proptest! {
        #[test]
        fn two_arcs_of_that_length_end_in_the_plane(x in -8.0..8.0f64, pitch in -0.2..0.2f64) {
            let needle = Needle::new(1.0 / 122.0).unwrap();
            let start = Reduced { x_mm: x, pitch_rad: pitch, roll_rad: 0.0 };
            let length = shortest_into_plane_mm(&needle, &start).unwrap();
            let reached = [1.0, -1.0].into_iter().any(|s| {
                let cos_turn = 0.5 * (s * x / 122.0 + pitch.cos() + 1.0);
                let turn = cos_turn.min(1.0).acos();
                let total = 122.0 * (turn - s * pitch + turn);
                if cos_turn > 1.0 + TOLERANCE || turn < s * pitch || (total - length).abs() > 1e-9 { return false; }
                let end = follow(&needle, start, s, turn);
                end.x_mm.abs() < 1e-9 && end.pitch_rad.abs() < 1e-9
            });
            prop_assert!(reached, "no pair of arcs of {length} mm reaches the plane");
        }

        /// One more mm at any bevel angle shortens the remaining path by at most 1 mm.
        #[test]
        fn the_length_falls_by_at_most_the_insertion(x in -8.0..8.0f64, pitch in -0.2..0.2f64, roll in -3.1..3.1f64) {
            let needle = Needle::new(1.0 / 122.0).unwrap();
            let start = Reduced { x_mm: x, pitch_rad: pitch, roll_rad: roll };
            let before = shortest_into_plane_mm(&needle, &start).unwrap();
            let tip = needle.step(&start.join(&Fibre::default()), Increment::new(1.0, 0.0).unwrap());
            let after = shortest_into_plane_mm(&needle, &Reduced::split(&tip).0).unwrap();
            prop_assert!(after >= before - 1.0 - 1e-6, "{before} to {after}");
        }
    }

    #[test]
    fn edges() {
        let needle = Needle::new(1.0 / 122.0).unwrap();
        assert_eq!(shortest_into_plane_mm(&needle, &Reduced::default()), Some(0.0));
        let far = Reduced { x_mm: 500.0, ..Reduced::default() };
        assert_eq!(shortest_into_plane_mm(&needle, &far), None);
        let straight = Needle::new(0.0).unwrap();
        let off = Reduced { x_mm: 1.0, ..Reduced::default() };
        assert_eq!(shortest_into_plane_mm(&straight, &off), None);
    }
}
