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
    located(config, reader);
    home_inside(config, reader);
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

/// Limits of a real axis are what its screw, its needle or the sensor's cable bear. Counted from where
/// each command begins they would bear nothing: three jogs go three times as far.
fn located(config: &Config, reader: &mut Reader) {
    let (insertion, rotation) = (&config.stage.insertion, &config.stage.rotation);
    let axes = [
        ("insertion", &insertion.drive, [insertion.min_mm, insertion.max_mm], "mm"),
        ("rotation", &rotation.drive, [rotation.min_deg, rotation.max_deg], "deg"),
    ];
    for (axis, drive, [min, max], unit) in axes {
        let drifts = config.stage.hardware && drive.zero.is_none() && !drive.wraps;
        let limit = format!("stage.{axis}.max_{unit}");
        let keys = [format!("stage.{axis}.zero"), limit, "stage.hardware".to_owned()];
        reader.check(&keys.each_ref().map(String::as_str), drifts, || {
            format!(
                "{} is \"start\", but {} is true: limits of {min} to {max} {unit} would count anew \
                 from where each command begins. Give the counts at which the axis reads 0 \
                 (`needle-bench stage status`), with {} = \"homing\" where they are lost at power-off",
                keys[0],
                keys[2],
                format_args!("stage.{axis}.reference")
            )
        });
    }
}

/// An axis that was homed stands at home, from which the drive's zero is a home offset (607C) away.
fn home_inside(config: &Config, reader: &mut Reader) {
    let (insertion, rotation) = (&config.stage.insertion, &config.stage.rotation);
    let (per_mm, per_turn) = (insertion.counts_per_mm, rotation.counts_per_turn);
    let counts_per_mm = f64::from(per_mm.counts) / f64::from(per_mm.mm);
    let counts_per_deg = f64::from(per_turn.counts) / f64::from(per_turn.turns) / 360.0;
    let axes = [
        (
            ("insertion", "mm", &insertion.drive, counts_per_mm),
            insertion.homing.as_ref().and_then(|homing| homing.offset_mm),
            [insertion.min_mm, insertion.max_mm],
        ),
        (
            ("rotation", "deg", &rotation.drive, counts_per_deg),
            rotation.homing.as_ref().and_then(|homing| homing.offset_deg),
            [rotation.min_deg, rotation.max_deg],
        ),
    ];
    for ((axis, unit, drive, counts_per_unit), offset, [min, max]) in axes {
        let (Some(offset), Some(zero)) = (offset, drive.zero) else { continue };
        let home = -offset - f64::from(drive.sign) * f64::from(zero) / counts_per_unit;
        let outside = !(min..=max).contains(&home);
        let section = format!("stage.{axis}");
        let (low, high) = (format!("{section}.min_{unit}"), format!("{section}.max_{unit}"));
        let (key, zero_key) =
            (format!("{section}.homing.offset_{unit}"), format!("{section}.zero"));
        reader.check(&[&low, &high, &zero_key, &key], outside, || {
            format!(
                "{key} is {offset}, which puts home at {home:.3} {unit} with {zero_key} = {zero}, \
                 allowed: {low} to {high}, which are {min} and {max}"
            )
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

    /// Three jogs of 15° by limits of 20° that count from each jog's start would end at 45°.
    #[test]
    fn limits_of_a_real_axis_need_a_zero_that_stays() {
        let rig = include_str!("../../bench-config/rig-epos4.toml");
        let load = |sets: &[&str]| {
            let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
            Config::from_sources(&[Source { name: "rig.toml", text: rig }], &sets)
        };
        let absolute = "stage.rotation.reference=absolute";
        let said = load(&[absolute, "stage.rotation.zero=start"]).expect_err("refused").to_string();
        assert!(
            said.starts_with(
                "--set stage.rotation.zero is \"start\", but stage.hardware is true: limits of -720 \
                 to 720 deg would count anew"
            ),
            "{said}"
        );
        assert!(load(&[absolute, "stage.rotation.zero=-1234"]).is_ok());
        assert!(
            load(&[absolute, "stage.rotation.zero=start", "stage.rotation.wraps=true"]).is_ok()
        );
    }

    #[test]
    fn home_is_inside_the_limits_where_that_can_be_known() {
        assert_eq!(
            refusal("stage.insertion.homing.offset_mm = 5"),
            "bench.toml:1: stage.insertion.homing.offset_mm is 5, which puts home at -5.000 mm with \
             stage.insertion.zero = 0, allowed: stage.insertion.min_mm to stage.insertion.max_mm, \
             which are -1 and 310"
        );
        let text = "stage.insertion.homing.offset_mm = 5\nstage.insertion.zero = -23230\n";
        let source = Source { name: "bench.toml", text };
        assert!(Config::from_sources(&[source], &[]).is_ok(), "the axis reads 0 there");
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
