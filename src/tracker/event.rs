//! What a tracker's connection reports, and a census of what came over it.

use super::gate::is_tool;
use super::ndjson::LineError;
use super::openigtlink::{DecodeError, Status};
use super::sample::Sample;
use std::collections::BTreeMap;
use std::fmt::Write;
use thiserror::Error;

/// What happened on the connection to a tracker.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// A connection was made, by us or by the peer.
    Connected {
        /// The peer's address.
        peer: String,
    },
    /// No connection could be made; another attempt follows.
    Unreachable {
        /// What happened and what to look at.
        reason: String,
    },
    /// A tool's position.
    Sample(Sample),
    /// The peer says how it is.
    Status {
        /// The device it speaks of.
        device: String,
        /// Its status.
        status: Status,
    },
    /// A device sends something for the first time on this connection.
    SawTool {
        /// The device's name.
        tool: String,
        /// The type of its message; only some are read.
        message_type: String,
    },
    /// A message was refused; the connection goes on.
    Malformed(Malformed),
    /// Messages that the link did not hand on since the last of these events.
    PassedOver {
        /// Samples of other tools; statuses and refused messages beyond a bounded rate.
        messages: u64,
        /// Samples of the tool that were lost because they were not taken in time.
        dropped: u64,
    },
    /// The connection ended; another one is waited for.
    Disconnected {
        /// Why, and what to look at.
        reason: String,
    },
}

impl Event {
    /// True for what comes at the tracker's rate: samples, statuses, refused messages. The others
    /// change what is known of the connection.
    pub fn is_message(&self) -> bool {
        matches!(self, Event::Sample(_) | Event::Status { .. } | Event::Malformed(_))
    }
}

