//! The states of the parts of the bench.

use super::record::Lane;
use std::fmt;

/// A part of the bench and the state that it is in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    /// Of the run itself.
    Session(SessionState),
    /// Of the CANopen stage.
    Stage(StageState),
    /// Of the tracker stream.
    Tracker(TrackerState),
    /// Of the observer that steers.
    Observer(ObserverState),
    /// Of the controller.
    Control(ControlState),
}

/// The states of a run, an insertion or an operation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SessionState {
    /// The stage is brought up, and a tip awaited.
    Preparing,
    /// The needle is steered.
    Inserting,
    /// The insertion is held: the tip is not seen.
    Holding,
    /// An axis finds its home.
    Homing,
    /// An axis moves to where it was sent.
    Moving,
    /// The bench says nothing, to see whether the drives notice.
    Silent,
    /// The base turns in air.
    TurningInAir,
    /// The drives stand down.
    Stopping,
    /// Over, and done.
    Completed,
    /// Over, for a reason.
    Stopped,
}

/// The states of the stage.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StageState {
    /// Both axes have power and follow their targets.
    Enabled,
    /// Both axes were told to take power off.
    Stopped,
}

/// The states of the tracker stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrackerState {
    /// No tip was seen yet.
    Waiting,
    /// The tip is seen.
    Tracking,
    /// The tip is not seen just now.
    Coasting,
    /// What is seen is not believed to be the tip.
    Lost,
    /// There is no link.
    Disconnected,
}

/// The states of the observer that steers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ObserverState {
    /// It has no estimate yet.
    Waiting,
    /// It has an estimate but for the roll.
    RollUnknown,
    /// It has an estimate.
    Estimating,
}

/// The states of the controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ControlState {
    /// Its demand is within its limits.
    Steering,
    /// It asks for more than its limits let through.
    Saturated,
}

impl State {
    /// Every state of every part.
    const ALL: [State; 22] = [
        State::Session(SessionState::Preparing),
        State::Session(SessionState::Inserting),
        State::Session(SessionState::Holding),
        State::Session(SessionState::Homing),
        State::Session(SessionState::Moving),
        State::Session(SessionState::Silent),
        State::Session(SessionState::TurningInAir),
        State::Session(SessionState::Stopping),
        State::Session(SessionState::Completed),
        State::Session(SessionState::Stopped),
        State::Stage(StageState::Enabled),
        State::Stage(StageState::Stopped),
        State::Tracker(TrackerState::Waiting),
        State::Tracker(TrackerState::Tracking),
        State::Tracker(TrackerState::Coasting),
        State::Tracker(TrackerState::Lost),
        State::Tracker(TrackerState::Disconnected),
        State::Observer(ObserverState::Waiting),
        State::Observer(ObserverState::RollUnknown),
        State::Observer(ObserverState::Estimating),
        State::Control(ControlState::Steering),
        State::Control(ControlState::Saturated),
    ];

    /// The state of `lane` that has this name in `events.log`.
    pub fn named(lane: Lane, name: &str) -> Option<Self> {
        State::ALL.into_iter().find(|state| state.lane() == lane && state.as_str() == name)
    }

    /// The part of the bench that is in this state.
    pub const fn lane(self) -> Lane {
        match self {
            State::Session(_) => Lane::Session,
            State::Stage(_) => Lane::Stage,
            State::Tracker(_) => Lane::Tracker,
            State::Observer(_) => Lane::Observer,
            State::Control(_) => Lane::Control,
        }
    }

    /// The state's name, as `events.log` has it.
    pub const fn as_str(self) -> &'static str {
        match self {
            State::Session(SessionState::Preparing) => "preparing",
            State::Session(SessionState::Inserting) => "inserting",
            State::Session(SessionState::Holding) => "holding",
            State::Session(SessionState::Homing) => "homing",
            State::Session(SessionState::Moving) => "moving",
            State::Session(SessionState::Silent) => "silent",
            State::Session(SessionState::TurningInAir) => "turning in air",
            State::Session(SessionState::Stopping) => "stopping",
            State::Session(SessionState::Completed) => "completed",
            State::Session(SessionState::Stopped) | State::Stage(StageState::Stopped) => "stopped",
            State::Stage(StageState::Enabled) => "operation enabled",
            State::Tracker(TrackerState::Waiting) | State::Observer(ObserverState::Waiting) => {
                "waiting"
            }
            State::Tracker(TrackerState::Tracking) => "tracking",
            State::Tracker(TrackerState::Coasting) => "coasting",
            State::Tracker(TrackerState::Lost) => "lost",
            State::Tracker(TrackerState::Disconnected) => "disconnected",
            State::Observer(ObserverState::RollUnknown) => "roll not known yet",
            State::Observer(ObserverState::Estimating) => "estimating",
            State::Control(ControlState::Steering) => "steering",
            State::Control(ControlState::Saturated) => "saturated",
        }
    }
}

impl fmt::Display for State {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl From<SessionState> for State {
    fn from(state: SessionState) -> Self {
        State::Session(state)
    }
}

impl From<StageState> for State {
    fn from(state: StageState) -> Self {
        State::Stage(state)
    }
}

impl From<TrackerState> for State {
    fn from(state: TrackerState) -> Self {
        State::Tracker(state)
    }
}

impl From<ObserverState> for State {
    fn from(state: ObserverState) -> Self {
        State::Observer(state)
    }
}

impl From<ControlState> for State {
    fn from(state: ControlState) -> Self {
        State::Control(state)
    }
}
