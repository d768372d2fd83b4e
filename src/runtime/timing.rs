//! The clock of a live run, and statistics of its punctuality.

use super::realtime::RealTime;
use crate::stage::Counters;
use crate::units::Time;
use hdrhistogram::Histogram;
use nix::time::{ClockId, clock_gettime};
use serde::Serialize;
use std::fmt;
use std::time::{Duration, SystemTime};

/// A monotonic clock whose origin is known in UTC. It also counts the time for which the machine is suspended. An
/// [`Instant`](std::time::Instant) does not, so a run would not notice that it was suspended.
#[derive(Debug, Clone, Copy)]
pub struct Clock {
    origin_since_boot: Duration,
    origin_utc: SystemTime,
}

fn since_boot() -> Duration {
    clock_gettime(ClockId::CLOCK_BOOTTIME).expect("Linux has this clock").into()
}

impl Clock {
    /// A clock that starts at [`Time::ZERO`] now.
    pub fn start() -> Self {
        Clock { origin_since_boot: since_boot(), origin_utc: SystemTime::now() }
    }

    /// The present time.
    pub fn now(&self) -> Time {
        Time::ZERO + (since_boot() - self.origin_since_boot)
    }

    /// The origin, UTC.
    pub fn origin_utc(&self) -> SystemTime {
        self.origin_utc
    }
}

/// A SYNC that leaves later than this is counted: a tenth of the usual period of 10 ms.
const SYNC_LATE_LIMIT_US: u32 = 1000;

/// Timing statistics of the control thread, which sends the SYNCs (with `--realtime` called the SYNC
/// thread).
#[derive(Debug, Clone, Default)]
pub(super) struct TimingFigures {
    /// How late the thread handled its deadlines, µs.
    pub(super) deadline_lateness: DurationHistogram,
    /// How late SYNCs were handed to the bus, µs.
    sync_lateness: DurationHistogram,
    /// SYNCs that left later than [`SYNC_LATE_LIMIT_US`].
    syncs_over_limit: u64,
    /// From the arrival of the feedback to the hand-over of the set-points, µs.
    pub(super) set_point_delay: DurationHistogram,
}

/// A histogram of durations in whole µs, or ns, accurate to one part in a thousand.
///
/// It allocates all its memory at the start: adding a value never allocates.
#[derive(Debug, Clone)]
pub(super) struct DurationHistogram {
    histogram: Histogram<u32>,
    max: u32,
}

impl Default for DurationHistogram {
    fn default() -> Self {
        let histogram = Histogram::new_with_max(u32::MAX.into(), 3);
        let histogram = histogram.expect("a range above 2 takes three digits");
        DurationHistogram { histogram, max: 0 }
    }
}

impl DurationHistogram {
    /// Adds a duration in µs.
    pub(super) fn add_us(&mut self, duration: Duration) {
        self.add(duration.as_micros());
    }

    /// Adds a duration in ns; one above 4.29 s counts as 4.29 s.
    pub(super) fn add_ns(&mut self, duration: Duration) {
        self.add(duration.as_nanos());
    }

    fn add(&mut self, value: u128) {
        let value = u32::try_from(value).unwrap_or(u32::MAX);
        self.histogram.saturating_record(value.into());
        self.max = self.max.max(value);
    }

    fn count(&self) -> u64 {
        self.histogram.len()
    }

    /// Median, 99th percentile and maximum; zeros if the histogram is empty.
    fn figures(&self) -> [u32; 3] {
        // The histogram returns the upper end of a bin, which may be above the maximum.
        let at = |quantile| {
            let value = self.histogram.value_at_quantile(quantile);
            u32::try_from(value).unwrap_or(u32::MAX).min(self.max)
        };
        [at(0.5), at(0.99), self.max]
    }
}

