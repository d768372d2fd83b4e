//! `needle-bench calibrate`: from recordings of the rig to numbers for its configuration.
//!
//! A calibration prints a summary on stderr and TOML on stdout or into a file. The TOML names its
//! source and date. A recording that does not determine the result is refused.

mod recordings;
pub(super) mod tracker;

use self::recordings::{collect_fiducials, record_turn};
use super::arguments::{Configured, number_in, text_of};
use super::output::{
    merged, print_result_despite, print_stderr, print_stdout, refuse_unwritable, write_new,
};
use super::records::{Insertion, Insertions};
use super::{Failure, Result};
use crate::archive::sha256_hex;
use crate::calibration::{FiducialPair, NeedleFit, PosedRow, RegistrationFit, TipFit, TurnSample};
use crate::config::RegistrationConfig;
use crate::geometry::FixedAngles;
use crate::study::{RecordedRoll, student_95};
use crate::telemetry::utc_text;
use crate::text::screen;
use clap::{Args, Subcommand};
use minijinja::{Value as Shown, context};
use nalgebra::Rotation3;
use serde_json::{Value, json};
use std::f64::consts::SQRT_2;
use std::path::PathBuf;
use std::time::SystemTime;

/// Default limit of the RMS distance from the circle, mm.
const RMS_MAX_MM: f64 = 0.5;
/// Positions that scatter about the circle by less than this share of what the tracker's noise predicts are not from
/// this tracker.
const SCATTER_PART_MIN: f64 = 0.25;

#[derive(Debug, Subcommand)]
pub(super) enum Calibration {
    /// The needle on its sensor: curvature, bevel zero, sensor tilt, torsion, from recorded
    /// insertions.
    Needle {
        #[command(flatten)]
        insertions: Insertions,
        #[command(flatten)]
        output: Output,
    },
    /// The tracker's pose on the bench, from points known in both frames.
    Registration(RegistrationArguments),
    /// The tip's offset and tilt on the sensor, from a recording in which only the base turns.
    Tip(TipArguments),
    /// The noise of the tracker, its drift, rate, outliers, dropouts and latency jitter, from a
    /// recording at rest.
    Tracker(tracker::Arguments),
}

#[derive(Debug, Args)]
pub(super) struct RegistrationArguments {
    /// Points known in both frames: CSV with x_tracker_mm,y_tracker_mm,z_tracker_mm,x_bench_mm,
    /// y_bench_mm,z_bench_mm.
    file: PathBuf,
    #[command(flatten)]
    configured: Configured,
    /// Collect the points first, into FILE, which must not exist: touch each with the tracked tool and type
    /// its bench coordinates.
    #[arg(long)]
    collect: bool,
    /// Refuse a larger RMS distance between the two sets of points than this, mm.
    #[arg(long, value_name = "MM", default_value_t = RegistrationConfig::rms_max_mm(), value_parser = number_in(0.001..=100.0, "mm"))]
    rms_max_mm: f64,
    #[command(flatten)]
    output: Output,
}

#[derive(Debug, Args)]
pub(super) struct TipArguments {
    /// The sensor while the base turns and the insertion rests: CSV with
    /// rotation_rad,x_mm,y_mm,z_mm and, if the tracker gives it, qw,qx,qy,qz.
    file: PathBuf,
    #[command(flatten)]
    configured: Configured,
    /// Record first, into FILE, which must not exist: the stage of CONFIG turns the base once, in air, and
    /// back.
    #[arg(long)]
    run: bool,
    /// With --run: rehearse it on emulated drives and an emulated tracker, in virtual time. FILE is not written,
    /// and --out is refused: the result is not that of the rig.
    #[arg(long, requires = "run")]
    rehearse: bool,
    /// Distance of the tip ahead of the sensor along the needle, mm; without it they are taken to be level.
    #[arg(long, value_name = "MM", allow_negative_numbers = true, value_parser = number_in(-500.0..=500.0, "mm"))]
    along_mm: Option<f64>,
    /// Refuse positions with a larger RMS distance from a circle than this, mm; by default 0.5, and
    /// with CONFIG or --run twice tracker.gates.noise_sd_mm where that is more.
    #[arg(long, value_name = "MM", value_parser = number_in(0.001..=100.0, "mm"))]
    rms_max_mm: Option<f64>,
    #[command(flatten)]
    output: Output,
}

