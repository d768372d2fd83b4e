//! Measures of a fault of the tracker's stream: when it is noticed, when the insertion is held, and how much is
//! inserted blind. The second table of `docs/hazards.md`.

use crate::support::bench::{Bench, configured};
use crate::support::stop::{Stop, is_row};
use needle_bench::session::{Lane, Machine as _, Record, State};
use needle_bench::units::Time;

/// Runs to 10 mm of 30 with `sets`, applies `strike`, and runs to the end, which must be that of a completed
/// insertion. Gives the run and the time of the fault.
pub(crate) fn tolerated(sets: &[&str], strike: impl Fn(&mut Bench)) -> (Bench, Time) {
    let mut bench = Bench::new(configured(&[sets, &["insertion.depth_mm=30"]].concat()));
    bench.run_to_mm(10.0);
    let struck = bench.now;
    strike(&mut bench);
    bench.run_to_end();
    assert!(bench.completed(), "{}", bench.reason());
    (bench, struck)
}

/// Asserts that the runs were held and stopped for `reason`, within `within_ms` and before 1 mm
/// was inserted blind, and that the row of `docs/hazards.md` which names `test` says the same.
pub(crate) fn held(stops: &[Stop], test: &str, within_ms: f64, reason: &str) {
    let blind_mm = stops.iter().map(|stop| blind_mm(&stop.bench, Time::NEVER)).fold(0.0, f64::max);
    assert!(blind_mm <= 1.0, "{test}: {blind_mm} mm inserted blind");
    held_late(stops, test, within_ms, reason, blind_mm);
}

/// As [`held`], for wrong positions that were accepted for a while, in which `blind_mm` was inserted.
pub(crate) fn held_late(stops: &[Stop], test: &str, within_ms: f64, reason: &str, blind_mm: f64) {
    assert!(reason.chars().count() <= 200, "{reason}");
    for stop in stops {
        assert_eq!(stop.bench.reason(), reason);
    }
    let most = |of: &dyn Fn(&Stop) -> f64| stops.iter().map(of).fold(0.0, f64::max);
    let noticed_ms = most(&|stop| noticed_ms(&stop.bench, stop.struck));
    let held_ms = most(&|stop| stop.detected_after().as_secs_f64() * 1e3);
    assert!(held_ms <= within_ms, "{test}: held after {held_ms} ms");
    let row = format!(
        "{noticed_ms:.0} | {within_ms:.0} | {held_ms:.0} | {blind_mm:.2} | {reason} | `{test}` |"
    );
    is_row(test, &row);
}

/// As [`held`], for a run that completed.
pub(crate) fn went_on((bench, struck): &(Bench, Time), test: &str, blind_mm_max: f64) {
    let (noticed_ms, blind_mm) = (noticed_ms(bench, *struck), blind_mm(bench, Time::NEVER));
    assert!(blind_mm <= blind_mm_max, "{test}: {blind_mm} mm inserted blind");
    let counts = bench.session.gate_counts();
    is_row(test, &format!("{noticed_ms:.0} | - | - | {blind_mm:.2} | {counts} | `{test}` |"));
}

/// From the fault to the first sample refused, or the first state that is not tracking.
fn noticed_ms(bench: &Bench, struck: Time) -> f64 {
    let times = bench.records.iter().filter_map(|record| match record {
        Record::Sample(sample) if sample.refused.is_some() => Some(sample.received.receive_time),
        Record::State { time, state }
            if state.lane() == Lane::Tracker && *state != State::Tracking =>
        {
            Some(*time)
        }
        _ => None,
    });
    let first = times.filter(|time| *time >= struck).min().expect("a sign of the fault");
    first.seconds_after(struck) * 1e3
}

/// The most that was inserted, by the stage's measured depth, beyond the newest accepted position that was acquired
/// by `good_until`.
pub(crate) fn blind_mm(bench: &Bench, good_until: Time) -> f64 {
    let stage = bench.records.iter().filter_map(|record| match record {
        Record::Stage(stage) => Some((stage.time, stage.measured.insertion_mm)),
        _ => None,
    });
    let path: Vec<(Time, f64)> = stage.collect();
    let depth_at = |time: Time| {
        let next = path.partition_point(|(at, _)| *at <= time);
        let Some(last) = next.checked_sub(1) else { return 0.0 };
        let (from, to) = (path[last], path.get(next).copied().unwrap_or(path[last]));
        let span_s = to.0.seconds_after(from.0).max(1e-9);
        from.1 + (to.1 - from.1) * time.seconds_after(from.0) / span_s
    };
    let (mut seen_mm, mut most_mm) = (0.0, 0.0_f64);
    for record in &bench.records {
        match record {
            Record::Stage(stage) => most_mm = most_mm.max(stage.measured.insertion_mm - seen_mm),
            Record::Sample(sample) => {
                let acquired = sample.acquisition_time.filter(|time| *time <= good_until);
                seen_mm = acquired.map_or(seen_mm, depth_at);
            }
            _ => {}
        }
    }
    most_mm
}

/// The states of `lane` that the operator saw, in order.
pub(crate) fn states(bench: &Bench, of: Lane) -> Vec<&str> {
    let states = bench.records.iter().filter_map(|record| match record {
        Record::State { state, .. } if state.lane() == of => Some(state.as_str()),
        _ => None,
    });
    states.collect()
}
