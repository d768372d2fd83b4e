//! What the operator sees on stderr during a run without the console: a line of progress, and the events.

use super::console::minutes;
use super::output::{plain, print_stderr};
use crate::runtime::Operator;
use crate::session::{Lane, Progress, Severity, State};
use crate::text::wrapped;
use crate::units::Time;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use rtrb::{Consumer, Producer, RingBuffer};
use std::io::IsTerminal;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

/// Capacity of the queue of events.
const QUEUE: usize = 1024;
/// Interval at which the queue is emptied and the line of progress refreshed.
const REFRESH: Duration = Duration::from_millis(100);
/// Depth between two lines of progress without a terminal, mm.
const LINE_MM: f64 = 10.0;
/// How long the end of a run waits for the remaining output.
const FINISH: Duration = Duration::from_secs(1);

/// Prints a line for each event. A terminal has the progress in its last line; elsewhere a line is printed every
/// 10 mm.
///
/// A separate thread prints, so a blocked stderr never delays the control thread. Events that find
/// the queue full are dropped and counted.
pub(super) struct Terminal {
    /// This ring never blocks: the control thread does not wait for a preempted printing thread
    /// (docs/decisions/0018-tracker-queue.md).
    events: Producer<String>,
    /// Closed when everything is printed; nothing is ever sent.
    done: Receiver<()>,
    latest: Arc<Latest>,
    severity_min: Severity,
    /// Depth at which the next line of progress is due, mm; `None` with a terminal or without progress.
    line_due_mm: Option<f64>,
}

/// State shared with the printing thread.
#[derive(Default)]
struct Latest {
    progress: Mutex<Progress>,
    dropped: AtomicU64,
}

impl Terminal {
    /// Shows all events, or only warnings and faults if `quiet`; and the progress if `has_progress`.
    pub(super) fn new(quiet: bool, has_progress: bool) -> Self {
        let is_terminal = std::io::stderr().is_terminal();
        let (events, mut queue) = RingBuffer::new(QUEUE);
        let (printing, done) = sync_channel::<()>(0);
        let latest = Arc::new(Latest::default());
        let seen = Arc::clone(&latest);
        // If the thread cannot start, events are dropped; the run does not depend on them.
        let _ = thread::Builder::new().name("operator".to_owned()).spawn(move || {
            print(&mut queue, &seen, &progress_line(has_progress && is_terminal));
            drop(printing);
        });
        let severity_min = if quiet { Severity::Warning } else { Severity::Info };
        let line_due_mm = (has_progress && !is_terminal).then_some(LINE_MM);
        Terminal { events, done, latest, severity_min, line_due_mm }
    }

    fn print(&mut self, line: String) {
        if self.events.is_abandoned() || self.events.push(line).is_err() {
            self.latest.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Waits briefly until everything is printed, then removes the line of progress.
    pub(super) fn finish(self) {
        drop(self.events);
        let _ = self.done.recv_timeout(FINISH);
    }
}

impl Operator for Terminal {
    fn progress(&mut self, progress: Progress) {
        // If the printing thread has the lock, this progress is skipped; the next one follows soon.
        if let Ok(mut latest) = self.latest.progress.try_lock() {
            *latest = progress;
        }
        let is_due = |due_mm: &f64| progress.insertion_meas_mm >= *due_mm;
        if self.line_due_mm.as_ref().is_some_and(is_due) {
            self.line_due_mm =
                Some(((progress.insertion_meas_mm / LINE_MM).floor() + 1.0) * LINE_MM);
            self.print(format!("{:>9.3} s  {}", progress.time.as_secs_f64(), line(&progress)));
        }
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
        self.print(line);
    }
}

fn progress_line(is_shown: bool) -> ProgressBar {
    let target = if is_shown { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() };
    let style = ProgressStyle::with_template("{wide_msg}");
    let style = style.unwrap_or_else(|_| ProgressStyle::default_spinner());
    ProgressBar::with_draw_target(None, target).with_style(style)
}

/// Prints until the run closes the queue.
fn print(queue: &mut Consumer<String>, latest: &Latest, bar: &ProgressBar) {
    loop {
        // Read before the queue is emptied: the last line may come just before the queue is closed.
        let is_closed = queue.is_abandoned();
        while let Ok(line) = queue.pop() {
            if bar.is_hidden() { print_stderr(line) } else { bar.println(wrapped(&line)) }
        }
        if is_closed {
            break;
        }
        let progress = latest.progress.try_lock().map(|latest| *latest);
        if let Ok(progress) = progress {
            bar.set_message(line(&progress));
        }
        thread::sleep(REFRESH);
    }
    bar.finish_and_clear();
    let dropped = latest.dropped.load(Ordering::Relaxed);
    if dropped > 0 {
        print_stderr(format_args!("{dropped} messages were not shown: stderr did not keep up"));
    }
}

/// For example `inserting  123.4/250.0 mm  x -0.12 mm  roll 12°  tip 0.03 s  1:03 to go`.
fn line(progress: &Progress) -> String {
    let Progress { insertion_meas_mm, depth_mm, x_mm, roll_rad, tip_age_s, remaining_s, .. } =
        progress;
    let state = match progress.state {
        State::Holding => "held by tracker",
        state => state.as_str(),
    };
    let known = |value: Option<String>| value.unwrap_or_else(|| "-".to_owned());
    let x = known(x_mm.map(|mm| format!("{mm:.2} mm")));
    let roll = known(roll_rad.map(|rad| format!("{:.0}°", rad.to_degrees())));
    let age = known(tip_age_s.map(|age_s| format!("{age_s:.2} s")));
    let to_go = known(remaining_s.map(minutes));
    format!(
        "{state}  {insertion_meas_mm:.1}/{depth_mm:.1} mm  x {x}  roll {roll}  tip {age}  {to_go} to go"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_is_one_line() {
        let progress = Progress {
            state: State::Inserting,
            insertion_meas_mm: 123.44,
            depth_mm: 250.0,
            x_mm: Some(-0.123),
            roll_rad: Some(0.2),
            tip_age_s: Some(0.031),
            remaining_s: Some(63.2),
            ..Progress::default()
        };
        let shown = "inserting  123.4/250.0 mm  x -0.12 mm  roll 11°  tip 0.03 s  1:03 to go";
        assert_eq!(line(&progress), shown);
        let held = Progress { state: State::Holding, depth_mm: 250.0, ..Progress::default() };
        assert_eq!(line(&held), "held by tracker  0.0/250.0 mm  x -  roll -  tip -  - to go");
    }

    /// Without a printing thread, events beyond the queue's capacity are counted and the caller
    /// does not block.
    #[test]
    fn a_terminal_that_prints_nothing_delays_nothing() {
        let (events, _queue) = RingBuffer::new(2);
        let (printing, done) = sync_channel(0);
        drop(printing);
        let latest = Arc::new(Latest::default());
        let mut terminal = Terminal {
            events,
            done,
            latest: Arc::clone(&latest),
            severity_min: Severity::Info,
            line_due_mm: Some(LINE_MM),
        };
        for _ in 0..5 {
            terminal.event(Time::ZERO, Lane::Session, Severity::Warning, "again");
        }
        for insertion_meas_mm in [-0.1, 9.9, 10.0, 10.1, 35.0, 36.0] {
            terminal.progress(Progress { insertion_meas_mm, ..Progress::default() });
        }
        // The queue holds 2 of 5 events; the lines at 10 mm and 35 mm do not fit either.
        assert_eq!(latest.dropped.load(Ordering::Relaxed), 3 + 2);
        terminal.finish();
    }
}
