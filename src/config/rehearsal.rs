//! A rehearsal: the emulator's settings when the configuration is that of a real rig.
//!
//! The drives get the make, the objects, the switches and the start that the file implies, the needle is
//! the one that the bench believes in, and the tracker has the noise that the gates expect. Everything
//! under `[emulator]` that is given still counts.

use super::{Config, TrackerPreset};
use crate::emulator::drive::Switches;
use crate::geometry::FixedAngles;
use crate::stage::AxisConfig;
use crate::tracker::TrackerKind;
use std::fmt::Write as _;

/// maxon, whose drives are EPOS4s here.
const MAXON_VENDOR_ID: u32 = 0xFB;
/// The start is off the plane by this part of depth² · curvature, which half of the depth can mend.
const START_PART: f64 = 1.0 / 16.0;
/// And never further than this, mm.
const START_MAX_MM: f64 = 5.0;

/// The keys of `[emulator]` that follow from the rest of `config`, as TOML.
pub(super) fn layer(config: &Config) -> String {
    let (needle, tracker) = (&config.needle, &config.tracker);
    let curvature = needle.arc.curvature_per_mm();
    let depth_mm = config.insertion.depth_mm;
    let start_mm = (depth_mm * depth_mm * curvature * START_PART).min(START_MAX_MM);
    let x_bs = tracker.x_sb().inverse();
    let FixedAngles { yaw, pitch, roll } = FixedAngles::from_rotation(&x_bs.rotation);
    let maxon = Some(MAXON_VENDOR_ID);
    let is_epos4 =
        config.stage.insertion.vendor_id == maxon || config.stage.rotation.vendor_id == maxon;
    let drives = if is_epos4 { "epos4" } else { "generic" };
    // With the same keys in both sections.
    let torsion = config.at("needle.torsion").map(ToString::to_string).unwrap_or_default();
    let mut keys = format!(
        "[emulator]\n\
         drives = \"{drives}\"\n\
         homed = true\n\
         curvature_per_mm = {curvature:?}\n\
         tip_ahead_mm = {:?}\n\
         torsion = {torsion}\n\
         start = {{ x_mm = {start_mm:?}, y_mm = 0.0, z_mm = 0.0, yaw_deg = 1.0, pitch_deg = 1.0, \
         roll_deg = 30.0 }}\n\
         sensor = {{ x_mm = {:?}, y_mm = {:?}, z_mm = {:?}, yaw_deg = {:?}, pitch_deg = {:?}, \
         roll_deg = {:?} }}\n",
        needle.tip_ahead_mm,
        x_bs.translation.x,
        x_bs.translation.y,
        x_bs.translation.z,
        yaw.to_degrees(),
        pitch.to_degrees(),
        roll.to_degrees(),
    );
    if config.emulator.tracker == TrackerPreset::Plain {
        let repeats = u32::from(tracker.kind == TrackerKind::Imaging);
        let sd_mm = tracker.to_track().noise_sd_mm;
        let latency_ms = tracker.latency.as_secs_f64() * 1e3;
        // Writing to a string cannot fail.
        let _ = writeln!(
            keys,
            "noise = {{ sd_mm = {sd_mm:?} }}\n\
             tracker_latency_ms = {latency_ms:?}\n\
             tracker_repeats = {repeats}"
        );
    }
    keys
}

/// The switches of an axis that has `counts_per_unit` of mm or rad: those `given`, and if its homing seeks
/// another one, that one at the place where homing changes no position.
pub(super) fn switches(given: Switches, axis: &AxisConfig, counts_per_unit: f64) -> Switches {
    let Some(homing) = axis.homing else { return given };
    // From home the drive's zero is by the offset, and it is 0 now.
    let home = -(homing.offset.unwrap_or(0.0) * counts_per_unit).round() as i64;
    let sought = match homing.method {
        1 | 17 => Switches { negative_counts: Some(home - 1), ..Switches::default() },
        2 | 18 => Switches { positive_counts: Some(home + 1), ..Switches::default() },
        24 => Switches { home_counts: Some(home), ..Switches::default() },
        _ => Switches::default(),
    };
    Switches {
        negative_counts: given.negative_counts.or(sought.negative_counts),
        positive_counts: given.positive_counts.or(sought.positive_counts),
        home_counts: given.home_counts.or(sought.home_counts),
    }
}
