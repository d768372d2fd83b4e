//! Faults of the tracker and its link that end a run: the insertion is held, then the run is stopped.

use super::stream::{blind_mm, held, held_late, states};
use crate::support::bench::{Bench, Fate, configured, is_frame, is_tracker};
use crate::support::stop::{Stop, documented, enables, stopped};
use nalgebra::{UnitQuaternion, Vector3};
use needle_bench::session::{Input, Lane, Record};
use needle_bench::tracker::openigtlink::Status;
use needle_bench::tracker::{AcquisitionClock, Event, Sample, StampPolicy, Validity};
use needle_bench::units::Time;
use std::time::Duration;

/// Why samples were refused, by the record.
pub(crate) fn refusals(bench: &Bench) -> Vec<String> {
    let refusals = bench.records.iter().filter_map(|record| match record {
        Record::Sample(sample) => sample.refused.as_ref().map(ToString::to_string),
        _ => None,
    });
    refusals.collect()
}

/// Two runs with `sets` in which every sample is changed from 10 mm on.
fn changed(sets: &[&str], change: impl Fn(&mut Sample) + Clone + 'static) -> [Stop; 2] {
    stopped(sets, |bench| bench.change_samples(change.clone()))
}

#[test]
fn a_silent_tracker() {
    let stops = stopped(&[], |bench| bench.lose(is_tracker));
    for stop in &stops {
        let seen = states(&stop.bench, Lane::Tracker);
        assert_eq!(seen[..3], ["waiting", "tracking", "coasting"]);
        let run = states(&stop.bench, Lane::Session);
        assert_eq!(run, ["preparing", "inserting", "holding", "stopping", "stopped"]);
    }
    held(
        &stops,
        "a_silent_tracker",
        510.0,
        "tracker: last tip 0.47 s old (limit 0.50), 0.93 mm blind + 0.09 to brake \
         (limit 1.00); held and stopped; the link is up: the tool is out of view, or the source has stopped \
         sending",
    );
}

#[test]
fn messages_that_cannot_be_read() {
    let stops = stopped(&[], |bench| {
        bench.spoil(|input| match is_tracker(&input) {
            true => {
                let error = "ndjson: line 7: x is not a number".to_owned();
                Fate::Arrives(Input::Tracker(Event::Malformed(error)))
            }
            false => Fate::Arrives(input),
        });
    });
    let reason = stops[0].bench.reason();
    held(&stops, "messages_that_cannot_be_read", 510.0, &reason);
    let why = "; the tracker's messages cannot be read: ndjson: line 7: x is not a number";
    assert!(reason.ends_with(why), "{reason}");
}

/// PLUS sends STATUS OK while its tracker gives no frames. Other servers may also send it for a tool out of view.
#[test]
fn a_server_that_is_alive_and_sends_no_position() {
    let stops = stopped(&[], |bench| {
        bench.lose(is_tracker);
        let status =
            Status { code: 1, subcode: 0, error_name: "OK".to_owned(), message: String::new() };
        bench.run_for(Duration::from_millis(100));
        bench.hand(Input::Tracker(Event::Status { device: "PLUS".to_owned(), status }));
    });
    held(
        &stops,
        "a_server_that_is_alive_and_sends_no_position",
        510.0,
        "tracker: last tip 0.47 s old (limit 0.50), 0.93 mm blind + 0.09 to brake \
         (limit 1.00); held and stopped; STATUS OK but no position: PLUS's tracker off, or tool out of view",
    );
}

#[test]
fn a_fast_needle_is_held_by_its_blind_depth() {
    let stops = stopped(&["insertion.speed_mm_per_s=6"], |bench| bench.lose(is_tracker));
    for stop in &stops {
        let reason = stop.bench.reason();
        assert!(reason.contains("to brake (limit 1.00)"), "{reason}");
        assert!(stop.detected_after() < Duration::from_millis(80));
        assert!(blind_mm(&stop.bench, Time::NEVER) < 1.0);
    }
}

#[test]
fn a_tracker_that_hangs_up() {
    let stops = stopped(&[], |bench| {
        let reason = "tracker: 127.0.0.1:18944 closed the connection".to_owned();
        bench.lose(is_tracker);
        bench.hand(Input::Tracker(Event::Disconnected { reason }));
    });
    held(
        &stops,
        "a_tracker_that_hangs_up",
        510.0,
        "tracker: last tip 0.47 s old (limit 0.50), 0.93 mm blind + 0.09 to brake \
         (limit 1.00); held and stopped; tracker: 127.0.0.1:18944 closed the connection",
    );
}

#[test]
fn positions_that_are_not_numbers() {
    let stops = changed(&[], |sample| sample.position_mm.x = f64::NAN);
    for stop in &stops {
        let (refused, first) = (refusals(&stop.bench).len(), stop.struck);
        assert!(refused >= 18, "{refused}");
        let later = stop.bench.steps().filter(|step| step.time > first);
        assert!(later.into_iter().all(|step| step.tip_meas_mm.is_none()), "a step took a NaN");
    }
    let reason = stops[0].bench.reason();
    held(&stops, "positions_that_are_not_numbers", 510.0, &reason);
    assert!(reason.contains("; finite: position (NaN, "), "{reason}");
}