/// Where a calibration's result goes.
#[derive(Debug, Args)]
pub(super) struct Output {
    /// Write the result to FILE, which must not exist; by default the TOML goes to stdout.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// One JSON object on stdout.
    #[arg(long)]
    json: bool,
}

pub(super) fn calibrate(calibration: &Calibration) -> Result<()> {
    match calibration {
        Calibration::Needle { insertions, output } => needle(insertions, output),
        Calibration::Registration(arguments) => registration(arguments),
        Calibration::Tip(arguments) => tip(arguments),
        Calibration::Tracker(arguments) => tracker::calibrate(arguments),
    }
}

impl Output {
    /// Refuses a file that exists, or that cannot be written, before anything is measured.
    pub(super) fn refuse_unwritable(&self) -> Result<()> {
        refuse_unwritable(self.out.as_deref())
    }

    /// Writes the result: `json` for programs, and two templates for the values of `json` and `more`: the
    /// operator's `summary`, and `toml` for the configuration. A rehearsal has no TOML, since it could be taken for
    /// a calibration of the rig.
    fn write(&self, json: &Value, more: Shown, summary: &str, toml: Option<&str>) -> Result<()> {
        let show = |template| screen(template, json, more.clone()).map_err(Failure::environment);
        print_stderr(show(summary)?);
        let toml = toml.map(show).transpose()?;
        let written = match (&toml, &self.out) {
            (Some(toml), Some(path)) => write_new(path, &format!("{toml}\n")),
            _ => Ok(()),
        };
        if toml.is_none() {
            print_stderr(
                "rehearsal   emulated drives and tracker: no calibration of the rig, nothing is written",
            );
        }
        if self.json {
            return print_result_despite(written, true, json, || Ok(String::new()));
        }
        // A result that cannot be written to the file goes to stdout, so that it is not lost.
        match toml.filter(|_| self.out.is_none() || written.is_err()) {
            Some(toml) => print_stdout(toml).and(written),
            None => written,
        }
    }
}

fn to_toml(overlay: &Value) -> Result<String> {
    toml::to_string(overlay).map_err(Failure::environment)
}

/// The `fit` table: source file, SHA-256 of its `text`, version and date, with the fields of `found`. `text` is
/// `None` if the source is not a file.
fn fit_table(file: &str, text: Option<&str>, found: &Value) -> Value {
    let source = json!({
        "file": file,
        "sha256": text.map(|text| sha256_hex(text.as_bytes())),
        "version": env!("CARGO_PKG_VERSION"),
        "date_utc": utc_text(SystemTime::now()),
    });
    merged(source, found)
}

/// An orientation in the keys of the configuration.
fn angles_json(rotation: &Rotation3<f64>) -> Value {
    let FixedAngles { yaw, pitch, roll } = FixedAngles::from_rotation(rotation);
    json!({
        "yaw_deg": yaw.to_degrees(),
        "pitch_deg": pitch.to_degrees(),
        "roll_deg": roll.to_degrees(),
    })
}

/// Random walks of the path below both of these are far under those of recorded insertions of a real needle (0.9 mm and
/// 0.6 deg after 1 mm).
const AXIAL_USUAL_MM: f64 = 0.3;
const HEADING_USUAL_DEG: f64 = 0.2;

/// The tip's roll is usually no farther than this off the fitted torsion, RMS, deg: up to 7 in recorded insertions of
/// a real needle.
const ROLL_RMS_USUAL_DEG: f64 = 12.0;

