//! What a sample must pass before an observer may see it.

use super::openigtlink::DEVICE_NAME_LEN;
use super::registration::{Registration, RegistrationError};
use super::sample::{Sample, Validity};
use super::timing::StampPolicy;
use nalgebra::{Rotation3, Vector3};
use std::fmt;
use thiserror::Error;

/// What a [`Gate`] asks of a sample.
#[derive(Debug, Clone, PartialEq)]
pub struct GateSettings {
    /// The tool to steer by; every other one is passed over.
    pub tool: String,
    /// The tracker on the bench, and the tip on the sensor.
    pub registration: Registration,
    /// Where the tip can be on the bench at all.
    pub workspace: Option<Workspace>,
    /// With [`StampPolicy::Receive`] the sender's stamps mean nothing, and are not looked at.
    pub stamps: StampPolicy,
}

/// A box in the bench's frame W, its sides along the axes, its faces within it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Workspace {
    /// The corner with the smallest coordinates, mm.
    pub min_mm: Vector3<f64>,
    /// The corner with the largest coordinates, mm.
    pub max_mm: Vector3<f64>,
}

/// Passes samples that are fit to be measured by, in this order of checks: the tool, finite,
/// not the exact zero or identity that stands for "nothing seen", valid by the tracker's own
/// word, newer than the last by its stamp, registered, inside the workspace.
#[derive(Debug, Clone)]
pub struct Gate {
    settings: GateSettings,
    last_stamp_ns: Option<i64>,
    counts: GateCounts,
}

/// Why a sample was refused.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum Refusal {
    /// A sample of another tool.
    #[error("tracker: \"{0}\" is not the tool steered by")]
    OtherTool(String),
    /// A position that is NaN or infinite.
    #[error("tracker: position ({x:.1}, {y:.1}, {z:.1}) mm is not finite", x = .0.x, y = .0.y, z = .0.z)]
    NotFinite(Vector3<f64>),
    /// Position exactly zero, without orientation or with the exact identity: senders put that
    /// where they have no measurement.
    #[error("tracker: the exact zero pose, which stands for a tool that was not seen")]
    ZeroPose,
    /// The tracker says itself that the measurement is none.
    #[error("tracker: invalid sample: {0}")]
    Invalid(Validity),
    /// The last measurement sent again.
    #[error("tracker: sample sent twice (stamp {unix_ns} ns)")]
    Duplicate {
        /// The stamp, ns since 1970.
        unix_ns: i64,
    },
    /// A measurement older than one before.
    #[error("tracker: stamp went back by {by_s:.3} s; was the sender's clock set?")]
    Backwards {
        /// How far back, s.
        by_s: f64,
    },
    /// It cannot be brought into the bench's frame.
    #[error(transparent)]
    Registration(#[from] RegistrationError),
    /// The tip cannot be there.
    #[error(
        "tracker: tip at {axis} = {value_mm:.1} mm, outside the workspace ({min_mm:.1} to \
         {max_mm:.1} mm); check the registration"
    )]
    OutsideWorkspace {
        /// x, y or z of the bench.
        axis: char,
        /// The tip's coordinate, mm.
        value_mm: f64,
        /// The workspace's lower limit, mm.
        min_mm: f64,
        /// The workspace's upper limit, mm.
        max_mm: f64,
    },
}

/// What a [`Gate`] did with the samples so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct GateCounts {
    /// Passed.
    pub accepted: u64,
    /// Of other tools.
    pub other_tool: u64,
    /// NaN or infinite.
    pub not_finite: u64,
    /// Exact zero or identity.
    pub zero_pose: u64,
    /// Invalid by the tracker's own word.
    pub invalid: u64,
    /// Equal stamps.
    pub duplicate: u64,
    /// Stamps that went back.
    pub backwards: u64,
    /// Without the orientation that the tip's offset needs.
    pub unregistered: u64,
    /// Outside the workspace.
    pub outside_workspace: u64,
}

impl Gate {
    /// A gate that has seen nothing yet.
    pub fn new(settings: GateSettings) -> Self {
        Gate { settings, last_stamp_ns: None, counts: GateCounts::default() }
    }

    /// The tip's position on the bench, `p_WB` in mm, finite; counted.
    ///
    /// # Errors
    /// [`Refusal`]; counted by kind.
    pub fn admit(&mut self, sample: &Sample) -> Result<Vector3<f64>, Refusal> {
        let result = self.check(sample);
        self.counts.count(&result);
        result
    }

    /// Forgets the last stamp: a new connection may be another sender, with another clock.
    pub fn reconnected(&mut self) {
        self.last_stamp_ns = None;
    }

    /// What it did so far.
    pub fn counts(&self) -> GateCounts {
        self.counts
    }

