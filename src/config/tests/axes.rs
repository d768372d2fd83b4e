//! Keys of an axis, its drive and its operations.

use super::*;
use crate::stage::{HomingConfig, Reference};

#[test]
fn a_homing_reference_without_a_zero_in_counts_is_refused() {
    assert_eq!(
        refusal("stage.rotation.reference = \"homing\""),
        "bench.toml:1: stage.rotation.zero is \"start\", but stage.rotation.reference is \
         \"homing\": give the counts, 0 for the drive's zero"
    );
}

/// Otherwise three jogs of 15° would end at 45° in spite of limits of 20°, which count from each start.
#[test]
fn limits_of_a_real_axis_without_a_fixed_zero_are_refused() {
    let absolute = "stage.rotation.reference=absolute";
    let error = refused(RIG, &[absolute, "stage.rotation.zero=start"]);
    let expected = "--set stage.rotation.zero is \"start\": limits of -720 to 720 deg would count anew from \
                    each start";
    assert!(error.starts_with(expected), "{error}");
    loaded(RIG, &[absolute, "stage.rotation.zero=-1234"]);
    loaded(RIG, &[absolute, "stage.rotation.zero=start", "stage.rotation.wraps=true"]);
}

#[test]
fn a_home_outside_the_limits_is_refused() {
    assert_eq!(
        refusal("stage.insertion.homing.offset_mm = 5"),
        "bench.toml:1: stage.insertion.homing.offset_mm is 5, which puts home at -5.000 mm with \
         stage.insertion.zero = 0, allowed: stage.insertion.min_mm to stage.insertion.max_mm, \
         which are -1 and 310"
    );
    // With this zero the axis reads 0 at home.
    loaded("stage.insertion.homing.offset_mm = 5\nstage.insertion.zero = -23230\n", &[]);
}

/// The whole range of the axis would lie beyond that switch.
#[test]
fn a_homing_that_seeks_the_wrong_end_is_refused() {
    let homing = |method: i8, sign: i8, limits: &str| {
        format!(
            "stage.insertion.homing = {{ method = {method}, timeout_s = 60.0, homed_bit = 12 }}\n\
             stage.insertion.sign = {sign}\n{limits}"
        )
    };
    assert_eq!(
        refusal(&homing(18, 1, "")),
        "bench.toml:2: stage.insertion.homing.method is 18, which with sign = 1 seeks the switch \
         at the deep end: home is 0.000 mm, the limits of -1 to 310 mm go 310.0 mm beyond it; is it 17?"
    );
    let deep =
        "stage.insertion.min_mm = -310\nstage.insertion.max_mm = 1\ninsertion.depth_mm = 1\n";
    assert_eq!(
        refusal(&homing(1, 1, deep)),
        "bench.toml:4: stage.insertion.homing.method is 1, which with sign = 1 seeks the switch at \
         the withdrawn end: home is 0.000 mm, the limits of -310 to 1 mm go 310.0 mm beyond it; is it 2?"
    );
    for text in [homing(17, 1, ""), homing(2, -1, ""), homing(18, 1, deep), homing(28, 1, "")] {
        loaded(&text, &[]);
    }
    // A home switch that is sought in the direction in which the counts grow, and its mirror image.
    for (method, mirrored) in [(7, 11), (10, 14), (23, 27), (24, 28)] {
        for (sought, other, sign) in [(method, mirrored, 1), (mirrored, method, -1)] {
            let error = refusal(&homing(sought, sign, ""));
            assert!(error.ends_with(&format!("beyond it; is it {other}?")), "{error}");
            loaded(&homing(sought, -sign, ""), &[]);
        }
    }
}

/// The emulated drive has its own limit; a real one may have none.
#[test]
fn a_homing_speed_over_the_axis_limit_is_refused() {
    for key in ["speed_switch_mm_per_s", "speed_zero_mm_per_s"] {
        let homing = format!("method = 17, {key} = 10.5, timeout_s = 60.0, homed_bit = 12");
        assert_eq!(
            refusal(&format!("stage.insertion.homing = {{ {homing} }}\n")),
            format!(
                "bench.toml:1: stage.insertion.homing.{key} is 10.5, allowed: up to \
                 stage.insertion.speed_max_mm_per_s, which is 10"
            )
        );
    }
}

#[test]
fn a_withdrawal_speed_over_the_axis_limit_is_refused() {
    assert_eq!(
        refusal("stage.insertion.withdraw_speed_mm_per_s = 12"),
        "bench.toml:1: stage.insertion.withdraw_speed_mm_per_s is 12, allowed: up to \
         stage.insertion.speed_max_mm_per_s, which is 10"
    );
}

