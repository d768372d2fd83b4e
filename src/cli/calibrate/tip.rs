//! `needle-bench calibrate tip`: the tip's offset and tilt on the sensor, from the sensor's circle
//! while the base turns.

use super::turn::turn;
use super::{Output, angles, fit as fit_of};
use crate::calibration::{TipFit, TurnSample};
use crate::cli::Failure;
use crate::cli::output::number_in;
use crate::cli::sources::{Configured, text_of};
use clap::Args;
use minijinja::context;
use serde_json::json;
use std::path::PathBuf;
use std::process::ExitCode;

/// A good tracker's positions are nearer to their circle, mm.
const RMS_MAX_MM: f64 = 0.5;
/// The comment above the result.
const HEADER: &str = "\
# The tip in the sensor's frame, by `needle-bench calibrate tip`. In the rig's configuration, under
# [tracker]: tip_file = \"FILE\"
";
const NO_MOUNT: &str = "\
# The tracker sends no orientation that turns with the needle: the sensor's distance from the
# needle's axis cannot be taken off, and is left in the positions.
";

#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// The sensor while the base turns and the insertion rests: CSV with
    /// rotation_rad,x_mm,y_mm,z_mm and, if the tracker gives it, qw,qx,qy,qz.
    file: PathBuf,
    #[command(flatten)]
    configured: Configured,
    /// Record FILE first, which is new: the stage of CONFIG turns the base once, in air, and back.
    #[arg(long)]
    run: bool,
    /// With --run: rehearse it on emulated drives and an emulated tracker, in virtual time.
    #[arg(long, requires = "run")]
    rehearse: bool,
    /// Distance of the tip ahead of the sensor along the needle, mm.
    #[arg(long, value_name = "MM", default_value_t = 0.0, allow_negative_numbers = true,
          value_parser = number_in(-500.0..=500.0, "mm"))]
    along_mm: f64,
    /// Refuse positions with a larger RMS distance from a circle than this, mm; by default 0.5, and
    /// with --run twice tracker.gates.noise_sd_mm where that is more.
    #[arg(long, value_name = "MM", value_parser = number_in(0.001..=100.0, "mm"))]
    rms_max_mm: Option<f64>,
    #[command(flatten)]
    pub(super) output: Output,
}

pub(super) fn calibrate(arguments: &Arguments) -> Result<ExitCode, Failure> {
    let path = &arguments.file;
    let refused = |error: &dyn std::fmt::Display| Failure::in_file(path, error);
    let mut rms_max_mm = RMS_MAX_MM;
    if arguments.run {
        match turn(path, &arguments.configured, arguments.rehearse)? {
            Ok(noise_sd_mm) => rms_max_mm = rms_max_mm.max(2.0 * noise_sd_mm),
            Err(status) => return Ok(ExitCode::from(status)),
        }
    }
    let rms_max_mm = arguments.rms_max_mm.unwrap_or(rms_max_mm);
    let text = text_of(path)?;
    let samples = TurnSample::parse(&text).map_err(|error| refused(&error))?;
    let fit = TipFit::of(&samples, rms_max_mm).map_err(|error| refused(&error))?;
    let oriented = samples.iter().all(|sample| sample.orientation_meas.is_some());
    if arguments.along_mm != 0.0 && !oriented {
        return Err(refused(
            &"--along-mm needs the sensor's orientation: record qw,qx,qy,qz, or leave it out",
        ));
    }
    let x_sb = fit.x_sb(arguments.along_mm);
    let tracker = json!({
        "tip_offset_mm": <[f64; 3]>::from(x_sb.translation),
        "tip_tilt": angles(&x_sb.rotation),
        "tip_fit": fit_of(path, &text, [
            ("points", json!(fit.points)),
            ("radius_mm", json!(fit.radius_mm)),
            ("rms_mm", json!(fit.rms_mm)),
        ]),
    });
    let json = json!({
        "tracker": tracker,
        "axis_tracker": <[f64; 3]>::from(fit.axis),
        "centre_tracker_mm": <[f64; 3]>::from(fit.centre_mm),
        "arc_deg": fit.arc_rad.to_degrees(),
        "has_mount": fit.mount.is_some(),
    });
    let note = if fit.mount.is_some() { "" } else { NO_MOUNT };
    let header = format!("{HEADER}{note}\n");
    let more = context! {
        rms_max_mm,
        tilt_deg => fit.mount.map(|mount| mount.axis.z.clamp(-1.0, 1.0).acos().to_degrees()),
    };
    let (summary, overlay) = (include_str!("tip.txt"), json!({ "tracker": tracker }));
    arguments.output.give((summary, more), &header, &overlay, &json)
}
