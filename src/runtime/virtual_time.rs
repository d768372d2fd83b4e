//! Runs a session against the virtual stage in one thread, in virtual time: without sockets, and without sleeps
//! unless an operator practises at the pace of real time.

use super::drive::{RunIo, RunMonitor, drive};
use super::sink::{RunReport, Sink};
use crate::canopen::Frame;
use crate::canopen::cia402::DriveState;
use crate::emulator::fault::{Fault, FaultKind};
use crate::emulator::{StageOutput, TrackedTip, Truth, VirtualStage};
use crate::geometry::so3;
use crate::session::{Input, Lane, Machine, Outcome, Record, Severity, State};
use crate::tracker::{Event, Sample, StreamReplay, Validity};
use crate::transport::can::{BusError, CanError};
use crate::transport::unconfirmed::Unconfirmed;
use crate::units::Time;
use std::thread;
use std::time::{Duration, Instant};

/// The source of the tip positions of a run in virtual time.
#[derive(Debug)]
pub enum TipSource {
    /// The virtual stage's own tracker.
    Emulated {
        /// The name of the tool in its samples.
        tool: String,
        /// The name of the tool that marks the target, if the target is tracked.
        target: Option<String>,
    },
    /// A recording, which replaces that tracker.
    Recorded(StreamReplay),
}

/// Runs `session`, an insertion or an operation, against `stage` until it ends. Frames and samples
/// arrive at the moment when they are sent. Time jumps to the earliest deadline of session, stage and
/// tip source; with `pace`, the thread waits for it. Without `tips` the session has no tracker.
pub fn run_virtual(
    session: &mut dyn Machine,
    stage: VirtualStage,
    tips: Option<TipSource>,
    pace: Option<Pace>,
    sink: Sink<'_>,
) -> RunReport {
    let mut run = VirtualRun { pace, ..VirtualRun::new(session, stage, tips, sink) };
    let outcome = drive(&mut run);
    run.emulated.update(&run.stage, run.now);
    let report = run.monitor.finish(run.session, outcome, run.now, None);
    RunReport { emulated: Some(run.emulated), ..report }
}

/// Runs `session` against `stage` until it ends, and passes each record to `take`, with the true pose
/// at that time. A study has no operator, no interrupt and no run folder.
pub(super) fn run_unwatched(
    session: &mut dyn Machine,
    stage: VirtualStage,
    tips: TipSource,
    take: impl FnMut(Record, Option<Truth>),
) -> Outcome {
    drive(&mut VirtualRun::new(session, stage, Some(tips), take))
}

/// The default transmit queue of a CAN interface (`txqueuelen`), frames.
const QUEUE_MAX: usize = 10;

/// How many SYNCs may stay unconfirmed on a stuck interface; after these, sending is an error.
const UNCONFIRMED_SYNCS_MAX: usize = 2;
/// The interface's name in messages.
const INTERFACE: &str = "memory";

/// A run in virtual time: the session, the virtual stage, and the monitor that takes their records.
struct VirtualRun<'a, M> {
    now: Time,
    session: &'a mut dyn Machine,
    stage: VirtualStage,
    tips: Option<TipSource>,
    pace: Option<Pace>,
    emulated: EmulationReport,
    unconfirmed: Unconfirmed,
    monitor: M,
}

impl<'a, M: RunMonitor> VirtualRun<'a, M> {
    fn new(
        session: &'a mut dyn Machine,
        stage: VirtualStage,
        tips: Option<TipSource>,
        monitor: M,
    ) -> Self {
        let now = Time::ZERO;
        let emulated = EmulationReport::new(&stage, now);
        let unconfirmed = Unconfirmed::new(UNCONFIRMED_SYNCS_MAX);
        VirtualRun { now, session, stage, tips, pace: None, emulated, unconfirmed, monitor }
    }

