//! The clock of a live run, and how well it was kept.

use super::realtime::RealTime;
use crate::stage::Counters;
use crate::units::Time;
use hdrhistogram::Histogram;
use serde::Serialize;
use std::fmt;
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

/// A SYNC that leaves later than this is counted: a tenth of the usual period of 10 ms.
const SYNC_LATE_LIMIT_US: u32 = 1000;

/// How late the control thread came to its deadlines, and its SYNCs left.
#[derive(Debug, Clone, Default)]
pub struct TimingFigures {
    deadlines_late: Lateness,
    syncs_late: Lateness,
    /// SYNCs that left later than [`SYNC_LATE_LIMIT_US`].
    syncs_over_limit: u64,
    set_points: Lateness,
}

/// How late something was, or how long it took: whole µs, or ns, to a thousandth part.
///
/// Its room is taken at the start: noting asks for no memory, however long the run.
#[derive(Debug, Clone)]
pub(super) struct Lateness {
    histogram: Histogram<u32>,
    max: u32,
}

impl Default for Lateness {
    fn default() -> Self {
        let histogram = Histogram::new_with_max(u32::MAX.into(), 3);
        let histogram = histogram.expect("a range above 2 takes three digits");
        Lateness { histogram, max: 0 }
    }
}

impl Lateness {
    fn note_us(&mut self, late: Duration) {
        self.note(late.as_micros());
    }

    /// Notes what took less than four seconds, in ns.
    pub(super) fn note_ns(&mut self, took: Duration) {
        self.note(took.as_nanos());
    }

    fn note(&mut self, value: u128) {
        let value = u32::try_from(value).unwrap_or(u32::MAX);
        self.histogram.saturating_record(value.into());
        self.max = self.max.max(value);
    }

    fn count(&self) -> u64 {
        self.histogram.len()
    }

    /// Median, 99th percentile and maximum; zeros of nothing.
    fn figures(&self) -> [u32; 3] {
        // The end of a bin may lie above everything in it.
        let at = |quantile| {
            let value = self.histogram.value_at_quantile(quantile);
            u32::try_from(value).unwrap_or(u32::MAX).min(self.max)
        };
        [at(0.5), at(0.99), self.max]
    }
}

/// How well time was kept in a run: part of its manifest, times in µs.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct TimingReport {
    /// Deadlines met, the SYNCs' among them.
    pub deadlines: u64,
    /// Median lateness at a deadline.
    pub deadline_late_us_p50: u32,
    /// Its 99th percentile.
    pub deadline_late_us_p99: u32,
    /// The greatest.
    pub deadline_late_us_max: u32,
    /// SYNCs sent.
    pub syncs: u64,
    /// From the time a SYNC was due to its handing over to the bus: median.
    pub sync_late_us_p50: u32,
    /// Its 99th percentile.
    pub sync_late_us_p99: u32,
    /// The greatest.
    pub sync_late_us_max: u32,
    /// SYNCs that left later than [`sync_late_limit_us`](Self::sync_late_limit_us).
    pub syncs_late: u64,
    /// The limit, the same for every run, so that runs can be compared.
    pub sync_late_limit_us: u32,
    /// From the arrival of the feedback to the handing over of the set-points that follow from it to the
    /// bus: median. The kernel's time of arrival counts where there is one.
    pub set_point_us_p50: u32,
    /// Its 99th percentile.
    pub set_point_us_p99: u32,
    /// The greatest.
    pub set_point_us_max: u32,
    /// SYNC periods skipped because the bench was late.
    pub syncs_skipped: u64,
    /// SYNCs that went out without both positions coming back.
    pub feedback_missed: u64,
    /// Frames that came and were lost before the bench took them; none where nobody counts.
    pub frames_dropped: Option<u64>,
    /// What it took the SYNC thread to hand a record over, ns: median.
    pub record_ns_p50: u32,
    /// Its 99th percentile.
    pub record_ns_p99: u32,
    /// The greatest.
    pub record_ns_max: u32,
    /// How the SYNC thread ran; none where as any other thread.
    pub realtime: Option<RealTime>,
}

impl TimingReport {
    /// With what it `took` to hand the records over.
    pub(super) fn with_records(self, took: &Lateness) -> Self {
        let [record_ns_p50, record_ns_p99, record_ns_max] = took.figures();
        TimingReport { record_ns_p50, record_ns_p99, record_ns_max, ..self }
    }
}

impl TimingFigures {
    /// Notes a deadline met `late` after its time.
    pub fn note_deadline(&mut self, late: Duration) {
        self.deadlines_late.note_us(late);
    }

