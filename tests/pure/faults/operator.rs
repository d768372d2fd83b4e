//! The operator's commands: in each state of a run, twice, in bursts, and at the moment of a fault.

use super::stream::states;
use crate::support::bench::{Bench, Fate, configured, is_tracker};
use insta::assert_snapshot;
use needle_bench::session::{
    Input, Lane, Machine as _, OperatorCommand, Outcome, Record, Severity, State,
};
use needle_bench::stage::Feedback;
use proptest::prelude::*;
use std::time::Duration;

use OperatorCommand::{Hold, Resume, Speed, Step};

const SECOND: Duration = Duration::from_secs(1);
/// No insertion at these speeds takes longer to brake and come to rest.
const BRAKING: Duration = Duration::from_millis(150);

/// The longest travel from 2 mm/s after a hold and after a stop, mm.
const HOLD_MM: f64 = 0.12;
const STOP_MM: f64 = 0.11;

fn bench(sets: &[&str]) -> Bench {
    Bench::new(configured(&[&["insertion.depth_mm=20"], sets].concat()))
}

fn ask(bench: &mut Bench, command: OperatorCommand) -> String {
    bench.hand(Input::Operator(command));
    let answer = bench.events().filter(|text| text.starts_with("operator: ")).last();
    answer.expect("an answer").to_owned()
}

#[test]
fn the_last_of_many_steps_is_not_refused_for_its_rounding() {
    let mut bench = bench(&["insertion.depth_mm=3"]);
    ask(&mut bench, Hold);
    bench.run_for(3 * SECOND);
    for n in 0..15 {
        let answer = ask(&mut bench, Step { mm: 0.2 });
        assert!(!answer.contains("refused"), "{n}: {answer}");
        bench.run_for(2 * SECOND);
    }
}

fn state(bench: &Bench) -> State {
    bench.session.progress().state
}

fn feedback(bench: &Bench) -> impl Iterator<Item = &Feedback> {
    bench.records.iter().filter_map(|record| match record {
        Record::Stage(feedback) => Some(feedback),
        _ => None,
    })
}

/// Depth commanded last, mm.
fn commanded_mm(bench: &Bench) -> f64 {
    feedback(bench).last().map_or(0.0, |feedback| feedback.commanded.insertion_mm)
}

#[test]
fn only_the_operator_ends_a_hold_by_the_operator() {
    for resume in ["stop", "automatic", "operator"] {
        let mut bench = bench(&[&format!("tracker.resume={resume}"), "tracker.hold_timeout_s=1"]);
        bench.run_to_mm(5.0);
        ask(&mut bench, Hold);
        bench.run_for(BRAKING);
        let held_mm = commanded_mm(&bench);
        assert!(held_mm < 5.3, "{held_mm}");
        // Neither the loss of the tip nor its return ends the hold.
        bench.lose(is_tracker);
        bench.run_for(3 * SECOND);
        let refused = ask(&mut bench, Resume);
        assert!(
            refused.starts_with("operator: resume refused: the last tip is 3.0"),
            "{resume}: {refused}"
        );
        bench.spoil(Fate::Arrives);
        bench.run_for(3 * SECOND);
        assert_eq!((state(&bench), commanded_mm(&bench)), (State::HeldByOperator, held_mm));
        assert_eq!(
            ask(&mut bench, Resume),
            format!("operator: resume at {held_mm:.2} mm, held for 6.15 s")
        );
        bench.run_to_end();
        assert!(bench.completed(), "{resume}: {}", bench.reason());
        let went =
            ["preparing", "inserting", "held by operator", "inserting", "stopping", "completed"];
        assert_eq!(states(&bench, Lane::Session), went);
    }
}

/// In both modes.
#[test]
fn single_steps_end_at_the_depth_asked_for() {
    for mode in ["continuous", "stepwise"] {
        let mut bench = bench(&[&format!("insertion.mode={mode}")]);
        bench.run_to_mm(5.0);
        ask(&mut bench, Hold);
        bench.run_for(BRAKING);
        for step_mm in [0.01, 1.0, 2.5] {
            let from_mm = commanded_mm(&bench);
            ask(&mut bench, Step { mm: step_mm });
            assert_eq!(state(&bench), State::Stepping);
            bench.run_for(5 * SECOND);
            assert_eq!(state(&bench), State::HeldAfterStep);
            // Exact to a count of the drive.
            assert!((commanded_mm(&bench) - from_mm - step_mm).abs() < 1e-3, "{mode} {step_mm}");
        }
        ask(&mut bench, Resume);
        bench.run_to_end();
        assert!(bench.completed(), "{mode}: {}", bench.reason());
    }
}

