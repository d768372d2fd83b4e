//! Heartbeats of the recording threads, and the watchdog that reports a thread that stalls, fails or loses items.

use super::TelemetryError;
use std::mem;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// After this long without a heartbeat, a stalled thread is reported to the operator.
const WARN_AFTER: Duration = Duration::from_millis(700);
/// After this long without a heartbeat, a thread is given up.
pub(super) const STALL_TIMEOUT: Duration = Duration::from_secs(5);
/// Minimum interval between two warnings of dropped records.
const DROP_WARNING_INTERVAL: Duration = Duration::from_secs(1);

/// The state of a recording thread, shared without a lock.
#[derive(Debug, Default)]
pub(super) struct ThreadStatus {
    /// Number of heartbeats so far.
    pub(super) beats: AtomicU64,
    /// The reason of the first failure.
    pub(super) fault: OnceLock<String>,
}

impl ThreadStatus {
    /// A heartbeat: sent at every tick, and while the files are completed.
    pub(super) fn beat(&self) {
        self.beats.fetch_add(1, Ordering::Relaxed);
    }
}

/// At most this much of the time between two checks counts as time without a heartbeat, since the watcher itself may
/// have been descheduled or stopped by a debugger.
const CHECK_GAP_MAX: Duration = Duration::from_millis(50);

/// Measures the time since a thread's last heartbeat, without the watcher's own stalls.
#[derive(Debug)]
pub(super) struct StallTimer {
    beats: u64,
    last_check: Instant,
    /// The time without a heartbeat, up to the last check.
    stalled: Duration,
}

impl StallTimer {
    /// Starts at `now`.
    pub(super) fn new(now: Instant) -> Self {
        StallTimer { beats: 0, last_check: now, stalled: Duration::ZERO }
    }

    /// Checks the thread at `now`. Returns the time since its last heartbeat.
    pub(super) fn stalled_for(&mut self, status: &ThreadStatus, now: Instant) -> Duration {
        let elapsed = now.saturating_duration_since(mem::replace(&mut self.last_check, now));
        let beats = status.beats.load(Ordering::Relaxed);
        let is_alive = mem::replace(&mut self.beats, beats) != beats;
        self.stalled =
            if is_alive { Duration::ZERO } else { self.stalled + elapsed.min(CHECK_GAP_MAX) };
        self.stalled
    }
}

/// A change in the state of the recording.
#[derive(Debug)]
pub enum RecordNews {
    /// A warning to the operator: nothing is lost yet, or the loss is counted.
    Warning(String),
    /// From now on records are lost.
    Failed(String),
}

/// The health of a thread, from good to bad.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
enum Health {
    Alive,
    Stalled,
    GivenUp,
    Failed,
}

/// Watches one recording thread.
#[derive(Debug)]
pub(super) struct Watchdog {
    pub(super) writer: &'static str,
    /// The items that it takes.
    items: &'static str,
    stall_timer: StallTimer,
    /// The last health that was reported.
    health: Health,
    /// The number of lost items in the last report, and its time.
    reported_drops: Option<(u64, Instant)>,
}

impl Watchdog {
    /// Watches `writer`, which takes `items`, from `now` on.
    pub(super) fn new(writer: &'static str, items: &'static str, now: Instant) -> Self {
        let (stall_timer, health) = (StallTimer::new(now), Health::Alive);
        Watchdog { writer, items, stall_timer, health, reported_drops: None }
    }

    /// The change of the thread's health by `now`.
    pub(super) fn health_news(
        &mut self,
        status: &ThreadStatus,
        now: Instant,
    ) -> Option<RecordNews> {
        let before_s = self.stall_timer.stalled.as_secs_f64();
        let (writer, stalled) = (self.writer, self.stall_timer.stalled_for(status, now));
        let health = match status.fault.get() {
            Some(_) => Health::Failed,
            None if stalled > STALL_TIMEOUT => Health::GivenUp,
            None if stalled > WARN_AFTER => Health::Stalled,
            None => Health::Alive,
        };
        if mem::replace(&mut self.health, health) == health {
            return None;
        }
        let text = match (health, status.fault.get()) {
            (Health::Alive, _) => format!("{writer}: alive again after {before_s:.1} s"),
            (_, Some(reason)) => TelemetryError::writer_failed(writer, reason).to_string(),
            _ => TelemetryError::writer_stalled(writer, stalled, STALL_TIMEOUT).to_string(),
        };
        let is_failed = health >= Health::GivenUp;
        Some(if is_failed { RecordNews::Failed(text) } else { RecordNews::Warning(text) })
    }

