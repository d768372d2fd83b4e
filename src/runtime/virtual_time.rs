//! A session and the virtual stage in one thread, in virtual time: no sleeps, no sockets.

use super::emulated::Emulated;
use super::interrupt::Interrupt;
use super::sink::{RunReport, Sink};
use crate::canopen::Frame;
use crate::emulator::fault::{BusFault, Fault, FaultKind};
use crate::emulator::{StageOutput, TrackedTip, Truth, VirtualStage};
use crate::geometry::so3;
use crate::session::{
    Direction, Input, Lane, Machine, Outcome, Output, Record, SessionState, Severity, State,
};
use crate::tracker::{Event, Replay, Sample, Validity};
use crate::transport::bus_error::BusError;
use crate::transport::can::CanError;
use crate::transport::unconfirmed::Unconfirmed;
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
            orientation: Some(so3::quaternion(&tip.x_tb.rotation)),
            validity: Validity::Valid,
        })
    }
}

/// Takes a record, with the truth of its moment.
type Take<'a> = &'a mut dyn FnMut(Record, Truth);

/// Runs `session`, a run or an operation, against `stage` until it ends. Frames and samples arrive
/// the moment they are sent, and time leaps to the next deadline of any.
pub fn run_virtual(
    session: &mut dyn Machine,
    stage: VirtualStage,
    tips: Tips,
    mut sink: Sink<'_>,
    interrupt: &Interrupt,
) -> RunReport {
    let mut run = Virtual::new(session, stage, tips);
    let mut stop_asked = false;
    loop {
        run.settle(&mut |record, truth| sink.take(record, Some(truth)));
        sink.progress(run.session.progress());
        if let Some(outcome) = run.session.outcome() {
            let (outcome, gates) = (outcome.clone(), run.session.gate_counts());
            let report = sink.finish(outcome, run.now, gates, None);
            return RunReport { emulated: Some(run.emulated), ..report };
        }
        if let Some(reason) = stop_reason(interrupt, &mut sink, run.now, stop_asked) {
            stop_asked = true;
            run.session.handle(run.now, Input::Stop(reason));
            continue;
        }
        run.leap();
    }
}

/// Runs `session` against `stage` until it ends, its records handed to `take` with the truth of
/// their moment: for studies, which nobody watches or interrupts.
pub(super) fn run_unwatched(
    session: &mut dyn Machine,
    stage: VirtualStage,
    tips: Tips,
    take: Take<'_>,
) -> Outcome {
    let mut run = Virtual::new(session, stage, tips);
    loop {
        run.settle(take);
        if let Some(outcome) = run.session.outcome() {
            return outcome.clone();
        }
        run.leap();
    }
}

/// Why the runtime itself wants the run to end, after a look at the record; `None` of one that
/// `is_asked` to already.
pub(super) fn stop_reason(
    interrupt: &Interrupt,
    sink: &mut Sink<'_>,
    now: Time,
    is_asked: bool,
) -> Option<String> {
    let is_raised = interrupt.is_raised();
    let record = sink.look_after_record(now, is_asked || is_raised);
    let operator = is_raised.then(|| "operator: interrupted".to_owned());
    operator.or(record).filter(|_| !is_asked)
}

/// What a CAN interface queues by default (`txqueuelen`).
const QUEUE_MAX: usize = 10;

/// SYNCs whose frames may wait in an interface that is stuck.
const UNCONFIRMED_SYNCS_MAX: usize = 2;
/// The interface's name in messages.
const INTERFACE: &str = "memory";

/// Both sides and what is told of them.
struct Virtual<'a> {
    now: Time,
    session: &'a mut dyn Machine,
    stage: VirtualStage,
    tips: Tips,
    emulated: Emulated,
    unconfirmed: Unconfirmed,
}

