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
/// back to 0. Integrating x′ = sin β along both arcs gives `cos β_m = (κ s x + cos β + 1) / 2` and the
/// length `(s (β_m − β) + |β_m|) / κ`; the sign with the shorter length counts. If that cosine is
/// negative (without pitch: for |x| over 2/κ), the arcs turn to 90° and back, and a straight of length
/// `−2 cos β_m / κ` between them covers the rest of x.
///
/// x belongs to the point that moves along the shaft's axis. In the plane and without pitch, the tip is in the
/// plane as well.
///
/// `None` if the needle is straight and not already in the plane, or |β| is over π/2.
pub fn shortest_into_plane_mm(needle: &Needle, state: &Reduced) -> Option<f64> {
    let Reduced { pitch_rad, .. } = *state;
    let x_mm = state.x_mm - needle.tip_ahead_mm() * math::sin(pitch_rad);
    let curvature = needle.curvature_per_mm();
    if x_mm == 0.0 && pitch_rad == 0.0 {
        return Some(0.0);
    }
    if curvature == 0.0 || pitch_rad.abs() > FRAC_PI_2 {
        return None;
    }
    [1.0, -1.0]
        .into_iter()
        .filter_map(|s| {
            let cos_turn = 0.5 * (curvature * s * x_mm + math::cos(pitch_rad) + 1.0);
            let turn_rad = math::acos(cos_turn.clamp(0.0, 1.0));
            let straight_rad = -2.0 * cos_turn.min(0.0);
            let first_rad = turn_rad - s * pitch_rad;
            let exists = cos_turn <= 1.0 + TOLERANCE && first_rad >= -TOLERANCE;
            exists.then(|| (first_rad.max(0.0) + straight_rad + turn_rad) / curvature)
        })
        .min_by(f64::total_cmp)
}

/// An upper bound, mm, of how much nearer to the plane the tip comes over `length_mm` if it heads for the plane at
/// `toward_rad`. The bound assumes that the needle bends toward the plane all the way, with
/// `sin(β + κ s) ≤ sin β + κ s`. A tip that is ahead of the point that moves along the shaft's axis also comes
/// nearer by the turn of the heading times that distance.
pub fn approach_max_mm(needle: &Needle, toward_rad: f64, length_mm: f64) -> f64 {
    let curvature = needle.curvature_per_mm();
    length_mm * math::sin(toward_rad.min(FRAC_PI_2))
        + 0.5 * curvature * length_mm.powi(2)
        + needle.tip_ahead_mm().abs() * curvature * length_mm
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
    fn a_start_in_the_plane_has_length_0_and_one_without_a_path_none() {
        let needle = Needle::new(1.0 / 122.0).unwrap();
        assert_eq!(shortest_into_plane_mm(&needle, &Reduced::default()), Some(0.0));
        let off = |x_mm: f64| Reduced { x_mm, ..Reduced::default() };
        let straight = Needle::new(0.0).unwrap();
        assert_eq!(shortest_into_plane_mm(&straight, &off(1.0)), None);
        let away = Reduced { pitch_rad: 1.6, ..off(1.0) };
        assert_eq!(shortest_into_plane_mm(&needle, &away), None);
        assert_eq!(shortest_into_plane_mm(&needle, &off(f64::NAN)), None);
    }

    /// From 244 mm on, two quarters of a circle do not reach the plane.
    #[test]
    fn a_tip_far_from_the_plane_goes_straight_between_the_arcs() {
        let needle = Needle::new(1.0 / 122.0).unwrap();
        for (x_mm, straight_mm) in [(244.0, 0.0), (-300.0, 56.0), (500.0, 256.0)] {
            let state = Reduced { x_mm, ..Reduced::default() };
            let length_mm = shortest_into_plane_mm(&needle, &state).unwrap();
            let expected_mm = 122.0 * std::f64::consts::PI + straight_mm;
            assert!((length_mm - expected_mm).abs() < 1e-5, "{x_mm}: {length_mm}");
        }
    }

    /// The point that moves along the axis is 6.5 mm behind the tip.
    #[test]
    fn a_tip_ahead_of_the_rear_point_is_counted() {
        let rear = Needle::new(1.0 / 122.0).unwrap();
        let needle = rear.with_tip_ahead(6.5).unwrap();
        let start = Reduced { x_mm: 20.0, pitch_rad: -0.1, roll_rad: -FRAC_PI_2 };
        let at_rear = Reduced { x_mm: 20.0 + 6.5 * 0.1f64.sin(), ..start };
        assert_eq!(
            shortest_into_plane_mm(&needle, &start),
            shortest_into_plane_mm(&rear, &at_rear)
        );
        let bent = needle.step(&start.join(&Fibre::default()), Increment::new(40.0, 0.0).unwrap());
        let nearer_mm = start.x_mm - bent.translation.x;
        let most_mm = approach_max_mm(&needle, 0.1, 40.0);
        assert!((nearer_mm..nearer_mm + 0.5).contains(&most_mm), "{nearer_mm} of {most_mm}");
    }
}
