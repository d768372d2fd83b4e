//! A session and the virtual stage in one thread, in virtual time: no sleeps, no sockets.

use super::emulated::Emulated;
use super::interrupt::Interrupt;
use super::sink::{RunReport, Sink};
use crate::canopen::Frame;
use crate::emulator::fault::{BusFault, Fault, FaultKind};
use crate::emulator::{StageOutput, TrackedTip, VirtualStage};
use crate::session::{Direction, Input, Lane, Output, Record, Session, Severity};
use crate::tracker::{Event, Sample, Validity};
use crate::transport::bus_error::BusError;
use crate::transport::can::CanError;
use crate::units::Time;
use serde_json::Map;

/// Runs `session` against `stage` until it ends. Frames and samples arrive the moment they are
/// sent, and time leaps to the next deadline of either. `tool` is the name of the tracked tip.
pub fn run_virtual(
    session: Session,
    stage: VirtualStage,
    tool: &str,
    sink: Sink<'_>,
    interrupt: &Interrupt,
) -> RunReport {
    let mut now = Time::ZERO;
    let mut stop_asked = false;
    let emulated = Emulated::new(&stage, now);
    let mut run = Virtual { session, stage, tool, sink, emulated };
    loop {
        run.settle(now);
        run.sink.progress(run.session.progress());
        if let Some(outcome) = run.session.outcome() {
            let report = run.sink.finish(outcome.clone(), now, Map::new());
            return RunReport { emulated: Some(run.emulated), ..report };
        }
        if !stop_asked && let Some(reason) = stop_reason(interrupt, &run.sink) {
            stop_asked = true;
            run.session.handle(now, Input::Stop(reason));
            continue;
        }
        now = now.max(run.session.deadline().min(run.stage.deadline()));
        if run.stage.deadline() <= now {
            run.stage.handle_timeout(now);
        }
        if run.session.deadline() <= now {
            run.session.handle(now, Input::Tick);
        }
    }
}

/// Why the runtime itself wants the run to end.
pub(super) fn stop_reason(interrupt: &Interrupt, sink: &Sink<'_>) -> Option<String> {
    if interrupt.is_raised() {
        return Some("operator: interrupted".to_owned());
    }
    sink.failure()
}

/// The interface's name in messages.
const INTERFACE: &str = "memory";

/// Both sides and what is told of them.
struct Virtual<'a, 's> {
    session: Session,
    stage: VirtualStage,
    tool: &'a str,
    sink: Sink<'s>,
    emulated: Emulated,
}

impl Virtual<'_, '_> {
    /// Carries everything that is under way at `now` until both sides are silent.
    fn settle(&mut self, now: Time) {
        loop {
            let mut quiet = true;
            let mut sent = None;
            while let Some(output) = self.session.poll() {
                quiet = false;
                match output {
                    // Recorded as sent once it is.
                    Output::Record(record @ Record::Can { direction: Direction::Sent, .. }) => {
                        sent = Some(record);
                    }
                    Output::Record(record) => self.record(now, record),
                    Output::Transmit(frame) => self.send(now, &frame, sent.take()),
                }
            }
            while let Some(output) = self.stage.poll() {
                quiet = false;
                self.emulated.look(&self.stage, now);
                let input = match output {
                    StageOutput::Frame(frame) => Input::Frame(frame),
                    StageOutput::Tip { tip, .. } => {
                        Input::Tracker(Event::Sample(sample_of(&tip, self.tool, now)))
                    }
                    StageOutput::Struck(fault) => {
                        self.strike(now, fault);
                        continue;
                    }
                };
                self.session.handle(now, input);
            }
            if quiet {
                return self.emulated.look(&self.stage, now);
            }
        }
    }

    fn record(&mut self, now: Time, record: Record) {
        if matches!(&record, Record::State { lane: Lane::Session, state, .. } if state == "stopping")
        {
            self.emulated.stopping(&self.stage, now);
        }
        self.sink.take(record, Some(self.stage.truth()));
    }

    /// A bus that takes no frame says so, as an interface does; what a bus that is off was given is
    /// lost.
    fn send(&mut self, now: Time, frame: &Frame, sent: Option<Record>) {
        let interface = || INTERFACE.to_owned();
        let refused = match self.stage.bus_fault() {
            None | Some(BusFault::Off) => None,
            Some(BusFault::Down) => Some(CanError::Down { interface: interface() }),
            Some(BusFault::Full) => {
                Some(CanError::TransmitQueueFull { interface: interface(), frame: *frame })
            }
        };
        match refused {
            Some(error) => self.session.handle(now, Input::BusFault(error.to_string())),
            None => {
                if let Some(record) = sent {
                    self.record(now, record);
                }
                self.stage.handle_frame(now, frame);
                self.emulated.look(&self.stage, now);
            }
        }
    }

    fn strike(&mut self, now: Time, fault: Fault) {
        self.emulated.struck(fault, &self.stage, now);
        let (lane, severity) = (Lane::Stage, Severity::Warning);
        let text = format!("emulated fault: {fault}");
        self.record(now, Record::Event { time: now, lane, severity, text });
        if fault.kind == FaultKind::Bus(BusFault::Off) {
            self.session.handle(now, Input::BusFault(BusError::bus_off().to_string()));
        }
    }
}

/// The sample as which a tracked tip reaches the bench, in full precision and without a wire.
fn sample_of(tip: &TrackedTip, tool: &str, now: Time) -> Sample {
    Sample {
        tool: tool.to_owned(),
        receive_time: now,
        source_unix_ns: Some(tip.acquisition_time.as_nanos()),
        position_mm: tip.x_tb.translation,
        orientation: Some(tip.x_tb.rotation),
        validity: Validity::Valid,
    }
}
