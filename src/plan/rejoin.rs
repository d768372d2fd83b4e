//! The way back onto a path in the plane.

use super::arc::{Arc, Tip};
use crate::math;
use nalgebra::Vector3;
use std::f64::consts::{FRAC_PI_2, TAU};

/// Which way an arc turns: toward +y of the heading, or away from it.
const SIDES: [f64; 2] = [1.0, -1.0];
/// Rounding must not turn "straight ahead" into a full turn, rad.
const NO_TURN_RAD: f64 = 1e-9;

/// Arc, straight, arc of `curvature_per_mm` from `from` to the place and heading of `to`, both in the
/// plane x = 0: of each choice of sides the way, if it turns by less than a quarter each time.
///
/// With the centres of the two circles D apart, the straight is the tangent to both (Dubins 1957): as long
/// as D on one side, √(D² − 4 r²) across.
pub(super) fn ways_in_plane(
    from: &Tip,
    to: &Tip,
    curvature_per_mm: f64,
) -> impl Iterator<Item = [Arc; 3]> {
    let (from, to) = (*from, *to);
    let sides = SIDES.into_iter().flat_map(|first| SIDES.map(|second| (first, second)));
    sides.filter_map(move |sides| way(&from, &to, curvature_per_mm, sides))
}

fn way(
    from: &Tip,
    to: &Tip,
    curvature_per_mm: f64,
    (first, second): (f64, f64),
) -> Option<[Arc; 3]> {
    let radius_mm = curvature_per_mm.recip();
    let centre = |tip: &Tip, side: f64| tip.position_mm + across(&tip.heading) * (side * radius_mm);
    let between = centre(to, second) - centre(from, first);
    let apart_mm = math::hypot(between.y, between.z);
    let over_mm = (first - second) * radius_mm;
    let straight2_mm2 = apart_mm * apart_mm - over_mm * over_mm;
    if straight2_mm2 < 0.0 {
        return None;
    }
    let straight_mm = straight2_mm2.sqrt();
    let along_rad = math::atan2(between.y, between.z) + math::atan2(over_mm, straight_mm);
    let heading_rad = |tip: &Tip| math::atan2(tip.heading.y, tip.heading.z);
    let turns_rad =
        [first * (along_rad - heading_rad(from)), second * (heading_rad(to) - along_rad)];
    let [turn_in, turn_out] = turns_rad.map(|turn_rad| {
        let turn_rad = turn_rad.rem_euclid(TAU);
        if turn_rad > TAU - NO_TURN_RAD { 0.0 } else { turn_rad }
    });
    if turn_in.max(turn_out) >= FRAC_PI_2 {
        return None;
    }
    let bent = |tip: &Tip, side: f64, turn_rad: f64| Arc {
        bend: across(&tip.heading) * side,
        curvature_per_mm,
        length_mm: turn_rad * radius_mm,
    };
    let turning_in = bent(from, first, turn_in);
    let straight_from = from.after(&turning_in);
    let bend = across(&straight_from.heading);
    let straight = Arc { bend, curvature_per_mm: 0.0, length_mm: straight_mm };
    let turning_out = bent(&straight_from.after(&straight), second, turn_out);
    Some([turning_in, straight, turning_out])
}

/// The unit vector in the plane across a heading, toward +y of one along z.
fn across(heading: &Vector3<f64>) -> Vector3<f64> {
    Vector3::new(0.0, heading.z, -heading.y)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn tip(y: f64, z: f64, heading_rad: f64) -> Tip {
        let (sin, cos) = heading_rad.sin_cos();
        Tip { position_mm: Vector3::new(0.0, y, z), heading: Vector3::new(0.0, sin, cos) }
    }

    proptest! {
        /// Every way ends where it is to end, and a place ahead that is aside by no more than two arcs
        /// can turn has one.
        #[test]
        fn ways_end_at_place_and_heading(
            y in -2.0..2.0f64, z in 60.0..100.0f64, turned in -0.05..0.05f64, heading in -1.0..1.0f64,
        ) {
            let curvature_per_mm = 1.0 / 122.0;
            let (from, to) = (tip(0.0, 0.0, 0.0), tip(y, z, turned));
            let turn = |tip: Tip| {
                let angle = nalgebra::Rotation3::from_axis_angle(&Vector3::x_axis(), heading);
                Tip { position_mm: angle * tip.position_mm, heading: angle * tip.heading }
            };
            let (from, to) = (turn(from), turn(to));
            let ways: Vec<_> = ways_in_plane(&from, &to, curvature_per_mm).collect();
            prop_assert!(!ways.is_empty());
            for way in ways {
                let end = way.iter().fold(from, |tip, arc| tip.after(arc));
                prop_assert!((end.position_mm - to.position_mm).norm() < 1e-6, "{way:?}");
                prop_assert!((end.heading - to.heading).norm() < 1e-6, "{way:?}");
            }
        }
    }
}
