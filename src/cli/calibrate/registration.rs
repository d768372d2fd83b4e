//! `needle-bench calibrate registration`: the tracker's pose on the bench from fiducials.

use super::collect::collect;
use super::{Output, angles, fit as fit_of};
use crate::calibration::{FiducialPair, RegistrationFit};
use crate::cli::Failure;
use crate::cli::output::number_in;
use crate::cli::sources::{Configured, text_of};
use crate::config::RegistrationConfig;
use clap::Args;
use minijinja::context;
use serde_json::json;
use std::path::PathBuf;
use std::process::ExitCode;

/// The comment above the result.
const HEADER: &str = "\
# Pose of the tracker frame in the bench frame, by `needle-bench calibrate registration`. In the
# rig's configuration, under [tracker]: registration_file = \"FILE\"
# sd_mm: of each coordinate, that the pose's error gives a tip on the planned path.

";

#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Points known in both frames: CSV with x_tracker_mm,y_tracker_mm,z_tracker_mm,x_bench_mm,
    /// y_bench_mm,z_bench_mm.
    file: PathBuf,
    #[command(flatten)]
    configured: Configured,
    /// Collect the points into FILE first, which is new: touch each with the tracked tool and type its
    /// place on the bench.
    #[arg(long)]
    collect: bool,
    /// Refuse more than this between the two sets of points, RMS, mm.
    #[arg(long, value_name = "MM", default_value_t = RegistrationConfig::rms_max_mm(), value_parser = number_in(0.001..=100.0, "mm"))]
    rms_max_mm: f64,
    #[command(flatten)]
    pub(super) output: Output,
}

pub(super) fn calibrate(arguments: &Arguments) -> Result<ExitCode, Failure> {
    let path = &arguments.file;
    let refused = |error: &dyn std::fmt::Display| Failure::in_file(path, error);
    let config = arguments.configured.load(None)?;
    if arguments.collect {
        collect(path, &arguments.configured)?;
    }
    let text = text_of(path)?;
    let pairs = FiducialPair::parse(&text).map_err(|error| refused(&error))?;
    let fit = RegistrationFit::of(&pairs, arguments.rms_max_mm).map_err(|error| refused(&error))?;
    let sd_mm = config.registration_sd_of_mm(&fit);
    let mut registration = angles(&fit.x_wt.rotation);
    let [x_mm, y_mm, z_mm]: [f64; 3] = fit.x_wt.translation.into();
    for (key, value) in [("x_mm", x_mm), ("y_mm", y_mm), ("z_mm", z_mm), ("sd_mm", sd_mm)] {
        registration[key] = json!(value);
    }
    registration["fit"] = fit_of(
        path,
        &text,
        [
            ("points", json!(fit.points)),
            ("rms_mm", json!(fit.rms_mm)),
            ("spread_mm", json!(fit.spread_mm)),
        ],
    );
    let json = json!({
        "registration": registration,
        "worst_point": fit.worst_point,
        "worst_mm": fit.worst_mm,
        "localisation_error_mm": fit.localisation_error_mm(),
    });
    let overlay = json!({ "tracker": { "registration": registration } });
    let summary = include_str!("registration.txt");
    let more = context! { rms_max_mm => arguments.rms_max_mm };
    arguments.output.give((summary, more), HEADER, &overlay, &json)
}
