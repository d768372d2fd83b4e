//! `[tracker.registration]`: the tracker's pose on the bench, given or solved from fiducials.

use super::{Config, ConfigError};
use crate::calibration::{FiducialPair, RegistrationFit, RegistrationRecord};
use crate::geometry::Pose;
use crate::keys::{Field, Kind, Rule, find, over, section, within};
use nalgebra::Vector3;
use toml::{Table, Value};

/// `[tracker.registration]`.
#[derive(Debug, Clone, PartialEq)]
pub enum RegistrationConfig {
    /// A pose that was measured or computed before.
    Given(Box<GivenRegistration>),
    /// Points known in both frames, from which the pose is solved.
    Fiducials(Fiducials),
}

section! {
    /// The tracker's pose on the bench and how well it is known.
    pub struct GivenRegistration {
        /// `X_WT`.
        x_wt: Pose, flat;
        /// Standard deviation of the tip in the worst direction, due to the error of this pose, mm.
        sd_mm: f64 [within(0.0, 100.0)] = 0.0, everywhere;
        /// How it was computed, as `needle-bench calibrate registration` wrote it.
        fit: Option<RegistrationRecord>;
    }
}

section! {
    /// Fiducials in the configuration itself.
    pub struct Fiducials {
        /// Upper limit of the residual distances of the fiducials, RMS, mm.
        rms_max_mm: f64 [over(0.0, 100.0)] = 1.0, everywhere;
        /// Points known in both frames: at least three, not on a line.
        fiducials: Vec<FiducialPair> [Rule::Fields("tracker_mm, bench_mm")];
    }
}

impl Field for RegistrationConfig {
    const KIND: Kind = Kind::Either("fiducials", [Fiducials::KEYS, GivenRegistration::KEYS]);
    fn take(value: Option<&Value>) -> Self {
        match value.and_then(|value| value.get("fiducials")) {
            Some(_) => RegistrationConfig::Fiducials(Field::take(value)),
            None => RegistrationConfig::Given(Box::new(Field::take(value))),
        }
    }
}

impl GivenRegistration {
    /// The registration of the fiducials that the calibration recorded; `None` without them.
    pub fn of_fiducials(&self) -> Option<RegistrationFit> {
        RegistrationFit::of(&self.fit.as_ref()?.fiducials, f64::INFINITY).ok()
    }
}

impl RegistrationConfig {
    /// The default of `rms_max_mm`, for `needle-bench calibrate registration`.
    pub fn rms_max_mm() -> f64 {
        let default = find(Fiducials::KEYS, "rms_max_mm").and_then(|key| key.default_value());
        f64::take(default.as_ref())
    }
}

impl Fiducials {
    /// The registration that the fiducials determine.
    ///
    /// # Errors
    /// The fiducials determine no registration.
    pub fn fit(&self) -> Result<RegistrationFit, String> {
        RegistrationFit::of(&self.fiducials, self.rms_max_mm)
            .map_err(|error| format!("tracker.registration.fiducials: {error}"))
    }
}

impl Config {
    /// Standard deviation in the worst direction, mm, of a tip on the planned path, due to the error of the
    /// registration: as configured, or computed from the fiducials at both ends of the path, whichever is largest;
    /// between the ends it is never larger. Zero if it is unknown. The configured value alone does not suffice: it
    /// holds for the depth and the plane of its calibration.
    ///
    /// # Errors
    /// The fiducials determine no registration.
    pub fn registration_sd_mm(&self) -> Result<f64, ConfigError> {
        match &self.tracker.registration {
            None => Ok(0.0),
            Some(RegistrationConfig::Given(given)) => {
                let computed_mm = given.of_fiducials().map(|fit| self.registration_sd_of_mm(&fit));
                Ok(given.sd_mm.max(computed_mm.unwrap_or_default()))
            }
            Some(RegistrationConfig::Fiducials(fiducials)) => {
                Ok(self.registration_sd_of_mm(&fiducials.fit()?))
            }
        }
    }

