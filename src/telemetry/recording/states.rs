//! Changes of state, coloured by what they mean.

use super::Logged;
use super::palette::{COORDINATES, FAULT, GOOD, NEUTRAL, WARNING};
use crate::canopen::cia402::DriveState;
use crate::session::State;
use rerun::{Color, RecordingStream, StateChange, StateConfiguration};
use std::collections::BTreeMap;

/// The states of each lane so far, with their meanings.
#[derive(Debug, Default)]
pub(super) struct States(BTreeMap<String, Vec<(String, Meaning)>>);

impl States {
    /// Logs that `lane` enters `state`. If the state is new, also logs the colours of the lane's states.
    pub(super) fn log(
        &mut self,
        stream: &RecordingStream,
        lane: &str,
        state: &str,
        meaning: Meaning,
    ) -> Logged {
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

/// The meaning of a state to the operator, which is its colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Meaning {
    /// As it should be.
    Good,
    /// A transition, or the end.
    Passing,
    /// The operator should look.
    Warning,
    /// Something is wrong.
    Fault,
}

impl Meaning {
    pub(super) fn of(state: State) -> Self {
        match state {
            State::Inserting
            | State::Stepping
            | State::Homing
            | State::Moving
            | State::TurningInAir
            | State::Completed
            | State::Enabled
            | State::Tracking
            | State::Estimating
            | State::Steering => Meaning::Good,
            State::Preparing
            | State::Silent
            | State::Stopping
            | State::PowerOff
            | State::AwaitingTip
            | State::NoEstimate
            | State::RollUnknown => Meaning::Passing,
            State::Holding
            | State::HeldByOperator
            | State::HeldAfterStep
            | State::Coasting
            | State::Saturated => Meaning::Warning,
            State::Stopped | State::Lost | State::Disconnected => Meaning::Fault,
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

    /// The colour of the `n`-th state of a lane. Passing states use three colours, so that neighbours differ.
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

    /// A run that completes ends without a fault's colour in any lane.
    #[test]
    fn only_faults_have_the_colour_of_a_fault() {
        let colour = |state: State| Meaning::of(state).colour(0);
        assert_eq!(colour(State::Completed), GOOD);
        assert_eq!(colour(State::PowerOff), NEUTRAL);
        assert_eq!(colour(State::Stopping), NEUTRAL);
        assert_eq!(colour(State::Stopped), FAULT);
        assert_eq!(colour(State::Lost), FAULT);
        assert_eq!(colour(State::Holding), WARNING);
        assert_eq!(Meaning::of_drive(DriveState::SwitchOnDisabled), Meaning::Passing);
        assert_eq!(Meaning::of_drive(DriveState::FaultReactionActive), Meaning::Fault);
    }
}
