//! Tests of the planner's search.

use super::super::{Obstacle, Workspace};
use super::*;
use proptest::prelude::*;

pub(in crate::plan) fn world(obstacles: Vec<Obstacle>) -> World {
    let [min_mm, max_mm] = [[-50.0, -75.0, 0.0], [50.0, 75.0, 150.0]].map(Vector3::from);
    World { obstacles, workspace: Workspace { min_mm, max_mm, start_mm: None } }
}

pub(in crate::plan) fn problem(target_mm: [f64; 3], in_plane: bool) -> Problem {
    Problem {
        start: Tip { position_mm: Vector3::zeros(), heading: Vector3::z() },
        target_mm: target_mm.into(),
        tolerance_mm: 1.0,
        curvature_per_mm: 1.0 / 122.0,
        clearance_mm: 2.0,
        length_max_mm: 300.0,
        in_plane,
        expansions_max: 100_000,
    }
}

fn sphere(centre_mm: [f64; 3], radius_mm: f64) -> Obstacle {
    Obstacle::Sphere { centre_mm: centre_mm.into(), radius_mm }
}

/// The path of `answer`, after checking that the needle can follow it.
fn path(world: &World, problem: &Problem, answer: &Answer) -> Path {
    let path = answer.path.clone().unwrap_or_else(|| panic!("{answer:?}"));
    assert_eq!(path.start, problem.start);
    let (end, length_mm) = (path.end(), path.length_mm());
    assert!((end.position_mm - problem.target_mm).norm() <= problem.tolerance_mm + 1e-6);
    assert!(length_mm <= problem.length_max_mm);
    assert!(path.distance_mm(world) >= problem.clearance_mm - 2e-3);
    for (tip, arc) in path.pieces() {
        assert!((0.0..=problem.curvature_per_mm).contains(&arc.curvature_per_mm));
        assert!(arc.bend.dot(&tip.heading).abs() < 1e-9 && (arc.bend.norm() - 1.0).abs() < 1e-9);
    }
    for point in path.points_mm(0.5) {
        assert!(world.workspace.depth_mm(&point) >= -1e-9);
        assert!(!problem.in_plane || point.x.abs() < 1e-9);
    }
    path
}

#[test]
fn without_obstacles_the_first_try_is_the_plan() {
    let world = world(vec![]);
    for in_plane in [true, false] {
        let problem = problem([0.0, 20.0, 120.0], in_plane);
        let answer = plan(&world, &problem);
        assert_eq!((answer.status, answer.expansions), (Status::Plan, 1));
        let path = path(&world, &problem, &answer);
        let least_mm = problem.start.shortest_mm(&problem.target_mm, 1.0 / 122.0, 0.0, in_plane);
        assert!((path.length_mm() - least_mm).abs() < 1e-9);
    }
}

/// A path that ended short of the target by the tolerance would cost the same.
#[test]
fn a_path_straight_ahead_ends_at_the_target() {
    for (in_plane, z_mm) in [(true, 1.5), (false, 1.5), (true, 3.0), (false, 3.0), (true, 4.7)] {
        let problem = problem([0.0, 0.0, z_mm], in_plane);
        let answer = plan(&world(vec![]), &problem);
        let path = path(&world(vec![]), &problem, &answer);
        assert!((path.end().position_mm - problem.target_mm).norm() < 1e-9, "{z_mm}: {path:?}");
    }
}

#[test]
fn a_wall_that_blocks_the_plane_is_passed_in_space() {
    let wall = Obstacle::Box {
        min_mm: Vector3::new(-3.0, -100.0, 60.0),
        max_mm: Vector3::new(100.0, 100.0, 65.0),
    };
    let world = world(vec![wall]);
    let in_plane = plan(&world, &problem([0.0, 0.0, 140.0], true));
    assert_eq!(in_plane.status, Status::None);
    let nearest_mm = in_plane.nearest_mm.unwrap();
    assert!((nearest_mm.z - 58.0).abs() < 2.0 && nearest_mm.y.abs() < 2.0, "{nearest_mm}");
    let problem = problem([0.0, 0.0, 140.0], false);
    let answer = plan(&world, &problem);
    assert_eq!(answer.status, Status::Plan);
    path(&world, &problem, &answer);
}

/// Deeper in an obstacle, or farther outside, than the tolerance, the target needs no search. Less deep, a path
/// ends short of it.
#[test]
fn a_target_out_of_bounds_needs_no_search() {
    let world = world(vec![sphere([0.0, 0.0, 100.0], 10.0)]);
    for in_plane in [true, false] {
        for (z_mm, is_searched) in [(91.5, false), (89.0, true), (152.0, false)] {
            let problem = Problem { clearance_mm: 1.5, ..problem([0.0, 0.0, z_mm], in_plane) };
            let answer = plan(&world, &problem);
            assert_eq!(answer.expansions > 0, is_searched, "{z_mm}, {in_plane}");
            assert_eq!(answer.status == Status::None, !is_searched, "{z_mm}, {in_plane}");
        }
    }
}

