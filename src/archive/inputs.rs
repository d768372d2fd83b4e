//! `inputs.log`: the inputs of the session, in order, each with its time.
//!
//! Together with the configuration, they determine everything that the session does. The first line has the
//! format and the time at which the session was created. Each further line is one input: its time, in ns on the
//! run's own time line, its kind and its values. Frames and samples are not written a second time: `frame` is the
//! next received frame of `can.log`, `sample` the next line of `tracker.ndjson`. Text is quoted as in JSON.
//!
//! ```text
//! needle-bench inputs 1, begun 0
//! 0 tick
//! 1000000 frame
//! 2000000 connected "127.0.0.1:18944"
//! 2500000 sample
//! 2700000 step 1.0
//! 3000000 stop "operator: interrupted"
//! ```

use super::Lines;
use crate::session::{Input, OperatorCommand};
use crate::tracker::Event;
use crate::tracker::openigtlink::Status;
use crate::units::Time;
use serde_json::{Value, json};
use std::io;

/// Version of the format; raised when the meaning of a line changes.
const FORMAT: u32 = 1;
const TITLE: &str = "needle-bench inputs ";

/// The first line of `inputs.log`, without its newline, for a session that was created at `begun`.
pub fn inputs_header(begun: Time) -> String {
    format!("{TITLE}{FORMAT}, begun {}", begun.as_nanos())
}

/// The line of `inputs.log`, without its newline, for an `input` that the session was given at `time`.
pub fn input_line(time: Time, input: &Input) -> String {
    let (word, values) = word_and_values(input);
    let start = format!("{} {word}", time.as_nanos());
    values.iter().fold(start, |line, value| format!("{line} {value}"))
}

/// The word for an input's kind, and its values.
fn word_and_values(input: &Input) -> (&'static str, Vec<Value>) {
    match input {
        Input::Frame(_) => ("frame", vec![]),
        Input::Tick => ("tick", vec![]),
        Input::Stop(reason) => ("stop", vec![json!(reason)]),
        Input::Operator(command) => match command {
            OperatorCommand::Hold => ("hold", vec![]),
            OperatorCommand::Resume => ("resume", vec![]),
            OperatorCommand::Step { mm } => ("step", vec![json!(mm)]),
            OperatorCommand::Speed { mm_per_s } => ("speed", vec![json!(mm_per_s)]),
        },
        Input::BusFault(text) => ("bus-fault", vec![json!(text)]),
        Input::BusWarning(text) => ("bus-warning", vec![json!(text)]),
        Input::Tracker(event) => match event {
            Event::Sample(_) => ("sample", vec![]),
            Event::Connected { peer } => ("connected", vec![json!(peer)]),
            Event::Unreachable { reason } => ("unreachable", vec![json!(reason)]),
            Event::TurnedAway { reason } => ("turned-away", vec![json!(reason)]),
            Event::Disconnected { reason } => ("disconnected", vec![json!(reason)]),
            Event::Malformed(error) => ("malformed", vec![json!(error)]),
            Event::PassedOver { messages, dropped } => {
                ("passed-over", vec![json!(messages), json!(dropped)])
            }
            Event::SawTool { tool, message_type } => {
                ("saw-tool", vec![json!(tool), json!(message_type)])
            }
            Event::Status { device, status } => {
                let Status { code, subcode, error_name, message } = status;
                let values =
                    [json!(device), json!(code), json!(subcode), json!(error_name), json!(message)];
                ("status", values.into())
            }
        },
    }
}

/// An input as it is read back.
#[derive(Debug, Clone, PartialEq)]
pub enum RecordedInput {
    /// The next received frame of `can.log`.
    Frame,
    /// The next line of `tracker.ndjson`.
    Sample,
    /// Any other input.
    Input(Input),
}

/// Reads an `inputs.log` line by line: the inputs with their times, which never decrease.
pub struct Inputs {
    /// The time at which the session was created.
    pub begun: Time,
    /// The time of the last input read.
    last_time: Time,
    /// Lines read so far.
    pub line: usize,
    lines: Lines,
}

impl Inputs {
    /// Reads the header of an `inputs.log` with these `lines`.
    ///
    /// # Errors
    /// The file is empty, or its first line is not a header of this format.
    pub fn read(mut lines: Lines) -> Result<Self, String> {
        let header = lines.next().ok_or(
            "inputs.log holds no input: the bench was killed at once, or an earlier version of the bench \
             recorded a `needle-bench stage` operation",
        )?;
        let begun = parse_header(&header.map_err(unreadable)?)?;
        Ok(Inputs { begun, last_time: begun, line: 1, lines })
    }

