//! Why a sample is not believed, by the name of the gate that refused it, and how often.

use super::pairing::PairingError;
use super::registration::RegistrationError;
use super::sample::Validity;
use super::timing::TimingError;
use nalgebra::Vector3;
use std::fmt;
use thiserror::Error;

/// The gates, in the order in which a sample comes to them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GateName {
    /// The sample is of the tool steered by.
    Tool,
    /// Its position is finite.
    Finite,
    /// Its orientation, where it has one, is a rotation.
    Rotation,
    /// It is not the exact zero or identity.
    Zero,
    /// The tracker itself does not call it invalid.
    Status,
    /// It can be brought into the bench's frame.
    Registration,
    /// The tip can be there at all.
    Workspace,
    /// It was not sent before.
    Duplicate,
    /// Its stamp can be believed.
    Stamp,
    /// The stage's position at its acquisition is known.
    Pairing,
    /// Its value is not the last one again.
    Repeat,
    /// The tip can have come so far since the last sample.
    Step,
    /// It agrees with the model.
    Innovation,
    /// The track is not lost.
    Lost,
}

impl GateName {
    /// Every gate, in order.
    pub const ALL: [GateName; 14] = [
        GateName::Tool,
        GateName::Finite,
        GateName::Rotation,
        GateName::Zero,
        GateName::Status,
        GateName::Registration,
        GateName::Workspace,
        GateName::Duplicate,
        GateName::Stamp,
        GateName::Pairing,
        GateName::Repeat,
        GateName::Step,
        GateName::Innovation,
        GateName::Lost,
    ];

    /// The name in records, counts and messages.
    pub fn name(self) -> &'static str {
        match self {
            GateName::Tool => "tool",
            GateName::Finite => "finite",
            GateName::Rotation => "rotation",
            GateName::Zero => "zero",
            GateName::Status => "status",
            GateName::Registration => "registration",
            GateName::Workspace => "workspace",
            GateName::Duplicate => "duplicate",
            GateName::Stamp => "stamp",
            GateName::Pairing => "pairing",
            GateName::Repeat => "repeat",
            GateName::Step => "step",
            GateName::Innovation => "innovation",
            GateName::Lost => "lost",
        }
    }
}

impl fmt::Display for GateName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

