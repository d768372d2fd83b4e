//! The operation machine.

use std::collections::VecDeque;
use std::time::Duration;

use super::answer::{Answering, Next};
use super::moving::{Moving, along, commanded, measured};
use super::silence::Silence;
use super::{Move, Task};
use crate::canopen::Frame;
use crate::canopen::emcy::EmcyCode;
use crate::session::{
    Direction, Input, Lane, Machine, Outcome, Output, Progress, Record, SessionState, Severity,
    StageRecord, StageState, State, left_unknown, news,
};
use crate::stage::{
    self, Axis, AxisLimits, Counters, Feedback, SetPoint, Stage, StageConfig, StageConfigError,
    StageEvent,
};
use crate::units::Time;

/// The stage stops by its own time-outs, for standing and for power; this much after them the
/// operation is closed without its word.
const STOP_MARGIN: Duration = Duration::from_secs(1);

/// Everything an operation needs to know.
#[derive(Debug, Clone, PartialEq)]
pub struct OperationConfig {
    /// The two drives.
    pub stage: StageConfig,
    /// What is to be done.
    pub task: Task,
}

/// What an axis has done.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Done {
    /// Which axis.
    pub axis: Axis,
    /// Where it began, mm or rad; `None` before it was homed.
    pub from: Option<f64>,
    /// Where it stood last, mm or rad.
    pub to: f64,
}

/// Where the operation is.
#[derive(Debug, Clone)]
enum Phase {
    /// The stage is brought up.
    Preparing,
    /// The axes still to be homed, the one that is being homed first.
    Homing(VecDeque<Axis>),
    Moving(Box<Moving>),
    /// The base turns in air, and a sensor answers.
    Answering(Box<Answering>),
    /// Both axes are held, and the bench says nothing.
    Silent(Box<Silence>),
    /// The drives stand down; the operation will have ended as `outcome`.
    Stopping {
        outcome: Outcome,
        since: Time,
    },
    /// Over; nothing is sent any more.
    Over(Outcome),
}

/// An operation, from the first boot-up to the last frame; driven as a session is, see [`Machine`].
#[derive(Debug)]
pub struct Operation {
    config: OperationConfig,
    phase: Phase,
    stage: Stage,
    done: Vec<Done>,
    /// The drives were enabled.
    had_power: bool,
    outputs: VecDeque<Output>,
}

impl Operation {
    /// An operation that begins at `now`.
    ///
    /// # Errors
    /// Where the stage refuses its configuration, or an axis is to be homed without being told how.
    pub fn new(config: OperationConfig, now: Time) -> Result<Self, StageConfigError> {
        let stage = match config.task {
            Task::Home(axes) => Stage::for_homing(config.stage.clone(), axes, now)?,
            Task::Move(_) | Task::Prove | Task::Answer(_) => Stage::new(config.stage.clone(), now)?,
        };
        let (done, outputs) = (Vec::new(), VecDeque::new());
        let mut operation =
            Operation { config, phase: Phase::Preparing, stage, done, had_power: false, outputs };
        operation.state(now, SessionState::Preparing);
        operation.drain_stage(now);
        Ok(operation)
    }

    /// What the axes have done so far.
    pub fn done(&self) -> &[Done] {
        &self.done
    }

    fn record(&mut self, record: Record) {
        self.outputs.push_back(Output::Record(record));
    }

    fn state(&mut self, time: Time, state: impl Into<State>) {
        self.record(Record::State { time, state: state.into() });
    }

    fn event(&mut self, time: Time, lane: Lane, severity: Severity, text: String) {
        self.record(Record::Event { time, lane, severity, text });
    }

    fn transmit(&mut self, now: Time, frame: Frame) {
        self.outputs.push_back(Output::Transmit { time: now, frame });
    }

    /// Everything the stage has to say, acted upon.
    fn drain_stage(&mut self, now: Time) {
        while let Some(output) = self.stage.poll() {
            match output {
                stage::Output::Transmit(frame) => self.transmit(now, frame),
                stage::Output::Event(event) => self.take_stage_event(now, event),
            }
        }
    }

