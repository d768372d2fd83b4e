//! `needle-bench tracker watch`: one line a second on the configured tool.

use super::{Listener, RATE_TIME_MIN_S, listen};
use crate::cli::arguments::{Configured, number_in};
use crate::cli::output::{has_no_reader, print_stdout};
use crate::cli::{Failure, Result};
use crate::config::TrackerSection;
use crate::tracker::{AcquisitionClock, Event, Gate, GateCounts, Refusal};
use crate::units::Time;
use clap::Args;
use nalgebra::Vector3;
use std::io;
use std::time::Duration;

const LINE_PERIOD: Duration = Duration::from_secs(1);

#[derive(Debug, Args)]
pub(in crate::cli) struct WatchArguments {
    #[command(flatten)]
    configured: Configured,
    /// How long to watch, s; by default until Ctrl-C.
    #[arg(long, value_name = "SECONDS", value_parser = number_in(0.1..=1e6, "seconds"))]
    seconds: Option<f64>,
}

/// The tool's samples, each judged by itself as in a run.
struct Watch {
    gate: Gate,
    /// The frame of the positions.
    frame: &'static str,
    clock: AcquisitionClock,
    counts: GateCounts,
    /// The last position, and when it was measured.
    last: Option<(Time, Vector3<f64>)>,
    /// How often that position has come in a row.
    repeats: u32,
    /// Why the newest sample or message was refused, since the last line.
    refusal: Option<String>,
    /// The newest refusal, for the end.
    last_refusal: Option<Refusal>,
    /// Messages that could not be read.
    malformed: u64,
    /// Accepted positions since the last line.
    positions: u64,
}

impl Watch {
    /// Positions are in the bench frame if the tracker is registered, else in the tracker's own frame.
    fn new(tracker: &TrackerSection) -> Self {
        let registered = tracker.to_gate().ok();
        let frame = if registered.is_some() { "bench" } else { "tracker, not registered" };
        let gate = registered.unwrap_or_else(|| tracker.to_unregistered_gate());
        Watch {
            gate,
            frame,
            clock: AcquisitionClock::new(tracker.stamp, tracker.latency),
            counts: GateCounts::default(),
            last: None,
            repeats: 0,
            refusal: None,
            last_refusal: None,
            malformed: 0,
            positions: 0,
        }
    }

    fn take(&mut self, event: &Event) {
        let sample = match event {
            Event::Connected { .. } => return self.clock.reconnected(),
            Event::Sample(sample) => sample,
            Event::Malformed(error) => {
                self.malformed += 1;
                self.refusal = Some(format!("a message cannot be read: {error}"));
                return;
            }
            _ => return,
        };
        let admitted = self.gate.admit(sample).and_then(|position_mm| {
            let time = self.clock.acquisition_time(sample)?;
            // A repeated value is not a new measurement, whatever its stamp.
            if self.last.is_some_and(|(_, last_mm)| last_mm == position_mm) {
                self.repeats += 1;
                return Err(Refusal::repeat(self.repeats));
            }
            self.repeats = 1;
            Ok((time, position_mm))
        });
        self.counts.count(admitted.as_ref().err());
        match admitted {
            Ok(position) => {
                self.last = Some(position);
                self.positions += 1;
            }
            Err(refusal) => {
                self.refusal = Some(refusal.to_string());
                self.last_refusal = Some(refusal);
            }
        }
    }

    /// The line at `now` for the last `seconds`.
    fn line(&mut self, now: Time, seconds: f64, listener: &mut Listener) -> String {
        let connection = listener.connection_trouble();
        if let Some(line) = self.position_line(now, seconds) {
            return line + &connection;
        }
        let why = match self.refusal.take() {
            Some(refusal) => format!("tracker: {refusal}{connection}"),
            None => listener.explain_missing(),
        };
        format!("{:7.1} s  {why}", now.as_secs_f64())
    }

