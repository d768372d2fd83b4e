//! Targets that move.

use super::*;

/// The target has moved to where the needle cannot come. The tip may still be on the path to where it was.
#[test]
fn a_path_to_where_the_target_was_is_not_followed() {
    let mut problem = problem([0.0, 0.0, 120.0], true);
    let path = plan(&world(vec![]), &problem).path;
    problem.expansions_max = 0;
    let mut planner = Replanner::new(world(vec![]), problem.clone(), 0.0, path);
    planner.set_target(Vector3::new(0.0, 30.0, 60.0));
    let end = (0..60).find_map(|mm| {
        let position_mm = Vector3::z() * f64::from(mm);
        let tip = Tip { position_mm, ..problem.start };
        let doubtful = TipEstimate { position_sd_mm: 0.3, heading_sd_rad: 0.02, ..exact(tip) };
        let step = planner.step(&doubtful, if mm == 0 { 0.0 } else { STEP_MM }, STEP_MM);
        (!matches!(step, Step::Steer(_))).then_some((step, mm))
    });
    assert_eq!(end, Some((Step::Stop(StopReason::NoPath), 5)));
}

/// The target moves 3 mm in 90 steps.
#[test]
fn a_target_that_moves_is_followed() {
    let mut planner = Replanner::new(world(vec![]), problem([0.0, 0.0, 120.0], true), 0.0, None);
    let mut needle = Simulated::new(RADIUS_MM);
    let mut mm = 0.0;
    loop {
        planner.set_target(Vector3::new(0.0, 3.0 * f64::min(mm / 90.0, 1.0), 120.0));
        match planner.step(&exact(needle.tip), 1.0, 1.0) {
            Step::Steer(steer) => needle.step(&steer, RADIUS_MM),
            end => break assert!(error_mm(&end) < 0.6, "{end:?}"),
        }
        mm += 1.0;
    }
}

/// A target that is suddenly behind the tip was not passed: the run must not end as if it had been.
#[test]
fn a_target_behind_the_tip_is_not_arrived_at_before_the_path_ends() {
    let straight = problem([0.0, 0.0, 120.0], true);
    let path = plan(&world(vec![]), &straight).path;
    let mut planner = Replanner::new(world(vec![]), straight.clone(), 0.0, path);
    let first = planner.step(&known(straight.start, &straight), 0.0, STEP_MM);
    assert!(matches!(first, Step::Steer(_)), "{first:?}");
    planner.set_target(Vector3::new(0.0, 0.0, -30.0));
    let position_mm = Vector3::z() * STEP_MM;
    let estimate = known(Tip { position_mm, ..straight.start }, &straight);
    let next = planner.step(&estimate, STEP_MM, STEP_MM);
    assert_eq!(next, Step::Stop(StopReason::NoPath));
}

/// The target moves aside 3 mm before the tip, by more than the needle can follow. A whole circle, 157 mm long, would
/// come back to it.
#[test]
fn a_target_that_is_missed_is_not_circled() {
    let radius_mm = 25.0;
    for in_plane in [true, false] {
        let straight = [0.0, 0.0, 60.0];
        let sharp = Problem {
            curvature_per_mm: 1.0 / radius_mm,
            tolerance_mm: 0.05,
            length_max_mm: 400.0,
            ..problem(straight, in_plane)
        };
        let path = plan(&world(vec![]), &sharp).path;
        let mut planner = Replanner::new(world(vec![]), sharp.clone(), 0.0, path);
        let mut needle = Simulated::new(radius_mm);
        let mut depth_mm = 0.0;
        let end = loop {
            let target_mm = if depth_mm < 57.0 { straight } else { [0.0, 2.2, 60.0] };
            planner.set_target(target_mm.into());
            let estimate = known(needle.tip, &sharp);
            match planner.step(&estimate, if depth_mm == 0.0 { 0.0 } else { STEP_MM }, STEP_MM) {
                Step::Steer(steer) => {
                    assert!(depth_mm + steer.remaining_mm < 62.0, "{depth_mm} {steer:?}");
                    needle.step(&steer, radius_mm);
                }
                end => break end,
            }
            depth_mm += STEP_MM;
        };
        assert!((1.0..2.2).contains(&error_mm(&end)) && depth_mm < 62.0, "{end:?} {depth_mm}");
    }
}
