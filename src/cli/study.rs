//! `needle-bench study`: Monte Carlo trials of emulated insertions.

use super::arguments::{Configured, parse_seed};
use super::mask::{mask_reader, print_warning};
use super::output::{print_result_despite, refuse_unwritable, write_new};
use super::{Failure, Result, STOPPED};
use crate::config::Config;
use crate::geometry::coordinates;
use crate::runtime::{Interrupt, Study};
use crate::session::PlaneOutOfReach;
use crate::study::{StudySummary, TipError, TrialResult, trial_seed};
use crate::text::{screen, shell_word};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use minijinja::context;
use nalgebra::Vector3;
use serde::Serialize;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// At most this many failed trials are listed on the screen.
const FAILED_MAX: usize = 20;

#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(flatten)]
    configured: Configured,
    /// Study the configuration of a rig on emulated drives and an emulated tracker, as `run --rehearse` runs it.
    #[arg(long)]
    rehearse: bool,
    /// Number of insertions.
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u32).range(1..=10_000_000))]
    trials: u32,
    /// Seed of the study: the same seed gives the same trials.
    #[arg(long, default_value_t = 1, value_parser = parse_seed, allow_negative_numbers = true)]
    seed: u64,
    /// One JSON object on stdout.
    #[arg(long)]
    json: bool,
    /// Write a CSV row for each trial.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Make each insertion through drives and CAN frames: slower, and with what only those do: gates on the tip's
    /// positions, whole counts, and a refused start if no path leads to the target from the measured tip.
    #[arg(long)]
    through_session: bool,
    /// Number of threads, by default the number of processors.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: Option<u16>,
}

pub(super) fn study(arguments: &Arguments) -> Result<()> {
    let config = arguments.configured.clone().rehearsed(arguments.rehearse).load(None)?;
    refuse_unwritable(arguments.out.as_deref())?;
    if !config.is_emulated() {
        return Err(Failure::configuration(format!(
            "can.interface is \"{}\", but a study emulates the needle: study this rig with --rehearse",
            config.can.interface
        )));
    }
    // A study counts the trials that miss the plane; it does not refuse them.
    let mut session = config.session_without_goal()?;
    session.shadows.clear();
    session.insertion.plane_out_of_reach = PlaneOutOfReach::Insert;
    let drawn = |seed| config.drawn(seed).map_err(|error| error.to_string());
    let stage = |seed| drawn(seed)?.virtual_stage().map_err(|error| error.to_string());
    let read_mask = mask_reader(arguments.configured.path(), print_warning);
    let goal = |seed| drawn(seed)?.to_goal(&read_mask).map_err(|error| error.to_string());
    let (tool, prior) = (&config.tracker.tool, config.prior());
    let study = Study { session, tool, prior, stage: &stage, goal: &goal };
    let seeds: Vec<u64> =
        (0..u64::from(arguments.trials)).map(|trial| trial_seed(arguments.seed, trial)).collect();

    let interrupt = Interrupt::listen().map_err(Failure::environment)?;
    let style = ProgressStyle::with_template("{bar:40.cyan/blue} {pos} of {len} trials  {eta}");
    let style = style.unwrap_or_else(|_| ProgressStyle::default_bar());
    let bar = ProgressBar::new(seeds.len() as u64).with_style(style);
    let threads = arguments.threads.map_or(0, usize::from);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    let begun = Instant::now();
    let trials = pool.map_err(Failure::environment)?.install(|| {
        let on_trial_done = || {
            bar.inc(1);
            if interrupt.is_raised() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        if arguments.through_session {
            study.run_through_sessions(&seeds, &on_trial_done)
        } else {
            study.run(&seeds, &on_trial_done)
        }
    });
    let elapsed_s = begun.elapsed().as_secs_f64();
    bar.finish_and_clear();
    let trials = trials.map_err(Failure::configuration)?;
    let inserted_mm: f64 = trials.iter().map(|trial| trial.figures.insertion_mm).sum();
    let summary = StudySummary::of(&trials)
        .ok_or_else(|| Failure::configuration("a study needs at least one trial"))?;
    let written = match &arguments.out {
        Some(path) => write_csv(path, &trials, &config),
        None => Ok(()),
    };
    let is_whole = trials.len() == seeds.len();
    let ended =
        written.and_then(|()| if is_whole { Ok(()) } else { Err(interrupted(&trials, &seeds)) });
    let report = Report { summary: &summary, insertion_mm_per_second: inserted_mm / elapsed_s };
    let more = context! {
        depth_mm => config.insertion.depth_mm,
        observer => config.observer.kind.to_string(),
        control => config.control.kind.to_string(),
        rms => summary.estimate_rms.map(|rms| rms.to_string()),
        failed_max => FAILED_MAX,
        repeat => repeat_command(arguments, config.insertion.plane_out_of_reach),
    };
    let text = || screen(include_str!("study.txt"), &report, more);
    print_result_despite(ended, arguments.json, &report, text)
}

fn interrupted(trials: &[TrialResult], seeds: &[u64]) -> Failure {
    let (done, all) = (trials.len(), seeds.len());
    let text = format!("interrupted after {done} of {all} trials; the figures are of these {done}");
    Failure { message: Some(text), status: STOPPED }
}

/// The command that repeats a trial, without its seed. A run refuses a plane out of reach, which a study counts.
fn repeat_command(arguments: &Arguments, plane_out_of_reach: PlaneOutOfReach) -> String {
    let Arguments { configured, rehearse, .. } = arguments;
    let path = configured.path().map(|path| path.display().to_string());
    let flag = rehearse.then(|| "--rehearse".to_owned());
    let is_refused = plane_out_of_reach != PlaneOutOfReach::Insert;
    let inserts_anyway = is_refused.then(|| "insertion.plane_out_of_reach=insert".to_owned());
    let sets = configured.set.iter().cloned().chain(inserts_anyway);
    let words = path.into_iter().chain(flag).chain(sets.flat_map(|set| ["--set".to_owned(), set]));
    words.fold("needle-bench run".to_owned(), |line, word| line + " " + &shell_word(word))
}

/// The summary, and how fast this computer made the trials.
#[derive(Serialize)]
struct Report<'a> {
    #[serde(flatten)]
    summary: &'a StudySummary,
    insertion_mm_per_second: f64,
}

