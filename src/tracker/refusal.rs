//! Why a gate refused a sample, and how often.

use super::pairing::PairingError;
use super::sample::Validity;
use super::timing::TimingError;
use crate::text::clipped;
use nalgebra::Vector3;
use std::fmt;
use thiserror::Error;

/// The gates, in the order in which a sample passes them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GateName {
    /// The sample is of the tool that the bench steers by.
    Tool,
    /// Its position is finite.
    Finite,
    /// Its orientation, if any, is a rotation.
    Rotation,
    /// It is not the exact zero or identity.
    Zero,
    /// The tracker itself does not call it invalid.
    Status,
    /// It can be transformed into the bench's frame.
    Registration,
    /// The tip can be there.
    Workspace,
    /// It was not sent before.
    Duplicate,
    /// Its stamp is plausible.
    Stamp,
    /// The stage's position at its acquisition is known.
    Pairing,
    /// It does not repeat the last value.
    Repeat,
    /// The tip can have moved that far since the last position.
    Step,
    /// It agrees with the model.
    Innovation,
    /// The track is not lost.
    Lost,
}

/// Every gate with its name, in order.
const GATES: [(GateName, &str); 14] = [
    (GateName::Tool, "tool"),
    (GateName::Finite, "finite"),
    (GateName::Rotation, "rotation"),
    (GateName::Zero, "zero"),
    (GateName::Status, "status"),
    (GateName::Registration, "registration"),
    (GateName::Workspace, "workspace"),
    (GateName::Duplicate, "duplicate"),
    (GateName::Stamp, "stamp"),
    (GateName::Pairing, "pairing"),
    (GateName::Repeat, "repeat"),
    (GateName::Step, "step"),
    (GateName::Innovation, "innovation"),
    (GateName::Lost, "lost"),
];

impl GateName {
    /// The name in records, counts and messages.
    pub fn name(self) -> &'static str {
        GATES[self as usize].1
    }
}

impl fmt::Display for GateName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

/// A message shows this many characters of what a peer chose.
const SHOWN_MAX: usize = 40;

/// `value` with one decimal, a very large one by its power of ten.
fn short(value: f64) -> String {
    match value.abs() < 1e6 {
        true => format!("{value:.1}"),
        false => format!("{value:.1e}"),
    }
}