    fn check(&mut self, sample: &Sample) -> Result<Vector3<f64>, Refusal> {
        if !is_tool(&sample.tool, &self.settings.tool) {
            return Err(Refusal::OtherTool(sample.tool.clone()));
        }
        if !is_finite(&sample.position_mm) {
            return Err(Refusal::NotFinite(sample.position_mm));
        }
        if sample.position_mm == Vector3::zeros()
            && sample.orientation.is_none_or(|r| r == Rotation3::identity())
        {
            return Err(Refusal::ZeroPose);
        }
        if sample.validity != Validity::Valid {
            return Err(Refusal::Invalid(sample.validity.clone()));
        }
        self.check_stamp(sample)?;
        let p_wb_mm = self.settings.registration.tip_mm(sample)?;
        // The registration can overflow what was finite.
        if !is_finite(&p_wb_mm) {
            return Err(Refusal::NotFinite(p_wb_mm));
        }
        if let Some(workspace) = &self.settings.workspace {
            workspace.check(&p_wb_mm)?;
        }
        Ok(p_wb_mm)
    }

    fn check_stamp(&mut self, sample: &Sample) -> Result<(), Refusal> {
        let Some(unix_ns) = sample.source_unix_ns else { return Ok(()) };
        if self.settings.stamps == StampPolicy::Receive {
            return Ok(());
        }
        match self.last_stamp_ns {
            Some(last) if unix_ns == last => return Err(Refusal::Duplicate { unix_ns }),
            Some(last) if unix_ns < last => {
                return Err(Refusal::Backwards {
                    by_s: last.saturating_sub(unix_ns) as f64 * 1e-9,
                });
            }
            _ => self.last_stamp_ns = Some(unix_ns),
        }
        Ok(())
    }
}

impl Workspace {
    fn check(&self, p_wb_mm: &Vector3<f64>) -> Result<(), Refusal> {
        let limits = self.min_mm.iter().zip(&self.max_mm);
        for ((axis, &value_mm), (&min_mm, &max_mm)) in
            ['x', 'y', 'z'].iter().zip(p_wb_mm).zip(limits)
        {
            if !(min_mm..=max_mm).contains(&value_mm) {
                return Err(Refusal::OutsideWorkspace { axis: *axis, value_mm, min_mm, max_mm });
            }
        }
        Ok(())
    }
}

fn is_finite(p_mm: &Vector3<f64>) -> bool {
    p_mm.iter().all(|coordinate| coordinate.is_finite())
}

/// True if `sent` names the tool `wanted`. A name that fills the header's field may be the start
/// of a longer one: version 1 has no room for the rest.
pub fn is_tool(sent: &str, wanted: &str) -> bool {
    sent == wanted || (sent.len() == DEVICE_NAME_LEN && wanted.starts_with(sent))
}

impl GateCounts {
    /// Samples of the tool that were refused.
    pub fn refused(&self) -> u64 {
        self.kinds().iter().map(|(_, count)| count).sum()
    }

    fn count(&mut self, result: &Result<Vector3<f64>, Refusal>) {
        *match result {
            Ok(_) => &mut self.accepted,
            Err(Refusal::OtherTool(_)) => &mut self.other_tool,
            Err(Refusal::NotFinite(_)) => &mut self.not_finite,
            Err(Refusal::ZeroPose) => &mut self.zero_pose,
            Err(Refusal::Invalid(_)) => &mut self.invalid,
            Err(Refusal::Duplicate { .. }) => &mut self.duplicate,
            Err(Refusal::Backwards { .. }) => &mut self.backwards,
            Err(Refusal::Registration(_)) => &mut self.unregistered,
            Err(Refusal::OutsideWorkspace { .. }) => &mut self.outside_workspace,
        } += 1;
    }

