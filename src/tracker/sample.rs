//! One measurement of a tool, whatever protocol it came by.

use super::openigtlink::{Body, Message, Quaternion as Sent};
use crate::units::Time;
use nalgebra::{Matrix3, Quaternion, Rotation3, UnitQuaternion, Vector3};
use std::fmt;

/// One position of a tool as the tracker sent it, in the tracker's frame T.
///
/// Nothing of it has been checked: the position may be infinite, stale or somebody else's. The
/// [gate](super::gate) decides.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {
    /// The tool's name. Cut to 20 bytes where the protocol cuts it.
    pub tool: String,
    /// When the sample was received, on the session's time line.
    pub receive_time: Time,
    /// When the sender says it was measured, in nanoseconds since 1970; none without a stamp.
    pub source_unix_ns: Option<i64>,
    /// `p_TS`: position of the tool's sensor S in T, mm.
    pub position_mm: Vector3<f64>,
    /// `R_TS`: orientation of the sensor in T; none where none was sent, or nothing that is a
    /// rotation.
    pub orientation: Option<Rotation3<f64>>,
    /// What the tracker says of the measurement itself.
    pub validity: Validity,
}

/// A tracker's own word on a measurement.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Validity {
    /// Measured, or nothing was said of it.
    Valid,
    /// The tool is not plugged in (`MISSING`).
    Missing,
    /// The tool cannot be seen (`OUT_OF_VIEW`).
    OutOfView,
    /// An orientation was sent that is not a rotation.
    NotARotation,
    /// Invalid for another reason, in the tracker's words.
    Invalid(String),
}

impl fmt::Display for Validity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Validity::Valid => f.write_str("valid"),
            Validity::Missing => f.write_str("tool missing"),
            Validity::OutOfView => f.write_str("tool out of view"),
            Validity::NotARotation => f.write_str("its orientation is not a rotation"),
            Validity::Invalid(reason) => f.write_str(reason),
        }
    }
}

/// How far `RᵀR` may be from the identity (Frobenius norm), or a quaternion's length from 1.
/// Single precision leaves 1e-6, matrices written as text with four digits 1e-4.
const ROTATION_TOLERANCE: f64 = 1e-3;

impl Sample {
    /// The sample in an OpenIGTLink message; none if it is not of a type that carries one.
    pub fn from_message(message: &Message, receive_time: Time) -> Option<Self> {
        let (position, orientation) = match &message.body {
            Body::Transform([xx, xy, xz, yx, yy, yz, zx, zy, zz, px, py, pz]) => {
                let columns = [xx, xy, xz, yx, yy, yz, zx, zy, zz].map(|e| f64::from(*e));
                let matrix = Matrix3::from_column_slice(&columns);
                ([*px, *py, *pz], Some(rotation_of_matrix(&matrix)))
            }
            Body::Position { position_mm, quaternion } => {
                (*position_mm, rotation_of_quaternion(quaternion))
            }
            Body::Status(_) | Body::Other(_) => return None,
        };
        let validity = match (tracker_says(message), orientation) {
            (Validity::Valid, Some(None)) => Validity::NotARotation,
            (said, _) => said,
        };
        Some(Sample {
            tool: message.full_device_name().to_owned(),
            receive_time,
            source_unix_ns: message.timestamp.map(|stamp| stamp.unix_ns()),
            position_mm: Vector3::from(position.map(f64::from)),
            orientation: orientation.flatten(),
            validity,
        })
    }
}

/// PLUS's metadata: `TransformStatus` names the fault, `TransformValid` is true or false.
fn tracker_says(message: &Message) -> Validity {
    let valid = message.metadata("TransformValid");
    match message.metadata("TransformStatus") {
        Some("MISSING") => Validity::Missing,
        Some("OUT_OF_VIEW") => Validity::OutOfView,
        Some(status) if status != "OK" => Validity::Invalid(status.to_owned()),
        _ => match valid {
            Some(word) if !word.eq_ignore_ascii_case("true") && word != "1" => {
                Validity::Invalid(format!("TransformValid is {word}"))
            }
            _ => Validity::Valid,
        },
    }
}

/// The rotation nearest to `matrix`, none if it is none to [`ROTATION_TOLERANCE`].
fn rotation_of_matrix(matrix: &Matrix3<f64>) -> Option<Rotation3<f64>> {
    let residual = (matrix.transpose() * matrix - Matrix3::identity()).norm();
    // Written so that NaN is refused.
    let is_rotation = residual <= ROTATION_TOLERANCE && matrix.determinant() > 0.0;
    is_rotation.then(|| {
        let mut rotation = Rotation3::from_matrix_unchecked(*matrix);
        rotation.renormalize();
        rotation
    })
}

