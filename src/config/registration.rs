//! `[tracker.registration]`: the tracker's pose on the bench, given or solved from fiducials; and
//! what calibrated values say of their origin.

use serde::Serialize;

use super::Config;
use super::error::ConfigError;
use super::pose::PoseConfig;
use super::rule::Range;
use super::section::Section;
use crate::calibration::{FiducialPair, RegistrationFit, TipFit};
use crate::geometry::Pose;
use nalgebra::Vector3;

const LENGTH: Range = Range::within(0.0, 10_000.0);

/// `[tracker.registration]`.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(untagged)]
pub enum RegistrationConfig {
    /// A pose, measured somehow.
    Given(GivenRegistration),
    /// Points known in both frames, from which the pose is solved.
    Fiducials(Fiducials),
}

/// The tracker's pose on the bench and how well it is known.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct GivenRegistration {
    /// `X_WT`.
    #[serde(flatten)]
    pub x_wt: PoseConfig,
    /// Standard deviation of each coordinate that the pose's error gives the tip, mm.
    pub sd_mm: f64,
    /// How it was computed, where `needle-bench calibrate registration` did it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fit: Option<RegistrationFitConfig>,
}

/// What a computed registration says of itself; for the record alone.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RegistrationFitConfig {
    /// Where it came from.
    #[serde(flatten)]
    pub provenance: Provenance,
    /// Number of fiducials.
    pub points: u32,
    /// RMS of the distances left, mm.
    pub rms_mm: f64,
    /// RMS extent of the fiducials along their principal axes, mm.
    pub spread_mm: [f64; 3],
}

/// Where a calibrated value came from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Provenance {
    /// The file it was computed from.
    pub file: String,
    /// SHA-256 of that file, hex.
    pub sha256: String,
    /// Version of the bench that computed it.
    pub version: String,
    /// When, RFC 3339.
    pub date_utc: String,
}

/// What a computed tip offset and tilt say of themselves; for the record alone.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TipFitConfig {
    /// Where they came from.
    #[serde(flatten)]
    pub provenance: Provenance,
    /// Number of positions.
    pub points: u32,
    /// Radius of the circle, mm.
    pub radius_mm: f64,
    /// RMS distance of the positions from the circle, mm.
    pub rms_mm: f64,
}

/// Fiducials in the configuration itself.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Fiducials {
    /// The most that the distances left may be, RMS, mm.
    pub rms_max_mm: f64,
    /// At least three, not on a line.
    pub fiducials: Vec<FiducialConfig>,
}

/// A point in both frames.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FiducialConfig {
    /// In the tracker's frame, mm.
    pub tracker_mm: [f64; 3],
    /// In the bench's frame, mm.
    pub bench_mm: [f64; 3],
}

impl RegistrationConfig {
    /// The most that the distances left may be where nothing else is said, RMS, mm.
    pub const RMS_MAX_MM: f64 = 1.0;

    pub(super) fn read(s: &mut Section<'_>) -> Self {
        if s.is_given("fiducials") {
            let pose = ["x_mm", "y_mm", "z_mm", "yaw_deg", "pitch_deg", "roll_deg", "sd_mm", "fit"];
            if let Some(other) = pose.into_iter().find(|&name| s.is_given(name)) {
                s.refuse(
                    "fiducials",
                    &format!("fiducials are given along with {other}: give one of the two"),
                );
            }
            let coordinate = Range::within(-5000.0, 5000.0);
            return RegistrationConfig::Fiducials(Fiducials {
                rms_max_mm: s
                    .optional_number("rms_max_mm", Range::over(0.0, 100.0))
                    .unwrap_or(Self::RMS_MAX_MM),
                fiducials: s.tables("fiducials", "tracker_mm, bench_mm", |s| FiducialConfig {
                    tracker_mm: s.numbers("tracker_mm", coordinate),
                    bench_mm: s.numbers("bench_mm", coordinate),
                }),
            });
        }
        RegistrationConfig::Given(GivenRegistration {
            x_wt: PoseConfig::read_frame(s),
            sd_mm: s.optional_number("sd_mm", Range::within(0.0, 100.0)).unwrap_or(0.0),
            fit: s.optional_section("fit", RegistrationFitConfig::read),
        })
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

impl RegistrationFitConfig {
    /// What `fit` says of itself.
    pub fn new(provenance: Provenance, fit: &RegistrationFit) -> Self {
        RegistrationFitConfig {
            provenance,
            points: u32::try_from(fit.points).unwrap_or(u32::MAX),
            rms_mm: fit.rms_mm,
            spread_mm: fit.spread_mm,
        }
    }

    fn read(s: &mut Section<'_>) -> Self {
        RegistrationFitConfig {
            provenance: Provenance::read(s),
            points: s.integer("points", 3, u32::MAX),
            rms_mm: s.number("rms_mm", LENGTH),
            spread_mm: s.numbers("spread_mm", LENGTH),
        }
    }
}

impl TipFitConfig {
    /// What `fit` says of itself.
    pub fn new(provenance: Provenance, fit: &TipFit) -> Self {
        TipFitConfig {
            provenance,
            points: u32::try_from(fit.points).unwrap_or(u32::MAX),
            radius_mm: fit.radius_mm,
            rms_mm: fit.rms_mm,
        }
    }

    pub(super) fn read(s: &mut Section<'_>) -> Self {
        TipFitConfig {
            provenance: Provenance::read(s),
            points: s.integer("points", 1, u32::MAX),
            radius_mm: s.number("radius_mm", LENGTH),
            rms_mm: s.number("rms_mm", LENGTH),
        }
    }
}

impl Provenance {
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        let mut text = |name| s.text(name, "any text", |_| true);
        Provenance {
            file: text("file"),
            sha256: text("sha256"),
            version: text("version"),
            date_utc: text("date_utc"),
        }
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