    /// What a silence asks the drives, and what has come of it.
    fn drain_silence(&mut self, now: Time) {
        let Phase::Silent(silence) = &mut self.phase else { return };
        silence.handle_timeout(now);
        let verdict = silence.verdict(now);
        let asked: Vec<Frame> = std::iter::from_fn(|| silence.poll_transmit()).collect();
        asked.into_iter().for_each(|frame| self.transmit(now, frame));
        match verdict {
            None => {}
            Some(Err(reason)) => self.stop(now, reason),
            Some(Ok(())) => {
                self.stage.quick_stop(now);
                self.begin_stopping(now, Outcome::Completed);
            }
        }
    }

    fn take_stage_event(&mut self, now: Time, event: StageEvent) {
        if let Some((severity, text)) = news(&event) {
            self.event(now, Lane::Stage, severity, text);
        }
        match event {
            StageEvent::Located(at) => {
                if let Err(reason) = self.check_move(at) {
                    self.stop(now, reason);
                }
            }
            StageEvent::Ready => self.begin(now),
            StageEvent::Feedback(feedback) => self.take_feedback(now, &feedback),
            StageEvent::Homed { axis, position } => self.take_home(now, axis, position),
            StageEvent::Identity(axis, identity) => {
                let node = self.config.stage.axis(axis).node;
                self.record(Record::Drive { time: now, axis, node, identity });
            }
            StageEvent::Emergency(axis, emcy) if emcy.code == EmcyCode::HEARTBEAT => {
                self.take_notice(now, axis);
            }
            StageEvent::Fault(fault) => self.stop(now, format!("stage: {fault}")),
            StageEvent::Stopped { standing, off } => {
                // What it still sends belongs to the operation, whose end is the last word.
                self.drain_stage(now);
                let unknown = left_unknown(standing, off).filter(|_| self.had_power);
                if let Some(text) = unknown {
                    self.event(now, Lane::Stage, Severity::Warning, text.to_owned());
                }
                self.state(now, StageState::Stopped);
                let by_itself = || Outcome::Stopped("stage: stopped by itself".to_owned());
                let outcome = match (&self.phase, unknown) {
                    // Nothing that may still have power is a success.
                    (Phase::Stopping { outcome: Outcome::Completed, .. }, Some(text)) if !off => {
                        Outcome::Stopped(format!("stage: {text}"))
                    }
                    (Phase::Stopping { outcome, .. } | Phase::Over(outcome), _) => outcome.clone(),
                    _ => by_itself(),
                };
                self.finish(now, outcome);
            }
            _ => {}
        }
    }

    /// Both drives are enabled and held.
    fn begin(&mut self, now: Time) {
        self.had_power = true;
        self.state(now, StageState::Enabled);
        match &self.config.task {
            Task::Home(axes) => {
                let axes = *axes;
                self.state(now, SessionState::Homing);
                let chosen = Axis::BOTH.into_iter().filter(|axis| axes[*axis]);
                self.phase = Phase::Homing(chosen.collect());
                self.home_next(now);
            }
            Task::Prove => {
                self.state(now, SessionState::Silent);
                self.stage.fall_silent();
                self.phase = Phase::Silent(Box::new(Silence::new(&self.config.stage, now)));
                self.drain_silence(now);
            }
            Task::Answer(settings) => {
                let answering = Answering::new(settings);
                self.state(now, SessionState::TurningInAir);
                self.phase = Phase::Answering(Box::new(answering));
            }
            // Begins with the first positions.
            Task::Move(_) => {}
        }
    }

    fn take_notice(&mut self, now: Time, axis: Axis) {
        if let Phase::Silent(silence) = &mut self.phase {
            let after_ms = silence.notice(now, axis).as_millis();
            let text = format!("{axis}: noticed the bench's silence after {after_ms} ms");
            self.event(now, Lane::Session, Severity::Info, text);
        }
    }

    fn home_next(&mut self, now: Time) {
        let Phase::Homing(axes) = &self.phase else { return };
        match axes.front().copied() {
            None => self.begin_stopping(now, Outcome::Completed),
            Some(axis) => {
                if let Err(error) = self.stage.home(now, axis) {
                    self.stop(now, format!("stage: {error}"));
                }
            }
        }
    }