/// Why a sample was refused. Its text begins with the gate's name.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum Refusal {
    /// A sample of another tool.
    #[error("tool: \"{0}\" is not the tool steered by")]
    OtherTool(String),
    /// A position that is NaN or infinite.
    #[error("finite: position ({x:.1}, {y:.1}, {z:.1}) mm", x = .0.x, y = .0.y, z = .0.z)]
    NotFinite(Vector3<f64>),
    /// An orientation that turns nothing: skewed, mirrored, scaled or not finite.
    #[error("rotation: the orientation sent is not a rotation")]
    NotARotation,
    /// Position exactly zero, without orientation or with the exact identity: senders put that
    /// where they have no measurement.
    #[error("zero: the exact zero pose, which stands for a tool that was not seen")]
    ZeroPose,
    /// The tracker says itself that the measurement is none.
    #[error("status: {0}")]
    Invalid(Validity),
    /// It cannot be brought into the bench's frame.
    #[error(transparent)]
    Registration(#[from] RegistrationError),
    /// The tip cannot be there.
    #[error(
        "workspace: tip at {axis} = {value_mm:.1} mm, outside {min_mm:.1} to {max_mm:.1} mm; check \
         the registration"
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
    /// Its time of acquisition is not known.
    #[error(transparent)]
    Timing(#[from] TimingError),
    /// The stage's position at its acquisition is not known.
    #[error("pairing: {0}")]
    Unpaired(#[from] PairingError),
    /// Acquired no later than the measurement that the observer took last.
    #[error("pairing: acquired {by_s:.3} s before the measurement taken last, it came too late")]
    Late {
        /// How much earlier, s.
        by_s: f64,
    },
    /// The stage never told where it was at its acquisition.
    #[error("pairing: the stage gave no position at its acquisition before the run ended")]
    NeverPaired,
    /// The value of the last sample again, to the bit.
    #[error(
        "repeat: the last position again, the same to the bit, {times} in a row; is the tool \
             still in view?"
    )]
    Repeat {
        /// How often in a row it has come again.
        times: u32,
    },
    /// Further from the last position than the tip can have come.
    #[error(
        "step: {step_mm:.1} mm from the last position believed, {after_s:.3} s after it (limit \
         {limit_mm:.1}); is something else being tracked?"
    )]
    Step {
        /// Distance from the last position believed, mm.
        step_mm: f64,
        /// Time since that one, s.
        after_s: f64,
        /// The limit, mm.
        limit_mm: f64,
    },
    /// Further from the model than noise and the model's own uncertainty explain.
    #[error(
        "innovation: {distance_mm:.1} mm from where the model has the tip, chi-square {chi2:.1} \
         (limit {limit:.1}); is it another's position, or is needle.radius_mm wrong?"
    )]
    Innovation {
        /// Distance from the predicted position, mm.
        distance_mm: f64,
        /// Squared Mahalanobis distance, 3 degrees of freedom.
        chi2: f64,
        /// The limit.
        limit: f64,
    },
    /// The last positions are, in their mean, further from the model than noise and the model's own
    /// uncertainty explain.
    #[error(
        "innovation: the last {positions} positions are {distance_mm:.1} mm from where the model has the \
         tip in their mean, chi-square {chi2:.1} (limit {limit:.1}); did the stream jump?"
    )]
    Jump {
        /// Distance of the mean from the predicted position, mm.
        distance_mm: f64,
        /// How many positions.
        positions: usize,
        /// Squared Mahalanobis distance, 3 degrees of freedom.
        chi2: f64,
        /// The limit.
        limit: f64,
    },
    /// It agrees with the model, but the track is lost and needs more than one that does.
    #[error("lost: agrees with the model, {agreeing} of {needed} in a row to be found again by")]
    NotFoundYet {
        /// Samples in a row that agreed, this one among them.
        agreeing: u32,
        /// How many it takes.
        needed: u32,
    },
    /// The track is lost, and there is no estimate to find it again by.
    #[error("lost: no observer has an estimate yet to find the tip again by")]
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
            Refusal::Registration(_) => GateName::Registration,
            Refusal::OutsideWorkspace { .. } => GateName::Workspace,
            Refusal::Timing(TimingError::Duplicate { .. }) => GateName::Duplicate,
            Refusal::Timing(_) => GateName::Stamp,
            Refusal::Unpaired(_) | Refusal::Late { .. } | Refusal::NeverPaired => GateName::Pairing,
            Refusal::Repeat { .. } => GateName::Repeat,
            Refusal::Step { .. } => GateName::Step,
            Refusal::Innovation { .. } | Refusal::Jump { .. } => GateName::Innovation,
            Refusal::NotFoundYet { .. } | Refusal::NoModel => GateName::Lost,
        }
    }

    /// True if it speaks against the track: enough of these in a row, and the track is lost.
    /// Others only bring nothing new: another tool's samples, what was sent before, what comes
    /// while the sender's clock is learnt or too late to be set against the stage.
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
    refused: [u64; GateName::ALL.len()],
}

impl GateCounts {
    /// Counts what became of a sample.
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
        let own = GateName::ALL.into_iter().filter(|gate| *gate != GateName::Tool);
        own.map(|gate| (gate, self.of(gate))).filter(|(_, count)| *count > 0)
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
            Refusal::Registration(RegistrationError::NoOrientation { offset_mm: 1.0 }),
            Refusal::OutsideWorkspace { axis: 'x', value_mm: 9.0, min_mm: 0.0, max_mm: 1.0 },
            Refusal::Timing(TimingError::Duplicate { unix_ns: 1 }),
            Refusal::Timing(TimingError::Backwards { by_s: 1.0 }),
            Refusal::Timing(TimingError::Ahead { by_s: 1.0 }),
            Refusal::Timing(TimingError::Unsettled { samples: 1 }),
            Refusal::Timing(TimingError::NoStamp { tool: "Tip".to_owned() }),
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
            counts.count(Some(refusal));
        }
        assert!(GateName::ALL.iter().all(|&gate| counts.of(gate) > 0), "each gate refuses");
        assert_eq!(counts.refused(), refusals.len() as u64 - 1, "of the tool");
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
