//! The state of each part of the bench: lanes coloured by what the states mean, and a page with the states at
//! the time cursor, since lanes show a time range.

use super::Logged;
use super::document::cell;
use super::palette::{COORDINATES, FAULT, GOOD, NEUTRAL, WARNING};
use crate::canopen::cia402::DriveState;
use crate::session::{Lane, Severity, State};
use crate::stage::Axis;
use crate::units::Time;
use rerun::{Color, RecordingStream, StateChange, StateConfiguration, TextDocument};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::time::Duration;

/// An event explains a state that follows within this time, which is longer than any stop takes.
const REASON_AGE_MAX: Duration = Duration::from_secs(5);

/// The lanes, and the page of the parts of the bench.
#[derive(Debug, Default)]
pub(super) struct States {
    /// The states of each lane so far, with their meanings.
    lanes: BTreeMap<String, Vec<(String, Meaning)>>,
    /// The state of each part, in the order in which the parts first reported one.
    rows: Vec<Row>,
    /// The page that was logged last.
    page: String,
}

/// A part of the bench in the page.
#[derive(Debug)]
struct Row {
    lane: String,
    state: String,
    since: Time,
    /// Time and text of the newest event that explains the state.
    why: Option<(Time, String)>,
}

impl States {
    /// Logs that `lane` enters `state`. If the state is new, also logs the colours of the lane's states.
    pub(super) fn log_lane(
        &mut self,
        stream: &RecordingStream,
        lane: &str,
        state: &str,
        meaning: Meaning,
    ) -> Logged {
        let path = format!("states/{lane}");
        let known = self.lanes.entry(lane.to_owned()).or_default();
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

    /// Notes that `lane` has entered `state`. A recent event explains it; a good state is not explained by an earlier
    /// event.
    pub(super) fn enter(&mut self, time: Time, lane: &str, state: &str, meaning: Meaning) {
        let row = self.row(lane);
        (row.state, row.since) = (state.to_owned(), time);
        row.why.take_if(|(event_time, _)| {
            let is_over = meaning == Meaning::Good && *event_time < time;
            is_over || time.since(*event_time) > REASON_AGE_MAX
        });
    }

    /// Takes an event of a part as the reason of a state: a warning, a fault, or a command of the operator.
    pub(super) fn event(&mut self, time: Time, lane: Lane, severity: Severity, text: &str) {
        if severity == Severity::Info && !text.starts_with("operator: ") {
            return;
        }
        let session = Lane::Session.to_string();
        if lane == Lane::Tracker && self.row(&session).state == State::Holding.as_str() {
            self.explain(time, &session, text);
        }
        self.explain(time, &lane.to_string(), text);
    }

    /// Takes `why` as the reason of the state of `lane`.
    pub(super) fn explain(&mut self, time: Time, lane: &str, why: &str) {
        self.row(lane).why = Some((time, why.to_owned()));
    }

    fn row(&mut self, lane: &str) -> &mut Row {
        let index = self.rows.iter().position(|row| row.lane == lane).unwrap_or_else(|| {
            let (lane, state) = (lane.to_owned(), String::new());
            self.rows.push(Row { lane, state, since: Time::ZERO, why: None });
            self.rows.len() - 1
        });
        &mut self.rows[index]
    }

    /// Logs the page, if it has changed.
    pub(super) fn log_page(&mut self, stream: &RecordingStream) -> Logged {
        let page = self.page();
        if page == self.page {
            return Ok(());
        }
        self.page.clone_from(&page);
        stream.log("now", &TextDocument::from_markdown(page))
    }

    fn page(&self) -> String {
        let mut page = "| | state | since | why |\n|---|---|---|---|\n".to_owned();
        for Row { lane, state, since, why } in &self.rows {
            let why = why.as_ref().map_or(String::new(), |(_, why)| cell(why));
            let since_s = since.as_secs_f64();
            // Writing to a string cannot fail.
            let _ = writeln!(page, "| {lane} | **{state}** | {since_s:.2} s | {why} |");
        }
        page
    }
}

/// The lane of the drive of `axis`.
pub(super) fn drive_lane(axis: Axis) -> String {
    format!("drive_{axis}")
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

    fn at(s: f64) -> Time {
        Time::from_secs_f64(s)
    }

    #[test]
    fn a_state_has_the_reason_that_came_with_it() {
        let mut now = States::default();
        let enter = |now: &mut States, s, state: State| {
            now.enter(at(s), &state.lane().to_string(), state.as_str(), Meaning::of(state));
        };
        let drive = |now: &mut States, s, state: DriveState| {
            now.enter(at(s), "drive_insertion", &state.to_string(), Meaning::of_drive(state));
        };
        enter(&mut now, 0.0, State::Inserting);
        drive(&mut now, 0.0, DriveState::OperationEnabled);
        now.event(at(1.0), Lane::Session, Severity::Info, "at 10 mm");
        assert!(!now.page().contains("at 10 mm"), "{}", now.page());
        // The tracker gives the reason after the run has changed its state.
        enter(&mut now, 2.0, State::Holding);
        now.event(at(2.0), Lane::Tracker, Severity::Warning, "no tip | held");
        assert_eq!(now.page().matches("| no tip \\| held |").count(), 2, "{}", now.page());
        enter(&mut now, 2.0, State::Coasting);
        assert!(now.page().contains("| tracker | **coasting** | 2.00 s | no tip \\| held |"));
        // The tip is seen again.
        enter(&mut now, 3.0, State::Tracking);
        assert!(now.page().contains("| tracker | **tracking** | 3.00 s |  |"), "{}", now.page());
        enter(&mut now, 3.0, State::Inserting);
        assert!(now.page().contains("| session | **inserting** | 3.00 s |  |"), "{}", now.page());
        // A fault comes before the state that it causes.
        now.explain(at(4.0), "drive_insertion", "0x8611 following error");
        now.event(at(4.0), Lane::Session, Severity::Fault, "stage: insertion: fault");
        enter(&mut now, 4.0, State::Stopping);
        enter(&mut now, 4.5, State::Stopped);
        drive(&mut now, 4.5, DriveState::Fault);
        let page = now.page();
        assert!(page.contains("| session | **stopped** | 4.50 s | stage: insertion: fault |"));
        assert!(page.contains("| **fault** | 4.50 s | 0x8611 following error |"));
        drive(&mut now, 60.0, DriveState::SwitchOnDisabled);
        assert!(now.page().contains("| **switch on disabled** | 60.00 s |  |"), "{}", now.page());
    }
}
