//! `[needle]`: the bench's model of the needle, and how it was calibrated.

use super::tracker::FILE;
use super::{Config, ConfigError};
use crate::calibration::{NeedleRecord, PathNoise};
use crate::keys::{Rule, section, within};
use crate::needle::{Needle, Torsion, TorsionConfig};
use crate::session::Samples;

pub(super) const TIP_AHEAD: Rule = within(-100.0, 100.0);

section! {
    /// `[needle]`: the bench's model of the needle.
    pub struct NeedleConfig {
        /// The arc that it cuts unturned.
        arc: Arc, flat;
        /// How far the tip is ahead of the point on the shaft that moves along its own axis (bicycle
        /// model), mm; 0 is the paper's unicycle.
        tip_ahead_mm: f64 [TIP_AHEAD] = 0.0;
        /// The play of the shaft: the tip's roll lags behind the base's.
        torsion: TorsionConfig;
        /// How the needle's values were found, as `needle-bench calibrate needle` wrote it.
        fit: Option<NeedleRecord>, whole;
        /// In place of the needle's values: the file that `needle-bench calibrate needle` wrote.
        needle_file: Option<String> [FILE];
    }
}

section! {
    /// The arc that a needle cuts when it is not turned, given by radius or curvature.
    #[derive(Copy)]
    pub struct Arc {
        /// Radius of the arc that the needle cuts unturned, mm.
        radius_mm: Option<f64> [within(10.0, 100_000.0)] = 122.0;
        /// Its curvature, per mm.
        curvature_per_mm: Option<f64> [within(1e-5, 0.1)], instead_of("radius_mm");
    }
}

impl Arc {
    /// κ, per mm.
    pub fn curvature_per_mm(&self) -> f64 {
        let of_radius = || self.radius_mm.map_or(f64::NAN, f64::recip);
        self.curvature_per_mm.unwrap_or_else(of_radius)
    }

    /// A needle that cuts this arc, with its tip `tip_ahead_mm` ahead of the bicycle model's point. An error names
    /// the `section`.
    pub(super) fn to_needle(self, tip_ahead_mm: f64, section: &str) -> Result<Needle, String> {
        Needle::new(self.curvature_per_mm())
            .and_then(|needle| needle.with_tip_ahead(tip_ahead_mm))
            .map_err(|error| format!("{section}: {error}"))
    }
}

/// The torsion of `config`; an error names the `section`.
pub(super) fn torsion(config: TorsionConfig, section: &str) -> Result<Torsion, String> {
    Torsion::new(config).map_err(|error| format!("{section}.torsion: {error}"))
}

impl Config {
    /// The bench's model of the needle and of the torsion of its shaft.
    ///
    /// # Errors
    /// Those of [`Needle::new`], [`Needle::with_tip_ahead`] and [`Torsion::new`].
    pub fn believed_needle(&self) -> Result<(Needle, Torsion), ConfigError> {
        let NeedleConfig { arc, tip_ahead_mm, torsion: config, .. } = self.needle;
        Ok((arc.to_needle(tip_ahead_mm, "needle")?, torsion(config, "needle")?))
    }

    /// The noise of a path due to tracker and tissue, from the settings of the invariant observer.
    pub fn path_noise(&self) -> PathNoise {
        let observer = &self.observer.invariant;
        PathNoise {
            spacing_mm: match self.observer.samples {
                Samples::All => 0.0,
                Samples::OnePerStep => self.insertion.step_mm,
            },
            position_sd_mm: observer.position_sd_mm,
            position_noise_mm: observer.noise.position_mm,
            axial_noise_mm: observer.noise.axial_mm,
            heading_noise_rad: observer.noise.heading_rad,
        }
    }
}
