//! A page with the states at the time cursor, since the lanes of states show a time range.

use super::Logged;
use super::document::cell;
use super::states::Meaning;
use crate::canopen::emcy::Emcy;
use crate::session::{Lane, Severity, State};
use crate::stage::Axis;
use crate::units::Time;
use rerun::{RecordingStream, TextDocument};
use std::fmt::Write as _;
use std::time::Duration;

/// An event explains a state that follows within this time, which is longer than any stop takes.
const REASON_AGE_MAX: Duration = Duration::from_secs(5);

/// The state of each part, in the order in which the parts first reported one.
#[derive(Debug, Default)]
pub(super) struct Now(Vec<Row>);

#[derive(Debug)]
struct Row {
    lane: String,
    state: String,
    since: Time,
    /// Time and text of the newest event that explains the state.
    why: Option<(Time, String)>,
}

impl Now {
    /// Notes that `lane` has entered `state`. A recent event explains it; a good state needs no earlier event.
    pub(super) fn enter(&mut self, time: Time, lane: &str, state: &str, meaning: Meaning) {
        let row = self.row(lane);
        (row.state, row.since) = (state.to_owned(), time);
        row.why.take_if(|(event_time, _)| {
            let is_over = meaning == Meaning::Good && *event_time < time;
            is_over || time.since(*event_time) > REASON_AGE_MAX
        });
    }

    /// Takes an event as the reason of a state: a warning, a fault, or a command of the operator. Returns true
    /// if the page has changed.
    pub(super) fn explain(
        &mut self,
        time: Time,
        lane: Lane,
        severity: Severity,
        text: &str,
    ) -> bool {
        if severity == Severity::Info && !text.starts_with("operator: ") {
            return false;
        }
        let explains_hold = lane == Lane::Tracker
            && self.row(&Lane::Session.to_string()).state == State::Holding.as_str();
        let mut is_new = self.explain_row(time, &lane.to_string(), text);
        if explains_hold {
            is_new |= self.explain_row(time, &Lane::Session.to_string(), text);
        }
        is_new
    }

    /// Takes an emergency message of the drive of `axis` as the reason of its state. Returns true if the page has
    /// changed.
    pub(super) fn emergency(&mut self, time: Time, axis: Axis, emcy: &Emcy) -> bool {
        self.explain_row(time, &drive_lane(axis), &emcy.to_string())
    }

    fn explain_row(&mut self, time: Time, lane: &str, why: &str) -> bool {
        let row = self.row(lane);
        let is_new = row.why.as_ref().is_none_or(|(_, before)| before != why);
        row.why = Some((time, why.to_owned()));
        is_new
    }

    fn row(&mut self, lane: &str) -> &mut Row {
        let index = self.0.iter().position(|row| row.lane == lane).unwrap_or_else(|| {
            let (lane, state) = (lane.to_owned(), String::new());
            self.0.push(Row { lane, state, since: Time::ZERO, why: None });
            self.0.len() - 1
        });
        &mut self.0[index]
    }

    /// Logs the page.
    pub(super) fn log(&self, stream: &RecordingStream) -> Logged {
        stream.log("now", &TextDocument::from_markdown(self.page()))
    }

    fn page(&self) -> String {
        let mut page = "| | state | since | why |\n|---|---|---|---|\n".to_owned();
        for Row { lane, state, since, why } in &self.0 {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::canopen::cia402::DriveState;
    use crate::canopen::emcy::EmcyCode;

    fn at(s: f64) -> Time {
        Time::from_secs_f64(s)
    }

    #[test]
    fn a_state_has_the_reason_that_came_with_it() {
        let mut now = Now::default();
        let enter = |now: &mut Now, s, state: State| {
            now.enter(at(s), &state.lane().to_string(), state.as_str(), Meaning::of(state));
        };
        let drive = |now: &mut Now, s, state: DriveState| {
            now.enter(at(s), "drive_insertion", &state.to_string(), Meaning::of_drive(state));
        };
        enter(&mut now, 0.0, State::Inserting);
        drive(&mut now, 0.0, DriveState::OperationEnabled);
        let info = |now: &mut Now, text| now.explain(at(1.0), Lane::Session, Severity::Info, text);
        assert!(!info(&mut now, "at 10 mm"));
        // The tracker gives the reason after the run has changed its state.
        enter(&mut now, 2.0, State::Holding);
        let warning =
            |now: &mut Now, s, text| now.explain(at(s), Lane::Tracker, Severity::Warning, text);
        assert!(warning(&mut now, 2.0, "no tip | held"));
        assert!(!warning(&mut now, 2.1, "no tip | held"), "shown already");
        assert_eq!(now.page().matches("| no tip \\| held |").count(), 2, "{}", now.page());
        enter(&mut now, 2.0, State::Coasting);
        assert!(now.page().contains("| tracker | **coasting** | 2.00 s | no tip \\| held |"));
        // The tip is seen again.
        enter(&mut now, 3.0, State::Tracking);
        assert!(now.page().contains("| tracker | **tracking** | 3.00 s |  |"), "{}", now.page());
        enter(&mut now, 3.0, State::Inserting);
        assert!(now.page().contains("| session | **inserting** | 3.00 s |  |"), "{}", now.page());
        // A fault comes before the state that it causes.
        let emcy = Emcy { code: EmcyCode::FOLLOWING_ERROR, register: 0x21, manufacturer: [0; 5] };
        assert!(now.emergency(at(4.0), Axis::Insertion, &emcy));
        assert!(now.explain(at(4.0), Lane::Session, Severity::Fault, "stage: insertion: fault"));
        enter(&mut now, 4.0, State::Stopping);
        enter(&mut now, 4.5, State::Stopped);
        drive(&mut now, 4.5, DriveState::Fault);
        let page = now.page();
        assert!(page.contains("| session | **stopped** | 4.50 s | stage: insertion: fault |"));
        assert!(page.contains("| **fault** | 4.50 s | 0x8611 following error (register 0x21) |"));
        drive(&mut now, 60.0, DriveState::SwitchOnDisabled);
        assert!(now.page().contains("| **switch on disabled** | 60.00 s |  |"), "{}", now.page());
    }
}
