//! The events of a tracker's connection, and a census of them.

use super::gate::is_same_tool;
use super::openigtlink::Status;
use super::reader::Reader;
use super::sample::Sample;
use crate::text::clipped;
use std::collections::{BTreeMap, BTreeSet};

/// An event on the connection to a tracker.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// A connection was made, by the bench or by the peer.
    Connected {
        /// The peer's address.
        peer: String,
    },
    /// No connection could be made; another attempt follows.
    Unreachable {
        /// The error, and what to check.
        reason: String,
    },
    /// Another client wanted to connect; the bench reads one at a time.
    TurnedAway {
        /// Which one, and why.
        reason: String,
    },
    /// A tool's position.
    Sample(Sample),
    /// The peer reports a status.
    Status {
        /// The device that the status is about.
        device: String,
        /// Its status.
        status: Status,
    },
    /// A device sent its first message on this connection.
    SawTool {
        /// The device's name.
        tool: String,
        /// The type of its message; the bench reads only some types.
        message_type: String,
    },
    /// A message was refused for this reason; the connection goes on.
    Malformed(String),
    /// The link has not passed on some messages since the last of these events.
    PassedOver {
        /// Samples of other tools; statuses and refused messages beyond a bounded rate.
        messages: u64,
        /// Samples of the tool that were lost because the session did not take them in time.
        dropped: u64,
    },
    /// The connection ended; the bench waits for another one.
    Disconnected {
        /// Why, and what to check.
        reason: String,
    },
}

impl Event {
    /// True for events that come at the tracker's rate: samples, statuses, refused messages. The
    /// others are about the connection itself.
    pub fn is_message(&self) -> bool {
        matches!(self, Event::Sample(_) | Event::Status { .. } | Event::Malformed(_))
    }
}

/// A message shows at most this many names, and this many characters of each.
const NAMES_SHOWN: usize = 2;
const SHOWN_MAX: usize = 22;
/// The message about a missing tool has at most this many characters.
const MESSAGE_MAX: usize = 168;
const IN_VIEW: &str = "is the tool in view?";

/// Counts what came over a connection, to say what came when the wanted tool did not.
#[derive(Debug, Clone, Default)]
pub struct Census {
    peer: String,
    messages: u64,
    /// How many messages were refused, and why the last one was.
    refused: Option<(u64, String)>,
    /// Tools whose samples came.
    tools: BTreeSet<String>,
    /// Devices that were reported by name, with the type of their messages.
    devices: BTreeMap<String, String>,
}

impl Census {
    /// Counts an event. A new connection starts a new census; one that has ended still explains what came.
    pub fn note(&mut self, event: &Event) {
        match event {
            Event::Connected { peer } => *self = Census { peer: peer.clone(), ..Census::default() },
            Event::Sample(sample) => {
                self.messages += 1;
                if self.tools.len() < Reader::NAMES_MAX {
                    self.tools.insert(sample.tool.clone());
                }
            }
            Event::Status { .. } => self.messages += 1,
            Event::PassedOver { messages, dropped } => self.messages += messages + dropped,
            Event::Malformed(error) => {
                self.messages += 1;
                let before = self.refused.take().map_or(0, |(count, _)| count);
                self.refused = Some((before + 1, error.clone()));
            }
            Event::SawTool { tool, message_type } if self.devices.len() < Reader::NAMES_MAX => {
                let known =
                    self.devices.entry(tool.clone()).or_insert_with(|| message_type.clone());
                // A device may send a status first and positions later.
                if has_positions(message_type) {
                    known.clone_from(message_type);
                }
            }
            Event::SawTool { .. }
            | Event::Unreachable { .. }
            | Event::TurnedAway { .. }
            | Event::Disconnected { .. } => {}
        }
    }

    /// Samples, statuses and refused messages on this connection, including those passed over.
    pub fn messages(&self) -> u64 {
        self.messages
    }

