//! The reserve: extra distance from obstacles beyond the clearance.

use super::obstacle::World;
use super::path::Path;
use super::problem::Problem;
use super::search::{Answer, Status, plan};

/// The extra distance from obstacles, mm, if a path exists with it. The shortest path passes obstacles as near as it
/// may; noise would then push the needle to where it can no longer pass them.
pub(super) const RESERVE_MM: f64 = 2.0;

/// The parts of the reserve that are tried, the largest first.
const PARTS: [f64; 3] = [1.0, 0.5, 0.25];

/// A known path that keeps the reserve may end farther from the target than one without it by this much, mm.
pub(super) const MISS_MORE_MAX_MM: f64 = 0.1;

/// The path with which a run begins.
#[derive(Debug, Clone, PartialEq)]
pub struct RoomyPath {
    /// The path.
    pub path: Path,
    /// The least distance that the path keeps from every obstacle beyond the clearance, mm.
    pub reserve_mm: f64,
}

/// Plans the path with which a run begins, with as much of the reserve as possible, but no less than `least_mm`.
/// `shortest` is the answer to `problem`; if it has no path, no other is searched for. Each try may spend
/// `problem.expansions_max`.
///
/// # Errors
/// There is no such path; the text says why.
pub fn plan_with_reserve(
    world: &World,
    problem: &Problem,
    least_mm: f64,
    shortest: &Answer,
) -> Result<RoomyPath, String> {
    let Some(path) = shortest.path.clone() else {
        return Err(shortest.reason.clone().unwrap_or_default());
    };
    let parts = PARTS.map(|part| part * RESERVE_MM);
    let tries = parts.into_iter().filter(|part_mm| *part_mm > least_mm);
    let least = (least_mm > 0.0).then_some(least_mm);
    let mut last = Status::None;
    for reserve_mm in tries.chain(least) {
        let clearance_mm = problem.clearance_mm + reserve_mm;
        let answer = plan(world, &Problem { clearance_mm, ..problem.clone() });
        if let Some(path) = answer.path {
            return Ok(RoomyPath { path, reserve_mm });
        }
        last = answer.status;
    }
    let kept_mm = path.distance_mm(world) - problem.clearance_mm;
    if least_mm == 0.0 || kept_mm >= least_mm {
        return Ok(RoomyPath { path, reserve_mm: least_mm });
    }
    Err(match last {
        Status::Budget => format!(
            "there is a path, but the budget of expansions was spent before one was found that keeps \
             goal.reserve_mm, {least_mm}: raise goal.expansions_max, which is {}",
            problem.expansions_max
        ),
        _ => format!(
            "there is a path, but none was found that keeps goal.reserve_mm, {least_mm}, beside \
             goal.clearance_mm: the needle may lose it on the way; to try it, set goal.reserve_mm = 0"
        ),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::search::tests::{problem, world};
    use crate::plan::{Obstacle, plan};
    use nalgebra::Vector3;

    /// The path between two balls, each `gap_mm` from the axis, and its distance to them. Around them there is no
    /// path.
    fn planned(
        gap_mm: f64,
        least_mm: f64,
        expansions_max: u32,
    ) -> Result<(f64, RoomyPath), String> {
        let ball = |side: f64| {
            let centre_mm = Vector3::new(0.0, side * (36.0 + gap_mm), 60.0);
            Obstacle::Sphere { centre_mm, radius_mm: 36.0 }
        };
        let world = world(vec![ball(-1.0), ball(1.0)]);
        let problem = Problem { expansions_max, ..problem([0.0, 0.0, 120.0], true) };
        let roomy = plan_with_reserve(&world, &problem, least_mm, &plan(&world, &problem))?;
        Ok((roomy.path.distance_mm(&world), roomy))
    }

    const MANY: u32 = 100_000;

    #[test]
    fn the_reserve_is_kept_where_there_is_room() {
        let clearance_mm = problem([0.0, 0.0, 120.0], true).clearance_mm;
        let half_mm = 0.5 * RESERVE_MM;
        for (gap_mm, kept_mm) in [(2.5, 2.0 * half_mm), (1.1, half_mm), (0.1, 0.0)] {
            let (distance_mm, roomy) = planned(clearance_mm + gap_mm, 0.0, MANY).unwrap();
            assert_eq!(roomy.reserve_mm, kept_mm);
            assert!(distance_mm >= clearance_mm + kept_mm - 1e-3);
        }
        assert!(planned(clearance_mm - 0.5, 0.0, MANY).is_err());
    }

    #[test]
    fn a_path_with_less_than_the_least_reserve_is_refused() {
        let clearance_mm = problem([0.0, 0.0, 120.0], true).clearance_mm;
        let (distance_mm, roomy) = planned(clearance_mm + 0.6, 0.5, MANY).expect("it keeps more");
        assert!(distance_mm >= clearance_mm + 0.5 - 1e-3 && roomy.reserve_mm == 0.5);
        let reason = planned(clearance_mm + 0.4, 0.5, MANY).expect_err("it keeps less");
        assert!(reason.contains("none was found that keeps goal.reserve_mm, 0.5,"), "{reason}");
        let reason = planned(clearance_mm - 0.5, 0.5, MANY).expect_err("there is no path at all");
        assert!(!reason.contains("goal.reserve_mm"), "{reason}");
    }

    /// With more distance from the obstacles the same number of expansions may find one, but `plan` has none.
    #[test]
    fn without_a_shortest_path_no_other_is_looked_for() {
        let (world, problem) = (world(Vec::new()), problem([0.0, 0.0, 120.0], true));
        let reason = Some("the budget of expansions was spent".to_owned());
        let found = plan(&world, &problem);
        let shortest = Answer { status: Status::Budget, path: None, reason, ..found };
        let refusal = plan_with_reserve(&world, &problem, 0.5, &shortest).expect_err("no path");
        assert_eq!(Some(refusal), shortest.reason);
    }

    /// The first expansions find a path. Only a complete search shows that no path keeps more.
    #[test]
    fn a_spent_budget_is_not_reported_as_no_path() {
        let clearance_mm = problem([0.0, 0.0, 120.0], true).clearance_mm;
        let reason = planned(clearance_mm + 0.4, 0.5, 10).expect_err("it keeps less");
        let spent = "the budget of expansions was spent before one was found that keeps";
        assert!(reason.contains(spent) && !reason.contains("none was"), "{reason}");
        assert!(reason.contains("goal.expansions_max, which is 10"), "{reason}");
    }
}
