//! Faults of the tracker's stream that cost only the samples, and holds that may end by themselves.

use super::stream::{blind_mm, states, tolerated, went_on};
use super::tracker::refusals;
use crate::support::bench::{Bench, Fate, configured, is_tracker};
use crate::support::stop::Stop;
use needle_bench::canopen::Frame;
use needle_bench::session::{Input, Lane, Machine as _, Record, StepRecord};
use needle_bench::tracker::{Event, GateCounts, GateName};
use needle_bench::units::Time;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use std::time::Duration;

const SEEDS: u64 = 3;

/// Loses everything from the tracker for `duration`.
fn silent_for(bench: &mut Bench, duration: Duration) {
    bench.lose(is_tracker);
    bench.run_for(duration);
    bench.spoil(Fate::Arrives);
}

/// The number of samples that `gate` refused.
fn refused_by(counts: &GateCounts, gate: GateName) -> u64 {
    counts.by_gate().find(|(by, _)| *by == gate).map_or(0, |(_, count)| count)
}

/// The largest innovation at the steps from 5 mm on.
fn largest_innovation_mm(bench: &Bench) -> f64 {
    let innovations = bench.steps().skip(5).filter_map(|step| step.innovation_mm);
    innovations.map(|innovation| innovation.norm()).fold(0.0, f64::max)
}

#[test]
fn spikes_of_one_and_of_two_samples() {
    for (test, length, by_mm) in
        [("a_spike_of_one_sample", 1, 12.0), ("a_spike_of_two_samples", 2, 18.0)]
    {
        let run = tolerated(&[], |bench| {
            let mut n = 0;
            bench.change_samples(move |sample| {
                n += 1;
                if n <= length {
                    sample.position_mm.x += by_mm;
                }
            });
        });
        assert_eq!(refused_by(&run.0.session.gate_counts(), GateName::Step), length);
        went_on(&run, test, 0.25);
    }
}

/// Noise that changes slowly looks like travel. Once it is configured, the travel check allows for it.
#[test]
fn noise_that_is_configured_as_slow_stops_no_run() {
    for seed in 11..15 {
        let mut bench = Bench::new(configured(&[
            "insertion={depth_mm=60.0, speed_mm_per_s=2.0, plane_out_of_reach=\"insert\"}",
            &format!("emulator.seed={seed}"),
            "emulator.noise={sd_mm=0.4, correlated_sd_mm=0.5, correlation_time_s=1.0}",
            "tracker.noise={white_sd_mm=0.4, correlated_sd_mm=0.5, correlation_time_s=1.0}",
            "tracker.gates.noise_sd_mm=0.64",
            "observer.invariant.position_sd_mm=0.64",
        ]));
        bench.run_to_end();
        assert!(bench.completed(), "seed {seed}: {}", bench.reason());
    }
}

#[test]
fn every_other_position_infinite_costs_only_those_samples() {
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
    assert!(refused.iter().all(|reason| reason.starts_with("finite: ")));
    let finite = |step: &StepRecord| {
        step.decision.estimate.is_none_or(|estimate| estimate.x_pb.is_finite())
            && step.tip_meas_mm.is_none_or(|tip| tip.iter().all(|x| x.is_finite()))
    };
    assert!(bench.steps().all(finite));
}

/// Four frames of five repeat the one before.
#[test]
fn frames_that_are_sent_five_times() {
    let run = tolerated(&["tracker.kind=\"imaging\""], |bench| {
        let mut n = 0;
        let mut frame = None;
        bench.change_samples(move |sample| {
            if n % 5 == 0 {
                frame = Some(sample.position_mm);
            }
            n += 1;
            sample.position_mm = frame.unwrap_or(sample.position_mm);
        });
    });
    let counts = run.0.session.gate_counts();
    let (repeats, states) = (refused_by(&counts, GateName::Repeat), states(&run.0, Lane::Tracker));
    assert_eq!(repeats, counts.refused());
    assert!(repeats > 300 && !states.contains(&"lost"), "{counts} {states:?}");
    // Each position was used at the depth of its first frame, not at that of a repeat.
    assert!(largest_innovation_mm(&run.0) < 3.0, "{}", largest_innovation_mm(&run.0));
    went_on(&run, "frames_that_are_sent_five_times", 0.35);
}

