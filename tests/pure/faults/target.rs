//! Faults of a target that is a tool of its own on the tracker's stream.

use crate::support::bench::{Bench, Fate, configured_with};
use crate::support::stop::Stop;
use needle_bench::session::Input;
use needle_bench::tracker::{Event, Sample};
use std::time::Duration;

const TARGET: &str = "TargetToTracker";
const GOAL: [&str; 8] = [
    "goal.kind=\"target\"",
    "goal.position_mm=[0.0, 4.0, 60.0]",
    "goal.tool=\"TargetToTracker\"",
    "insertion.depth_mm=80",
    "insertion.speed_mm_per_s=5",
    "emulator.start={ x_mm=0, y_mm=0, z_mm=0, yaw_deg=0, pitch_deg=0, roll_deg=0 }",
    "observer.invariant.start_sd={ yaw_deg=3, pitch_deg=3, roll_deg=5 }",
    "tracker.hold_after_mm=5",
];

fn bench(sets: &[&str]) -> Bench {
    Bench::new(configured_with(&[&GOAL, sets].concat()))
}

fn is_target(input: &Input) -> bool {
    matches!(input, Input::Tracker(Event::Sample(sample)) if sample.tool == TARGET)
}

/// Applies `change` to every sample of the target on its way to the bench.
fn change(bench: &mut Bench, change: impl Fn(&mut Sample) + 'static) {
    bench.change_samples(move |sample| {
        if sample.tool == TARGET {
            change(sample);
        }
    });
}

/// A run in which every sample of the target is changed from 10 mm on.
fn changed(what: impl Fn(&mut Sample) + Clone + 'static) -> Stop {
    let mut bench = bench(&[]);
    bench.run_to_mm(10.0);
    Stop::of(bench, |bench| change(bench, what.clone()))
}

/// Asserts that the run was held within 300 ms and then stopped, with `why` in its reason.
fn is_lost(stop: &Stop, why: &str) {
    let reason = stop.bench.reason();
    assert!(reason.starts_with("tracker: the target is lost"), "{reason}");
    // The mean of the positions shows a jump before five of them are refused.
    let is_counted = reason.contains(" refused in a row (limit 5)");
    assert_eq!(is_counted, !why.starts_with("innovation"), "{reason}");
    assert!(reason.contains("; held and stopped; "), "{reason}");
    assert!(reason.contains(why), "{reason}");
    assert!(stop.detected_after() <= Duration::from_millis(300), "{:?}", stop.detected_after());
}

/// Asserts that a run ends before power, with both parts of `why` in its reason.
fn never_begins(sets: &[&str], what: impl Fn(&mut Sample) + Clone + 'static, why: [&str; 2]) {
    let stop = Stop::of(bench(sets), |bench| change(bench, what.clone()));
    stop.never_had_power();
    let reason = stop.bench.reason();
    assert!(why.iter().all(|why| reason.contains(why)), "{reason}");
}

#[test]
fn a_target_that_jumps() {
    is_lost(&changed(|sample| sample.position_mm.y += 5.0), "innovation: ");
}

#[test]
fn a_target_position_that_is_not_finite() {
    is_lost(&changed(|sample| sample.position_mm.y = f64::NAN), "finite: position");
}

#[test]
fn a_target_stream_that_changes_its_frame() {
    let turned = |sample: &mut Sample| sample.position_mm.swap_rows(0, 2);
    is_lost(&changed(turned), "mm from goal.position_mm (limit 10.0, goal.tool_range_mm)");
}

#[test]
fn a_target_outside_the_trackers_workspace() {
    let box_mm = "tracker.workspace={ min_mm=[-50, -50, -10], max_mm=[50, 50, 100] }";
    let mut bench = bench(&[box_mm]);
    bench.run_to_mm(10.0);
    let stop = Stop::of(bench, |bench| change(bench, |sample| sample.position_mm.x = 60.0));
    is_lost(&stop, "workspace: target at x = 60.0 mm, outside -50.0 to 50.0 mm");
}

