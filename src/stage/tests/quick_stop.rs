//! [`QuickStop`], the stop from outside a run.

use super::*;
use crate::canopen::cia402::{Controlword, DriveState, object};
use crate::canopen::nmt::{NmtState, heartbeat_frame};

const BEGUN: Time = Time::from_nanos(1_000_000_000);

/// What was seen while a stop ran.
struct Seen {
    /// When it ended.
    end: Duration,
    /// The controlwords that were written to the insertion drive, and when.
    controlwords: Vec<(Duration, Controlword)>,
}

impl Seen {
    /// When `controlword` was first written after `since`.
    fn first(&self, controlword: Controlword, since: Duration) -> Option<Duration> {
        let is_it = |(at, word): &&(Duration, Controlword)| *at > since && *word == controlword;
        self.controlwords.iter().find(is_it).map(|(at, _)| *at)
    }

    fn power_off(&self) -> Option<Duration> {
        self.first(Controlword::DISABLE_VOLTAGE, Duration::ZERO)
    }
}

/// Runs `quick_stop` to its end. `change` sets up the insertion drive by the time since the start.
fn run(
    quick_stop: &mut QuickStop,
    drives: &mut [TestDrive; 2],
    mut change: impl FnMut(Duration, &mut TestDrive),
) -> Seen {
    let (mut now, mut controlwords) = (BEGUN, Vec::new());
    while !quick_stop.is_over() {
        let time = now.since(BEGUN);
        change(time, &mut drives[0]);
        quick_stop.handle_frame(now, &heartbeat_frame(drives[0].node, drives[0].nmt));
        while let Some(frame) = quick_stop.poll_transmit() {
            if let Some(word) = frame.to_string().strip_prefix("601#2B406000") {
                let word = u16::from_str_radix(&word[..2], 16).expect("hexadecimal");
                controlwords.push((time, Controlword(word)));
            }
            for drive in drives.iter_mut() {
                let answers = drive.handle_frame(now, &frame);
                answers.iter().for_each(|answer| quick_stop.handle_frame(now, answer));
            }
        }
        now = now.max(quick_stop.deadline().min(now + Duration::from_millis(20)));
        quick_stop.handle_timeout(now);
    }
    Seen { end: now.since(BEGUN), controlwords }
}

/// Stops an insertion of 100 counts/mm that moves at `mm_per_s` until `stops`.
fn coarse_axis(
    quick_stop: fn(&StageConfig, Time) -> QuickStop,
    mm_per_s: f64,
    stops: Duration,
) -> Seen {
    let mut config = config();
    config.insertion.ratio = CountsRatio::new(100, 1).expect("not zero");
    let mut drives = [TestDrive::new(node(1), 1000), TestDrive::new(node(2), 0)];
    drives.iter_mut().for_each(|drive| drive.state = DriveState::SwitchedOn);
    run(&mut quick_stop(&config, BEGUN), &mut drives, |time, insertion| {
        insertion.counts = 1000 + (time.min(stops).as_secs_f64() * mm_per_s * 100.0) as i32;
    })
}

#[test]
fn a_moving_coarse_axis_is_not_taken_for_standing() {
    // Standstill is under 0.04 mm/s: two counts in 0.5 s.
    let stops = Duration::from_millis(700);
    let watch =
        |config: &StageConfig, now| QuickStop::watch(config, now, now + Duration::from_secs(5));
    for (mm_per_s, stands) in [(4.9, 1.1..1.3), (0.5, 1.1..1.3), (0.0, 0.5..0.6)] {
        let off = coarse_axis(QuickStop::new, mm_per_s, stops).power_off();
        assert!(stands.contains(&off.expect("power is taken off").as_secs_f64()), "{off:?}");
        // `stage prove` only watches.
        let seen = coarse_axis(watch, mm_per_s, stops);
        assert!(stands.contains(&seen.end.as_secs_f64()), "{:?}", seen.end);
        assert_eq!(seen.controlwords, []);
    }
}

/// The result of `quick_stop` for an enabled insertion drive, the drive at the end, and what was seen.
fn result_of(
    mut quick_stop: QuickStop,
    change: impl FnMut(Duration, &mut TestDrive),
) -> (Result<i32, String>, TestDrive, Seen) {
    let mut drives = [TestDrive::new(node(1), 7), TestDrive::new(node(2), 0)];
    drives[0].state = DriveState::OperationEnabled;
    let seen = run(&mut quick_stop, &mut drives, change);
    let [drive, _] = drives;
    (quick_stop.outcome(Axis::Insertion).expect("it is over"), drive, seen)
}

/// The result for an insertion drive that ignores controlwords before `obeys`, and the state of the drive.
fn stop_of_a_drive_that_obeys_late(obeys: Duration) -> (Result<i32, String>, DriveState) {
    let quick_stop = QuickStop::new(&config(), BEGUN);
    let (result, drive, _) = result_of(quick_stop, |time, drive| drive.ignores_sdo = time < obeys);
    (result, drive.state)
}

