//! The limits for the figures of a run.

use crate::config::{Config, ConfigError, Source};
use crate::stage::Axis;
use crate::study::OFF_PLANE_LIMIT_MM;

/// The limits that applied to a run, from its own configuration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Depth to reach, mm.
    pub depth_mm: f64,
    /// Position tolerance at that depth, mm.
    pub arrival_mm: f64,
    /// A run with a smaller RMS distance from the plane over the last third has settled, mm.
    pub off_plane_mm: f64,
    /// Distance of the insertion axis from its target at a SYNC, mm.
    pub following_error_mm: f64,
    /// Distance of the rotation axis from its target at a SYNC, deg.
    pub following_error_deg: f64,
    /// Age of the newest tip position before the insertion is held, s.
    pub tip_age_s: f64,
    /// Insertion without a tip position before it is held, mm.
    pub tip_lag_mm: f64,
}

impl Limits {
    /// The limits of a run's `config.toml`.
    ///
    /// # Errors
    /// A configuration that this version cannot read; another version may have written it.
    pub fn of(config_toml: &str) -> Result<Self, ConfigError> {
        let source = Source { name: "config.toml", text: config_toml };
        let config = Config::from_sources(&[source], &[])?;
        let stage = config.stage.to_stage(&config.can)?;
        let following = |axis| stage.axis(axis).following_error_limit(stage.sync_period);
        Ok(Limits {
            depth_mm: config.insertion.depth_mm,
            arrival_mm: config.insertion.arrival_mm,
            off_plane_mm: OFF_PLANE_LIMIT_MM,
            following_error_mm: following(Axis::Insertion),
            following_error_deg: following(Axis::Rotation).to_degrees(),
            tip_age_s: config.tracker.hold.after.as_secs_f64(),
            tip_lag_mm: config.tracker.hold.after_mm,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 10 mm/s and 360 deg/s, 30 ms of servo lag and two SYNC of 10 ms.
    #[test]
    fn limits_are_those_that_the_run_was_under() {
        let limits =
            Limits::of("insertion.depth_mm = 120.0\ntracker.hold_after_s = 0.25\n").unwrap();
        assert_eq!((limits.depth_mm, limits.tip_age_s, limits.tip_lag_mm), (120.0, 0.25, 1.0));
        assert!((limits.following_error_mm - 0.5).abs() < 1e-12);
        assert!((limits.following_error_deg - 18.0).abs() < 1e-12);
        assert!(Limits::of("insertion.depth_mn = 120.0").is_err());
    }
}
