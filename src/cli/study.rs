//! `needle-bench study`: Monte Carlo.

use super::Failure;
use super::output::say;
use super::sources::load;
use crate::config::{CanInterface, Config, SEED_MAX};
use crate::geometry::FixedAngles;
use crate::runtime::Study;
use crate::session::{PlaneOutOfReach, SessionConfig};
use crate::study::{Consistency, StudySummary, TipError, TrialResult, trial_seed};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::{Map, Value, json};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

/// Trials that failed, of those listed on the screen.
const FAILED_SHOWN: usize = 20;

#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Configuration; without one, bench-config/virtual.toml. Trials are drawn from its [study].
    config: Option<PathBuf>,
    /// Set a key of the configuration, for example 'study.x_mm=[-2, 2]'.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Insertions.
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u32).range(1..))]
    trials: u32,
    /// Seed of the study: the same seed gives the same trials.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(..=SEED_MAX))]
    seed: u64,
    /// One JSON object on stdout.
    #[arg(long)]
    pub(super) json: bool,
    /// Write a CSV row a trial.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Make each insertion through drives and CAN frames: much slower, and the same.
    #[arg(long)]
    through_session: bool,
    /// Threads; as many as there are processors without it.
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true)]
    threads: usize,
}

pub(super) fn study(arguments: &Arguments) -> Result<ExitCode, Failure> {
    let config = load(arguments.config.as_deref(), None, &arguments.set)?;
    let wrong = |error: &dyn std::fmt::Display| Failure::Configuration(error.to_string());
    if config.can.interface != CanInterface::Memory {
        return Err(Failure::Configuration(format!(
            "can.interface is \"{}\": a study needs the emulated needle, can.interface = \"memory\"",
            config.can.interface
        )));
    }
    // What a trial comes to is what a study is about.
    let session = SessionConfig {
        shadows: Vec::new(),
        plane_out_of_reach: PlaneOutOfReach::Insert,
        ..config.session().map_err(|e| wrong(&e))?
    };
    session.check().map_err(|error| wrong(&error))?;
    let stage = |seed| config.drawn(seed).virtual_stage().map_err(|error| error.to_string());
    let study = Study { session, tool: &config.tracker.tool, prior: config.prior(), stage: &stage };
    let seeds: Vec<u64> =
        (0..u64::from(arguments.trials)).map(|trial| trial_seed(arguments.seed, trial)).collect();

    let bar = progress_bar(seeds.len());
    let pool = rayon::ThreadPoolBuilder::new().num_threads(arguments.threads).build();
    let begun = Instant::now();
    let trials = pool.map_err(Failure::environment)?.install(|| {
        let done = || bar.inc(1);
        if arguments.through_session {
            study.run_through_sessions(&seeds, &done)
        } else {
            study.run(&seeds, &done)
        }
    });
    let elapsed_s = begun.elapsed().as_secs_f64();
    bar.finish_and_clear();
    let trials = trials.map_err(|error| wrong(&error))?;
    if let Some(path) = &arguments.out {
        write(path, &trials)?;
    }
    let inserted_mm: f64 = trials.iter().map(|trial| trial.insertion_mm).sum();
    let summary = StudySummary::of(&trials)
        .ok_or_else(|| Failure::Configuration("a study of no trials".to_owned()))?;
    if arguments.json {
        say(to_json(&summary, inserted_mm / elapsed_s))?;
    } else {
        say(text(&config, &summary, inserted_mm / elapsed_s))?;
    }
    Ok(ExitCode::SUCCESS)
}

fn progress_bar(trials: usize) -> ProgressBar {
    let bar = ProgressBar::new(trials as u64);
    if let Ok(style) =
        ProgressStyle::with_template("{bar:40.cyan/blue} {pos} of {len} trials  {eta}")
    {
        bar.set_style(style);
    }
    bar
}

fn to_json(summary: &StudySummary, insertion_mm_per_second: f64) -> Value {
    let mut object = match json!(summary) {
        Value::Object(object) => object,
        _ => Map::new(),
    };
    object.insert("insertion_mm_per_second".to_owned(), json!(insertion_mm_per_second));
    Value::Object(object)
}