#[test]
fn identity_poses() {
    let stops = changed(&[], |sample| {
        sample.position_mm = Vector3::zeros();
        sample.orientation = Some(UnitQuaternion::identity());
    });
    let reason = stops[0].bench.reason();
    held(&stops, "identity_poses", 510.0, &reason);
    assert!(states(&stops[0].bench, Lane::Tracker).contains(&"lost"));
}

#[test]
fn a_tool_that_the_tracker_calls_out_of_view() {
    let stops = changed(&[], |sample| sample.validity = Validity::OutOfView);
    let reason = stops[0].bench.reason();
    held(&stops, "a_tool_that_the_tracker_calls_out_of_view", 510.0, &reason);
    assert!(reason.ends_with("; status: tool out of view"), "{reason}");
}

#[test]
fn a_sender_whose_clock_is_set_back() {
    let stops = changed(&["tracker.stamp=\"source\""], |sample| {
        sample.source_unix_ns = sample.source_unix_ns.map(|ns| ns - 10_000_000_000);
    });
    let reason = stops[0].bench.reason();
    assert!(reason.contains("; stamp: went back by"), "{reason}");
    assert!(reason.ends_with("was the sender's clock set?"), "{reason}");
    held(&stops, "a_sender_whose_clock_is_set_back", 510.0, &reason);
}

#[test]
fn positions_that_come_too_late() {
    let stops = stopped(&["tracker.stamp=\"source\""], |bench| {
        bench.spoil(|input| match is_tracker(&input) {
            true => Fate::Late(Duration::from_millis(600), input),
            false => Fate::Arrives(input),
        });
    });
    let reason = stops[0].bench.reason();
    held(&stops, "positions_that_come_too_late", 510.0, &reason);
}

/// The gate compares the values, whatever the stamps are.
#[test]
fn a_frozen_position_stamped_as_fresh() {
    for stamp in ["source", "receive"] {
        let set = format!("tracker.stamp=\"{stamp}\"");
        let stops = stopped(&[&set], |bench| {
            let mut first = None;
            bench.change_samples(move |sample| {
                sample.position_mm = *first.get_or_insert(sample.position_mm);
            });
        });
        let reason = stops[0].bench.reason();
        assert!(reason.contains("; repeat: the same position to the bit, "), "{reason}");
        assert!(states(&stops[0].bench, Lane::Tracker).contains(&"lost"));
        if stamp == "receive" {
            held(&stops, "a_frozen_position_stamped_as_fresh", 510.0, &reason);
        }
    }
}

#[test]
fn a_jump_that_persists() {
    let stops = changed(&[], |sample| sample.position_mm.x += 12.0);
    let reason = stops[0].bench.reason();
    assert!(reason.contains("; innovation: 1"), "{reason}");
    held(&stops, "a_jump_that_persists", 510.0, &reason);
    for stop in &stops {
        let seen = states(&stop.bench, Lane::Tracker);
        assert!(seen.contains(&"lost"), "{seen:?}");
        let later = stop.bench.steps().filter(|step| step.time > stop.struck);
        assert!(later.into_iter().all(|step| step.tip_meas_mm.is_none()), "a step took the jump");
    }
}

/// By 8 mm/s to the side: each position is near the one before, but the sum disagrees with the model.
#[test]
fn a_position_that_drifts() {
    let stops = stopped(&[], |bench| {
        let mut drifted_mm = 0.0;
        bench.change_samples(move |sample| {
            drifted_mm += 0.2;
            sample.position_mm.x += drifted_mm;
        });
    });
    let reason = stops[0].bench.reason();
    assert!(reason.contains("; innovation: "), "{reason}");
    let blind_mm = |stop: &Stop| blind_mm(&stop.bench, stop.struck);
    let blind_mm = stops.iter().map(blind_mm).fold(0.0, f64::max);
    held_late(&stops, "a_position_that_drifts", 1500.0, &reason, blind_mm);
}

#[test]
fn a_stream_of_another_tool() {
    let mut bench = Bench::new(configured(&[]));
    bench.change_samples(|sample| sample.tool = "StylusToTracker".to_owned());
    let stop = Stop::of(bench, |_| ());
    assert_eq!(stop.travel(), [(0.0, 0.0); 2]);
    stop.never_had_power();
    documented(
        &[stop],
        "a_stream_of_another_tool",
        5000.0,
        "tracker: no tip within 5.0 s; tracker: 127.0.0.1:18944 sent 200 messages, none of \
         \"NeedleToTracker\"; saw \"StylusToTracker\"; set tracker.tool",
    );
}

#[test]
fn another_tool_in_place_of_the_needle_is_reported_as_out_of_view() {
    let stops = changed(&[], |sample| sample.tool = "StylusToTracker".to_owned());
    let end = "; the link is up: the tool is out of view, or the source has stopped sending";
    assert!(stops.iter().all(|stop| stop.bench.reason().ends_with(end)));
}