/// Curvature, bevel zero, sensor tilt and torsion from insertions.
fn needle(insertions: &Insertions, output: &Output) -> Result<()> {
    output.refuse_unwritable()?;
    let (config, insertions) = insertions.read(None)?;
    if let Some(Insertion { path, .. }) = insertions.iter().find(|run| run.is_rehearsal) {
        let why = "a rehearsal, whose needle is emulated: calibrate from runs on the rig";
        return Err(Failure::bad_input(path, why));
    }
    let posed_rows = insertions.iter().map(posed_rows).collect::<Result<Vec<_>, _>>()?;
    check_roll(&insertions)?;
    let noise = config.path_noise();
    let (axial_mm, heading_deg) = (noise.axial_noise_mm, noise.heading_noise_rad.to_degrees());
    if !config.is_emulated() && axial_mm < AXIAL_USUAL_MM && heading_deg < HEADING_USUAL_DEG {
        print_stderr(format_args!(
            "warning: observer.invariant.noise has axial_mm = {axial_mm} and heading_deg = {heading_deg:.1}: tissue \
             disturbs the path more, so results and errors are off; see bench-config/recordings.toml",
        ));
    }
    let name = |index: usize| insertions[index].path.display().to_string();
    let fit = NeedleFit::of(&posed_rows, name, &noise);
    let fit = fit.map_err(Failure::configuration)?;
    let roll_rms_deg = fit.torsion.roll_rms_rad.to_degrees();
    if roll_rms_deg > ROLL_RMS_USUAL_DEG {
        print_stderr(format_args!(
            "warning: the tip's roll is {roll_rms_deg:.0} deg RMS off the fit (usual: up to {ROLL_RMS_USUAL_DEG:.0}): \
             is stage.rotation.counts_per_turn right, and does the shaft slip in its clamp?"
        ));
    }
    let mut file = insertions[0].path.display().to_string();
    if insertions.len() > 1 {
        file += &format!(" and {} more", insertions.len() - 1);
    }
    let text: String = insertions.iter().map(|insertion| insertion.text.as_str()).collect();
    let found = json!({
        "insertions": fit.insertions,
        "roll_rms_deg": roll_rms_deg,
        "curvature_sd_per_mm": fit.bend.curvature_sd_per_mm,
        "tip_ahead_sd_mm": fit.bend.tip_ahead_sd_mm,
        "bend_axis_sd_deg": fit.bend.bend_axis_sd_rad.to_degrees(),
        "offset_spread_deg": fit.torsion.offset_spread_rad.to_degrees(),
        "torsion_sd": Value::from_iter(fit.torsion.sd.in_keys()),
    });
    let overlay = json!({
        "needle": {
            "curvature_per_mm": fit.bend.curvature_per_mm,
            "tip_ahead_mm": fit.bend.tip_ahead_mm,
            "torsion": Value::from_iter(fit.torsion.torsion.in_keys()),
            "fit": fit_table(&file, Some(&text), &found),
        },
        "evaluation": {
            "axis": <[f64; 3]>::from(fit.axis),
            "bend_axis": <[f64; 3]>::from(fit.bend.bend_axis),
        },
    });
    let student_t = student_95(fit.insertions - 1);
    let more = context! { student_t, overlay => to_toml(&overlay)? };
    let toml = Some(include_str!("needle.toml"));
    output.write(&overlay, more, include_str!("needle.txt"), toml)
}

/// The rows of an insertion; every row must have an orientation.
fn posed_rows(Insertion { path, recording, .. }: &Insertion) -> Result<Vec<PosedRow>> {
    let rows = recording.rows.iter().map(|row| {
        Some(PosedRow {
            line: row.line,
            insertion_mm: row.insertion_meas_mm,
            rotation_rad: row.rotation_meas_rad,
            position_mm: row.position_meas_mm,
            orientation: row.sensor_orientation?,
        })
    });
    rows.collect::<Option<_>>().ok_or_else(|| {
        let why = "no columns qw,qx,qy,qz; a needle is calibrated from recorded orientations";
        Failure::bad_input(path, why)
    })
}

