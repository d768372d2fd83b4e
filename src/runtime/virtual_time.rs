//! A session and the virtual stage in one thread, in virtual time: no sleeps, no sockets.

use super::emulated::Emulated;
use super::interrupt::Interrupt;
use super::sink::{RunReport, Sink};
use crate::canopen::Frame;
use crate::emulator::fault::{BusFault, Fault, FaultKind};
use crate::emulator::{StageOutput, TrackedTip, VirtualStage};
use crate::session::{Direction, Input, Lane, Machine, Output, Record, Severity};
use crate::tracker::{Event, Replay, Sample, Validity};
use crate::transport::bus_error::BusError;
use crate::transport::can::CanError;
use crate::units::Time;

/// Where a run in virtual time has its tip positions from.
#[derive(Debug)]
pub enum Tips {
    /// The virtual stage's own tracker, under the name of the tool.
    Emulated {
        /// The tool.
        tool: String,
    },
    /// A recording, which takes that tracker's place.
    Recorded(Replay),
}

impl Tips {
    /// When the recording has something to say.
    fn deadline(&self) -> Time {
        match self {
            Tips::Emulated { .. } => Time::NEVER,
            Tips::Recorded(replay) => replay.deadline(),
        }
    }

    /// What the recording says by `now`.
    fn poll(&mut self, now: Time) -> Option<Event> {
        match self {
            Tips::Emulated { .. } => None,
            Tips::Recorded(replay) => replay.poll(now),
        }
    }

    /// The sample as which a tracked tip reaches the bench, in full precision and without a wire;
    /// none where a recording is in its place.
    fn sample_of(&self, tip: &TrackedTip, now: Time) -> Option<Sample> {
        let Tips::Emulated { tool } = self else { return None };
        Some(Sample {
            tool: tool.clone(),
            receive_time: now,
            source_unix_ns: Some(tip.acquisition_time.as_nanos()),
            position_mm: tip.x_tb.translation,
            orientation: Some(tip.x_tb.rotation),
            validity: Validity::Valid,
        })
    }
}

/// Runs `session`, a run or an operation, against `stage` until it ends. Frames and samples arrive
/// the moment they are sent, and time leaps to the next deadline of any.
pub fn run_virtual<'a>(
    session: &'a mut dyn Machine,
    stage: VirtualStage,
    tips: Tips,
    sink: Sink<'a>,
    interrupt: &Interrupt,
) -> RunReport {
    let mut now = Time::ZERO;
    let mut stop_asked = false;
    let emulated = Emulated::new(&stage, now);
    let mut run = Virtual { session, stage, tips, sink, emulated };
    loop {
        run.settle(now);
        run.sink.progress(run.session.progress());
        if let Some(outcome) = run.session.outcome() {
            let report = run.sink.finish(outcome.clone(), now, None);
            return RunReport { emulated: Some(run.emulated), ..report };
        }
        if !stop_asked && let Some(reason) = stop_reason(interrupt, &run.sink) {
            stop_asked = true;
            run.session.handle(now, Input::Stop(reason));
            continue;
        }
        let due = run.session.deadline().min(run.stage.deadline()).min(run.tips.deadline());
        now = now.max(due);
        while let Some(event) = run.tips.poll(now) {
            run.session.handle(now, Input::Tracker(event));
        }
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
struct Virtual<'a> {
    session: &'a mut dyn Machine,
    stage: VirtualStage,
    tips: Tips,
    sink: Sink<'a>,
    emulated: Emulated,
}

impl Virtual<'_> {
    /// Carries everything that is under way at `now` until both sides are silent.
    fn settle(&mut self, now: Time) {
        loop {
            let mut quiet = !self.drain_session(now);
            while let Some(output) = self.stage.poll() {
                quiet = false;
                self.emulated.look(&self.stage, now);
                let input = match output {
                    StageOutput::Frame(frame) => Input::Frame(frame),
                    StageOutput::Tip { tip, .. } => match self.tips.sample_of(&tip, now) {
                        Some(sample) => Input::Tracker(Event::Sample(sample)),
                        None => continue,
                    },
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

    /// Sends and records what the session has to say; true when there was anything. A frame that
    /// the bus does not take is a fault, told once a time, and what was queued behind it is never
    /// sent; a frame is recorded as sent once it was: all as on a real bus.
    fn drain_session(&mut self, now: Time) -> bool {
        let (mut any, mut failed) = (false, false);
        let mut sent = None;
        while let Some(output) = self.session.poll() {
            any = true;
            let frame = match output {
                Output::Record(record @ Record::Can { direction: Direction::Sent, .. }) => {
                    sent = Some(record);
                    continue;
                }
                Output::Record(record) => {
                    self.record(now, record);
                    continue;
                }
                Output::Transmit(frame) => frame,
            };
            match (self.refusal(&frame), sent.take()) {
                (None, record) => {
                    record.into_iter().for_each(|record| self.record(now, record));
                    self.stage.handle_frame(now, &frame);
                    self.emulated.look(&self.stage, now);
                }
                (Some(_), _) if failed => {}
                (Some(error), _) => {
                    failed = true;
                    self.discard_frames(now);
                    self.session.handle(now, Input::BusFault(error.to_string()));
                }
            }
        }
        any
    }

    /// Records what the session has said and forgets the frames among it.
    fn discard_frames(&mut self, now: Time) {
        while let Some(output) = self.session.poll() {
            match output {
                Output::Record(Record::Can { direction: Direction::Sent, .. })
                | Output::Transmit(_) => {}
                Output::Record(record) => self.record(now, record),
            }
        }
    }

    fn record(&mut self, now: Time, record: Record) {
        if let Record::State { lane: Lane::Session, state, .. } = &record
            && state == "stopping"
        {
            self.emulated.stopping(&self.stage, now);
        }
        self.sink.take(record, Some(self.stage.truth()));
    }

    /// What an interface says that takes no frame. One whose controller is off takes it, and it is
    /// lost.
    fn refusal(&self, frame: &Frame) -> Option<CanError> {
        let interface = INTERFACE.to_owned();
        match self.stage.bus_fault()? {
            BusFault::Off => None,
            BusFault::Down => Some(CanError::Down { interface }),
            BusFault::Full => Some(CanError::TransmitQueueFull { interface, frame: *frame }),
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
