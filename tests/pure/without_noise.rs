//! Whole runs without noise, so that other errors of an estimate show.

use crate::support::program::{Scratch, needle_bench};
use serde_json::Value;

/// The JSON of a run of 200 mm without noise, with `sets` over that.
fn noiseless(sets: &[&str]) -> Value {
    let scratch = Scratch::new();
    let mut arguments = vec![
        "run",
        "--json",
        "-q",
        "--set",
        "emulator.noise={}",
        "--set",
        "insertion.depth_mm=200",
    ];
    sets.iter().for_each(|set| arguments.extend(["--set", set]));
    let said = needle_bench(&scratch, &arguments);
    assert_eq!(said.status, 0, "{}{}", said.stdout, said.stderr);
    said.json()
}

fn rms(json: &Value, coordinate: &str) -> f64 {
    json["estimate_rms"][coordinate].as_f64().unwrap()
}

/// In the plane's frame, which the poses of plane and tracker and the signs of the drives do not change.
#[test]
fn the_run_does_not_depend_on_frames_or_signs() {
    let elsewhere = noiseless(&[
        "plane={x_mm=10,y_mm=-20,z_mm=30,yaw_deg=50,pitch_deg=-30,roll_deg=20}",
        "tracker.registration={x_mm=100,y_mm=-50,z_mm=20,yaw_deg=10,pitch_deg=20,roll_deg=100}",
        "stage.insertion.sign=-1",
        "stage.rotation.sign=-1",
    ]);
    let here = noiseless(&[]);
    assert_eq!(elsewhere["steps_saturated"], here["steps_saturated"]);
    for (name, tolerance) in [("off_plane_rms_mm", 1e-3), ("settling_mm", 1.5)] {
        let (a, b) = (elsewhere[name].as_f64().unwrap(), here[name].as_f64().unwrap());
        assert!((a - b).abs() < tolerance, "{name}: {a} and {b}");
    }
    assert!(rms(&elsewhere, "y_mm") < 0.01 && rms(&elsewhere, "roll_deg") < 0.1, "{elsewhere}");
}

/// At 5 mm/s a latency of 175 ms, if the bench does not know it, is an error of 0.875 mm along the path.
#[test]
fn a_known_latency_causes_no_error_along_the_path() {
    let late = |stamp: &str, known_ms: &str| {
        noiseless(&[
            "insertion.speed_mm_per_s=5",
            "tracker.hold_after_mm=3",
            "emulator.tracker_latency_ms=175",
            &format!("tracker.stamp={stamp}"),
            &format!("tracker.latency_ms={known_ms}"),
        ])
    };
    let along = |json: &Value| rms(json, "y_mm").hypot(rms(json, "z_mm"));
    for stamp in ["receive", "source"] {
        let known = late(stamp, "175");
        assert!(along(&known) < 0.005, "{stamp}: {known}");
        assert!((along(&late(stamp, "0")) - 0.875).abs() < 0.05, "{stamp}");
    }
}

/// With the control law that turns the needle slowly.
#[test]
fn the_finite_difference_observer_can_steer_without_noise() {
    let json = noiseless(&[
        "observer.kind=finite-difference",
        "observer.finite_difference.baseline_mm=2",
        "control.kind=feedback-linearization",
    ]);
    assert!(json["off_plane_rms_mm"].as_f64().unwrap() < 0.5, "{json}");
    assert!(rms(&json, "roll_deg") < 1.0, "{json}");
}

/// A step may take longer than the stage's history lasts. The session then predicts between the steps.
#[test]
fn slow_insertions_are_estimated_as_well_as_fast_ones() {
    let slow =
        noiseless(&["insertion.depth_mm=60", "can.sync_ms=5", "insertion.speed_mm_per_s=0.2"]);
    let quick = noiseless(&["insertion.depth_mm=60", "can.sync_ms=5"]);
    for coordinate in ["x_mm", "y_mm", "z_mm", "roll_deg"] {
        let difference = rms(&slow, coordinate) - rms(&quick, coordinate);
        assert!(difference.abs() < 0.05 + 0.02 * rms(&quick, coordinate), "{slow} {quick}");
    }
}