/// Refuses insertions whose orientations contain no roll: one that shows this, or all if none shows that they turn
/// with the base.
fn check_roll(insertions: &[Insertion]) -> Result<()> {
    let rolls = insertions.iter().map(|insertion| Some((insertion, insertion.recording.roll()?)));
    let rolls: Vec<_> = rolls.flatten().collect();
    let has_any_roll = rolls.iter().any(|(_, roll)| *roll == RecordedRoll::Turns);
    for (Insertion { path, .. }, roll) in rolls {
        let next = match roll {
            RecordedRoll::DoesNotTurn => {
                "a needle is calibrated from those of a sensor of six degrees of freedom"
            }
            RecordedRoll::Unknown { .. } if !has_any_roll => {
                "turn the base by more while inserting"
            }
            RecordedRoll::Otherwise { .. } => return Err(Failure::bad_input(path, roll)),
            _ => continue,
        };
        return Err(Failure::bad_input(path, format_args!("{roll}; {next}")));
    }
    Ok(())
}

/// A fiducial in the keys of the configuration.
fn fiducial_json(pair: &FiducialPair) -> Value {
    let [tracker_mm, bench_mm] = [pair.tracker_mm, pair.bench_mm].map(<[f64; 3]>::from);
    json!({ "tracker_mm": tracker_mm, "bench_mm": bench_mm })
}

/// The tracker's pose on the bench from fiducials.
fn registration(arguments: &RegistrationArguments) -> Result<()> {
    let path = &arguments.file;
    let config = arguments.configured.load(None)?;
    arguments.output.refuse_unwritable()?;
    if arguments.collect {
        if config.stage.hardware && !config.tracker.has_tip() {
            print_stderr(
                "warning: without tracker.tip_offset_mm each point is where the sensor is, not the tip: if you touch with \
                 the needle's tip, run needle-bench calibrate tip first",
            );
        }
        collect_fiducials(path, &arguments.configured)?;
    }
    let text = text_of(path)?;
    let pairs = FiducialPair::parse(&text).map_err(|error| Failure::bad_input(path, error))?;
    let fit = RegistrationFit::of(&pairs, arguments.rms_max_mm)
        .map_err(|error| Failure::bad_input(path, error))?;
    let fiducials: Vec<Value> = pairs.iter().map(fiducial_json).collect();
    let found = json!({
        "points": fit.points,
        "rms_mm": fit.rms_mm,
        "spread_mm": fit.spread_mm,
        "fiducials": fiducials,
    });
    // How the points of a file were touched is not known.
    let touched = match arguments.collect {
        true => {
            json!({ "tool": config.tracker.tool, "tip_offset_mm": config.tracker.tip_offset_mm })
        }
        false => json!({}),
    };
    let found = merged(found, &touched);
    let [x_mm, y_mm, z_mm]: [f64; 3] = fit.x_wt.translation.into();
    let registration = json!({
        "x_mm": x_mm,
        "y_mm": y_mm,
        "z_mm": z_mm,
        "sd_mm": config.registration_sd_of_mm(&fit),
        "fit": fit_table(&path.display().to_string(), Some(&text), &found),
    });
    let registration = merged(angles_json(&fit.x_wt.rotation), &registration);
    let json = json!({
        "registration": registration,
        "worst_point": fit.worst_point,
        "worst_mm": fit.worst_mm,
        "localisation_error_mm": fit.localisation_error_mm(),
    });
    let overlay = json!({ "tracker": { "registration": registration } });
    let more = context! {
        rms_max_mm => arguments.rms_max_mm,
        remarks => fit.remarks(&pairs, arguments.rms_max_mm),
        overlay => to_toml(&overlay)?,
    };
    let toml = Some(include_str!("registration.toml"));
    arguments.output.write(&json, more, include_str!("registration.txt"), toml)
}

