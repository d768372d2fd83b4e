//! The session, which is the state machine of a run, and the interface that a run loop uses.

use super::SessionConfig;
use super::insert::InsertTask;
use super::outcome::{Outcome, StageAtEnd};
use super::record::{Direction, Lane, Record, Severity};
use super::shell::{Power, Shell};
use super::state::State;
use super::task::Task;
use crate::canopen::Frame;
use crate::stage::{Axis, Counters, Stage, StageEvent};
use crate::tracker::{Event, GateCounts};
use crate::units::Time;
use derive_more::Display;
use std::collections::BTreeMap;
use std::time::Duration;

/// The stop reason begins with this if the bench itself stalled for longer than [`Machine::stall_max`]. The
/// runtime then discards the frames that were made before the stall.
pub const STALLED: &str = "bench: was held up for ";

/// Something that reaches the session from outside.
#[derive(Debug, Clone, PartialEq)]
pub enum Input {
    /// A frame taken from the bus.
    Frame(Frame),
    /// The bus failed: bus off, interface down, a frame not taken. The text says which.
    BusFault(String),
    /// The bus reports a problem and keeps working.
    BusWarning(String),
    /// A tip position, or another event of the tracker's link.
    Tracker(Event),
    /// The operator or the runtime ends the run for this reason.
    Stop(String),
    /// The operator asks for something other than a stop.
    Operator(OperatorCommand),
    /// Only the time has passed: to be given at [`Machine::deadline`].
    Tick,
}

/// A command of the operator to an insertion.
#[derive(Debug, Clone, Copy, PartialEq, Display)]
pub enum OperatorCommand {
    /// Brake the insertion to a standstill; both axes stay enabled.
    #[display("hold")]
    Hold,
    /// Resume a held insertion.
    #[display("resume")]
    Resume,
    /// Insert a held needle by this much, then hold again.
    #[display("step of {mm} mm")]
    Step {
        /// Length of the step, mm.
        mm: f64,
    },
    /// Change the speed of the insertion.
    #[display("speed {mm_per_s:.3} mm/s")]
    Speed {
        /// The new speed, mm/s; at most `insertion.speed_mm_per_s`.
        mm_per_s: f64,
    },
}

/// Something that leaves the session.
#[derive(Debug, Clone)]
pub enum Output {
    /// A frame for the bus. The runtime sends it and records it as sent, with this time.
    Transmit {
        /// When it was made.
        time: Time,
        /// The frame.
        frame: Frame,
    },
    /// A record for telemetry.
    Record(Record),
}

/// The progress of a run.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Progress {
    /// Time of the last input.
    pub time: Time,
    /// The state of the run.
    pub state: State,
    /// Measured depth from the start, mm.
    pub insertion_meas_mm: f64,
    /// Depth to reach, mm; 0 if the run has none.
    pub depth_mm: f64,
    /// Speed of the insertion while nothing holds it, mm/s; 0 before it begins.
    pub speed_mm_per_s: f64,
    /// Remaining time at this speed, s; `None` before the insertion and while it is held.
    pub remaining_s: Option<f64>,
    /// Distance of the tip from the plane as estimated at the last step, mm.
    pub x_mm: Option<f64>,
    /// Roll of the tip as estimated at the last step, rad; `None` while it is not known.
    pub roll_rad: Option<f64>,
    /// Age of the newest accepted tip position, s.
    pub tip_age_s: Option<f64>,
    /// SYNC periods skipped because the bench was late.
    pub syncs_skipped: u64,
    /// The longest delay of a SYNC after it was due.
    pub sync_late_max: Duration,
}

/// The move of one axis in an operation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AxisMove {
    /// Which axis.
    pub axis: Axis,
    /// Position at the start, mm or rad; `None` if the axis was not homed.
    pub from: Option<f64>,
    /// Last position, mm or rad.
    pub to: f64,
}

/// A machine that commands the stage, sans-IO: a [`Session`].
///
/// The whole contract: call [`handle`](Self::handle) with the time and one input, drain
/// [`poll`](Self::poll) to `None`, wait until [`deadline`](Self::deadline) or the next input,
/// repeat until [`outcome`](Self::outcome) says how it ended.
pub trait Machine {
    /// Takes one input at `now`.
    fn handle(&mut self, now: Time, input: Input);

