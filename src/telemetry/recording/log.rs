//! Lines of text and changes of state.

use super::index::{Index, Moment};
use super::palette::{COORDINATES, FAULT, GOOD, NEUTRAL, WARNING};
use crate::canopen::cia402::DriveState;
use crate::session::{
    ControlState, ObserverState, SessionState, Severity, StageState, State, TrackerState,
};
use rerun::{
    Color, RecordingStream, RecordingStreamResult, StateChange, StateConfiguration, TextLog,
};
use std::collections::BTreeMap;

/// Text by entity, waiting to be sent.
#[derive(Debug, Default)]
pub(super) struct Lines(BTreeMap<String, Rows>);

#[derive(Debug, Default)]
struct Rows {
    index: Index,
    texts: Vec<String>,
    levels: Vec<&'static str>,
}

impl Lines {
    pub(super) fn push(&mut self, moment: Moment, path: &str, level: &'static str, text: String) {
        if !self.0.contains_key(path) {
            self.0.insert(path.to_owned(), Rows::default());
        }
        if let Some(rows) = self.0.get_mut(path) {
            rows.index.push(moment);
            rows.texts.push(text);
            rows.levels.push(level);
        }
    }

    pub(super) fn send(&mut self, stream: &RecordingStream) -> RecordingStreamResult<()> {
        for (path, rows) in std::mem::take(&mut self.0) {
            let columns = TextLog::update_fields()
                .with_many_text(rows.texts)
                .with_many_level(rows.levels)
                .columns_of_unit_batches()?;
            stream.send_columns(path, rows.index.columns(), columns)?;
        }
        Ok(())
    }
}

/// rerun's name of a severity.
pub(super) fn level(severity: Severity) -> &'static str {
    match severity {
        Severity::Info => "INFO",
        Severity::Warning => "WARN",
        Severity::Fault => "ERROR",
    }
}

/// Changes of state by lane, waiting to be sent.
#[derive(Debug, Default)]
pub(super) struct States(BTreeMap<String, LaneStates>);

#[derive(Debug, Default)]
struct LaneStates {
    index: Index,
    changes: Vec<String>,
    known: Vec<(String, Meaning)>,
    /// The colours of all that are known were sent.
    is_styled: bool,
}

impl States {
    pub(super) fn push(&mut self, moment: Moment, lane: &str, state: String, meaning: Meaning) {
        let states = self.0.entry(lane.to_owned()).or_default();
        if states.known.iter().all(|(known, _)| *known != state) {
            states.known.push((state.clone(), meaning));
            states.is_styled = false;
        }
        states.index.push(moment);
        states.changes.push(state);
    }

    pub(super) fn send(&mut self, stream: &RecordingStream) -> RecordingStreamResult<()> {
        for (lane, states) in &mut self.0 {
            let changes = std::mem::take(&mut states.changes);
            if changes.is_empty() {
                continue;
            }
            let path = format!("states/{lane}");
            if !std::mem::replace(&mut states.is_styled, true) {
                let known = states.known.iter();
                let style = StateConfiguration::new()
                    .with_values(known.clone().map(|(state, _)| state.as_str()))
                    .with_colors(known.enumerate().map(|(n, (_, meaning))| meaning.colour(n)));
                stream.log_static(path.as_str(), &style)?;
            }
            let columns =
                StateChange::update_fields().with_state(changes).columns_of_unit_batches()?;
            stream.send_columns(path.as_str(), states.index.columns(), columns)?;
            states.index.clear();
        }
        Ok(())
    }
}

/// What a state means to who looks at it: its colour.
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
