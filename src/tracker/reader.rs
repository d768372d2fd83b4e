//! Turns the bytes of a tracker's connection into events, for either protocol.

use super::event::{Event, NDJSON, has_positions};
use super::ndjson::LineDecoder;
use super::openigtlink::{Body, Message, Status, StreamDecoder};
use super::sample::Sample;
use crate::units::Time;
use std::collections::{BTreeMap, VecDeque};

/// The protocol of a tracker's connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Protocol {
    /// [OpenIGTLink](super::openigtlink).
    #[default]
    OpenIgtLink,
    /// [NDJSON](super::ndjson), one sample a line.
    Ndjson,
}

/// Turns the bytes of one connection into events: push what was received, then poll until
/// `Ok(None)`.
#[derive(Debug)]
pub struct Reader {
    decoder: Decoder,
    received: Time,
    /// Names seen on this connection, and whether positions came with them.
    names: BTreeMap<String, bool>,
    events: VecDeque<Event>,
    messages: u64,
    /// GET_STATUS was sent, and is not answered.
    awaits_status: bool,
}

#[derive(Debug)]
enum Decoder {
    OpenIgtLink(StreamDecoder),
    Ndjson(LineDecoder),
}

impl Reader {
    /// The most names kept of one connection: a peer with more is faulty or hostile.
    pub const NAMES_MAX: usize = 64;

    /// A reader at the start of a connection.
    pub fn new(protocol: Protocol) -> Self {
        Reader {
            decoder: match protocol {
                Protocol::OpenIgtLink => Decoder::OpenIgtLink(StreamDecoder::default()),
                Protocol::Ndjson => Decoder::Ndjson(LineDecoder::default()),
            },
            received: Time::ZERO,
            names: BTreeMap::new(),
            events: VecDeque::new(),
            messages: 0,
            awaits_status: false,
        }
    }

    /// Adds what was received at `now`.
    pub fn push(&mut self, now: Time, chunk: &[u8]) {
        self.received = now;
        match &mut self.decoder {
            Decoder::OpenIgtLink(decoder) => decoder.push(chunk),
            Decoder::Ndjson(decoder) => decoder.push(chunk),
        }
    }

    /// The next event, or `None` until more is pushed. A message that is wrong in itself becomes the
    /// event [`Event::Malformed`].
    ///
    /// # Errors
    /// An error that loses the start of the next message: drop the connection.
    pub fn poll(&mut self) -> Result<Option<Event>, String> {
        while self.events.is_empty() && self.advance()? {}
        Ok(self.events.pop_front())
    }

    /// Takes note that GET_STATUS was sent. If the peer answers with OK and no text, it only says that it is alive,
    /// and the answer becomes no event. A STATUS that comes unasked always does.
    pub fn await_status(&mut self) {
        self.awaits_status = true;
    }

    /// Ends the connection. Poll for a last line without an end.
    ///
    /// # Errors
    /// The connection ends within a message of OpenIGTLink.
    pub fn finish(&mut self) -> Result<(), String> {
        match &mut self.decoder {
            Decoder::OpenIgtLink(decoder) => {
                return decoder.finish().map_err(|error| error.to_string());
            }
            Decoder::Ndjson(decoder) => decoder.finish(),
        }
        Ok(())
    }

    /// The number of whole messages so far, of every type.
    pub fn messages(&self) -> u64 {
        self.messages
    }

    /// Reads the next message; false if there is none.
    fn advance(&mut self) -> Result<bool, String> {
        match &mut self.decoder {
            Decoder::OpenIgtLink(decoder) => match decoder.poll() {
                Ok(None) => return Ok(false),
                Ok(Some(message)) => self.take_message(message),
                Err(error) if error.loses_framing => return Err(error.to_string()),
                Err(error) => self.events.push_back(Event::Malformed(error.to_string())),
            },
            Decoder::Ndjson(decoder) => match decoder.poll() {
                Ok(None) => return Ok(false),
                Ok(Some(line)) => {
                    self.messages += 1;
                    self.take_sample(line.into_sample(self.received), NDJSON);
                }
                Err(error) => self.events.push_back(Event::Malformed(error)),
            },
        }
        Ok(true)
    }

