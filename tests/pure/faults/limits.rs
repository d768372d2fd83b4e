//! The lowest limits of acceleration that the configuration check accepts are enough for a run.

use crate::support::bench::{Bench, Fate, PAPER, configured, is_tracker};
use needle_bench::config::Config;
use needle_bench::session::{Record, State};
use std::time::Duration;

/// Settings of runs, the largest accelerations that they command, mm/s² and deg/s², and the depth, mm, at which the
/// tracker must fall silent for a hold while the insertion brakes at its end.
const RUNS: [(&[&str], [f64; 2], f64); 7] = [
    (&[], [40.0, 8000.0], 10.9),
    (&["control.kind=nested-saturation", "observer.kind=invariant"], [40.0, 24_000.0], 10.9),
    (&["insertion.mode=stepwise", "insertion.settle_s=0.05"], [40.0, 8000.0], 10.9),
    (
        &[
            "insertion.speed_mm_per_s=5",
            "insertion.acceleration_mm_per_s2=80",
            "stage.insertion.jog_acceleration_mm_per_s2=80",
            "can.sync_ms=4",
        ],
        [90.0, 50_000.0],
        9.4,
    ),
    // A hold brakes more softly than the end of the insertion.
    (
        &[
            "tracker.hold_braking_mm_per_s2=1.5",
            "insertion.acceleration_mm_per_s2=20",
            "stage.insertion.jog_acceleration_mm_per_s2=20",
        ],
        [22.5, 8000.0],
        10.3,
    ),
    (&["can.sync_ms=25", "insertion.acceleration_mm_per_s2=33"], [40.0, 3200.0], 10.9),
    (
        &[
            "insertion.speed_mm_per_s=0.7",
            "insertion.acceleration_mm_per_s2=3.3",
            "tracker.hold_braking_mm_per_s2=3.0",
            "stage.insertion.jog_acceleration_mm_per_s2=1.0",
        ],
        [3.7125, 2800.0],
        11.55,
    ),
];

/// The settings of these limits.
fn limits([mm_per_s2, deg_per_s2]: [f64; 2]) -> [String; 2] {
    [
        format!("stage.insertion.acceleration_max_mm_per_s2={mm_per_s2:?}"),
        format!("stage.rotation.acceleration_max_deg_per_s2={deg_per_s2:?}"),
    ]
}

/// With holds between steps, before the last step, and while the needle brakes at the end.
#[test]
fn a_run_at_its_acceleration_limits_completes() {
    for (sets, peaks, end_mm) in RUNS {
        let common = [
            "stage.insertion.quick_stop_deceleration_mm_per_s2=80",
            "insertion.depth_mm=12",
            "tracker.resume=automatic",
            "tracker.hold_after_mm=3",
            "tracker.hold_timeout_s=30",
        ];
        let sets = [&common[..], sets].concat();
        let limits = limits(peaks);
        let sets = [&sets[..], &limits.each_ref().map(String::as_str)].concat();
        let mut bench = Bench::new(configured(&sets));
        for depth_mm in [2.3, 6.0, end_mm] {
            bench.run_to_mm(depth_mm);
            bench.lose(is_tracker);
            bench.run_for(Duration::from_secs(1));
            bench.spoil(Fate::Arrives);
        }
        bench.run_to_end();
        assert!(bench.completed(), "{sets:?}: {}", bench.reason());
        let is_held =
            |record: &&Record| matches!(record, Record::State { state: State::Holding, .. });
        assert!(bench.records.iter().filter(is_held).count() >= 2, "{sets:?}");
        // The configuration check refuses any lower limit.
        for lower in [[0.999 * peaks[0], peaks[1]], [peaks[0], 0.999 * peaks[1]]] {
            let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
            let all = PAPER.map(str::to_owned).into_iter().chain(sets).chain(self::limits(lower));
            let refused = Config::from_sources(&[], &all.collect::<Vec<_>>()).expect_err("refused");
            assert!(refused.to_string().contains("acceleration_max_"), "{refused}");
        }
    }
}