    fn parse(&mut self, text: &str) -> Result<(Time, RecordedInput), String> {
        let line = self.line;
        let (time, input) = parse_line(text)
            .ok_or_else(|| format!("inputs.log line {line}: {text:?} is no input"))?;
        if time < self.last_time {
            let by_ns = self.last_time.as_nanos().saturating_sub(time.as_nanos());
            return Err(format!("inputs.log line {line}: its time goes back by {by_ns} ns"));
        }
        self.last_time = time;
        Ok((time, input))
    }
}

impl Iterator for Inputs {
    type Item = Result<(Time, RecordedInput), String>;

    fn next(&mut self) -> Option<Self::Item> {
        let text = self.lines.next()?;
        self.line += 1;
        Some(text.map_err(unreadable).and_then(|text| self.parse(&text)))
    }
}

fn unreadable(error: io::Error) -> String {
    format!("inputs.log: {error}")
}

/// The time at which the session was created.
fn parse_header(header: &str) -> Result<Time, String> {
    let not_inputs = || {
        let start: String = header.chars().take(80).collect();
        format!("inputs.log begins with {start:?}: not the inputs of a session")
    };
    let (format, begun) =
        header.strip_prefix(TITLE).and_then(|rest| rest.split_once(',')).ok_or_else(not_inputs)?;
    if format != FORMAT.to_string() {
        return Err(format!(
            "inputs.log has format {format}, this bench reads format {FORMAT}; use the bench it was made by"
        ));
    }
    let begun = begun.strip_prefix(" begun ").and_then(|ns| ns.parse().ok());
    begun.map(Time::from_nanos).ok_or_else(not_inputs)
}

fn parse_line(text: &str) -> Option<(Time, RecordedInput)> {
    let (time, rest) = text.split_once(' ')?;
    let (word, values) = rest.split_once(' ').unwrap_or((rest, ""));
    let values = serde_json::Deserializer::from_str(values).into_iter::<Value>();
    let values = values.collect::<Result<Vec<_>, _>>().ok()?;
    Some((Time::from_nanos(time.parse().ok()?), parse_input(word, &values)?))
}

