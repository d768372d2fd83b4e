//! `[needle.fit]`: what a calibrated needle says of itself.

use serde::Serialize;

use super::Config;
use super::registration::Provenance;
use super::rule::Range;
use super::section::Section;
use super::steering::TorsionConfig;
use crate::calibration::{NeedleFit, PathNoise};

/// What a calibrated needle says of itself; for the record alone. The standard errors are from how
/// the insertions differ.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NeedleFitConfig {
    /// Where it came from.
    #[serde(flatten)]
    pub provenance: Provenance,
    /// Number of insertions.
    pub insertions: u32,
    /// RMS of the recorded roll less the base's through the torsion, degrees.
    pub roll_rms_deg: f64,
    /// Standard error of the curvature, per mm.
    pub curvature_sd_per_mm: f64,
    /// Of the tip's distance from the rear wheel, mm.
    pub tip_ahead_sd_mm: f64,
    /// Of the bend axis about the shaft's, degrees.
    pub bend_axis_sd_deg: f64,
    /// Standard deviation of the torsion's offset from one insertion to the next, degrees.
    pub offset_spread_deg: f64,
    /// Standard errors of the torsion.
    pub torsion_sd: TorsionConfig,
}

impl NeedleFitConfig {
    /// What `fit` says of itself.
    pub fn new(provenance: Provenance, fit: &NeedleFit) -> Self {
        let NeedleFit { insertions, bend, torsion, .. } = fit;
        NeedleFitConfig {
            provenance,
            insertions: u32::try_from(*insertions).unwrap_or(u32::MAX),
            roll_rms_deg: torsion.roll_rms_rad.to_degrees(),
            curvature_sd_per_mm: bend.curvature_sd_per_mm,
            tip_ahead_sd_mm: bend.tip_ahead_sd_mm,
            bend_axis_sd_deg: bend.bend_axis_sd_rad.to_degrees(),
            offset_spread_deg: torsion.offset_spread_rad.to_degrees(),
            torsion_sd: TorsionConfig::of(&torsion.sd),
        }
    }

    pub(super) fn read(s: &mut Section<'_>) -> Self {
        let any = Range::within(0.0, 1e6);
        NeedleFitConfig {
            provenance: Provenance::read(s),
            insertions: s.integer("insertions", 1, u32::MAX),
            roll_rms_deg: s.number("roll_rms_deg", any),
            curvature_sd_per_mm: s.number("curvature_sd_per_mm", any),
            tip_ahead_sd_mm: s.number("tip_ahead_sd_mm", any),
            bend_axis_sd_deg: s.number("bend_axis_sd_deg", any),
            offset_spread_deg: s.number("offset_spread_deg", any),
            torsion_sd: s.section("torsion_sd", TorsionConfig::read),
        }
    }
}

impl Config {
    /// How tracker and tissue disturb a path.
    pub fn path_noise(&self) -> PathNoise {
        PathNoise { position_sd_mm: 0.18, position_noise_mm: 0.017, heading_noise_rad: 0.01 }
    }
}
