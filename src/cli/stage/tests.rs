//! Tests of the motions' arguments.

use super::*;

#[test]
fn a_speed_over_the_limit_is_refused_with_the_configured_limit() {
    let config = Config::from_sources(&[], &[]).unwrap();
    let mut stage = config.to_stage().unwrap();
    stage.rotation.limits.speed_max = 3_f64.to_radians();
    let jog = jog_move(&config, Axis::Rotation, MoveGoal::By(1.0));
    let speed = |text| with_speed(jog, Some(Distance::parse_speed(text).unwrap()), &stage);
    let message = speed("5deg/s").unwrap_err().to_string();
    assert!(message.ends_with("up to 3deg/s"), "{message}");
    assert!(speed("3deg/s").is_ok());
}

#[test]
fn the_rest_of_a_withdrawal_is_what_was_asked_for_and_not_done() {
    let rest = |line: &str, to: f64| {
        let done = AxisMove { axis: Axis::Insertion, from: Some(30.0), to };
        Motion::of(line).unwrap().remaining(&[done], -1.0)
    };
    assert_eq!(rest("withdraw --by 20mm", 24.5).as_deref(), Some(" --by 14.5mm"));
    assert_eq!(rest("withdraw --by 20mm", 10.01), None);
    let unhomed = rest("withdraw --by 32mm --unhomed", 24.46);
    assert_eq!(unhomed.as_deref(), Some(" --by 26.4mm --unhomed"));
    assert_eq!(rest("withdraw --by 31mm", 24.46).as_deref(), Some(" --by 25.4mm"));
    assert_eq!(rest("withdraw", 24.5).as_deref(), Some(""), "to depth 0");
    assert_eq!(rest("withdraw --by 32mm", 30.0), None, "was refused");
    assert_eq!(rest("jog --axis insertion --by=-20mm", 24.5), None);
    for line in ["withdraw", "withdraw --by 20mm"] {
        assert_eq!(Motion::of(line).unwrap().remaining(&[], -1.0), None, "{line} has not begun");
    }
}
