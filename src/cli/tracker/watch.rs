//! `needle-bench tracker watch`: a line a second.

use super::listen::{Listener, listen};
use crate::cli::Failure;
use crate::cli::output::{number_in, say};
use crate::cli::sources::Configured;
use crate::config::TrackerConfig;
use crate::tracker::{AcquisitionClock, Event, Gate, GateCounts, Refusal};
use crate::units::Time;
use clap::Args;
use nalgebra::Vector3;
use std::process::ExitCode;
use std::time::Duration;

const LINE_PERIOD: Duration = Duration::from_secs(1);

#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(flatten)]
    configured: Configured,
    /// How long to watch, s; by default until Ctrl-C.
    #[arg(long, value_name = "SECONDS", value_parser = number_in(0.1..=1e6, "seconds"))]
    seconds: Option<f64>,
}

/// What came of the tool, as a run would judge each sample by itself.
struct Watch {
    gate: Gate,
    /// The frame of the positions.
    frame: &'static str,
    dates: AcquisitionClock,
    counts: GateCounts,
    /// The last position, and when it was measured.
    last: Option<(Time, Vector3<f64>)>,
    refusal: Option<Refusal>,
    /// Since the last line.
    positions: u64,
}

impl Watch {
    /// Positions are on the bench where the tracker is registered, else in the tracker's own frame.
    fn new(tracker: &TrackerConfig) -> Self {
        let registered = tracker.to_gate().ok();
        let frame = if registered.is_some() { "bench" } else { "tracker, not registered" };
        let gate = registered.unwrap_or_else(|| tracker.to_unregistered_gate());
        Watch {
            gate,
            frame,
            dates: tracker.to_clock(),
            counts: GateCounts::default(),
            last: None,
            refusal: None,
            positions: 0,
        }
    }

    fn take(&mut self, event: &Event) {
        match event {
            Event::Connected { .. } => self.dates.reconnected(),
            Event::Sample(sample) => {
                let admitted = self.gate.admit(sample).and_then(|position_mm| {
                    let time = self.dates.acquisition_time(sample)?;
                    // A value that is sent again is no new measurement, whatever its stamp.
                    match self.last {
                        Some((_, last_mm)) if last_mm == position_mm => Err(Refusal::repeat(2)),
                        _ => Ok((time, position_mm)),
                    }
                });
                self.counts.count(admitted.as_ref().err());
                match admitted {
                    Ok(position) => {
                        self.last = Some(position);
                        self.positions += 1;
                    }
                    Err(refusal) => self.refusal = Some(refusal),
                }
            }
            _ => {}
        }
    }

    /// The line of the last `seconds`.
    fn line(&mut self, now: Time, seconds: f64, listener: &mut Listener) -> String {
        let at = now.as_secs_f64();
        let Some((time, p_mm)) = self.last else {
            let refusal = self.refusal.take().map(|refusal| format!("tracker: {refusal}"));
            return format!("{at:7.1} s  {}", refusal.unwrap_or_else(|| listener.missing()));
        };
        let rate_hz = std::mem::take(&mut self.positions) as f64 / seconds;
        let refusal = self.refusal.take().map(|refusal| format!("; {refusal}")).unwrap_or_default();
        format!(
            "{at:7.1} s  x {:.2} y {:.2} z {:.2} mm ({})  {rate_hz:.1} Hz  age {:.3} s  {}{refusal}",
            p_mm.x,
            p_mm.y,
            p_mm.z,
            self.frame,
            now.seconds_after(time),
            self.counts
        )
    }
}

pub(super) fn watch(arguments: &Arguments) -> Result<ExitCode, Failure> {
    let mut listener = listen(&arguments.configured, false)?;
    let mut watch = Watch::new(&listener.config.tracker);
    let start = listener.now();
    let end = arguments.seconds.map_or(Time::NEVER, |s| start + Duration::from_secs_f64(s));
    let mut last_line = start;
    while !listener.is_over() && listener.now() < end {
        let due = (last_line + LINE_PERIOD).min(end);
        while let Some(event) = listener.next(due) {
            watch.take(&event);
        }
        let now = listener.now();
        if now >= due || watch.positions > 0 {
            say(watch.line(now, now.seconds_after(last_line).max(1e-3), &mut listener))?;
        }
        last_line = now;
    }
    match watch.last {
        Some(_) => Ok(ExitCode::SUCCESS),
        None => Err(listener.nothing()),
    }
}