    /// The next frame or record to leave the machine; `None` when there is no more for now.
    fn poll(&mut self) -> Option<Output>;

    /// When to call [`handle`](Self::handle) with [`Input::Tick`] if no input comes first.
    fn deadline(&self) -> Time;

    /// When the next SYNC is due.
    fn sync_due(&self) -> Time;

    /// How the run ended; `None` until it has.
    fn outcome(&self) -> Option<&Outcome>;

    /// The progress of the run.
    fn progress(&self) -> Progress;

    /// Counts of harmless errors on the stage's bus.
    fn stage_counters(&self) -> Counters;

    /// The longest stall of the bench that a run survives: the drives' heartbeat timeout, or during an
    /// insertion the maximum age of the tip position, if that is less. `None` before the drives are enabled
    /// and while they are being stopped.
    fn stall_max(&self) -> Option<Duration>;

    /// The state in which the run leaves the stage.
    fn stage_at_end(&self) -> StageAtEnd {
        StageAtEnd::default()
    }

    /// The numbers of samples that the tracker's gates accepted and refused.
    fn gate_counts(&self) -> GateCounts {
        GateCounts::default()
    }
}

/// A run, from the first boot-up to the last frame; see [`Machine`] for how it is driven.
///
/// The same shell brings the stage up, supervises it, stops it and takes power off for every task. A session uses
/// no clock, socket, file or thread, so live, emulated and replayed runs use the same code.
///
/// Motion follows from feedback alone: a set-point is computed only when both drives have answered a
/// SYNC, from that answer. Every fault stops both axes, and the session never starts them again.
pub struct Session {
    shell: Shell,
    task: Box<dyn Task>,
    /// How often the CAN controller has warned, by the words of the warning.
    bus_warnings: BTreeMap<String, u64>,
}

impl Session {
    /// An insertion that begins at `now`.
    pub fn new(config: SessionConfig, now: Time) -> Self {
        let stage = Stage::new(config.stage.clone(), now);
        Session::begin(stage, Box::new(InsertTask::new(config, now)), now)
    }

    /// `task` on `stage`, begun at `now`.
    pub(crate) fn begin(stage: Stage, task: Box<dyn Task>, now: Time) -> Self {
        let shell = Shell::new(stage, now);
        let mut session = Session { shell, task, bus_warnings: BTreeMap::new() };
        session.shell.record(Record::Begun { time: now });
        session.shell.enter(State::Preparing);
        session.task.begin(&mut session.shell);
        session.permit_power();
        session.drain_stage();
        session
    }

    /// The moves of an operation, one for each axis that moved.
    pub fn moves(&self) -> &[AxisMove] {
        self.task.moves()
    }

    /// Reports a warning of the CAN controller the 1st, 2nd, 4th, 8th … time: a bad contact gives thousands a
    /// second. Warnings that differ only in their digits, such as error counters, count as one.
    fn report_bus_warning(&mut self, text: String) {
        let words: String = text.chars().filter(|c| !c.is_ascii_digit()).collect();
        let count = self.bus_warnings.entry(words).or_default();
        *count += 1;
        let text = match *count {
            1 => text,
            count if count.is_power_of_two() => format!("{text} ({count} times)"),
            _ => return,
        };
        self.shell.report(Lane::Stage, Severity::Warning, text);
    }

    fn permit_power(&mut self) {
        let may_ask = matches!(self.shell.power(), Power::Off | Power::Awaited(_));
        if !may_ask || !self.shell.is_running() {
            return;
        }
        match self.task.permits_power(&mut self.shell) {
            Ok(permitted) => self.shell.stage.permit_power(permitted),
            Err(reason) => self.shell.stop(reason),
        }
    }

