//! What the operator sees during a run: a progress bar and the events, on stderr.

use super::output::{plain, tell};
use crate::runtime::Operator;
use crate::session::{Lane, Progress, Severity};
use crate::units::Time;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread;
use std::time::Duration;

/// Capacity of the queue of events.
const QUEUE: usize = 1024;
/// Refresh interval of the progress bar.
const REFRESH: Duration = Duration::from_millis(100);
/// How long the end of a run waits for the remaining output.
const FINISH: Duration = Duration::from_secs(1);

/// A progress bar on a terminal; otherwise only a line for each event.
///
/// A separate thread prints, so a blocked stderr never delays the control thread. Events that find
/// the queue full are dropped and counted.
pub(super) struct Terminal {
    events: SyncSender<String>,
    /// Closed when everything is printed; nothing is ever sent.
    done: Receiver<()>,
    latest: Arc<Latest>,
    severity_min: Severity,
}

/// State shared with the printing thread.
#[derive(Default)]
struct Latest {
    depth_um: AtomicU64,
    insertion_um: AtomicU64,
    dropped: AtomicU64,
}

impl Terminal {
    /// Shows everything, or warnings and faults only when `quiet`; with a progress bar if `bar`.
    pub(super) fn new(quiet: bool, bar: bool) -> Self {
        let (events, queue) = sync_channel(QUEUE);
        let (printing, done) = sync_channel::<()>(0);
        let latest = Arc::new(Latest::default());
        let seen = Arc::clone(&latest);
        // If the thread cannot start, events are dropped; the run does not depend on them.
        let _ = thread::Builder::new().name("operator".to_owned()).spawn(move || {
            print(&queue, &seen, &progress_bar(bar));
            drop(printing);
        });
        let severity_min = if quiet { Severity::Warning } else { Severity::Info };
        Terminal { events, done, latest, severity_min }
    }

    /// Waits briefly until everything is printed, then removes the bar.
    pub(super) fn finish(self) {
        drop(self.events);
        let _ = self.done.recv_timeout(FINISH);
    }
}

impl Operator for Terminal {
    fn progress(&mut self, progress: Progress) {
        // The cast saturates at 0 and at the maximum.
        let um = |mm: f64| (mm * 1e3) as u64;
        self.latest.depth_um.store(um(progress.depth_mm), Ordering::Relaxed);
        self.latest.insertion_um.store(um(progress.insertion_meas_mm), Ordering::Relaxed);
    }

    fn event(&mut self, time: Time, lane: Lane, severity: Severity, text: &str) {
        if severity < self.severity_min {
            return;
        }
        let mark = match severity {
            Severity::Info => "",
            Severity::Warning => "warning: ",
            Severity::Fault => "fault: ",
        };
        let text = plain(text, "");
        let line = format!("{:>9.3} s  {lane}: {mark}{text}", time.as_secs_f64());
        if self.events.try_send(line).is_err() {
            self.latest.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }
}

fn progress_bar(wanted: bool) -> ProgressBar {
    let shown = std::io::stderr().is_terminal() && wanted;
    let target = if shown { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() };
    let bar = ProgressBar::with_draw_target(None, target);
    if let Ok(style) =
        ProgressStyle::with_template("{prefix:>10} {bar:40.cyan/blue} {msg}  {elapsed_precise}")
    {
        bar.set_style(style);
    }
    bar.set_prefix("preparing");
    bar
}

/// Prints until the run closes the queue.
fn print(queue: &Receiver<String>, latest: &Latest, bar: &ProgressBar) {
    loop {
        match queue.recv_timeout(REFRESH) {
            Ok(line) if bar.is_hidden() => tell(line),
            Ok(line) => bar.println(line),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => break,
        }
        refresh(bar, latest);
    }
    bar.finish_and_clear();
    let dropped = latest.dropped.load(Ordering::Relaxed);
    if dropped > 0 {
        tell(format_args!("{dropped} messages were not shown: stderr did not keep up"));
    }
}

fn refresh(bar: &ProgressBar, latest: &Latest) {
    let depth_um = latest.depth_um.load(Ordering::Relaxed);
    let insertion_um = latest.insertion_um.load(Ordering::Relaxed);
    if insertion_um > 0 {
        bar.set_prefix("inserting");
    }
    bar.set_length(depth_um);
    bar.set_position(insertion_um);
    bar.set_message(in_mm(insertion_um, depth_um));
}

/// For example `123.4 of 250.0 mm`.
fn in_mm(insertion_um: u64, depth_um: u64) -> String {
    format!("{:.1} of {:.1} mm", insertion_um as f64 * 1e-3, depth_um as f64 * 1e-3)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_reads_in_mm() {
        assert_eq!(in_mm(123_400, 250_000), "123.4 of 250.0 mm");
    }

    /// Without a printing thread, events beyond the queue's capacity are counted and the caller
    /// does not block.
    #[test]
    fn a_terminal_that_prints_nothing_holds_nothing_up() {
        let (events, _queue) = sync_channel(2);
        let (printing, done) = sync_channel(0);
        drop(printing);
        let latest = Arc::new(Latest::default());
        let mut terminal =
            Terminal { events, done, latest: Arc::clone(&latest), severity_min: Severity::Info };
        for _ in 0..5 {
            terminal.event(Time::ZERO, Lane::Session, Severity::Warning, "again");
        }
        terminal.progress(Progress { insertion_meas_mm: -0.1, ..Progress::default() });
        assert_eq!(latest.insertion_um.load(Ordering::Relaxed), 0);
        assert_eq!(latest.dropped.load(Ordering::Relaxed), 3);
        terminal.finish();
    }
}
