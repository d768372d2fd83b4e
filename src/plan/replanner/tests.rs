//! A simulated needle that follows a path that is planned again at each step.

use super::super::search::tests::world;
use super::super::{Obstacle, plan, search};
use super::*;
use crate::geometry::Pose;
use crate::needle::{Increment, Needle};
use nalgebra::{Matrix3, Rotation3};
use proptest::prelude::*;

mod moving;

const RADIUS_MM: f64 = 122.0;
const STEP_MM: f64 = 1.0;

fn problem(target_mm: [f64; 3], in_plane: bool) -> Problem {
    Problem { expansions_max: 20_000, ..search::tests::problem(target_mm, in_plane) }
}

/// A needle without errors that bends either toward `bend` or away from it.
struct Simulated {
    tip: Tip,
    needle: Needle,
}

impl Simulated {
    fn new(radius_mm: f64) -> Self {
        let tip = Tip { position_mm: Vector3::zeros(), heading: Vector3::z() };
        Simulated { tip, needle: Needle::new(radius_mm.recip()).unwrap() }
    }

    /// Inserts `length_mm` with the needle bent toward `bend`. An unturned needle bends toward -y.
    fn insert(&mut self, bend: &Vector3<f64>, length_mm: f64) {
        let Tip { position_mm, heading } = self.tip;
        let y = -bend;
        let axes = Matrix3::from_columns(&[y.cross(&heading), y, heading]);
        let rotation = Rotation3::from_matrix_unchecked(axes);
        let pose = Pose { rotation, translation: position_mm };
        let pose = self.needle.step(&pose, Increment::new(length_mm, 0.0).unwrap());
        self.tip = Tip { position_mm: pose.translation, heading: pose.rotation * Vector3::z() };
    }

    /// One step of `steer`, by a bench that assumes the radius `assumed_mm`.
    fn step(&mut self, steer: &Steer, assumed_mm: f64) {
        let share = 0.5 * (1.0 + (steer.curvature_per_mm * assumed_mm).clamp(-1.0, 1.0));
        let step_mm = steer.remaining_mm.min(STEP_MM);
        for (side, part) in [(1.0, share), (-1.0, 1.0 - share)] {
            let heading = self.tip.heading;
            let bend = steer.bend - heading * steer.bend.dot(&heading);
            self.insert(&(bend.normalize() * side), part * step_mm);
        }
    }
}

/// An estimate with a small uncertainty and the curvature of `problem`.
fn known(tip: Tip, problem: &Problem) -> TipEstimate {
    let curvature_per_mm = problem.curvature_per_mm;
    TipEstimate { tip, curvature_per_mm, position_sd_mm: 0.05, heading_sd_rad: 0.001 }
}

/// An estimate of a position without uncertainty.
fn exact(tip: Tip) -> TipEstimate {
    let curvature_per_mm = RADIUS_MM.recip();
    TipEstimate { tip, curvature_per_mm, position_sd_mm: 0.0, heading_sd_rad: 0.001 }
}

/// Steers a needle of radius `true_mm` that the bench assumes to be `RADIUS_MM`. Returns the last step, the least
/// distance to an obstacle and the needle.
fn run(world: &World, problem: &Problem, true_mm: f64) -> (Step, f64, Simulated) {
    let mut planner = Replanner::new(world.clone(), problem.clone(), 0.0, None);
    let mut needle = Simulated::new(true_mm);
    let mut least_mm = f64::INFINITY;
    for step in 0..300 {
        let estimate = known(needle.tip, problem);
        let inserted_mm = if step == 0 { 0.0 } else { STEP_MM };
        match planner.step(&estimate, inserted_mm, STEP_MM) {
            Step::Steer(steer) => needle.step(&steer, RADIUS_MM),
            end => return (end, least_mm, needle),
        }
        least_mm = least_mm.min(world.distance_mm(&needle.tip.position_mm));
    }
    panic!("no end at {}", needle.tip.position_mm);
}