    /// The error of an interface that does not accept `frame`; `None` if it does. In bus-off the interface
    /// accepts the frame and loses it. If no node acknowledges, it accepts frames until its queue is full.
    fn refusal(&self, frame: &Frame) -> Option<CanError> {
        let interface = INTERFACE.to_owned();
        let full = |interface| CanError::TransmitQueueFull { interface, frame: *frame };
        match self.stage.bus_fault()? {
            FaultKind::BusDown => Some(CanError::Down(interface)),
            FaultKind::BusFull => Some(full(interface)),
            FaultKind::BusStuck => match self.unconfirmed.too_many() {
                Some((frames, syncs)) => Some(CanError::NotConfirmed { interface, frames, syncs }),
                None => (self.stage.frames_held() >= QUEUE_MAX).then(|| full(interface)),
            },
            _ => None,
        }
    }

    /// The recording that replaces the emulated tracker, if there is one.
    fn replay(&mut self) -> Option<&mut StreamReplay> {
        match &mut self.tips {
            Some(TipSource::Recorded(replay)) => Some(replay),
            _ => None,
        }
    }

    /// Gives the session a sample of the tip or the target from the emulated tracker, in full precision: no
    /// tracker protocol rounds it.
    fn give_sample(&mut self, seen: &TrackedTip, is_target: bool) {
        let Some(TipSource::Emulated { tool, target }) = &self.tips else { return };
        let tool = if is_target { target.as_ref() } else { Some(tool) };
        let Some(tool) = tool.cloned() else { return };
        self.give(Input::Tracker(Event::Sample(Sample {
            tool,
            receive_time: self.now,
            source_unix_ns: Some(seen.acquisition_time.as_nanos()),
            position_mm: seen.x_ts.translation,
            orientation: Some(so3::quaternion(&seen.x_ts.rotation)),
            validity: Validity::Valid,
        })));
    }

    fn begin_fault(&mut self, fault: Fault) {
        let (time, lane, severity) = (self.now, Lane::Stage, Severity::Warning);
        let text = format!("emulated fault: {fault}");
        let is_bus_off = fault.kind == FaultKind::BusOff;
        self.emulated.faults.push((fault, Moment::of(&self.stage, time)));
        self.record(Record::Event { time, lane, severity, text });
        if is_bus_off {
            self.give(Input::BusFault(BusError::bus_off().to_string()));
        }
    }
}

impl<M: RunMonitor> RunIo for VirtualRun<'_, M> {
    fn machine(&mut self) -> &mut dyn Machine {
        self.session
    }

    fn monitor(&mut self) -> &mut dyn RunMonitor {
        &mut self.monitor
    }

    fn now(&self) -> Time {
        self.now
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
            Some(FaultKind::BusStuck) => self.unconfirmed.sent(*frame, 0),
            _ => self.unconfirmed.give_up(),
        }
        self.emulated.update(&self.stage, self.now);
        Ok(true)
    }

    fn record(&mut self, record: Record) {
        if let Record::State { state: State::Stopping, .. } = &record {
            self.emulated.stopping = Some(Moment::of(&self.stage, self.now));
        }
        // A recording comes from another needle than the emulated one, so its true pose is not known.
        let truth = self.replay().is_none().then(|| self.stage.truth(self.now));
        self.monitor.take(record, truth);
    }

    fn take_arrived(&mut self) -> bool {
        let mut has_arrived = false;
        while let Some(output) = self.stage.poll() {
            has_arrived = true;
            self.emulated.update(&self.stage, self.now);
            match output {
                StageOutput::Frame(frame) => self.give(Input::Frame(frame)),
                StageOutput::FaultBegan(fault) => self.begin_fault(fault),
                StageOutput::Tip { tip, .. } => self.give_sample(&tip, false),
                StageOutput::Target(target) => self.give_sample(&target, true),
            }
        }
        has_arrived
    }

    /// Goes to the earliest deadline of session, stage and tip source.
    fn wait_for_input(&mut self) {
        self.monitor.progress(self.session.progress());
        self.emulated.update(&self.stage, self.now);
        let tip_due = self.replay().map_or(Time::NEVER, |replay| replay.deadline());
        let due = self.session.deadline().min(self.stage.deadline()).min(tip_due);
        let due = self.pace.as_mut().map_or(due, |pace| pace.wait(self.now, due));
        self.now = self.now.max(due);
        let now = self.now;
        while let Some(event) = self.replay().and_then(|replay| replay.poll(now)) {
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

/// The true positions of both axes at one time of an emulated run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moment {
    /// The time.
    pub time: Time,
    /// True depth, mm, from where the stage was switched on.
    pub insertion_true_mm: f64,
    /// True rotation, rad, from where the stage was switched on.
    pub rotation_true_rad: f64,
}

impl Moment {
    fn of(stage: &VirtualStage, time: Time) -> Self {
        let (insertion_true_mm, rotation_true_rad) = stage.position_true(time);
        Moment { time, insertion_true_mm, rotation_true_rad }
    }
}

/// How one emulated drive ended.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveOutcome {
    /// Its state at the end.
    pub state: DriveState,
    /// When it last left Operation Enabled.
    pub left_operation_enabled: Option<Moment>,
}