    /// The same, if there was a position.
    fn position_line(&mut self, now: Time, seconds: f64) -> Option<String> {
        let (time, p_mm) = self.last?;
        let at = now.as_secs_f64();
        let positions = std::mem::take(&mut self.positions);
        let rate = match positions {
            1 if seconds < RATE_TIME_MIN_S => "1 position".to_owned(),
            _ if seconds < RATE_TIME_MIN_S => format!("{positions} positions"),
            _ => format!("{:.1} Hz", positions as f64 / seconds),
        };
        let refusal = self.refusal.take().map(|refusal| format!("; {refusal}")).unwrap_or_default();
        let malformed = match self.malformed {
            0 => String::new(),
            count => format!(", {count} not readable"),
        };
        Some(format!(
            "{at:7.1} s  x {:.2} y {:.2} z {:.2} mm ({})  {rate}  age {:.3} s  {}{malformed}{refusal}",
            p_mm.x,
            p_mm.y,
            p_mm.z,
            self.frame,
            now.seconds_after(time),
            self.counts
        ))
    }
}

pub(super) fn watch(arguments: &WatchArguments) -> Result<()> {
    let mut listener = listen(&arguments.configured, false)?;
    let mut watch = Watch::new(&listener.config.tracker);
    let start = listener.now();
    let end = arguments.seconds.map_or(Time::NEVER, |s| start + Duration::from_secs_f64(s));
    let mut last_line = start;
    while !listener.is_over() && listener.now() < end && !has_no_reader(&io::stdout()) {
        let due = (last_line + LINE_PERIOD).min(end);
        while let Some(event) = listener.next(due) {
            watch.take(&event);
        }
        let now = listener.now();
        if now >= due || watch.positions > 0 {
            print_stdout(watch.line(now, now.seconds_after(last_line), &mut listener))?;
        }
        last_line = now;
    }
    if has_no_reader(&io::stdout()) {
        return Ok(());
    }
    match (watch.last, watch.last_refusal) {
        (Some(_), _) => Ok(()),
        (None, Some(refusal)) => Err(Failure::environment(format_args!(
            "tracker: no position of \"{}\" was accepted; the last: {refusal}",
            listener.config.tracker.tool
        ))),
        (None, None) => Err(Failure::environment(listener.explain_missing())),
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::config::Config;
    use crate::tracker::Sample;

    pub(in crate::cli::tracker) fn sample(tool: &str) -> Sample {
        Sample {
            receive_time: Time::from_nanos(5),
            orientation: Some(Default::default()),
            ..Sample::valid(tool, Vector3::new(1.0, 2.0, 3.0))
        }
    }

    #[test]
    fn a_position_that_is_repeated_is_counted() {
        let tracker = Config::from_sources(&[], &[]).unwrap().tracker;
        let mut watch = Watch::new(&tracker);
        watch.gate = tracker.to_unregistered_gate();
        for _ in 0..3 {
            watch.take(&Event::Sample(sample(&tracker.tool)));
        }
        assert_eq!((watch.positions, watch.counts.refused()), (1, 2));
        let why = watch.refusal.expect("repeats are refused");
        assert!(why.contains("to the bit, 3 in a row"), "{why}");
    }

    /// A recording is over at once.
    #[test]
    fn a_rate_is_given_only_over_enough_time() {
        let tracker = Config::from_sources(&[], &[]).unwrap().tracker;
        for (seconds, rate) in [(1.0, "  1.0 Hz  age"), (1e-4, "  1 position  age")] {
            let mut watch = Watch::new(&tracker);
            watch.gate = tracker.to_unregistered_gate();
            watch.take(&Event::Sample(sample(&tracker.tool)));
            let line = watch.position_line(Time::from_nanos(5), seconds).expect("a position");
            assert!(line.contains(rate), "{line}");
        }
    }

    #[test]
    fn a_message_that_cannot_be_read_is_shown_beside_a_position() {
        let tracker = Config::from_sources(&[], &[]).unwrap().tracker;
        let mut watch = Watch::new(&tracker);
        watch.gate = tracker.to_unregistered_gate();
        watch.take(&Event::Sample(sample(&tracker.tool)));
        watch.take(&Event::Malformed("line 2: garbage".to_owned()));
        let line = watch.position_line(Time::from_nanos(5), 1.0).expect("a position was seen");
        let end =
            "1 accepted, 0 refused, 1 not readable; a message cannot be read: line 2: garbage";
        assert!(line.ends_with(end), "{line}");
    }
}