/// With `tracker.resume = "automatic"` the tracker's hold ends by itself, but the step does not continue.
#[test]
fn a_step_that_the_tracker_interrupts_stays_held() {
    let mut bench = bench(&["tracker.resume=automatic"]);
    bench.run_to_mm(5.0);
    ask(&mut bench, Hold);
    bench.run_for(BRAKING);
    ask(&mut bench, Step { mm: 10.0 });
    bench.run_to_mm(7.0);
    bench.lose(is_tracker);
    bench.run_for(SECOND);
    assert_eq!(state(&bench), State::Holding);
    bench.spoil(Fate::Arrives);
    bench.run_for(3 * SECOND);
    assert_eq!(state(&bench), State::HeldAfterStep);
    assert!(commanded_mm(&bench) < 8.5);
    ask(&mut bench, Resume);
    bench.run_to_end();
    assert!(bench.completed(), "{}", bench.reason());
}

const SEEN_AGAIN: &str = "the tip is seen again; resume within ";

/// With `tracker.resume = "operator"`.
#[test]
fn a_hold_by_the_tracker_is_ended_by_the_operator_or_by_its_timeout() {
    for asks in [true, false] {
        let mut bench = bench(&["tracker.resume=operator"]);
        bench.run_to_mm(5.0);
        bench.lose(is_tracker);
        bench.run_for(2 * SECOND);
        assert!(ask(&mut bench, Resume).contains("refused: the last tip is"));
        bench.spoil(Fate::Arrives);
        bench.run_for(SECOND);
        assert_eq!(state(&bench), State::Holding);
        if asks {
            assert!(ask(&mut bench, Resume).starts_with("operator: resume at "));
        }
        if !asks {
            bench.lose(is_tracker);
            bench.run_for(SECOND);
            bench.spoil(Fate::Arrives);
            bench.run_for(SECOND / 2);
        }
        bench.run_to_end();
        let told = |start: &str| bench.events().filter(|text| text.starts_with(start)).count();
        let again = usize::from(!asks);
        assert_eq!([told(SEEN_AGAIN), told("the tip is lost again; ")], [1 + again, again]);
        assert_eq!(bench.completed(), asks, "{}", bench.reason());
        let nobody = "tracker: the tip is seen again, but the operator did not resume \
                      (tracker.hold_timeout_s); held for 5.0 s and stopped";
        assert!(asks || bench.reason() == nobody, "{}", bench.reason());
    }
}

#[test]
fn the_speed_changes_evenly_and_within_its_limits() {
    let mut bench = bench(&[]);
    bench.run_to_mm(5.0);
    for mm_per_s in [0.0, -1.0, 2.000001, 1e9, f64::NAN, f64::INFINITY] {
        let refused = ask(&mut bench, Speed { mm_per_s });
        assert!(
            refused.ends_with("allowed: over 0 and up to 2 mm/s (insertion.speed_mm_per_s)"),
            "{refused}"
        );
    }
    assert_eq!(ask(&mut bench, Speed { mm_per_s: 0.5 }), "operator: speed 0.500 mm/s, was 2.000");
    bench.run_for(SECOND);
    let from_mm = commanded_mm(&bench);
    bench.run_for(SECOND);
    assert!((commanded_mm(&bench) - from_mm - 0.5).abs() < 0.01);
    assert_eq!(ask(&mut bench, Speed { mm_per_s: 2.0 }), "operator: speed 2.000 mm/s, was 0.500");
    bench.run_to_end();
    assert!(bench.completed(), "{}", bench.reason());
}

/// Brings a run into a state.
type Reach = fn(&mut Bench);