/// The error names both keys and both numbers. The bound itself is allowed.
#[test]
fn accelerations_over_the_axis_limits_are_refused() {
    let braking = "tracker.hold_braking_mm_per_s2 = 10\ntracker.hold_after_mm = 2\n";
    let along =
        |max: f64| format!("{braking}stage.insertion.acceleration_max_mm_per_s2 = {max:?}\n");
    let peak = |key: &str, max: &str, unit: &str, axis: &str| {
        format!(
            "bench.toml:3: {key} is 10, allowed: up to {max}: the last set-point brakes 1.125 times \
             as hard, and stage.{axis}.acceleration_max_{unit}_per_s2 is 11.2"
        )
    };
    assert_eq!(
        refusal(&along(11.2)).lines().collect::<Vec<_>>(),
        [
            peak("insertion.acceleration_mm_per_s2", "9.955", "mm", "insertion"),
            peak("stage.insertion.jog_acceleration_mm_per_s2", "9.955", "mm", "insertion"),
        ]
    );
    assert_eq!(
        refusal("stage.insertion.acceleration_max_mm_per_s2 = 39"),
        "bench.toml:1: tracker.hold_braking_mm_per_s2 is 40, allowed: up to \
         stage.insertion.acceleration_max_mm_per_s2, which is 39"
    );
    assert_eq!(
        refusal("insertion.acceleration_mm_per_s2 = 30"),
        "bench.toml:1: insertion.acceleration_mm_per_s2 is 30, allowed: up to \
         stage.insertion.quick_stop_deceleration_mm_per_s2, which is 21.5239"
    );
    let about = |max: f64| format!("stage.rotation.acceleration_max_deg_per_s2 = {max:?}\n");
    assert_eq!(
        refusal(&about(3600.0)),
        "bench.toml:1: control.nested_saturation.rotation_max_deg_per_mm is 60: reversed at 2 mm/s, \
         that is 24000 deg/s², over stage.rotation.acceleration_max_deg_per_s2 = 3600; turn or insert more \
         slowly"
    );
    let jog = about(24_000.0)
        + "stage.rotation.jog_acceleration_deg_per_s2 = 22000\n\
           stage.rotation.quick_stop_deceleration_deg_per_s2 = 22000\n";
    assert_eq!(
        refusal(&jog),
        "bench.toml:1: stage.rotation.jog_acceleration_deg_per_s2 is 22000, allowed: up to \
         21333.333: the last set-point brakes 1.125 times as hard, and \
         stage.rotation.acceleration_max_deg_per_s2 is 24000"
    );
    for text in [along(11.25), about(24_000.0)] {
        loaded(&text, &[]);
    }
}

#[test]
fn the_stage_gets_the_homing_of_its_axes() {
    let text = "[stage.insertion]\nreference = \"homing\"\nzero = -500\n\
                [stage.rotation.homing]\nspeed_zero_deg_per_s = 180.0\n";
    let config = loaded(text, &[]);
    let stage = config.to_stage().expect("a stage");
    assert_eq!(stage.insertion.reference, Reference::Homing);
    assert_eq!(stage.insertion.zero, Some(-500));
    let insertion = stage.insertion.homing.expect("homing");
    assert_eq!((insertion.method, insertion.speed_zero), (33, None));
    assert_eq!(insertion.homed_bit, HomingConfig::ATTAINED_BIT);
    let rotation = stage.rotation.homing.expect("homing");
    assert_eq!((rotation.method, rotation.speed_zero), (37, Some(std::f64::consts::PI)));
}

#[test]
fn an_advised_rotation_or_speed_is_allowed() {
    let refused_rotation = |deg_per_mm: &str, mm_per_s: &str| {
        let sets = [
            format!("control.nested_saturation.rotation_max_deg_per_mm={deg_per_mm}"),
            format!("insertion.speed_mm_per_s={mm_per_s}"),
            "stage.rotation.speed_max_deg_per_s=50".to_owned(),
        ];
        let error = load("", &sets.each_ref().map(String::as_str)).err().map(|e| e.to_string());
        let of_rotation = "control.nested_saturation.rotation_max_deg_per_mm is ";
        error?.lines().find(|line| line.contains(of_rotation)).map(str::to_owned)
    };
    let error = refused_rotation("30", "3").expect("90 deg/s is over 50");
    let advice = "turn by 16.6666 deg/mm or insert at 1.6666 mm/s";
    assert!(error.ends_with(advice), "{error}");
    assert_eq!([refused_rotation("16.6666", "3"), refused_rotation("30", "1.6666")], [None, None]);
}

