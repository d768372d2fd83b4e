//! The calibrated part of a configuration: what two runs must share to be of one calibration.

use super::needle_fit::NeedleFitConfig;
use super::pose::AnglesConfig;
use super::registration::{RegistrationConfig, TipFitConfig};
use super::steering::TorsionConfig;
use super::{Arc, Config};
use serde::Serialize;

/// Registration, tip and needle, as they stand in the configuration as used.
#[derive(Serialize)]
struct Calibration<'a> {
    #[serde(skip_serializing_if = "Option::is_none")]
    registration: Option<&'a RegistrationConfig>,
    tip: Tip<'a>,
    needle: Needle<'a>,
}

#[derive(Serialize)]
struct Tip<'a> {
    offset_mm: [f64; 3],
    tilt: AnglesConfig,
    #[serde(skip_serializing_if = "Option::is_none")]
    fit: Option<&'a TipFitConfig>,
}

#[derive(Serialize)]
struct Needle<'a> {
    #[serde(flatten)]
    arc: Arc,
    tip_ahead_mm: f64,
    torsion: TorsionConfig,
    #[serde(skip_serializing_if = "Option::is_none")]
    fit: Option<&'a NeedleFitConfig>,
}

impl Config {
    /// The tracker's registration, the tip on its sensor and the needle, as TOML of one form: equal
    /// texts are equal calibrations.
    ///
    /// # Errors
    /// As [`Config::to_toml`].
    pub fn calibration_toml(&self) -> Result<String, toml::ser::Error> {
        let Config { tracker, needle, .. } = self;
        toml::to_string(&Calibration {
            registration: tracker.registration.as_ref(),
            tip: Tip {
                offset_mm: tracker.tip_offset_mm,
                tilt: tracker.tip_tilt,
                fit: tracker.tip_fit.as_ref(),
            },
            needle: Needle {
                arc: needle.arc,
                tip_ahead_mm: needle.tip_ahead_mm,
                torsion: needle.torsion,
                fit: needle.fit.as_ref(),
            },
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn calibration(set: &str) -> String {
        Config::from_sources(&[], &[set.to_owned()]).unwrap().calibration_toml().unwrap()
    }

    #[test]
    fn what_is_calibrated_and_nothing_else_changes_it() {
        let usual = calibration("name=\"usual\"");
        assert_eq!(usual, calibration("emulator.seed=9"));
        for set in [
            "needle.radius_mm=121.0",
            "tracker.registration.sd_mm=0.2",
            "tracker.tip_offset_mm=[0.0, 0.0, 7.0]",
        ] {
            assert_ne!(usual, calibration(set), "{set}");
        }
    }
}
