//! `needle-bench run`: one insertion.

use super::arguments::{Configured, parse_seed};
use super::console::Console;
use super::ending::{
    after_insertion, ending, plan_status, plane_missed_by_mm, possible_withdrawal, status,
};
use super::mask::{file_crc32, mask_reader, print_warning, warn_of_far_obstacles};
use super::output::{merged, print_result, print_stderr};
use super::perform::{Job, Options, Performed, end_json};
use super::preflight::{before_rehearsal, before_run};
use super::{Failure, Result, finish_with, stage};
use crate::config::Config;
use crate::operation::RunConfig;
use crate::preflight::Check;
use crate::runtime::{RunReport, gates_to_json};
use crate::session::{Outcome, Resume};
use crate::text::screen;
use clap::Args;
use minijinja::{Value as Shown, context};
use serde_json::{Value, json};
use std::path::Path;

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
    /// Draw the emulated start and needle from [study] by this seed, the target if the study draws one, and
    /// the noise: the trial of a study that has this seed. (The noise alone: --set emulator.seed=SEED.)
    #[arg(long, value_parser = parse_seed, allow_negative_numbers = true)]
    seed: Option<u64>,
    /// One JSON object on stdout.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    options: Options,
}

pub(super) fn run(arguments: &Arguments) -> Result<()> {
    if arguments.options.console {
        // Refused before anything is checked.
        Console::open_keys()?;
    }
    let configured = arguments.configured.clone().rehearsed(arguments.rehearse);
    let (mut config, _) = configured.load_with_warnings()?;
    if let Some(seed) = arguments.seed {
        if !config.is_emulated() {
            return Err(Failure::configuration(format_args!(
                "--seed draws the emulated needle, but can.interface is \"{}\"; rehearse it with \
                 --rehearse, or leave --seed out",
                config.can.interface
            )));
        }
        config = config.drawn(seed)?;
    }
    if config.tracker.hold.resume == Resume::Operator && !arguments.options.console {
        print_stderr(format_args!(
            "warning: tracker.resume is \"operator\", but only the keys of --console resume: a hold will end the run"
        ));
    }
    // The record names each mask by its absolute path and checksum, for a replay to find and check it.
    config = configured.completed(&config, |mask| file_crc32(mask).ok());
    let session = Box::new(config.session_reading(&mask_reader(None, print_warning))?);
    if let Some(goal) = &session.goal {
        warn_of_far_obstacles(&goal.world, goal.problem.clearance_mm);
    }
    let preflight = if arguments.rehearse {
        before_rehearsal(&config, &arguments.configured.load(None)?, arguments.options.quiet)
    } else {
        before_run(&config, arguments.yes, arguments.json)?
    };
    let paced = arguments.options.console;
    let options = Options { paced, ..arguments.options.clone() };
    let withdrawal_options = options.of_withdrawal();
    let run_config = RunConfig::Insertion(session);
    let job = Job { config: &config, run_config, motion: None, options };
    let Performed { report, wants_withdrawal, .. } = job.perform()?;
    let object = to_json(&config, &report, &preflight);
    let more = screen_values(&config, configured.whole_path(), &report);
    let printed =
        print_result(arguments.json, &object, || screen(include_str!("run.txt"), &object, more));
    let mut worst = status(&config, &report);
    if wants_withdrawal && let Ok(withdrawal) = possible_withdrawal(&config, &report) {
        let config = withdrawal.configuration(config, &report);
        let command = format!("withdraw{}", withdrawal.by_option());
        let report = stage::perform(&config, &command, withdrawal_options)?;
        worst = worst.max(status(&config, &report));
    }
    // Last: stdout may be a file on a full disk.
    printed?;
    finish_with(worst)
}

/// The figures and the outcome of the run.
fn to_json(config: &Config, report: &RunReport, preflight: &[Check]) -> Value {
    let figures = merged(json!(report.figures.report()), &end_json(report));
    let more = json!({
        "timing": report.timing,
        "holds": report.holds,
        "tracker_samples": gates_to_json(&report.gates),
        "plane_missed_by_mm": plane_missed_by_mm(report),
        "plan_status": plan_status(config, report),
        "rehearsal": config.emulator.rehearse,
        "record_dropped": report.record.as_ref().ok().and_then(|manifest| manifest.dropped),
        "preflight": preflight,
    });
    merged(figures, &more)
}

/// The values that the screen shows and the JSON object lacks.
fn screen_values(config: &Config, path: Option<&Path>, report: &RunReport) -> Shown {
    let figures = report.figures.report();
    context! {
        depth_mm => config.insertion.depth_mm,
        is_virtual => config.is_emulated(),
        has_truth => config.knows_truth(),
        rehearsed => config.emulator.rehearse.then(|| config.can.interface.to_string()),
        is_stopped => matches!(report.outcome, Outcome::Stopped(_)),
        tracker => report.gates.to_string(),
        rms => figures.estimate_rms.map(|rms| rms.to_string()),
        error => figures.final_error.map(|error| error.to_string()),
        kept_time => report.timing.as_ref().map(ToString::to_string),
        after => after_insertion(config, path, report),
        ending => ending(config, report),
    }
}
