//! `needle-bench study`: Monte Carlo.

use super::Failure;
use super::output::give;
use super::run::seed;
use super::sources::load;
use crate::config::{CanInterface, Config};
use crate::geometry::FixedAngles;
use crate::runtime::Study;
use crate::session::PlaneOutOfReach;
use crate::study::{Consistency, StudySummary, TipError, TrialResult, trial_seed};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

/// At most this many failed trials are listed on the screen.
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
    #[arg(long, default_value_t = 1, value_parser = seed, allow_negative_numbers = true)]
    seed: u64,
    /// One JSON object on stdout.
    #[arg(long)]
    pub(super) json: bool,
    /// Write a CSV row for each trial.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Make each insertion through drives and CAN frames: much slower, with the same result.
    #[arg(long)]
    through_session: bool,
    /// Number of threads, by default the number of processors.
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true)]
    threads: usize,
}

pub(super) fn study(arguments: &Arguments) -> Result<ExitCode, Failure> {
    let config = load(arguments.config.as_deref(), None, &arguments.set)?;
    if config.can.interface != CanInterface::Memory {
        return Err(Failure::Configuration(format!(
            "can.interface is \"{}\": a study needs the emulated needle, can.interface = \"memory\"",
            config.can.interface
        )));
    }
    // A study counts the trials that miss the plane; it does not refuse them.
    let mut session = config.session().map_err(Failure::configuration)?;
    session.shadows.clear();
    session.insertion.plane_out_of_reach = PlaneOutOfReach::Insert;
    session.check().map_err(Failure::configuration)?;
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
    let trials = trials.map_err(Failure::configuration)?;
    if let Some(path) = &arguments.out {
        write(path, &trials)?;
    }
    let inserted_mm: f64 = trials.iter().map(|trial| trial.insertion_mm).sum();
    let summary = StudySummary::of(&trials)
        .ok_or_else(|| Failure::configuration("a study needs at least one trial"))?;
    let speed_mm_per_s = inserted_mm / elapsed_s;
    give(
        arguments.json,
        || to_json(&summary, speed_mm_per_s),
        || text(&config, &summary, speed_mm_per_s),
    )?;
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

fn to_json(summary: &StudySummary, speed_mm_per_s: f64) -> Value {
    let mut object = json!(summary);
    object["insertion_mm_per_second"] = json!(speed_mm_per_s);
    object
}

/// One screen; the failed trials come last.
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
    lines.extend(
        summary
            .estimate_rms
            .map(|rms| format!("estimate    {rms} RMS over the last third, median")),
    );
    lines.extend(summary.bound_ratio.map(|ratio| {
        let [x, y, z, yaw, pitch, roll] = ratio.coordinates();
        format!(
            "            x {x:.3} y {y:.3} z {z:.3}, yaw {yaw:.2} pitch {pitch:.2} roll {roll:.2} times \
             the information bound"
        )
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

/// A number; an infinite one stands for an event that never came.
fn finite(value: f64, decimals: usize) -> String {
    if value.is_finite() { format!("{value:.decimals$}") } else { "never".to_owned() }
}

/// Writes a CSV row for each trial; a field that the trial has no number for is empty.
fn write(path: &Path, trials: &[TrialResult]) -> Result<(), Failure> {
    let mut text = String::new();
    for (number, trial) in trials.iter().enumerate() {
        let (names, fields): (Vec<String>, Vec<String>) = row(number, trial).into_iter().unzip();
        if number == 0 {
            text = names.join(",") + "\n";
        }
        text += &(fields.join(",") + "\n");
    }
    std::fs::write(path, text)
        .map_err(|error| Failure::Environment(format!("{}: {error}", path.display())))
}

/// The columns of a trial with their names.
fn row(number: usize, trial: &TrialResult) -> Vec<(String, String)> {
    let field = |value: Option<f64>| value.map_or(String::new(), |value| value.to_string());
    let stage = &trial.stage;
    let (p, angles) = (stage.start.translation, FixedAngles::from_rotation(&stage.start.rotation));
    let angles = [angles.yaw, angles.pitch, angles.roll].map(f64::to_degrees);
    let start = [p.x, p.y, p.z, angles[0], angles[1], angles[2]];
    let torsion = stage.torsion.config();
    let mut row =
        vec![("trial".to_owned(), number.to_string()), ("seed".to_owned(), trial.seed.to_string())];
    for (group, values) in [
        ("start", Some(start)),
        ("estimate_rms", trial.estimate_rms.map(|error| error.coordinates())),
        ("bound_rms", trial.bound_rms.map(|error| error.coordinates())),
    ] {
        row.extend(TipError::COORDINATES.iter().enumerate().map(|(i, coordinate)| {
            (format!("{group}_{coordinate}"), field(values.map(|values| values[i])))
        }));
    }
    for (name, value) in [
        ("curvature_per_mm", Some(stage.needle.curvature_per_mm())),
        ("torsion_half_width_deg", Some(torsion.half_width_rad.to_degrees())),
        ("torsion_half_width_deg_per_mm", Some(torsion.half_width_rad_per_mm.to_degrees())),
        ("torsion_offset_deg", Some(torsion.offset_rad.to_degrees())),
        ("insertion_mm", Some(trial.insertion_mm)),
        ("off_plane_rms_mm", trial.off_plane_rms_mm),
        ("settling_mm", trial.settling_mm),
        ("shortest_settling_mm", trial.shortest_settling_mm),
    ] {
        row.push((name.to_owned(), field(value)));
    }
    let reason = trial.outcome.stop_reason().unwrap_or_default().replace('"', "'");
    row.push(("settled".to_owned(), trial.is_settled().to_string()));
    row.push(("stop_reason".to_owned(), format!("\"{reason}\"")));
    row
}
