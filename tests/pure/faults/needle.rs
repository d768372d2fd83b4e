//! A needle or tissue unlike the model, scripted in TOML: 110 mm at 2 mm/s with the default noise, observer and law.
//! Each row of `docs/hazards.md` has two runs with the model taken as exact, and two with the process noise of
//! `bench-config/rig-epos4.toml`. And a needle as in the model, from a known start.

use crate::support::bench::{Bench, configured_with};
use crate::support::stop::is_row;
use needle_bench::config::{Config, Source};
use needle_bench::session::{Machine, Record};
use std::time::Duration;

const SEEDS: [u32; 2] = [1, 2];
/// The start; the observer knows its roll to 20 degrees.
const SETTINGS: [&str; 4] = [
    "insertion.depth_mm=110",
    "emulator.start={ x_mm = 3, y_mm = 0, z_mm = 0, yaw_deg = 2, pitch_deg = 2, roll_deg = 30 }",
    "observer.start={ yaw_deg = 0, pitch_deg = 0, roll_deg = 30 }",
    "observer.invariant.start_sd={ yaw_deg = 12, pitch_deg = 8, roll_deg = 20 }",
];
/// Estimates are judged from this depth on, mm, or in a run that ends before it from the start.
const JUDGED_FROM_MM: f64 = 40.0;
/// What the observer warns of.
const WARNING: &str = "the positions leave the model at ";

/// Two runs with a fault.
#[derive(Debug, Default)]
struct Runs {
    warned: u32,
    stopped: u32,
    /// The largest depth of a run's first warning, mm.
    warned_by_mm: f64,
    /// The largest distance of the estimated tip from the true one, mm.
    error_mm: f64,
    /// The largest error of a coordinate in its standard deviations.
    error_sds: f64,
}

impl Runs {
    /// Runs each seed with the fault `fault`, an inline table of TOML without braces.
    fn of(fault: &str, noise: &str) -> Self {
        let mut runs = Runs::default();
        SEEDS.iter().for_each(|seed| runs.add(fault, noise, *seed));
        runs
    }

    fn add(&mut self, fault: &str, noise: &str, seed: u32) {
        let (fault, seed) =
            (format!("emulator.fault=[{{ {fault} }}]"), format!("emulator.seed={seed}"));
        let mut bench =
            Bench::new(configured_with(&[&SETTINGS[..], &[noise, &fault, &seed]].concat()));
        let (mut taken, mut errors, mut warned_mm) = (0, Vec::new(), None);
        while bench.session.outcome().is_none() {
            bench.run_for(Duration::from_millis(2));
            let tip_true_mm = bench.stage.truth(bench.now).x_pb.translation;
            for record in &bench.records[taken..] {
                match record {
                    Record::Step(step) => {
                        let Some(estimate) = step.decision.estimate else { continue };
                        let error_mm = estimate.x_pb.translation - tip_true_mm;
                        let sds = estimate.sd.expect("stated");
                        let worst = (0..3).map(|axis| error_mm[axis].abs() / sds[axis]);
                        let worst = worst.fold(0.0, f64::max);
                        errors.push((step.insertion_meas_mm, error_mm.norm(), worst));
                    }
                    Record::Event { text, .. } if warned_mm.is_none() => {
                        let depth_mm =
                            text.strip_prefix(WARNING).and_then(|text| text.split(' ').next());
                        warned_mm = depth_mm.map(|mm| mm.parse::<f64>().expect("a depth"));
                    }
                    _ => {}
                }
            }
            taken = bench.records.len();
        }
        self.stopped += u32::from(!bench.completed());
        self.warned += u32::from(warned_mm.is_some());
        self.warned_by_mm = self.warned_by_mm.max(warned_mm.unwrap_or(0.0));
        let (last_mm, ..) = *errors.last().expect("an estimate");
        for (depth_mm, error_mm, sds) in errors {
            if depth_mm >= JUDGED_FROM_MM || last_mm <= JUDGED_FROM_MM {
                self.error_mm = self.error_mm.max(error_mm);
                self.error_sds = self.error_sds.max(sds);
            }
        }
    }

    /// Its half of the row of `docs/hazards.md`.
    fn cells(&self) -> String {
        let Runs { warned, stopped, error_mm, error_sds, .. } = self;
        let by =
            if self.warned > 0 { format!("{:.0}", self.warned_by_mm) } else { "–".to_owned() };
        format!("{warned} | {by} | {stopped} | {error_mm:.2} | {error_sds:.1}")
    }
}

