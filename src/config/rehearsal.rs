//! A rehearsal: the emulator's settings when the configuration is for a real rig.
//!
//! The drives get the make, the objects, the switches and the start position that the rig's configuration
//! implies. The needle is the bench's own model of it, and the tracker has the noise that the gates expect.
//! Keys under `[emulator]` that are given override all this.

use super::{Config, TrackerPreset};
use crate::emulator::drive::Switches;
use crate::geometry::coordinates;
use crate::stage::AxisConfig;
use crate::tracker::TrackerKind;
use serde_json::{Value, json};

/// Vendor ID of maxon motor, whose drives are emulated as an EPOS4.
const MAXON_VENDOR_ID: u32 = 0xFB;
/// The start is off the plane by this fraction of depth² · curvature, which half of the depth suffices to correct.
const START_PART: f64 = 1.0 / 16.0;
/// The start is at most this far off the plane, mm.
const START_MAX_MM: f64 = 5.0;

/// True if a rehearsal derives this key of `[emulator]`, or its alternative.
pub(super) fn derives(key: &str, config: &Config) -> bool {
    let key = if key == "radius_mm" { "curvature_per_mm" } else { key };
    derived(config).get(key).is_some()
}

/// The keys of `[emulator]` that a rehearsal derives from the rest of `config`, as TOML.
///
/// # Errors
/// None for a configuration that was read.
pub(super) fn layer(config: &Config) -> Result<String, toml::ser::Error> {
    toml::to_string(&json!({ "emulator": derived(config) }))
}

fn derived(config: &Config) -> Value {
    let (needle, tracker) = (&config.needle, &config.tracker);
    let curvature = needle.arc.curvature_per_mm();
    let depth_mm = config.insertion.depth_mm;
    let start_mm = (depth_mm * depth_mm * curvature * START_PART).min(START_MAX_MM);
    let [x, y, z, angles @ ..] = coordinates(&tracker.x_sb().inverse());
    let [yaw, pitch, roll] = angles.map(f64::to_degrees);
    let maxon = Some(MAXON_VENDOR_ID);
    let is_epos4 =
        config.stage.insertion.vendor_id == maxon || config.stage.rotation.vendor_id == maxon;
    let mut emulator = json!({
        "drives": if is_epos4 { "epos4" } else { "generic" },
        "homed": true,
        "curvature_per_mm": curvature,
        "tip_ahead_mm": needle.tip_ahead_mm,
        // Both sections have the same keys.
        "torsion": config.value_at("needle.torsion"),
        "start": { "x_mm": start_mm, "yaw_deg": 1.0, "pitch_deg": 1.0 },
        "sensor": {
            "x_mm": x, "y_mm": y, "z_mm": z, "yaw_deg": yaw, "pitch_deg": pitch, "roll_deg": roll,
        },
    });
    if config.emulator.tracker == TrackerPreset::Plain {
        emulator["noise"] = json!({ "sd_mm": tracker.to_track().noise_sd_mm });
        emulator["tracker_latency_ms"] = json!(tracker.latency.as_secs_f64() * 1e3);
        emulator["tracker_repeats"] = json!(u32::from(tracker.kind == TrackerKind::Imaging));
    }
    emulator
}

/// The switches of an axis with `counts_per_unit` counts per mm or rad: those `given`, and the switch that its
/// homing seeks, placed so that homing changes no position.
pub(super) fn switches(given: Switches, axis: &AxisConfig, counts_per_unit: f64) -> Switches {
    let Some(homing) = axis.homing else { return given };
    // The drive's zero is at home plus the offset; the drive now reads 0.
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
