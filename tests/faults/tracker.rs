//! Faults of the tracker and its link.

use crate::bench::{Bench, Fate, configured, is_frame, is_tracker};
use crate::stop::{Stop, documented, stopped};
use needle_bench::session::{Input, Record, StepRecord};
use needle_bench::tracker::{AcquisitionClock, Event, StampPolicy};
use std::time::Duration;

/// Refusals of samples in the record.
fn refusals(bench: &Bench) -> Vec<&str> {
    let refusals = bench.records.iter().filter_map(|record| match record {
        Record::Sample(sample) => sample.refused.as_deref(),
        _ => None,
    });
    refusals.collect()
}

#[test]
fn a_silent_tracker() {
    let stops = stopped(&[], |bench| bench.lose(is_tracker));
    documented(
        &stops,
        "a_silent_tracker",
        510.0,
        "tracker: last tip 0.51 s old (limit 0.50), 1.01 mm inserted blind (limit 1.50); the link \
         is up: the tool is out of view, or the source has stopped sending",
    );
}

#[test]
fn a_fast_needle_is_stopped_by_its_blind_depth() {
    let sets = ["insertion.speed_mm_per_s=8", "stage.rotation.speed_max_deg_per_s=360"];
    let stops = stopped(&sets, |bench| bench.lose(is_tracker));
    for stop in &stops {
        let reason = stop.bench.reason();
        assert!(reason.contains("mm inserted blind (limit 1.50)"), "{reason}");
        assert!(stop.detected_after() < Duration::from_millis(210));
        assert!(stop.travel()[0].0 < 1.7 && stop.travel()[1].0 < 1.6, "{:?}", stop.travel());
    }
}

#[test]
fn a_tracker_that_hangs_up() {
    let stops = stopped(&[], |bench| {
        let reason = "tracker: 127.0.0.1:18944 closed the connection".to_owned();
        bench.lose(is_tracker);
        bench.hand(Input::Tracker(Event::Disconnected { reason }));
    });
    documented(
        &stops,
        "a_tracker_that_hangs_up",
        510.0,
        "tracker: last tip 0.51 s old (limit 0.50), 1.01 mm inserted blind (limit 1.50); tracker: \
         127.0.0.1:18944 closed the connection",
    );
}

#[test]
fn positions_that_are_no_numbers() {
    let stops = stopped(&[], |bench| {
        bench.change_samples(|sample| sample.position_mm.x = f64::NAN);
    });
    for stop in &stops {
        let (refused, first) = (refusals(&stop.bench).len(), stop.struck);
        assert!(refused >= 19, "{refused}");
        let later = stop.bench.steps().filter(|step| step.time > first);
        assert!(later.into_iter().all(|step| step.tip_meas_mm.is_none()), "no NaN is a tip");
    }
    let counted = stops[0].bench.reason();
    documented(&stops, "positions_that_are_no_numbers", 510.0, &counted);
    assert!(counted.contains("not finite; the last: tracker: position (NaN, "), "{counted}");
}

#[test]
fn every_other_position_infinite_costs_nothing_but_those() {
    let mut bench = Bench::new(configured(&["insertion.depth_mm=30"]));
    let mut n = 0;
    bench.change_samples(move |sample| {
        n += 1;
        if n % 2 == 0 {
            sample.position_mm.z = f64::NEG_INFINITY;
        }
    });
    bench.run_to_end();
    assert!(bench.completed(), "{}", bench.reason());
    let refused = refusals(&bench);
    assert_eq!(refused.len(), bench.received.1 / 2);
    assert!(refused.iter().all(|reason| reason.ends_with("-inf) mm is not finite")));
    let finite = |step: &StepRecord| {
        step.estimate.is_none_or(|estimate| estimate.x_pb.is_finite())
            && step.tip_meas_mm.is_none_or(|tip| tip.iter().all(|x| x.is_finite()))
    };
    assert!(bench.steps().all(finite));
}

