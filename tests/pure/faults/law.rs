//! Runs that the control law or a limit ends.

use crate::support::bench::{Bench, configured};
use crate::support::stop::{Stop, documented};

/// The sum of the commanded rotations without their signs, in turns.
fn turns(bench: &Bench) -> f64 {
    let commanded = bench.steps().filter_map(|step| step.decision.rotation_cmd_rad_per_mm);
    commanded.map(f64::abs).sum::<f64>() / std::f64::consts::TAU
}

#[test]
fn an_assumed_start_outside_the_law() {
    let bench = Bench::new(configured(&["observer.start={pitch_deg=70.0}"]));
    let stop = Stop::of(bench, |_| ());
    assert_eq!(turns(&stop.bench), 0.0);
    assert_eq!(stop.travel(), [(0.0, 0.0); 2]);
    let reason = "control: estimated pitch is 70.0 deg, the control law holds within 60 deg; start \
                  nearer to the plane";
    assert_eq!(stop.bench.reason(), reason);
}

#[test]
fn a_needle_nothing_like_its_model_is_not_spun() {
    let wrong = [
        // The path of this needle is a circle.
        (&["emulator.radius_mm=10"][..], "over the last 32.0 mm the tip travelled", 2.0),
        (&["needle.radius_mm=10"], "the control law holds within 60 deg", 0.5),
        (&["needle.radius_mm=100000"], "the control law is spinning it", 2.0),
        (&["emulator.start={x_mm=200.0}"], "the control law holds within 60 deg", 1.0),
        (&["emulator.noise={uniform_mm=100.0}"], "the control law holds within 60 deg", 0.5),
    ];
    for (sets, reason, turns_max) in wrong {
        // Otherwise the tracker's gates would often hold the insertion first.
        let gates = ["tracker.gates.innovation_chi2=1e9", "tracker.gates.step_sds=1e6"];
        let stop = Stop::of(Bench::new(configured(&[sets, &gates].concat())), |_| ());
        let (stopped_for, turns) = (stop.bench.reason(), turns(&stop.bench));
        assert!(stopped_for.contains(reason), "{sets:?}: {stopped_for}");
        assert!(turns < turns_max, "{sets:?}: {turns} turns");
        let net = stop.bench.stage.position_true(stop.bench.now).1 / std::f64::consts::TAU;
        assert!(net.abs() <= 1.0, "{sets:?}: {net} turns");
    }
}

#[test]
fn a_depth_past_a_soft_limit() {
    let stop = Stop::of(
        Bench::new(configured(&["emulator.insertion_start_mm=290", "insertion.depth_mm=30"])),
        |_| (),
    );
    stop.never_had_power();
    let reason = "stage: insertion: 320.000 mm is over the limit of 310.000 mm (stage.insertion.max_mm); \
                  the axis stands at 290.000 mm, and insertion.depth_mm is 30.000";
    documented(&[stop], "a_depth_past_a_soft_limit", 1000.0, reason);
}

/// The base would turn by 15 degrees while it brakes from the speed of the second run.
#[test]
fn a_soft_limit_of_the_rotation() {
    let fast = ["control.kind=\"nested-saturation\"", "insertion.speed_mm_per_s=2"];
    for (more, limit) in [(&[][..], -20.0), (&fast, -60.0)] {
        let limits = [
            format!("stage.rotation.min_deg={limit:.1}"),
            format!("stage.rotation.max_deg={:.1}", -limit),
        ];
        let sets = [more, &limits.each_ref().map(String::as_str)].concat();
        let stop = Stop::of(Bench::new(configured(&sets)), |_| ());
        let (_, end_rad) = stop.bench.stage.position_true(stop.bench.now);
        let end_deg = end_rad.to_degrees().abs();
        assert!((-limit - 1.5..-limit).contains(&end_deg), "{end_deg}");
        let reason = stop.bench.reason();
        assert!(reason.starts_with("stage: rotation: "), "{reason}");
        assert!(
            reason.contains(&format!("the limit of {:.3} deg", limit.copysign(end_rad))),
            "{reason}"
        );
    }
}
