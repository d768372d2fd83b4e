//! `[tracker.registration]`: the tracker's pose on the bench, given or solved from fiducials; and
//! what calibrated values say of their origin.

use super::Config;
use super::error::ConfigError;
use super::pose::PoseConfig;
use crate::calibration::{FiducialPair, RegistrationFit};
use crate::geometry::Pose;
use crate::keys::{Field, Kind, Rule, find, over, section, within};
use nalgebra::Vector3;
use toml::Value;

const LENGTH: Rule = within(0.0, 10_000.0);
const COORDINATE: Rule = within(-5000.0, 5000.0);

/// `[tracker.registration]`.
#[derive(Debug, Clone, PartialEq)]
pub enum RegistrationConfig {
    /// A pose, measured somehow.
    Given(GivenRegistration),
    /// Points known in both frames, from which the pose is solved.
    Fiducials(Fiducials),
}

section! {
    /// The tracker's pose on the bench and how well it is known.
    pub struct GivenRegistration {
        /// `X_WT`.
        x_wt: PoseConfig, flat;
        /// Standard deviation of each coordinate that the pose's error gives the tip, mm.
        sd_mm: f64 [within(0.0, 100.0)] = 0.0, everywhere;
        /// How it was computed, as `needle-bench calibrate registration` wrote it.
        fit: Option<RegistrationFitConfig>;
    }
}

section! {
    /// What a computed registration says of itself; for the record alone.
    pub struct RegistrationFitConfig {
        /// Where it came from.
        provenance: Provenance, flat;
        /// Number of fiducials.
        points: u32 [within(3.0, u32::MAX as f64)];
        /// RMS of the distances left, mm.
        rms_mm: f64 [LENGTH];
        /// RMS extent of the fiducials along their principal axes, mm.
        spread_mm: [f64; 3] [LENGTH];
    }
}

section! {
    /// Where a calibrated value came from.
    pub struct Provenance {
        /// The file it was computed from.
        file: String;
        /// SHA-256 of that file, hex.
        sha256: String;
        /// Version of the bench that computed it.
        version: String;
        /// When, RFC 3339.
        date_utc: String;
    }
}

section! {
    /// What a computed tip offset and tilt say of themselves; for the record alone.
    pub struct TipFitConfig {
        /// Where they came from.
        provenance: Provenance, flat;
        /// Number of positions.
        points: u32 [within(1.0, u32::MAX as f64)];
        /// Radius of the circle, mm.
        radius_mm: f64 [LENGTH];
        /// RMS distance of the positions from the circle, mm.
        rms_mm: f64 [LENGTH];
    }
}

section! {
    /// Fiducials in the configuration itself.
    pub struct Fiducials {
        /// The most that the distances left may be, RMS, mm.
        rms_max_mm: f64 [over(0.0, 100.0)] = 1.0, everywhere;
        /// Points known in both frames: at least three, not on a line.
        fiducials: Vec<FiducialConfig> [Rule::Fields("tracker_mm, bench_mm")];
    }
}

section! {
    /// A point in both frames.
    #[derive(Copy)]
    pub struct FiducialConfig {
        /// In the tracker's frame, mm.
        tracker_mm: [f64; 3] [COORDINATE];
        /// In the bench's frame, mm.
        bench_mm: [f64; 3] [COORDINATE];
    }
}

impl Field for RegistrationConfig {
    const KIND: Kind = Kind::Either("fiducials", [Fiducials::KEYS, GivenRegistration::KEYS]);
    fn take(value: Option<&Value>) -> Self {
        match value.and_then(|value| value.get("fiducials")) {
            Some(_) => RegistrationConfig::Fiducials(Field::take(value)),
            None => RegistrationConfig::Given(Field::take(value)),
        }
    }
}

impl RegistrationConfig {
    /// The default of `rms_max_mm`, for `needle-bench calibrate registration`.
    pub fn rms_max_mm() -> f64 {
        let default = find(Fiducials::KEYS, "rms_max_mm").and_then(|key| key.default_value());
        f64::take(default.as_ref())
    }

    /// `X_WT`: the tracker's pose on the bench.
    ///
    /// # Errors
    /// Fiducials that determine none.
    pub fn x_wt(&self) -> Result<Pose, ConfigError> {
        match self {
            RegistrationConfig::Given(given) => Ok(given.x_wt.to_pose()),
            RegistrationConfig::Fiducials(fiducials) => Ok(fiducials.fit()?.x_wt),
        }
    }
}

impl Fiducials {
    /// The registration that the fiducials determine.
    ///
    /// # Errors
    /// What is wrong with them.
    pub fn fit(&self) -> Result<RegistrationFit, ConfigError> {
        let pairs: Vec<FiducialPair> = self
            .fiducials
            .iter()
            .map(|pair| FiducialPair {
                tracker_mm: pair.tracker_mm.into(),
                bench_mm: pair.bench_mm.into(),
            })
            .collect();
        RegistrationFit::of(&pairs, self.rms_max_mm)
            .map_err(|error| ConfigError::of(format!("tracker.registration.fiducials: {error}")))
    }
}

impl Config {
    /// Standard deviation of each coordinate, mm, that the registration's error gives a tip on the
    /// planned path: as configured, or with fiducials the larger of those at the path's two ends,
    /// between which it is never larger. Zero where nothing is known of it.
    ///
    /// # Errors
    /// Fiducials that determine no registration.
    pub fn registration_sd_mm(&self) -> Result<f64, ConfigError> {
        match &self.tracker.registration {
            None => Ok(0.0),
            Some(RegistrationConfig::Given(given)) => Ok(given.sd_mm),
            Some(RegistrationConfig::Fiducials(fiducials)) => {
                Ok(self.registration_sd_of_mm(&fiducials.fit()?))
            }
        }
    }

    /// The same of a fit.
    pub fn registration_sd_of_mm(&self, fit: &RegistrationFit) -> f64 {
        let x_wp = self.plane.to_pose();
        let ends = [0.0, self.insertion.depth_mm].map(|depth_mm| Vector3::z() * depth_mm);
        ends.map(|p_p_mm| fit.target_sd_mm(&x_wp.transform(&p_p_mm)))
            .into_iter()
            .fold(0.0, f64::max)
    }
}