/// If the bench believed it, the samples after it would be 10 s old, or their stamps would go back.
#[test]
fn one_stamp_10_s_ahead() {
    let run = tolerated(&["tracker.stamp=\"source\""], |bench| {
        let mut n = 0;
        bench.change_samples(move |sample| {
            n += 1;
            if n == 1 {
                sample.source_unix_ns = sample.source_unix_ns.map(|ns| ns + 10_000_000_000);
            }
        });
    });
    let stamps = refused_by(&run.0.session.gate_counts(), GateName::Stamp);
    assert_eq!(stamps, 1 + learnt(&run.0));
    went_on(&run, "one_stamp_10_s_ahead", 0.25);
}

/// Samples refused while the sender's clock was learnt.
fn learnt(bench: &Bench) -> u64 {
    refusals(bench).iter().filter(|reason| reason.contains("still being learnt")).count() as u64
}

#[test]
fn a_sender_whose_clock_is_set_ahead() {
    let run = tolerated(&["tracker.stamp=\"source\""], |bench| {
        bench.change_samples(move |sample| {
            sample.source_unix_ns = sample.source_unix_ns.map(|ns| ns + 10_000_000_000);
        });
    });
    let aged = run.0.steps().filter_map(|step| step.tip_meas_age_s);
    assert!(aged.into_iter().all(|age_s| (0.0..0.05).contains(&age_s)));
    assert_eq!(
        states(&run.0, Lane::Tracker),
        ["waiting", "tracking", "coasting", "lost", "tracking"]
    );
    went_on(&run, "a_sender_whose_clock_is_set_ahead", 0.7);
}

#[test]
fn wrong_stamps_do_no_harm_where_stamps_are_not_used() {
    let (bench, _) = tolerated(&["tracker.stamp=\"receive\""], |bench| {
        bench.change_samples(move |sample| {
            sample.source_unix_ns = sample.source_unix_ns.map(|ns| ns - 10_000_000_000);
        });
    });
    assert_eq!(bench.session.gate_counts().refused(), 0);
}

/// After a reconnection the server first sends its last pose, which is a second old.
#[test]
fn a_stale_sample_after_a_reconnection() {
    let run = tolerated(&["tracker.stamp=\"source\""], |bench| {
        let mut first = true;
        bench.hand(Input::Tracker(Event::Disconnected { reason: "gone".to_owned() }));
        bench.hand(Input::Tracker(Event::Connected { peer: "127.0.0.1:18944".to_owned() }));
        bench.change_samples(move |sample| {
            if std::mem::take(&mut first) {
                sample.source_unix_ns = sample.source_unix_ns.map(|ns| ns - 1_000_000_000);
                sample.position_mm.z -= 2.0;
            }
        });
    });
    let aged = run.0.steps().filter_map(|step| step.tip_meas_age_s);
    assert!(aged.into_iter().all(|age_s| (0.0..0.05).contains(&age_s)));
    assert!(learnt(&run.0) > learnt_at_the_start());
    went_on(&run, "a_stale_sample_after_a_reconnection", 0.7);
}

fn learnt_at_the_start() -> u64 {
    learnt(&tolerated(&["tracker.stamp=\"source\""], |_| ()).0)
}

/// The track is found again, by the model, before the insertion is held.
#[test]
fn a_track_lost_for_a_moment() {
    let run = tolerated(&[], |bench| {
        let mut n = 0;
        bench.change_samples(move |sample| {
            n += 1;
            if n <= 8 {
                sample.position_mm.y -= 18.0;
            }
        });
    });
    assert_eq!(
        states(&run.0, Lane::Tracker),
        ["waiting", "tracking", "coasting", "lost", "tracking"]
    );
    let events: Vec<&str> =
        run.0.events().filter(|text| text.contains("lost") || text.contains("found")).collect();
    assert!(events[0].starts_with("lost, 5 refused in a row; the last: step: "), "{events:?}");
    assert_eq!(events[1..], ["found again: it agrees with the model"]);
    went_on(&run, "a_track_lost_for_a_moment", 0.7);
}

