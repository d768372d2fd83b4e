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
mod recording;

pub(super) use decoder::LineDecoder;
pub use recording::{RecordingError, recorded, recording};

use super::orientation::Orientation;
use super::sample::{Sample, Validity};
use crate::text::{clipped, escaped};
use crate::units::Time;
use nalgebra::Vector3;
use serde::Deserialize;
use serde::de::IgnoredAny;
use thiserror::Error;

/// The longest line, bytes. A sample takes about 300.
pub const LINE_LIMIT: usize = 16 * 1024;

/// The longest text of serde_json in an error, characters.
const SHOWN_MAX: usize = 150;

/// A line that is not a sample.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("ndjson: line {line}: {problem}")]
pub struct LineError {
    /// Which line, from 1.
    pub line: u64,
    /// What is wrong with it.
    pub problem: LineProblem,
}

/// What is wrong with a line.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum LineProblem {
    /// It is not JSON, or not an object of this form.
    #[error("{0}")]
    NotASample(String),
    /// It is longer than [`LINE_LIMIT`]; the rest of it is skipped.
    #[error("longer than {LINE_LIMIT} bytes")]
    TooLong,
    /// The stream ended before the line did.
    #[error("{0} bytes and no end of line; it was cut off")]
    Unfinished(usize),
    /// It has no time, which a replay of a recording needs.
    #[error("no receive_time_ns: a replay needs it to keep the pace of the recording")]
    NoTime,
    /// Its time goes back; the times of a recording must not.
    #[error("receive_time_ns goes back by {0} ns")]
    Backwards(i64),
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
    fn parse(line: u64, text: &[u8]) -> Result<Self, LineError> {
        serde_json::from_slice(text).map_err(|error| {
            let message = error.to_string();
            // serde_json sees one line only, so its " at line 1 column …" would mislead.
            let message = message.split(" at line ").next().unwrap_or_default();
            let message = escaped(message);
            let message = clipped(&message, SHOWN_MAX);
            let problem = LineProblem::NotASample(format!("{message} (column {})", error.column()));
            LineError { line, problem }
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
            Orientation::of_quaternion(wxyz.map(Number::value))
        });
        Sample {
            tool: self.tool,
            receive_time,
            source_unix_ns: self.source_unix_ns.filter(|&unix_ns| unix_ns != 0),
            position_mm: Vector3::from(self.position_tracker_mm.map(Number::value)),
            orientation: None,
            validity: self.status.map_or(Validity::Valid, |status| Validity::from_status(&status)),
        }
        .oriented(orientation)
    }
}

/// A JSON number, or the word for one that JSON lacks.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(untagged, expecting = "expected a number, \"NaN\", \"inf\" or \"-inf\"")]
enum Number {
    Number(f64),
    Word(NumberWord),
}

#[derive(Debug, Clone, Copy, Deserialize)]
enum NumberWord {
    NaN,
    #[serde(rename = "inf")]
    Infinity,
    #[serde(rename = "-inf")]
    MinusInfinity,
}

impl Number {
    fn value(self) -> f64 {
        match self {
            Number::Number(value) => value,
            Number::Word(NumberWord::NaN) => f64::NAN,
            Number::Word(NumberWord::Infinity) => f64::INFINITY,
            Number::Word(NumberWord::MinusInfinity) => f64::NEG_INFINITY,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(text: &str) -> Result<Sample, String> {
        let line = Line::parse(3, text.as_bytes()).map_err(|error| error.to_string())?;
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
}
