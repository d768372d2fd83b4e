//! `needle-bench run`: one insertion.

use super::about::About;
use super::after::{after_insertion, withdrawal};
use super::console::{Console, Setup};
use super::ending::{ending, plane_missed_by_mm, record_error, status};
use super::output::{give, tell};
use super::perform::{Job, LIVE_ADDRESS, Performed, emulated_json};
use super::plan::{file_crc32, mask_reader};
use super::preflight::{before_rehearsal, before_run};
use super::realtime::RealTimeArguments;
use super::sources::{Configured, load_with_warnings, rehearsed};
use super::{Failure, stage};
use crate::archive::RunOutcome;
use crate::config::{Config, SEED_MAX};
use crate::runtime::{RunReport, gates_to_json};
use crate::session::Outcome;
use crate::text::screen;
use clap::Args;
use minijinja::{Value as Shown, context};
use serde_json::{Value, json};
use std::net::SocketAddr;
use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;

#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(flatten)]
    configured: Configured,
    /// Rehearse this very configuration on emulated drives and an emulated tracker; no CAN interface and
    /// no connection is opened. In virtual time, or with --console at the rig's own pace.
    ///
    /// It exercises the file, the bring-up, the limits, the steering, the console and the record. It does
    /// not exercise the wiring, the real drives, their signs and scales, the tracker and its registration,
    /// the tissue, or how punctual this machine is.
    #[arg(long)]
    rehearse: bool,
    /// On hardware: do not ask before the insertion. The preflight still refuses what fails.
    #[arg(long, short)]
    yes: bool,
    /// Draw the emulated start and needle from [study] by this seed, and the noise: the trial of a
    /// study that has this seed. (The noise alone: --set emulator.seed=SEED.)
    #[arg(long, value_parser = seed, allow_negative_numbers = true)]
    seed: Option<u64>,
    #[command(flatten)]
    realtime: RealTimeArguments,
    #[command(flatten)]
    about: About,
    /// Serve the run to rerun viewers as it goes; without an address at 127.0.0.1:9876.
    #[arg(long, value_name = "ADDRESS:PORT", num_args = 0..=1, require_equals = true,
          default_missing_value = LIVE_ADDRESS)]
    live: Option<SocketAddr>,
    /// Show the run on the whole terminal; its keys hold, resume, step, change the speed and stop. An
    /// emulated run then takes as long as a real one.
    #[arg(long, conflicts_with = "quiet")]
    console: bool,
    /// One JSON object on stdout.
    #[arg(long)]
    pub(super) json: bool,
    /// Show warnings and faults only.
    #[arg(long, short)]
    quiet: bool,
}

/// A seed of the command line.
pub(super) fn seed(text: &str) -> Result<u64, String> {
    let seed = text.parse().ok().filter(|seed| *seed <= SEED_MAX);
    seed.ok_or_else(|| format!("a whole number from 0 to {SEED_MAX}"))
}

pub(super) fn run(arguments: &Arguments) -> Result<ExitCode, Failure> {
    if arguments.console {
        Console::keys()?;
    }
    let sets = rehearsed(&arguments.configured.set, arguments.rehearse);
    let (mut config, warnings) = load_with_warnings(arguments.configured.path(), None, &sets)?;
    for warning in warnings {
        tell(format_args!("warning: {warning}"));
    }
    if let Some(seed) = arguments.seed {
        if !config.is_emulated() {
            return Err(Failure::Configuration(format!(
                "--seed draws an emulated needle, but can.interface is \"{}\": its needle is where \
                 it is",
                config.can.interface
            )));
        }
        config = config.drawn(seed).map_err(Failure::configuration)?;
    }
    // A replay finds the masks again, and sees whether they are the same.
    if let Some(file) = arguments.configured.path() {
        let file = std::path::absolute(file).map_err(Failure::environment)?;
        config = config.with_masks_beside(&file, |mask| file_crc32(mask).ok());
    }
    let session = config.session_reading(&mask_reader(None)).map_err(Failure::configuration)?;
    session.check().map_err(Failure::configuration)?;
    let preflight = if arguments.rehearse {
        before_rehearsal(&config, &arguments.configured.load(None)?, arguments.quiet)?
    } else {
        match before_run(&config, arguments.yes, arguments.json)? {
            Ok(checks) => checks,
            Err(status) => return Ok(status),
        }
    };
    let job = Job {
        config: &config,
        plan: session.into(),
        operation: None,
        about: &arguments.about,
        realtime: arguments.realtime,
        live: arguments.live,
        quiet: arguments.quiet,
        console: arguments.console.then(|| console_setup(&config)),
        paced: arguments.console,
    };
    let Performed { report, withdraws, .. } = job.perform()?;
    let mut object = to_json(&config, &report);
    object["preflight"] = json!(preflight);
    let text = || {
        screen(
            include_str!("run.txt"),
            &object,
            // The run's own configuration has what was set on the command line, the file has not.
            more(&config, arguments.configured.path().filter(|_| sets.is_empty()), &report),
        )
    };
    give(arguments.json, &object, text)?;
    let mut ended = status(&config, &report);
    if withdraws && let Ok(withdrawal) = withdrawal(&config, &report) {
        let (words, config) = withdrawal.after(&config, &report);
        let words: Vec<&str> = words.iter().map(String::as_str).collect();
        let (report, summary) = stage::perform(&config, &words, true)?;
        tell(summary);
        ended = ended.max(status(&config, &report));
    }
    Ok(ExitCode::from(ended))
}

