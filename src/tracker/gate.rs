//! The checks of a single sample, before it is dated and compared with others.

use super::openigtlink::DEVICE_NAME_LEN;
use super::refusal::{GateName, Refusal, short};
use super::registration::Registration;
use super::sample::{Sample, Validity};
use crate::geometry::POSITION;
use crate::keys::section;
use crate::text::clipped;
use crate::units::IN_METRES;
use nalgebra::{Rotation3, UnitQuaternion, Vector3};

/// How far the squared length of a quaternion may be from 1: enough for rounding.
const ROTATION_TOLERANCE: f64 = 1e-6;
/// A message shows at most this many characters of a peer's text.
const SHOWN_MAX: usize = 40;
/// Senders send this when they have no measurement.
const ZERO_POSE: &str = "the exact zero pose, which stands for a tool that was not seen";

/// Accepts a sample only if it can be a measurement. It checks in this order: the tool, finite numbers, a rotation,
/// not the exact zero or identity that stands for "not seen", valid by the tracker's own status, registered, inside
/// the workspace.
#[derive(Debug, Clone, PartialEq)]
pub struct Gate {
    /// The tool to steer by; samples of other tools are refused.
    pub tool: String,
    /// Where the tracker is on the bench, and the tip on the sensor.
    pub registration: Registration,
    /// The box on the bench that the tip can be in.
    pub workspace: Option<Workspace>,
    /// The checks that the configuration asks for.
    pub checks: ContentChecks,
}

section! {
    /// Checks of a sample's content that can be switched off.
    #[derive(Copy, Eq)]
    pub struct ContentChecks {
        /// Refuse an orientation that is not a rotation; false uses the position alone.
        rotation: bool = true;
        /// Refuse the exact zero or identity, which stands for "not seen".
        zero: bool = true;
        /// Refuse what the tracker itself calls invalid.
        status: bool = true;
    }
}

section! {
    /// A box in the bench's frame W, its sides along the axes, its faces within it.
    #[derive(Copy)]
    pub struct Workspace {
        /// The corner with the smallest coordinates, mm.
        min_mm: Vector3<f64> [POSITION];
        /// The corner with the largest coordinates, mm.
        max_mm: Vector3<f64> [POSITION];
    }
}

impl Gate {
    /// Checks the content of a sample, whatever its tool and the registration are: its position is finite, and it
    /// passes the [checks](Self::checks).
    ///
    /// # Errors
    /// [`Refusal`], by the first check that fails.
    pub fn check_content(&self, sample: &Sample) -> Result<(), Refusal> {
        if !is_finite(&sample.position_mm) {
            return Err(Refusal::not_finite(&sample.position_mm));
        }
        self.checks.check(sample)
    }

    /// The tip's position on the bench, `p_WB` in mm, finite.
    ///
    /// # Errors
    /// [`Refusal`], by the first check that fails.
    pub fn admit(&self, sample: &Sample) -> Result<Vector3<f64>, Refusal> {
        self.admit_as("tip", sample)
    }

    /// As [`Gate::admit`]; a refusal calls the point that the tool marks `what`.
    ///
    /// # Errors
    /// [`Refusal`], by the first check that fails.
    pub fn admit_as(&self, what: &str, sample: &Sample) -> Result<Vector3<f64>, Refusal> {
        if !is_same_tool(&sample.tool, &self.tool) {
            let sent = clipped(&sample.tool, SHOWN_MAX);
            let why = format!("\"{sent}\" is not the tracked tool");
            return Err(Refusal::new(GateName::Tool, why));
        }
        self.check_content(sample)?;
        let p_wb_mm = self.registration.tip_mm(sample)?;
        // The registration can overflow what was finite.
        if !is_finite(&p_wb_mm) {
            return Err(Refusal::not_finite(&p_wb_mm));
        }
        let Some(workspace) = &self.workspace else { return Ok(p_wb_mm) };
        let Some(outside) = workspace.outside(&p_wb_mm) else { return Ok(p_wb_mm) };
        let hint = match workspace.fits_in_metres(&self.registration, sample) {
            true => IN_METRES,
            false => "check the registration",
        };
        Err(Refusal::new(GateName::Workspace, format!("{what} at {outside}; {hint}")))
    }
}

impl Workspace {
    /// Whether the tip would be in the box if the position of the `sample` were in metres.
    pub fn fits_in_metres(&self, registration: &Registration, sample: &Sample) -> bool {
        let in_mm = Sample { position_mm: 1e3 * sample.position_mm, ..sample.clone() };
        registration.tip_mm(&in_mm).is_ok_and(|tip_mm| self.outside(&tip_mm).is_none())
    }

    /// The first coordinate of `p_wb_mm` that is outside the box, in words; `None` if the point is inside.
    pub fn outside(&self, p_wb_mm: &Vector3<f64>) -> Option<String> {
        let axes = ['x', 'y', 'z'].into_iter().enumerate();
        let limits = axes.map(|(k, axis)| (axis, p_wb_mm[k], self.min_mm[k], self.max_mm[k]));
        let is_outside = |&(_, mm, min_mm, max_mm): &_| !(min_mm..=max_mm).contains(&mm);
        let (axis, mm, min_mm, max_mm) = limits.into_iter().find(is_outside)?;
        let mm = short(mm);
        Some(format!("{axis} = {mm} mm, outside {min_mm:.1} to {max_mm:.1} mm"))
    }
}