    /// True once a sample of `tool` has come.
    pub fn has(&self, tool: &str) -> bool {
        self.tools.iter().any(|sent| is_same_tool(sent, tool))
    }

    /// Says that no position of `tool` has come, what has come instead, and what to do.
    pub fn explain_missing(&self, tool: &str) -> String {
        let Census { peer, messages, refused, tools, devices } = self;
        let shown = |name: &str| format!("\"{}\"", clipped(name, SHOWN_MAX));
        if peer.is_empty() {
            return format!("tracker: not connected, so no position of {}", shown(tool));
        }
        // Tools come first, without the type of their messages.
        let devices = devices.iter().filter(|(name, _)| !tools.contains(*name));
        let (more_tools, others): (Vec<_>, Vec<_>) =
            devices.partition(|(_, message_type)| has_positions(message_type));
        let tool_names = tools.iter().chain(more_tools.into_iter().map(|(name, _)| name));
        let mut seen: Vec<String> = tool_names.map(|name| shown(name)).collect();
        let has_tools = !seen.is_empty();
        let with_type =
            |(name, message_type): (&String, &String)| format!("{} ({message_type})", shown(name));
        seen.extend(others.into_iter().map(with_type));
        let more = match seen.len().saturating_sub(NAMES_SHOWN) {
            0 => String::new(),
            more => format!(" and {more} more"),
        };
        seen.truncate(NAMES_SHOWN);
        let (count_of_tool, next) = match refused {
            _ if self.has(tool) => ("no new position", IN_VIEW.to_owned()),
            _ if !seen.is_empty() => {
                let advice = if has_tools { "set tracker.tool" } else { IN_VIEW };
                ("none", format!("saw {}{more}; {advice}", seen.join(", ")))
            }
            Some((count, last)) => ("none", format!("{count} refused: {last}")),
            None => ("none", "is the tool in view, and does the server send it?".to_owned()),
        };
        let (peer, tool) = (clipped(peer, SHOWN_MAX), shown(tool));
        let text =
            format!("tracker: {peer} sent {messages} messages, {count_of_tool} of {tool}; {next}");
        clipped(&text, MESSAGE_MAX).into_owned()
    }
}

/// The message type reported for NDJSON lines and for recordings.
pub(super) const NDJSON: &str = "NDJSON";