#[test]
fn options_by_which_a_real_drive_would_not_stop_are_refused() {
    for (key, allowed, refused_values) in [
        ("abort_connection_option", &[1, 2, 3][..], &[-1, 0, 4][..]),
        ("communication_error_behaviour", &[0, 2], &[1, 3]),
        ("quick_stop_option", &[2, 3, 6, 7], &[-1, 0, 1, 4, 5, 8]),
        ("fault_reaction_option", &[2, 3], &[-1, 0, 1, 4]),
    ] {
        let set = |value| format!("stage.rotation.{key}={value}");
        for value in allowed {
            loaded(RIG, &[&set(value)]);
        }
        for value in refused_values {
            let error = refused(RIG, &[&set(value)]);
            let expected =
                format!("--set stage.rotation.{key} is {value}, allowed with stage.hardware");
            assert!(error.starts_with(&expected), "{error}");
        }
        // An emulated drive may have such a value.
        loaded("", &[&set(refused_values.last().unwrap())]);
    }
}

#[test]
fn objects_that_move_or_supervise_an_axis_are_not_optional() {
    for index in [
        0x1000, 0x1016, 0x1017, 0x1018, 0x1400, 0x1600, 0x1800, 0x1A00, 0x6007, 0x6040, 0x6041,
        0x6060, 0x6061, 0x6064, 0x607A, 0x607C, 0x607D, 0x6085, 0x6098,
    ] {
        let set = format!("stage.insertion.optional_objects=[0x60C2, {index}]");
        let error = set_refusal(&[&set]);
        let expected = format!(
            "--set stage.insertion.optional_objects[1] is 0x{index:04X}, which is not optional"
        );
        assert!(error.starts_with(&expected), "{error}");
    }
    let sets = ["stage.rotation.wraps=true", "stage.rotation.optional_objects=[0x607D]"];
    // A wrapping axis has no position limits.
    loaded("", &sets);
    let others = "stage.rotation.optional_objects=[0x1005, 0x1029, 0x1401, 0x605A, 0x605E, \
                  0x6065, 0x6066, 0x6099, 0x609A, 0x60C2, 0x6502]";
    loaded("", &[others]);
    loaded(RIG, &[others]);
}

#[test]
fn a_following_error_timeout_longer_than_the_benchs_is_refused() {
    let timeout = |ms| format!("stage.insertion.following_error_timeout_ms={ms}");
    loaded("", &[&timeout(20)]);
    assert_eq!(
        set_refusal(&[&timeout(21)]),
        "--set stage.insertion.following_error_timeout_ms is 21, allowed: up to 20 \
         (twice can.sync_ms), so that the drive notices no later than the bench"
    );
}

#[test]
fn raw_sdos_to_objects_that_the_bench_writes_are_refused() {
    let raw = |index: u16| {
        format!("stage.insertion.sdo=[{{ index = {index}, subindex = 0, value = 0, bits = 8 }}]")
    };
    for (index, instead) in [
        (0x6040, "the bench alone enables"),
        (0x6060, "the bench sets the mode"),
        (0x607A, "`needle-bench stage jog`"),
        (0x60FF, "`needle-bench stage jog`"),
        (0x6071, "`needle-bench stage jog`"),
        (0x1014, "every emergency message"),
        (0x1015, "every emergency message"),
        (0x1016, "can.heartbeat_timeout_ms"),
        (0x1017, "can.heartbeat_ms"),
        (0x1029, "communication_error_behaviour"),
        (0x6007, "abort_connection_option"),
        (0x605A, "quick_stop_option"),
        (0x605E, "fault_reaction_option"),
        (0x607D, "max_mm"),
        (0x6065, "following_error_mm"),
        (0x6066, "following_error_timeout_ms"),
        (0x6098, "homing.method"),
        (0x60C2, "can.sync_ms"),
        (0x1010, "maker's tool"),
        (0x1400, "maps the PDOs"),
        (0x1BFF, "maps the PDOs"),
    ] {
        let error = set_refusal(&[&raw(index)]);
        let key = format!("--set stage.insertion.sdo[0].index is 0x{index:04X}, not for raw SDOs");
        assert!(error.starts_with(&key) && error.contains(instead), "{error}");
    }
    for object in ["0x6099, subindex = 2", "0x609A, subindex = 0", "0x607C, subindex = 0"] {
        let raw = format!("stage.rotation.sdo=[{{ index = {object}, value = 0, bits = 32 }}]");
        // Without a homing no key sets these objects.
        loaded("", &[&raw]);
        let homing = "stage.rotation.homing={ method = 37, timeout_s = 10, homed_bit = 12, \
                      speed_zero_deg_per_s = 9, acceleration_deg_per_s2 = 9, offset_deg = 9 }";
        let error = set_refusal(&[&raw, homing]);
        assert!(error.contains("not for raw SDOs: homing."), "{error}");
    }
    loaded("", &[&raw(0x2000)]);
    // The rig sets 6085 in the drive's own units, and the key tells the bench what that is.
    loaded(RIG, &[]);
}
