//! The stage of a run, from its bring-up to power off, and the record of the run.

use super::outcome::{Outcome, StageAtEnd};
use super::record::{Lane, Record, Severity};
use super::state::State;
use super::{Output, left_unknown, news};
use crate::canopen::{Frame, cob};
use crate::stage::{self, Axis, Progress, SetPoint, Stage, StageConfig, StageEvent};
use crate::units::Time;
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

/// The stage has its own timeouts for standstill and for power off. If it has reported nothing for this
/// long after them, the run is closed.
const STOP_MARGIN: Duration = Duration::from_secs(1);

/// Maximum number of follow-up reasons that are reported.
const THEN_MAX: usize = 8;

/// Where the run is.
#[derive(Debug, Clone)]
enum Phase {
    /// The stage is brought up, or the task goes on.
    Running,
    /// The drives are being stopped, in order or after a fault; the run will end as `outcome`.
    Stopping { outcome: Outcome, since: Time },
    /// Over; nothing is sent any more.
    Over(Outcome),
}

/// How far the stage is on its way to power.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Power {
    /// The drives are being brought up.
    Off,
    /// They have been ready for power since then.
    Awaited(Time),
    /// They are being enabled.
    ComingOn,
    /// They have been enabled since then.
    On(Time),
}

/// The stage and the record of a run, in the hands of its [`Task`](super::Task).
#[derive(Debug)]
pub(crate) struct Shell {
    pub(super) stage: Stage,
    /// The time of the present input.
    pub(crate) now: Time,
    config: StageConfig,
    phase: Phase,
    power: Power,
    /// The bench has stopped sending its heartbeat on purpose.
    is_silent: bool,
    /// The state each part is in.
    states: BTreeMap<Lane, State>,
    /// The follow-up reasons reported since the stop began.
    then: Vec<String>,
    left_unknown: Option<&'static str>,
    /// A drive had power when the stop began, whoever gave it.
    stopped_with_power: bool,
    outputs: VecDeque<Output>,
}

impl Shell {
    pub(super) fn new(stage: Stage, config: StageConfig, now: Time) -> Self {
        Shell {
            stage,
            now,
            config,
            phase: Phase::Running,
            power: Power::Off,
            is_silent: false,
            states: BTreeMap::new(),
            then: Vec::new(),
            left_unknown: None,
            stopped_with_power: false,
            outputs: VecDeque::new(),
        }
    }

    pub(crate) fn record(&mut self, record: Record) {
        self.outputs.push_back(Output::Record(record));
    }

    /// Records that a part of the bench enters `state`, unless it is in that state already.
    pub(crate) fn enter(&mut self, state: State) {
        self.enter_at(self.now, state);
    }

    /// As [`Shell::enter`], at `time`.
    pub(crate) fn enter_at(&mut self, time: Time, state: State) {
        if self.states.insert(state.lane(), state) != Some(state) {
            self.record(Record::State { time, state });
        }
    }

    /// The state that the run itself is in.
    pub(super) fn session_state(&self) -> State {
        self.states.get(&Lane::Session).copied().unwrap_or_default()
    }

    /// Records an event, which the operator sees.
    pub(crate) fn report(&mut self, lane: Lane, severity: Severity, text: String) {
        self.report_at(self.now, lane, severity, text);
    }

    /// As [`Shell::report`], at `time`.
    pub(crate) fn report_at(&mut self, time: Time, lane: Lane, severity: Severity, text: String) {
        self.record(Record::Event { time, lane, severity, text });
    }

    pub(crate) fn send(&mut self, frame: Frame) {
        self.outputs.push_back(Output::Transmit { time: self.now, frame });
    }

    pub(super) fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// How far the stage is on its way to power.
    pub(crate) fn power(&self) -> Power {
        self.power
    }

    /// Neither stopping nor over.
    pub(crate) fn is_running(&self) -> bool {
        matches!(self.phase, Phase::Running)
    }

    pub(super) fn outcome(&self) -> Option<&Outcome> {
        match &self.phase {
            Phase::Over(outcome) => Some(outcome),
            Phase::Running | Phase::Stopping { .. } => None,
        }
    }

