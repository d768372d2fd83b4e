//! The stage of a run, from its bring-up to power off, and the record of the run.

use super::outcome::{Outcome, StageAtEnd};
use super::record::{Lane, Record, Severity};
use super::state::State;
use super::{Output, stage_news, unconfirmed_stop};
use crate::canopen::{Frame, cob};
use crate::stage::{self, Axis, SetPoint, Stage, StageConfig, StageEvent, StageProgress};
use crate::units::Time;
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

/// The stage has its own timeouts for standstill and for power off. If it has reported nothing for this
/// long after them, the run is closed.
const STOP_MARGIN: Duration = Duration::from_secs(1);

/// Maximum number of follow-up reasons that are reported.
const FOLLOW_UPS_MAX: usize = 8;

/// The phase of a run.
#[derive(Debug, Clone)]
enum Phase {
    /// The stage is being brought up, or the task is under way.
    Running,
    /// The drives are being stopped, in order or after a fault; the run will end as `outcome`.
    Stopping { outcome: Outcome, since: Time },
    /// Over; nothing more is sent.
    Over(Outcome),
}

/// How far the stage is on its way to power.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Power {
    /// The drives are being brought up.
    Off,
    /// The drives have been ready for power since this time.
    Awaited(Time),
    /// The drives are being enabled.
    Enabling,
    /// The drives have been enabled since this time.
    On(Time),
}

/// The stage and the record of a run. Its [`Task`](super::Task) acts through this.
#[derive(Debug)]
pub(crate) struct Shell {
    pub(super) stage: Stage,
    /// The time of the present input.
    pub(crate) now: Time,
    phase: Phase,
    power: Power,
    /// The bench has stopped sending its heartbeat on purpose.
    is_silent: bool,
    /// The state of each part of the bench.
    pub(super) states: BTreeMap<Lane, State>,
    /// The follow-up reasons reported since the stop began.
    follow_ups: Vec<String>,
    /// The part of the stop that the drives did not confirm.
    unconfirmed: Option<&'static str>,
    /// A drive had power when the stop began, even if this bench did not switch it on.
    stopped_with_power: bool,
    outputs: VecDeque<Output>,
}

impl Shell {
    pub(super) fn new(stage: Stage, now: Time) -> Self {
        Shell {
            stage,
            now,
            phase: Phase::Running,
            power: Power::Off,
            is_silent: false,
            states: BTreeMap::new(),
            follow_ups: Vec::new(),
            unconfirmed: None,
            stopped_with_power: false,
            outputs: VecDeque::new(),
        }
    }