impl ContentChecks {
    fn check(self, sample: &Sample) -> Result<(), Refusal> {
        let is_bad_rotation = sample.validity == Validity::NotARotation
            || sample.orientation.is_some_and(|orientation| !is_rotation(&orientation));
        if self.rotation && is_bad_rotation {
            return Err(Refusal::new(GateName::Rotation, "the orientation sent is not a rotation"));
        }
        let is_zero = sample.position_mm == Vector3::zeros()
            && sample.orientation.is_none_or(|q| q.to_rotation_matrix() == Rotation3::identity());
        if self.zero && is_zero {
            return Err(Refusal::new(GateName::Zero, ZERO_POSE));
        }
        let is_valid = matches!(sample.validity, Validity::Valid | Validity::NotARotation);
        if self.status && !is_valid {
            let why = clipped(&sample.validity.to_string(), SHOWN_MAX).into_owned();
            return Err(Refusal::new(GateName::Status, why));
        }
        Ok(())
    }
}

/// True for a unit quaternion: a `UnitQuaternion` can be built without a check.
fn is_rotation(quaternion: &UnitQuaternion<f64>) -> bool {
    // Written so that NaN is refused.
    (quaternion.norm_squared() - 1.0).abs() <= ROTATION_TOLERANCE
}

fn is_finite(p_mm: &Vector3<f64>) -> bool {
    p_mm.iter().all(|coordinate| coordinate.is_finite())
}

/// True if `sent` names the tool `wanted`. A name that fills the header's field may be the start
/// of a longer one: version 1 has no room for the rest. If the field ends within a character, the decoder has
/// replaced that character.
pub fn is_same_tool(sent: &str, wanted: &str) -> bool {
    let whole = wanted.floor_char_boundary(DEVICE_NAME_LEN);
    let is_cut = wanted.len() > DEVICE_NAME_LEN && sent.starts_with(&wanted[..whole]);
    sent == wanted
        || is_cut
            && matches!(
                (&sent[whole..], whole == DEVICE_NAME_LEN),
                ("", true) | ("\u{fffd}", false)
            )
}