    /// Makes `set_point` the target of both axes at the next SYNC.
    ///
    /// # Errors
    /// As [`Stage::command`].
    pub(crate) fn command(&mut self, set_point: SetPoint) -> Result<(), String> {
        self.stage.command(set_point).map_err(|error| format!("stage: {error}"))
    }

    /// Whether both axes may be sent to `goal` in time.
    ///
    /// # Errors
    /// As [`Stage::check_goal`].
    pub(crate) fn check_goal(&self, goal: SetPoint) -> Result<(), String> {
        self.stage.check_goal(goal).map_err(|error| format!("stage: {error}"))
    }

    /// Lets the drive of `axis` find its home.
    ///
    /// # Errors
    /// As [`Stage::home`].
    pub(crate) fn home(&mut self, axis: Axis) -> Result<(), String> {
        self.stage.home(self.now, axis).map_err(|error| format!("stage: {error}"))
    }

    /// Stops sending the bench's heartbeat, as if the bench had died.
    pub(crate) fn fall_silent(&mut self) {
        self.is_silent = true;
        self.stage.fall_silent();
    }

    /// The drives' heartbeat timeout; `None` while they would not notice a stall: before they are enabled,
    /// while they are being stopped, and while the bench is silent on purpose.
    pub(super) fn stall_max(&self) -> Option<Duration> {
        let is_noticed = matches!(self.power, Power::On(_)) && self.is_running() && !self.is_silent;
        is_noticed.then_some(self.config.bus.heartbeat_timeout())
    }

    /// Records an event of the stage.
    pub(super) fn take_stage_event(&mut self, event: &StageEvent) {
        let is_expected = match event {
            // The task refused the position in the event before: the axes stay without power.
            StageEvent::Progress(Progress::Enabling) => !self.is_running(),
            // An answer to the task, which reads the drives while the bench is silent.
            StageEvent::Ignored { frame, .. } => self.is_silent && self.is_sdo_answer(frame),
            _ => false,
        };
        if is_expected {
            return;
        }
        if let Some((severity, text)) = news(event) {
            self.report(Lane::Stage, severity, text);
        }
        match event {
            StageEvent::Progress(Progress::Enabling) => self.power = Power::ComingOn,
            StageEvent::Located(_) => self.power = Power::Awaited(self.now),
            StageEvent::Ready => {
                self.power = Power::On(self.now);
                self.enter(State::Enabled);
            }
            StageEvent::Identity(axis, identity) => {
                let (axis, identity) = (*axis, *identity);
                let node = self.config.axis(axis).node;
                self.record(Record::Drive { time: self.now, axis, node, identity });
            }
            StageEvent::Fault(fault) => self.stop(format!("stage: {fault}")),
            _ => {}
        }
    }

    fn is_sdo_answer(&self, frame: &Frame) -> bool {
        let answers = Axis::BOTH.map(|axis| cob::sdo_tx(self.config.axis(axis).node));
        frame.cob_id().is_some_and(|cob_id| answers.contains(&cob_id))
    }

    /// Ends the run for `reason`: both axes are quick-stopped. The first reason stands.
    pub(crate) fn stop(&mut self, reason: String) {
        match &self.phase {
            Phase::Over(_) | Phase::Stopping { outcome: Outcome::Stopped(_), .. } => {
                // A bus that is down reports it at every frame.
                if self.then.len() < THEN_MAX && !self.then.contains(&reason) {
                    self.report(Lane::Session, Severity::Warning, format!("then: {reason}"));
                    self.then.push(reason);
                }
            }
            Phase::Running | Phase::Stopping { outcome: Outcome::Completed, .. } => {
                self.report(Lane::Session, Severity::Fault, reason.clone());
                self.stage.quick_stop(self.now);
                self.begin_stopping(Outcome::Stopped(reason));
            }
        }
    }

    /// As [`Shell::stop`], for the reason that `result` gives, if it gives one.
    pub(super) fn stop_on_error(&mut self, result: Result<(), String>) {
        if let Err(reason) = result {
            self.stop(reason);
        }
    }