/// The facts that are known only in an emulated run.
#[derive(Debug, Clone, PartialEq)]
pub struct EmulationReport {
    /// The scripted faults that began, in order.
    pub faults: Vec<(Fault, Moment)>,
    /// The moment at which the run began to stop.
    pub stopping: Option<Moment>,
    /// The insertion drive and the rotation drive.
    pub drives: [DriveOutcome; 2],
    /// The end of the run.
    pub end: Moment,
}

impl EmulationReport {
    /// The report of a run that begins on `stage`.
    fn new(stage: &VirtualStage, now: Time) -> Self {
        let drives = stage
            .drives()
            .map(|drive| DriveOutcome { state: drive.state(), left_operation_enabled: None });
        EmulationReport { faults: Vec::new(), stopping: None, drives, end: Moment::of(stage, now) }
    }

    /// Updates the positions and the drive states. Call it after every change of the stage.
    fn update(&mut self, stage: &VirtualStage, now: Time) {
        self.end = Moment::of(stage, now);
        for (outcome, drive) in self.drives.iter_mut().zip(stage.drives()) {
            let before = std::mem::replace(&mut outcome.state, drive.state());
            if before == DriveState::OperationEnabled && outcome.state != before {
                outcome.left_operation_enabled = Some(self.end);
            }
        }
    }
}

/// Longest single wait, so that the operator's keys are handled at least this often.
const STRIDE: Duration = Duration::from_millis(20);
/// Virtual time catches up on a delay up to this long. After a longer one, such as a suspended program, it
/// continues from where it was.
const CATCH_UP_MAX: Duration = Duration::from_millis(100);

/// Keeps virtual time from running ahead of the clock.
#[derive(Debug)]
pub struct Pace {
    /// When virtual time was zero.
    origin: Instant,
}

impl Pace {
    /// Virtual time is zero now.
    pub fn begin() -> Self {
        Pace { origin: Instant::now() }
    }

    /// Waits at `now` for `due`, at most a [`STRIDE`]. Returns the virtual time that is reached.
    fn wait(&mut self, now: Time, due: Time) -> Time {
        let reached = due.min(now + STRIDE);
        let wake_at = self.origin + reached.since(Time::ZERO);
        let late = wake_at.elapsed();
        if late > CATCH_UP_MAX {
            self.origin += late;
        }
        thread::sleep(wake_at.saturating_duration_since(Instant::now()));
        reached
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: i64) -> Time {
        Time::from_nanos(ms * 1_000_000)
    }

    #[test]
    fn virtual_time_is_never_ahead_of_the_clock() {
        let begun = Instant::now();
        let mut pace = Pace::begin();
        let mut now = Time::ZERO;
        // The third deadline has passed already.
        for due in [at(0), at(7), at(3), at(40), Time::NEVER, Time::NEVER] {
            now = now.max(pace.wait(now, due));
            assert!(begun.elapsed() >= now.since(Time::ZERO), "{now:?}");
        }
        assert_eq!(now, at(67), "without a deadline it waits 20 ms");
    }

    #[test]
    fn a_suspended_program_does_not_catch_up() {
        let mut pace = Pace::begin();
        thread::sleep(CATCH_UP_MAX * 2);
        pace.wait(at(0), at(1));
        let resumed = Instant::now();
        pace.wait(at(1), at(16));
        assert!(resumed.elapsed() >= Duration::from_millis(14), "{:?}", resumed.elapsed());
    }
}