#[test]
fn automatic_resume_ends_a_hold_when_the_tip_is_seen_again() {
    let run = tolerated(&["tracker.resume=\"automatic\""], |bench| {
        silent_for(bench, Duration::from_secs(2));
    });
    let bench = &run.0;
    assert_eq!(
        states(bench, Lane::Session),
        ["preparing", "inserting", "holding", "inserting", "stopping", "completed"]
    );
    let events: Vec<&str> = bench.events().filter(|text| text.contains("; insertion ")).collect();
    assert!(events[0].contains("; insertion held; the link is up"), "{events:?}");
    let resumed = "the tip is seen again; insertion goes on, held for 1.";
    assert!(events[1].starts_with(resumed), "{events:?}");
    assert!(bench.steps().enumerate().all(|(n, step)| step.step as usize == n));
    went_on(&run, "automatic_resume_ends_a_hold_when_the_tip_is_seen_again", 1.0);
}

#[test]
fn automatic_resume_stops_the_run_after_the_hold_timeout() {
    let sets =
        ["tracker.resume=\"automatic\"", "tracker.hold_timeout_s=2", "insertion.depth_mm=30"];
    let mut bench = Bench::new(configured(&sets));
    bench.run_to_mm(10.0);
    let stop = Stop::of(bench, |bench| {
        bench.change_samples(|sample| sample.position_mm.x += 12.0);
    });
    let reason = stop.bench.reason();
    assert!(reason.contains("; held for 2.0 s and stopped; "), "{reason}");
    assert!(blind_mm(&stop.bench, Time::NEVER) < 1.0);
}

/// Not a silence that is over.
#[test]
fn the_stop_reason_is_the_last_cause_of_the_hold() {
    let sets =
        ["tracker.resume=\"automatic\"", "tracker.hold_timeout_s=4", "insertion.depth_mm=30"];
    let mut bench = Bench::new(configured(&sets));
    bench.run_to_mm(10.0);
    silent_for(&mut bench, Duration::from_secs(1));
    bench.change_samples(|sample| sample.position_mm.x += 12.0);
    bench.run_to_end();
    assert!(bench.events().any(|text| text.contains("; insertion held; the link is up")));
    let reason = bench.reason();
    let ends = "; held for 4.0 s and stopped; ";
    assert!(reason.contains(ends) && !reason.contains("the link is up"), "{reason}");
}

/// The silences last 2 s, with 0.2 s of the stream between them. Holds that are far from one another have a timeout
/// each.
#[test]
fn holds_in_a_row_share_one_timeout() {
    let sets = |depth| ["tracker.resume=\"automatic\"", "tracker.hold_timeout_s=4", depth];
    let mut bench = Bench::new(configured(&sets("insertion.depth_mm=30")));
    bench.run_to_mm(10.0);
    let mut silences = 0;
    while bench.reason() == "not stopped" {
        silent_for(&mut bench, Duration::from_secs(2));
        bench.run_for(Duration::from_millis(200));
        silences += 1;
    }
    bench.run_to_end();
    let reason = bench.reason();
    assert!(reason.contains("; held for 4.0 s in a row and stopped; "), "{reason}");
    assert!(silences <= 6, "{silences}");

    let mut bench = Bench::new(configured(&sets("insertion.depth_mm=30")));
    for depth_mm in [5.0, 10.0, 15.0] {
        bench.run_to_mm(depth_mm);
        silent_for(&mut bench, Duration::from_secs(2));
    }
    bench.run_to_end();
    assert!(bench.completed(), "holds far from one another: {}", bench.reason());
}