/// Writes a CSV row for each trial; a cell for which the trial has no number is empty.
fn write_csv(path: &Path, trials: &[TrialResult], config: &Config) -> Result<()> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    for (number, trial) in trials.iter().enumerate() {
        let target_mm = match trial.target {
            Some(_) => config.drawn(trial.seed)?.goal.position_mm,
            None => None,
        };
        let row = trial_row(number, trial, target_mm);
        let (names, cells): (Vec<_>, Vec<_>) = row.into_iter().unzip();
        if number == 0 {
            writer.write_record(names).map_err(Failure::environment)?;
        }
        writer.write_record(cells).map_err(Failure::environment)?;
    }
    let written = writer.into_inner().map_err(Failure::environment)?;
    write_new(path, &String::from_utf8_lossy(&written))
}

/// The names and cells of a trial's row. `target_mm` is the target at the start, plane frame.
fn trial_row(
    number: usize,
    trial: &TrialResult,
    target_mm: Option<Vector3<f64>>,
) -> Vec<(String, String)> {
    let TrialResult { stage, figures, .. } = trial;
    let mut row = Vec::new();
    let mut add = |name: &str, cell: String| row.push((name.to_owned(), cell));
    let shown = |value: Option<f64>| {
        let finite = value.filter(|value| value.is_finite());
        finite.map_or(String::new(), |value| value.to_string())
    };
    add("trial", number.to_string());
    add("seed", trial.seed.to_string());
    let start = TipError::between(coordinates(&stage.start), [0.0; 6]);
    for (group, pose) in [
        ("start", Some(start)),
        ("estimate_rms", figures.estimate_rms),
        ("bound_rms", trial.bound_rms),
    ] {
        for (i, name) in TipError::COORDINATES.iter().enumerate() {
            add(&format!("{group}_{name}"), shown(pose.map(|pose| pose.coordinates()[i])));
        }
    }
    add("curvature_per_mm", shown(Some(stage.needle.curvature_per_mm())));
    for (name, value) in stage.torsion.config().in_keys() {
        add(&format!("torsion_{name}"), shown(Some(value)));
    }
    for (name, value) in [
        ("insertion_mm", Some(figures.insertion_mm)),
        ("off_plane_rms_mm", figures.off_plane_rms_mm),
        ("settling_mm", figures.settling_mm),
        ("shortest_settling_mm", trial.shortest_settling_mm),
    ] {
        add(name, shown(value));
    }
    if let Some(target) = trial.target {
        for (i, name) in ["target_x_mm", "target_y_mm", "target_z_mm"].into_iter().enumerate() {
            add(name, shown(target_mm.map(|mm| mm[i])));
        }
        add("target_refused", target.is_refused.to_string());
        add("target_reached", target.is_reached.to_string());
        add("target_error_mm", shown(target.error_mm));
        add("clearance_mm_min", shown(Some(target.clearance_mm)));
    }
    add("settled", trial.is_settled().to_string());
    add("stop_reason", trial.outcome.stop_reason().unwrap_or_default().to_owned());
    row
}
