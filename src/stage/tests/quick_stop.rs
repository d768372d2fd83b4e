//! Stopping from outside a run: standing is a speed, whatever the scale.

use super::*;
use crate::canopen::cia402::DriveState;

/// When an insertion of 100 counts/mm that moves at `mm_per_s` until `stops` is said to stand, and when power is
/// taken off it.
fn coarse_axis(
    quick_stop: fn(&StageConfig, Time) -> QuickStop,
    mm_per_s: f64,
    stops: Duration,
) -> (Duration, Option<Duration>) {
    let mut config = config();
    config.insertion.ratio = CountsRatio::new(100, 1).expect("not zero");
    let begun = Time::from_secs_f64(1.0);
    let mut drives = [TestDrive::new(node(1), 1000), TestDrive::new(node(2), 0)];
    drives.iter_mut().for_each(|drive| drive.state = DriveState::SwitchedOn);
    let (mut quick_stop, mut now, mut off) = (quick_stop(&config, begun), begun, None);
    while !quick_stop.is_over() {
        let gone_s = now.since(begun).min(stops).as_secs_f64();
        drives[0].counts = 1000 + (gone_s * mm_per_s * 100.0) as i32;
        while let Some(frame) = quick_stop.poll_transmit() {
            if frame.to_string() == "601#2B40600000000000" {
                off.get_or_insert(now.since(begun));
            }
            for drive in &mut drives {
                let answers = drive.handle_frame(now, &frame);
                answers.iter().for_each(|answer| quick_stop.handle_frame(now, answer));
            }
        }
        now = now.max(quick_stop.deadline().min(now + Duration::from_millis(20)));
        quick_stop.handle_timeout(now);
    }
    (now.since(begun), off)
}

#[test]
fn a_moving_coarse_axis_is_not_taken_for_standing() {
    // Half a second for two counts at 0.04 mm/s.
    let stops = Duration::from_millis(700);
    let watch =
        |config: &StageConfig, now| QuickStop::watch(config, now, now + Duration::from_secs(5));
    for (mm_per_s, stands) in [(4.9, 1.1..1.3), (0.5, 1.1..1.3), (0.0, 0.5..0.6)] {
        let (_, off) = coarse_axis(QuickStop::new, mm_per_s, stops);
        assert!(stands.contains(&off.expect("it always is").as_secs_f64()), "{off:?}");
        // As `stage prove` watches it.
        let (seen, off) = coarse_axis(watch, mm_per_s, stops);
        assert!(stands.contains(&seen.as_secs_f64()), "{seen:?}");
        assert_eq!(off, None);
    }
}

/// What is said of an insertion drive that obeys no controlword before `obeys`.
fn halt_of_a_drive_that_obeys_late(obeys: Duration) -> (Result<i32, String>, TestDrive) {
    let begun = Time::from_secs_f64(1.0);
    let (mut insertion, mut rotation) = (TestDrive::new(node(1), 7), TestDrive::new(node(2), 0));
    insertion.state = DriveState::OperationEnabled;
    let (mut quick_stop, mut now) = (QuickStop::new(&config(), begun), begun);
    while !quick_stop.is_over() {
        insertion.ignores_sdo = now.since(begun) < obeys;
        while let Some(frame) = quick_stop.poll_transmit() {
            for drive in [&mut insertion, &mut rotation] {
                let answers = drive.handle_frame(now, &frame);
                answers.iter().for_each(|answer| quick_stop.handle_frame(now, answer));
            }
        }
        now = now.max(quick_stop.deadline().min(now + Duration::from_millis(20)));
        quick_stop.handle_timeout(now);
    }
    (quick_stop.result(Axis::Insertion).expect("it is over"), insertion)
}

#[test]
fn a_drive_that_does_not_obey_is_told_again_and_then_named() {
    let (result, drive) = halt_of_a_drive_that_obeys_late(Duration::from_millis(300));
    assert_eq!((result, drive.state), (Ok(7), DriveState::SwitchOnDisabled));
    let (result, _) = halt_of_a_drive_that_obeys_late(Duration::from_secs(3));
    let said = result.expect_err("it was not seen to stand in time");
    assert_eq!(
        said,
        "insertion: node 1 stays in operation enabled (0x0237 operation enabled); its power was \
         taken off"
    );
    let (result, _) = halt_of_a_drive_that_obeys_late(Duration::MAX);
    assert_eq!(
        result.expect_err("it never obeys"),
        "insertion: node 1 keeps its power (statusword 0x0237 operation enabled): power off \
         was not seen, press the emergency stop"
    );
}

#[test]
fn a_short_answer_is_neither_statusword_nor_position() {
    let begun = Time::from_secs_f64(1.0);
    let said_at = |answers: [&str; 3]| {
        let mut quick_stop = QuickStop::watch(&config(), begun, begun + Duration::from_secs(1));
        for answer in answers {
            quick_stop.handle_frame(begun, &answer.parse().expect("a frame"));
        }
        quick_stop.result(Axis::Insertion)
    };
    let (short, disabled, unsized_) =
        ("581#4F41600040000000", "581#4B41600050020000", "581#4241600050020000");
    let has_bytes = |text: &str| Some(Err(format!("insertion: node 1 {text}")));
    assert_eq!(said_at([short, "080#", "080#"]), has_bytes("0x6041:00 has 1 bytes"));
    for statusword in [disabled, unsized_] {
        let position = [statusword, "581#4B64600007000000", "080#"];
        assert_eq!(said_at(position), has_bytes("0x6064:00 has 2 bytes"));
    }
}