    fn take_home(&mut self, now: Time, axis: Axis, position: f64) {
        self.done.push(Done { axis, from: None, to: position });
        let AxisLimits { min, max, .. } = self.config.stage.axis(axis).limits;
        if !(min..=max).contains(&position) {
            let unit = axis.unit();
            return self.stop(
                now,
                format!(
                    "{axis}: home is at {position:.3} {unit}, out of its limits of {min:.3} to \
                     {max:.3} {unit}: nothing could be moved from there; see zero, the limits and \
                     homing offset (0x607C) of the axis"
                ),
            );
        }
        if let Phase::Homing(axes) = &mut self.phase {
            axes.pop_front();
            self.home_next(now);
        }
    }

    fn take_feedback(&mut self, now: Time, feedback: &Feedback) {
        self.record(Record::Stage(StageRecord {
            time: feedback.time,
            insertion_meas_mm: feedback.insertion_mm,
            rotation_meas_rad: feedback.rotation_rad,
            insertion_cmd_mm: feedback.insertion_cmd_mm,
            rotation_cmd_rad: feedback.rotation_cmd_rad,
        }));
        if let Some(done) = self.done.last_mut().filter(|done| done.from.is_some()) {
            done.to = along(done.axis, measured(feedback));
        }
        let moved = match (&self.phase, &self.config.task) {
            (Phase::Preparing, Task::Move(way)) => self.begin_move(now, *way, feedback),
            (Phase::Moving(_), _) => self.go_on(now, feedback),
            (Phase::Answering(_), _) => self.answer(now, feedback),
            _ => Ok(()),
        };
        if let Err(reason) = moved {
            self.stop(now, reason);
        }
    }

    /// Refuses a goal out of the limits before the axes have power.
    fn check_move(&self, at: SetPoint) -> Result<(), String> {
        let goal = match &self.config.task {
            Task::Move(way) => Moving::new(*way, at)?.goal(),
            Task::Answer(settings) => settings.farthest(at),
            Task::Home(_) | Task::Prove => return Ok(()),
        };
        self.stage.check_goal(goal).map_err(|error| format!("stage: {error}"))
    }

    /// From the targets that both axes are held at.
    fn begin_move(&mut self, now: Time, way: Move, feedback: &Feedback) -> Result<(), String> {
        let held = commanded(feedback);
        self.check_move(held)?;
        let moving = Moving::new(way, held)?;
        let from = along(way.axis, moving.from());
        self.done.push(Done { axis: way.axis, from: Some(from), to: from });
        self.state(now, SessionState::Moving);
        self.phase = Phase::Moving(Box::new(moving));
        self.go_on(now, feedback)
    }

    /// One SYNC of a move.
    fn go_on(&mut self, now: Time, feedback: &Feedback) -> Result<(), String> {
        let Phase::Moving(moving) = &mut self.phase else { return Ok(()) };
        if moving.has_arrived(feedback)? {
            self.begin_stopping(now, Outcome::Completed);
            return Ok(());
        }
        let set_point = moving.advance(self.config.stage.sync_period);
        self.stage.command(set_point).map_err(|error| format!("stage: {error}"))
    }

    /// One SYNC of a check of handedness.
    fn answer(&mut self, now: Time, feedback: &Feedback) -> Result<(), String> {
        let Phase::Answering(answering) = &mut self.phase else { return Ok(()) };
        match answering.advance(feedback, self.config.stage.sync_period)? {
            Next::Hold => {}
            Next::Go(set_point) => {
                self.stage.command(set_point).map_err(|error| format!("stage: {error}"))?;
            }
            Next::Answered(said) => self.event(now, Lane::Session, Severity::Info, said),
            Next::Over => self.begin_stopping(now, Outcome::Completed),
        }
        Ok(())
    }

    /// The longest a stop may take by the stage's own time-outs, and a margin.
    fn stop_timeout(&self) -> Duration {
        self.config.stage.stop_timeout * 2 + STOP_MARGIN
    }