/// The inverse of [`word_and_values`].
fn parse_input(word: &str, values: &[Value]) -> Option<RecordedInput> {
    let text = |value: &Value| value.as_str().map(str::to_owned);
    let input = match (word, values) {
        ("frame", []) => return Some(RecordedInput::Frame),
        ("sample", []) => return Some(RecordedInput::Sample),
        ("tick", []) => Input::Tick,
        ("stop", [reason]) => Input::Stop(text(reason)?),
        ("hold", []) => Input::Operator(OperatorCommand::Hold),
        ("resume", []) => Input::Operator(OperatorCommand::Resume),
        ("step", [mm]) => Input::Operator(OperatorCommand::Step { mm: mm.as_f64()? }),
        ("speed", [mm_per_s]) => {
            Input::Operator(OperatorCommand::Speed { mm_per_s: mm_per_s.as_f64()? })
        }
        ("bus-fault", [fault]) => Input::BusFault(text(fault)?),
        ("bus-warning", [warning]) => Input::BusWarning(text(warning)?),
        (_, values) => Input::Tracker(match (word, values) {
            ("connected", [peer]) => Event::Connected { peer: text(peer)? },
            ("unreachable", [reason]) => Event::Unreachable { reason: text(reason)? },
            ("turned-away", [reason]) => Event::TurnedAway { reason: text(reason)? },
            ("disconnected", [reason]) => Event::Disconnected { reason: text(reason)? },
            ("malformed", [error]) => Event::Malformed(text(error)?),
            ("saw-tool", [tool, message_type]) => {
                Event::SawTool { tool: text(tool)?, message_type: text(message_type)? }
            }
            ("passed-over", [messages, dropped]) => {
                Event::PassedOver { messages: messages.as_u64()?, dropped: dropped.as_u64()? }
            }
            ("status", [device, code, subcode, error_name, message]) => Event::Status {
                device: text(device)?,
                status: Status {
                    code: code.as_u64()?.try_into().ok()?,
                    subcode: subcode.as_i64()?,
                    error_name: text(error_name)?,
                    message: text(message)?,
                },
            },
            _ => return None,
        }),
    };
    Some(RecordedInput::Input(input))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::canopen::Frame;
    use crate::tracker::{Sample, Validity};
    use nalgebra::Vector3;
    use std::io::Cursor;

    fn tracker(event: Event) -> Input {
        Input::Tracker(event)
    }

    /// One input of each kind, and its line. Do not edit: replay reads these lines.
    fn frozen() -> Vec<(Input, &'static str)> {
        let sample = Sample {
            tool: "N".to_owned(),
            receive_time: Time::ZERO,
            source_unix_ns: None,
            position_mm: Vector3::zeros(),
            orientation: None,
            validity: Validity::Valid,
        };
        let status = Status {
            code: 13,
            subcode: -1,
            error_name: "NotReady".to_owned(),
            message: "warming up".to_owned(),
        };
        let (peer, device) = ("lab:18944".to_owned(), "Tracker".to_owned());
        let (tool, message_type) = ("Probe".to_owned(), "IMAGE".to_owned());
        let reason = || "gone,\nsaid \"x\"".to_owned();
        vec![
            (Input::Tick, "-5 tick"),
            (Input::Frame(Frame::new(0x80, &[])), "-5 frame"),
            (Input::Stop(reason()), r#"-5 stop "gone,\nsaid \"x\"""#),
            (Input::Operator(OperatorCommand::Hold), "-5 hold"),
            (Input::Operator(OperatorCommand::Resume), "-5 resume"),
            (Input::Operator(OperatorCommand::Step { mm: 1.0 }), "-5 step 1.0"),
            (Input::Operator(OperatorCommand::Speed { mm_per_s: 0.1 }), "-5 speed 0.1"),
            (Input::BusFault(reason()), r#"-5 bus-fault "gone,\nsaid \"x\"""#),
            (Input::BusWarning(reason()), r#"-5 bus-warning "gone,\nsaid \"x\"""#),
            (tracker(Event::Sample(sample)), "-5 sample"),
            (tracker(Event::Connected { peer }), r#"-5 connected "lab:18944""#),
            (
                tracker(Event::Unreachable { reason: reason() }),
                r#"-5 unreachable "gone,\nsaid \"x\"""#,
            ),
            (
                tracker(Event::TurnedAway { reason: reason() }),
                r#"-5 turned-away "gone,\nsaid \"x\"""#,
            ),
            (
                tracker(Event::Disconnected { reason: reason() }),
                r#"-5 disconnected "gone,\nsaid \"x\"""#,
            ),
            (tracker(Event::SawTool { tool, message_type }), r#"-5 saw-tool "Probe" "IMAGE""#),
            (
                tracker(Event::Status { device, status }),
                r#"-5 status "Tracker" 13 -1 "NotReady" "warming up""#,
            ),
            (
                tracker(Event::Malformed("ndjson: line 3: x".to_owned())),
                r#"-5 malformed "ndjson: line 3: x""#,
            ),
            (tracker(Event::PassedOver { messages: 60_000, dropped: 3 }), "-5 passed-over 60000 3"),
        ]
    }

    #[test]
    fn lines_are_frozen_and_read_back() {
        let header = inputs_header(Time::from_nanos(-7));
        assert_eq!(header, "needle-bench inputs 1, begun -7");
        for (input, line) in frozen() {
            let time = Time::from_nanos(-5);
            assert_eq!(input_line(time, &input), line);
            let expected = match input {
                Input::Frame(_) => RecordedInput::Frame,
                Input::Tracker(Event::Sample(_)) => RecordedInput::Sample,
                whole => RecordedInput::Input(whole),
            };
            let text = format!("{header}\n{line}\n0 ti");
            let read = Inputs::read(Lines::new(Cursor::new(text))).unwrap();
            assert_eq!(read.begun, Time::from_nanos(-7));
            assert_eq!(read.map(Result::unwrap).collect::<Vec<_>>(), [(time, expected)]);
        }
    }

    #[test]
    fn malformed_inputs_are_refused_with_the_line() {
        let header = "needle-bench inputs 1, begun 0";
        let cases = [
            (String::new(), "inputs.log holds no input"),
            ("step,time_s\n".to_owned(), "inputs.log begins with \"step,time_s\""),
            (header.replace('1', "2") + "\n", "inputs.log has format 2, this bench reads format 1"),
            (format!("{header}\n0 tock\n"), "inputs.log line 2: \"0 tock\" is no input"),
            (format!("{header}\n0 stop\n"), "inputs.log line 2: \"0 stop\" is no input"),
            (format!("{header}\n0 stop \"x\n"), "inputs.log line 2: \"0 stop \\\"x\" is no input"),
            (
                format!("{header}\n5 tick\n3 tick\n"),
                "inputs.log line 3: its time goes back by 2 ns",
            ),
        ];
        for (text, said) in cases {
            let all = Inputs::read(Lines::new(Cursor::new(text)))
                .and_then(|inputs| inputs.collect::<Result<Vec<_>, _>>());
            let error = all.unwrap_err();
            assert!(error.starts_with(said), "{error}");
        }
    }
}