    /// Acts on every event of the stage.
    fn drain_stage(&mut self) {
        while let Some(event) = self.shell.poll_stage() {
            self.shell.take_stage_event(&event);
            if let StageEvent::Stopped { standing, off } = event {
                // What the stage still sends is recorded before the end of the run.
                self.drain_stage();
                let outcome = self.shell.outcome_of_stop(standing, off);
                self.finish(outcome);
            } else if self.shell.is_running() || matches!(event, StageEvent::Feedback(_)) {
                let taken = self.task.take_stage_event(&mut self.shell, &event);
                self.shell.stop_on_error(taken);
            }
        }
    }

    /// Answers every command with an event: its effect, or why it is refused.
    fn take_operator(&mut self, command: OperatorCommand) {
        let answer = match self.shell.is_running() {
            true => self.task.take_operator(&mut self.shell, command),
            false => Err("the run is ending".to_owned()),
        };
        let (severity, text) = match answer {
            Ok(text) => (Severity::Info, format!("operator: {text}")),
            Err(why) => (Severity::Warning, format!("operator: {command} refused: {why}")),
        };
        self.shell.report(Lane::Session, severity, text);
    }

    fn finish(&mut self, outcome: Outcome) {
        if self.outcome().is_none() {
            self.task.end(&mut self.shell);
            self.shell.finish(outcome);
        }
    }
}

impl Machine for Session {
    fn handle(&mut self, now: Time, input: Input) {
        self.shell.now = now;
        if self.outcome().is_some() {
            // The bus may refuse the last frame. A replay needs this input.
            if matches!(input, Input::BusFault(_)) {
                self.shell.record(Record::Input { time: now, input });
            }
            return;
        }
        let caught_up = self.task.catch_up();
        self.shell.stop_on_error(caught_up);
        self.shell.record(Record::Input { time: now, input: input.clone() });
        match input {
            Input::Frame(frame) => {
                let direction = Direction::Received;
                self.shell.record(Record::Can { time: now, direction, frame });
                self.shell.stage.handle_frame(now, &frame);
                self.task.take_frame(&self.shell, &frame);
            }
            Input::BusFault(reason) => self.shell.stop(format!("can: {reason}")),
            Input::BusWarning(text) => self.report_bus_warning(text),
            Input::Tracker(event) => self.task.take_tracker_event(&mut self.shell, event),
            Input::Stop(reason) => self.shell.stop(reason),
            Input::Operator(command) => self.take_operator(command),
            Input::Tick => {}
        }
        // Feedback is answered before the next SYNC goes out, however late the call is.
        self.drain_stage();
        self.permit_power();
        if now >= self.shell.stage.deadline() {
            self.shell.stage.handle_timeout(now);
            self.drain_stage();
        }
        let handled = self.task.handle_timeout(&mut self.shell);
        self.shell.stop_on_error(handled);
        self.drain_stage();
        if let Some(outcome) = self.shell.outcome_of_timeout() {
            self.finish(outcome);
        }
    }

    fn poll(&mut self) -> Option<Output> {
        self.shell.poll()
    }

    fn deadline(&self) -> Time {
        let deadline = self.shell.deadline();
        match self.shell.is_running() {
            true => deadline.min(self.task.deadline(&self.shell)),
            false => deadline,
        }
    }

    fn sync_due(&self) -> Time {
        self.shell.stage.sync_due()
    }

    fn outcome(&self) -> Option<&Outcome> {
        self.shell.outcome()
    }

    fn progress(&self) -> Progress {
        let time = self.shell.now;
        let state = self.shell.states.get(&Lane::Session).copied().unwrap_or_default();
        let Counters { syncs_skipped, sync_late_max, .. } = self.stage_counters();
        Progress { time, state, syncs_skipped, sync_late_max, ..self.task.progress(time) }
    }

    fn stage_counters(&self) -> Counters {
        self.shell.stage.counters()
    }

    fn stage_at_end(&self) -> StageAtEnd {
        self.shell.stage_at_end()
    }

    fn stall_max(&self) -> Option<Duration> {
        let max = self.shell.stall_max()?;
        Some(self.task.tip_age_max().map_or(max, |tip_age_max| max.min(tip_age_max)))
    }

    fn gate_counts(&self) -> GateCounts {
        self.task.gate_counts()
    }
}
