//! Stopping from outside a run: standing is a speed, whatever the scale.

use super::*;
use crate::canopen::cia402::{Controlword, DriveState, object};
use crate::canopen::cob;
use crate::canopen::nmt::{NmtState, heartbeat_frame};
use crate::canopen::sdo::SdoRequest;
use crate::canopen::sdo::codec::ClientFrame;

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

/// How a stop of an enabled insertion drive ended.
struct Stopped {
    result: Result<i32, String>,
    drive: TestDrive,
    /// The controlwords that were written to it, with the time since the beginning.
    controlwords: Vec<(Duration, u32)>,
}

impl Stopped {
    /// When `controlword` was first written after `since`.
    fn first(&self, controlword: Controlword, since: Duration) -> Option<Duration> {
        let is_it =
            |(at, word): &&(Duration, u32)| *at > since && *word == u32::from(controlword.0);
        self.controlwords.iter().find(is_it).map(|(at, _)| *at)
    }
}

/// Stops or watches an enabled insertion drive; every 20 ms, and before each frame, `change` changes it.
fn run(mut quick_stop: QuickStop, mut change: impl FnMut(Duration, &mut TestDrive)) -> Stopped {
    let begun = Time::from_secs_f64(1.0);
    let (mut drive, mut rotation) = (TestDrive::new(node(1), 7), TestDrive::new(node(2), 0));
    drive.state = DriveState::OperationEnabled;
    let (mut now, mut controlwords) = (begun, Vec::new());
    while !quick_stop.is_over() {
        change(now.since(begun), &mut drive);
        quick_stop.handle_frame(now, &heartbeat_frame(drive.node, drive.nmt));
        while let Some(frame) = quick_stop.poll_transmit() {
            if frame.cob_id() == Some(cob::sdo_rx(drive.node))
                && let Some(ClientFrame::Request(SdoRequest::Download(object::CONTROLWORD, word))) =
                    ClientFrame::decode(frame.data())
            {
                controlwords.push((now.since(begun), word.to_u32()));
            }
            for drive in [&mut drive, &mut rotation] {
                let answers = drive.handle_frame(now, &frame);
                answers.iter().for_each(|answer| quick_stop.handle_frame(now, answer));
            }
        }
        now = now.max(quick_stop.deadline().min(now + Duration::from_millis(20)));
        quick_stop.handle_timeout(now);
    }
    let result = quick_stop.result(Axis::Insertion).expect("it is over");
    Stopped { result, drive, controlwords }
}

fn stop(change: impl FnMut(Duration, &mut TestDrive)) -> Stopped {
    run(QuickStop::new(&config(), Time::from_secs_f64(1.0)), change)
}

/// What is said of an insertion drive that obeys no controlword before `obeys`.
fn halt_of_a_drive_that_obeys_late(obeys: Duration) -> (Result<i32, String>, TestDrive) {
    let stopped = stop(|since, drive| drive.ignores_sdo = since < obeys);
    (stopped.result, stopped.drive)
}

/// Without power the axis would coast.
#[test]
fn a_read_that_fails_does_not_take_power_off_while_the_axis_brakes() {
    let braked = Duration::from_millis(800);
    for read in [object::STATUSWORD, object::POSITION_ACTUAL] {
        let mut lost = Some((read, 3));
        let stopped = stop(|since, drive| {
            if drive.state == DriveState::QuickStopActive && since < braked {
                drive.mute = lost.take().or(drive.mute);
                drive.counts += 100;
            }
        });
        assert!(stopped.result.is_ok(), "{:?}", stopped.result);
        let off = stopped.first(Controlword::DISABLE_VOLTAGE, Duration::ZERO);
        assert!(off.is_some_and(|off| off > braked), "{read}: {off:?}");
        // A statusword that cannot be read does not show that the drive obeyed.
        let again = stopped.first(Controlword::QUICK_STOP, Duration::from_millis(100));
        assert_eq!(again.is_some(), read == object::STATUSWORD);
    }
}

#[test]
fn a_drive_that_another_master_enables_again_is_stopped_again() {
    let enabled = Duration::from_millis(200);
    let mut enables = true;
    let stopped = stop(|since, drive| {
        if since >= enabled && std::mem::take(&mut enables) {
            drive.nmt = NmtState::Operational;
            drive.state = DriveState::OperationEnabled;
        }
        // Still moving, so that the stop goes on.
        drive.counts += if since < 2 * enabled { 100 } else { 0 };
    });
    let again = stopped.first(Controlword::QUICK_STOP, enabled).expect("it is commanded again");
    assert!(again < enabled + Duration::from_millis(100), "{again:?}");
    assert_eq!(stopped.drive.nmt, NmtState::PreOperational);
    assert!(stopped.result.is_ok(), "{:?}", stopped.result);
}

/// A drive may enter NMT Stopped when it misses the bench's heartbeat (0x1029 = 2); it answers no SDO then.
#[test]
fn a_drive_that_stops_by_itself_in_nmt_stopped_is_seen_to_stand() {
    let begun = Time::from_secs_f64(1.0);
    let watch = QuickStop::watch(&config(), begun, begun + Duration::from_secs(2));
    let mut notices = true;
    let watched = run(watch, |since, drive| {
        if since >= Duration::from_millis(300) && std::mem::take(&mut notices) {
            drive.state = DriveState::QuickStopActive;
            drive.nmt = NmtState::Stopped;
        }
    });
    assert_eq!((watched.result, watched.controlwords), (Ok(7), vec![]));
}

#[test]
fn a_drive_that_ignores_quick_stop_gets_it_again_and_is_an_error() {
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
        let mut quick_stop = QuickStop::watch(&config(), begun, begun);
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
