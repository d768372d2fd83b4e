//! Samples as lines of JSON, one object per line, for a lab's scripts and for recordings.
//!
//! ```json
//! {"tool":"NeedleToTracker","position_tracker_mm":[1.5,-2.0,80.25]}
//! ```
//!
//! | key | value | |
//! |---|---|---|
//! | `tool` | text | the tool's name |
//! | `position_tracker_mm` | `[x,y,z]` | the sensor in the tracker's frame, mm |
//! | `orientation_tracker_wxyz` | `[w,x,y,z]` or `null` | optional: the sensor's orientation in that frame, a quaternion |
//! | `source_unix_ns` | whole number or `null` | optional: when the tracker measured the position, ns since 1970; 0 means no timestamp |
//! | `status` | text | optional: the tracker's status: `OK`, `MISSING`, `OUT_OF_VIEW`, or any other text for another fault |
//! | `receive_time_ns` | whole number | in recordings only: when the bench received the sample, ns on the recording's own time line; a replay keeps that pace |
//!
//! A number may be `"NaN"`, `"inf"` or `"-inf"`, since JSON has no numbers for these. The keys that the
//! bench adds in its own `tracker.ndjson` (`position_plane_mm`, `acquisition_time_ns`, `refused`) are
//! ignored: a replay judges each sample again. A line with any other key is refused.

mod decoder;

pub(super) use decoder::LineDecoder;

use super::event::Event;
use super::orientation::Orientation;
use super::sample::{Sample, Validity};
use crate::text::{clipped, escaped};
use crate::units::Time;
use nalgebra::Vector3;
use serde::Deserialize;
use serde::de::IgnoredAny;
use serde_json::Value;
use std::fmt::Display;

/// The longest line, bytes. A sample takes about 300.
pub const LINE_LIMIT: usize = 16 * 1024;

/// An error shows at most this many characters of serde_json's message.
const SHOWN_MAX: usize = 150;

/// The error for line number `line` of a stream, from 1.
fn line_error(line: u64, problem: impl Display) -> String {
    format!("ndjson: line {line}: {problem}")
}

/// A line as it was sent.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, expecting = "a JSON object")]
pub(super) struct Line {
    tool: String,
    position_tracker_mm: [Number; 3],
    orientation_tracker_wxyz: Option<[Number; 4]>,
    source_unix_ns: Option<i64>,
    status: Option<String>,
    receive_time_ns: Option<i64>,
    #[serde(rename = "position_plane_mm")]
    _position_plane_mm: Option<IgnoredAny>,
    #[serde(rename = "acquisition_time_ns")]
    _acquisition_time_ns: Option<IgnoredAny>,
    #[serde(rename = "refused")]
    _refused: Option<IgnoredAny>,
}

impl Line {
    /// Parses `text`, which is line number `line` of a stream without its newline.
    fn parse(line: u64, text: &[u8]) -> Result<Self, String> {
        // serde would read an array as the values of the keys in their order.
        if text.trim_ascii_start().starts_with(b"[") {
            return Err(line_error(line, "an array, expected a JSON object"));
        }
        serde_json::from_slice(text).map_err(|error| {
            let message = error.to_string();
            // serde_json sees one line only, so its " at line 1 column …" would mislead.
            let message = message.split(" at line ").next().unwrap_or_default();
            let message = escaped(message);
            let message = clipped(&message, SHOWN_MAX);
            line_error(line, format_args!("{message} (column {})", error.column()))
        })
    }

    /// The same line with its strings [escaped].
    fn printable(mut self) -> Self {
        self.tool = escaped(&self.tool).into_owned();
        self.status = self.status.map(|status| escaped(&status).into_owned());
        self
    }

    /// The sample, received at `receive_time`.
    pub(super) fn into_sample(self, receive_time: Time) -> Sample {
        let orientation = self.orientation_tracker_wxyz.map_or(Orientation::Absent, |wxyz| {
            Orientation::of_quaternion(wxyz.map(|Number(value)| value))
        });
        Sample {
            tool: self.tool,
            receive_time,
            source_unix_ns: self.source_unix_ns.filter(|&unix_ns| unix_ns != 0),
            position_mm: Vector3::from(self.position_tracker_mm.map(|Number(mm)| mm)),
            orientation: None,
            validity: self.status.map_or(Validity::Valid, |status| Validity::from_status(&status)),
        }
        .with_orientation(orientation)
    }
}

