//! One measurement of a tool, whatever protocol it came by.

use super::gate::is_same_tool;
use super::openigtlink::{Body, Message, Quaternion, tool_kind};
use super::orientation::Orientation;
use crate::units::Time;
use nalgebra::{Matrix3, UnitQuaternion, Vector3};

/// One position of a tool as the tracker sent it, in the tracker's frame T.
///
/// It has not been checked: the position may be infinite, stale, or that of another tool. The
/// [gate](super::gate) decides.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {
    /// The tool's name, truncated to 20 bytes if the protocol has no room for more.
    pub tool: String,
    /// When the sample was received, on the session's time line.
    pub receive_time: Time,
    /// When the sender says it was measured, in nanoseconds since 1970; `None` without a stamp.
    pub source_unix_ns: Option<i64>,
    /// `p_TS`: position of the tool's sensor S in T, mm.
    pub position_mm: Vector3<f64>,
    /// `R_TS`: orientation of the sensor in T; `None` if none was sent, or what was sent is not a
    /// rotation. It is kept as a quaternion, like in the record, so that a replay has the same bits.
    pub orientation: Option<UnitQuaternion<f64>>,
    /// The tracker's own verdict on the sample.
    pub validity: Validity,
}

/// The tracker's own verdict on a measurement.
#[derive(Debug, Clone, PartialEq, Eq, derive_more::Display)]
pub enum Validity {
    /// Measured, or sent without a status.
    #[display("valid")]
    Valid,
    /// The tool is not plugged in (`MISSING`).
    #[display("tool missing")]
    Missing,
    /// The tool cannot be seen (`OUT_OF_VIEW`).
    #[display("tool out of view")]
    OutOfView,
    /// An orientation was sent that is not a rotation.
    #[display("its orientation is not a rotation")]
    NotARotation,
    /// Invalid for another reason, in the tracker's words.
    #[display("{_0}")]
    Invalid(String),
}

impl Validity {
    /// The validity for PLUS's status of a transform: `OK`, `MISSING`, `OUT_OF_VIEW`, or another fault,
    /// whose text is kept.
    pub fn from_status(status: &str) -> Self {
        match status {
            "OK" => Validity::Valid,
            "MISSING" => Validity::Missing,
            "OUT_OF_VIEW" => Validity::OutOfView,
            NOT_A_ROTATION => Validity::NotARotation,
            other => Validity::Invalid(other.to_owned()),
        }
    }

    /// The status that [`Validity::from_status`] reads as this validity.
    pub fn status(&self) -> &str {
        match self {
            Validity::Valid => "OK",
            Validity::Missing => "MISSING",
            Validity::OutOfView => "OUT_OF_VIEW",
            Validity::NotARotation => NOT_A_ROTATION,
            Validity::Invalid(reason) => reason,
        }
    }
}

/// A status of the bench, in addition to those of PLUS.
const NOT_A_ROTATION: &str = "NOT_A_ROTATION";

impl Sample {
    /// The samples in an OpenIGTLink message, in its order; none where it carries no positions. In
    /// TDATA and QTDATA the tools have names of their own; elsewhere the tool is the device.
    pub fn from_message(message: &Message, receive_time: Time) -> Vec<Self> {
        let sample = |tool: &str, validity, (position, orientation): ([f32; 3], _)| {
            Sample {
                tool: tool.to_owned(),
                receive_time,
                source_unix_ns: message.timestamp.map(|stamp| stamp.unix_ns()),
                position_mm: Vector3::from(position.map(f64::from)),
                orientation: None,
                validity,
            }
            .with_orientation(orientation)
        };
        let device_sample =
            |pose| vec![sample(message.full_device_name(), device_validity(message), pose)];
        let tool_sample = |name: &str, kind, (position, orientation)| {
            let has_orientation = kind != tool_kind::THREE_D;
            let orientation = if has_orientation { orientation } else { Orientation::Absent };
            sample(name, tool_validity(message, name), (position, orientation))
        };
        match &message.body {
            Body::Transform(matrix) => device_sample(matrix_pose(matrix)),
            Body::Position { position_mm, quaternion } => {
                device_sample((*position_mm, quaternion_orientation(quaternion)))
            }
            Body::TrackingData(tools) => tools
                .iter()
                .map(|tool| tool_sample(&tool.name, tool.kind, matrix_pose(&tool.pose)))
                .collect(),
            Body::QuaternionTrackingData(tools) => tools
                .iter()
                .map(|tool| tool_sample(&tool.name, tool.kind, quaternion_pose(&tool.pose)))
                .collect(),
            Body::Status(_) | Body::Other(_) => Vec::new(),
        }
    }