/// The outer none: no orientation was sent. The inner none: it is not a rotation.
fn rotation_of_quaternion(sent: &Sent) -> Option<Option<Rotation3<f64>>> {
    let [x, y, z, w] = match *sent {
        Sent::Absent => return None,
        Sent::Full(xyzw) => xyzw.map(f64::from),
        Sent::Imaginary(xyz) => {
            let [x, y, z] = xyz.map(f64::from);
            // w from the unit length. A half turn may come out a rounding longer than 1.
            [x, y, z, (1.0 - x * x - y * y - z * z).max(0.0).sqrt()]
        }
    };
    let quaternion = Quaternion::new(w, x, y, z);
    let is_unit = (quaternion.norm() - 1.0).abs() <= ROTATION_TOLERANCE;
    Some(is_unit.then(|| UnitQuaternion::new_normalize(quaternion).to_rotation_matrix()))
}

#[cfg(test)]
mod tests {
    use super::super::openigtlink::{IgtlStamp, Version};
    use super::*;

    const AT: Time = Time::from_nanos(5);

    fn sample(body: Body) -> Sample {
        let stamp = IgtlStamp::from_unix_ns(1_500_000_000);
        Sample::from_message(&Message::new("Tip", stamp, body), AT).expect("carries a position")
    }

    fn position(quaternion: Sent) -> Sample {
        sample(Body::Position { position_mm: [1.0, 2.0, 3.0], quaternion })
    }

    #[test]
    fn a_transform_is_read_column_by_column() {
        let quarter_turn = [0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 4.0, 5.0, 6.0];
        let sample = sample(Body::Transform(quarter_turn));
        assert_eq!(sample.position_mm, Vector3::new(4.0, 5.0, 6.0));
        let orientation = sample.orientation.expect("a rotation");
        assert!((orientation * Vector3::x() - Vector3::y()).norm() < 1e-15);
        assert_eq!((sample.tool.as_str(), sample.receive_time), ("Tip", AT));
        assert_eq!(sample.source_unix_ns, Some(1_500_000_000));
        assert_eq!(sample.validity, Validity::Valid);
    }

    #[test]
    fn an_exact_identity_stays_exact() {
        let identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0];
        let sample = sample(Body::Transform(identity));
        assert_eq!(sample.orientation, Some(Rotation3::identity()));
    }

    #[test]
    fn the_three_forms_of_a_position_agree() {
        let half = std::f32::consts::FRAC_1_SQRT_2;
        let full = position(Sent::Full([half, 0.0, 0.0, half])).orientation.expect("unit");
        let imaginary = position(Sent::Imaginary([half, 0.0, 0.0])).orientation.expect("unit");
        assert!((full * Vector3::y() - Vector3::z()).norm() < 1e-7);
        assert!((full.matrix() - imaginary.matrix()).norm() < 1e-6);
        let absent = position(Sent::Absent);
        assert_eq!((absent.orientation, absent.validity), (None, Validity::Valid));
        let half_turn = position(Sent::Imaginary([1.000_000_1, 0.0, 0.0])).orientation;
        assert!(half_turn.is_some());
    }

    #[test]
    fn what_is_not_a_rotation_is_marked() {
        let reflection = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 1.0, 1.0];
        let mut nan = reflection;
        nan[0] = f32::NAN;
        for matrix in [[0.0; 12], reflection, nan, reflection.map(|e| 2.0 * e)] {
            let sample = sample(Body::Transform(matrix));
            assert_eq!((sample.orientation, sample.validity), (None, Validity::NotARotation));
        }
        for xyzw in [[0.0; 4], [0.5; 4].map(|e| 1.1 * e), [f32::NAN; 4]] {
            assert_eq!(position(Sent::Full(xyzw)).validity, Validity::NotARotation);
        }
        assert_eq!(position(Sent::Imaginary([1.1, 0.0, 0.0])).validity, Validity::NotARotation);
    }

    #[test]
    fn metadata_says_whether_a_tool_was_seen() {
        let validity = |pairs: &[(&str, &str)]| {
            let message = Message {
                version: Version::V2 { message_id: 0 },
                metadata: pairs.iter().map(|(k, v)| (k.to_string(), v.to_string())).collect(),
                ..Message::new(
                    "Tip",
                    None,
                    Body::Position { position_mm: [1.0; 3], quaternion: Sent::Absent },
                )
            };
            Sample::from_message(&message, AT).expect("carries a position").validity
        };
        assert_eq!(
            validity(&[("TransformStatus", "OK"), ("TransformValid", "True")]),
            Validity::Valid
        );
        assert_eq!(validity(&[("TransformValid", "1")]), Validity::Valid);
        assert_eq!(validity(&[("TransformStatus", "MISSING")]), Validity::Missing);
        assert_eq!(
            validity(&[("TransformValid", "False"), ("TransformStatus", "OUT_OF_VIEW")]),
            Validity::OutOfView
        );
        assert_eq!(
            validity(&[("TransformStatus", "OUT_OF_VOLUME")]),
            Validity::Invalid("OUT_OF_VOLUME".to_owned())
        );
        assert_eq!(
            validity(&[("TransformStatus", "OK"), ("TransformValid", "false")]),
            Validity::Invalid("TransformValid is false".to_owned())
        );
    }

    #[test]
    fn a_status_is_no_sample() {
        let message = Message::new("Tip", None, Body::Other("IMAGE".to_owned()));
        assert_eq!(Sample::from_message(&message, AT), None);
    }
}