/// Reads all events of a recording, each with its time on the recording's own time line. A refused
/// line is an event at the time of the line before it.
///
/// # Errors
/// Nothing in it is a sample.
pub fn recording(text: &str) -> Result<Vec<(Time, Event)>, String> {
    let mut newest: Option<Time> = None;
    let mut first_error = None;
    let mut events: Vec<(Option<Time>, Event)> = Vec::new();
    let text = text.trim_start_matches('\u{feff}');
    let lines = text.lines().zip(1u64..).filter(|(line, _)| !line.trim().is_empty());
    for (text, line) in lines {
        match timed_sample(line, text, newest) {
            Ok(sample) => {
                newest = Some(sample.receive_time);
                events.push((newest, Event::Sample(sample)));
            }
            Err(error) => {
                first_error.get_or_insert(error.clone());
                events.push((newest, Event::Malformed(error)));
            }
        }
    }
    let Some(first) = events.iter().find_map(|(time, _)| *time) else {
        return Err(match first_error {
            Some(error) => format!("no line is a sample; the first: {error}"),
            None => "no line".to_owned(),
        });
    };
    Ok(events.into_iter().map(|(time, event)| (time.unwrap_or(first), event)).collect())
}

/// The sample in line `line` of the bench's own record, exactly as it was, even with a stamp of 0.
///
/// # Errors
/// The line is not a sample, or has no time of receipt.
pub fn recorded(line: u64, text: &str) -> Result<Sample, String> {
    let (parsed, time) = timed_line(line, text)?;
    let source_unix_ns = parsed.source_unix_ns;
    Ok(Sample { source_unix_ns, ..parsed.into_sample(time) })
}

const NO_TIME: &str = "no receive_time_ns: a replay needs it to keep the pace of the recording";

fn timed_line(line: u64, text: &str) -> Result<(Line, Time), String> {
    let parsed = Line::parse(line, text.as_bytes())?;
    let time_ns = parsed.receive_time_ns.ok_or_else(|| line_error(line, NO_TIME))?;
    Ok((parsed, Time::from_nanos(time_ns)))
}

fn timed_sample(line: u64, text: &str, newest: Option<Time>) -> Result<Sample, String> {
    let (parsed, time) = timed_line(line, text)?;
    let back_ns = newest.map_or(0, |newest| newest.as_nanos().saturating_sub(time.as_nanos()));
    if back_ns > 0 {
        return Err(line_error(line, format_args!("receive_time_ns goes back by {back_ns} ns")));
    }
    Ok(parsed.printable().into_sample(time))
}

/// A JSON number, or the word for one that JSON lacks.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(try_from = "Value")]
struct Number(f64);