    fn take_message(&mut self, message: Message) {
        self.messages += 1;
        // The answer to GET_STATUS of a device without a fault has nothing to report.
        if let Body::Status(status) = &message.body
            && std::mem::take(&mut self.awaits_status)
            && status.code == Status::OK
            && status.message.is_empty()
        {
            return;
        }
        let samples = Sample::from_message(&message, self.received);
        let message_type = message.body.type_name();
        if samples.is_empty() {
            // The device of a message without tools must not be taken for a tool.
            let without = if has_positions(message_type) { " without tools" } else { "" };
            self.note_name(message.full_device_name(), &format!("{message_type}{without}"));
        }
        for sample in samples {
            self.take_sample(sample, message_type);
        }
        if let Body::Status(status) = &message.body {
            let (device, status) = (message.full_device_name().to_owned(), status.clone());
            self.events.push_back(Event::Status { device, status });
        }
    }

    fn take_sample(&mut self, sample: Sample, message_type: &str) {
        self.note_name(&sample.tool, message_type);
        self.events.push_back(Event::Sample(sample));
    }

    /// Reports a name that is new on this connection, or comes with positions for the first time.
    fn note_name(&mut self, name: &str, message_type: &str) {
        let with_positions = has_positions(message_type);
        let is_news = match self.names.get(name) {
            Some(had_positions) => with_positions && !had_positions,
            None => self.names.len() < Self::NAMES_MAX,
        };
        if is_news {
            self.names.insert(name.to_owned(), with_positions);
            let (tool, message_type) = (name.to_owned(), message_type.to_owned());
            self.events.push_back(Event::SawTool { tool, message_type });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::openigtlink::{Tool, encode, tool_kind};
    use super::*;
    use proptest::prelude::*;
    use proptest::sample::Index;

    const AT: Time = Time::from_nanos(7);

    /// A message that is too short, both message types that hold positions, a status, and a type that is skipped.
    fn openigtlink() -> Vec<u8> {
        let tool = |name: &str| Tool {
            name: name.to_owned(),
            kind: tool_kind::SIX_D,
            pose: [0.0, 1.0, 2.0, 1.0, 0.0, 0.0, 0.0],
        };
        let status = Status {
            code: Status::OK,
            subcode: 0,
            error_name: String::new(),
            message: "tracking".to_owned(),
        };
        let mut short = encode(&Message::new("Needle", None, Body::TrackingData(Vec::new())));
        short[2..14].copy_from_slice(b"TRANSFORM\0\0\0");
        let rest = [
            Message::new("Needle", None, Body::Transform([0.5; 12])),
            Message::new("Tracker", None, Body::QuaternionTrackingData(vec![tool("A"), tool("B")])),
            Message::new("Server", None, Body::Status(status)),
            Message::new("Probe", None, Body::Other("GET_IMAGE".to_owned())),
        ];
        short.into_iter().chain(rest.iter().flat_map(encode)).collect()
    }

    fn ndjson() -> Vec<u8> {
        let good = r#"{"tool":"Needle","position_tracker_mm":[1,2,3]}"#;
        format!("{good}\nnot a sample\n\n{good}\r\n").into_bytes()
    }

    /// The events of a stream that arrives in `chunks`.
    fn read<'a>(protocol: Protocol, chunks: impl IntoIterator<Item = &'a [u8]>) -> Vec<Event> {
        let mut reader = Reader::new(protocol);
        let mut events = Vec::new();
        for chunk in chunks {
            reader.push(AT, chunk);
            while let Some(event) = reader.poll().expect("keeps its framing") {
                events.push(event);
            }
        }
        assert_eq!(reader.finish(), Ok(()));
        events
    }

    fn summary(events: &[Event]) -> Vec<String> {
        let line = |event: &Event| match event {
            Event::Sample(sample) => format!("{} at {:?}", sample.tool, sample.receive_time),
            Event::SawTool { tool, message_type } => format!("saw {tool} ({message_type})"),
            Event::Status { device, status } => format!("{device}: {}", status.message),
            Event::Malformed(error) => error.clone(),
            other => format!("{other:?}"),
        };
        events.iter().map(line).collect()
    }

    #[test]
    fn every_message_is_reported() {
        assert_eq!(
            summary(&read(Protocol::OpenIgtLink, [&openigtlink()[..]])),
            [
                "openigtlink: TRANSFORM \"Needle\": content of 0 bytes (48 expected)",
                "saw Needle (TRANSFORM)",
                "Needle at Time(7)",
                "saw A (QTDATA)",
                "A at Time(7)",
                "saw B (QTDATA)",
                "B at Time(7)",
                "saw Server (STATUS)",
                "Server: tracking",
                "saw Probe (GET_IMAGE)",
            ]
        );
        let lines = summary(&read(Protocol::Ndjson, [&ndjson()[..]]));
        assert_eq!(lines[..2], ["saw Needle (NDJSON)", "Needle at Time(7)"]);
        assert!(lines[2].starts_with("ndjson: line 2: "), "{}", lines[2]);
        assert_eq!(lines[3..], ["Needle at Time(7)"]);
    }

    #[test]
    fn a_device_whose_message_has_no_tools_is_not_reported_as_a_tool() {
        let empty = encode(&Message::new("Tracker", None, Body::TrackingData(Vec::new())));
        let events = read(Protocol::OpenIgtLink, [&empty[..]]);
        assert_eq!(summary(&events), ["saw Tracker (TDATA without tools)"]);
    }

    /// A device may send its status first, and its positions later.
    #[test]
    fn a_name_is_reported_again_when_it_comes_with_positions() {
        let status =
            Status { code: 1, subcode: 0, error_name: String::new(), message: String::new() };
        let pose = Body::Transform([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 4.0, 5.0, 6.0]);
        let bytes = [Body::Status(status), pose.clone(), pose]
            .map(|body| encode(&Message::new("Stylus", None, body)))
            .concat();
        let saw: Vec<_> = read(Protocol::OpenIgtLink, [&bytes[..]])
            .into_iter()
            .filter_map(|event| match event {
                Event::SawTool { message_type, .. } => Some(message_type),
                _ => None,
            })
            .collect();
        assert_eq!(saw, ["STATUS", "TRANSFORM"]);
    }

    #[test]
    fn a_peer_of_many_names_does_not_fill_the_memory() {
        let name = |i: usize| Message::new(&format!("{i}"), None, Body::Other("X".to_owned()));
        let stream: Vec<u8> = (0..1000).flat_map(|i| encode(&name(i))).collect();
        assert_eq!(read(Protocol::OpenIgtLink, [&stream[..]]).len(), Reader::NAMES_MAX);
    }

    #[test]
    fn bytes_that_are_no_header_end_the_reading() {
        let mut reader = Reader::new(Protocol::OpenIgtLink);
        reader.push(AT, &[b'x'; 100]);
        let error = reader.poll().expect_err("no header");
        assert!(error.starts_with("openigtlink: header version 30840 "), "{error}");
    }

    proptest! {
        #[test]
        fn any_split_gives_the_same_events(
            mut cuts in prop::collection::vec(any::<Index>(), 0..60),
            lines: bool,
        ) {
            let (protocol, stream) = match lines {
                true => (Protocol::Ndjson, ndjson()),
                false => (Protocol::OpenIgtLink, openigtlink()),
            };
            cuts.sort_by_key(|cut| cut.index(stream.len()));
            let mut from = 0;
            let ends = cuts.iter().map(|cut| cut.index(stream.len())).chain([stream.len()]);
            let chunks: Vec<&[u8]> =
                ends.map(|to| &stream[std::mem::replace(&mut from, to)..to]).collect();
            prop_assert_eq!(read(protocol, chunks), read(protocol, [&stream[..]]));
        }
    }
}
