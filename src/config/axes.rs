//! Contradictions within `[stage]`, of what an axis and its operations are told.

use std::time::Duration;

use super::Config;
use super::reader::Reader;
use crate::session::{PROFILE_PEAK, rotation_peak};
use crate::stage::Reference;

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
    accelerations(config, reader);
}

/// What is commanded is under what each axis may be commanded: a run is not to end by a limit that it
/// was bound to break.
fn accelerations(config: &Config, reader: &mut Reader) {
    let (insertion, rotation) = (&config.stage.insertion, &config.stage.rotation);
    let along =
        ("stage.insertion.acceleration_max_mm_per_s2", insertion.acceleration_max_mm_per_s2);
    let about =
        ("stage.rotation.acceleration_max_deg_per_s2", rotation.acceleration_max_deg_per_s2);
    let profiles = [
        ("insertion.acceleration_mm_per_s2", config.insertion.acceleration_mm_per_s2, along),
        ("stage.insertion.jog_acceleration_mm_per_s2", insertion.jog_acceleration_mm_per_s2, along),
        ("stage.rotation.jog_acceleration_deg_per_s2", rotation.jog_acceleration_deg_per_s2, about),
    ];
    for (key, acceleration, (max_key, max)) in profiles {
        let Some(max) = max else { continue };
        reader.check(&[key, max_key], PROFILE_PEAK * acceleration > max, || {
            format!(
                "{key} is {acceleration}, allowed: up to {:.3}: the last set-point brakes {PROFILE_PEAK} \
                 times as hard, and {max_key} is {max}",
                max / PROFILE_PEAK
            )
        });
    }
    let (max_key, Some(max)) = about else { return };
    let (_, key) = config.control.rotation_max_rad_per_mm();
    let per_mm = config.number(key);
    let (speed, sync_ms) = (config.insertion.speed_mm_per_s, config.can.sync_ms);
    let peak = rotation_peak(per_mm, speed, Duration::from_millis(sync_ms.into()));
    let keys = [key, "insertion.speed_mm_per_s", "can.sync_ms", max_key];
    reader.check(&keys, peak > max, || {
        format!(
            "{key} is {per_mm}: reversed within a SYNC at {speed} mm/s, that is {peak:.0} deg/s², \
             over {max_key} = {max}; raise it, or turn or insert more slowly"
        )
    });
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
                "{} is \"start\": its limits of {min} to {max} {unit} would count anew from each start; \
                 give the counts at 0 {unit} (stage status), and {} = \"homing\" if power-off loses them",
                keys[0],
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
                "--set stage.rotation.zero is \"start\": its limits of -720 to 720 deg would count anew \
                 from each start"
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
    }

    /// Each with both keys and both numbers; at the bound itself nothing is refused.
    #[test]
    fn accelerations_keep_to_the_axis_limits() {
        let braking = "tracker.hold_braking_mm_per_s2 = 10\ntracker.hold_after_mm = 2\n";
        let along =
            |max: f64| format!("{braking}stage.insertion.acceleration_max_mm_per_s2 = {max:?}\n");
        let peak = |key: &str, max: &str, unit: &str, axis: &str| {
            format!(
                "bench.toml:3: {key} is 10, allowed: up to {max}: the last set-point brakes 1.125 times \
                 as hard, and stage.{axis}.acceleration_max_{unit}_per_s2 is 11.2"
            )
        };
        let said = refusal(&along(11.2));
        assert_eq!(
            said.lines().collect::<Vec<_>>(),
            [
                peak("insertion.acceleration_mm_per_s2", "9.956", "mm", "insertion"),
                peak("stage.insertion.jog_acceleration_mm_per_s2", "9.956", "mm", "insertion"),
            ]
        );
        assert_eq!(
            refusal("stage.insertion.acceleration_max_mm_per_s2 = 39"),
            "bench.toml:1: tracker.hold_braking_mm_per_s2 is 40, allowed: up to \
             stage.insertion.acceleration_max_mm_per_s2, which is 39"
        );
        let about = |max: f64| format!("stage.rotation.acceleration_max_deg_per_s2 = {max:?}\n");
        assert_eq!(
            refusal(&about(3600.0)),
            "bench.toml:1: control.nested_saturation.rotation_max_deg_per_mm is 60: reversed within a \
             SYNC at 2 mm/s, that is 24000 deg/s², over stage.rotation.acceleration_max_deg_per_s2 = \
             3600; raise it, or turn or insert more slowly"
        );
        let jog = about(24_000.0) + "stage.rotation.jog_acceleration_deg_per_s2 = 22000\n";
        assert_eq!(
            refusal(&jog),
            "bench.toml:1: stage.rotation.jog_acceleration_deg_per_s2 is 22000, allowed: up to \
             21333.333: the last set-point brakes 1.125 times as hard, and \
             stage.rotation.acceleration_max_deg_per_s2 is 24000"
        );
        for text in [along(11.25), about(24_000.0)] {
            let source = Source { name: "bench.toml", text: &text };
            Config::from_sources(&[source], &[]).unwrap_or_else(|error| panic!("{error}"));
        }
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
        let insertion = stage.insertion.homing.expect("homing");
        assert_eq!((insertion.method, insertion.speed_zero), (33, None));
        assert_eq!(insertion.homed_bit, HomingConfig::ATTAINED_BIT);
        let rotation = stage.rotation.homing.expect("homing");
        assert_eq!((rotation.method, rotation.speed_zero), (37, Some(std::f64::consts::PI)));
    }
}
