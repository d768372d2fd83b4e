//! A rehearsal: the emulator's settings when the configuration is that of a real rig.
//!
//! The drives get the make, the objects, the switches and the start position that the rig's configuration
//! implies. The needle is the bench's own model of it, and the tracker has the noise that the gates expect.
//! Keys under `[emulator]` that are given override all this.

use super::{Config, TrackerPreset};
use crate::emulator::drive::Switches;
use crate::geometry::coordinates;
use crate::stage::AxisConfig;
use crate::tracker::TrackerKind;
use std::fmt::Write as _;

/// maxon motor; a drive of this vendor is emulated as an EPOS4.
const MAXON_VENDOR_ID: u32 = 0xFB;
/// The start is off the plane by this part of depth² · curvature; half of the depth suffices to correct that.
const START_PART: f64 = 1.0 / 16.0;
/// The start is at most this far off the plane, mm.
const START_MAX_MM: f64 = 5.0;

/// The keys of `[emulator]` that a rehearsal derives from the rest of `config`, as TOML.
pub(super) fn layer(config: &Config) -> String {
    let (needle, tracker) = (&config.needle, &config.tracker);
    let curvature = needle.arc.curvature_per_mm();
    let depth_mm = config.insertion.depth_mm;
    let start_mm = (depth_mm * depth_mm * curvature * START_PART).min(START_MAX_MM);
    let [x, y, z, angles @ ..] = coordinates(&tracker.x_sb().inverse());
    let [yaw, pitch, roll] = angles.map(f64::to_degrees);
    let maxon = Some(MAXON_VENDOR_ID);
    let is_epos4 =
        config.stage.insertion.vendor_id == maxon || config.stage.rotation.vendor_id == maxon;
    let drives = if is_epos4 { "epos4" } else { "generic" };
    // Both sections have the same keys.
    let torsion = config.value_at("needle.torsion").map(ToString::to_string).unwrap_or_default();
    let mut keys = format!(
        "[emulator]\n\
         drives = \"{drives}\"\n\
         homed = true\n\
         curvature_per_mm = {curvature:?}\n\
         tip_ahead_mm = {:?}\n\
         torsion = {torsion}\n\
         start = {{ x_mm = {start_mm:?}, yaw_deg = 1.0, pitch_deg = 1.0 }}\n\
         sensor = {{ x_mm = {x:?}, y_mm = {y:?}, z_mm = {z:?}, yaw_deg = {yaw:?}, \
         pitch_deg = {pitch:?}, roll_deg = {roll:?} }}\n",
        needle.tip_ahead_mm,
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

/// The switches of an axis with `counts_per_unit` counts per mm or rad: those `given`, and the switch that its
/// homing seeks, placed so that homing changes no position.
pub(super) fn switches(given: Switches, axis: &AxisConfig, counts_per_unit: f64) -> Switches {
    let Some(homing) = axis.homing else { return given };
    // The drive's zero is at home plus the offset; the drive reads 0 now.
    let home = -(homing.offset.unwrap_or(0.0) * counts_per_unit).round() as i64;
    let mut switches = given;
    match homing.method {
        1 | 17 => switches.negative_counts.get_or_insert(home - 1),
        2 | 18 => switches.positive_counts.get_or_insert(home + 1),
        24 => switches.home_counts.get_or_insert(home),
        _ => return given,
    };
    switches
}