fn error_mm(step: &Step) -> f64 {
    match step {
        Step::Arrived { error_mm } => *error_mm,
        other => panic!("{other:?}"),
    }
}

/// While the base turns once around, the needle goes straight on.
#[test]
fn a_whole_turn_needs_a_path_after_it() {
    let reach_mm = RADIUS_MM - (RADIUS_MM * RADIUS_MM - 100.0 * 100.0).sqrt();
    let aside = |share: f64| ([0.0, share * reach_mm, 100.0], vec![]);
    let sphere = |y, z| Obstacle::Sphere { centre_mm: Vector3::new(0.0, y, z), radius_mm: 3.0 };
    let ball = |z| sphere(1.0, z);
    // A turn takes 6 mm of the 100 mm, and with them 12% of the reach; a margin of 0.15 takes 22%.
    let cases = [
        (([0.0, 0.1, 5.0], vec![]), 0.0, true),
        (([0.0, 0.1, 5.0], vec![sphere(-5.05, 5.0)]), 0.0, false),
        (aside(0.0), 0.0, true),
        (aside(0.8), 0.0, true),
        (aside(0.95), 0.0, false),
        (aside(0.6), 0.15, true),
        (aside(0.7), 0.15, false),
        (aside(0.8), 0.15, false),
        (([0.0, 0.0, 120.0], vec![ball(45.0)]), 0.0, true),
        (([0.0, 0.0, 120.0], vec![ball(34.0)]), 0.0, false),
    ];
    for ((target_mm, obstacles), margin, may_turn) in cases {
        let problem = problem(target_mm, true);
        let mut planner = Replanner::new(world(obstacles.clone()), problem.clone(), margin, None);
        let estimate = known(problem.start, &problem);
        let step = planner.step(&estimate, 0.0, STEP_MM);
        let path = planner.path().cloned();
        assert!(path.is_some() && matches!(step, Step::Steer(_)), "{step:?}");
        let said = planner.may_turn(&estimate, 6.0);
        assert_eq!(said, may_turn, "{target_mm:?}, {obstacles:?}, margin {margin}");
        assert_eq!(planner.path(), path.as_ref(), "the plan stays");
        assert_eq!(planner.problem.start, problem.start);
    }
}

