//! The run machine.

mod events;
mod hold;

use self::hold::Hold;
use crate::canopen::Frame;
use crate::observer::ObserverError;
use crate::session::config::{PlaneOutOfReach, SessionConfig};
use crate::session::estimation::Estimation;
use crate::session::insertion::{DueStep, Insertion};
use crate::session::outcome::Outcome;
use crate::session::reach::check_reach;
use crate::session::record::{Direction, Lane, Record, Severity, StageRecord, StepRecord};
use crate::session::state::{ControlState, ObserverState, SessionState, State, TrackerState};
use crate::session::steering::Decision;
use crate::session::tracking::Tracking;
use crate::stage::{self, Feedback, SetPoint, Stage, StageConfigError};
use crate::tracker::{Event, GateCounts, StageHistory, StagePoint};
use crate::units::Time;
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;
use thiserror::Error;

/// Kept of the stage's past beyond what a measurement can come from.
const HISTORY_MARGIN: Duration = Duration::from_secs(1);
/// The stage stops by its own time-outs, for standing and for power; this much after them the run
/// is closed without its word.
const STOP_MARGIN: Duration = Duration::from_secs(1);

/// Something that reaches the session from outside.
#[derive(Debug, Clone, PartialEq)]
pub enum Input {
    /// A frame taken from the bus.
    Frame(Frame),
    /// The bus failed: bus off, interface down, a frame not taken. The text says which.
    BusFault(String),
    /// The bus complains and goes on.
    BusWarning(String),
    /// A tip position, or other news of the tracker's link.
    Tracker(Event),
    /// The operator, or the runtime in his name, ends the run for the reason given.
    Stop(String),
    /// Nothing but the time: to be given at [`Session::deadline`].
    Tick,
}

/// Something that leaves the session.
#[derive(Debug, Clone)]
pub enum Output {
    /// A frame for the bus. It is recorded by whoever sends it, once it was sent.
    Transmit {
        /// When it was made.
        time: Time,
        /// The frame.
        frame: Frame,
    },
    /// A record for telemetry.
    Record(Record),
}

/// How far a run is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Progress {
    /// Measured depth from the start, mm.
    pub insertion_meas_mm: f64,
    /// Depth to reach, mm.
    pub depth_mm: f64,
}