/// The tip's offset and tilt on the sensor, from the sensor's circle while the base turns.
fn tip(arguments: &TipArguments) -> Result<()> {
    let path = &arguments.file;
    if arguments.rehearse && arguments.output.out.is_some() {
        return Err(Failure::configuration(
            "--rehearse writes no calibration, since its needle and tracker are emulated: leave --out out",
        ));
    }
    let along_mm = arguments.along_mm.unwrap_or_default();
    if along_mm < 0.0 {
        return Err(Failure::configuration(format_args!(
            "--along-mm is {along_mm} mm (at least 0): a sensor is not ahead of its own tip; give the distance from the \
             sensor forward to the tip"
        )));
    }
    arguments.output.refuse_unwritable()?;
    let (text, config) = match arguments.run {
        true => {
            let (text, config) = record_turn(path, &arguments.configured, arguments.rehearse)?;
            (text, Some(config))
        }
        false if arguments.configured.is_given() => {
            let config = arguments.configured.load(None)?;
            (text_of(path)?, Some(config))
        }
        false => (text_of(path)?, None),
    };
    let noise_sd_mm = config.as_ref().map_or(0.0, |config| config.tracker.to_track().noise_sd_mm);
    let rms_max_mm = arguments.rms_max_mm.unwrap_or(RMS_MAX_MM.max(2.0 * noise_sd_mm));
    let samples = TurnSample::parse(&text).map_err(|error| Failure::bad_input(path, error))?;
    let fit = TipFit::of(&samples, rms_max_mm).map_err(|error| Failure::bad_input(path, error))?;
    let is_oriented = samples.iter().all(|sample| sample.orientation_meas.is_some());
    if along_mm != 0.0 && !is_oriented {
        let why = "--along-mm needs the sensor's orientation: record qw,qx,qy,qz, or leave it out";
        return Err(Failure::bad_input(path, why));
    }
    if arguments.along_mm.is_none() && is_oriented {
        print_stderr(
            "warning: the tip is taken to be level with the sensor: measure how far it is ahead along the needle, and \
             give it as --along-mm",
        );
    }
    // Each position scatters in the direction of the radius, and across the circle's plane.
    let expected_mm =
        config.and_then(|config| config.tracker.noise).map(|noise| SQRT_2 * noise.sd_mm());
    if let Some(mm) = expected_mm.filter(|mm| fit.rms_mm < SCATTER_PART_MIN * mm) {
        print_stderr(format_args!(
            "warning: the positions scatter by {:.3} mm RMS, and tracker.noise gives {mm:.3} (a quarter needed): are they \
             in cm or inches, or smoothed?",
            fit.rms_mm
        ));
    }
    let x_sb = fit.x_sb(along_mm);
    let found = json!({ "points": fit.points, "radius_mm": fit.radius_mm, "rms_mm": fit.rms_mm });
    let tracker = json!({
        "tip_offset_mm": <[f64; 3]>::from(x_sb.translation),
        "tip_tilt": angles_json(&x_sb.rotation),
        "tip_fit": fit_table(&path.display().to_string(), Some(&text), &found),
    });
    let json = json!({
        "tracker": tracker,
        "axis_tracker": <[f64; 3]>::from(fit.axis),
        "centre_tracker_mm": <[f64; 3]>::from(fit.centre_mm),
        "arc_deg": fit.arc_rad.to_degrees(),
        "centre_sd_mm": fit.centre_sd_mm,
        "axis_sd_deg": fit.axis_sd_rad.to_degrees(),
        "has_mount": fit.mount.is_some(),
        "rehearsal": arguments.rehearse,
    });
    let more = context! {
        rms_max_mm,
        is_oriented,
        along_mm,
        tilt_deg => fit.mount.map(|mount| mount.axis.z.clamp(-1.0, 1.0).acos().to_degrees()),
        overlay => to_toml(&json!({ "tracker": tracker }))?,
    };
    let toml = (!arguments.rehearse).then_some(include_str!("tip.toml"));
    arguments.output.write(&json, more, include_str!("tip.txt"), toml)
}