/// How punctual a run was: part of its manifest, times in µs.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct TimingReport {
    /// Deadlines that the thread handled, including those of the SYNCs.
    pub deadlines: u64,
    /// Lateness at a deadline: median.
    pub deadline_late_us_p50: u32,
    /// 99th percentile.
    pub deadline_late_us_p99: u32,
    /// Maximum.
    pub deadline_late_us_max: u32,
    /// SYNCs sent.
    pub syncs: u64,
    /// Lateness of a SYNC, from when it was due to when it was handed to the bus: median.
    pub sync_late_us_p50: u32,
    /// 99th percentile.
    pub sync_late_us_p99: u32,
    /// Maximum.
    pub sync_late_us_max: u32,
    /// SYNCs that left later than [`sync_late_limit_us`](Self::sync_late_limit_us).
    pub syncs_late: u64,
    /// The limit, the same for every run, so that runs can be compared.
    pub sync_late_limit_us: u32,
    /// Set-point delay, from when the feedback arrived (by the kernel's receive timestamp, if there is
    /// one) to when the set-points computed from it were handed to the bus: median.
    pub set_point_us_p50: u32,
    /// 99th percentile.
    pub set_point_us_p99: u32,
    /// Maximum.
    pub set_point_us_max: u32,
    /// SYNC periods skipped because the bench was late.
    pub syncs_skipped: u64,
    /// SYNCs that went out without both positions coming back.
    pub feedback_missed: u64,
    /// Received frames that were lost before the bench read them; `None` if the bus does not count them.
    pub frames_dropped: Option<u64>,
    /// How long the control thread took to hand a record to the writer, ns: median.
    pub record_ns_p50: u32,
    /// 99th percentile.
    pub record_ns_p99: u32,
    /// Maximum.
    pub record_ns_max: u32,
    /// Priority and processor of the control thread; `None` without `--realtime`.
    pub realtime: Option<RealTime>,
}

impl TimingReport {
    /// The report, completed with the times that the thread took to hand records to the writer.
    pub(super) fn with_record_times(self, record_times: &DurationHistogram) -> Self {
        let [record_ns_p50, record_ns_p99, record_ns_max] = record_times.figures();
        TimingReport { record_ns_p50, record_ns_p99, record_ns_max, ..self }
    }
}

impl TimingFigures {
    /// Notes a SYNC that was handed to the bus `late` after it was due.
    pub(super) fn note_sync(&mut self, late: Duration) {
        self.sync_lateness.add_us(late);
        let limit = Duration::from_micros(SYNC_LATE_LIMIT_US.into());
        self.syncs_over_limit += u64::from(late > limit);
    }

    /// The figures, with what the stage counted.
    pub(super) fn report(&self, counters: Counters) -> TimingReport {
        let [deadline_late_us_p50, deadline_late_us_p99, deadline_late_us_max] =
            self.deadline_lateness.figures();
        let [sync_late_us_p50, sync_late_us_p99, sync_late_us_max] = self.sync_lateness.figures();
        let [set_point_us_p50, set_point_us_p99, set_point_us_max] = self.set_point_delay.figures();
        TimingReport {
            deadlines: self.deadline_lateness.count(),
            deadline_late_us_p50,
            deadline_late_us_p99,
            deadline_late_us_max,
            syncs: self.sync_lateness.count(),
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
            ..TimingReport::default()
        }
    }
}

/// One line for the operator.
impl fmt::Display for TimingReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ms = |us: u32| f64::from(us) * 1e-3;
        write!(
            f,
            "SYNC late by {:.2} ms (median), {:.2} (99th percentile), {:.2} (maximum); {} of {} \
             over {:.2} ms, {} skipped",
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
            timing.deadline_lateness.add_us(Duration::from_micros(2 * us));
            timing.note_sync(Duration::from_micros(us + 200));
            timing.set_point_delay.add_us(Duration::from_micros(us / 2));
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
                ..TimingReport::default()
            }
        );
        assert_eq!(
            report.to_string(),
            "SYNC late by 0.70 ms (median), 1.19 (99th percentile), 1.20 (maximum); 200 of 1001 \
             over 1.00 ms, 3 skipped"
        );
    }

    #[test]
    fn figures_of_a_long_run_are_accurate_to_one_part_in_a_thousand() {
        let mut took = DurationHistogram::default();
        (1..=100_000).for_each(|n| took.add_ns(Duration::from_nanos(n * 17)));
        took.add_ns(Duration::from_secs(5));
        let [p50, p99, max] = took.figures().map(f64::from);
        assert!((p50 / 850_017.0 - 1.0).abs() < 1e-3, "{p50}");
        assert!((p99 / 1_683_017.0 - 1.0).abs() < 1e-3, "{p99}");
        assert_eq!((max, took.count()), (f64::from(u32::MAX), 100_001));
    }
}