/// A needle could take this path, 0.25 mm to the side per mm inserted, so the gates do not see the drift.
#[test]
fn a_slow_drift_is_taken_for_the_needle() {
    let (bench, _) = tolerated(&[], |bench| {
        let mut drifted_mm = 0.0;
        bench.change_samples(move |sample| {
            drifted_mm += 0.0125;
            sample.position_mm.x += drifted_mm;
        });
    });
    assert!(!states(&bench, Lane::Tracker).contains(&"lost"), "{}", bench.session.gate_counts());
}

/// A random start that the observers do not know: x up to 5 mm, yaw and pitch up to 8°, roll up to 60°.
fn start(seed: u64) -> String {
    let mut rng = Pcg64::seed_from_u64(seed);
    let [x, yaw, pitch, roll] =
        [5.0, 8.0, 8.0, 60.0].map(|most| most * (2.0 * rng.random::<f64>() - 1.0));
    format!("{{x_mm={x:.3},yaw_deg={yaw:.3},pitch_deg={pitch:.3},roll_deg={roll:.3}}}")
}

/// With noise as measured of real trackers, unknown starts, and a shaft that twists. At most one good position in a
/// hundred is refused.
#[test]
fn good_streams_are_never_lost() {
    let law = "control.kind=\"feedback-linearization\"";
    let streams: [&[&str]; 8] = [
        &[],
        &["observer.coupled.gains=\"fading\""],
        &["observer.kind=\"finite-difference\"", law],
        &[
            "emulator.tracker=\"electromagnetic-near\"",
            "tracker.gates.noise_sd_mm=0.05",
            "observer.invariant.position_sd_mm=0.05",
        ],
        &[
            "emulator.tracker=\"electromagnetic-far\"",
            "tracker.gates.noise_sd_mm=0.2",
            "observer.invariant.position_sd_mm=0.2",
        ],
        &["emulator.tracker=\"stereo-camera\"", "tracker.latency_ms=33"],
        &[
            "emulator.tracker=\"ultrasound\"",
            "tracker.kind=\"imaging\"",
            "tracker.latency_ms=175",
            "tracker.gates.noise_sd_mm=0.94",
            "observer.invariant.position_sd_mm=0.94",
        ],
        &["emulator.torsion.half_width_deg=30"],
    ];
    for (stream, seed) in streams.into_iter().flat_map(|s| (0..SEEDS).map(move |seed| (s, seed))) {
        let (start, seed) = (start(seed), format!("emulator.seed={seed}"));
        let start = format!("emulator.start={start}");
        let given = [seed.as_str(), &start, "insertion.depth_mm=100"];
        let mut bench = Bench::new(configured(&[stream, &given].concat()));
        bench.run_to_end();
        let (counts, seen) = (bench.session.gate_counts(), states(&bench, Lane::Tracker));
        let what = format!("{stream:?} {given:?}: {counts}");
        println!("{what}");
        assert!(bench.completed(), "{what}: {}", bench.reason());
        assert!(!seen.contains(&"lost"), "{what}: {seen:?}");
        let doubted = [GateName::Step, GateName::Innovation]
            .map(|gate| refused_by(&counts, gate))
            .iter()
            .sum::<u64>();
        assert!(doubted * 100 <= counts.accepted, "{what}");
        assert!(blind_mm(&bench, Time::NEVER) < 1.0, "{what}");
    }
}