#[test]
fn each_answer_without_a_path_gives_its_reason() {
    let mut reasons = String::new();
    let mut none = |obstacles: Vec<Obstacle>, change: &dyn Fn(&mut Problem)| {
        let world = world(obstacles);
        let mut problem = problem([0.0, 0.0, 100.0], true);
        change(&mut problem);
        let answer = plan(&world, &problem);
        assert!(answer.path.is_none());
        let reason = answer.reason.unwrap();
        assert!(reason.len() < 160, "{reason}");
        reasons.push_str(&format!("{}: {reason}\n", answer.status));
    };
    let aside = |problem: &mut Problem| problem.target_mm.y = 60.0;
    let cage = || {
        let at = |x, y, z| Vector3::new(x, y, z);
        let wall = |min_mm, max_mm| Obstacle::Box { min_mm, max_mm };
        vec![
            wall(at(-99.0, -20.0, 80.0), at(99.0, 20.0, 85.0)),
            wall(at(-99.0, -20.0, 115.0), at(99.0, 20.0, 120.0)),
            wall(at(-99.0, -20.0, 80.0), at(99.0, -15.0, 120.0)),
            wall(at(-99.0, 15.0, 80.0), at(99.0, 20.0, 120.0)),
        ]
    };
    none(vec![sphere([0.0, 0.0, 5.0], 4.0)], &|_| {});
    none(vec![], &|problem| problem.start.position_mm.z = -3.0);
    none(vec![], &|problem| problem.target_mm.z = 155.0);
    none(vec![sphere([0.0, 5.0, 100.0], 10.0)], &|_| {});
    none(vec![], &aside);
    none(vec![], &|problem| problem.target_mm.z = -10.0);
    none(cage(), &|_| {});
    none(vec![sphere([0.0, 0.0, 80.0], 30.0)], &|problem| problem.target_mm.z = 118.0);
    none(vec![sphere([0.0, 0.0, 50.0], 5.0)], &|problem| problem.expansions_max = 5);
    insta::assert_snapshot!(reasons);
}

/// The wall closes the way to the target, but a path may end before it.
#[test]
fn a_spent_budget_is_not_blamed_on_a_wall() {
    let at = |y, z| Vector3::new(40.0 * f64::signum(y), y, z);
    let world = world(vec![Obstacle::Box { min_mm: at(-75.0, 101.9), max_mm: at(75.0, 102.1) }]);
    let behind = Problem { tolerance_mm: 5.0, ..problem([0.0, 0.0, 104.2], true) };
    assert_eq!(plan(&world, &behind).status, Status::Plan);
    let answer = plan(&world, &Problem { expansions_max: 20, ..behind });
    assert_eq!((answer.status, answer.path), (Status::Budget, None));
    assert!(
        answer.reason.as_ref().is_some_and(|why| why.contains("was spent")),
        "{:?}",
        answer.reason
    );
}

/// A search that ends early says so. A path that it has found by then can be followed.
#[test]
fn a_budget_ends_the_search() {
    let world = world(vec![sphere([0.0, 1.0, 70.0], 5.0)]);
    let mut problem = problem([0.0, 0.0, 140.0], true);
    let whole = plan(&world, &problem);
    assert_eq!(whole.status, Status::Plan);
    for expansions_max in [1, whole.expansions / 2, whole.expansions - 1] {
        problem.expansions_max = expansions_max;
        let answer = plan(&world, &problem);
        assert_eq!((answer.status, answer.expansions), (Status::Budget, expansions_max));
        match &answer.path {
            Some(_) => drop(path(&world, &problem, &answer)),
            None => assert!(answer.reason.is_some_and(|why| why.contains("was spent"))),
        }
    }
    problem.expansions_max = whole.expansions;
    assert_eq!(plan(&world, &problem).status, Status::Plan);
}

/// The first arc of the search would end beyond this ball.
#[test]
fn a_small_obstacle_right_ahead_is_not_passed_through() {
    for (in_plane, z_mm) in [(true, 1.0), (false, 6.0)] {
        let small = sphere([0.0, 0.0, z_mm], 0.3);
        let world = world(vec![small]);
        let problem = Problem { clearance_mm: 0.5, ..problem([0.0, 0.0, 120.0], in_plane) };
        let answer = plan(&world, &problem);
        assert!(answer.path.is_none(), "{answer:?}");
        assert!(answer.nearest_mm.is_some_and(|at| at.z < z_mm), "{answer:?}");
        let aside = self::world(vec![sphere([0.0, 2.0, z_mm + 3.0], 0.8)]);
        path(&aside, &problem, &plan(&aside, &problem));
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]
    #[test]
    fn plans_in_space_can_be_followed(
        spheres in prop::collection::vec(
            (prop::array::uniform3(-40.0..40.0f64), 5.0..20.0f64), 0..6
        ),
        x in -20.0..20.0f64, y in -20.0..20.0f64, z in 100.0..140.0f64,
    ) {
        let spheres = spheres.into_iter().map(|([x, y, z], r)| sphere([x, y, z + 75.0], r));
        let world = world(spheres.collect());
        let problem = problem([x, y, z], false);
        let answer = plan(&world, &problem);
        prop_assert_eq!(&answer, &plan(&world, &problem), "a second search is the same");
        prop_assert_eq!(answer.path.is_none(), answer.reason.is_some());
        if answer.path.is_some() {
            path(&world, &problem, &answer);
        } else {
            prop_assert!(answer.status != Status::Plan);
        }
    }
}

/// What no path can reach does not make the cells larger. They grow if the needle itself reaches too far.
#[test]
fn a_wide_workspace_leaves_the_cells_as_they_are() {
    let room = 900.0;
    let mut wide = world(vec![sphere([0.0, 0.0, 60.0], 50.0)]);
    (wide.workspace.min_mm, wide.workspace.max_mm) =
        (Vector3::repeat(-room), Vector3::repeat(room));
    let problem = Problem { expansions_max: 30, ..problem([0.0, 0.0, 135.0], false) };
    let near = plan(&wide, &Problem { length_max_mm: 140.0, ..problem.clone() });
    assert_eq!(near.resolution.cell_mm, 2.0);
    let far = plan(&wide, &Problem { length_max_mm: 800.0, ..problem });
    assert!(far.resolution.cell_mm > 2.0);
}