/// One screen; the trials that failed last.
fn text(config: &Config, summary: &StudySummary, insertion_mm_per_second: f64) -> String {
    let (off_plane, settling) = (&summary.off_plane_rms_mm, &summary.settling_mm);
    let mut lines = vec![
        format!(
            "{} insertions of {:.0} mm by {} and {}; {:.0} mm inserted a second",
            summary.trials,
            config.insertion.depth_mm,
            config.observer.kind,
            config.control.kind,
            insertion_mm_per_second
        ),
        format!("settled     {:.2}% within 1 mm RMS", 100.0 * summary.settled_fraction),
        format!(
            "off plane   {} mm median, {} 95%, {} the worst: RMS over the last third",
            finite(off_plane.median, 3),
            finite(off_plane.p95, 3),
            finite(off_plane.max, 3)
        ),
        format!(
            "settling    {} mm median, {} 95%; two arcs would take {} median",
            finite(settling.median, 0),
            finite(settling.p95, 0),
            finite(summary.shortest_settling_mm.median.unwrap_or(f64::INFINITY), 0)
        ),
    ];
    lines.extend(summary.estimate_rms.map(|rms| {
        format!("estimate    {} RMS over the last third, median", coordinates(&rms, " mm", " deg"))
    }));
    lines.extend(summary.bound_ratio.map(|ratio| {
        format!("            {} times the information bound", coordinates(&ratio, "", ""))
    }));
    lines.extend(summary.nees.map(|nees| {
        let Consistency { mean, lo95, hi95, verdict } = nees.end;
        format!("NEES        {mean:.2} at the end (95%: {lo95:.2} to {hi95:.2}): {verdict}")
    }));
    lines.extend(summary.nis.map(|nis| {
        let Consistency { mean, lo95, hi95, verdict } = nis;
        format!(
            "NIS         {mean:.3} over the last third (95%: {lo95:.3} to {hi95:.3}): {verdict}"
        )
    }));
    lines.extend(summary.failed.iter().take(FAILED_SHOWN).map(|failed| {
        let off_plane_mm =
            failed.off_plane_rms_mm.map_or("-".to_owned(), |rms| format!("{rms:.2}"));
        let reason = failed.stop_reason.as_deref().unwrap_or("reached its depth");
        format!("failed      run --seed {}: {off_plane_mm} mm off plane; {reason}", failed.seed)
    }));
    if let Some(more) = summary.failed.len().checked_sub(FAILED_SHOWN + 1) {
        lines.push(format!("            and {} more: --json lists all", more + 1));
    }
    lines.join("\n")
}

/// A number; what is not finite never came about.
fn finite(value: f64, decimals: usize) -> String {
    if value.is_finite() { format!("{value:.decimals$}") } else { "never".to_owned() }
}

fn coordinates(error: &TipError, mm: &str, deg: &str) -> String {
    format!(
        "x {:.3} y {:.3} z {:.3}{mm}, yaw {:.2} pitch {:.2} roll {:.2}{deg}",
        error.x_mm, error.y_mm, error.z_mm, error.yaw_deg, error.pitch_deg, error.roll_deg
    )
}

/// A CSV row a trial, empty where a trial has no such number.
fn write(path: &Path, trials: &[TrialResult]) -> Result<(), Failure> {
    const COORDINATES: [&str; 6] = ["x_mm", "y_mm", "z_mm", "yaw_deg", "pitch_deg", "roll_deg"];
    let mut text = "trial,seed".to_owned();
    for group in ["start", "estimate_rms", "bound_rms"] {
        COORDINATES.iter().for_each(|coordinate| text.extend([",", group, "_", coordinate]));
    }
    text.push_str(
        ",curvature_per_mm,torsion_half_width_deg,torsion_half_width_deg_per_mm,\
         torsion_offset_deg,insertion_mm,off_plane_rms_mm,settling_mm,shortest_settling_mm,settled,\
         stop_reason\n",
    );
    for (number, trial) in trials.iter().enumerate() {
        let _ = writeln!(text, "{}", row(number, trial));
    }
    std::fs::write(path, text)
        .map_err(|error| Failure::Environment(format!("{}: {error}", path.display())))
}

fn row(number: usize, trial: &TrialResult) -> String {
    let field = |value: Option<f64>| value.map_or(String::new(), |value| value.to_string());
    let of = |error: Option<TipError>| -> Vec<String> {
        let coordinates = error.map(|error| error.coordinates());
        (0..6).map(|i| field(coordinates.map(|c| c[i]))).collect()
    };
    let stage = &trial.stage;
    let (p, angles) = (stage.start.translation, FixedAngles::from_rotation(&stage.start.rotation));
    let start = [
        p.x,
        p.y,
        p.z,
        angles.yaw.to_degrees(),
        angles.pitch.to_degrees(),
        angles.roll.to_degrees(),
    ];
    let torsion = stage.torsion.config();
    let mut fields = vec![number.to_string(), trial.seed.to_string()];
    fields.extend(start.map(|value| value.to_string()));
    fields.extend(of(trial.estimate_rms));
    fields.extend(of(trial.bound_rms));
    fields.extend(
        [
            Some(stage.needle.curvature_per_mm()),
            Some(torsion.half_width_rad.to_degrees()),
            Some(torsion.half_width_rad_per_mm.to_degrees()),
            Some(torsion.offset_rad.to_degrees()),
            Some(trial.insertion_mm),
            trial.off_plane_rms_mm,
            trial.settling_mm,
            trial.shortest_settling_mm,
        ]
        .map(field),
    );
    fields.push(trial.is_settled().to_string());
    let reason = trial.outcome.stop_reason().unwrap_or_default().replace('"', "'");
    fields.push(format!("\"{reason}\""));
    fields.join(",")
}
