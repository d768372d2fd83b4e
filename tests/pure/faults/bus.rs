//! Faults of the bus and of the bench itself, and the operator's stop.

use crate::support::bench::{Bench, configured};
use crate::support::stop::{Measured, Stop, documented, stopped};
use needle_bench::canopen::cia402::DriveState;
use needle_bench::canopen::{CanId, Frame};
use needle_bench::emulator::StageOutput;
use needle_bench::session::{Input, Lane, Machine, Output, Record};
use needle_bench::tracker::Event;
use std::time::Duration;

#[test]
fn foreign_and_misshapen_frames_have_no_effect() {
    let mut bench = Bench::new(configured(&["insertion.depth_mm=30"]));
    bench.run_to_mm(10.0);
    let extended = Frame::from_parts(CanId::Extended(0x181), false, &[0; 6]).expect("a frame");
    for _ in 0..4 {
        for cob_id in [0x185, 0x705, 0x085, 0x585, 0x7ff] {
            bench.inject(Frame::new(cob_id, &[0; 8]));
        }
        bench.inject(extended);
        // Of the wrong length: the drives' TPDO1, emergency, heartbeat, SDO.
        for cob_id in [0x181, 0x182, 0x081, 0x701, 0x582] {
            bench.inject(Frame::new(cob_id, &[0; 3]));
        }
        bench.run_for(Duration::from_millis(7));
    }
    bench.run_to_end();
    assert!(bench.completed(), "{}", bench.reason());
    for report in ["frame from elsewhere, 16 so far", "frame of the wrong length, 16 so far"] {
        assert!(bench.events().any(|text| text.starts_with(report)), "no report: {report}");
    }
}

/// After the set-points the session is due at once, and after that tick only later.
#[test]
fn observers_are_updated_after_the_set_points_are_sent() {
    let mut bench = Bench::new(configured(&["insertion.depth_mm=30"]));
    bench.run_to_mm(5.0);
    let mut answered = 0;
    while answered < 100 {
        assert!(bench.session.outcome().is_none(), "{}", bench.reason());
        let due = bench.session.deadline().min(bench.stage.deadline());
        bench.now = bench.now.max(due);
        bench.stage.handle_timeout(bench.now);
        bench.session.handle(bench.now, Input::Tick);
        assert!(bench.session.deadline() > bench.now, "still due after a tick");
        let mut made = sent(&mut bench);
        while let Some(output) = bench.stage.poll() {
            let input = match output {
                StageOutput::Frame(frame) => Input::Frame(frame),
                StageOutput::Tip { tip, .. } => Input::Tracker(Event::Sample(bench.sample(&tip))),
                StageOutput::Target(_) | StageOutput::FaultBegan(_) => continue,
            };
            bench.session.handle(bench.now, input);
            made.extend(sent(&mut bench));
        }
        if made.contains(&0x202) {
            assert!(bench.session.deadline() <= bench.now, "the observers were updated already");
            answered += 1;
        }
    }
}

/// Passes the session's frames to the drives, and gives their identifiers.
fn sent(bench: &mut Bench) -> Vec<u16> {
    let mut sent = Vec::new();
    while let Some(output) = bench.session.poll() {
        if let Output::Transmit { frame, .. } = output {
            bench.stage.handle_frame(bench.now, &frame);
            sent.extend(frame.cob_id());
        }
    }
    sent
}

#[test]
fn a_cut_cable() {
    let stops = stopped(&[], |bench| {
        bench.lose(|input| matches!(input, Input::Frame(_)));
        bench.deafen_drives();
    });
    let reason =
        "stage: insertion: no TPDO1 for 2 SYNCs in a row, check bus load, cable and the drive";
    documented(&stops, "a_cut_cable", 30.0, reason);
}

#[test]
fn a_bus_that_fails() {
    let stops = stopped(&[], |bench| bench.hand(Input::BusFault("can0: bus off".to_owned())));
    documented(&stops, "a_bus_that_fails", 0.0, "can: can0: bus off");
}

#[test]
fn a_stop_by_the_operator() {
    let stops = stopped(&[], |bench| bench.hand(Input::Stop("operator: interrupted".to_owned())));
    documented(&stops, "a_stop_by_the_operator", 0.0, "operator: interrupted");
}

