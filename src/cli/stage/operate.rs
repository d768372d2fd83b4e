//! `home`, `jog`, `withdraw` and `prove`: a run without a needle's steering, and its record.

use super::super::Failure;
use super::super::about::About;
use super::super::after::after_operation;
use super::super::ending::{ending, record_error, status};
use super::super::output::{say, show};
use super::super::perform::{Job, Performed, emulated_json};
use super::super::realtime::RealTimeArguments;
use super::{Arguments, Common, Operation};
use crate::archive::{RunOutcome, file, proof};
use crate::config::Config;
use crate::runtime::RunReport;
use crate::session::Done;
use serde_json::{Value, json};
use std::path::Path;
use std::process::ExitCode;

/// Does the operation of `arguments`, and says what came of it. `path` is the file that `config` is, where
/// nothing was set besides.
pub(super) fn operate(
    config: &Config,
    path: Option<&Path>,
    common: &Common,
    arguments: &Arguments,
) -> Result<ExitCode, Failure> {
    let operation = &arguments.operation;
    let job = Job {
        config,
        plan: operation.plan(config)?.into(),
        operation: Some(operation),
        about: &common.about,
        realtime: arguments.realtime,
        live: None,
        quiet: arguments.quiet,
        console: None,
        paced: false,
    };
    let Performed { report, done, .. } = job.perform()?;
    match arguments.json {
        true => say(to_json(operation.name(), &done, &report))?,
        false => {
            show(summary(config, path, operation, &done, &report))?;
            if let Some(proof) = proof_of(&report) {
                show(proof)?;
            }
        }
    }
    Ok(ExitCode::from(status(config, &report)))
}

/// Does what these `words` say, as on the command line of `stage`: the report and its last lines. An emulated
/// stage that is `paced` takes as long as a rig.
pub(in crate::cli) fn perform(
    config: &Config,
    words: &[&str],
    paced: bool,
) -> Result<(RunReport, String), Failure> {
    let operation = Operation::of(words).map_err(Failure::configuration)?;
    let job = Job {
        config,
        plan: operation.plan(config)?.into(),
        operation: Some(&operation),
        about: &About::default(),
        realtime: RealTimeArguments::default(),
        live: None,
        quiet: false,
        console: None,
        paced,
    };
    let Performed { report, done, .. } = job.perform()?;
    let summary = summary(config, None, &operation, &done, &report);
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

/// What the operation has proved, as its record says.
fn proof_of(report: &RunReport) -> Option<String> {
    proof(&std::fs::read_to_string(report.run_dir.join(file::EVENTS)).ok()?)
}

/// The summary, the stop reason last.
fn summary(
    config: &Config,
    path: Option<&Path>,
    operation: &Operation,
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
    let rest = operation.rest(done);
    let left = after_operation(config, path, rest.as_deref(), report);
    let lines: Vec<String> = done.iter().map(line).chain(left).chain([ending(report)]).collect();
    lines.join("\n")
}
