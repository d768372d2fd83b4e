//! The calibrated part of a configuration: what two runs must share to be of one calibration.

use toml::Table;

use super::Config;

impl Config {
    /// The tracker's registration, the tip on its sensor and the needle, as TOML of one form: equal
    /// texts are equal calibrations.
    ///
    /// # Errors
    /// As [`Config::to_toml`].
    pub fn calibration_toml(&self) -> Result<String, toml::ser::Error> {
        let given = |(key, value): (&str, Option<_>)| Some((key.to_owned(), value?));
        let tip = ["offset_mm", "tilt", "fit"]
            .map(|key| (key, self.at(&format!("tracker.tip_{key}")).cloned()));
        let parts = [
            ("registration", self.at("tracker.registration").cloned()),
            ("tip", Some(Table::from_iter(tip.into_iter().filter_map(given)).into())),
            ("needle", self.at("needle").cloned()),
        ];
        toml::to_string(&Table::from_iter(parts.into_iter().filter_map(given)))
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
