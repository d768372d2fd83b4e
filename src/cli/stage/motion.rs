//! `home`, `jog`, `withdraw` and `prove`: a run without a needle's steering, and its record.

use super::{Arguments, Motion};
use crate::archive::{RunOutcome, file, proof};
use crate::cli::Failure;
use crate::cli::ending::{after_operation, ending, record_error, status};
use crate::cli::output::{say, show};
use crate::cli::perform::{Job, Performed, emulated_json};
use crate::config::Config;
use crate::runtime::RunReport;
use crate::session::Done;
use serde_json::{Value, json};
use std::path::Path;
use std::process::ExitCode;

/// Runs the `motion` of `arguments` and prints its result. `path` is the file of `config`, where no key was set
/// over it.
pub(super) fn operate(
    config: &Config,
    path: Option<&Path>,
    motion: &Motion,
    arguments: &Arguments,
) -> Result<ExitCode, Failure> {
    let job = Job {
        motion: Some(motion),
        about: motion.common().about.clone(),
        realtime: arguments.realtime,
        quiet: arguments.quiet,
        ..Job::new(config, motion.plan(config)?)
    };
    let Performed { report, done, .. } = job.perform()?;
    match arguments.json {
        true => say(to_json(motion.name(), &done, &report))?,
        false => {
            show(summary(config, path, motion, &done, &report))?;
            proof_of(&report).map_or(Ok(()), show)?;
        }
    }
    Ok(ExitCode::from(status(config, &report)))
}

/// Runs the motion in `line`, written as on the command line of `stage`, and returns the report and the summary.
/// An emulated stage that is `paced` takes as long as a rig.
pub(in crate::cli) fn perform(
    config: &Config,
    line: &str,
    paced: bool,
) -> Result<(RunReport, String), Failure> {
    let motion = Motion::of(line).map_err(Failure::configuration)?;
    let job = Job { motion: Some(&motion), paced, ..Job::new(config, motion.plan(config)?) };
    let Performed { report, done, .. } = job.perform()?;
    let summary = summary(config, None, &motion, &done, &report);
    Ok((report, summary))
}

fn to_json(name: &str, done: &[Done], report: &RunReport) -> Value {
    let axis = |done: &Done| {
        let (to, unit) = done.axis.in_unit(done.to);
        let from = done.from.map(|from| done.axis.in_unit(from).0);
        let mut object = json!({ "axis": done.axis.to_string() });
        object[format!("from_{unit}")] = json!(from);
        object[format!("to_{unit}")] = json!(to);
        object
    };
    json!({
        "operation": name,
        "outcome": RunOutcome::from(&report.outcome),
        "stop_reason": report.outcome.stop_reason(),
        "axes": done.iter().map(axis).collect::<Vec<_>>(),
        "proof": proof_of(report),
        "duration_s": report.end.as_secs_f64(),
        "run_dir": report.run_dir.display().to_string(),
        "record_error": record_error(&report.record),
        "emulated": report.emulated.as_ref().map(emulated_json),
    })
}

/// What the motion has proved, from its record.
fn proof_of(report: &RunReport) -> Option<String> {
    proof(&std::fs::read_to_string(report.run_dir.join(file::EVENTS)).ok()?)
}

/// The summary, the stop reason last.
fn summary(
    config: &Config,
    path: Option<&Path>,
    motion: &Motion,
    done: &[Done],
    report: &RunReport,
) -> String {
    let line = |done: &Done| {
        let (to, unit) = done.axis.in_unit(done.to);
        let axis = done.axis;
        match done.from.map(|from| axis.in_unit(from).0) {
            Some(from) => format!("{axis:<11} from {from:.3} to {to:.3} {unit}"),
            None => format!("{axis:<11} home, at {to:.3} {unit}"),
        }
    };
    let rest = motion.remaining(done, config.stage.insertion.limits.min);
    let left = after_operation(config, path, rest.as_deref(), report);
    let lines: Vec<String> =
        done.iter().map(line).chain(left).chain([ending(config, report)]).collect();
    lines.join("\n")
}