    fn check_deadline(&mut self, now: Time) {
        let timeout = self.stop_timeout();
        if let Phase::Stopping { outcome, since } = &self.phase
            && now >= *since + timeout
        {
            let late = format!(
                "stage: the drives did not stand down within {:.0} s",
                timeout.as_secs_f64()
            );
            let outcome = match outcome {
                Outcome::Completed => Outcome::Stopped(late),
                stopped => stopped.clone(),
            };
            self.finish(now, outcome);
        }
    }

    /// Ends the operation for `reason`: both axes are quick-stopped. The first reason stands.
    fn stop(&mut self, now: Time, reason: String) {
        if matches!(
            self.phase,
            Phase::Over(_) | Phase::Stopping { outcome: Outcome::Stopped(_), .. }
        ) {
            return;
        }
        self.event(now, Lane::Session, Severity::Fault, reason.clone());
        self.stage.quick_stop(now);
        self.begin_stopping(now, Outcome::Stopped(reason));
    }

    fn begin_stopping(&mut self, now: Time, outcome: Outcome) {
        if outcome == Outcome::Completed {
            // Drives that were quick-stopped already are past it.
            self.stage.disable(now);
        }
        self.phase = Phase::Stopping { outcome, since: now };
        self.state(now, SessionState::Stopping);
    }

    fn finish(&mut self, now: Time, outcome: Outcome) {
        if matches!(self.phase, Phase::Over(_)) {
            return;
        }
        let state = match &outcome {
            Outcome::Completed => SessionState::Completed,
            Outcome::Stopped(_) => SessionState::Stopped,
        };
        self.state(now, state);
        self.phase = Phase::Over(outcome);
    }
}

impl Machine for Operation {
    fn handle(&mut self, now: Time, input: Input) {
        if matches!(self.phase, Phase::Over(_)) {
            return;
        }
        match input {
            Input::Frame(frame) => {
                self.record(Record::Can { time: now, direction: Direction::Received, frame });
                self.stage.handle_frame(now, &frame);
                if let Phase::Silent(silence) = &mut self.phase {
                    silence.handle_frame(now, &frame);
                }
            }
            Input::BusFault(reason) => self.stop(now, format!("can: {reason}")),
            Input::BusWarning(text) => self.event(now, Lane::Stage, Severity::Warning, text),
            Input::Stop(reason) => self.stop(now, reason),
            Input::Tracker(event) => {
                if let Phase::Answering(answering) = &mut self.phase {
                    answering.take(now, &event);
                }
            }
            Input::Tick => {}
        }
        // Feedback is answered before the next SYNC goes out, however late the call is.
        self.drain_stage(now);
        if now >= self.stage.deadline() {
            self.stage.handle_timeout(now);
            self.drain_stage(now);
        }
        self.drain_silence(now);
        self.drain_stage(now);
        self.check_deadline(now);
    }

    fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    fn deadline(&self) -> Time {
        match &self.phase {
            Phase::Stopping { since, .. } => {
                self.stage.deadline().min(*since + self.stop_timeout())
            }
            Phase::Silent(silence) => self.stage.deadline().min(silence.deadline()),
            Phase::Over(_) => Time::NEVER,
            _ => self.stage.deadline(),
        }
    }

    fn outcome(&self) -> Option<&Outcome> {
        match &self.phase {
            Phase::Over(outcome) => Some(outcome),
            _ => None,
        }
    }

    fn progress(&self) -> Progress {
        Progress { insertion_meas_mm: 0.0, depth_mm: 0.0 }
    }

    fn stage_counters(&self) -> Counters {
        self.stage.counters()
    }

    fn silence_max(&self) -> Option<Duration> {
        let moves = matches!(self.config.task, Task::Move(_)) && self.had_power;
        let watched = match self.phase {
            Phase::Homing(_) | Phase::Moving(_) | Phase::Answering(_) => true,
            Phase::Preparing => moves,
            Phase::Silent(_) | Phase::Stopping { .. } | Phase::Over(_) => false,
        };
        watched.then_some(self.config.stage.heartbeat.consumer_time)
    }
}
