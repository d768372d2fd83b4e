//! `needle-bench calibrate needle`: curvature, bevel zero, sensor tilt and torsion from insertions.

use super::{Output, fit as fit_of};
use crate::calibration::{NeedleFit, PosedRow};
use crate::cli::Failure;
use crate::cli::evaluate::RECORDINGS_TOML;
use crate::cli::insertions::insertions;
use crate::cli::sources::{configuration_among, load};
use crate::needle::TorsionConfig;
use crate::study::Recording;
use clap::Args;
use minijinja::context;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// The comment above the result.
const HEADER: &str = "\
# A needle on its sensor, by `needle-bench calibrate needle`. In the rig's configuration, under
# [needle]: needle_file = \"FILE\"
# [needle.fit] says how sure they are: standard errors, from how the insertions differ.

";

#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Recorded insertions with orientations: run folders, or CSV with insertion_mm,rotation_rad,
    /// x_mm,y_mm,z_mm,qw,qx,qy,qz; at least three. A TOML file among them is the configuration.
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Configuration of the rig: the noises under [observer.invariant] weight the positions. By
    /// default bench-config/recordings.toml.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Set a key of the configuration, for example 'observer.invariant.position_sd_mm=0.2'.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    #[command(flatten)]
    pub(super) output: Output,
}

pub(super) fn calibrate(arguments: &Arguments) -> Result<ExitCode, Failure> {
    let (path, files) = configuration_among(&arguments.files, arguments.config.as_deref())?;
    let config = load(path, Some(RECORDINGS_TOML), &arguments.set)?;
    let (mut posed_rows, mut texts) = (Vec::new(), String::new());
    for (path, (text, recording)) in files.iter().zip(insertions(&files)?) {
        posed_rows.push(posed(path, &recording)?);
        texts.push_str(&text);
    }
    let fit = NeedleFit::of(&posed_rows, &config.path_noise()).map_err(Failure::configuration)?;
    let fitted = fit_of(
        &named(&files),
        &texts,
        [
            ("insertions", json!(fit.insertions)),
            ("roll_rms_deg", json!(fit.torsion.roll_rms_rad.to_degrees())),
            ("curvature_sd_per_mm", json!(fit.bend.curvature_sd_per_mm)),
            ("tip_ahead_sd_mm", json!(fit.bend.tip_ahead_sd_mm)),
            ("bend_axis_sd_deg", json!(fit.bend.bend_axis_sd_rad.to_degrees())),
            ("offset_spread_deg", json!(fit.torsion.offset_spread_rad.to_degrees())),
            ("torsion_sd", written(&fit.torsion.sd)),
        ],
    );
    let overlay = json!({
        "needle": {
            "curvature_per_mm": fit.bend.curvature_per_mm,
            "tip_ahead_mm": fit.bend.tip_ahead_mm,
            "torsion": written(&fit.torsion.torsion),
            "fit": fitted,
        },
        "evaluation": {
            "axis": <[f64; 3]>::from(fit.axis),
            "bend_axis": <[f64; 3]>::from(fit.bend.bend_axis),
        },
    });
    let summary = (include_str!("needle.txt"), context! {});
    arguments.output.give(summary, HEADER, &overlay, &overlay)
}

/// The rows of a recording; every row must have an orientation.
fn posed(path: &Path, recording: &Recording) -> Result<Vec<PosedRow>, Failure> {
    let posed = recording.rows.iter().map(|row| {
        Some(PosedRow {
            line: row.line,
            insertion_mm: row.insertion_meas_mm,
            rotation_rad: row.rotation_meas_rad,
            position_mm: row.position_meas_mm,
            orientation: row.rotation_true?,
        })
    });
    posed.collect::<Option<_>>().ok_or_else(|| {
        let lacks = "no columns qw,qx,qy,qz; a needle is calibrated from recorded orientations";
        Failure::in_file(path, lacks)
    })
}

/// The name for the files in the provenance.
fn named(files: &[PathBuf]) -> PathBuf {
    match files {
        [only] => only.clone(),
        [first, rest @ ..] => format!("{} and {} more", first.display(), rest.len()).into(),
        [] => PathBuf::new(),
    }
}

/// A torsion as a configuration has it.
fn written(torsion: &TorsionConfig) -> Value {
    json!({
        "half_width_deg": torsion.half_width_rad.to_degrees(),
        "half_width_deg_per_mm": torsion.half_width_rad_per_mm.to_degrees(),
        "offset_deg": torsion.offset_rad.to_degrees(),
        "creep_mm": torsion.creep_mm,
        "creep_mm_per_mm": torsion.creep_mm_per_mm,
    })
}