/// The process noise of the rig's configuration, as a setting.
fn rig_noise() -> String {
    let rig = include_str!("../../../bench-config/rig-epos4.toml");
    let (_, after) = rig.split_once("[observer.invariant.noise]\n").expect("the section");
    let keys = after.lines().take_while(|line| line.contains('='));
    let keys: Vec<&str> =
        keys.map(|line| line.split('#').next().unwrap_or_default().trim()).collect();
    let noise = format!("observer.invariant.noise={{ {} }}", keys.join(", "));
    Config::from_sources(&[] as &[Source], std::slice::from_ref(&noise)).expect("valid");
    noise
}

/// Asserts that the estimate stays within `error_max_mm` of the tip, and that the row of `docs/hazards.md` has what was
/// measured.
fn is_documented(test: &str, fault: &str, error_max_mm: f64) {
    let exact = Runs::of(fault, "observer.invariant.noise={}");
    let noisy = Runs::of(fault, &rig_noise());
    for runs in [&exact, &noisy] {
        assert!(runs.error_mm < error_max_mm, "{test}: {runs:?}");
    }
    is_row(test, &format!("{} | {} | `{test}` |", exact.cells(), noisy.cells()));
}

#[test]
fn softer_tissue_up_to_40_mm() {
    is_documented(
        "softer_tissue_up_to_40_mm",
        r#"kind = "tissue", share = 0.3, at_mm = 0, duration_s = 20"#,
        0.7,
    );
}

#[test]
fn softer_tissue_from_50_mm_on() {
    is_documented(
        "softer_tissue_from_50_mm_on",
        r#"kind = "tissue", share = 0.3, at_mm = 50"#,
        0.7,
    );
}

#[test]
fn tissue_that_bends_more_from_50_mm_on() {
    is_documented(
        "tissue_that_bends_more_from_50_mm_on",
        r#"kind = "tissue", share = 1.6, at_mm = 50"#,
        0.7,
    );
}

/// It is stopped as another needle.
#[test]
fn tissue_that_bends_five_times_as_much() {
    is_documented(
        "tissue_that_bends_five_times_as_much",
        r#"kind = "tissue", share = 5, at_mm = 20"#,
        2.5,
    );
}

#[test]
fn a_chuck_that_slips_from_60_mm_on() {
    is_documented(
        "a_chuck_that_slips_from_60_mm_on",
        r#"kind = "chuck-slip", share = 0, at_mm = 60"#,
        0.7,
    );
}

#[test]
fn a_chuck_that_slips_from_40_to_80_mm() {
    is_documented(
        "a_chuck_that_slips_from_40_to_80_mm",
        r#"kind = "chuck-slip", share = 0, at_mm = 40, duration_s = 20"#,
        0.7,
    );
}

#[test]
fn a_chuck_that_loses_a_fifth_of_each_turn() {
    is_documented(
        "a_chuck_that_loses_a_fifth_of_each_turn",
        r#"kind = "chuck-slip", share = 0.8, at_mm = 0"#,
        0.7,
    );
}

#[test]
fn a_chuck_that_loses_two_fifths_of_each_turn() {
    is_documented(
        "a_chuck_that_loses_two_fifths_of_each_turn",
        r#"kind = "chuck-slip", share = 0.6, at_mm = 0"#,
        0.7,
    );
}

#[test]
fn a_needle_that_never_turns_with_its_chuck() {
    is_documented(
        "a_needle_that_never_turns_with_its_chuck",
        r#"kind = "chuck-slip", share = 0, at_mm = 0"#,
        1.5,
    );
}

#[test]
fn a_shaft_that_buckles_by_5_mm_in_30() {
    is_documented(
        "a_shaft_that_buckles_by_5_mm_in_30",
        r#"kind = "buckling", share = 0.833, at_mm = 40, duration_s = 15"#,
        2.0,
    );
}

#[test]
fn a_shaft_that_buckles_by_5_mm_in_70() {
    is_documented(
        "a_shaft_that_buckles_by_5_mm_in_70",
        r#"kind = "buckling", share = 0.93, at_mm = 30, duration_s = 35"#,
        2.0,
    );
}

/// The watch must not miss the first turns of the base, however long it waits for positions.
#[test]
fn a_known_start_is_not_taken_for_another_roll() {
    for after_s in [0.5, 2.0] {
        let mut bench = Bench::new(configured_with(&[
            "insertion.depth_mm=40",
            "observer.start={ yaw_deg = 5.0, pitch_deg = 5.0, roll_deg = 30.0 }",
            "observer.invariant.start_sd={ yaw_deg = 2.0, pitch_deg = 2.0, roll_deg = 2.0 }",
            "tracker.hold_after_mm=6",
            &format!("tracker.hold_after_s={after_s}"),
        ]));
        bench.run_to_end();
        assert!(bench.completed(), "{after_s} s: {}", bench.reason());
    }
}