    /// Notes a SYNC that left `late` after its time.
    pub fn note_sync(&mut self, late: Duration) {
        self.syncs_late.note_us(late);
        let limit = Duration::from_micros(SYNC_LATE_LIMIT_US.into());
        self.syncs_over_limit += u64::from(late > limit);
    }

    /// Notes a set-point that left `after` the feedback that it follows from.
    pub fn note_set_point(&mut self, after: Duration) {
        self.set_points.note_us(after);
    }

    /// The figures, with what the stage counted.
    pub fn report(&self, counters: Counters) -> TimingReport {
        let [deadline_late_us_p50, deadline_late_us_p99, deadline_late_us_max] =
            self.deadlines_late.figures();
        let [sync_late_us_p50, sync_late_us_p99, sync_late_us_max] = self.syncs_late.figures();
        let [set_point_us_p50, set_point_us_p99, set_point_us_max] = self.set_points.figures();
        TimingReport {
            deadlines: self.deadlines_late.count(),
            deadline_late_us_p50,
            deadline_late_us_p99,
            deadline_late_us_max,
            syncs: self.syncs_late.count(),
            sync_late_us_p50,
            sync_late_us_p99,
            sync_late_us_max,
            syncs_late: self.syncs_over_limit,
            sync_late_limit_us: SYNC_LATE_LIMIT_US,
            set_point_us_p50,
            set_point_us_p99,
            set_point_us_max,
            syncs_skipped: counters.syncs_skipped,
            feedback_missed: counters.feedback_missed,
            frames_dropped: None,
            record_ns_p50: 0,
            record_ns_p99: 0,
            record_ns_max: 0,
            realtime: None,
        }
    }
}

/// One line for the operator.
impl fmt::Display for TimingReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ms = |us: u32| f64::from(us) * 1e-3;
        write!(
            f,
            "SYNC late by {:.2} ms (median), {:.2} (99 %), {:.2} (at most); {} of {} over {:.2} ms, \
             {} skipped",
            ms(self.sync_late_us_p50),
            ms(self.sync_late_us_p99),
            ms(self.sync_late_us_max),
            self.syncs_late,
            self.syncs,
            ms(self.sync_late_limit_us),
            self.syncs_skipped,
        )?;
        match self.realtime {
            None => Ok(()),
            Some(RealTime { priority, cpu }) => {
                write!(f, "; SCHED_FIFO {priority} on processor {cpu}")
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_order_statistics() {
        let mut timing = TimingFigures::default();
        assert_eq!(timing.report(Counters::default()).sync_late_us_max, 0);
        for us in (0..=1000).rev() {
            timing.note_deadline(Duration::from_micros(2 * us));
            timing.note_sync(Duration::from_micros(us + 200));
            timing.note_set_point(Duration::from_micros(us / 2));
        }
        let counters = Counters { syncs_skipped: 3, ..Counters::default() };
        let report = timing.report(counters);
        assert_eq!(
            report,
            TimingReport {
                deadlines: 1001,
                deadline_late_us_p50: 1000,
                deadline_late_us_p99: 1980,
                deadline_late_us_max: 2000,
                syncs: 1001,
                sync_late_us_p50: 700,
                sync_late_us_p99: 1190,
                sync_late_us_max: 1200,
                syncs_late: 200,
                sync_late_limit_us: 1000,
                set_point_us_p50: 250,
                set_point_us_p99: 495,
                set_point_us_max: 500,
                syncs_skipped: 3,
                feedback_missed: 0,
                frames_dropped: None,
                record_ns_p50: 0,
                record_ns_p99: 0,
                record_ns_max: 0,
                realtime: None,
            }
        );
        assert_eq!(
            report.to_string(),
            "SYNC late by 0.70 ms (median), 1.19 (99 %), 1.20 (at most); 200 of 1001 over 1.00 ms, \
             3 skipped"
        );
    }

    #[test]
    fn figures_of_a_long_run_are_true_to_a_thousandth_part() {
        let mut took = Lateness::default();
        (1..=100_000).for_each(|n| took.note_ns(Duration::from_nanos(n * 17)));
        took.note_ns(Duration::from_secs(5));
        let [p50, p99, max] = took.figures().map(f64::from);
        assert!((p50 / 850_017.0 - 1.0).abs() < 1e-3, "{p50}");
        assert!((p99 / 1_683_017.0 - 1.0).abs() < 1e-3, "{p99}");
        assert_eq!((max, took.count()), (f64::from(u32::MAX), 100_001));
    }
}