#[test]
fn a_target_that_is_frozen() {
    let frozen = |sample: &mut Sample| sample.position_mm = [0.0, 4.0, 60.0].into();
    is_lost(&changed(frozen), "repeat: the same position to the bit");
}

#[test]
fn a_target_that_is_no_longer_seen() {
    let mut bench = bench(&[]);
    bench.run_to_mm(10.0);
    let stop = Stop::of(bench, |bench| bench.lose(is_target));
    let reason = stop.bench.reason();
    assert!(reason.starts_with("tracker: the target was last seen 0.5"), "{reason}");
    assert!(reason.ends_with("is \"TargetToTracker\" in view? See goal.tool"), "{reason}");
    assert!(stop.detected_after() <= Duration::from_millis(530));
}

/// With `tracker.resume = "automatic"` the insertion continues.
#[test]
fn a_target_that_is_seen_again() {
    let mut bench = bench(&["tracker.resume=\"automatic\""]);
    bench.run_to_mm(10.0);
    bench.heals = true;
    bench.spoil(|input| if is_target(&input) { Fate::Lost } else { Fate::Arrives(input) });
    bench.run_to_end();
    assert!(bench.completed(), "{}", bench.reason());
    assert!(bench.detection.is_some(), "the insertion was not held");
    let resumed = "the target is seen again; insertion goes on, held for ";
    assert!(bench.events().any(|text| text.contains(resumed)));
}

#[test]
fn a_target_that_is_never_seen() {
    let stop = Stop::of(bench(&[]), |bench| bench.lose(is_target));
    stop.never_had_power();
    assert_eq!(
        stop.bench.reason(),
        "tracker: no target within 5.0 s; the target has not been seen; is \"TargetToTracker\" in view? \
         See goal.tool"
    );
}

#[test]
fn a_target_that_is_seen_where_no_path_leads() {
    let frame = ["no target within 5.0 s", "(limit 10.0, goal.tool_range_mm); another frame"];
    never_begins(&[], |sample| sample.position_mm.swap_rows(0, 2), frame);
    let far = ["goal.tool_range_mm=100"];
    let behind = ["no path to the target", "mm behind the start"];
    never_begins(&far, |sample| sample.position_mm.z -= 70.0, behind);
    let beside = ["no path to the target", "the target is out of reach"];
    never_begins(&far, |sample| sample.position_mm.y += 50.0, beside);
    let off_plane = ["goal: the target is 3.", "mm off the plane (limit goal.tolerance_mm"];
    never_begins(&[], |sample| sample.position_mm.x += 3.4, off_plane);
}

#[test]
fn a_target_that_moves_where_no_path_may_end() {
    let cases = [
        (
            "emulator.target_drift_mm_per_mm=[0.1, 0.0, 0.0]",
            "mm off the plane (limit goal.tolerance_mm",
        ),
        ("emulator.target_drift_mm_per_mm=[0.0, 0.15, 0.0]", "the target has moved 0."),
    ];
    let near = "goal.workspace_mm={ min=[-50, -75, 0], max=[50, 6, 150] }";
    for (drift, why) in cases {
        let stop = Stop::of(bench(&[drift, near]), |_| {});
        let reason = stop.bench.reason();
        assert!(reason.starts_with("goal: ") && reason.contains(why), "{reason}");
    }
}

/// The needle ends where the target is in the end.
#[test]
fn a_moving_target_is_reached() {
    let mut bench = bench(&["emulator.target_drift_mm_per_mm=[0.0, 0.05, 0.0]"]);
    bench.run_to_end();
    assert!(bench.completed(), "{}", bench.reason());
    let end = bench.steps().last().expect("steps").decision.approach.clone().expect("a target");
    assert!((end.target_mm.y - 7.0).abs() < 0.7, "{}", end.target_mm);
    assert!(end.distance_mm < 0.7, "{}", end.distance_mm);
    let truth = bench.stage.truth(bench.now);
    let target_mm = truth.target_mm.expect("it moves");
    assert!((truth.x_pb.translation - target_mm).norm() < 0.8, "{target_mm}");
}
