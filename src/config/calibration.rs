//! The calibrated part of a configuration: what two runs must share to be of one calibration.

use toml::Table;

use super::Config;
use super::schema::Field;

impl Config {
    /// The tracker's registration, the tip on its sensor and the needle, as TOML of one form: equal
    /// texts are equal calibrations.
    ///
    /// # Errors
    /// As [`Config::to_toml`].
    pub fn calibration_toml(&self) -> Result<String, toml::ser::Error> {
        let Config { tracker, needle, .. } = self;
        let tip = [
            ("offset_mm", tracker.tip_offset_mm.put()),
            ("tilt", tracker.tip_tilt.put()),
            ("fit", tracker.tip_fit.put()),
        ];
        let given = |(key, value): (&str, Option<_>)| Some((key.to_owned(), value?));
        let tip: Table = tip.into_iter().filter_map(given).collect();
        let parts = [
            ("registration", tracker.registration.put()),
            ("tip", Some(tip.into())),
            ("needle", needle.put()),
        ];
        toml::to_string(&parts.into_iter().filter_map(given).collect::<Table>())
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