#[test]
fn another_tool() {
    let mut bench = Bench::new(configured(&[]));
    bench.change_samples(|sample| sample.tool = "StylusToTracker".to_owned());
    let stop = Stop::of(bench, |_| ());
    assert_eq!(stop.travel(), [(0.0, 0.0); 2]);
    documented(
        &[stop],
        "another_tool",
        5000.0,
        "tracker: no tip within 5.0 s; tracker: connected to 127.0.0.1:18944, 200 messages, none \
         named \"NeedleToTracker\"; saw \"StylusToTracker\". Set tracker.tool.",
    );
}

#[test]
fn a_needle_out_of_view_is_told_from_another_tool_in_view() {
    let stops = stopped(&[], |bench| {
        bench.change_samples(|sample| sample.tool = "StylusToTracker".to_owned());
    });
    let end = "; the link is up: the tool is out of view, or the source has stopped sending";
    assert!(stops.iter().all(|stop| stop.bench.reason().ends_with(end)));
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
    documented(
        &[stop],
        "one_tip_and_then_silence_while_the_drives_are_slow",
        5000.0,
        "tracker: no tip within 5.0 s; the last was 5.00 s old (limit 0.50); the link is up: the tool is out of view, or the \
         source has stopped sending",
    );
}

#[test]
fn a_sender_whose_clock_is_set_back() {
    let stops = stopped(&["tracker.stamp=\"source\""], |bench| {
        bench.change_samples(|sample| {
            sample.source_unix_ns = sample.source_unix_ns.map(|ns| ns - 10_000_000_000);
        });
    });
    let reason = stops[0].bench.reason();
    assert!(reason.contains("stamped backwards; the last: tracker: stamp went back by"));
    assert!(reason.ends_with("was the sender's clock set?"), "{reason}");
    documented(&stops, "a_sender_whose_clock_is_set_back", 510.0, &reason);
}

#[test]
fn positions_that_come_too_late() {
    let stops = stopped(&["tracker.stamp=\"source\""], |bench| {
        bench.spoil(|input| match is_tracker(&input) {
            true => Fate::Late(Duration::from_millis(600), input),
            false => Fate::Arrives(input),
        });
    });
    documented(
        &stops,
        "positions_that_come_too_late",
        510.0,
        "tracker: last tip 0.51 s old (limit 0.50), 1.01 mm inserted blind (limit 1.50); the link \
         is up: the tool is out of view, or the source has stopped sending",
    );
}

#[test]
fn stamps_that_lead_and_stamps_that_are_not_looked_at_do_no_harm() {
    for (stamp, shift_ns) in [("source", 10_000_000_000), ("receive", -10_000_000_000_i64)] {
        let set = format!("tracker.stamp=\"{stamp}\"");
        let mut bench = Bench::new(configured(&[&set, "insertion.depth_mm=30"]));
        bench.run_to_mm(10.0);
        bench.change_samples(move |sample| {
            sample.source_unix_ns = sample.source_unix_ns.map(|ns| ns + shift_ns);
        });
        bench.run_to_end();
        assert!(bench.completed(), "{stamp}: {}", bench.reason());
        let aged = bench.steps().filter_map(|step| step.tip_meas_age_s);
        assert!(aged.into_iter().all(|age_s| (0.0..0.05).contains(&age_s)));
    }
}

#[test]
fn a_tracker_that_repeats_itself() {
    let stops = stopped(&[], |bench| {
        let mut first = None;
        bench.change_samples(move |sample| {
            sample.position_mm = *first.get_or_insert(sample.position_mm);
        });
    });
    documented(
        &stops,
        "a_tracker_that_repeats_itself",
        800.0,
        "tracker: last tip 0.01 s old (limit 0.50), 1.52 mm inserted blind (limit 1.50); the last \
         position came 30 times again, the same to the bit: is the tool still in view?",
    );
}

/// Positions that are always too old to begin with: the wait for a fresh one ends all the same.
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