/// Every state in which a command can arrive, and how a run gets there.
const STATES: [(&str, Reach); 9] = [
    ("preparing", |_| {}),
    ("preparing, asked to hold", |bench| {
        ask(bench, Hold);
        bench.run_for(SECOND / 10);
    }),
    ("inserting", |bench| bench.run_to_mm(5.0)),
    ("braking", |bench| {
        bench.run_to_mm(5.0);
        ask(bench, Hold);
    }),
    ("held by operator", |bench| {
        bench.run_to_mm(5.0);
        ask(bench, Hold);
        bench.run_for(BRAKING);
    }),
    ("stepping", |bench| {
        STATES[4].1(bench);
        ask(bench, Step { mm: 3.0 });
        bench.run_to_mm(6.0);
    }),
    ("held after step", |bench| {
        STATES[4].1(bench);
        ask(bench, Step { mm: 0.5 });
        bench.run_for(2 * SECOND);
    }),
    ("holding", |bench| {
        bench.run_to_mm(5.0);
        bench.lose(is_tracker);
        bench.run_for(SECOND);
    }),
    ("stopping", |bench| {
        bench.run_to_mm(5.0);
        bench.hand(Input::Stop("operator: interrupted".to_owned()));
    }),
];
const COMMANDS: [OperatorCommand; 5] =
    [Hold, Resume, Step { mm: 1.0 }, Step { mm: 30.0 }, Speed { mm_per_s: 1.0 }];

/// The answer to each command in each state, and to the same command again.
#[test]
fn each_command_at_each_state() {
    let mut table = String::new();
    for (name, reach) in STATES {
        table += &format!("{name}\n");
        for command in COMMANDS {
            let mut bench = bench(&["tracker.resume=automatic"]);
            reach(&mut bench);
            for _ in 0..2 {
                let answer = ask(&mut bench, command);
                table +=
                    &format!("  {}\n      -> {}\n", &answer["operator: ".len()..], state(&bench));
            }
            bench.spoil(Fate::Arrives);
            bench.hand(Input::Stop("operator: interrupted".to_owned()));
            bench.run_to_end();
            assert_eq!(bench.reason(), "operator: interrupted");
        }
    }
    assert_snapshot!(table);
}

/// Eight holds or stops at once: the needle stands as soon as after one of them.
#[test]
fn a_burst_of_holds_or_stops_at_each_state_goes_no_further() {
    let stop = Input::Stop("operator: interrupted".to_owned());
    for (input, travel_max_mm) in [(Input::Operator(Hold), HOLD_MM), (stop, STOP_MM)] {
        let mut furthest_mm = 0.0f64;
        for (name, reach) in STATES {
            let mut bench = bench(&["tracker.resume=automatic"]);
            reach(&mut bench);
            let from_mm = bench.stage.position_true(bench.now).0;
            (0..8).for_each(|_| bench.hand(input.clone()));
            bench.run_for(SECOND);
            let stands_mm = bench.stage.position_true(bench.now).0;
            bench.run_for(SECOND);
            let later_mm = bench.stage.position_true(bench.now).0;
            assert!((later_mm - stands_mm).abs() < 1e-3, "{name}, {input:?}: it still moves");
            furthest_mm = furthest_mm.max(stands_mm - from_mm);
            assert!(furthest_mm < travel_max_mm, "{name}, {input:?}: {furthest_mm} mm");
        }
        println!("{input:?}: {furthest_mm:.3} mm at most");
    }
}

/// Just before it or just after it.
#[test]
fn a_command_at_the_moment_of_a_fault_changes_nothing() {
    for (name, reach) in STATES.iter().filter(|(name, _)| *name != "stopping") {
        for command in COMMANDS {
            for fault_first in [true, false] {
                let mut bench = bench(&["tracker.resume=automatic"]);
                reach(&mut bench);
                let fault = Input::BusFault("bus off".to_owned());
                let both = [fault, Input::Operator(command)];
                let order = if fault_first { [0, 1] } else { [1, 0] };
                order.into_iter().for_each(|n| bench.hand(both[n].clone()));
                let since_mm = bench.stage.position_true(bench.now).0;
                bench.run_to_end();
                assert_eq!(bench.reason(), "can: bus off", "{name}");
                let travel_mm = bench.stage.position_true(bench.now).0 - since_mm;
                assert!(travel_mm < 0.1, "{name}, {command}: {travel_mm} mm");
            }
        }
    }
}