    /// The configuration of the stage.
    pub(crate) fn config(&self) -> &StageConfig {
        &self.stage.config
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

    /// True until the run is being stopped.
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

    /// Checks that both axes may be sent to `goal` later.
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

    /// Stops the bench's heartbeat, and returns when the last one was sent. SYNC and set-points go on.
    pub(crate) fn stop_heartbeat(&mut self) -> Time {
        self.is_silent = true;
        self.stage.stop_heartbeat().unwrap_or(self.now)
    }

    /// The drives' heartbeat timeout; `None` while they would not notice a stall: before they are enabled,
    /// while they are being stopped, and while the bench is silent on purpose.
    pub(super) fn stall_max(&self) -> Option<Duration> {
        let is_noticed = matches!(self.power, Power::On(_)) && self.is_running() && !self.is_silent;
        is_noticed.then_some(self.config().bus.heartbeat_timeout())
    }

    /// Records an event of the stage.
    pub(super) fn take_stage_event(&mut self, event: &StageEvent) {
        let is_expected = match event {
            // The task refused the position in the event before: the axes stay without power.
            StageEvent::Progress(StageProgress::Enabling) => !self.is_running(),
            // The reply to an SDO request of the task, which reads the drives while the bench is silent.
            StageEvent::Ignored { frame, .. } => self.is_silent && self.is_sdo_answer(frame),
            _ => false,
        };
        if is_expected {
            return;
        }
        if let Some((severity, text)) = stage_news(event) {
            self.report(Lane::Stage, severity, text);
        }
        match event {
            StageEvent::Progress(StageProgress::Enabling) => self.power = Power::Enabling,
            StageEvent::Located(_) => self.power = Power::Awaited(self.now),
            StageEvent::Ready => {
                self.power = Power::On(self.now);
                self.enter(State::Enabled);
            }
            StageEvent::Identity(axis, identity) => {
                let (axis, identity) = (*axis, *identity);
                let node = self.config().axis(axis).node;
                self.record(Record::Drive { time: self.now, axis, node, identity });
            }
            StageEvent::Fault(fault) => self.stop(format!("stage: {fault}")),
            _ => {}
        }
    }

    fn is_sdo_answer(&self, frame: &Frame) -> bool {
        let answers = Axis::BOTH.map(|axis| cob::sdo_tx(self.config().axis(axis).node));
        frame.cob_id().is_some_and(|cob_id| answers.contains(&cob_id))
    }

    /// Stops the run for `reason`, with a quick stop of both axes. The outcome keeps the first reason.
    pub(crate) fn stop(&mut self, reason: String) {
        match &self.phase {
            Phase::Over(_) | Phase::Stopping { outcome: Outcome::Stopped(_), .. } => {
                // A bus that is down reports the same reason for every frame.
                if self.follow_ups.len() < FOLLOW_UPS_MAX && !self.follow_ups.contains(&reason) {
                    self.report(Lane::Session, Severity::Warning, format!("then: {reason}"));
                    self.follow_ups.push(reason);
                }
            }
            Phase::Running | Phase::Stopping { outcome: Outcome::Completed, .. } => {
                self.report(Lane::Session, Severity::Fault, reason.clone());
                self.stage.quick_stop(self.now);
                self.begin_stopping(Outcome::Stopped(reason));
            }
        }
    }

    /// As [`Shell::stop`], for the error of `result`, if it is one.
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

    /// The task is done, and the drives have stopped by themselves, so an orderly shutdown is not possible.
    pub(crate) fn complete_by_quick_stop(&mut self) {
        self.stage.quick_stop(self.now);
        self.begin_stopping(Outcome::Completed);
    }

    fn begin_stopping(&mut self, outcome: Outcome) {
        self.stopped_with_power |= self.had_power();
        self.phase = Phase::Stopping { outcome, since: self.now };
        self.enter(State::Stopping);
    }

    /// The longest time that a stop may take: the stage's own timeouts, plus a margin.
    fn stop_timeout(&self) -> Duration {
        self.config().power.stop_timeout * 2 + STOP_MARGIN
    }

    /// When the shell or its stage next has something to do.
    pub(super) fn deadline(&self) -> Time {
        match &self.phase {
            Phase::Running => self.stage.deadline(),
            Phase::Stopping { since, .. } => {
                self.stage.deadline().min(*since + self.stop_timeout())
            }
            Phase::Over(_) => Time::NEVER,
        }
    }

    /// The outcome once the stage has reported the end of the stop. A run whose drives may still have power
    /// does not count as completed.
    pub(super) fn outcome_of_stop(&mut self, standing: bool, off: bool) -> Outcome {
        self.enter(State::PowerOff);
        let unknown = self.report_unconfirmed(standing, off);
        match (&self.phase, unknown) {
            (Phase::Stopping { outcome: Outcome::Completed, .. }, Some(text)) if !off => {
                Outcome::Stopped(format!("stage: {text}"))
            }
            (Phase::Stopping { outcome, .. } | Phase::Over(outcome), _) => outcome.clone(),
            (Phase::Running, _) => Outcome::Stopped("stage: stopped by itself".to_owned()),
        }
    }

    /// Reports what drives with power did not confirm of the stop.
    fn report_unconfirmed(&mut self, standing: bool, off: bool) -> Option<&'static str> {
        let unknown = unconfirmed_stop(standing, off).filter(|_| self.had_power())?;
        self.report(Lane::Stage, Severity::Warning, unknown.to_owned());
        self.unconfirmed = Some(unknown);
        Some(unknown)
    }

    /// True if the drives had power, from this bench or from elsewhere.
    fn had_power(&self) -> bool {
        let reports = self.stage.drive_reports();
        self.stopped_with_power
            || matches!(self.power, Power::Enabling | Power::On(_))
            || Axis::BOTH.into_iter().any(|axis| reports[axis].says_power())
    }

    /// Where the axes were last measured; `None` before both drives have reported it.
    pub(crate) fn position(&self) -> Option<SetPoint> {
        self.stage.position()
    }

    /// The state in which the run leaves the stage.
    pub(crate) fn stage_at_end(&self) -> StageAtEnd {
        StageAtEnd {
            had_power: self.had_power(),
            unknown: self.unconfirmed,
            drives: self.stage.drive_reports(),
            position: self.position(),
        }
    }

    /// The outcome if the stage has not reported the end of the stop in time.
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
        self.report_unconfirmed(false, false);
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

    /// The next event of the stage. Frames that come before it are queued to be sent.
    pub(super) fn poll_stage(&mut self) -> Option<StageEvent> {
        loop {
            match self.stage.poll()? {
                stage::Output::Transmit(frame) => self.send(frame),
                stage::Output::Event(event) => return Some(event),
            }
        }
    }
}
