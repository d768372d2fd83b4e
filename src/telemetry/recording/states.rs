//! Changes of state, coloured by what they mean.

use super::palette::{COORDINATES, FAULT, GOOD, NEUTRAL, WARNING};
use crate::canopen::cia402::DriveState;
use crate::session::{ControlState, ObserverState, SessionState, StageState, State, TrackerState};
use rerun::{Color, RecordingStream, RecordingStreamResult, StateChange, StateConfiguration};
use std::collections::BTreeMap;

/// The states that each lane was in so far, with their meanings.
#[derive(Debug, Default)]
pub(super) struct States(BTreeMap<String, Vec<(String, Meaning)>>);

impl States {
    /// Logs that `lane` enters `state`, and the colours of its states where this one is new.
    pub(super) fn log(
        &mut self,
        stream: &RecordingStream,
        lane: &str,
        state: &str,
        meaning: Meaning,
    ) -> RecordingStreamResult<()> {
        let path = format!("states/{lane}");
        let known = self.0.entry(lane.to_owned()).or_default();
        if known.iter().all(|(known, _)| known != state) {
            known.push((state.to_owned(), meaning));
            let colours = known.iter().enumerate().map(|(n, (_, meaning))| meaning.colour(n));
            let style = StateConfiguration::new()
                .with_values(known.iter().map(|(state, _)| state.as_str()))
                .with_colors(colours);
            stream.log_static(path.as_str(), &style)?;
        }
        stream.log(path, &StateChange::update_fields().with_state([state]))
    }
}

/// What a state means to the operator: its colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Meaning {
    /// As it should be.
    Good,
    /// On the way to something, or over.
    Passing,
    /// It deserves a look.
    Warning,
    /// Something is wrong.
    Fault,
}

impl Meaning {
    pub(super) fn of(state: State) -> Self {
        use {ControlState as C, ObserverState as O, SessionState as S, TrackerState as T};
        match state {
            State::Session(
                S::Inserting | S::Homing | S::Moving | S::TurningInAir | S::Completed,
            )
            | State::Stage(StageState::Enabled)
            | State::Tracker(T::Tracking)
            | State::Observer(O::Estimating)
            | State::Control(C::Steering) => Meaning::Good,
            State::Session(S::Preparing | S::Silent | S::Stopping)
            | State::Stage(StageState::Stopped)
            | State::Tracker(T::Waiting)
            | State::Observer(O::Waiting | O::RollUnknown) => Meaning::Passing,
            State::Session(S::Holding)
            | State::Tracker(T::Coasting)
            | State::Control(C::Saturated) => Meaning::Warning,
            State::Session(S::Stopped) | State::Tracker(T::Lost | T::Disconnected) => {
                Meaning::Fault
            }
        }
    }

    pub(super) fn of_drive(state: DriveState) -> Self {
        match state {
            DriveState::OperationEnabled => Meaning::Good,
            DriveState::NotReadyToSwitchOn
            | DriveState::SwitchOnDisabled
            | DriveState::ReadyToSwitchOn
            | DriveState::SwitchedOn => Meaning::Passing,
            DriveState::QuickStopActive => Meaning::Warning,
            DriveState::Fault | DriveState::FaultReactionActive => Meaning::Fault,
        }
    }

    /// The colour of the `n`-th state of a lane: those that pass are told apart by turns.
    fn colour(self, n: usize) -> Color {
        match self {
            Meaning::Good => GOOD,
            Meaning::Passing => [NEUTRAL, COORDINATES[2], COORDINATES[1]][n % 3],
            Meaning::Warning => WARNING,
            Meaning::Fault => FAULT,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A run that completed ends in no colour of a fault, in any lane.
    #[test]
    fn only_what_is_wrong_has_the_colour_of_a_fault() {
        let colour = |state: State| Meaning::of(state).colour(0);
        assert_eq!(colour(SessionState::Completed.into()), GOOD);
        assert_eq!(colour(StageState::Stopped.into()), NEUTRAL);
        assert_eq!(colour(SessionState::Stopping.into()), NEUTRAL);
        assert_eq!(colour(SessionState::Stopped.into()), FAULT);
        assert_eq!(colour(TrackerState::Lost.into()), FAULT);
        assert_eq!(colour(SessionState::Holding.into()), WARNING);
        assert_eq!(Meaning::of_drive(DriveState::SwitchOnDisabled), Meaning::Passing);
        assert_eq!(Meaning::of_drive(DriveState::FaultReactionActive), Meaning::Fault);
    }
}