    /// The task is done: both axes are held until they stand, then power is taken off.
    pub(crate) fn complete(&mut self) {
        self.stage.disable(self.now);
        self.begin_stopping(Outcome::Completed);
    }

    /// The task is done, and the drives have stopped by themselves, so an orderly end is not possible.
    pub(crate) fn complete_by_quick_stop(&mut self) {
        self.stage.quick_stop(self.now);
        self.begin_stopping(Outcome::Completed);
    }

    fn begin_stopping(&mut self, outcome: Outcome) {
        self.stopped_with_power |= self.had_power();
        self.phase = Phase::Stopping { outcome, since: self.now };
        self.enter(State::Stopping);
    }

    /// The longest a stop may take by the stage's own timeouts, and a margin.
    fn stop_timeout(&self) -> Duration {
        self.config.power.stop_timeout * 2 + STOP_MARGIN
    }

    /// When the shell itself, or else its stage, has something to do.
    pub(super) fn deadline(&self) -> Time {
        match &self.phase {
            Phase::Running => self.stage.deadline(),
            Phase::Stopping { since, .. } => {
                self.stage.deadline().min(*since + self.stop_timeout())
            }
            Phase::Over(_) => Time::NEVER,
        }
    }

    /// The outcome once the stage has done what it can to take power off. A run whose drives may still
    /// have power is not completed.
    pub(super) fn outcome_of_stop(&mut self, standing: bool, off: bool) -> Outcome {
        self.enter(State::PowerOff);
        let unknown = self.tell_left_unknown(standing, off);
        match (&self.phase, unknown) {
            (Phase::Stopping { outcome: Outcome::Completed, .. }, Some(text)) if !off => {
                Outcome::Stopped(format!("stage: {text}"))
            }
            (Phase::Stopping { outcome, .. } | Phase::Over(outcome), _) => outcome.clone(),
            (Phase::Running, _) => Outcome::Stopped("stage: stopped by itself".to_owned()),
        }
    }

    /// Reports what a stop has left unknown of drives that had power.
    fn tell_left_unknown(&mut self, standing: bool, off: bool) -> Option<&'static str> {
        let unknown = left_unknown(standing, off).filter(|_| self.had_power())?;
        self.report(Lane::Stage, Severity::Warning, unknown.to_owned());
        self.left_unknown = Some(unknown);
        Some(unknown)
    }

    /// The bench gave the drives power, or something else did.
    fn had_power(&self) -> bool {
        let reports = self.stage.drive_reports();
        self.stopped_with_power
            || matches!(self.power, Power::ComingOn | Power::On(_))
            || Axis::BOTH.into_iter().any(|axis| reports[axis].says_power())
    }

    /// The state in which the run leaves the stage.
    pub(super) fn stage_at_end(&self) -> StageAtEnd {
        StageAtEnd {
            had_power: self.had_power(),
            unknown: self.left_unknown,
            drives: self.stage.drive_reports(),
            position: self.stage.position(),
        }
    }

    /// The outcome if the stage has reported nothing for longer than a stop may take.
    pub(super) fn outcome_of_timeout(&mut self) -> Option<Outcome> {
        let timeout = self.stop_timeout();
        let Phase::Stopping { outcome, since } = &self.phase else { return None };
        if self.now < *since + timeout {
            return None;
        }
        let outcome = match outcome {
            Outcome::Completed => Outcome::Stopped(format!(
                "stage: the drives did not stand down within {:.0} s",
                timeout.as_secs_f64()
            )),
            Outcome::Stopped(_) => outcome.clone(),
        };
        self.tell_left_unknown(false, false);
        Some(outcome)
    }

    pub(super) fn finish(&mut self, outcome: Outcome) {
        let state = match &outcome {
            Outcome::Completed => State::Completed,
            Outcome::Stopped(_) => State::Stopped,
        };
        self.enter(state);
        self.phase = Phase::Over(outcome);
    }

    /// The next event of the stage; the frames before it are sent.
    pub(super) fn poll_stage(&mut self) -> Option<StageEvent> {
        loop {
            match self.stage.poll()? {
                stage::Output::Transmit(frame) => self.send(frame),
                stage::Output::Event(event) => return Some(event),
            }
        }
    }
}
