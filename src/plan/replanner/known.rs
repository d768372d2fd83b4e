//! Known paths: those that are found without a search.

use super::super::arc::{Arc, Tip};
use super::super::nearest::sharpest_arc;
use super::super::path::Path;
use super::super::problem::Problem;
use super::{Replanner, rest_of};
use crate::math;
use nalgebra::Vector3;
use std::f64::consts::{FRAC_PI_2, TAU};

/// Distance between the points of the last path from which the target is tried again, mm.
const TRY_MM: f64 = 2.0;
/// Distance between the points of the remembered path at which the tip may come back onto it, mm.
const JOIN_MM: f64 = 4.0;
/// An arc of a known path may be sharper by this share than the estimated curvature of the needle allows.
const CURVATURE_SLACK: f64 = 0.05;

impl Replanner {
    /// A path that is found without a search.
    pub(super) fn known(&mut self, last: Option<&Path>) -> Option<Path> {
        // If one arc is too long, several may be short enough.
        let known = self.direct().or_else(|| self.redirected(last?));
        let known = known.or_else(|| self.nearly_direct());
        known.or_else(|| self.continued(last?)).or_else(|| self.rejoined())
    }

    fn is_short(&self, path: &Path) -> bool {
        path.length_mm() <= self.problem.length_max_mm
    }

    /// In the plane: back onto the remembered path, if the way there and the path from there on are clear.
    fn rejoined(&mut self) -> Option<Path> {
        let Problem { start, curvature_per_mm, in_plane, .. } = self.problem;
        let (path, along_mm) = self.remembered.clone().filter(|_| in_plane)?;
        if !self.ends_near(&path) || !path.arcs.iter().all(|arc| self.can_follow(arc)) {
            return None;
        }
        let joins = ((path.length_mm() - along_mm) / JOIN_MM) as u32;
        let mut joins = (1..=joins).map(|join| along_mm + JOIN_MM * f64::from(join));
        joins.find_map(|join_mm| {
            let (to, _) = path.at(join_mm);
            let rest = rest_of(&path, join_mm, to);
            ways_in_plane(&start, &to, curvature_per_mm).find_map(|way| {
                let whole = Path { start, arcs: [&way[..], &rest.arcs[..]].concat() };
                (self.is_short(&whole) && self.is_clear(&whole)).then(|| whole.joined())
            })
        })
    }

    /// The arc to the target; if that is too sharp, the sharpest arc toward it, up to the point nearest to it. Either
    /// ends where the longest path ends.
    pub(super) fn sharpest(&self) -> Path {
        let Problem { start, length_max_mm, target_mm, curvature_per_mm, .. } = self.problem;
        let direct =
            start.arc_to(&target_mm).filter(|arc| arc.curvature_per_mm <= curvature_per_mm);
        let arc = direct.unwrap_or_else(|| sharpest_arc(&start, &self.problem, length_max_mm));
        Path { start, arcs: vec![arc.with_length(arc.length_mm.min(length_max_mm))] }
    }

    /// The arc of [`Replanner::sharpest`], if it is clear and ends within the tolerance.
    fn nearly_direct(&mut self) -> Option<Path> {
        let path = self.sharpest();
        let is_free = self.ends_near(&path) && self.field.is_clear(&path.start, &path.arcs[0]);
        is_free.then_some(path)
    }

    fn ends_near(&self, path: &Path) -> bool {
        self.miss_mm(path) <= self.problem.tolerance_mm
    }

    /// The `last` path unchanged, if it is clear and ends within the tolerance.
    fn continued(&mut self, last: &Path) -> Option<Path> {
        let can_follow = last.arcs.iter().all(|arc| self.can_follow(arc));
        (can_follow && self.ends_near(last) && self.is_clear(last)).then(|| last.clone())
    }

    fn is_clear(&mut self, path: &Path) -> bool {
        self.begins_clear(path, f64::INFINITY)
    }

    /// True if the needle can follow this arc of a known path, by the estimate of its curvature.
    fn can_follow(&self, arc: &Arc) -> bool {
        arc.curvature_per_mm <= self.problem.curvature_per_mm * (1.0 + CURVATURE_SLACK)
    }

    /// One arc from the tip to the target, if it is clear and not too long.
    fn direct(&mut self) -> Option<Path> {
        let start = self.problem.start;
        let arc = start.arc_to(&self.problem.target_mm)?;
        let is_bent = arc.curvature_per_mm <= self.problem.curvature_per_mm;
        let is_free = is_bent && self.field.is_clear(&start, &arc);
        is_free.then(|| Path { start, arcs: vec![arc] }).filter(|path| self.is_short(path))
    }

    /// The `last` path up to some point, then directly to the target; the shortest of these paths.
    fn redirected(&mut self, last: &Path) -> Option<Path> {
        let mut best: Option<Path> = None;
        let mut arcs = Vec::new();
        for (start, arc) in last.pieces() {
            // The needle bends less than its estimate said when the path was found.
            if !self.can_follow(&arc) {
                break;
            }
            let parts = (arc.length_mm / TRY_MM).ceil().max(1.0);
            for part in 0..parts as u32 {
                let cut = arc.with_length(arc.length_mm * f64::from(part) / parts);
                if !self.field.is_clear(&start, &cut) {
                    return best.map(Path::joined);
                }
                let rest = self.shortest_clear(&start.after(&cut));
                let whole = rest.map(|rest| Path {
                    start: last.start,
                    arcs: [&arcs[..], &[cut], &rest[..]].concat(),
                });
                let length_mm =
                    |path: &Option<Path>| path.as_ref().map_or(f64::INFINITY, Path::length_mm);
                let whole = whole.filter(|whole| self.is_short(whole));
                if length_mm(&whole) < length_mm(&best) {
                    best = whole;
                }
            }
            if !self.field.is_clear(&start, &arc) {
                break;
            }
            arcs.push(arc);
        }
        best.map(Path::joined)
    }

    /// An arc and a straight from `tip` to the target, or if that is not clear, a single arc.
    fn shortest_clear(&mut self, tip: &Tip) -> Option<Vec<Arc>> {
        let Problem { target_mm, curvature_per_mm, .. } = self.problem;
        let turning = tip.arc_then_straight_to(&target_mm, curvature_per_mm);
        let bent = tip.arc_to(&target_mm).filter(|arc| arc.curvature_per_mm <= curvature_per_mm);
        let ways = [turning.map(Vec::from), bent.map(|arc| vec![arc])];
        ways.into_iter()
            .flatten()
            .find(|arcs| self.is_clear(&Path { start: *tip, arcs: arcs.clone() }))
    }
}

/// The side to which an arc turns: toward [`across`] of the heading, or away from it.
const SIDES: [f64; 2] = [1.0, -1.0];
/// Rounding must not turn "straight ahead" into a full turn, rad.
const NO_TURN_RAD: f64 = 1e-9;

/// Ways from `from` to the position and heading of `to`, both in the plane x = 0: an arc of `curvature_per_mm`, a
/// straight, and another such arc. For each choice of sides there is a way if both arcs turn by less than a
/// quarter turn.
///
/// The straight is the common tangent of the two circles (Dubins 1957). With their centres D apart its length is D
/// if both arcs turn to the same side, else √(D² − 4 r²).
fn ways_in_plane(from: &Tip, to: &Tip, curvature_per_mm: f64) -> impl Iterator<Item = [Arc; 3]> {
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

/// The unit vector in the plane across a heading; for a heading along z it is +y.
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
        /// Every way ends at its goal. A goal ahead that two arcs can reach has a way.
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