/// The bench learns the new offset of the clock, so each position is paired with the stage's position at its true
/// acquisition.
#[test]
fn a_sender_whose_clock_is_set_back_a_little() {
    for (test, back_ms) in [
        ("a_sender_s_clock_set_back_by_0_03_s", 30),
        ("a_sender_s_clock_set_back_by_0_05_s", 50),
        ("a_sender_s_clock_set_back_by_0_1_s", 100),
        ("a_sender_s_clock_set_back_by_0_3_s", 300),
        ("a_sender_s_clock_set_back_by_0_45_s", 450),
    ] {
        let back_ns = back_ms * 1_000_000;
        let slowly = ["tracker.stamp=\"source\"", "insertion.speed_mm_per_s=1"];
        let run = tolerated(&slowly, |bench| {
            bench.change_samples(move |sample| {
                sample.source_unix_ns = sample.source_unix_ns.map(|ns| ns - back_ns);
            });
        });
        let (bench, struck) = &run;
        let learnt = *struck + Duration::from_millis(195);
        // The errors of the acquisition times, ms. The emulated tracker stamps by the bench's clock, so the true
        // times are known.
        let error_ms = |is_of: &dyn Fn(Time) -> bool| {
            let errors = bench.records.iter().filter_map(|record| match record {
                Record::Sample(sample) => {
                    let received = sample.received.receive_time;
                    let dated = sample.acquisition_time.filter(|_| is_of(received))?;
                    let back_ns = if received > *struck { back_ns } else { 0 };
                    let measured = Time::from_nanos(sample.received.source_unix_ns? + back_ns);
                    Some(dated.seconds_after(measured) * 1e3)
                }
                _ => None,
            });
            errors.collect::<Vec<_>>()
        };
        let within = |errors: &[f64], least: f64, most: f64| {
            errors.iter().all(|error| (least - 1.0..most + 1.0).contains(error))
        };
        let before = error_ms(&|received| received <= *struck);
        let meanwhile = error_ms(&|received| received > *struck && received <= learnt);
        let after = error_ms(&|received| received > learnt);
        println!("{test}: {} samples meanwhile, {} after", meanwhile.len(), after.len());
        assert!(within(&before, 0.0, 0.0) && within(&after, 0.0, 0.0), "{before:?} {after:?}");
        // After a step of up to 40 ms the bench uses the old offset until it has learnt the new one.
        assert_eq!(meanwhile.is_empty(), back_ms > 40, "{meanwhile:?}");
        assert!(within(&meanwhile, -back_ms as f64, -back_ms as f64), "{meanwhile:?}");
        let report = format!("was set back by {:.3} s", back_ms as f64 * 1e-3);
        assert_eq!(bench.events().filter(|text| text.contains(&report)).count(), 1, "{test}");
        went_on(&run, test, 0.7);
    }
}

/// Friction may keep the axis off its set-point by more than `insertion.arrival_mm`: here by 0.1 mm.
#[test]
fn a_hold_in_which_the_needle_rests_off_its_set_point_ends_with_the_reason() {
    let ended = |resume: &str, mut lost: u32| {
        let resume = format!("tracker.resume={resume}");
        let sets = ["insertion.depth_mm=30", "tracker.hold_timeout_s=6", &resume];
        let mut bench = Bench::new(configured(&sets));
        bench.run_to_mm(10.0);
        bench.spoil(move |input| match input {
            Input::Tracker(_) if lost > 0 => {
                lost -= 1;
                Fate::Lost
            }
            Input::Frame(frame) if frame.cob_id() == Some(0x181) => {
                let mut data: [u8; 6] = frame.data().try_into().unwrap();
                let counts = i32::from_le_bytes(data[2..].try_into().unwrap()) - 465;
                data[2..].copy_from_slice(&counts.to_le_bytes());
                Fate::Arrives(Input::Frame(Frame::new(0x181, &data)))
            }
            _ => Fate::Arrives(input),
        });
        let from = bench.now;
        bench.run_to_end();
        (bench.reason().to_owned(), bench.now.seconds_after(from))
    };
    let (reason, lasted_s) = ended("stop", u32::MAX);
    assert!(reason.contains("; held and stopped; ") && lasted_s < 4.0, "{reason} {lasted_s}");
    let (reason, lasted_s) = ended("automatic", 40);
    let off = "tracker: the tip is seen again, but the needle is 0.1";
    assert!(reason.starts_with(off) && reason.ends_with("held for 6.0 s and stopped"), "{reason}");
    assert!(lasted_s < 8.0, "{lasted_s}");
}