    /// The sample with the orientation that was sent with it. One that is not a rotation makes the sample
    /// invalid, unless the tracker already called it invalid.
    pub(super) fn with_orientation(mut self, sent: Orientation) -> Self {
        match sent {
            Orientation::Absent => {}
            Orientation::Rotation(quaternion) => self.orientation = Some(quaternion),
            Orientation::NotARotation if self.validity == Validity::Valid => {
                self.validity = Validity::NotARotation;
            }
            Orientation::NotARotation => {}
        }
        self
    }
}

/// The validity by PLUS's metadata of the device: `TransformStatus` names the fault, `TransformValid` is
/// true or false. Without either the device is valid.
fn device_validity(message: &Message) -> Validity {
    let status = message.metadata("TransformStatus").map_or(Validity::Valid, Validity::from_status);
    let is_true = |value: &str| value.eq_ignore_ascii_case("true") || value == "1";
    match message.metadata("TransformValid").filter(|value| !is_true(value)) {
        Some(value) if status == Validity::Valid => {
            Validity::Invalid(format!("TransformValid is {value}"))
        }
        _ => status,
    }
}

/// The validity of one of several tools by PLUS's metadata `<name>Status`, which has the tool's whole name
/// even where the message truncates it. Without this key it is the validity of the device.
fn tool_validity(message: &Message, tool: &str) -> Validity {
    let own = message.metadata.iter().find_map(|(key, status)| {
        let name = key.strip_suffix("Status")?;
        is_same_tool(tool, name).then(|| Validity::from_status(status))
    });
    own.unwrap_or_else(|| device_validity(message))
}

/// Position and orientation from the numbers of a TRANSFORM.
fn matrix_pose(numbers: &[f32; 12]) -> ([f32; 3], Orientation) {
    let [xx, xy, xz, yx, yy, yz, zx, zy, zz, px, py, pz] = *numbers;
    let columns = [xx, xy, xz, yx, yy, yz, zx, zy, zz].map(f64::from);
    ([px, py, pz], Orientation::of_matrix(&Matrix3::from_column_slice(&columns)))
}

/// Position and orientation from the numbers of a QTDATA tool.
fn quaternion_pose(numbers: &[f32; 7]) -> ([f32; 3], Orientation) {
    let [px, py, pz, x, y, z, w] = *numbers;
    ([px, py, pz], quaternion_orientation(&Quaternion::Full([x, y, z, w])))
}

fn quaternion_orientation(sent: &Quaternion) -> Orientation {
    match *sent {
        Quaternion::Absent => Orientation::Absent,
        Quaternion::Imaginary(xyz) => Orientation::of_imaginary(xyz.map(f64::from)),
        Quaternion::Full([x, y, z, w]) => Orientation::of_quaternion([w, x, y, z].map(f64::from)),
    }
}

#[cfg(test)]
mod tests {
    use super::super::openigtlink::{IgtlStamp, Tool};
    use super::*;

    impl Sample {
        /// A valid sample, received at time 0, without stamp and orientation.
        pub(crate) fn valid(tool: &str, position_mm: Vector3<f64>) -> Self {
            Sample {
                tool: tool.to_owned(),
                receive_time: Time::ZERO,
                source_unix_ns: None,
                position_mm,
                orientation: None,
                validity: Validity::Valid,
            }
        }
    }

    const AT: Time = Time::from_nanos(5);
    const QUARTER_TURN: [f32; 12] = [0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 4.0, 5.0, 6.0];

    /// The samples of a version 2 message with `metadata`.
    fn samples(body: Body, metadata: &[(&str, &str)]) -> Vec<Sample> {
        let message = Message {
            metadata: metadata.iter().map(|(k, v)| (k.to_string(), v.to_string())).collect(),
            ..Message::new("Tip", IgtlStamp::from_unix_ns(1_500_000_000), body)
        };
        Sample::from_message(&message, AT)
    }

    fn sample(body: Body) -> Sample {
        samples(body, &[]).remove(0)
    }

    fn tools(metadata: &[(&str, &str)]) -> Vec<Sample> {
        let tool = |name: &str, kind| Tool { name: name.to_owned(), kind, pose: QUARTER_TURN };
        let tools = vec![
            tool("Needle", tool_kind::SIX_D),
            tool("ReferenceToTrackerBa", tool_kind::FIVE_D),
            tool("Ball", tool_kind::THREE_D),
        ];
        samples(Body::TrackingData(tools), metadata)
    }

    fn validities(samples: &[Sample]) -> Vec<Validity> {
        samples.iter().map(|sample| sample.validity.clone()).collect()
    }

    #[test]
    fn a_transform_is_read_column_by_column() {
        let sample = sample(Body::Transform(QUARTER_TURN));
        assert_eq!(sample.position_mm, Vector3::new(4.0, 5.0, 6.0));
        let orientation = sample.orientation.expect("a rotation");
        assert!((orientation * Vector3::x() - Vector3::y()).norm() < 1e-15);
        assert_eq!((sample.tool.as_str(), sample.receive_time), ("Tip", AT));
        assert_eq!(sample.source_unix_ns, Some(1_500_000_000));
        assert_eq!(sample.validity, Validity::Valid);
    }

