//! The check of handedness.

use super::*;

/// A check of handedness with this sensor.
fn answer(sensor: Option<Sensor>) -> Bench {
    let config = config(&[]);
    let settings = HandednessSettings {
        gate: config.session().unwrap().tracker.gate,
        axis: Vector3::z(),
        turn: Move { arrival: 0.002, speed: 1.0, ..by(Axis::Rotation, FRAC_PI_4) },
    };
    let mut bench = Bench::new(&config, Operation::Handedness(Box::new(settings)));
    bench.sensor = sensor;
    bench
}

/// A sensor 3 mm off the axis, in a right-handed tracker frame.
fn off_axis(turned_rad: f64) -> Vector3<f64> {
    Vector3::new(20.0 + 3.0 * (turned_rad + 0.7).cos(), 3.0 * (turned_rad + 0.7).sin() - 4.0, 5.0)
}

#[test]
fn a_sensor_off_the_axis_proves_the_handedness() {
    let mut bench = answer(Some(off_axis));
    assert_eq!(bench.run(), Outcome::Completed);
    let (insertion_mm, rotation_rad) = bench.travel();
    assert!(insertion_mm.abs() < 2e-4, "{insertion_mm} mm");
    assert!(rotation_rad.abs() < 0.003, "the base is turned back: {rotation_rad} rad");
}

#[test]
fn a_sensor_that_moves_wrongly_fails_the_check_with_a_cause() {
    let mirrored = |turned_rad| off_axis(turned_rad).component_mul(&Vector3::new(-1.0, 1.0, 1.0));
    let turned = |turned_rad| {
        let p = off_axis(turned_rad);
        Vector3::new(p.z, p.y, -p.x)
    };
    let cases: [(Sensor, &str); 5] = [
        (mirrored, "is a tracker axis mirrored, or stage.rotation.sign wrong?"),
        (|turned_rad| off_axis(-turned_rad), "is a tracker axis mirrored"),
        (|turned_rad| off_axis(0.5 * turned_rad), "is it the needle's sensor"),
        (turned, "is the registration turned?"),
        (|_| off_axis(0.0), "handedness cannot be seen; mount it off the axis"),
    ];
    for (sensor, cause) in cases {
        let mut bench = answer(Some(sensor));
        let reason = bench.reason();
        assert!(reason.starts_with("tracker: ") && reason.contains(cause), "{reason}");
        assert!(reason.len() < 200, "{} characters", reason.len());
    }
}

#[test]
fn a_refusal_at_one_standstill_does_not_explain_silence_at_the_next() {
    let mut bench = answer(Some(|_| Vector3::repeat(f64::NAN)));
    while bench.operation.progress().state != State::TurningInAir {
        bench.step();
    }
    let until = bench.now + Duration::from_millis(600);
    while bench.now < until {
        bench.step();
    }
    bench.sensor = Some(off_axis);
    while bench.travel().1 < 0.1 {
        bench.step();
    }
    bench.sensor = None;
    let reason = bench.reason();
    assert!(reason.ends_with("the stream is silent, or has another tool"), "{reason}");
}

#[test]
fn a_sensor_that_is_not_seen_fails_the_check_before_any_motion() {
    let mut bench = answer(None);
    assert_eq!(
        bench.reason(),
        "tracker: 0 positions within 1.0 s (limit 5); the stream is silent, or has another tool"
    );
    assert_eq!(bench.travel(), (0.0, 0.0));
}

/// Otherwise the cable would stay wound up.
#[test]
fn a_base_is_turned_back_before_a_check_of_handedness_fails() {
    let mut bench = answer(Some(|_| off_axis(0.0)));
    assert!(bench.reason().contains("handedness cannot be seen"));
    assert!(bench.travel().1.abs() < 0.003, "{} rad", bench.travel().1);
}

/// The outcome is the stop; the verdict is in the record all the same.
#[test]
fn an_adverse_verdict_is_reported_before_the_base_is_turned_back() {
    let mut bench = answer(Some(|turned_rad| off_axis(-turned_rad)));
    let is_mirrored = |text: &String| text.contains("is a tracker axis mirrored");
    while !bench.events.iter().any(is_mirrored) {
        assert_eq!(bench.operation.outcome(), None);
        bench.step();
    }
    assert!(bench.travel().1 > FRAC_PI_4, "before the turn back: {} rad", bench.travel().1);
    bench.operation.handle(bench.now, Input::Stop("operator: interrupted".to_owned()));
    assert_eq!(bench.reason(), "operator: interrupted");
}