/// Why a sample was refused. Its text begins with the gate's name.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum Refusal {
    /// The sample is of another tool.
    #[error("tool: \"{}\" is not the tool steered by", clipped(.0, SHOWN_MAX))]
    OtherTool(String),
    /// The position is NaN or infinite.
    #[error("finite: position ({}, {}, {}) mm", short(.0.x), short(.0.y), short(.0.z))]
    NotFinite(Vector3<f64>),
    /// The orientation is not a rotation: skewed, mirrored, scaled or not finite.
    #[error("rotation: the orientation sent is not a rotation")]
    NotARotation,
    /// The position is exactly zero, without orientation or with the exact identity. Senders send
    /// this when they have no measurement.
    #[error("zero: the exact zero pose, which stands for a tool that was not seen")]
    ZeroPose,
    /// The tracker itself calls the measurement invalid.
    #[error("status: {}", clipped(&.0.to_string(), SHOWN_MAX))]
    Invalid(Validity),
    /// The tip is off the sensor, and nothing says to which side.
    #[error("registration: a tip offset of {offset_mm:.2} mm needs an orientation; send TRANSFORM")]
    NoOrientation {
        /// Distance from sensor to tip, mm.
        offset_mm: f64,
    },
    /// The tip cannot be there.
    #[error(
        "workspace: tip at {axis} = {} mm, outside {min_mm:.1} to {max_mm:.1} mm; check the \
         registration",
        short(*.value_mm)
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
    /// The target is not where it is expected.
    #[error(
        "workspace: the target is {} mm from goal.position_mm (limit {limit_mm:.1}); another frame, or tool?",
        short(*.off_mm)
    )]
    TargetElsewhere {
        /// Distance from where it is expected, mm.
        off_mm: f64,
        /// The limit, mm.
        limit_mm: f64,
    },
    /// Its time of acquisition is not known.
    #[error(transparent)]
    Timing(#[from] TimingError),
    /// The stage's position at its acquisition is not known.
    #[error("pairing: {0}")]
    Unpaired(#[from] PairingError),
    /// It was acquired no later than the last measurement that the observer took.
    #[error("pairing: acquired {by_s:.3} s before the measurement taken last, it came too late")]
    Late {
        /// How much earlier, s.
        by_s: f64,
    },
    /// The stage gave no position for its acquisition before the run ended.
    #[error("pairing: the stage gave no position at its acquisition before the run ended")]
    NeverPaired,
    /// The position is the same as the last one, to the bit.
    #[error("repeat: the same position to the bit, {times} in a row; is the tool still in view?")]
    Repeat {
        /// How often in a row it has been repeated.
        times: u32,
    },
    /// The tip cannot have moved that far since the last position.
    #[error(
        "step: {} mm in {after_s:.3} s since the last tip (limit {limit_mm:.1}); is it another tool?",
        short(*.step_mm)
    )]
    Step {
        /// Distance from the last position believed, mm.
        step_mm: f64,
        /// Time since that one, s.
        after_s: f64,
        /// The limit, mm.
        limit_mm: f64,
    },
    /// The position is further from the model than noise and the model's uncertainty explain.
    #[error(
        "innovation: {} mm off the model, chi2 {} (limit {limit:.1}); a jump, or needle.radius_mm?",
        short(*.distance_mm),
        short(*.chi2)
    )]
    Innovation {
        /// Distance from the predicted position, mm.
        distance_mm: f64,
        /// Squared Mahalanobis distance, 3 degrees of freedom.
        chi2: f64,
        /// The limit.
        limit: f64,
    },
    /// The mean of the last positions is further from the model than noise and the model's
    /// uncertainty explain.
    #[error(
        "innovation: the mean of {positions} is {} mm off the model, chi2 {} (limit {limit:.1}): frozen or jumped",
        short(*.distance_mm),
        short(*.chi2)
    )]
    Jump {
        /// Distance of the mean from the predicted position, or of its lag along the heading, mm.
        distance_mm: f64,
        /// How many positions.
        positions: usize,
        /// Squared Mahalanobis distance.
        chi2: f64,
        /// The limit.
        limit: f64,
    },
    /// It agrees with the model, but a lost track needs several such positions in a row.
    #[error("lost: agrees with the model, {agreeing} of {needed} needed in a row")]
    NotFoundYet {
        /// Samples in a row that agreed, this one among them.
        agreeing: u32,
        /// How many are needed.
        needed: u32,
    },
    /// The track is lost, and no observer has an estimate to find it again.
    #[error("lost: no observer has an estimate yet to find the tip again")]
    NoModel,
}

impl Refusal {
    /// The gate that refused.
    pub fn gate(&self) -> GateName {
        match self {
            Refusal::OtherTool(_) => GateName::Tool,
            Refusal::NotFinite(_) => GateName::Finite,
            Refusal::NotARotation => GateName::Rotation,
            Refusal::ZeroPose => GateName::Zero,
            Refusal::Invalid(_) => GateName::Status,
            Refusal::NoOrientation { .. } => GateName::Registration,
            Refusal::OutsideWorkspace { .. } | Refusal::TargetElsewhere { .. } => {
                GateName::Workspace
            }
            Refusal::Timing(TimingError::Duplicate { .. }) => GateName::Duplicate,
            Refusal::Timing(_) => GateName::Stamp,
            Refusal::Unpaired(_) | Refusal::Late { .. } | Refusal::NeverPaired => GateName::Pairing,
            Refusal::Repeat { .. } => GateName::Repeat,
            Refusal::Step { .. } => GateName::Step,
            Refusal::Innovation { .. } | Refusal::Jump { .. } => GateName::Innovation,
            Refusal::NotFoundYet { .. } | Refusal::NoModel => GateName::Lost,
        }
    }

    /// True if it counts against the track: enough of these in a row, and the track is lost. The
    /// others bring nothing new: samples of another tool, samples sent twice, and samples that come
    /// too late or while the bench learns the sender's clock.
    pub fn is_against_the_track(&self) -> bool {
        match self {
            Refusal::Timing(TimingError::Unsettled { .. }) => false,
            _ => !matches!(
                self.gate(),
                GateName::Tool | GateName::Duplicate | GateName::Pairing | GateName::Lost
            ),
        }
    }
}

/// What the gates did with the samples so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct GateCounts {
    /// Passed.
    pub accepted: u64,
    refused: [u64; GATES.len()],
}

impl GateCounts {
    /// Counts a sample that was accepted or refused.
    pub fn count(&mut self, refusal: Option<&Refusal>) {
        match refusal {
            None => self.accepted += 1,
            Some(refusal) => self.refused[refusal.gate() as usize] += 1,
        }
    }

    /// Samples that `gate` refused.
    pub fn of(&self, gate: GateName) -> u64 {
        self.refused[gate as usize]
    }

