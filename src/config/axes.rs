//! Contradictions within `[stage]`, of what an axis and its operations are told.

use super::reader::Reader;
use super::{Config, Reference};

/// Notes every contradiction.
pub(super) fn check(config: &Config, reader: &mut Reader) {
    let (insertion, rotation) = (&config.stage.insertion, &config.stage.rotation);
    let axes = [
        ("insertion", &insertion.drive, insertion.homing.is_some()),
        ("rotation", &rotation.drive, rotation.homing.is_some()),
    ];
    for (axis, drive, has_homing) in axes {
        let homed = drive.reference == Reference::Homing;
        let keys = [format!("stage.{axis}.reference"), format!("stage.{axis}.homing")];
        reader.check(&[&keys[0], &keys[1]], homed && !has_homing, || {
            format!("{} is \"homing\", and there is no [{}] that says how", keys[0], keys[1])
        });
        let keys = [format!("stage.{axis}.zero"), format!("stage.{axis}.reference")];
        reader.check(&[&keys[0], &keys[1]], homed && drive.zero.is_none(), || {
            format!(
                "{} is \"start\", but {} is \"homing\": give the counts, 0 for the drive's zero",
                keys[0], keys[1]
            )
        });
    }
    // The last set-point before a stop may brake by twice what the others do.
    let (acceleration, max) =
        (config.insertion.acceleration_mm_per_s2, insertion.acceleration_max_mm_per_s2);
    let keys = ["insertion.acceleration_mm_per_s2", "stage.insertion.acceleration_max_mm_per_s2"];
    reader.check(&keys, max.is_some_and(|max| 2.0 * acceleration > max), || {
        let max = max.unwrap_or_default();
        format!("{} is {acceleration}, allowed: up to half of {}, which is {max}", keys[0], keys[1])
    });
    let operations = [
        (
            ["stage.insertion.jog_speed_mm_per_s", "stage.insertion.speed_max_mm_per_s"],
            [insertion.jog_speed_mm_per_s, insertion.speed_max_mm_per_s],
        ),
        (
            ["stage.insertion.withdraw_speed_mm_per_s", "stage.insertion.speed_max_mm_per_s"],
            [insertion.withdraw_speed_mm_per_s, insertion.speed_max_mm_per_s],
        ),
        (
            ["stage.rotation.jog_speed_deg_per_s", "stage.rotation.speed_max_deg_per_s"],
            [rotation.jog_speed_deg_per_s, rotation.speed_max_deg_per_s],
        ),
    ];
    for (keys, [speed, max]) in operations {
        reader.check(&keys, speed > max, || {
            format!("{} is {speed}, allowed: up to {}, which is {max}", keys[0], keys[1])
        });
    }
}

#[cfg(test)]
mod tests {
    use crate::config::{Config, Source};
    use crate::stage::{HomingConfig, Reference, Zero};

    fn refusal(text: &str) -> String {
        let source = Source { name: "bench.toml", text };
        Config::from_sources(&[source], &[]).expect_err("refused").to_string()
    }

    #[test]
    fn homing_needs_a_zero_of_its_own() {
        assert_eq!(
            refusal("stage.rotation.reference = \"homing\""),
            "bench.toml:1: stage.rotation.zero is \"start\", but stage.rotation.reference is \
             \"homing\": give the counts, 0 for the drive's zero"
        );
    }

    #[test]
    fn operations_keep_to_the_axis_limits() {
        assert_eq!(
            refusal("stage.insertion.withdraw_speed_mm_per_s = 12"),
            "bench.toml:1: stage.insertion.withdraw_speed_mm_per_s is 12, allowed: up to \
             stage.insertion.speed_max_mm_per_s, which is 10"
        );
        assert_eq!(
            refusal("stage.insertion.acceleration_max_mm_per_s2 = 15"),
            "bench.toml:1: insertion.acceleration_mm_per_s2 is 10, allowed: up to half of \
             stage.insertion.acceleration_max_mm_per_s2, which is 15"
        );
    }

    #[test]
    fn the_stage_is_told_how_its_axes_are_homed() {
        let text = "[stage.insertion]\nreference = \"homing\"\nzero = -500\n\
                    [stage.rotation.homing]\nspeed_zero_deg_per_s = 180.0\n";
        let source = Source { name: "bench.toml", text };
        let config = Config::from_sources(&[source], &[]).expect("valid");
        let stage = config.stage.to_stage(&config.can).expect("a stage");
        assert_eq!(stage.insertion.reference, Reference::Homing);
        assert_eq!(stage.insertion.zero, Zero::Counts(-500));
        assert_eq!(stage.insertion.homing, Some(HomingConfig::new(33)));
        let rotation = stage.rotation.homing.expect("homing");
        assert_eq!((rotation.method, rotation.speed_zero), (37, Some(std::f64::consts::PI)));
    }
}