/// The arc to the target is 111.2 mm long. After 6 mm straight ahead another one of 105.9 mm leads there.
#[test]
fn a_whole_turn_counts_in_the_length_of_the_path() {
    for (length_max_mm, may_turn) in [(111.5, false), (112.0, true)] {
        let problem = Problem { length_max_mm, ..problem([0.0, 41.7, 100.0], true) };
        let mut planner = Replanner::new(world(vec![]), problem.clone(), 0.0, None);
        let estimate = known(problem.start, &problem);
        let step = planner.step(&estimate, 0.0, STEP_MM);
        assert!(matches!(step, Step::Steer(_)), "{step:?}");
        assert_eq!(planner.may_turn(&estimate, 6.0), may_turn, "{length_max_mm}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    /// Targets at up to 90% of what one arc can reach, with the right curvature.
    #[test]
    fn targets_within_reach_are_reached(
        z in 80.0..140.0f64, share in 0.0..0.9f64, turn in 0.0..6.3f64, in_plane in any::<bool>(),
    ) {
        let reach_mm = share * (RADIUS_MM - (RADIUS_MM * RADIUS_MM - z * z).max(0.0).sqrt());
        let reach_mm = reach_mm.min(40.0);
        let turn = if in_plane { 0.5 * std::f64::consts::PI } else { turn };
        let target_mm = [reach_mm * turn.cos() * f64::from(!in_plane), reach_mm * turn.sin(), z];
        let (end, ..) = run(&world(vec![]), &problem(target_mm, in_plane), RADIUS_MM);
        // The path ends at a whole step, up to half a step from the target.
        prop_assert!(error_mm(&end) <= 0.5 * STEP_MM + 0.15, "{end:?}");
    }

    #[test]
    fn a_wrong_curvature_is_corrected_on_the_way(
        z in 80.0..140.0f64, share in 0.0..0.7f64, wrong in 0.85..1.15f64,
    ) {
        let reach_mm = share * (RADIUS_MM - (RADIUS_MM * RADIUS_MM - z * z).max(0.0).sqrt());
        let target_mm = [0.0, reach_mm.min(40.0), z];
        let (end, ..) = run(&world(vec![]), &problem(target_mm, true), RADIUS_MM * wrong);
        prop_assert!(error_mm(&end) <= 1.0, "within the tolerance: {end:?}");
    }

    /// The needle may come nearer than the clearance only by the uncertainty of the tip.
    #[test]
    fn the_clearance_to_obstacles_is_kept(
        spheres in prop::collection::vec((-15.0..15.0f64, 30.0..100.0f64, 3.0..10.0f64), 1..4),
        wrong in 0.7..1.4f64,
    ) {
        let sphere = |(y, z, radius_mm)| Obstacle::Sphere { centre_mm: Vector3::new(0.0, y, z), radius_mm };
        let world = world(spheres.into_iter().map(sphere).collect());
        let (_, least_mm, _) = run(&world, &problem([0.0, 5.0, 130.0], true), RADIUS_MM * wrong);
        // 0.05 mm: within one step a curvature that is wrong by 40% leads astray by less. Then two standard
        // deviations of the position.
        prop_assert!(least_mm > 2.0 - 0.05 - SDS * 0.05, "{least_mm}");
    }
}

#[test]
fn a_way_around_is_found_and_kept() {
    let ball = Obstacle::Sphere { centre_mm: Vector3::new(0.0, 1.0, 60.0), radius_mm: 4.0 };
    for in_plane in [true, false] {
        let problem = problem([0.0, 0.0, 130.0], in_plane);
        let world = world(vec![ball.clone()]);
        let (end, least_mm, _) = run(&world, &problem, RADIUS_MM);
        assert!(error_mm(&end) < 0.7, "{end:?}");
        assert!(least_mm >= 2.0, "{least_mm}");
        assert_eq!(run(&world, &problem, RADIUS_MM).0, end, "a second run is the same");
    }
}

/// A run begins with a plan, and has no expansions to find it again.
#[test]
fn a_plan_that_is_given_is_followed() {
    let ball = Obstacle::Sphere { centre_mm: Vector3::new(0.0, 1.0, 60.0), radius_mm: 4.0 };
    let world = world(vec![ball]);
    let mut problem = problem([0.0, 0.0, 130.0], true);
    problem.clearance_mm += 0.5;
    let path = plan(&world, &problem).path;
    (problem.clearance_mm, problem.expansions_max) = (2.0, 0);
    let estimate = known(problem.start, &problem);
    let first = |path: Option<Path>| {
        Replanner::new(world.clone(), problem.clone(), 0.0, path).step(&estimate, 0.0, STEP_MM)
    };
    let steer = |step| match step {
        Step::Steer(steer) => steer,
        other => panic!("{other:?}"),
    };
    // Without a path the needle goes on toward the target for a few millimetres.
    assert_eq!(steer(first(None)).curvature_per_mm, 0.0);
    assert!(steer(first(path)).curvature_per_mm > 0.0);
}

/// The estimated heading is off by 6 degrees, within its uncertainty, so the plan may still lead to the target. An
/// obstacle is on the direct path.
#[test]
fn a_plan_is_followed_while_the_heading_is_hardly_known() {
    let ball = Obstacle::Sphere { centre_mm: Vector3::new(0.0, -1.0, 60.0), radius_mm: 6.0 };
    let world = world(vec![ball]);
    let mut problem = problem([0.0, 0.0, 130.0], true);
    let path = plan(&world, &problem).path;
    problem.expansions_max = 0;
    let off_rad = 6f64.to_radians();
    let heading = Vector3::new(0.0, off_rad.sin(), off_rad.cos());
    let estimate = TipEstimate {
        tip: Tip { heading, ..problem.start },
        curvature_per_mm: 1.0 / RADIUS_MM,
        position_sd_mm: 0.3,
        heading_sd_rad: 8f64.to_radians(),
    };
    let toward_y = |path: Option<Path>| {
        let mut planner = Replanner::new(world.clone(), problem.clone(), 0.0, path);
        match planner.step(&estimate, 0.0, STEP_MM) {
            Step::Steer(steer) => steer.bend.y * steer.curvature_per_mm,
            other => panic!("{other:?}"),
        }
    };
    assert!(toward_y(path) > 0.0 && toward_y(None) < 0.0);
}

/// The needle does not bend. It stops before it comes nearer than the clearance.
#[test]
fn when_no_path_is_left_the_insertion_stops() {
    let ball = Obstacle::Sphere { centre_mm: Vector3::new(0.0, 1.0, 60.0), radius_mm: 6.0 };
    let (end, least_mm, needle) = run(&world(vec![ball]), &problem([0.0, 0.0, 130.0], true), 1e5);
    assert_eq!(end, Step::Stop(StopReason::NoPath));
    assert!(least_mm >= 2.0 && needle.tip.position_mm.z > 10.0, "{least_mm}");
}

/// A step straight ahead would come 0.15 mm nearer to a ball than the clearance. The run stops unless a standard
/// deviation of the position is larger than that.
#[test]
fn a_step_ahead_that_is_nearer_than_the_clearance_is_not_made() {
    for in_plane in [true, false] {
        let centre_mm = Vector3::new(0.0, 7.85, 1.0);
        let ball = Obstacle::Sphere { centre_mm, radius_mm: 6.0 };
        let problem = problem([0.0, -10.0, 100.0], in_plane);
        let first = |position_sd_mm| {
            let (tip, curvature_per_mm) = (problem.start, 1.0 / RADIUS_MM);
            let estimate =
                TipEstimate { tip, curvature_per_mm, position_sd_mm, heading_sd_rad: 0.001 };
            let world = world(vec![ball.clone()]);
            Replanner::new(world, problem.clone(), 0.0, None).step(&estimate, 0.0, STEP_MM)
        };
        assert_eq!(first(0.1), Step::Stop(StopReason::ObstacleAhead));
        assert!(matches!(first(0.16), Step::Steer(_)), "{:?}", first(0.16));
    }
}

/// The target is 120 mm away.
#[test]
fn a_start_from_which_the_path_is_too_long_is_refused() {
    let problem = problem([0.0, 0.0, 120.0], true);
    let check = |length_max_mm: f64| {
        let problem = Problem { length_max_mm, ..problem.clone() };
        let path = plan(&world(vec![]), &self::problem([0.0, 0.0, 120.0], true)).path;
        let Problem { start, curvature_per_mm, .. } = problem;
        let mut planner = Replanner::new(world(vec![]), problem, 0.0, path);
        planner.check_start(start, &start.position_mm, curvature_per_mm)
    };
    assert_eq!(check(120.0), Ok(()));
    assert_eq!(check(119.5), Ok(()), "within the tolerance");
    let why = check(118.0).unwrap_err().reason;
    assert!(why.contains("takes 120 mm at least, allowed are 118"), "{why}");
}

/// One arc to the target is 128.7 mm long, and a sharper one with a straight after it 127 mm.
#[test]
fn one_arc_that_is_too_long_does_not_replace_a_path_that_fits() {
    let world = world(vec![]);
    let problem = Problem { length_max_mm: 127.5, ..problem([0.0, 40.0, 120.0], true) };
    let path = plan(&world, &problem).path;
    assert!(path.is_some(), "a path of two pieces is short enough");
    let mut planner = Replanner::new(world, problem.clone(), 0.0, path);
    let mut needle = Simulated::new(RADIUS_MM);
    for step in 0..100 {
        let estimate = known(needle.tip, &problem);
        let inserted_mm = if step == 0 { 0.0 } else { STEP_MM };
        let Step::Steer(steer) = planner.step(&estimate, inserted_mm, STEP_MM) else {
            panic!("no path at {step} mm");
        };
        let end_mm = f64::from(step) * STEP_MM + steer.remaining_mm;
        assert!(end_mm <= problem.length_max_mm, "{end_mm} mm");
        needle.step(&steer, RADIUS_MM);
    }
}

/// The insertion may end a little deeper than allowed. Then no length is left for a path.
#[test]
fn beyond_the_allowed_length_no_path_goes_backwards() {
    let mut problem = Problem { length_max_mm: 1.0, ..problem([0.0, 60.0, 60.0], true) };
    problem.start.position_mm.z = 10.0;
    let mut planner = Replanner::new(world(vec![]), problem.clone(), 0.0, None);
    for inserted_mm in [0.0, 1.5] {
        let estimate = known(problem.start, &problem);
        let step = planner.step(&estimate, inserted_mm, STEP_MM);
        let backwards = |path: &Path| path.arcs.iter().any(|arc| arc.length_mm < 0.0);
        assert!(!planner.path().is_some_and(backwards), "{step:?}, {:?}", planner.path());
    }
}

#[test]
fn a_tip_that_is_not_finite_stops_the_insertion() {
    let problem = problem([0.0, 0.0, 120.0], false);
    let mut planner = Replanner::new(world(vec![]), problem.clone(), 0.0, None);
    let tip = Tip { position_mm: Vector3::new(0.0, f64::NAN, 10.0), ..problem.start };
    let estimate = known(tip, &problem);
    assert_eq!(planner.step(&estimate, 1.0, STEP_MM), Step::Stop(StopReason::TipOutside));
}

/// No step goes beyond the target, where the obstacle is.
#[test]
fn a_target_right_in_front_of_an_obstacle_is_reached() {
    for in_plane in [true, false] {
        let target_mm = [0.0, 0.0, 100.4];
        let centre_mm = Vector3::from(target_mm) + Vector3::z() * (6.0 + 2.1);
        let world = world(vec![Obstacle::Sphere { centre_mm, radius_mm: 6.0 }]);
        let (end, least_mm, _) = run(&world, &problem(target_mm, in_plane), RADIUS_MM);
        assert!(error_mm(&end) < 0.1 && least_mm > 2.0, "{end:?}, {least_mm}");
    }
}

#[test]
fn a_tip_at_an_obstacle_stops_the_insertion() {
    let ball = Obstacle::Sphere { centre_mm: Vector3::zeros(), radius_mm: 1.0 };
    let problem = problem([0.0, 0.0, 120.0], true);
    let estimate = exact(problem.start);
    let mut planner = Replanner::new(world(vec![ball]), problem, 0.0, None);
    let first = planner.step(&estimate, 0.0, STEP_MM);
    assert_eq!(first, Step::Stop(StopReason::TipNearObstacle));
}

/// The path leads past a ball, but at speed the needle would go on toward it after a stop.
#[test]
fn the_way_on_after_a_stop_counts() {
    let (centre_mm, radius_mm) = (Vector3::new(0.0, 3.6, 6.5), 3.0);
    let ball = Obstacle::Sphere { centre_mm, radius_mm };
    let target_mm = [0.0, -9.29, 9.97];
    let problem = Problem { curvature_per_mm: 1.0 / 9.9, ..problem(target_mm, true) };
    let first = |stopping_mm| {
        let planner = Replanner::new(world(vec![ball.clone()]), problem.clone(), 0.0, None);
        let estimate = TipEstimate { position_sd_mm: 0.0, ..known(problem.start, &problem) };
        planner.with_stopping_mm(stopping_mm).step(&estimate, 0.0, STEP_MM)
    };
    assert!(matches!(first(0.1), Step::Steer(_)), "{:?}", first(0.1));
    assert_eq!(first(2.3), Step::Stop(StopReason::ObstacleAhead));
}

/// The ball is half way along a step of 10 mm.
#[test]
fn a_thin_obstacle_within_a_step_counts() {
    let ball = Obstacle::Sphere { centre_mm: Vector3::new(0.0, 2.2, 6.0), radius_mm: 0.5 };
    let problem = problem([0.0, -20.0, 120.0], true);
    let mut planner = Replanner::new(world(vec![ball]), problem.clone(), 0.0, None);
    let first = planner.step(&exact(problem.start), 0.0, 10.0);
    assert_eq!(first, Step::Stop(StopReason::ObstacleAhead));
}

/// However uncertain the estimate is, a tip in an obstacle is not allowed.
#[test]
fn doubt_does_not_allow_a_tip_in_an_obstacle() {
    let centre_mm = Vector3::new(0.0, 4.9, 0.0);
    let ball = Obstacle::Sphere { centre_mm, radius_mm: 5.0 };
    let problem = problem([0.0, -20.0, 120.0], true);
    let estimate = TipEstimate { position_sd_mm: 10.0, ..exact(problem.start) };
    let mut planner = Replanner::new(world(vec![ball]), problem, 0.0, None);
    let first = planner.step(&estimate, 0.0, STEP_MM);
    assert_eq!(first, Step::Stop(StopReason::TipNearObstacle));
}

/// One estimate says that the needle hardly bends, so no path is found. The needle goes on toward the target for a
/// while; the length of that way does not limit the next path.
#[test]
fn a_step_without_a_path_does_not_shorten_the_next_path() {
    let ball = Obstacle::Sphere { centre_mm: Vector3::new(0.0, 1.0, 60.0), radius_mm: 4.0 };
    let problem = problem([0.0, 0.0, 130.0], true);
    let mut planner = Replanner::new(world(vec![ball]), problem.clone(), 0.0, None);
    let certain = known(problem.start, &problem);
    assert!(matches!(planner.step(&certain, 0.0, STEP_MM), Step::Steer(_)));
    let longest_mm = planner.longest_mm;
    let hardly_bent = TipEstimate { curvature_per_mm: 1e-4, ..certain };
    planner.problem.expansions_max = 0;
    planner.step(&hardly_bent, STEP_MM, STEP_MM);
    assert!(planner.without_path_mm > 0.0, "no path was found");
    assert_eq!(planner.longest_mm, longest_mm - STEP_MM);
}

/// The needle starts on the wall z = 0 of the workspace, off the plane, and its first estimates scatter about it.
#[test]
fn a_start_on_a_wall_and_off_the_plane_is_inside() {
    let mut world = world(vec![]);
    world.workspace.min_mm.z = 0.0;
    let problem = problem([0.0, 0.0, 120.0], true);
    let start = |off_mm: f64, z_mm: f64| {
        let position_mm = Vector3::new(off_mm, 0.0, z_mm);
        let estimate = exact(Tip { position_mm, ..problem.start });
        Replanner::new(world.clone(), problem.clone(), 0.0, None).step(&estimate, 0.0, STEP_MM)
    };
    assert!(matches!(start(5.0, -0.6), Step::Steer(_)), "{:?}", start(5.0, -0.6));
    assert_eq!(start(5.0, -3.6), Step::Stop(StopReason::TipOutside));
    assert_eq!(start(f64::NAN, 0.0), Step::Stop(StopReason::TipOutside));
}

/// The wall is 1 mm ahead, and the target beside the tip.
#[test]
fn a_wall_ahead_is_named() {
    let mut world = world(vec![]);
    world.workspace.max_mm.z = 21.0;
    let problem = problem([0.0, 3.0, 20.0], true);
    let mut planner = Replanner::new(world, problem.clone(), 0.0, None).with_stopping_mm(0.2);
    let mut tip = problem.start;
    assert!(matches!(planner.step(&exact(tip), 0.0, STEP_MM), Step::Steer(_)));
    tip.position_mm.z = 20.5;
    assert_eq!(planner.step(&exact(tip), 20.5, STEP_MM), Step::Stop(StopReason::WallAhead));
}
