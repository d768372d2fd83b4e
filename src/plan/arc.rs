//! The motion of the tip on arcs, and the shortest way to a point without obstacles.

use crate::math;
use nalgebra::Vector3;
use std::f64::consts::{PI, TAU};

/// Distance from the tip's axis under which a point counts as straight ahead, mm.
const STRAIGHT_MM: f64 = 1e-9;

/// Position and heading of the needle's tip. The base can turn the tip to any roll, so a plan does not contain it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tip {
    /// Position, plane frame, mm.
    pub position_mm: Vector3<f64>,
    /// Unit vector along the tip's axis.
    pub heading: Vector3<f64>,
}

/// A piece of path of constant curvature.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Arc {
    /// Unit vector across the heading at the start of the arc: the path bends toward it.
    pub bend: Vector3<f64>,
    /// Curvature, 0 or more, per mm; 0 is straight.
    pub curvature_per_mm: f64,
    /// Length, mm.
    pub length_mm: f64,
}

impl Arc {
    /// The same arc with another length.
    pub fn with_length(self, length_mm: f64) -> Self {
        Arc { length_mm, ..self }
    }
}

/// The end of a bent arc relative to its start: distances ahead and aside, mm, and the sine and cosine of the turn.
#[derive(Debug, Clone, Copy)]
pub(super) struct Chord {
    ahead_mm: f64,
    aside_mm: f64,
    sin: f64,
    pub(super) cos: f64,
}

impl Chord {
    /// The chord of an arc with this curvature, over 0, and length.
    pub(super) fn of(curvature_per_mm: f64, length_mm: f64) -> Self {
        let angle_rad = curvature_per_mm * length_mm;
        let (sin, cos) = math::sin_cos(angle_rad);
        let half = math::sin(0.5 * angle_rad);
        let (ahead_mm, aside_mm) = (sin / curvature_per_mm, 2.0 * half * half / curvature_per_mm);
        Chord { ahead_mm, aside_mm, sin, cos }
    }
}

/// A point relative to the tip.
pub(super) struct RelativePoint {
    /// Distance from the tip's axis, ρ, mm.
    pub(super) off_axis_mm: f64,
    /// Distance along the tip's axis, mm; negative behind the tip.
    pub(super) ahead_mm: f64,
    /// Unit vector across the axis, toward the point.
    pub(super) bend: Vector3<f64>,
}

impl Tip {
    /// The tip at the end of `arc`.
    pub fn after(&self, arc: &Arc) -> Tip {
        let Arc { bend, curvature_per_mm, length_mm } = *arc;
        if curvature_per_mm == 0.0 {
            return Tip { position_mm: self.position_mm + self.heading * length_mm, ..*self };
        }
        self.at_end_of(&Chord::of(curvature_per_mm, length_mm), &bend)
    }

    /// The tip at the end of the arc with this chord.
    pub(super) fn at_end_of(&self, chord: &Chord, bend: &Vector3<f64>) -> Tip {
        let Chord { ahead_mm, aside_mm, sin, cos } = *chord;
        Tip {
            position_mm: self.position_mm + self.heading * ahead_mm + bend * aside_mm,
            heading: self.heading * cos + bend * sin,
        }
    }

    /// Two perpendicular unit vectors across the heading. They depend only on the heading.
    pub fn across(&self) -> [Vector3<f64>; 2] {
        let axis = Vector3::ith(self.heading.iamin(), 1.0);
        let first = self.heading.cross(&axis).normalize();
        [first, self.heading.cross(&first)]
    }

    pub(super) fn relative(&self, point_mm: &Vector3<f64>) -> RelativePoint {
        let to_point = point_mm - self.position_mm;
        let ahead_mm = to_point.dot(&self.heading);
        let across = to_point - self.heading * ahead_mm;
        let off_axis_mm = across.norm();
        let is_aside = off_axis_mm > STRAIGHT_MM;
        let bend = if is_aside { across / off_axis_mm } else { self.across()[0] };
        RelativePoint { off_axis_mm, ahead_mm, bend }
    }

    /// The single arc to `point_mm`: curvature `κ = 2ρ / (ρ² + z²)` and length `2 atan2(ρ, z) / κ` for a
    /// point ρ off the axis and z ahead. `None` for a point behind the tip or at it.
    pub fn arc_to(&self, point_mm: &Vector3<f64>) -> Option<Arc> {
        let RelativePoint { off_axis_mm, ahead_mm, bend } = self.relative(point_mm);
        if ahead_mm < 0.0 || off_axis_mm + ahead_mm <= STRAIGHT_MM {
            return None;
        }
        if off_axis_mm <= STRAIGHT_MM {
            return Some(Arc { bend, curvature_per_mm: 0.0, length_mm: ahead_mm });
        }
        let curvature_per_mm =
            2.0 * off_axis_mm / (off_axis_mm * off_axis_mm + ahead_mm * ahead_mm);
        let length_mm = 2.0 * math::atan2(off_axis_mm, ahead_mm) / curvature_per_mm;
        Some(Arc { bend, curvature_per_mm, length_mm })
    }

