//! The same configuration and seed give the same record, bit for bit.

use crate::support::bench::{Bench, configured};

/// Every record of a run as text, with all digits.
fn records(seed: u32) -> Vec<String> {
    let seed = format!("emulator.seed={seed}");
    let mut bench = Bench::new(configured(&[&seed, "insertion.depth_mm=30"]));
    bench.run_to_end();
    assert!(bench.completed(), "{}", bench.reason());
    bench.records.iter().map(|record| format!("{record:?}")).collect()
}

#[test]
fn a_run_is_repeated_by_its_seed_and_by_no_other() {
    let steps = |records: &[String]| {
        records.iter().filter(|record| record.starts_with("Step(")).cloned().collect::<Vec<_>>()
    };
    let (first, again, other) = (records(7), records(7), records(8));
    assert_eq!(first, again);
    let (first, other) = (steps(&first), steps(&other));
    assert_eq!((first.len(), other.len()), (31, 31));
    assert!(first.iter().zip(&other).all(|(a, b)| a != b));
}
