//! Lines of text and changes of state.

use super::index::{Index, Moment};
use super::palette::{COORDINATES, FAULT, GOOD, NEUTRAL, WARNING};
use crate::session::Severity;
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
    known: Vec<String>,
}

impl States {
    pub(super) fn push(&mut self, moment: Moment, lane: &str, state: &str) {
        let states = self.0.entry(lane.to_owned()).or_default();
        states.index.push(moment);
        states.changes.push(state.to_owned());
    }

    pub(super) fn send(&mut self, stream: &RecordingStream) -> RecordingStreamResult<()> {
        for (lane, states) in &mut self.0 {
            let changes = std::mem::take(&mut states.changes);
            if changes.is_empty() {
                continue;
            }
            let path = format!("states/{lane}");
            let known = states.known.len();
            for state in &changes {
                if !states.known.contains(state) {
                    states.known.push(state.clone());
                }
            }
            if states.known.len() > known {
                let colours = states.known.iter().enumerate().map(|(n, s)| state_colour(n, s));
                let style = StateConfiguration::new()
                    .with_values(states.known.iter().map(String::as_str))
                    .with_colors(colours);
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

/// States are coloured by what their names promise, the others in turn.
fn state_colour(n: usize, state: &str) -> Color {
    let says = |words: &[&str]| words.iter().any(|word| state.contains(word));
    if says(&["fault", "lost", "stopped", "error", "abort", "refused"]) {
        FAULT
    } else if says(&["hold", "held", "coast", "saturat", "late", "quick"]) {
        WARNING
    } else if says(&["steer", "insert", "operation", "track", "completed", "running", "accepted"]) {
        GOOD
    } else {
        [NEUTRAL, COORDINATES[2], COORDINATES[1]][n % 3]
    }
}
