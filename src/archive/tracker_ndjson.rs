//! `tracker.ndjson`: every sample as received, one JSON object a line.

use crate::session::SampleRecord;
use crate::tracker::gate::is_same_tool;
use crate::units::Time;
use nalgebra::Vector3;
use serde::{Deserialize, Serialize, Serializer};

/// A sample as a line of `tracker.ndjson`, without its newline.
///
/// Times are whole nanoseconds. JSON has no NaN and no infinity, but a stream may send them: they are
/// written as the strings `"NaN"`, `"inf"`, `"-inf"`, which Rust's `f64::from_str` and Python's `float`
/// both read.
pub fn line(sample: &SampleRecord) -> Result<String, serde_json::Error> {
    let SampleRecord { received, position_plane_mm, acquisition_time, refused } = sample;
    let orientation = received.orientation.map(|q| [q.w, q.i, q.j, q.k].map(Number));
    serde_json::to_string(&Line {
        receive_time_ns: received.receive_time.as_nanos(),
        source_unix_ns: received.source_unix_ns,
        tool: &received.tool,
        position_tracker_mm: position(&received.position_mm),
        orientation_tracker_wxyz: orientation,
        status: received.validity.status(),
        position_plane_mm: position_plane_mm.as_ref().map(position),
        acquisition_time_ns: acquisition_time.map(Time::as_nanos),
        refused: refused.as_ref().map(ToString::to_string),
    })
}

#[derive(Serialize)]
struct Line<'a> {
    receive_time_ns: i64,
    source_unix_ns: Option<i64>,
    tool: &'a str,
    position_tracker_mm: [Number; 3],
    orientation_tracker_wxyz: Option<[Number; 4]>,
    status: &'a str,
    position_plane_mm: Option<[Number; 3]>,
    acquisition_time_ns: Option<i64>,
    refused: Option<String>,
}

/// The tool and the times of a sample of `tracker.ndjson`, and whether it was accepted.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct TrackerTimes {
    /// The tool, as it was sent.
    pub tool: String,
    /// When the bench received it, ns on the run's time line.
    pub receive_time_ns: i64,
    /// When the tip was at this position, ns on the run's time line, if the sample was accepted.
    pub acquisition_time_ns: Option<i64>,
    /// Why it was refused; `None` if it was accepted.
    pub refused: Option<String>,
}

impl TrackerTimes {
    /// The times in `line`; `None` if it is not a sample.
    pub fn parse(line: &str) -> Option<Self> {
        serde_json::from_str(line).ok()
    }

    /// True if the sample is of `tool`, whose name a sender may have truncated.
    pub fn is_of(&self, tool: &str) -> bool {
        is_same_tool(&self.tool, tool)
    }
}

fn position(p: &Vector3<f64>) -> [Number; 3] {
    [p.x, p.y, p.z].map(Number)
}

struct Number(f64);

impl Serialize for Number {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if self.0.is_finite() {
            serializer.serialize_f64(self.0)
        } else {
            serializer.collect_str(&self.0)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::archive::Lines;
    use crate::tracker::{GateName, Refusal, Sample, Validity};
    use nalgebra::UnitQuaternion;

    /// Do not edit: scripts and replay read these lines.
    #[test]
    fn lines_are_frozen() {
        let accepted = SampleRecord {
            received: Sample {
                receive_time: Time::from_nanos(1_020_000_000),
                source_unix_ns: Some(1_700_000_001_000_000_000),
                tool: "Needle \"A\"".to_owned(),
                position_mm: Vector3::new(0.1, -2.0, 1e-7),
                orientation: Some(UnitQuaternion::identity()),
                validity: Validity::Valid,
            },
            position_plane_mm: Some(Vector3::new(1.0, 2.0, 3.0)),
            acquisition_time: Some(Time::from_nanos(1_000_000_000)),
            refused: None,
        };
        assert_eq!(
            line(&accepted).unwrap(),
            r#"{"receive_time_ns":1020000000,"source_unix_ns":1700000001000000000,"tool":"Needle \"A\"","position_tracker_mm":[0.1,-2.0,1e-7],"orientation_tracker_wxyz":[1.0,0.0,0.0,0.0],"status":"OK","position_plane_mm":[1.0,2.0,3.0],"acquisition_time_ns":1000000000,"refused":null}"#
        );
        let refused = SampleRecord {
            received: Sample {
                source_unix_ns: None,
                tool: String::new(),
                position_mm: Vector3::new(f64::NAN, f64::INFINITY, f64::NEG_INFINITY),
                orientation: None,
                validity: Validity::OutOfView,
                ..accepted.received
            },
            position_plane_mm: None,
            acquisition_time: None,
            refused: Some(Refusal::new(GateName::Zero, "not seen")),
        };
        assert_eq!(
            line(&refused).unwrap(),
            r#"{"receive_time_ns":1020000000,"source_unix_ns":null,"tool":"","position_tracker_mm":["NaN","inf","-inf"],"orientation_tracker_wxyz":null,"status":"OUT_OF_VIEW","position_plane_mm":null,"acquisition_time_ns":null,"refused":"zero: not seen"}"#
        );
    }

    #[test]
    fn the_times_of_whole_lines_are_read() {
        let text = "{\"receive_time_ns\":20,\"acquisition_time_ns\":7,\"refused\":null,\"tool\":\"N\"}\n\
                    {}\n\
                    {\"receive_time_ns\":30,\"acquisition_time_ns\":null,\"refused\":\"zero\",\"tool\":\"N\"}\n\
                    {\"rece";
        let times = |receive_time_ns, acquisition_time_ns, refused: Option<&str>| TrackerTimes {
            tool: "N".to_owned(),
            receive_time_ns,
            acquisition_time_ns,
            refused: refused.map(str::to_owned),
        };
        assert_eq!(
            Lines::new(text.as_bytes()).parse(TrackerTimes::parse).unwrap(),
            (vec![times(20, Some(7), None), times(30, None, Some("zero"))], vec![2])
        );
    }
}
