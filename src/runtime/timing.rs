//! The clock of a live run, and how well it was kept.

use crate::stage::Counters;
use crate::units::Time;
use serde_json::{Map, Value, json};
use std::time::{Duration, Instant, SystemTime};

/// A monotonic clock whose origin is known in UTC.
#[derive(Debug, Clone, Copy)]
pub struct Clock {
    origin: Instant,
    origin_utc: SystemTime,
}

impl Clock {
    /// A clock that starts at [`Time::ZERO`] now.
    pub fn start() -> Self {
        Clock { origin: Instant::now(), origin_utc: SystemTime::now() }
    }

    /// The time of now.
    pub fn now(&self) -> Time {
        Time::ZERO + self.origin.elapsed()
    }

    /// The origin in UTC.
    pub fn origin_utc(&self) -> SystemTime {
        self.origin_utc
    }
}

/// How late the control thread came to the session's deadlines, the SYNCs among them.
#[derive(Debug, Clone, Default)]
pub struct TimingFigures {
    late_us: Vec<u32>,
}

impl TimingFigures {
    /// Notes a deadline met `late` after its time.
    pub fn note(&mut self, late: Duration) {
        self.late_us.push(u32::try_from(late.as_micros()).unwrap_or(u32::MAX));
    }

    /// The figures for the manifest, times in µs, with what the stage counted; empty of a run
    /// without deadlines.
    pub fn to_json(&self, counters: Counters) -> Map<String, Value> {
        let mut sorted = self.late_us.clone();
        sorted.sort_unstable();
        let Some(last) = sorted.len().checked_sub(1) else { return Map::new() };
        let at = |per_mille: usize| sorted[last * per_mille / 1000];
        let figures = json!({
            "deadlines": sorted.len(),
            "deadline_late_us_p50": at(500),
            "deadline_late_us_p99": at(990),
            "deadline_late_us_max": at(1000),
            "syncs_skipped": counters.syncs_skipped,
            "feedback_missed": counters.feedback_missed,
        });
        figures.as_object().cloned().unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_order_statistics() {
        let mut timing = TimingFigures::default();
        assert!(timing.to_json(Counters::default()).is_empty());
        for us in (0..=1000).rev() {
            timing.note(Duration::from_micros(us));
        }
        let json = timing.to_json(Counters { syncs_skipped: 3, ..Counters::default() });
        assert_eq!(json["deadline_late_us_p50"], 500);
        assert_eq!(json["deadline_late_us_p99"], 990);
        assert_eq!(json["deadline_late_us_max"], 1000);
        assert_eq!(json["syncs_skipped"], 3);
    }
}
