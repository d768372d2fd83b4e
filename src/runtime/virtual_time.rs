//! A session and the virtual stage in one thread, in virtual time: no sleeps, no sockets.

use super::drive::{Watched, Witness, World, drive};
use super::emulated::Emulated;
use super::interrupt::Interrupt;
use super::sink::{RunReport, Sink};
use crate::canopen::Frame;
use crate::emulator::fault::{BusFault, Fault, FaultKind};
use crate::emulator::{StageOutput, TrackedTip, Truth, VirtualStage};
use crate::geometry::so3;
use crate::session::{Input, Lane, Machine, OperatorCommand, Outcome, Record, Severity, State};
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
            position_mm: tip.x_ts.translation,
            orientation: Some(so3::quaternion(&tip.x_ts.rotation)),
            validity: Validity::Valid,
        })
    }
}

/// Runs `session`, an insertion or an operation, against `stage` until it ends. Frames and samples
/// arrive the moment they are sent, and time leaps to the next deadline of any. Without `tips` the
/// session hears no tracker.
pub fn run_virtual(
    session: &mut dyn Machine,
    stage: VirtualStage,
    tips: Option<Tips>,
    sink: Sink<'_>,
    interrupt: &Interrupt,
) -> RunReport {
    let mut run =
        Virtual::new(session, stage, tips, Watched { sink, interrupt: interrupt.clone() });
    let outcome = drive(&mut run);
    run.emulated.look(&run.stage, run.now);
    let gates = run.session.gate_counts();
    let report = run.witness.sink.finish(outcome, run.now, gates, None);
    RunReport { emulated: Some(run.emulated), ..report }
}

/// Runs `session` against `stage` until it ends, its records handed to `take` with the truth of
/// their moment: for studies, which nobody watches or interrupts.
pub(super) fn run_unwatched(
    session: &mut dyn Machine,
    stage: VirtualStage,
    tips: Tips,
    take: impl FnMut(Record, Option<Truth>),
) -> Outcome {
    drive(&mut Virtual::new(session, stage, Some(tips), take))
}

/// What a CAN interface queues by default (`txqueuelen`).
const QUEUE_MAX: usize = 10;

/// SYNCs whose frames may wait in an interface that is stuck.
const UNCONFIRMED_SYNCS_MAX: usize = 2;
/// The interface's name in messages.
const INTERFACE: &str = "memory";

/// Both sides and what is told of them.
struct Virtual<'a, W> {
    now: Time,
    session: &'a mut dyn Machine,
    stage: VirtualStage,
    tips: Option<Tips>,
    emulated: Emulated,
    unconfirmed: Unconfirmed,
    witness: W,
}

impl<'a, W: Witness> Virtual<'a, W> {
    fn new(
        session: &'a mut dyn Machine,
        stage: VirtualStage,
        tips: Option<Tips>,
        witness: W,
    ) -> Self {
        let now = Time::ZERO;
        let emulated = Emulated::new(&stage, now);
        let unconfirmed = Unconfirmed::new(UNCONFIRMED_SYNCS_MAX);
        Virtual { now, session, stage, tips, emulated, unconfirmed, witness }
    }

    /// What an interface says that takes no frame. One whose controller is off takes it, and it is
    /// lost; one whose frames nobody acknowledges takes as many as its queue holds.
    fn refusal(&self, frame: &Frame) -> Option<CanError> {
        let interface = INTERFACE.to_owned();
        let full = |interface| CanError::TransmitQueueFull { interface, frame: *frame };
        match self.stage.bus_fault()? {
            BusFault::Off => None,
            BusFault::Down => Some(CanError::Down(interface)),
            BusFault::Full => Some(full(interface)),
            BusFault::Stuck => match self.unconfirmed.too_many() {
                Some(frames) => Some(CanError::NotConfirmed { interface, frames }),
                None => (self.stage.frames_held() >= QUEUE_MAX).then(|| full(interface)),
            },
        }
    }

    fn strike(&mut self, fault: Fault) {
        let now = self.now;
        self.emulated.struck(fault, &self.stage, now);
        let (lane, severity) = (Lane::Stage, Severity::Warning);
        let text = format!("emulated fault: {fault}");
        self.record(Record::Event { time: now, lane, severity, text });
        if fault.kind == FaultKind::Bus(BusFault::Off) {
            self.give(Input::BusFault(BusError::bus_off().to_string()));
        }
    }
}

impl<W: Witness> World for Virtual<'_, W> {
    fn machine(&mut self) -> &mut dyn Machine {
        self.session
    }

    fn give(&mut self, input: Input) {
        self.session.handle(self.now, input);
    }

    fn send(&mut self, _: Time, frame: &Frame) -> Result<bool, CanError> {
        if let Some(error) = self.refusal(frame) {
            return Err(error);
        }
        self.stage.handle_frame(self.now, frame);
        match self.stage.bus_fault() {
            Some(BusFault::Stuck) => self.unconfirmed.sent(*frame),
            _ => self.unconfirmed.give_up(),
        }
        self.emulated.look(&self.stage, self.now);
        Ok(true)
    }

    fn record(&mut self, record: Record) {
        if let Record::State { state: State::Stopping, .. } = &record {
            self.emulated.stopping(&self.stage, self.now);
        }
        self.witness.take(record, Some(self.stage.truth()));
    }

    fn take_arrived(&mut self) -> bool {
        let mut any = false;
        while let Some(output) = self.stage.poll() {
            any = true;
            self.emulated.look(&self.stage, self.now);
            match output {
                StageOutput::Frame(frame) => self.give(Input::Frame(frame)),
                StageOutput::FaultBegan(fault) => self.strike(fault),
                StageOutput::Tip { tip, .. } => {
                    let sample = self.tips.as_ref().and_then(|tips| tips.sample_of(&tip, self.now));
                    if let Some(sample) = sample {
                        self.give(Input::Tracker(Event::Sample(sample)));
                    }
                }
            }
        }
        any
    }

    fn command(&mut self) -> Option<OperatorCommand> {
        self.witness.command()
    }

    fn stop_reason(&mut self, is_asked: bool) -> Option<String> {
        self.witness.progress(self.session.progress());
        self.witness.stop_reason(self.now, is_asked)
    }

    /// Leaps to the next deadline of any.
    fn go_on(&mut self) {
        self.emulated.look(&self.stage, self.now);
        let tips = self.tips.as_ref().map_or(Time::NEVER, Tips::deadline);
        let due = self.session.deadline().min(self.stage.deadline()).min(tips);
        self.now = self.now.max(due);
        while let Some(event) = self.tips.as_mut().and_then(|tips| tips.poll(self.now)) {
            self.give(Input::Tracker(event));
        }
        if self.stage.deadline() <= self.now {
            self.stage.handle_timeout(self.now);
        }
        if self.session.deadline() <= self.now {
            self.give(Input::Tick);
        }
    }
}