    /// The standard deviation of [`Config::registration_sd_mm`], mm, for the registration `fit`.
    pub fn registration_sd_of_mm(&self, fit: &RegistrationFit) -> f64 {
        let ends = [0.0, self.insertion.depth_mm].map(|depth_mm| Vector3::z() * depth_mm);
        let [start, end] = ends.map(|p_p_mm| fit.target_sd_mm(&self.plane.transform(&p_p_mm)));
        start.max(end)
    }

    /// The calibrated values, as TOML in a canonical form, so that equal texts mean equal calibrations: the
    /// tracker's registration, the tip on its sensor, and the needle.
    ///
    /// # Errors
    /// Those of [`Config::to_toml`].
    pub fn calibration_toml(&self) -> Result<String, toml::ser::Error> {
        let given = |name: &str, key: &str| Some((name.to_owned(), self.value_at(key)?.clone()));
        let tip =
            ["offset_mm", "tilt", "fit"].map(|name| given(name, &format!("tracker.tip_{name}")));
        let tip = Value::Table(tip.into_iter().flatten().collect());
        let registration = given("registration", "tracker.registration");
        let parts = [registration, Some(("tip".to_owned(), tip)), given("needle", "needle")];
        toml::to_string(&parts.into_iter().flatten().collect::<Table>())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn calibration(set: &str) -> String {
        Config::from_sources(&[], &[set.to_owned()]).unwrap().calibration_toml().unwrap()
    }

    /// As uncertain as with the same fiducials in the configuration, unless more is given.
    #[test]
    fn a_registration_is_as_uncertain_as_the_run_is_deep() {
        let off = |n: usize| if n.is_multiple_of(2) { 0.3 } else { -0.3 };
        let points =
            [[-60, -60, 0], [60, -60, 0], [60, 60, 0], [-60, 60, 0], [0, 0, 120], [30, 0, 9]];
        let pairs = points.iter().enumerate().map(|(n, [x, y, z])| {
            let (x_mm, z_mm) = (f64::from(*x) + off(n), f64::from(*z) + off(n / 2));
            format!(
                "{{ tracker_mm = [{x_mm:.1}, {y}.0, {z_mm:.1}], bench_mm = [{x}.0, {y}.0, {z}.0] }}"
            )
        });
        let fiducials = format!("fiducials = [{}]", pairs.collect::<Vec<_>>().join(", "));
        let given = |sd_mm: f64| {
            format!(
                "x_mm = 0.0, y_mm = 0.0, z_mm = 0.0, yaw_deg = 0.0, pitch_deg = 0.0, roll_deg = 0.0, \
                 sd_mm = {sd_mm:.2}, fit = {{ file = \"p.csv\", sha256 = \"0\", version = \"0\", date_utc = \"0\", \
                 points = 6, rms_mm = 0.4, spread_mm = [9.0, 9.0, 9.0], {fiducials} }}"
            )
        };
        let sd_mm = |registration: &str, depth_mm: u32, z_mm: u32| {
            let sets = [
                format!("tracker.registration={{ {registration} }}"),
                format!("insertion.depth_mm={depth_mm}"),
                format!("plane.z_mm={z_mm}"),
            ];
            Config::from_sources(&[], &sets).unwrap().registration_sd_mm().unwrap()
        };
        for (depth_mm, z_mm) in [(10, 0), (250, 0), (10, 400)] {
            let computed_mm = sd_mm(&fiducials, depth_mm, z_mm);
            assert_eq!(sd_mm(&given(0.01), depth_mm, z_mm), computed_mm);
            assert_eq!(sd_mm(&given(9.0), depth_mm, z_mm), 9.0);
        }
        assert!(sd_mm(&fiducials, 250, 0) > 2.0 * sd_mm(&fiducials, 10, 0));
        assert!(sd_mm(&fiducials, 10, 400) > 2.0 * sd_mm(&fiducials, 10, 0));
    }

    #[test]
    fn only_calibrated_values_change_the_calibration_text() {
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
