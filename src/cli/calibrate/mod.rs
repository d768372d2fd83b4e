//! `needle-bench calibrate`: from recordings of the rig to numbers for its configuration.
//!
//! A calibration prints a summary on stderr and TOML on stdout or into a file. The TOML names its
//! source and date. A recording that does not determine the result is refused.

mod collect;
mod needle;
mod registration;
mod tip;
pub(super) mod tracker;
mod turn;

use super::Failure;
use super::output::{say, tell, write_new};
use crate::archive::sha256_hex;
use crate::geometry::FixedAngles;
use crate::telemetry::utc_text;
use crate::text::screen;
use clap::{Args, Subcommand};
use minijinja::Value as Shown;
use nalgebra::Rotation3;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::SystemTime;

#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(subcommand)]
    calibration: Calibration,
}

#[derive(Debug, Subcommand)]
enum Calibration {
    /// The needle on its sensor: curvature, bevel zero, sensor tilt, torsion, from recorded
    /// insertions.
    #[command(
        after_help = "Examples:\n  needle-bench calibrate needle runs/20261121T1* --out needle.toml"
    )]
    Needle(needle::Arguments),
    /// The tracker's pose on the bench, from points known in both frames.
    #[command(
        after_help = "Examples:\n  needle-bench calibrate registration points.csv my-rig.toml --collect --out registration.toml"
    )]
    Registration(registration::Arguments),
    /// The tip's offset and tilt on the sensor, from a recording in which only the base turns.
    #[command(
        after_help = "Examples:\n  needle-bench calibrate tip turn.csv my-rig.toml --run --along-mm 7 --out tip.toml"
    )]
    Tip(tip::Arguments),
    /// The noise of the tracker, its drift, rate, outliers, dropouts and latency jitter, from a
    /// recording at rest.
    #[command(after_help = "Examples:\n  needle-bench calibrate tracker rest.csv --out noise.toml")]
    Tracker(tracker::Arguments),
}

/// Where a calibration's result goes.
#[derive(Debug, Args)]
pub(super) struct Output {
    /// Write the result to FILE, which must not exist; by default the TOML goes to stdout.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// One JSON object on stdout.
    #[arg(long)]
    pub(super) json: bool,
}

pub(super) fn calibrate(arguments: &Arguments) -> Result<ExitCode, Failure> {
    match &arguments.calibration {
        Calibration::Needle(arguments) => needle::calibrate(arguments),
        Calibration::Registration(arguments) => registration::calibrate(arguments),
        Calibration::Tip(arguments) => tip::calibrate(arguments),
        Calibration::Tracker(arguments) => tracker::calibrate(arguments),
    }
}

impl Output {
    /// Writes the result: the operator's `summary`, a template for the values of `json` and `more`;
    /// `overlay` as TOML below the comment `header` for the configuration; `json` for programs.
    fn give(
        &self,
        summary: (&str, Shown),
        header: &str,
        overlay: &Value,
        json: &Value,
    ) -> Result<ExitCode, Failure> {
        let toml = toml::to_string(overlay).map_err(Failure::environment)?;
        self.give_toml(summary, &format!("{header}{toml}"), json)
    }

    /// The same, with the `toml` at hand.
    fn give_toml(
        &self,
        (summary, more): (&str, Shown),
        toml: &str,
        json: &Value,
    ) -> Result<ExitCode, Failure> {
        tell(screen(summary, json, more).map_err(Failure::environment)?);
        if let Some(path) = &self.out {
            write_new(path, toml)?;
        }
        if self.json {
            say(json)?;
        } else if self.out.is_none() {
            say(toml.trim_end())?;
        }
        Ok(ExitCode::SUCCESS)
    }
}

/// What a calibration says of itself: where it came from, computed now from `text`, the content of
/// `path`, and what it `found`.
fn fit<const N: usize>(path: &Path, text: &str, found: [(&str, Value); N]) -> Value {
    let mut fit = json!({
        "file": path.display().to_string(),
        "sha256": sha256_hex(text.as_bytes()),
        "version": env!("CARGO_PKG_VERSION"),
        "date_utc": utc_text(SystemTime::now()),
    });
    for (key, value) in found {
        fit[key] = value;
    }
    fit
}

/// An orientation as a configuration has it.
fn angles(rotation: &Rotation3<f64>) -> Value {
    let FixedAngles { yaw, pitch, roll } = FixedAngles::from_rotation(rotation);
    json!({
        "yaw_deg": yaw.to_degrees(),
        "pitch_deg": pitch.to_degrees(),
        "roll_deg": roll.to_degrees(),
    })
}