/// While listening, in standby, while enabling, and while inserting. The bring-up of these drives takes no time.
#[test]
fn a_stop_by_the_operator_at_any_moment() {
    let listens = Duration::from_millis(100);
    let mut states = Vec::new();
    for ms in [0, 50, 99, 101, 120, 150, 200, 260, 400, 3000] {
        let (mut session, stage) = configured(&["insertion.depth_mm=30"]);
        session.stage.listen_first = listens;
        let mut bench = Bench::new((session, stage));
        bench.run_for(Duration::from_millis(ms));
        let last = bench.records.iter().rev().find_map(|record| match record {
            Record::Event { lane: Lane::Stage, text, .. } => Some(text.clone()),
            _ => None,
        });
        states.push(last.unwrap_or_default());
        let stop = Stop::of(bench, |bench| {
            bench.hand(Input::Stop("operator: interrupted".to_owned()));
        });
        assert_eq!(stop.bench.reason(), "operator: interrupted", "after {ms} ms");
        assert_eq!(stop.detected_after(), Duration::ZERO, "after {ms} ms");
        if ms < 150 {
            assert_eq!(stop.travel(), [(0.0, 0.0); 2], "after {ms} ms");
        }
    }
    let listening = "listening for another master";
    let configured = "both drives are configured, without power";
    assert_eq!(states[..4], ["", listening, listening, configured]);
    assert_eq!(states[4..], ["enabling both axes"; 6]);
}

#[test]
fn a_bench_that_dies() {
    let mut bench = Bench::new(configured(&["insertion.depth_mm=30"]));
    bench.run_to_mm(10.0);
    let (died, died_at) = (bench.now, bench.stage.position_true(bench.now));
    let enabled = |bench: &Bench| {
        bench.stage.drives().iter().any(|drive| drive.state() == DriveState::OperationEnabled)
    };
    while enabled(&bench) {
        bench.hold_up_for(Duration::from_millis(1));
    }
    let (detected_ms, at) =
        (bench.now.seconds_after(died) * 1e3, bench.stage.position_true(bench.now));
    bench.hold_up_for(Duration::from_secs(2));
    let end = bench.stage.position_true(bench.now);
    let measured = Measured {
        detected_ms,
        before: ((at.0 - died_at.0).abs(), (at.1 - died_at.1).abs()),
        after: ((end.0 - at.0).abs(), (end.1 - at.1).abs()),
    };
    measured.is_documented("a_bench_that_dies", 100.0, "none: the drives stop by themselves");

    // If the bench continues after that, it moves nothing.
    let stop = Stop::of(bench, |_| ());
    assert_eq!(stop.travel(), [(0.0, 0.0); 2]);
}

/// Whether the drives still answer or not.
#[test]
fn a_bench_that_stalls_in_its_stop_reports_what_it_does_not_know() {
    for drives_answer in [true, false] {
        let mut bench = Bench::new(configured(&["insertion.depth_mm=30"]));
        bench.run_to_mm(10.0);
        bench.hand(Input::Stop("a test".to_owned()));
        if !drives_answer {
            bench.lose(|input| matches!(input, Input::Frame(_)));
            bench.deafen_drives();
        }
        bench.hold_up_for(Duration::from_secs(7));
        bench.run_to_end();
        let unknown = bench.session.stage_at_end().unknown.expect("an unknown state");
        let is_reported = bench.events().any(|text| text == unknown);
        assert!(is_reported, "drives answer: {drives_answer}; not reported: {unknown}");
    }
}

/// However long the drives' heartbeat timeout is, after 500 ms the last tip is too old.
#[test]
fn the_longest_stall_is_the_shorter_of_heartbeat_and_tip_timeout() {
    for (timeout_ms, max_ms) in [(100, 100), (3000, 500)] {
        let timeout = format!("can.heartbeat_timeout_ms={timeout_ms}");
        let mut bench = Bench::new(configured(&["insertion.depth_mm=30", &timeout]));
        bench.run_to_mm(10.0);
        assert_eq!(bench.session.stall_max(), Some(Duration::from_millis(max_ms)));
    }
}

#[test]
fn a_stall_shorter_than_the_heartbeat_timeout_is_tolerated() {
    let mut bench = Bench::new(configured(&["insertion.depth_mm=30"]));
    bench.run_to_mm(10.0);
    bench.hold_up_for(Duration::from_millis(60));
    bench.run_to_end();
    assert!(bench.completed(), "{}", bench.reason());
    assert!(
        bench.events().any(|text| text.starts_with("the bench was late; SYNC periods skipped: "))
    );
}
