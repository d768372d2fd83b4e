//! `[control]`: the law that steers, and its settings.

use serde::Serialize;

use super::choice::choice;
use super::rule::Range;
use super::section::Section;
use crate::control::{FeedbackLinearizationConfig, NestedSaturationConfig};

/// Faster than 1 per mm a pole is done within a sample.
const RATE: Range = Range::over(0.0, 1.0);
/// Turning by more than this in a mm is none.
const TURNING: Range = Range::over(0.0, 360.0);

choice! {
    /// A control law.
    ControlKind {
        /// The paper's.
        FeedbackLinearization = "feedback-linearization",
        /// The one that holds from everywhere.
        NestedSaturation = "nested-saturation",
    }
}

/// `[control]`: which law steers, and its settings.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ControlConfig {
    /// The law.
    pub kind: ControlKind,
    /// `[control.feedback_linearization]`.
    pub feedback_linearization: FeedbackLinearizationSection,
    /// `[control.nested_saturation]`.
    pub nested_saturation: NestedSaturationSection,
}

/// `[control.feedback_linearization]`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FeedbackLinearizationSection {
    /// Decay rates of the distance from the plane, per mm.
    pub poles_per_mm: [f64; 3],
    /// The law never asks for more roll than this, degrees.
    pub roll_demand_max_deg: f64,
    /// The law never asks for faster turning, degrees per mm.
    pub rotation_max_deg_per_mm: f64,
}

/// `[control.nested_saturation]`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NestedSaturationSection {
    /// Decay rate of the distance from the plane, per mm.
    pub distance_rate_per_mm: f64,
    /// Decay rate of the pitch error, per mm.
    pub pitch_rate_per_mm: f64,
    /// The law never steers towards the plane at more than this pitch, degrees.
    pub pitch_demand_max_deg: f64,
    /// Part of the needle's bend that the way into the plane counts on.
    pub bend_part: f64,
    /// The law never asks for faster turning of the base, degrees per mm.
    pub rotation_max_deg_per_mm: f64,
    /// Demands under this do not make the base cross the torsion's band, degrees.
    pub reversal_min_deg: f64,
    /// Nor do those under so many standard deviations of the band's width.
    pub reversal_sd: f64,
    /// Part of the demand that is withheld while nothing is known of the roll.
    pub caution: f64,
}

impl ControlConfig {
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        ControlConfig {
            kind: s.choice("kind"),
            feedback_linearization: s.section("feedback_linearization", |s| {
                FeedbackLinearizationSection {
                    poles_per_mm: s.numbers("poles_per_mm", RATE),
                    roll_demand_max_deg: s.number("roll_demand_max_deg", Range::over(0.0, 85.0)),
                    rotation_max_deg_per_mm: s.number("rotation_max_deg_per_mm", TURNING),
                }
            }),
            nested_saturation: s.section("nested_saturation", |s| NestedSaturationSection {
                distance_rate_per_mm: s.number("distance_rate_per_mm", RATE),
                pitch_rate_per_mm: s.number("pitch_rate_per_mm", RATE),
                pitch_demand_max_deg: s.number("pitch_demand_max_deg", Range::over(0.0, 60.0)),
                bend_part: s.number("bend_part", Range::over(0.0, 1.0)),
                rotation_max_deg_per_mm: s.number("rotation_max_deg_per_mm", TURNING),
                reversal_min_deg: s.number("reversal_min_deg", Range::within(0.0, 45.0)),
                reversal_sd: s.number("reversal_sd", Range::within(0.0, 10.0)),
                caution: s.number("caution", Range::within(0.0, 1.0)),
            }),
        }
    }

    /// The fastest turning that the chosen law asks for, and its key.
    pub fn rotation_max_deg_per_mm(&self) -> (f64, &'static str) {
        match self.kind {
            ControlKind::FeedbackLinearization => (
                self.feedback_linearization.rotation_max_deg_per_mm,
                "control.feedback_linearization.rotation_max_deg_per_mm",
            ),
            ControlKind::NestedSaturation => (
                self.nested_saturation.rotation_max_deg_per_mm,
                "control.nested_saturation.rotation_max_deg_per_mm",
            ),
        }
    }

    /// What the feedback linearisation is told.
    pub fn to_feedback_linearization(&self) -> FeedbackLinearizationConfig {
        let section = &self.feedback_linearization;
        FeedbackLinearizationConfig {
            poles_per_mm: section.poles_per_mm,
            roll_demand_max_rad: section.roll_demand_max_deg.to_radians(),
            rotation_max_rad_per_mm: section.rotation_max_deg_per_mm.to_radians(),
        }
    }

    /// What the nested saturation is told.
    pub fn to_nested_saturation(&self) -> NestedSaturationConfig {
        let section = &self.nested_saturation;
        NestedSaturationConfig {
            distance_rate_per_mm: section.distance_rate_per_mm,
            pitch_rate_per_mm: section.pitch_rate_per_mm,
            pitch_demand_max_rad: section.pitch_demand_max_deg.to_radians(),
            bend_part: section.bend_part,
            rotation_max_rad_per_mm: section.rotation_max_deg_per_mm.to_radians(),
            reversal_min_rad: section.reversal_min_deg.to_radians(),
            reversal_sd: section.reversal_sd,
            caution: section.caution,
        }
    }
}