    /// The shortest way to `point_mm` with a curvature of at most `curvature_per_mm` > 0: an arc of that
    /// curvature, then straight. With r = 1/κ, a point ρ off the axis and z ahead, d² = (ρ − r)² + z² and
    /// t² = d² − r², the arc turns by `atan2(z r − (r − ρ) t, (r − ρ) r + z t)` and t is straight.
    /// `None` for a point inside the turning circle, for which there is no such way.
    pub fn arc_then_straight_to(
        &self,
        point_mm: &Vector3<f64>,
        curvature_per_mm: f64,
    ) -> Option<[Arc; 2]> {
        let relative = self.relative(point_mm);
        let (turn_rad, straight_mm) = relative.turn_then_straight(curvature_per_mm)?;
        let arc =
            Arc { bend: relative.bend, curvature_per_mm, length_mm: turn_rad / curvature_per_mm };
        let (sin, cos) = math::sin_cos(turn_rad);
        let bend = relative.bend * cos - self.heading * sin;
        Some([arc, Arc { bend, curvature_per_mm: 0.0, length_mm: straight_mm }])
    }

    /// A lower bound of the length plus the remaining distance, mm, of any way that ends within `tolerance_mm`
    /// of `point_mm`, without obstacles. Outside the turning circle it is the length of
    /// [`Tip::arc_then_straight_to`]. In space a way to a point that is inside by more than the tolerance takes at
    /// least half a circle (Schur: a curve of curvature at most 1/r that touches a ball of radius r enters it only
    /// after π r), in the plane more: it turns away first.
    pub fn shortest_mm(
        &self,
        point_mm: &Vector3<f64>,
        curvature_per_mm: f64,
        tolerance_mm: f64,
        in_plane: bool,
    ) -> f64 {
        let relative = self.relative(point_mm);
        if let Some((turn_rad, straight_mm)) = relative.turn_then_straight(curvature_per_mm) {
            return turn_rad / curvature_per_mm + straight_mm;
        }
        let RelativePoint { off_axis_mm, ahead_mm, .. } = relative;
        let radius_mm = curvature_per_mm.recip();
        let from_centre_mm = math::hypot(radius_mm - off_axis_mm, ahead_mm);
        if radius_mm - from_centre_mm <= tolerance_mm {
            return math::hypot(off_axis_mm, ahead_mm);
        }
        let half_circle_mm = PI * radius_mm;
        match in_plane {
            true => half_circle_mm.max(relative.away_then_toward_mm(radius_mm, tolerance_mm)),
            false => half_circle_mm,
        }
    }
}

impl RelativePoint {
    /// The turn of the arc, rad, and the length of the straight after it, mm; `None` inside the turning circle.
    fn turn_then_straight(&self, curvature_per_mm: f64) -> Option<(f64, f64)> {
        let radius_mm = curvature_per_mm.recip();
        let (from_axis_mm, ahead_mm) = (radius_mm - self.off_axis_mm, self.ahead_mm);
        let tangent2_mm2 =
            ahead_mm * ahead_mm - self.off_axis_mm * (2.0 * radius_mm - self.off_axis_mm);
        if tangent2_mm2 < 0.0 {
            return None;
        }
        let straight_mm = tangent2_mm2.sqrt();
        let turn_rad = math::atan2(
            ahead_mm * radius_mm - from_axis_mm * straight_mm,
            from_axis_mm * radius_mm + ahead_mm * straight_mm,
        );
        // Rounding must not change "straight ahead" into a full turn.
        let turn_rad = if turn_rad < -1e-9 { turn_rad + TAU } else { turn_rad.max(0.0) };
        Some((turn_rad, straight_mm))
    }