    /// Samples of the tool that were refused.
    pub fn refused(&self) -> u64 {
        self.by_gate().map(|(_, count)| count).sum()
    }

    /// The gates of the tool's own samples that refused any, with how many.
    pub fn by_gate(&self) -> impl Iterator<Item = (GateName, u64)> + '_ {
        let counts = GATES.into_iter().map(|(gate, _)| (gate, self.of(gate)));
        counts.filter(|(gate, count)| *gate != GateName::Tool && *count > 0)
    }
}

impl fmt::Display for GateCounts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} accepted, {} refused", self.accepted, self.refused())?;
        let mut separator = ": ";
        for (gate, count) in self.by_gate() {
            write!(f, "{separator}{count} {gate}")?;
            separator = ", ";
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::Time;

    #[test]
    fn a_refusal_begins_with_the_name_of_its_gate() {
        let refusals = [
            Refusal::OtherTool("Stylus".to_owned()),
            Refusal::NotFinite(Vector3::new(f64::NAN, 0.0, 0.0)),
            Refusal::NotARotation,
            Refusal::ZeroPose,
            Refusal::Invalid(Validity::Missing),
            Refusal::NoOrientation { offset_mm: 1.0 },
            Refusal::OutsideWorkspace { axis: 'x', value_mm: 9.0, min_mm: 0.0, max_mm: 1.0 },
            Refusal::Timing(TimingError::Duplicate { unix_ns: 1 }),
            Refusal::Timing(TimingError::Backwards { by_s: 1.0 }),
            Refusal::Timing(TimingError::Ahead { by_s: 1.0 }),
            Refusal::Timing(TimingError::Unsettled { samples: 1 }),
            Refusal::Timing(TimingError::NoStamp),
            Refusal::Unpaired(PairingError::TooOld { time: Time::ZERO, by_s: 1.0 }),
            Refusal::Late { by_s: 0.1 },
            Refusal::NeverPaired,
            Refusal::Repeat { times: 3 },
            Refusal::Step { step_mm: 12.0, after_s: 0.025, limit_mm: 3.9 },
            Refusal::Innovation { distance_mm: 9.0, chi2: 60.0, limit: 16.3 },
            Refusal::Jump { distance_mm: 3.0, positions: 8, chi2: 56.0, limit: 40.0 },
            Refusal::NotFoundYet { agreeing: 1, needed: 3 },
            Refusal::NoModel,
        ];
        let mut counts = GateCounts::default();
        for refusal in &refusals {
            let (text, gate) = (refusal.to_string(), refusal.gate());
            assert!(text.starts_with(&format!("{gate}: ")), "{text}");
            // A hold has as much room for why the tip was not seen.
            assert!(
                matches!(refusal, Refusal::Unpaired(_)) || text.chars().count() <= 92,
                "{text}"
            );
            counts.count(Some(refusal));
        }
        assert!(GATES.iter().all(|(gate, _)| counts.of(*gate) > 0), "each gate refuses");
        assert_eq!(counts.refused(), refusals.len() as u64 - 1, "of the tool");
    }

    #[test]
    fn a_refusal_is_short_whatever_was_sent() {
        let long = || "x".repeat(500);
        for refusal in [
            Refusal::OtherTool(long()),
            Refusal::NotFinite(Vector3::new(f64::NAN, f64::MIN, f64::MAX)),
            Refusal::Invalid(Validity::Invalid(long())),
            Refusal::OutsideWorkspace { axis: 'x', value_mm: 1e300, min_mm: 0.0, max_mm: 1.0 },
            Refusal::Step { step_mm: 1e300, after_s: 0.025, limit_mm: 3.9 },
            Refusal::Innovation { distance_mm: 1e300, chi2: f64::INFINITY, limit: 16.3 },
            Refusal::Jump { distance_mm: 1e300, positions: 8, chi2: 1e300, limit: 40.0 },
        ] {
            let text = refusal.to_string();
            assert!(text.chars().count() <= 100, "{text}");
        }
    }

    #[test]
    fn counts_are_told_by_gate() {
        let mut counts = GateCounts::default();
        counts.count(None);
        assert_eq!(counts.to_string(), "1 accepted, 0 refused");
        for refusal in [Refusal::NotARotation, Refusal::ZeroPose, Refusal::ZeroPose] {
            counts.count(Some(&refusal));
        }
        counts.count(Some(&Refusal::OtherTool("Stylus".to_owned())));
        assert_eq!(counts.to_string(), "1 accepted, 3 refused: 1 rotation, 2 zero");
    }
}