/// Without power the axis would coast.
#[test]
fn a_read_that_fails_does_not_take_power_off_while_the_axis_brakes() {
    let braked = Duration::from_millis(800);
    for read in [object::STATUSWORD, object::POSITION_ACTUAL] {
        let mut lost = Some((read, 3));
        let (result, _, seen) = result_of(QuickStop::new(&config(), BEGUN), |time, drive| {
            if drive.state == DriveState::QuickStopActive && time < braked {
                drive.mute = lost.take().or(drive.mute);
                drive.counts += 100;
            }
        });
        assert!(result.is_ok(), "{result:?}");
        assert!(seen.power_off().is_some_and(|off| off > braked), "{read}: {:?}", seen.power_off());
        // A statusword that cannot be read does not show that the drive obeyed.
        let again = seen.first(Controlword::QUICK_STOP, Duration::from_millis(100));
        assert_eq!(again.is_some(), read == object::STATUSWORD);
    }
}

#[test]
fn a_drive_that_another_master_enables_again_is_stopped_again() {
    let enabled = Duration::from_millis(200);
    let mut enables = true;
    let (result, drive, seen) = result_of(QuickStop::new(&config(), BEGUN), |time, drive| {
        if time >= enabled && std::mem::take(&mut enables) {
            drive.nmt = NmtState::Operational;
            drive.state = DriveState::OperationEnabled;
        }
        // Still moving, so that the stop goes on.
        drive.counts += if time < 2 * enabled { 100 } else { 0 };
    });
    let again = seen.first(Controlword::QUICK_STOP, enabled).expect("it is commanded again");
    assert!(again < enabled + Duration::from_millis(100), "{again:?}");
    assert_eq!(drive.nmt, NmtState::PreOperational);
    assert!(result.is_ok(), "{result:?}");
}

/// A drive may enter NMT Stopped when it misses the bench's heartbeat (0x1029 = 2); it answers no SDO then.
#[test]
fn a_drive_that_stops_by_itself_in_nmt_stopped_is_seen_to_stand() {
    let watch = QuickStop::watch(&config(), BEGUN, BEGUN + Duration::from_secs(2));
    let mut notices = true;
    let (result, _, seen) = result_of(watch, |time, drive| {
        if time >= Duration::from_millis(300) && std::mem::take(&mut notices) {
            drive.state = DriveState::QuickStopActive;
            drive.nmt = NmtState::Stopped;
        }
    });
    assert_eq!((result, seen.controlwords), (Ok(7), vec![]));
}

/// The command that leads the node out of Stopped leaves before the request that the node could not answer there.
#[test]
fn a_node_is_led_out_of_nmt_stopped_before_it_is_read() {
    let mut quick_stop = QuickStop::watch(&config(), BEGUN, BEGUN + Duration::from_secs(2));
    let (mut sent, mut now) = (Vec::new(), BEGUN);
    quick_stop.handle_frame(now, &heartbeat_frame(node(1), NmtState::Stopped));
    while !sent.contains(&"000#8001".to_owned()) {
        now = quick_stop.deadline();
        quick_stop.handle_timeout(now);
        sent = std::iter::from_fn(|| quick_stop.poll_transmit()).map(|f| f.to_string()).collect();
    }
    let is_request = |frame: &String| frame.starts_with("601#40");
    assert!(!sent.iter().any(is_request), "not before the node can answer: {sent:?}");
}

#[test]
fn a_drive_that_ignores_quick_stop_gets_it_again_and_is_an_error() {
    let stop = stop_of_a_drive_that_obeys_late;
    assert_eq!(stop(Duration::from_millis(300)), (Ok(7), DriveState::SwitchOnDisabled));
    assert_eq!(
        stop(Duration::from_secs(3)).0.expect_err("no standstill in time"),
        "insertion: node 1 stays in operation enabled (0x0237 operation enabled); its power was \
         taken off"
    );
    assert_eq!(
        stop(Duration::MAX).0.expect_err("it never obeys"),
        "insertion: node 1 keeps its power (statusword 0x0237 operation enabled): power off \
         was not seen, press the emergency stop"
    );
}

/// It hears nothing as long as the bench waits for the axis to stand, and a little longer.
#[test]
fn power_off_is_commanded_again_until_it_is_confirmed() {
    let deaf = config().power.stop_timeout.mul_f64(1.6);
    let quick_stop = QuickStop::new(&config(), BEGUN);
    let (result, drive, _) = result_of(quick_stop, |time, drive| drive.off = time < deaf);
    assert!(result.is_err(), "{result:?}");
    assert_eq!(drive.state, DriveState::SwitchOnDisabled);
}

#[test]
fn a_short_answer_is_neither_statusword_nor_position() {
    let result_after = |answers: [&str; 3]| {
        let mut quick_stop = QuickStop::watch(&config(), BEGUN, BEGUN);
        for answer in answers {
            quick_stop.handle_frame(BEGUN, &Frame::parse(answer).expect("a frame"));
        }
        quick_stop.outcome(Axis::Insertion)
    };
    let (short, disabled, unsized_) =
        ("581#4F41600040000000", "581#4B41600050020000", "581#4241600050020000");
    let has_bytes = |text: &str| Some(Err(format!("insertion: node 1 {text}")));
    assert_eq!(result_after([short, "080#", "080#"]), has_bytes("0x6041:00 has 1 bytes"));
    for statusword in [disabled, unsized_] {
        let position = [statusword, "581#4B64600007000000", "080#"];
        assert_eq!(result_after(position), has_bytes("0x6064:00 has 2 bytes"));
    }
}