/// A configuration that a session cannot start with.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum SessionError {
    /// An observer refuses it.
    #[error("observer: {0}")]
    Observer(#[from] ObserverError),
    /// The stage refuses it.
    #[error("stage: {0}")]
    Stage(#[from] StageConfigError),
}

/// So much is told of what follows the reason to stop: a bus may fail for good in many ways.
const THEN_MAX: usize = 8;

/// Where the run is.
#[derive(Debug, Clone)]
enum Phase {
    /// The stage is brought up and the first tip position awaited.
    Preparing,
    /// The needle is steered.
    Inserting,
    /// The drives stand down, in order or after a fault; the run will have ended as `outcome`.
    Stopping { outcome: Outcome, since: Time },
    /// Over; nothing is sent any more.
    Done(Outcome),
}

/// How far the stage is on its way to power.
#[derive(Debug, Clone, Copy)]
enum Power {
    /// The drives are brought up.
    Off,
    /// They are ready for it since then.
    Awaited(Time),
    /// They are being enabled.
    ComingOn,
    /// They are enabled since then.
    On(Time),
}

/// A run, from the first boot-up to the last frame.
///
/// The whole contract: call [`Session::handle`] with the time and one input, drain
/// [`Session::poll`] to `None`, wait until [`Session::deadline`] or the next input, repeat until
/// [`Session::outcome`] says how it ended. Nothing in it touches a clock, a socket, a file or a
/// thread, so a live, an emulated and a replayed run are the same run.
///
/// Motion follows from feedback alone: a set-point is computed only when both drives have
/// answered a SYNC, from that answer, while the newest believed tip position is young enough.
/// Every fault ends in both axes stopped; nothing in here starts again after one.
pub struct Session {
    config: SessionConfig,
    begun: Time,
    phase: Phase,
    stage: Stage,
    power: Power,
    /// The tip was believed when the last input had been taken.
    tip_believed: bool,
    tracking: Tracking,
    /// Measured stage positions, depth never receding: what the needle has cut.
    history: StageHistory,
    estimation: Estimation,
    insertion: Option<Insertion>,
    hold: Option<Hold>,
    /// The state each part is in.
    states: BTreeMap<Lane, State>,
    /// What was told of what followed the reason to stop.
    then: Vec<String>,
    outputs: VecDeque<Output>,
    progress: Progress,
}

impl Session {
    /// A run that begins at `now`.
    ///
    /// # Errors
    /// [`SessionError`] where an observer or the stage refuses its configuration.
    pub fn new(config: SessionConfig, now: Time) -> Result<Self, SessionError> {
        let estimation = Estimation::new(&config)?;
        let mut session = Session {
            begun: now,
            phase: Phase::Preparing,
            stage: Stage::new(config.stage.clone(), now)?,
            power: Power::Off,
            tip_believed: false,
            tracking: Tracking::new(&config),
            history: StageHistory::new(history_points(&config), Duration::ZERO),
            estimation,
            insertion: None,
            hold: None,
            states: BTreeMap::new(),
            then: Vec::new(),
            outputs: VecDeque::new(),
            progress: Progress { insertion_meas_mm: 0.0, depth_mm: config.insertion.depth_mm },
            config,
        };
        session.stage.permit_power(false);
        session.record(Record::Begun { time: now });
        session.state(now, SessionState::Preparing);
        session.state(now, TrackerState::Waiting);
        session.drain_stage(now);
        Ok(session)
    }

    /// Takes one input at `now`.
    pub fn handle(&mut self, now: Time, input: Input) {
        if matches!(self.phase, Phase::Done(_)) {
            // Of the last frame, which a replay would miss.
            if matches!(input, Input::BusFault(_)) {
                self.record(Record::Input { time: now, input });
            }
            return;
        }
        self.record(Record::Input { time: now, input: input.clone() });
        match input {
            Input::Frame(frame) => {
                self.record(Record::Can { time: now, direction: Direction::Received, frame });
                self.stage.handle_frame(now, &frame);
            }
            Input::BusFault(reason) => self.stop(now, format!("can: {reason}")),
            Input::BusWarning(text) => self.event(now, Lane::Stage, Severity::Warning, text),
            Input::Tracker(event) => self.take_tracker_event(now, event),
            Input::Stop(reason) => self.stop(now, reason),
            Input::Tick => {}
        }
        // Feedback is answered before the next SYNC goes out, however late the call is.
        self.drain_stage(now);
        self.permit_power(now);
        if now >= self.stage.deadline() {
            self.stage.handle_timeout(now);
            self.drain_stage(now);
        }
        self.check_deadlines(now);
        self.drain_stage(now);
        if matches!(self.phase, Phase::Stopping { .. }) {
            self.tracking.give_up_on_the_unpaired(now);
            self.drain_tracking(now);
        }
    }

    /// The next thing to leave the session; `None` when it has nothing more to say for now.
    pub fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// When to call [`Session::handle`] with [`Input::Tick`] if nothing comes before.
    pub fn deadline(&self) -> Time {
        match &self.phase {
            Phase::Preparing => self.stage.deadline().min(self.tip_due()),
            Phase::Inserting => self.stage.deadline(),
            Phase::Stopping { since, .. } => {
                self.stage.deadline().min(*since + self.stop_timeout())
            }
            Phase::Done(_) => Time::NEVER,
        }
    }

    /// How the run ended; `None` while it goes on.
    pub fn outcome(&self) -> Option<&Outcome> {
        match &self.phase {
            Phase::Done(outcome) => Some(outcome),
            _ => None,
        }
    }

    /// How far the run is.
    pub fn progress(&self) -> Progress {
        self.progress
    }

    /// How long the drives bear not to hear of the bench; `None` before they are enabled and once
    /// they are being stopped.
    pub fn silence_max(&self) -> Option<Duration> {
        let enabled = matches!(self.power, Power::On(_));
        let goes_on = matches!(self.phase, Phase::Preparing | Phase::Inserting);
        (enabled && goes_on).then_some(self.config.stage.heartbeat.consumer_time)
    }

    /// What did not go as it should on the stage's bus, and did no harm.
    pub fn stage_counters(&self) -> stage::Counters {
        self.stage.counters()
    }

    /// What the tracker's gates did with its samples.
    pub fn gate_counts(&self) -> GateCounts {
        self.tracking.counts()
    }

    fn record(&mut self, record: Record) {
        self.outputs.push_back(Output::Record(record));
    }

    /// Records that a part of the bench is in `state`, where that is news.
    fn state(&mut self, time: Time, state: impl Into<State>) {
        let state = state.into();
        if self.states.insert(state.lane(), state) != Some(state) {
            self.record(Record::State { time, state });
        }
    }

    fn event(&mut self, time: Time, lane: Lane, severity: Severity, text: String) {
        self.record(Record::Event { time, lane, severity, text });
    }

    /// Everything the stage has to say, acted upon.
    fn drain_stage(&mut self, now: Time) {
        while let Some(output) = self.stage.poll() {
            match output {
                stage::Output::Transmit(frame) => {
                    self.outputs.push_back(Output::Transmit { time: now, frame });
                }
                stage::Output::Event(event) => self.take_stage_event(now, event),
            }
        }
    }

    /// Everything the tracking has to record, and its state.
    fn drain_tracking(&mut self, now: Time) {
        while let Some(record) = self.tracking.poll() {
            self.record(record);
        }
        let state = self.tracking.state(now);
        self.state(now, state);
    }

    /// Both drives have answered a SYNC: pair, estimate, decide, command.
    fn take_feedback(&mut self, now: Time, feedback: &Feedback) {
        let cut_mm = self.history.newest().map_or(f64::NEG_INFINITY, |point| point.insertion_mm);
        let point = StagePoint {
            time: feedback.time,
            insertion_mm: feedback.insertion_mm.max(cut_mm),
            rotation_rad: feedback.rotation_rad,
        };
        if let Err(error) = self.history.push(point) {
            return self.stop(now, error.to_string());
        }
        let measurements = self.tracking.judge(now, &self.history, &self.estimation);
        self.drain_tracking(now);
        if matches!(self.phase, Phase::Preparing) {
            self.begin_if_ready(now, feedback);
        }
        let Some(mut insertion) = self.insertion.take() else { return };
        let at = insertion.measured(feedback.insertion_mm, feedback.rotation_rad);
        let commanded = insertion.commanded(feedback.insertion_cmd_mm, feedback.rotation_cmd_rad);
        self.progress.insertion_meas_mm = at.insertion_mm;
        self.record(Record::Stage(StageRecord {
            time: feedback.time,
            insertion_meas_mm: at.insertion_mm,
            rotation_meas_rad: at.rotation_rad,
            insertion_cmd_mm: commanded.insertion_mm,
            rotation_cmd_rad: commanded.rotation_rad,
        }));
        if matches!(self.phase, Phase::Inserting) {
            for measurement in measurements {
                self.estimation.gather(&measurement);
                insertion.measure(measurement);
            }
            if let Err(reason) = self.insert(now, feedback, at, &mut insertion) {
                self.stop(now, reason);
            }
        }
        self.insertion = Some(insertion);
    }

    /// The axes get power only while the tip is believed, from a start from which the plane can be
    /// reached.
    fn permit_power(&mut self, now: Time) {
        if !matches!(self.phase, Phase::Preparing) {
            return;
        }
        let was_believed = self.tip_believed;
        self.tip_believed = self.tracking.is_held() && self.tracking.is_fresh(now);
        if self.tip_believed
            && !was_believed
            && matches!(self.power, Power::Off | Power::Awaited(_))
        {
            self.check_reach(now);
        }
        self.stage.permit_power(self.tip_believed);
    }

    fn check_reach(&mut self, now: Time) {
        let tip_mm = self.tracking.tip_mm();
        let Some(Err(why)) = tip_mm.map(|tip_mm| check_reach(&self.config, &tip_mm)) else {
            return;
        };
        match self.config.plane_out_of_reach {
            PlaneOutOfReach::Insert => self.event(now, Lane::Session, Severity::Warning, why),
            PlaneOutOfReach::Refuse => {
                let next = "see insertion.plane_out_of_reach";
                self.stop(now, format!("insertion: {why}; {next}"));
            }
        }
    }

    /// Starts the insertion once the stage is enabled and the tip is seen.
    fn begin_if_ready(&mut self, now: Time, feedback: &Feedback) {
        let is_on = matches!(self.power, Power::On(_));
        if !is_on || !self.tracking.is_held() || !self.tracking.is_fresh(now) {
            return;
        }
        let measured =
            SetPoint { insertion_mm: feedback.insertion_mm, rotation_rad: feedback.rotation_rad };
        let held = SetPoint {
            insertion_mm: feedback.insertion_cmd_mm,
            rotation_rad: feedback.rotation_cmd_rad,
        };
        self.insertion = Some(Insertion::new(self.config.insertion, measured, held));
        self.phase = Phase::Inserting;
        self.state(now, SessionState::Inserting);
    }

    /// One SYNC of the insertion: checks, the step that is due, the next set-point. An error is
    /// the reason to stop for.
    fn insert(
        &mut self,
        now: Time,
        feedback: &Feedback,
        at: SetPoint,
        insertion: &mut Insertion,
    ) -> Result<(), String> {
        let oldest = feedback.time - self.config.tracker.hold_after;
        self.estimation.carry_to(oldest, &self.history).map_err(|error| error.to_string())?;
        let due = feedback.time - self.config.tracker.hold_after / 2;
        self.estimation.watch(due, oldest, &self.history).map_err(|error| error.to_string())?;
        if self.config.tracker.judges_stream {
            self.tracking.check_travel().map_err(|error| format!("tracker: {error}"))?;
        }
        self.watch_tip(feedback.time, at, insertion)?;
        insertion.check_arrival(feedback.time, at.insertion_mm)?;
        if let Some(due) = insertion.due(feedback.time, at.insertion_mm) {
            let command = self.step(feedback.time, at, &due)?;
            match command {
                Some(rotation_rad_per_mm) => insertion.steer(rotation_rad_per_mm),
                None => {
                    self.begin_stopping(now, Outcome::Completed);
                    return Ok(());
                }
            }
        }
        let set_point = insertion.advance(self.config.stage.sync_period);
        self.stage.command(set_point).map_err(|error| format!("stage: {error}"))
    }

    /// Takes one step: observe, decide, record. Gives the rotation rate for the next step; `None`
    /// after the last.
    fn step(&mut self, time: Time, at: SetPoint, due: &DueStep) -> Result<Option<f64>, String> {
        let history = &self.history;
        let innovation_mm = match &due.measurement {
            Some(measurement) => self.estimation.take(measurement, history),
            None => Ok(None),
        };
        let innovation_mm = innovation_mm.map_err(|error| error.to_string())?;
        let decision = self.estimation.decide(time, history, due.is_last);
        let Decision { estimate, shadows, rotation_cmd_rad_per_mm, command_saturated, refused } =
            decision.map_err(|error| error.to_string())?;
        let observer = match &estimate {
            None => ObserverState::Waiting,
            Some(estimate) if !estimate.is_roll_known() => ObserverState::RollUnknown,
            Some(_) => ObserverState::Estimating,
        };
        self.state(time, observer);
        let control =
            if command_saturated { ControlState::Saturated } else { ControlState::Steering };
        self.state(time, control);
        self.record(Record::Step(Box::new(StepRecord {
            step: due.step,
            time,
            insertion_meas_mm: at.insertion_mm,
            rotation_meas_rad: at.rotation_rad,
            rotation_cmd_rad_per_mm,
            command_saturated,
            tip_meas_mm: due.measurement.map(|m| m.tip_meas.mm()),
            tip_meas_insertion_mm: due.measurement.map(|m| m.insertion_meas_mm),
            tip_meas_age_s: due.measurement.map(|m| time.seconds_after(m.acquisition_time)),
            innovation_mm,
            estimate,
            shadows,
        })));
        match refused {
            Some(error) => Err(error.to_string()),
            None => Ok(rotation_cmd_rad_per_mm),
        }
    }

    /// When, before the insertion, a tip to begin with is awaited no longer: some time after the
    /// last was seen, and once nothing but the tip is awaited, some time after that whatever is seen.
    fn tip_due(&self) -> Time {
        let heard = self.tracking.last_acquisition().unwrap_or(self.begun).max(self.begun);
        let since = match self.power {
            Power::Off | Power::ComingOn => heard,
            Power::Awaited(since) | Power::On(since) => since.min(heard),
        };
        since + self.config.tracker.timeout
    }

    /// The longest a stop may take by the stage's own time-outs, and a margin.
    fn stop_timeout(&self) -> Duration {
        self.config.stage.stop_timeout * 2 + STOP_MARGIN
    }

    /// Deadlines of the run itself.
    fn check_deadlines(&mut self, now: Time) {
        match &self.phase {
            Phase::Preparing if now >= self.tip_due() => {
                let silence = self.tracking.explain_silence();
                let limit_s = self.config.tracker.timeout.as_secs_f64();
                let fresh_s = self.config.tracker.hold_after.as_secs_f64();
                let seen = match self.tracking.age_s(now) {
                    Some(age_s) => format!("the last was {age_s:.2} s old (limit {fresh_s:.2}); "),
                    None => String::new(),
                };
                self.stop(now, format!("tracker: no tip within {limit_s:.1} s; {seen}{silence}"));
            }
            Phase::Stopping { outcome, since } if now >= *since + self.stop_timeout() => {
                let outcome = match outcome {
                    Outcome::Completed => Outcome::Stopped(format!(
                        "stage: the drives did not stand down within {:.0} s",
                        self.stop_timeout().as_secs_f64()
                    )),
                    stopped => stopped.clone(),
                };
                self.finish(now, outcome);
            }
            _ => {}
        }
    }

    /// Ends the run for `reason`: both axes are quick-stopped. The first reason stands.
    fn stop(&mut self, now: Time, reason: String) {
        match &self.phase {
            Phase::Done(_) | Phase::Stopping { outcome: Outcome::Stopped(_), .. } => {
                // A bus that is gone says so at every frame.
                if self.then.len() < THEN_MAX && !self.then.contains(&reason) {
                    self.event(now, Lane::Session, Severity::Warning, format!("then: {reason}"));
                    self.then.push(reason);
                }
            }
            _ => {
                self.event(now, Lane::Session, Severity::Fault, reason.clone());
                self.stage.quick_stop(now);
                self.begin_stopping(now, Outcome::Stopped(reason));
            }
        }
    }

    fn begin_stopping(&mut self, now: Time, outcome: Outcome) {
        if outcome == Outcome::Completed {
            self.stage.disable(now);
        }
        self.phase = Phase::Stopping { outcome, since: now };
        self.state(now, SessionState::Stopping);
    }

    fn finish(&mut self, now: Time, outcome: Outcome) {
        self.tracking.close(now);
        self.drain_tracking(now);
        let state = match &outcome {
            Outcome::Completed => SessionState::Completed,
            Outcome::Stopped(_) => SessionState::Stopped,
        };
        self.state(now, state);
        self.phase = Phase::Done(outcome);
    }
}

/// How many SYNCs the history holds: those that a measurement can come from, and a margin.
fn history_points(config: &SessionConfig) -> usize {
    // Positions are gathered for half as long before the watch over the stream takes their mean.
    let span = config.tracker.hold_after * 2 + HISTORY_MARGIN;
    (span.as_nanos() / config.stage.sync_period.as_nanos().max(1)) as usize + 2
}