fn console_setup(config: &Config) -> Setup {
    let (insertion, stage, gates) = (&config.insertion, &config.stage, &config.tracker.gates);
    Setup {
        nodes: [stage.insertion.node, stage.rotation.node],
        sync_period: Duration::from_millis(config.can.sync_ms.into()),
        tip_age_max_s: config.tracker.hold.after.as_secs_f64(),
        noise_sd_mm: gates.track.noise_sd_mm,
        step_mm: insertion.step_mm,
        speed_max_mm_per_s: insertion.speed_mm_per_s,
    }
}

fn to_json(config: &Config, report: &RunReport) -> Value {
    let RunReport { outcome, holds, gates, run_dir, record, end, timing, emulated, .. } = report;
    let figures = report.figures.report();
    json!({
        "outcome": RunOutcome::from(outcome),
        "stop_reason": outcome.stop_reason(),
        "insertion_mm": figures.insertion_mm,
        "steps": figures.steps,
        "steps_saturated": figures.steps_saturated,
        "duration_s": end.as_secs_f64(),
        "timing": timing,
        "holds": holds,
        "tracker_samples": gates_to_json(gates),
        "off_plane_rms_mm": figures.off_plane_rms_mm,
        "settling_mm": figures.settling_mm,
        "plane_missed_by_mm": plane_missed_by_mm(report),
        "target_error_mm": figures.target_error_mm,
        "target_error_est_mm": figures.target_error_est_mm,
        "clearance_mm_min": figures.clearance_mm_min,
        "plan_status": plan_status(config, report),
        "estimate_rms": figures.estimate_rms,
        "final_error": figures.final_error,
        "rehearsal": config.emulator.rehearse,
        "run_dir": run_dir.display().to_string(),
        "record_dropped": record.as_ref().ok().map(|finished| finished.dropped),
        "record_error": record_error(record),
        "emulated": emulated.as_ref().map(emulated_json),
    })
}

/// What became of the plan: `"arrived"`; `"missed"` where the run completed and the estimated tip is not
/// within the tolerance; `"lost"` where the run was stopped before. Null without a target.
fn plan_status(config: &Config, report: &RunReport) -> Option<&'static str> {
    let error_mm = report.figures.report().target_error_est_mm?;
    Some(match report.outcome {
        Outcome::Completed if error_mm <= config.goal.tolerance_mm => "arrived",
        Outcome::Completed => "missed",
        Outcome::Stopped(_) => "lost",
    })
}

/// What the screen shows besides the object.
fn more(config: &Config, path: Option<&Path>, report: &RunReport) -> Shown {
    let figures = report.figures.report();
    context! {
        depth_mm => config.insertion.depth_mm,
        is_virtual => config.is_emulated(),
        rehearsed => config.emulator.rehearse.then(|| config.can.interface.to_string()),
        is_stopped => matches!(report.outcome, Outcome::Stopped(_)),
        tracker => report.gates.to_string(),
        rms => figures.estimate_rms.map(|rms| rms.to_string()),
        error => figures.final_error.map(|error| error.to_string()),
        kept_time => report.timing.as_ref().map(ToString::to_string),
        after => after_insertion(config, path, report),
        ending => ending(report),
    }
}