    /// A lower bound of the length, mm, of any way in the plane that comes within `tolerance_mm` of a point that is
    /// inside the turning circle by more than that. The shortest way to such a point is two arcs: the needle turns
    /// away from the point and then around it the other way (Cockayne and Hall, SIAM J. Control 13, 1975).
    ///
    /// The centres A and B of the two circles and the point P form a triangle with sides AB = 2 r, AP = q and BP. The
    /// first arc turns by ψ + γ, with γ the angle at A and ψ that of P at the start. The second turns by 2 π − ε, with
    /// ε the angle at B, minus the part within the tolerance. BP differs from r by at most the tolerance, which bounds
    /// γ. The bound uses the largest ε over these γ: at a right angle at P, or at an end of the range of γ.
    fn away_then_toward_mm(&self, radius_mm: f64, tolerance_mm: f64) -> f64 {
        let (ahead_mm, off_a_mm) = (self.ahead_mm, self.off_axis_mm + radius_mm);
        let psi_rad = math::atan2(ahead_mm, off_a_mm);
        // All lengths in radii.
        let q = math::hypot(ahead_mm, off_a_mm) / radius_mm;
        let tolerance = tolerance_mm / radius_mm;
        let gamma_cos = |bp: f64| ((q * q + 4.0 - bp * bp) / (4.0 * q)).clamp(-1.0, 1.0);
        let [least_cos, largest_cos] = [1.0 + tolerance, 1.0 - tolerance].map(gamma_cos);
        let cos = (0.5 * q).clamp(least_cos, largest_cos);
        let epsilon_rad = math::atan2(q * (1.0 - cos * cos).sqrt(), 2.0 - q * cos);
        let turn_rad = psi_rad + math::acos(largest_cos) + TAU - epsilon_rad;
        (turn_rad - math::asin(tolerance)) * radius_mm
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn tip() -> impl Strategy<Value = Tip> {
        let number = || prop::array::uniform3(-1.0..1.0f64).prop_map(Vector3::from);
        (number(), number()).prop_filter_map("no direction", |(position, heading)| {
            let heading = heading.try_normalize(1e-3)?;
            Some(Tip { position_mm: position * 50.0, heading })
        })
    }

    fn point() -> impl Strategy<Value = Vector3<f64>> {
        prop::array::uniform3(-150.0..150.0f64).prop_map(Vector3::from)
    }

    const CURVATURE_PER_MM: f64 = 1.0 / 50.0;

    proptest! {
        #[test]
        fn one_arc_ends_at_the_point(tip in tip(), point in point()) {
            if let Some(arc) = tip.arc_to(&point) {
                let end = tip.after(&arc);
                prop_assert!((end.position_mm - point).norm() < 1e-9);
                prop_assert!((end.heading.norm() - 1.0).abs() < 1e-12);
                prop_assert!(arc.bend.dot(&tip.heading).abs() < 1e-9);
                prop_assert!(arc.length_mm >= (point - tip.position_mm).norm() - 1e-9);
            } else {
                prop_assert!((point - tip.position_mm).dot(&tip.heading) < 1e-9);
            }
        }

        #[test]
        fn arc_then_straight_ends_at_the_point(tip in tip(), point in point()) {
            let ways = tip.arc_then_straight_to(&point, CURVATURE_PER_MM);
            let bound_mm = tip.shortest_mm(&point, CURVATURE_PER_MM, 1.0, false);
            let Some([arc, straight]) = ways else {
                prop_assert!(bound_mm <= PI * 50.0);
                return Ok(());
            };
            let end = tip.after(&arc).after(&straight);
            prop_assert!((end.position_mm - point).norm() < 1e-6, "{end:?}");
            prop_assert!(arc.curvature_per_mm * arc.length_mm <= TAU + 1e-9);
            prop_assert!((arc.length_mm + straight.length_mm - bound_mm).abs() < 1e-9);
            // Less curvature is never shorter, and a single arc neither.
            let wider = tip.shortest_mm(&point, 0.5 * CURVATURE_PER_MM, 0.0, false);
            prop_assert!(wider >= bound_mm - 1e-6 || wider == PI * 100.0, "{wider} {bound_mm}");
            if let Some(arc) = tip.arc_to(&point).filter(|arc| arc.curvature_per_mm <= CURVATURE_PER_MM) {
                prop_assert!(arc.length_mm >= bound_mm - 1e-9);
            }
        }

        /// On any arc the bound falls by at most the length of the arc, so it never over-estimates.
        #[test]
        fn the_bound_is_consistent(tip in tip(), point in point(), side in -1.0..1.0f64, l in 0.0..3.0f64) {
            let h = |tip: &Tip| tip.shortest_mm(&point, CURVATURE_PER_MM, 0.0, false);
            let [first, second] = tip.across();
            let (sin, cos) = math::sin_cos(PI * side);
            for curvature_per_mm in [0.0, CURVATURE_PER_MM] {
                let arc = Arc { bend: first * cos + second * sin, curvature_per_mm, length_mm: l };
                let (before, after) = (h(&tip), h(&tip.after(&arc)));
                // On the way into the turning circle the bound may fall to half a circle.
                prop_assert!(before <= l + after + 1e-6 || after == PI * 50.0, "{before} {after}");
            }
        }

        /// Without a tolerance there is a way as long as the bound: away from the point, then around it.
        #[test]
        fn away_and_then_around_is_as_long_as_the_bound(away_rad in 0.01..1.0f64, around_rad in PI..TAU) {
            let start = Tip { position_mm: Vector3::zeros(), heading: Vector3::z() };
            let arc = |bend, turn_rad| {
                Arc { bend, curvature_per_mm: CURVATURE_PER_MM, length_mm: turn_rad / CURVATURE_PER_MM }
            };
            let turned = start.after(&arc(-Vector3::y(), away_rad));
            let back = Vector3::new(0.0, turned.heading.z, -turned.heading.y);
            let end_mm = turned.after(&arc(back, around_rad)).position_mm;
            prop_assume!((end_mm - Vector3::y() * 50.0).norm() < 49.9);
            let bound_mm = start.shortest_mm(&end_mm, CURVATURE_PER_MM, 0.0, true);
            prop_assert!((bound_mm - 50.0 * (away_rad + around_rad)).abs() < 1e-6, "{bound_mm}");
        }

        #[test]
        fn arcs_compose(tip in tip(), k in 0.0..0.1f64, l in 0.0..50.0f64, part in 0.0..1.0f64) {
            let arc = Arc { bend: tip.across()[1], curvature_per_mm: k, length_mm: l };
            let first = arc.with_length(part * l);
            let (middle, end) = (tip.after(&first), tip.after(&arc));
            let (sin, cos) = math::sin_cos(k * part * l);
            let bend = arc.bend * cos - tip.heading * sin;
            let again = middle.after(&Arc { bend, length_mm: l - part * l, ..arc });
            prop_assert!((again.position_mm - end.position_mm).norm() < 1e-9);
            prop_assert!((again.heading - end.heading).norm() < 1e-9);
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(3000))]
        /// The ways end anywhere within the tolerance.
        #[test]
        fn no_way_in_the_plane_is_shorter_than_the_bound(
            away_mm in 0.0..60.0f64, around_mm in 100.0..300.0f64,
            others in prop::collection::vec(
                (prop::sample::select(vec![-1.0, 0.0, 1.0]), 0.0..60.0f64), 0..3
            ),
            miss in prop::array::uniform2(-1.0..1.0f64), share in 0.0..0.49f64,
        ) {
            let start = Tip { position_mm: Vector3::zeros(), heading: Vector3::z() };
            let (mut end, mut length_mm) = (start, 0.0);
            for (side, mm) in [(-1.0, away_mm), (1.0, around_mm)].into_iter().chain(others) {
                let bend = Vector3::new(0.0, end.heading.z, -end.heading.y) * side;
                let curvature_per_mm = CURVATURE_PER_MM * side.abs();
                end = end.after(&Arc { bend, curvature_per_mm, length_mm: mm });
                length_mm += mm;
            }
            let inside_mm = 50.0 - (end.position_mm - Vector3::y() * 50.0).norm();
            let tolerance_mm = share * inside_mm.max(0.0);
            let miss_mm = Vector3::new(0.0, miss[0], miss[1]).cap_magnitude(1.0) * tolerance_mm;
            let target_mm = end.position_mm + miss_mm;
            let bound_mm = start.shortest_mm(&target_mm, CURVATURE_PER_MM, tolerance_mm, true);
            prop_assert!(bound_mm <= length_mm + 1e-6, "{bound_mm} {length_mm}");
        }
    }

    #[test]
    fn points_without_an_arc_give_none() {
        let tip = Tip { position_mm: Vector3::zeros(), heading: Vector3::z() };
        let ahead = Vector3::new(0.0, 0.0, 80.0);
        let [arc, straight] = tip.arc_then_straight_to(&ahead, CURVATURE_PER_MM).unwrap();
        assert!(arc.length_mm < 1e-6 && (straight.length_mm - 80.0).abs() < 1e-9);
        assert_eq!(tip.arc_to(&ahead).unwrap().curvature_per_mm, 0.0);
        assert!(tip.arc_to(&Vector3::new(0.0, 0.0, -1.0)).is_none(), "behind");
        assert!(tip.arc_to(&tip.position_mm).is_none(), "at the tip");
        assert!(
            tip.arc_then_straight_to(&Vector3::new(0.0, 50.0, 0.0), CURVATURE_PER_MM).is_none()
        );
        // The point on the far side of the turning circle is half a turn away.
        let beside = Vector3::new(0.0, 100.0, 0.0);
        assert!((tip.shortest_mm(&beside, CURVATURE_PER_MM, 0.0, false) - PI * 50.0).abs() < 1e-6);
    }
}