    #[test]
    fn a_position_is_read_in_each_form() {
        let position = |quaternion| sample(Body::Position { position_mm: [1.0; 3], quaternion });
        let half = std::f32::consts::FRAC_1_SQRT_2;
        for quaternion in
            [Quaternion::Full([half, 0.0, 0.0, half]), Quaternion::Imaginary([half, 0.0, 0.0])]
        {
            let orientation = position(quaternion).orientation.expect("unit");
            assert!((orientation * Vector3::y() - Vector3::z()).norm() < 1e-6);
        }
        let absent = position(Quaternion::Absent);
        assert_eq!((absent.orientation, absent.validity), (None, Validity::Valid));
    }

    #[test]
    fn each_tool_of_tdata_is_a_sample() {
        let samples = tools(&[]);
        let names: Vec<&str> = samples.iter().map(|sample| sample.tool.as_str()).collect();
        assert_eq!(names, ["Needle", "ReferenceToTrackerBa", "Ball"]);
        for sample in &samples {
            assert_eq!(sample.position_mm, Vector3::new(4.0, 5.0, 6.0));
            assert_eq!(sample.source_unix_ns, Some(1_500_000_000));
        }
        assert_eq!(samples[0].orientation, sample(Body::Transform(QUARTER_TURN)).orientation);
        assert!(samples[1].orientation.is_some());
        assert_eq!(samples[2].orientation, None, "it has three degrees of freedom");
    }

    #[test]
    fn qtdata_quaternions_have_w_last() {
        let half = std::f32::consts::FRAC_1_SQRT_2;
        let pose = [4.0, 5.0, 6.0, 0.0, 0.0, half, half];
        let tool = Tool { name: "Needle".to_owned(), kind: tool_kind::SIX_D, pose };
        let sample = sample(Body::QuaternionTrackingData(vec![tool]));
        assert_eq!(sample.position_mm, Vector3::new(4.0, 5.0, 6.0));
        let orientation = sample.orientation.expect("unit");
        assert!((orientation * Vector3::x() - Vector3::y()).norm() < 1e-7);
    }

    #[test]
    fn a_matrix_that_is_not_a_rotation_makes_a_sample_invalid() {
        let zero = sample(Body::Transform([0.0; 12]));
        assert_eq!((zero.orientation, zero.validity), (None, Validity::NotARotation));
        let missing = samples(Body::Transform([0.0; 12]), &[("TransformStatus", "MISSING")]);
        assert_eq!(validities(&missing), [Validity::Missing], "as the tracker says");
    }

    #[test]
    fn metadata_says_whether_a_tool_was_seen() {
        let validity = |metadata: &[(&str, &str)]| {
            validities(&samples(Body::Transform(QUARTER_TURN), metadata)).remove(0)
        };
        let says = |metadata: &[(&str, &str)], reason: &str| {
            assert_eq!(validity(metadata), Validity::Invalid(reason.to_owned()));
        };
        let ok = [("TransformStatus", "OK"), ("TransformValid", "True")];
        assert_eq!(validity(&ok), Validity::Valid);
        assert_eq!(validity(&[("TransformValid", "1")]), Validity::Valid);
        assert_eq!(validity(&[("TransformStatus", "MISSING")]), Validity::Missing);
        let out_of_view = [("TransformValid", "False"), ("TransformStatus", "OUT_OF_VIEW")];
        assert_eq!(validity(&out_of_view), Validity::OutOfView);
        says(&[("TransformStatus", "OUT_OF_VOLUME")], "OUT_OF_VOLUME");
        says(&[("TransformStatus", "OK"), ("TransformValid", "0")], "TransformValid is 0");
        says(&[("TransformValid", "false")], "TransformValid is false");
    }

    #[test]
    fn metadata_says_whether_each_tool_was_seen_by_its_whole_name() {
        let metadata = [("NeedleStatus", "OK"), ("ReferenceToTrackerBaseStatus", "MISSING")];
        assert_eq!(
            validities(&tools(&metadata)),
            [Validity::Valid, Validity::Missing, Validity::Valid]
        );
        let of_all = [("TransformStatus", "OUT_OF_VIEW"), ("BallStatus", "OK")];
        assert_eq!(
            validities(&tools(&of_all)),
            [Validity::OutOfView, Validity::OutOfView, Validity::Valid]
        );
    }

    #[test]
    fn each_validity_is_read_back_from_its_status() {
        let validities = [
            Validity::Valid,
            Validity::Missing,
            Validity::OutOfView,
            Validity::NotARotation,
            Validity::Invalid("MISSING_REFERENCE".to_owned()),
        ];
        for validity in validities {
            assert_eq!(Validity::from_status(validity.status()), validity);
        }
    }

    #[test]
    fn other_messages_are_no_sample() {
        assert_eq!(samples(Body::Other("IMAGE".to_owned()), &[]), []);
    }
}