/// A source whose stamps are in another unit, or stand still.
#[test]
fn stamps_that_hardly_advance_are_named() {
    const START_NS: i64 = 1_700_000_000_000_000_000;
    let mut bench = Bench::new(configured(&["tracker.stamp=\"source\""]));
    bench.change_samples(|sample| {
        sample.source_unix_ns = Some(START_NS + sample.receive_time.as_nanos() / 1000);
    });
    bench.run_to_end();
    let reason = bench.reason();
    let end = "s late by its stamp: a slow link, or its clock (tracker.stamp)";
    assert!(reason.contains("the newest came 0.5") && reason.ends_with(end), "{reason}");
    let (depth_mm, _) = bench.stage.position_true(bench.now);
    assert!(depth_mm < 1.5, "{depth_mm} mm");
}

#[test]
fn one_tip_and_then_silence_while_the_drives_are_slow() {
    let mut bench = Bench::new(configured(&[]));
    let mut tips = 0;
    bench.spoil(move |input| match &input {
        Input::Frame(_) if is_frame(&input, &[0x581, 0x582]) => {
            Fate::Late(Duration::from_millis(140), input)
        }
        Input::Tracker(Event::Sample(_)) => {
            tips += 1;
            if tips > 1 { Fate::Lost } else { Fate::Arrives(input) }
        }
        _ => Fate::Arrives(input),
    });
    let stop = Stop::of(bench, |_| ());
    assert_eq!(stop.travel(), [(0.0, 0.0); 2]);
    stop.never_had_power();
    documented(
        &[stop],
        "one_tip_and_then_silence_while_the_drives_are_slow",
        5000.0,
        "tracker: no tip within 5.0 s; the last was 5.00 s old (limit 0.50); the link is up: the tool is out of view, or the \
         source has stopped sending",
    );
}

/// The tip is first seen 3 s after the drives are ready.
#[test]
fn power_comes_on_with_the_first_tip() {
    let mut bench = Bench::new(configured(&["insertion.depth_mm=2"]));
    let hidden = Time::from_secs_f64(3.0);
    bench.spoil(move |input| match &input {
        Input::Tracker(Event::Sample(sample)) if sample.receive_time < hidden => Fate::Lost,
        _ => Fate::Arrives(input),
    });
    bench.run_for(Duration::from_secs(3));
    assert!(bench.sent.iter().all(|frame| !enables(frame)));
    assert_eq!(bench.events().last(), Some("both drives are configured, without power"));
    bench.run_to_end();
    assert!(bench.completed(), "{}", bench.reason());
    assert!(bench.sent.iter().any(enables));
}

/// The tip is lost before the drives are ready.
#[test]
fn a_tip_lost_before_power_is_waited_for() {
    let mut bench = Bench::new(configured(&["insertion.depth_mm=2"]));
    let (seen, hidden) = (Time::from_secs_f64(0.08), Time::from_secs_f64(4.0));
    bench.spoil(move |input| match &input {
        Input::Frame(_) if is_frame(&input, &[0x581, 0x582]) => {
            Fate::Late(Duration::from_millis(30), input)
        }
        Input::Tracker(Event::Sample(sample)) if (seen..hidden).contains(&sample.receive_time) => {
            Fate::Lost
        }
        _ => Fate::Arrives(input),
    });
    bench.run_for(Duration::from_millis(3900));
    assert!(bench.sent.iter().all(|frame| !enables(frame)));
    bench.run_to_end();
    assert!(bench.completed(), "{}", bench.reason());
}

/// The insertion is held long before the control law would end the run.
#[test]
fn a_needle_nothing_like_its_model() {
    let stop = Stop::of(Bench::new(configured(&["emulator.radius_mm=10"])), |_| ());
    let reason = stop.bench.reason();
    assert!(reason.ends_with("a jump, or needle.radius_mm?"), "{reason}");
    let depth_mm = stop.bench.stage.position_true(stop.bench.now).0;
    assert!(depth_mm < 16.0, "{depth_mm}");
}

/// Without positions that agree with one another there is no tip, and so no power.
#[test]
fn positions_that_never_agree() {
    let stop = Stop::of(Bench::new(configured(&["emulator.noise={uniform_mm=100.0}"])), |_| ());
    assert_eq!(stop.travel(), [(0.0, 0.0); 2]);
    stop.never_had_power();
    let reason = stop.bench.reason();
    assert!(reason.contains("; step: ") && reason.contains("no tip within"), "{reason}");
}

/// Even the first position is too old.
#[test]
fn positions_that_are_always_too_old() {
    let (mut session, stage) = configured(&[]);
    session.tracker.clock = AcquisitionClock::new(StampPolicy::Receive, Duration::from_millis(600));
    let mut bench = Bench::new((session, stage));
    bench.run_to_end();
    let reason = bench.reason();
    assert!(reason.starts_with("tracker: no tip within 5.0 s; the last was 0.6"), "{reason}");
    assert!(bench.now.as_secs_f64() < 8.0);
}
