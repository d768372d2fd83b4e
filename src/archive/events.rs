//! `events.log`: one line for each change of state and each event, for people and grep.

use crate::session::{Lane, PROVED, Record, Severity};
use crate::text::escaped;
use crate::units::Time;
use std::borrow::Cow;
use std::fmt;

/// The kind of a line of `events.log`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EventKind {
    /// A part of the bench entered a state; the line's text is its name.
    State,
    /// An event of this severity.
    Event(Severity),
}

/// A line of `events.log`, without its line feed: `   12.345 s  tracker   warning  connection lost`.
///
/// Its columns: the time to the millisecond, the part of the bench, the kind (`state`, `info`, `warning`,
/// `fault`), and the text. Newlines and control characters are [escaped] in the text, which may come from a
/// tracker.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EventLine<'a> {
    /// The time of the record, rounded down to the millisecond.
    pub time: Time,
    /// The part of the bench.
    pub lane: Lane,
    /// The kind of the text.
    pub kind: EventKind,
    /// The event, or the state's name.
    pub text: Cow<'a, str>,
}

impl<'a> EventLine<'a> {
    /// The line for `record`; `None` for a record that is neither a state nor an event.
    pub fn of(record: &'a Record) -> Option<Self> {
        let (time, lane, kind, text) = match record {
            Record::State { time, state } => (time, state.lane(), EventKind::State, state.as_str()),
            Record::Event { time, lane, severity, text } => {
                (time, *lane, EventKind::Event(*severity), text.as_str())
            }
            _ => return None,
        };
        let time = Time::from_nanos(time.as_nanos().div_euclid(1_000_000) * 1_000_000);
        Some(EventLine { time, lane, kind, text: escaped(text) })
    }

    /// Reads a line; `None` if it is not a whole line of this format.
    pub fn parse(line: &'a str) -> Option<Self> {
        let (time_s, rest) = line.trim_start().split_once(" s  ")?;
        let (lane, rest) = column(rest, LANE_WIDTH)?;
        let (kind, text) = column(rest, KIND_WIDTH)?;
        Some(EventLine {
            time: time_s.parse().ok().map(Time::from_secs_f64)?,
            lane: Lane::ALL.into_iter().find(|known| known.to_string() == lane)?,
            kind: KINDS.into_iter().find(|(_, name)| *name == kind)?.0,
            text: Cow::Borrowed(text),
        })
    }
}

/// The result of a `stage prove`: the text of the last line of `events`, an `events.log`, that states one.
pub fn proof(events: &str) -> Option<String> {
    let lines = events.lines().rev().filter_map(EventLine::parse);
    lines.map(|line| line.text).find(|text| text.starts_with(PROVED)).map(Cow::into_owned)
}

const LANE_WIDTH: usize = 8;
const KIND_WIDTH: usize = 7;

const KINDS: [(EventKind, &str); 4] = [
    (EventKind::State, "state"),
    (EventKind::Event(Severity::Info), "info"),
    (EventKind::Event(Severity::Warning), "warning"),
    (EventKind::Event(Severity::Fault), "fault"),
];

impl fmt::Display for EventLine<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let time = format!("{:.3}", self.time.as_secs_f64());
        let kind = KINDS.into_iter().find(|(kind, _)| *kind == self.kind).map_or("", |(_, n)| n);
        let lane = self.lane.to_string();
        write!(f, "{time:>9} s  {lane:<LANE_WIDTH$}  {kind:<KIND_WIDTH$}  {}", self.text)
    }
}

/// Splits `text` after a column of `width` bytes: the column without its padding, and the rest.
fn column(text: &str, width: usize) -> Option<(&str, &str)> {
    let (column, rest) = text.split_at_checked(width)?;
    Some((column.trim_end(), rest.strip_prefix("  ")?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::State;

    fn lines() -> [Record; 3] {
        let event = |ns, lane, severity, text: &str| Record::Event {
            time: Time::from_nanos(ns),
            lane,
            severity,
            text: text.to_owned(),
        };
        [
            Record::State { time: Time::ZERO, state: State::Preparing },
            event(12_345_999_999, Lane::Tracker, Severity::Warning, "no tip\nfor  \u{1b}[1m 1 s"),
            event(-1_000_000, Lane::Observer, Severity::Fault, "é"),
        ]
    }

    /// Do not edit: people's scripts and `review` read these lines.
    #[test]
    fn lines_are_frozen() {
        let said = lines().map(|record| EventLine::of(&record).unwrap().to_string());
        assert_eq!(
            said,
            [
                "    0.000 s  session   state    preparing",
                "   12.345 s  tracker   warning  no tip\\nfor  \\u{1b}[1m 1 s",
                "   -0.001 s  observer  fault    é",
            ]
        );
    }

    #[test]
    fn lines_are_read_back_and_cut_lines_are_refused() {
        for record in lines() {
            let line = EventLine::of(&record).unwrap();
            assert_eq!(EventLine::parse(&line.to_string()), Some(line));
        }
        for cut in ["", "   12.345", "   12.345 s  trac", "x s  session   info     y", "1.0 s  é"]
        {
            assert_eq!(EventLine::parse(cut), None, "{cut:?}");
        }
    }
}