    /// The report at `now` of newly lost items, if any; `dropped` items were lost so far because the queue was full.
    pub(super) fn drop_news(&mut self, dropped: u64, now: Instant) -> Option<RecordNews> {
        let (before, is_recent) = self.reported_drops.map_or((0, false), |(drops, time)| {
            (drops, now.saturating_duration_since(time) < DROP_WARNING_INTERVAL)
        });
        if dropped == before || is_recent {
            return None;
        }
        let is_first = self.reported_drops.replace((dropped, now)).is_none();
        let (writer, items, more) = (self.writer, self.items, dropped - before);
        Some(match is_first && self.health < Health::GivenUp {
            true => RecordNews::Failed(format!(
                "{writer}: {items} lost: {dropped}, its queue is full; is the disk too slow for this run?"
            )),
            false => RecordNews::Warning(format!(
                "{writer}: {items} lost: {more} more, {dropped} in all"
            )),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A thread, and a watcher that checks it every `every_ms`.
    struct Watched {
        status: ThreadStatus,
        watch: Watchdog,
        now: Instant,
        every_ms: u64,
    }

    impl Watched {
        fn new(every_ms: u64) -> Self {
            let now = Instant::now();
            Watched {
                status: ThreadStatus::default(),
                watch: Watchdog::new("text files", "records", now),
                now,
                every_ms,
            }
        }

        /// The reports of the next `ms`, each with its time in ms.
        fn reports_of_next(&mut self, ms: u64, dropped: u64) -> Vec<(u64, String)> {
            let mut reports = Vec::new();
            for n in 1..=ms / self.every_ms {
                self.now += Duration::from_millis(self.every_ms);
                let health = self.watch.health_news(&self.status, self.now);
                let drops = self.watch.drop_news(dropped, self.now);
                for news in health.into_iter().chain(drops) {
                    let text = match news {
                        RecordNews::Warning(text) => text,
                        RecordNews::Failed(error) => format!("failed: {error}"),
                    };
                    reports.push((n * self.every_ms, text));
                }
            }
            reports
        }
    }

    #[test]
    fn a_stall_is_reported_within_a_second_and_given_up_after_five() {
        let mut watched = Watched::new(5);
        watched.status.beat();
        let reports = watched.reports_of_next(10_000, 0);
        let stalled = "text files: no sign of life for 0.7 s (given up after 5.0); is the disk \
                      stalled?";
        assert_eq!(reports[0], (710, stalled.to_owned()));
        assert!(reports[1].1.starts_with("failed: text files: no sign of life for 5.0 s"));
        assert_eq!((reports.len(), reports[1].0), (2, 5010));
        watched.status.beat();
        let reports = watched.reports_of_next(100, 0);
        assert_eq!(reports, [(5, "text files: alive again after 10.0 s".to_owned())]);
    }

    #[test]
    fn a_watcher_that_was_descheduled_raises_no_alarm() {
        let mut watched = Watched::new(3000);
        watched.status.beat();
        assert_eq!(watched.reports_of_next(30_000, 0), []);
    }

    #[test]
    fn a_thread_that_beats_raises_no_alarm() {
        let mut watched = Watched::new(50);
        for _ in 0..100 {
            watched.status.beat();
            assert_eq!(watched.reports_of_next(600, 0), []);
        }
    }

    #[test]
    fn a_fault_is_reported_once() {
        let mut watched = Watched::new(5);
        watched.status.fault.set("no space left".to_owned()).unwrap();
        watched.status.fault.set("and again".to_owned()).unwrap_err();
        let said = "failed: text files: no space left; what follows is not recorded";
        assert_eq!(watched.reports_of_next(1000, 0), [(5, said.to_owned())]);
    }

    #[test]
    fn lost_records_are_a_failure_once_and_then_a_warning() {
        let mut watched = Watched::new(50);
        watched.status.beat();
        let reports = watched.reports_of_next(100, 3);
        let said = "failed: text files: records lost: 3, its queue is full; is the disk too slow for \
                    this run?";
        assert_eq!(reports, [(50, said.to_owned())]);
        let mut reports = Vec::new();
        for _ in 0..12 {
            watched.status.beat();
            reports.extend(watched.reports_of_next(100, 4).into_iter().map(|(_, text)| text));
        }
        assert_eq!(reports, ["text files: records lost: 1 more, 4 in all"]);
    }

    #[test]
    fn lost_records_are_reported_once_a_second() {
        let mut watched = Watched::new(50);
        let mut reports = Vec::new();
        for dropped in 1..=20 {
            watched.status.beat();
            reports.extend(watched.reports_of_next(100, dropped));
        }
        let said: Vec<&str> = reports.iter().map(|(_, text)| text.as_str()).collect();
        assert_eq!(
            said,
            [
                "failed: text files: records lost: 1, its queue is full; is the disk too slow for this \
                 run?",
                "text files: records lost: 10 more, 11 in all",
            ]
        );
    }

    /// The disk of a stalled writer may turn out to be broken.
    #[test]
    fn a_fault_after_a_stall_is_reported_too() {
        let mut watched = Watched::new(5);
        let given_up = watched.reports_of_next(6000, 0).pop().expect("given up").1;
        assert!(
            given_up.starts_with("failed: text files: no sign of life for 5.0 s"),
            "{given_up}"
        );
        watched.status.fault.set("Input/output error".to_owned()).unwrap();
        let said = "failed: text files: Input/output error; what follows is not recorded";
        assert_eq!(watched.reports_of_next(1000, 0), [(5, said.to_owned())]);
    }

    #[test]
    fn a_silence_counts_only_the_time_that_the_watcher_ran() {
        let ms = Duration::from_millis;
        let begin = Instant::now();
        let status = ThreadStatus::default();
        let mut stall_timer = StallTimer::new(begin);
        assert_eq!(stall_timer.stalled_for(&status, begin + ms(30)), ms(30));
        // The watcher was suspended for ten seconds.
        assert_eq!(stall_timer.stalled_for(&status, begin + ms(10_030)), ms(80));
        status.beat();
        assert_eq!(stall_timer.stalled_for(&status, begin + ms(10_040)), ms(0));
    }
}