/// True for a type of message that contains samples.
pub(super) fn has_positions(message_type: &str) -> bool {
    matches!(message_type, "TRANSFORM" | "POSITION" | "TDATA" | "QTDATA" | NDJSON)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    fn sample(tool: &str) -> Event {
        Event::Sample(Sample::valid(tool, Vector3::zeros()))
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
        census.note(&Event::Disconnected { reason: "standard input has ended".to_owned() });
        assert_eq!(
            census.explain_missing("NeedleToTracker"),
            "tracker: localhost:18944 sent 37 messages, none of \"NeedleToTracker\"; saw \
             \"StylusToTracker\"; set tracker.tool"
        );
    }

    /// A link reports how many messages it did not pass on.
    #[test]
    fn messages_that_a_link_passed_over_are_counted() {
        let mut census = Census::default();
        census.note(&connected());
        let (tool, message_type) = ("StylusToTracker".to_owned(), "TRANSFORM".to_owned());
        census.note(&Event::SawTool { tool, message_type });
        for messages in [30, 7] {
            census.note(&Event::PassedOver { messages, dropped: 0 });
        }
        assert_eq!(
            census.explain_missing("NeedleToTracker"),
            "tracker: localhost:18944 sent 37 messages, none of \"NeedleToTracker\"; saw \
             \"StylusToTracker\"; set tracker.tool"
        );
    }

    #[test]
    fn tools_of_unread_message_types_are_named_with_the_type() {
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
            "tracker: localhost:18944 sent 1 messages, none of \"Needle\"; saw \"Stylus\", \"Probe\" \
             (IMAGE); set tracker.tool"
        );
    }

    #[test]
    fn a_tool_that_was_seen_is_not_reported_as_another() {
        let mut census = Census::default();
        census.note(&connected());
        census.note(&sample("Needle"));
        assert_eq!(
            census.explain_missing("Needle"),
            "tracker: localhost:18944 sent 1 messages, no new position of \"Needle\"; is the tool in view?"
        );
    }

    /// NDJSON and OpenIGTLink version 2 send names that are longer than what a message shows of them.
    #[test]
    fn a_tool_whose_shown_name_is_shortened_is_not_reported_as_another() {
        let tool = "NeedleTipToTrackerBaseFrame";
        let mut census = Census::default();
        census.note(&connected());
        census.note(&sample(tool));
        assert_eq!(
            census.explain_missing(tool),
            "tracker: localhost:18944 sent 1 messages, no new position of \
             \"NeedleTipToTrackerBas…\"; is the tool in view?"
        );
    }

    /// A server whose tools are all out of view may send only its status, or messages without tools.
    #[test]
    fn devices_without_tools_do_not_give_the_advice_to_set_tracker_tool() {
        let mut census = Census::default();
        census.note(&connected());
        for (device, message_type) in [("PlusServer", "STATUS"), ("Tracker", "TDATA without tools")]
        {
            let (tool, message_type) = (device.to_owned(), message_type.to_owned());
            census.note(&Event::SawTool { tool, message_type });
        }
        assert_eq!(
            census.explain_missing("Needle"),
            "tracker: localhost:18944 sent 0 messages, none of \"Needle\"; saw \"PlusServer\" (STATUS), \
             \"Tracker\" (TDATA without tools); is the tool in view?"
        );
        for message_type in ["TRANSFORM", "STATUS"].map(str::to_owned) {
            census.note(&Event::SawTool { tool: "PlusServer".to_owned(), message_type });
        }
        assert!(
            census.explain_missing("Needle").ends_with("; set tracker.tool"),
            "it has sent a position too"
        );
    }

    const OTHER_PORT: &str =
        "openigtlink: header version 9 (1 or 2 expected); is that port an OpenIGTLink server?";

    #[test]
    fn refused_messages_are_counted_and_the_last_reason_is_given() {
        let mut census = Census::default();
        census.note(&connected());
        for error in ["openigtlink: header version 7", OTHER_PORT] {
            census.note(&Event::Malformed(error.to_owned()));
        }
        assert_eq!(
            census.explain_missing("Needle"),
            "tracker: localhost:18944 sent 2 messages, none of \"Needle\"; 2 refused: \
             openigtlink: header version 9 (1 or 2 expected); is that port an OpenIGTLink server?"
        );
    }

    #[test]
    fn a_silent_peer_is_distinguished_from_no_connection() {
        let mut census = Census::default();
        assert_eq!(
            census.explain_missing("Needle"),
            "tracker: not connected, so no position of \"Needle\""
        );
        census.note(&sample("Needle"));
        census.note(&connected());
        assert!(!census.has("Needle"), "it was seen on another connection");
        assert!(
            census
                .explain_missing("Needle")
                .ends_with("is the tool in view, and does the server send it?")
        );
    }

    #[test]
    fn a_peer_of_many_names_does_not_fill_the_memory() {
        let mut census = Census::default();
        for i in 0..1000 {
            census.note(&sample(&format!("tool {i}")));
        }
        assert_eq!((census.tools.len(), census.messages()), (Reader::NAMES_MAX, 1000));
        census.note(&Event::Connected { peer: "x".repeat(500) });
        (0..9).for_each(|i| census.note(&sample(&format!("{i}").repeat(500))));
        let text = census.explain_missing(&"y".repeat(500));
        assert!(text.chars().count() <= MESSAGE_MAX, "{text}");
        assert!(text.ends_with(" and 7 more; set tracker.tool"), "{text}");
    }
}