    /// The kinds of refusal of the tool's own samples, with their counts.
    fn kinds(&self) -> [(&'static str, u64); 7] {
        [
            ("not finite", self.not_finite),
            ("zero", self.zero_pose),
            ("invalid", self.invalid),
            ("sent twice", self.duplicate),
            ("stamped backwards", self.backwards),
            ("without orientation", self.unregistered),
            ("outside the workspace", self.outside_workspace),
        ]
    }
}

impl fmt::Display for GateCounts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} accepted, {} refused", self.accepted, self.refused())?;
        let mut separator = ": ";
        for (kind, count) in self.kinds().into_iter().filter(|(_, count)| *count > 0) {
            write!(f, "{separator}{count} {kind}")?;
            separator = ", ";
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
    use crate::units::Time;
    use proptest::prelude::*;

    fn gate() -> Gate {
        Gate::new(GateSettings {
            tool: "NeedleToTracker".to_owned(),
            registration: Registration::new(Pose::identity()),
            workspace: Some(Workspace {
                min_mm: Vector3::new(-50.0, -50.0, -1.0),
                max_mm: Vector3::new(50.0, 50.0, 200.0),
            }),
            stamps: StampPolicy::Auto,
        })
    }

    fn sample(x: f64, y: f64, z: f64) -> Sample {
        Sample {
            tool: "NeedleToTracker".to_owned(),
            receive_time: Time::ZERO,
            source_unix_ns: None,
            position_mm: Vector3::new(x, y, z),
            orientation: None,
            validity: Validity::Valid,
        }
    }

    fn stamped(unix_ns: i64) -> Sample {
        Sample { source_unix_ns: Some(unix_ns), ..sample(1.0, 2.0, 3.0) }
    }

    proptest! {
        #[test]
        fn nothing_but_finite_positions_in_the_workspace_come_through(x: f64, y: f64, z in -300.0..300.0f64) {
            let mut gate = gate();
            let result = gate.admit(&sample(x, y, z));
            let inside = x.abs() <= 50.0 && y.abs() <= 50.0 && (-1.0..=200.0).contains(&z);
            prop_assert_eq!(result.is_ok(), inside);
            prop_assert_eq!(gate.counts().accepted + gate.counts().refused(), 1);
        }
    }

    #[test]
    fn each_refusal_is_named_and_counted() {
        let mut gate = gate();
        assert_eq!(gate.admit(&stamped(1_000)), Ok(Vector3::new(1.0, 2.0, 3.0)));
        let refused = [
            Sample { tool: "StylusToTracker".to_owned(), ..sample(f64::NAN, 0.0, 0.0) },
            sample(f64::NAN, 0.0, 0.0),
            sample(0.0, f64::NEG_INFINITY, 0.0),
            Sample { validity: Validity::OutOfView, ..sample(0.0, 0.0, 0.0) },
            Sample { orientation: Some(Rotation3::identity()), ..sample(0.0, -0.0, 0.0) },
            Sample { validity: Validity::Missing, ..sample(1.0, 2.0, 3.0) },
            stamped(1_000),
            stamped(999),
            sample(1.0, 2.0, 200.5),
        ];
        let texts: Vec<String> = refused
            .iter()
            .map(|sample| gate.admit(sample).expect_err("is refused").to_string())
            .collect();
        assert_eq!(
            texts,
            [
                "tracker: \"StylusToTracker\" is not the tool steered by",
                "tracker: position (NaN, 0.0, 0.0) mm is not finite",
                "tracker: position (0.0, -inf, 0.0) mm is not finite",
                "tracker: the exact zero pose, which stands for a tool that was not seen",
                "tracker: the exact zero pose, which stands for a tool that was not seen",
                "tracker: invalid sample: tool missing",
                "tracker: sample sent twice (stamp 1000 ns)",
                "tracker: stamp went back by 0.000 s; was the sender's clock set?",
                "tracker: tip at z = 200.5 mm, outside the workspace (-1.0 to 200.0 mm); check \
                 the registration",
            ]
        );
        let counts = gate.counts();
        assert_eq!((counts.accepted, counts.other_tool, counts.refused()), (1, 1, 8));
        assert_eq!(
            counts.to_string(),
            "1 accepted, 8 refused: 2 not finite, 2 zero, 1 invalid, 1 sent twice, 1 \
             stamped backwards, 1 outside the workspace"
        );
    }

    #[test]
    fn a_tip_off_the_sensor_needs_an_orientation() {
        let mut gate = gate();
        gate.settings.registration =
            gate.settings.registration.with_tip_offset(Vector3::new(0.0, 0.0, 8.0));
        let error = gate.admit(&sample(1.0, 2.0, 3.0)).expect_err("no orientation");
        assert_eq!(
            error.to_string(),
            "registration: the tip is 8.00 mm off the sensor, and the tracker sends no \
             orientation to turn that by; send TRANSFORM or a quaternion, or set the offset to \
             zero"
        );
        assert_eq!(gate.counts().unregistered, 1);
    }

    #[test]
    fn stamps_matter_only_where_they_are_used_and_within_a_connection() {
        let mut gate = gate();
        assert!(gate.admit(&stamped(2_000)).is_ok());
        assert!(gate.admit(&sample(1.0, 1.0, 1.0)).is_ok(), "no stamp, nothing to compare");
        gate.reconnected();
        assert!(gate.admit(&stamped(1_000)).is_ok());
        gate.settings.stamps = StampPolicy::Receive;
        assert!(gate.admit(&stamped(1_000)).is_ok());
    }

    #[test]
    fn an_origin_with_a_real_orientation_is_a_measurement() {
        let turned = Rotation3::from_axis_angle(&Vector3::x_axis(), 0.1);
        let at_origin = Sample { orientation: Some(turned), ..sample(0.0, 0.0, 0.0) };
        assert_eq!(gate().admit(&at_origin), Ok(Vector3::zeros()));
    }

    #[test]
    fn a_name_cut_by_the_protocol_is_still_the_tool() {
        assert!(is_tool("NeedleTipToTrackerBa", "NeedleTipToTrackerBase"));
        assert!(!is_tool("NeedleTipToTracker", "NeedleTipToTrackerBase"));
        assert!(!is_tool("NeedleTipToTrackerBase", "NeedleTipToTrackerBa"));
    }
}
