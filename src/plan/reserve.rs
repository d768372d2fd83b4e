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

/// Plans the path with which a run begins: with the reserve if there is such a path, else without it.
/// Each of the two may spend `problem.expansions_max`.
pub fn plan_with_reserve(world: &World, problem: &Problem) -> Answer {
    let clearance_mm = problem.clearance_mm + reserve_mm(problem.in_plane);
    let roomy = Problem { clearance_mm, ..problem.clone() };
    let mut field = Field::new(Cow::Borrowed(world), clearance_mm, problem.in_plane);
    let route = Route::new(&mut field, &problem.target_mm);
    let answer = plan_along(&mut field, &roomy, &route);
    if answer.path.is_some() { answer } else { plan(world, problem) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::Obstacle;
    use crate::plan::search::tests::{problem, world};
    use nalgebra::Vector3;

    /// Of the path between two balls, with a gap of `gap_mm` between each and the axis. Around them there
    /// is none.
    fn distance_mm(gap_mm: f64) -> Option<f64> {
        let ball = |side: f64| {
            let centre_mm = Vector3::new(0.0, side * (36.0 + gap_mm), 60.0);
            Obstacle::Sphere { centre_mm, radius_mm: 36.0 }
        };
        let world = world(vec![ball(-1.0), ball(1.0)]);
        let answer = plan_with_reserve(&world, &problem([0.0, 0.0, 120.0], true));
        answer.path.map(|path| path.distance_mm(&world))
    }

    #[test]
    fn the_reserve_is_kept_where_there_is_room() {
        let clearance_mm = problem([0.0, 0.0, 120.0], true).clearance_mm;
        let kept_mm = clearance_mm + reserve_mm(true);
        let room_mm = |gap_mm| distance_mm(gap_mm).expect("there is a path");
        assert!(room_mm(kept_mm + 0.5) >= kept_mm - 1e-3);
        assert!((clearance_mm - 1e-3..kept_mm).contains(&room_mm(clearance_mm + 0.5)));
        assert_eq!(distance_mm(clearance_mm - 0.5), None);
    }
}
