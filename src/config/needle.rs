//! `[needle]`: what the bench believes of the needle, and how it was calibrated.

use super::registration::Provenance;
use super::schema::{Rule, over, section, within};
use super::{Config, ConfigError};
use crate::calibration::{NeedleFit, PathNoise};
use crate::needle::{self, Needle, Torsion};

pub(super) const TIP_AHEAD: Rule = within(-100.0, 100.0);
/// Half-width of a play in degrees, its growth in degrees per mm, and its offset in degrees.
pub(super) const WIDTH: Rule = within(0.0, 720.0);
pub(super) const GROWTH: Rule = within(0.0, 36.0);
pub(super) const OFFSET: Rule = within(-720.0, 720.0);
/// A standard error.
const ERROR: Rule = within(0.0, 1e6);

section! {
    /// `[needle]`: what the bench believes of the needle.
    pub struct NeedleConfig {
        /// The arc that it cuts unturned.
        arc: Arc, flat;
        /// How far the tip is ahead of the point on the shaft that moves along its own axis (bicycle
        /// model), mm; 0 is the paper's unicycle.
        tip_ahead_mm: f64 [TIP_AHEAD] = 0.0;
        /// The play of the shaft: the tip's roll lags behind the base's.
        torsion: TorsionConfig;
        /// How these were found, as `needle-bench calibrate needle` wrote it.
        fit: Option<NeedleFitConfig>, whole;
    }
}

section! {
    /// The arc that a needle cuts when it is not turned, as it is given.
    #[derive(Copy)]
    pub struct Arc {
        /// Radius of the arc that the needle cuts unturned, mm.
        radius_mm: Option<f64> [within(10.0, 100_000.0)] = 122.0;
        /// Its curvature, per mm.
        curvature_per_mm: Option<f64> [over(0.0, 0.1)], instead_of("radius_mm");
    }
}

section! {
    /// `[needle.torsion]` and `[emulator.torsion]`: the play between the base's rotation and the
    /// tip's.
    #[derive(Copy)]
    pub struct TorsionConfig {
        /// Half the width of the band at the start, degrees: the tip stays within offset ± half-width
        /// of the base.
        half_width_deg: f64 [WIDTH] = 0.0;
        /// Growth of the half-width with depth, degrees per mm.
        half_width_deg_per_mm: f64 [GROWTH] = 0.0;
        /// Middle of the band, degrees; without creep at most `half_width_deg` in magnitude.
        offset_deg: f64 [OFFSET] = 0.0;
        /// Insertion over which the tip creeps to the band, at the start, mm; 0: at once.
        creep_mm: f64 [within(0.0, 100.0)] = 0.0;
        /// Growth of that with depth, mm per mm.
        creep_mm_per_mm: f64 [within(0.0, 1.0)] = 0.0;
    }
}

section! {
    /// What a calibrated needle says of itself; for the record alone. The standard errors are from how
    /// the insertions differ.
    pub struct NeedleFitConfig {
        /// Where it came from.
        provenance: Provenance, flat;
        /// Number of insertions.
        insertions: u32 [within(1.0, u32::MAX as f64)];
        /// RMS of the recorded roll less the base's through the torsion, degrees.
        roll_rms_deg: f64 [ERROR];
        /// Standard error of the curvature, per mm.
        curvature_sd_per_mm: f64 [ERROR];
        /// Standard error of `tip_ahead_mm`, mm.
        tip_ahead_sd_mm: f64 [ERROR];
        /// Standard error of the bend axis about the shaft's, degrees.
        bend_axis_sd_deg: f64 [ERROR];
        /// Standard deviation of the torsion's offset from one insertion to the next, degrees.
        offset_spread_deg: f64 [ERROR];
        /// Standard errors of the torsion.
        torsion_sd: TorsionConfig, whole;
    }
}

impl Arc {
    /// An arc of this curvature, per mm.
    pub(super) fn of_curvature(curvature_per_mm: f64) -> Self {
        Arc { radius_mm: None, curvature_per_mm: Some(curvature_per_mm) }
    }

    /// κ, per mm.
    pub fn curvature_per_mm(&self) -> f64 {
        let of_radius = || self.radius_mm.map_or(f64::NAN, f64::recip);
        self.curvature_per_mm.unwrap_or_else(of_radius)
    }

    /// A needle that cuts it, with its tip so far ahead; `section` is named where there is none.
    pub(super) fn to_needle(self, tip_ahead_mm: f64, section: &str) -> Result<Needle, ConfigError> {
        Needle::new(self.curvature_per_mm())
            .and_then(|needle| needle.with_tip_ahead(tip_ahead_mm))
            .map_err(|error| ConfigError::of(format!("{section}: {error}")))
    }
}

impl TorsionConfig {
    /// As `torsion` is written.
    pub fn of(torsion: &needle::TorsionConfig) -> Self {
        TorsionConfig {
            half_width_deg: torsion.half_width_rad.to_degrees(),
            half_width_deg_per_mm: torsion.half_width_rad_per_mm.to_degrees(),
            offset_deg: torsion.offset_rad.to_degrees(),
            creep_mm: torsion.creep_mm,
            creep_mm_per_mm: torsion.creep_mm_per_mm,
        }
    }

    /// The play in rad; an error names the `section`.
    pub(super) fn to_torsion(self, section: &str) -> Result<Torsion, ConfigError> {
        Torsion::new(needle::TorsionConfig {
            half_width_rad: self.half_width_deg.to_radians(),
            half_width_rad_per_mm: self.half_width_deg_per_mm.to_radians(),
            offset_rad: self.offset_deg.to_radians(),
            creep_mm: self.creep_mm,
            creep_mm_per_mm: self.creep_mm_per_mm,
        })
        .map_err(|error| ConfigError::of(format!("{section}.torsion: {error}")))
    }
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
}

impl Config {
    /// The needle as the bench believes it to be.
    ///
    /// # Errors
    /// A curvature that no needle has.
    pub fn believed_needle(&self) -> Result<Needle, ConfigError> {
        self.needle.arc.to_needle(self.needle.tip_ahead_mm, "needle")
    }

    /// The torsion of its shaft as the bench believes it to be.
    ///
    /// # Errors
    /// An offset outside the band.
    pub fn believed_torsion(&self) -> Result<Torsion, ConfigError> {
        self.needle.torsion.to_torsion("needle")
    }

    /// How tracker and tissue disturb a path: as the invariant observer is told.
    pub fn path_noise(&self) -> PathNoise {
        let observer = self.observer.to_invariant();
        PathNoise {
            position_sd_mm: observer.position_sd_mm,
            position_noise_mm: observer.position_noise_mm,
            axial_noise_mm: observer.axial_noise_mm,
            heading_noise_rad: observer.heading_noise_rad,
        }
    }
}