/// A message that was refused, by the protocol it was to be in.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum Malformed {
    /// OpenIGTLink.
    #[error(transparent)]
    OpenIgtLink(#[from] DecodeError),
    /// A line of NDJSON.
    #[error(transparent)]
    Ndjson(#[from] LineError),
    /// Of either, in the words of a run's record.
    #[error("{0}")]
    Recorded(String),
}

/// Names kept of one connection. A peer that sends more is not believed to mean them.
const NAMES_MAX: usize = 64;

/// Counts what came over a connection, to say what is there when the tool wanted is not.
#[derive(Debug, Clone, Default)]
pub struct Census {
    peer: String,
    messages: u64,
    /// How many messages were refused, and why the last one was.
    refused: Option<(u64, Malformed)>,
    samples: BTreeMap<String, u64>,
    unread: BTreeMap<String, String>,
}

impl Census {
    /// Takes an event in. The census is of the present connection.
    pub fn note(&mut self, event: &Event) {
        match event {
            Event::Connected { peer } => *self = Census { peer: peer.clone(), ..Census::default() },
            Event::Sample(sample) => {
                self.messages += 1;
                if let Some(count) = self.samples.get_mut(&sample.tool) {
                    *count += 1;
                } else if self.samples.len() < NAMES_MAX {
                    self.samples.insert(sample.tool.clone(), 1);
                }
            }
            Event::Status { .. } => self.messages += 1,
            Event::PassedOver { messages, dropped } => self.messages += messages + dropped,
            Event::Malformed(error) => {
                self.messages += 1;
                let before = self.refused.take().map_or(0, |(count, _)| count);
                self.refused = Some((before + 1, error.clone()));
            }
            Event::SawTool { tool, message_type } if self.unread.len() < NAMES_MAX => {
                self.unread.insert(tool.clone(), message_type.clone());
            }
            Event::Disconnected { .. } => *self = Census::default(),
            Event::SawTool { .. } | Event::Unreachable { .. } => {}
        }
    }

    /// Samples, statuses and refused messages on this connection, those passed over among them.
    pub fn messages(&self) -> u64 {
        self.messages
    }

    /// True once a sample of `tool` has come.
    pub fn has(&self, tool: &str) -> bool {
        self.samples.keys().any(|sent| is_tool(sent, tool))
    }

    /// Says that `tool` has not come, what has instead, and what to do.
    pub fn explain_missing(&self, tool: &str) -> String {
        let Census { peer, messages, refused, samples, unread } = self;
        if peer.is_empty() {
            return format!("tracker: not connected, so nothing of \"{tool}\"");
        }
        let mut text =
            format!("tracker: connected to {peer}, {messages} messages, none named \"{tool}\"");
        let others = unread.iter().filter(|(name, _)| !samples.contains_key(*name));
        let seen: Vec<String> = (samples.keys().map(|name| format!("\"{name}\"")))
            .chain(others.map(|(name, message_type)| match has_positions(message_type) {
                true => format!("\"{name}\""),
                false => format!("\"{name}\" ({message_type})"),
            }))
            .collect();
        // Writing to a string cannot fail.
        let _ = if seen.is_empty() {
            write!(text, ". Is the tool in view, and does the server send it?")
        } else {
            write!(text, "; saw {}. Set tracker.tool.", seen.join(", "))
        };
        if let Some((count, last)) = refused {
            let _ = write!(text, " {count} messages were refused; the last: {last}");
        }
        text
    }
}

/// True for a type of message that brings samples.
fn has_positions(message_type: &str) -> bool {
    matches!(message_type, "TRANSFORM" | "POSITION" | "TDATA" | "QTDATA" | "NDJSON")
}

#[cfg(test)]
mod tests {
    use super::super::sample::Validity;
    use super::*;
    use crate::units::Time;
    use nalgebra::Vector3;

    fn sample(tool: &str) -> Event {
        Event::Sample(Sample {
            tool: tool.to_owned(),
            receive_time: Time::ZERO,
            source_unix_ns: None,
            position_mm: Vector3::zeros(),
            orientation: None,
            validity: Validity::Valid,
        })
    }

    fn connected() -> Event {
        Event::Connected { peer: "localhost:18944".to_owned() }
    }

    #[test]
    fn a_wrong_tool_name_is_explained() {
        let mut census = Census::default();
        census.note(&connected());
        for _ in 0..37 {
            census.note(&sample("StylusToTracker"));
        }
        assert!(census.has("StylusToTracker") && !census.has("NeedleToTracker"));
        assert_eq!(
            census.explain_missing("NeedleToTracker"),
            "tracker: connected to localhost:18944, 37 messages, none named \"NeedleToTracker\"; \
             saw \"StylusToTracker\". Set tracker.tool."
        );
    }

    /// What a link keeps back is in the census all the same.
    #[test]
    fn a_tool_that_was_passed_over_is_explained() {
        let mut census = Census::default();
        census.note(&connected());
        let (tool, message_type) = ("StylusToTracker".to_owned(), "TRANSFORM".to_owned());
        census.note(&Event::SawTool { tool, message_type });
        for messages in [30, 7] {
            census.note(&Event::PassedOver { messages, dropped: 0 });
        }
        assert_eq!(
            census.explain_missing("NeedleToTracker"),
            "tracker: connected to localhost:18944, 37 messages, none named \"NeedleToTracker\"; \
             saw \"StylusToTracker\". Set tracker.tool."
        );
    }

    #[test]
    fn types_that_are_not_read_are_named_too() {
        let mut census = Census::default();
        census.note(&connected());
        let saw = |tool: &str, message_type: &str| Event::SawTool {
            tool: tool.to_owned(),
            message_type: message_type.to_owned(),
        };
        census.note(&saw("Probe", "IMAGE"));
        census.note(&saw("Stylus", "TRANSFORM"));
        census.note(&sample("Stylus"));
        assert_eq!(
            census.explain_missing("Needle"),
            "tracker: connected to localhost:18944, 1 messages, none named \"Needle\"; saw \
             \"Stylus\", \"Probe\" (IMAGE). Set tracker.tool."
        );
    }

    #[test]
    fn refused_messages_are_counted_and_the_last_one_told() {
        let mut census = Census::default();
        census.note(&connected());
        census.note(&sample("Stylus"));
        for version in [7, 9] {
            census.note(&Event::Malformed(DecodeError::Version(version).into()));
        }
        let text = census.explain_missing("Needle");
        assert!(text.contains("3 messages, none named \"Needle\"; saw \"Stylus\""), "{text}");
        assert!(
            text.contains(
                "2 messages were refused; the last: openigtlink: header version 9 (1 or 2 expected)"
            ),
            "{text}"
        );
    }

    #[test]
    fn silence_is_told_from_no_connection() {
        let mut census = Census::default();
        assert_eq!(
            census.explain_missing("Needle"),
            "tracker: not connected, so nothing of \"Needle\""
        );
        census.note(&sample("Needle"));
        census.note(&connected());
        assert!(!census.has("Needle"), "that was another connection");
        assert!(
            census
                .explain_missing("Needle")
                .ends_with("Is the tool in view, and does the server send it?")
        );
    }

    #[test]
    fn a_peer_of_many_names_does_not_fill_the_memory() {
        let mut census = Census::default();
        for i in 0..1000 {
            census.note(&sample(&format!("tool {i}")));
        }
        assert_eq!((census.samples.len(), census.messages()), (NAMES_MAX, 1000));
    }
}