impl TryFrom<Value> for Number {
    type Error = &'static str;
    fn try_from(value: Value) -> Result<Self, Self::Error> {
        let word = value.as_str().filter(|word| ["NaN", "inf", "-inf"].contains(word));
        let number = value.as_f64().or_else(|| word?.parse().ok());
        number.map(Number).ok_or("expected a number, \"NaN\", \"inf\" or \"-inf\"")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(text: &str) -> Result<Sample, String> {
        let line = Line::parse(3, text.as_bytes())?;
        Ok(line.into_sample(Time::from_nanos(9)))
    }

    /// Do not edit: scripts write these lines.
    #[test]
    fn a_line_of_two_keys_is_a_sample() {
        let sample = line(r#"{"tool":"Needle","position_tracker_mm":[1,-2.5,1e2]}"#).unwrap();
        assert_eq!(sample.tool, "Needle");
        assert_eq!(sample.position_mm, Vector3::new(1.0, -2.5, 100.0));
        assert_eq!((sample.receive_time, sample.source_unix_ns), (Time::from_nanos(9), None));
        assert_eq!((sample.orientation, sample.validity), (None, Validity::Valid));
    }

    /// Do not edit: recordings hold these lines.
    #[test]
    fn a_line_of_the_bench_s_own_record_is_a_sample() {
        let sample = line(
            r#"{"receive_time_ns":1020000000,"source_unix_ns":1700000001000000000,"tool":"Needle \"A\"","position_tracker_mm":[0.1,-2.0,1e-7],"orientation_tracker_wxyz":[1.0,0.0,0.0,0.0],"status":"OUT_OF_VIEW","position_plane_mm":[1.0,2.0,3.0],"acquisition_time_ns":1000000000,"refused":null}"#,
        )
        .unwrap();
        assert_eq!(sample.tool, "Needle \"A\"");
        assert_eq!(sample.source_unix_ns, Some(1_700_000_001_000_000_000));
        assert_eq!(sample.orientation, Some(nalgebra::UnitQuaternion::identity()));
        assert_eq!(sample.validity, Validity::OutOfView);
        let refused = line(
            r#"{"receive_time_ns":1,"source_unix_ns":null,"tool":"","position_tracker_mm":["NaN","inf","-inf"],"orientation_tracker_wxyz":null,"position_plane_mm":null,"acquisition_time_ns":null,"refused":"position is not finite"}"#,
        )
        .unwrap();
        let p_mm = refused.position_mm;
        assert!(p_mm.x.is_nan() && p_mm.y == f64::INFINITY && p_mm.z == f64::NEG_INFINITY);
    }

    #[test]
    fn the_error_of_a_bad_line_says_what_is_wrong() {
        let sample = |keys: &str| format!(r#"{{"tool":"N","position_tracker_mm":[1,2,3]{keys}}}"#);
        let cases = [
            ("", "EOF while parsing a value (column 0)"),
            ("1,2,3", "invalid type: integer `1`, expected a JSON object (column 1)"),
            (r#"["N",[1,2,3],null,null,null,1]"#, "an array, expected a JSON object"),
            (r#"{"tool":"N"}"#, "missing field `position_tracker_mm` (column 12)"),
            (
                r#"{"tool":"N","position_tracker_mm":[1,2]}"#,
                "invalid length 2, expected an array of length 3 (column 39)",
            ),
            (
                r#"{"tool":"N","position_tracker_mm":[1,2,"x"]}"#,
                "expected a number, \"NaN\", \"inf\" or \"-inf\" (column 43)",
            ),
            (
                r#"{"tool":"N","position_tracker_mm":[1,2,1e999]}"#,
                "number out of range (column 44)",
            ),
            (&sample(r#","tool":"M""#), "duplicate field `tool` (column 48)"),
            (
                &sample(r#","source_unix_ns":1.5"#),
                "invalid type: floating point `1.5`, expected i64 (column 62)",
            ),
            (&sample("")[..20], "EOF while parsing a string (column 20)"),
        ];
        for (text, problem) in cases {
            assert_eq!(line(text).unwrap_err(), format!("ndjson: line 3: {problem}"), "{text}");
        }
        let unknown = line(&sample(r#","oreintation_tracker_wxyz":[1,0,0,0]"#)).unwrap_err();
        assert!(
            unknown.starts_with(
                "ndjson: line 3: unknown field `oreintation_tracker_wxyz`, expected one of `tool`, "
            ),
            "{unknown}"
        );
        assert!(unknown.chars().count() <= 200, "{unknown}");
    }

    #[test]
    fn a_quaternion_that_is_no_rotation_makes_the_sample_invalid() {
        let text =
            r#"{"tool":"N","position_tracker_mm":[1,2,3],"orientation_tracker_wxyz":[0,0,0,0]}"#;
        assert_eq!(line(text).unwrap().validity, Validity::NotARotation);
    }

    #[test]
    fn a_recording_keeps_its_times_and_reports_its_bad_lines() {
        let good = |ns: i64| {
            format!(r#"{{"tool":"N","position_tracker_mm":[{ns},0,0],"receive_time_ns":{ns}}}"#)
        };
        let text = [
            "bad".to_owned(),
            good(50),
            r#"{"tool":"N","position_tracker_mm":[1,2,3]}"#.to_owned(),
            String::new(),
            good(70),
            good(60),
            good(70),
        ]
        .join("\n");
        let summary: Vec<String> = (recording(&text).unwrap().iter())
            .map(|(time, event)| match event {
                Event::Sample(sample) => format!("{} {}", time.as_nanos(), sample.position_mm.x),
                Event::Malformed(error) => format!("{} {error}", time.as_nanos()),
                other => panic!("{other:?}"),
            })
            .collect();
        assert_eq!(
            summary,
            [
                "50 ndjson: line 1: expected value (column 1)",
                "50 50",
                "50 ndjson: line 3: no receive_time_ns: a replay needs it to keep the pace of the \
                 recording",
                "70 70",
                "70 ndjson: line 6: receive_time_ns goes back by 10 ns",
                "70 70",
            ]
        );
    }

    #[test]
    fn the_benchs_own_record_is_read_exactly() {
        let line = r#"{"receive_time_ns":0,"source_unix_ns":0,"tool":"N","position_tracker_mm":[0.1,-0.0,"NaN"],"orientation_tracker_wxyz":null,"status":"OK"}"#;
        let sample = recorded(1, line).unwrap();
        assert_eq!((sample.receive_time, sample.source_unix_ns), (Time::ZERO, Some(0)));
        assert_eq!(sample.position_mm.y.to_bits(), (-0.0f64).to_bits());
        let given = recording(line).unwrap();
        let Event::Sample(sample) = &given[0].1 else { panic!("{given:?}") };
        assert_eq!(sample.source_unix_ns, None, "in a stream, 0 means no stamp");
    }

    #[test]
    fn a_byte_order_mark_is_ignored() {
        let text = "\u{feff}{\"tool\":\"N\",\"position_tracker_mm\":[1,2,3],\"receive_time_ns\":5}";
        let events = recording(text).unwrap();
        assert!(matches!(events[..], [(_, Event::Sample(_))]), "{events:?}");
    }

    #[test]
    fn a_file_without_a_sample_is_refused() {
        assert_eq!(recording("\n").unwrap_err(), "no line");
        assert_eq!(
            recording("step,time_s\n0,1.5\n").unwrap_err(),
            "no line is a sample; the first: ndjson: line 1: expected value (column 1)"
        );
    }
}
