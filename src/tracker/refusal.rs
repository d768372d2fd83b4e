//! Why a gate refused a sample, and how often.

use nalgebra::Vector3;
use std::collections::BTreeMap;
use std::fmt;

/// The gates, in the order in which a sample passes them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, derive_more::Display)]
#[display(rename_all = "lowercase")]
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

/// The effect of a refusal on the track.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Effect {
    /// None: a sample of another tool, sent twice, too old to pair, or received while the bench learns
    /// the sender's clock says nothing about the track.
    None,
    /// Enough of these in a row, and the track is lost.
    Counts,
    /// The track is lost at once.
    Loses,
}

/// Why a sample was refused, as text for the operator and for the record.
#[derive(Debug, Clone, PartialEq, Eq, derive_more::Display)]
#[display("{gate}: {why}")]
pub struct Refusal {
    /// The gate that refused.
    pub gate: GateName,
    /// The effect on the track.
    pub effect: Effect,
    /// Why, with the numbers and the limit.
    pub why: String,
    /// The positions lie behind the model along the heading: the tip travels less far than the needle is inserted.
    pub is_behind: bool,
}

impl Refusal {
    /// A refusal by `gate`, with the effect that this gate usually has.
    pub fn new(gate: GateName, why: impl Into<String>) -> Self {
        let effect = match gate {
            GateName::Tool | GateName::Duplicate | GateName::Pairing | GateName::Lost => {
                Effect::None
            }
            _ => Effect::Counts,
        };
        Refusal { gate, effect, why: why.into(), is_behind: false }
    }

    /// `position_mm` is NaN or infinite.
    pub(crate) fn not_finite(position_mm: &Vector3<f64>) -> Self {
        let [x, y, z] = [position_mm.x, position_mm.y, position_mm.z].map(short);
        Refusal::new(GateName::Finite, format!("position ({x}, {y}, {z}) mm"))
    }

    /// The same position as before, to the bit, repeated `repeats` times in a row.
    pub fn repeat(repeats: u32) -> Self {
        let why =
            format!("the same position to the bit, {repeats} in a row; is the tool still in view?");
        Refusal::new(GateName::Repeat, why)
    }
}

/// `value` with one decimal, a very large one by its power of ten.
pub(crate) fn short(value: f64) -> String {
    if value.abs() < 1e6 { format!("{value:.1}") } else { format!("{value:.1e}") }
}

/// The numbers of samples that the gates have accepted and refused so far.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct GateCounts {
    /// Samples that passed.
    pub accepted: u64,
    refused: BTreeMap<GateName, u64>,
}

impl GateCounts {
    /// Counts a sample that was accepted or refused.
    pub fn count(&mut self, refusal: Option<&Refusal>) {
        match refusal {
            None => self.accepted += 1,
            Some(refusal) => *self.refused.entry(refusal.gate).or_default() += 1,
        }
    }

    /// Samples of the tool that were refused.
    pub fn refused(&self) -> u64 {
        self.by_gate().map(|(_, count)| count).sum()
    }

    /// Each gate that refused samples of the tool, with their number.
    pub fn by_gate(&self) -> impl Iterator<Item = (GateName, u64)> + '_ {
        let counts = self.refused.iter().map(|(gate, count)| (*gate, *count));
        counts.filter(|(gate, _)| *gate != GateName::Tool)
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

    #[test]
    fn a_refusal_begins_with_the_name_of_its_gate() {
        let refusal = Refusal::repeat(3);
        let text = "repeat: the same position to the bit, 3 in a row; is the tool still in view?";
        assert_eq!(refusal.to_string(), text);
        let wild = Refusal::not_finite(&Vector3::new(f64::NAN, f64::MIN, f64::MAX));
        assert_eq!(wild.to_string(), "finite: position (NaN, -1.8e308, 1.8e308) mm");
    }

    #[test]
    fn refusals_are_counted_by_gate() {
        let mut counts = GateCounts::default();
        counts.count(None);
        assert_eq!(counts.to_string(), "1 accepted, 0 refused");
        for gate in [GateName::Zero, GateName::Rotation, GateName::Zero, GateName::Tool] {
            counts.count(Some(&Refusal::new(gate, "")));
        }
        assert_eq!(counts.to_string(), "1 accepted, 3 refused: 1 rotation, 2 zero");
        let by_gate: Vec<_> = counts.by_gate().collect();
        assert_eq!(by_gate, [(GateName::Rotation, 1), (GateName::Zero, 2)]);
    }
}