/// Something that happens during a run.
#[derive(Debug, Clone)]
enum Happening {
    Command(OperatorCommand),
    TipLost,
    TipFound,
}

fn happening() -> impl Strategy<Value = Happening> {
    let mm = prop_oneof![-1.0..8.0f64, Just(f64::NAN), Just(1e300), Just(1e-12)];
    let speed = prop_oneof![-0.5..2.5f64, Just(f64::NAN), Just(1e-9)];
    prop_oneof![
        3 => Just(Happening::Command(Hold)),
        4 => Just(Happening::Command(Resume)),
        3 => mm.prop_map(|mm| Happening::Command(Step { mm })),
        2 => speed.prop_map(|mm_per_s| Happening::Command(Speed { mm_per_s })),
        1 => Just(Happening::TipLost),
        2 => Just(Happening::TipFound),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    /// Whatever the operator and the tracker do: no set-point moves a needle that is held and has braked, or
    /// withdraws it, or breaks a limit of speed or acceleration; only a command ends a hold by the operator or after
    /// a step; and every run stops when the operator stops it.
    #[test]
    fn no_commands_in_any_order_move_a_held_needle_or_break_a_limit(
        resume in prop::sample::select(vec!["stop", "automatic", "operator"]),
        mode in prop::sample::select(vec!["continuous", "stepwise"]),
        happenings in prop::collection::vec((happening(), prop_oneof![Just(0u64), 0..40u64, 0..1500u64]), 1..40),
    ) {
        let sets = [format!("tracker.resume={resume}"), format!("insertion.mode={mode}")];
        let mut bench = bench(&sets.each_ref().map(String::as_str));
        bench.run_for(SECOND);
        let mut allowed = Vec::new();
        for (happening, pause_ms) in happenings {
            match happening {
                Happening::Command(command) => {
                    if matches!(command, Resume | Step { .. }) {
                        allowed.push(bench.now);
                    }
                    bench.hand(Input::Operator(command));
                }
                Happening::TipLost => bench.lose(is_tracker),
                Happening::TipFound => bench.spoil(Fate::Arrives),
            }
            bench.run_for(Duration::from_millis(pause_ms));
        }
        bench.hand(Input::Stop("operator: interrupted".to_owned()));
        bench.run_to_end();
        prop_assert!(matches!(bench.session.outcome(), Some(Outcome::Stopped(_) | Outcome::Completed)));

        let period_s = 0.01;
        let (mut held_since, mut last_mm, mut last_speed) = (None, 0.0, 0.0);
        let mut was = State::Preparing;
        for record in &bench.records {
            match record {
                Record::State { time, state } if state.lane() == Lane::Session => {
                    if matches!(was, State::HeldByOperator | State::HeldAfterStep)
                        && matches!(state, State::Inserting | State::Stepping)
                    {
                        prop_assert!(allowed.contains(time), "{was} ended by itself at {time:?}");
                    }
                    let goes_on = state.is_held() && was.is_held();
                    held_since = state.is_held().then(|| held_since.filter(|_| goes_on).unwrap_or(*time));
                    was = *state;
                    if *state == State::Stopping {
                        break;
                    }
                }
                Record::Stage(feedback) => {
                    let mm = feedback.commanded.insertion_mm;
                    let speed = (mm - last_mm) / period_s;
                    // The slack is for the rounding to counts of 0.2 µm.
                    prop_assert!((-1e-9..=2.0 + 0.1).contains(&speed), "{speed} mm/s in {was}");
                    let acceleration = (speed - last_speed) / period_s;
                    prop_assert!(acceleration.abs() <= 40.0 + 11.0, "{acceleration} mm/s² in {was}");
                    let has_braked = held_since.is_some_and(|since| feedback.time.since(since) > BRAKING);
                    prop_assert!(!has_braked || mm == last_mm, "{mm} after {last_mm} in {was}");
                    (last_mm, last_speed) = (mm, speed);
                }
                _ => {}
            }
        }
        let refused = bench.records.iter().any(|record| {
            matches!(record, Record::Event { lane: Lane::Stage, severity: Severity::Fault, .. })
        });
        prop_assert!(!refused, "{}", bench.reason());
    }
}
