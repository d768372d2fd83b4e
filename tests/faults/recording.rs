//! A recorded stream in which the tracker stalls and its last position is stamped as fresh for
//! 59 s while the robot goes on.

use crate::bench::{Bench, configured, is_tracker};
use crate::stream::{blind_mm, states};
use nalgebra::Vector3;
use needle_bench::session::{Input, Lane};
use needle_bench::tracker::{Event, GateName, Sample, Validity};
use needle_bench::units::Time;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// The recording, where the folder of data is there.
fn recording() -> Option<PathBuf> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let data = std::env::var_os("NEEDLE_DATA").map_or(beside, PathBuf::from);
    let file = data.join("tracker-recordings/phantomA_closedloop_03.csv");
    if !file.exists() {
        println!("skipped: {} is not there; set NEEDLE_DATA", file.display());
        return None;
    }
    Some(file)
}

/// The rows' time stamps, ns since 1970, and tip positions.
fn rows(file: &Path) -> Vec<(i64, Vector3<f64>)> {
    let text = std::fs::read_to_string(file).expect("a text");
    let mut lines = text.lines();
    let head: Vec<&str> = lines.next().expect("a head").split(',').map(str::trim).collect();
    let column = |name: &str| head.iter().position(|column| *column == name).expect("a column");
    let [s, ns] = ["Timestamp sec", "Timestamp nanosec"].map(column);
    let tip = ["Tip x", "Tip y", "Tip z"].map(column);
    let row = |line: &str| {
        let cells: Vec<f64> = line.split(',').map(|cell| cell.parse().expect("a number")).collect();
        (cells[s] as i64 * 1_000_000_000 + cells[ns] as i64, Vector3::from(tip.map(|i| cells[i])))
    };
    lines.map(row).collect()
}

#[test]
fn a_recorded_tracker_that_stalls_is_noticed_before_a_millimetre() {
    let Some(file) = recording() else { return };
    // Two positions a second, of another needle that was pushed by hand in steps of 5 mm: the model
    // has nothing to say of it.
    let sets = [
        "insertion.speed_mm_per_s=0.8",
        "tracker.hold_after_s=1.5",
        "tracker.gates.innovation_chi2=1e9",
        "tracker.gates.tip_speed_max_mm_per_s=20",
    ];
    let mut bench = Bench::new(configured(&sets));
    bench.lose(is_tracker);
    let rows = rows(&file);
    let begun_ns = rows[0].0;
    for (unix_ns, position_mm) in rows {
        if bench.session.outcome().is_some() {
            break;
        }
        let at = Time::from_nanos(unix_ns - begun_ns);
        bench.run_for(at.since(bench.now));
        let sample = Sample {
            tool: "NeedleToTracker".to_owned(),
            receive_time: bench.now,
            source_unix_ns: Some(unix_ns),
            position_mm,
            orientation: None,
            validity: Validity::Valid,
        };
        bench.hand(Input::Tracker(Event::Sample(sample)));
    }
    bench.run_for(Duration::from_secs(5));
    let reason = bench.reason();
    assert!(
        reason.contains("insertion held and stopped; ") && reason.contains("repeat: "),
        "{reason}"
    );
    let counts = bench.session.gate_counts();
    assert_eq!(counts.of(GateName::Zero), 1, "the first row");
    let stalled = Time::from_secs_f64(31.5);
    let blind_mm = blind_mm(&bench, Time::NEVER);
    println!("{blind_mm:.2} mm inserted blind; {reason}");
    assert!((0.5..1.0).contains(&blind_mm), "{blind_mm} mm inserted blind");
    assert!(bench.now > stalled && states(&bench, Lane::Session).contains(&"holding"));
}