impl<'a> Virtual<'a> {
    fn new(session: &'a mut dyn Machine, stage: VirtualStage, tips: Tips) -> Self {
        let now = Time::ZERO;
        let emulated = Emulated::new(&stage, now);
        let unconfirmed = Unconfirmed::new(UNCONFIRMED_SYNCS_MAX);
        Virtual { now, session, stage, tips, emulated, unconfirmed }
    }

    /// Goes on to the next deadline of any.
    fn leap(&mut self) {
        let due = self.session.deadline().min(self.stage.deadline()).min(self.tips.deadline());
        let now = self.now.max(due);
        self.now = now;
        while let Some(event) = self.tips.poll(now) {
            self.session.handle(now, Input::Tracker(event));
        }
        if self.stage.deadline() <= now {
            self.stage.handle_timeout(now);
        }
        if self.session.deadline() <= now {
            self.session.handle(now, Input::Tick);
        }
    }

    /// Carries everything that is under way now until both sides are silent.
    fn settle(&mut self, take: Take<'_>) {
        let now = self.now;
        loop {
            let mut quiet = !self.drain_session(take);
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
                        self.strike(fault, take);
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
    fn drain_session(&mut self, take: Take<'_>) -> bool {
        let now = self.now;
        let (mut any, mut failed) = (false, false);
        while let Some(output) = self.session.poll() {
            any = true;
            let (time, frame) = match output {
                Output::Record(record) => {
                    self.record(record, take);
                    continue;
                }
                Output::Transmit { time, frame } => (time, frame),
            };
            match self.refusal(&frame) {
                None => {
                    self.record(Record::Can { time, direction: Direction::Sent, frame }, take);
                    self.stage.handle_frame(now, &frame);
                    match self.stage.bus_fault() {
                        Some(BusFault::Stuck) => self.unconfirmed.sent(frame),
                        _ => self.unconfirmed.give_up(),
                    }
                    self.emulated.look(&self.stage, now);
                }
                Some(_) if failed => {}
                Some(error) => {
                    failed = true;
                    self.discard_frames(take);
                    self.session.handle(now, Input::BusFault(error.to_string()));
                }
            }
        }
        any
    }

    /// Records what the session has said and forgets the frames among it.
    fn discard_frames(&mut self, take: Take<'_>) {
        while let Some(output) = self.session.poll() {
            if let Output::Record(record) = output {
                self.record(record, take);
            }
        }
    }

    fn record(&mut self, record: Record, take: Take<'_>) {
        if let Record::State { state: State::Session(SessionState::Stopping), .. } = &record {
            self.emulated.stopping(&self.stage, self.now);
        }
        take(record, self.stage.truth());
    }

    /// What an interface says that takes no frame. One whose controller is off takes it, and it is
    /// lost; one whose frames nobody acknowledges takes as many as its queue holds.
    fn refusal(&self, frame: &Frame) -> Option<CanError> {
        let interface = INTERFACE.to_owned();
        let full = |interface| CanError::TransmitQueueFull { interface, frame: *frame };
        match self.stage.bus_fault()? {
            BusFault::Off => None,
            BusFault::Down => Some(CanError::Down { interface }),
            BusFault::Full => Some(full(interface)),
            BusFault::Stuck => match self.unconfirmed.too_many() {
                Some(frames) => Some(CanError::NotConfirmed { interface, frames }),
                None => (self.stage.frames_held() >= QUEUE_MAX).then(|| full(interface)),
            },
        }
    }

    fn strike(&mut self, fault: Fault, take: Take<'_>) {
        let now = self.now;
        self.emulated.struck(fault, &self.stage, now);
        let (lane, severity) = (Lane::Stage, Severity::Warning);
        let text = format!("emulated fault: {fault}");
        self.record(Record::Event { time: now, lane, severity, text }, take);
        if fault.kind == FaultKind::Bus(BusFault::Off) {
            self.session.handle(now, Input::BusFault(BusError::bus_off().to_string()));
        }
    }
}