/// True if version 1, which cuts a name to the length of the header's field, sends both names as the same.
pub fn are_cut_alike(one: &str, other: &str) -> bool {
    let sent = |name: &str| {
        let bytes = name.as_bytes();
        String::from_utf8_lossy(&bytes[..bytes.len().min(DEVICE_NAME_LEN)]).into_owned()
    };
    sent(one) == sent(other)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
    use nalgebra::Quaternion;
    use proptest::prelude::*;

    fn gate() -> Gate {
        Gate {
            tool: "NeedleToTracker".to_owned(),
            registration: Registration::new(Pose::identity()),
            workspace: Some(Workspace {
                min_mm: Vector3::new(-50.0, -50.0, -1.0),
                max_mm: Vector3::new(50.0, 50.0, 200.0),
            }),
            checks: ContentChecks { rotation: true, zero: true, status: true },
        }
    }

    fn sample(x: f64, y: f64, z: f64) -> Sample {
        Sample::valid("NeedleToTracker", Vector3::new(x, y, z))
    }

    proptest! {
        #[test]
        fn only_finite_positions_in_the_workspace_are_admitted(x: f64, y: f64, z in -300.0..300.0f64) {
            let result = gate().admit(&sample(x, y, z));
            let inside = x.abs() <= 50.0 && y.abs() <= 50.0 && (-1.0..=200.0).contains(&z);
            prop_assert_eq!(result.is_ok(), inside);
        }
    }

    #[test]
    fn each_refusal_names_its_gate_and_the_value() {
        let gate = gate();
        let [long, unknown] = [1.1, f64::NAN]
            .map(|w| UnitQuaternion::new_unchecked(Quaternion::new(w, 0.0, 0.0, 0.0)));
        assert_eq!(gate.admit(&sample(1.0, 2.0, 3.0)), Ok(Vector3::new(1.0, 2.0, 3.0)));
        let refused = [
            Sample { tool: "StylusToTracker".to_owned(), ..sample(f64::NAN, 0.0, 0.0) },
            sample(f64::NAN, 0.0, 0.0),
            sample(0.0, f64::NEG_INFINITY, 0.0),
            Sample { orientation: Some(long), ..sample(1.0, 2.0, 3.0) },
            Sample { orientation: Some(unknown), ..sample(1.0, 2.0, 3.0) },
            Sample { validity: Validity::NotARotation, ..sample(0.0, 0.0, 0.0) },
            Sample { validity: Validity::OutOfView, ..sample(0.0, 0.0, 0.0) },
            Sample { orientation: Some(UnitQuaternion::identity()), ..sample(0.0, -0.0, 0.0) },
            Sample { validity: Validity::Missing, ..sample(1.0, 2.0, 3.0) },
            sample(1.0, 2.0, 200.5),
        ];
        let texts: Vec<String> = refused
            .iter()
            .map(|sample| gate.admit(sample).expect_err("is refused").to_string())
            .collect();
        assert_eq!(
            texts,
            [
                "tool: \"StylusToTracker\" is not the tracked tool",
                "finite: position (NaN, 0.0, 0.0) mm",
                "finite: position (0.0, -inf, 0.0) mm",
                "rotation: the orientation sent is not a rotation",
                "rotation: the orientation sent is not a rotation",
                "rotation: the orientation sent is not a rotation",
                "zero: the exact zero pose, which stands for a tool that was not seen",
                "zero: the exact zero pose, which stands for a tool that was not seen",
                "status: tool missing",
                "workspace: tip at z = 200.5 mm, outside -1.0 to 200.0 mm; check the registration",
            ]
        );
    }

    /// A tracker far from the bench sends its positions in metres.
    #[test]
    fn a_tip_outside_that_would_be_inside_in_metres_is_named() {
        let mut gate = gate();
        let translation = Vector3::new(-200.0, 0.0, -300.0);
        gate.registration = Registration::new(Pose { translation, ..Pose::identity() });
        assert!(gate.admit(&sample(210.0, 5.0, 340.0)).is_ok());
        assert_eq!(
            gate.admit(&sample(0.21, 0.005, 0.34)).expect_err("outside").to_string(),
            "workspace: tip at x = -199.8 mm, outside -50.0 to 50.0 mm; the positions look like metres; \
             OpenIGTLink is in mm"
        );
    }

    /// A part of a character arrives as a replacement, whichever it was.
    #[test]
    fn names_that_differ_within_a_cut_character_are_cut_alike() {
        let stem = "x".repeat(DEVICE_NAME_LEN - 1);
        let [first, second] = ["ä", "ж"].map(|end| format!("{stem}{end}"));
        assert!(are_cut_alike(&first, &second) && !are_cut_alike(&first, &stem));
        assert!(!are_cut_alike("NeedleToTracker", "TargetToTracker"));
    }

    #[test]
    fn a_check_that_is_off_refuses_nothing() {
        let mut gate = gate();
        let zero = sample(0.0, 0.0, 0.0);
        let missing = Sample { validity: Validity::Missing, ..sample(1.0, 2.0, 3.0) };
        let skewed = Sample { validity: Validity::NotARotation, ..sample(1.0, 2.0, 3.0) };
        assert!([&zero, &missing, &skewed].iter().all(|sample| gate.admit(sample).is_err()));
        gate.checks.zero = false;
        assert_eq!(gate.admit(&zero), Ok(Vector3::zeros()));
        gate.checks.status = false;
        assert!(gate.admit(&missing).is_ok() && gate.admit(&skewed).is_err());
        gate.checks.rotation = false;
        assert!(gate.admit(&skewed).is_ok());
        gate.workspace = None;
        assert!(gate.admit(&sample(1.0, 2.0, 200.5)).is_ok());
        assert!(gate.admit(&sample(1.0, 2.0, f64::NAN)).is_err(), "always refused");
    }

    #[test]
    fn a_tip_off_the_sensor_needs_an_orientation() {
        let mut gate = gate();
        gate.registration = gate
            .registration
            .with_tip(Pose { translation: Vector3::new(0.0, 0.0, 8.0), ..Pose::identity() });
        let error = gate.admit(&sample(1.0, 2.0, 3.0)).expect_err("no orientation");
        assert_eq!(
            error.to_string(),
            "registration: a tip offset of 8.00 mm needs the sensor's orientation, which the tracker did not \
             send (OpenIGTLink has it in TRANSFORM)"
        );
        assert_eq!(error.gate, GateName::Registration);
    }

    #[test]
    fn an_origin_with_a_real_orientation_is_a_measurement() {
        let turned = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), 0.1);
        let at_origin = Sample { orientation: Some(turned), ..sample(0.0, 0.0, 0.0) };
        assert_eq!(gate().admit(&at_origin), Ok(Vector3::zeros()));
    }

    #[test]
    fn a_tool_name_truncated_by_the_protocol_still_matches() {
        assert!(is_same_tool("NeedleTipToTrackerBa", "NeedleTipToTrackerBase"));
        assert!(!is_same_tool("NeedleTipToTracker", "NeedleTipToTrackerBase"));
        assert!(!is_same_tool("NeedleTipToTrackerBase", "NeedleTipToTrackerBa"));
        assert!(!is_same_tool("NeedleTipToTrackerBa\u{fffd}", "NeedleTipToTrackerBase"));
        let wanted = "AiguilleVersTraceurééé";
        let sent = |bytes: usize| String::from_utf8_lossy(&wanted.as_bytes()[..bytes]).into_owned();
        assert!(is_same_tool(&sent(20), wanted), "{}", sent(20));
        assert!(!is_same_tool(&sent(19), wanted) && !is_same_tool(&sent(22), wanted));
    }
}
