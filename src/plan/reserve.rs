//! What a run keeps in hand of the clearance.

use super::field::Field;
use super::obstacle::World;
use super::route::Route;
use super::search::{Answer, Problem, plan, plan_along};
use std::borrow::Cow;

/// Obstacles are kept so much farther away where that leaves a path, in the plane and in space, mm: the
/// shortest path passes them as near as it may, and noise would push the needle past the last point from
/// which it can. In the plane there is no way past an obstacle but to its two sides.
const RESERVE_MM: [f64; 2] = [2.0, 0.5];

/// The reserve, mm.
pub(super) fn reserve_mm(in_plane: bool) -> f64 {
    RESERVE_MM[usize::from(!in_plane)]
}

/// The parts of it that are tried, the largest first.
const PARTS: [f64; 3] = [1.0, 0.5, 0.25];

/// Plans the path with which a run begins: with as much of the reserve as leaves one, and no less than
/// `least_mm`. Each try may spend `problem.expansions_max`.
pub fn plan_with_reserve(world: &World, problem: &Problem, least_mm: f64) -> Answer {
    let parts = PARTS.map(|part| part * reserve_mm(problem.in_plane));
    let tries = parts.into_iter().filter(|part_mm| *part_mm > least_mm);
    let least = (least_mm > 0.0).then_some(least_mm);
    let roomy = tries.chain(least).find_map(|reserve_mm| {
        let clearance_mm = problem.clearance_mm + reserve_mm;
        let roomy = Problem { clearance_mm, ..problem.clone() };
        let mut field = Field::new(Cow::Borrowed(world), clearance_mm, problem.in_plane);
        let route = Route::new(&mut field, &problem.target_mm);
        Some(plan_along(&mut field, &roomy, &route)).filter(|answer| answer.path.is_some())
    });
    roomy.unwrap_or_else(|| {
        let mut answer = plan(world, problem);
        if least_mm > 0.0 && answer.path.take().is_some() {
            answer.reason = Some(format!(
                "there is a path, but none keeps goal.reserve_mm, {least_mm}, beside goal.clearance_mm; \
                 with less the needle may lose it on the way"
            ));
        }
        answer
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::Obstacle;
    use crate::plan::search::tests::{problem, world};
    use nalgebra::Vector3;

    /// The plan between two balls, with a gap of `gap_mm` between each and the axis, and how near it comes
    /// to them. Around them there is no path.
    fn planned(gap_mm: f64, least_mm: f64) -> (Option<f64>, Answer) {
        let ball = |side: f64| {
            let centre_mm = Vector3::new(0.0, side * (36.0 + gap_mm), 60.0);
            Obstacle::Sphere { centre_mm, radius_mm: 36.0 }
        };
        let world = world(vec![ball(-1.0), ball(1.0)]);
        let answer = plan_with_reserve(&world, &problem([0.0, 0.0, 120.0], true), least_mm);
        (answer.path.as_ref().map(|path| path.distance_mm(&world)), answer)
    }

    #[test]
    fn the_reserve_is_kept_where_there_is_room() {
        let clearance_mm = problem([0.0, 0.0, 120.0], true).clearance_mm;
        let kept_mm = clearance_mm + reserve_mm(true);
        let room_mm = |gap_mm| planned(gap_mm, 0.0).0.expect("there is a path");
        assert!(room_mm(kept_mm + 0.5) >= kept_mm - 1e-3);
        let half_mm = 0.5 * (clearance_mm + kept_mm);
        assert!((half_mm - 1e-3..kept_mm).contains(&room_mm(half_mm + 0.1)));
        assert!((clearance_mm - 1e-3..half_mm).contains(&room_mm(clearance_mm + 0.1)));
        assert_eq!(planned(clearance_mm - 0.5, 0.0).0, None);
    }

    #[test]
    fn a_path_with_less_than_the_least_reserve_is_none() {
        let clearance_mm = problem([0.0, 0.0, 120.0], true).clearance_mm;
        let (room_mm, _) = planned(clearance_mm + 0.6, 0.5);
        assert!(room_mm.expect("it keeps more") >= clearance_mm + 0.5 - 1e-3);
        let (room_mm, answer) = planned(clearance_mm + 0.4, 0.5);
        let reason = answer.reason.expect("it keeps less");
        assert_eq!(room_mm, None);
        assert!(reason.contains("none keeps goal.reserve_mm, 0.5,"), "{reason}");
        let (_, answer) = planned(clearance_mm - 0.5, 0.5);
        let reason = answer.reason.expect("there is no path at all");
        assert!(!reason.contains("goal.reserve_mm"), "{reason}");
    }
}
