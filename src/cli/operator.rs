//! What the operator sees while a run goes on: a progress bar and the events, on stderr.

use crate::runtime::Operator;
use crate::session::{Lane, Progress, Severity};
use crate::units::Time;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::IsTerminal;

/// A terminal with a progress bar; without a terminal, lines for what matters alone.
pub(super) struct Terminal {
    bar: ProgressBar,
    severity_min: Severity,
}

impl Terminal {
    /// Shows everything, or warnings and faults only when `quiet`.
    pub(super) fn new(quiet: bool) -> Self {
        let shown = std::io::stderr().is_terminal() && !quiet;
        let target =
            if shown { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() };
        let bar = ProgressBar::with_draw_target(None, target);
        if let Ok(style) = ProgressStyle::with_template(
            "{msg:>10} {bar:40.cyan/blue} {pos:>6}/{len} µm  {elapsed_precise}",
        ) {
            bar.set_style(style);
        }
        bar.set_message("preparing");
        Terminal { bar, severity_min: if quiet { Severity::Warning } else { Severity::Info } }
    }

    /// Removes the bar.
    pub(super) fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

impl Operator for Terminal {
    fn progress(&mut self, progress: Progress) {
        if progress.insertion_meas_mm > 0.0 {
            self.bar.set_message("inserting");
        }
        self.bar.set_length((progress.depth_mm * 1e3) as u64);
        self.bar.set_position((progress.insertion_meas_mm.max(0.0) * 1e3) as u64);
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
        let line = format!("{:>9.3} s  {lane}: {mark}{text}", time.as_secs_f64());
        if self.bar.is_hidden() {
            eprintln!("{line}");
        } else {
            self.bar.println(line);
        }
    }
}
