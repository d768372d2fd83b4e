use super::*;
use crate::config::Config;
use crate::tracker::Validity;
use nalgebra::Vector3;

/// The records of `count` samples, of which those in `lost` are out of view.
fn records(count: i64, lost: std::ops::Range<i64>, is_inserting: bool) -> Vec<Record> {
    let config = Config::from_sources(&[], &[]).unwrap().session().unwrap();
    let mut tracking = Tracking::new(&config);
    for n in 0..count {
        let now = Time::from_nanos(n * 2_000_000);
        let validity = if lost.contains(&n) { Validity::OutOfView } else { Validity::Valid };
        let sample = Sample {
            tool: "NeedleToTracker".to_owned(),
            receive_time: now,
            source_unix_ns: None,
            position_mm: Vector3::new(1.0, 0.01 * n as f64, 0.0),
            orientation: None,
            validity,
        };
        tracking.take(now, sample, is_inserting);
    }
    tracking.records.into()
}

#[test]
fn a_tip_lost_before_the_insertion_is_not_recovered_by_the_model() {
    let records = records(9, 3..8, false);
    let has_event = |part: &str| {
        records
            .iter()
            .any(|record| matches!(record, Record::Event { text, .. } if text.contains(part)))
    };
    assert!(has_event("lost, 5 refused") && !has_event("found"), "{records:?}");
}

#[test]
fn the_oldest_of_too_many_waiting_positions_is_refused() {
    let records = records(257, 0..0, true);
    let [Record::Sample(sample), ..] = &records[..] else { panic!("{records:?}") };
    assert_eq!(sample.refused.as_ref().map(|refusal| &*refusal.why), Some(TOO_MANY_WAIT));
}
