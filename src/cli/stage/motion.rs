//! `home`, `jog`, `withdraw` and `prove`: runs without a needle to steer, and their records.

use super::{Arguments, Motion};
use crate::archive::{file, proof};
use crate::cli::ending::{after_operation, ending, status};
use crate::cli::output::{merged, print_result, print_stderr};
use crate::cli::perform::{Job, Options, Performed, end_json};
use crate::cli::{Failure, Result, finish_with};
use crate::config::Config;
use crate::emulator::drive::HOMING_METHODS;
use crate::operation::{Operation, RunConfig};
use crate::runtime::RunReport;
use crate::session::AxisMove;
use crate::stage::{Axis, HomingConfig};
use serde_json::{Value, json};
use std::path::Path;

/// Runs the `motion` of `arguments` and prints its result. `path` is the file of `config` if no key overrides it.
pub(super) fn operate(
    config: &Config,
    path: Option<&Path>,
    motion: &Motion,
    arguments: &Arguments,
) -> Result<()> {
    let options = Options {
        about: motion.common().about.clone(),
        realtime: arguments.realtime,
        quiet: arguments.quiet,
        ..Options::default()
    };
    let performed = job(config, motion, options)?.perform()?;
    let proof = proof_of(&performed.report);
    let object = to_json(motion.name(), &performed, &proof);
    let is_emulated = config.is_emulated() || !config.stage.hardware;
    if matches!(motion, Motion::Prove { handedness: true, .. }) && is_emulated && proof.is_some() {
        print_stderr(
            "emulated    the drives take their signs from the configuration: this proves nothing about a rig",
        );
    }
    let text = [summary(config, path, motion, &performed)].into_iter().chain(proof);
    print_result(arguments.json, &object, || Ok(text.collect::<Vec<_>>().join("\n")))?;
    finish_with(status(config, &performed.report))
}

/// Runs the motion that `line` describes as on the command line of `stage`, and prints its summary on stderr.
pub(in crate::cli) fn perform(config: &Config, line: &str, options: Options) -> Result<RunReport> {
    let motion = Motion::of(line).map_err(Failure::configuration)?;
    let performed = job(config, &motion, options)?.perform()?;
    print_stderr(summary(config, None, &motion, &performed));
    Ok(performed.report)
}

fn job<'a>(config: &'a Config, motion: &'a Motion, options: Options) -> Result<Job<'a>> {
    if let (Motion::Home { axis, .. }, Some(homing)) = (motion, config.stage.insertion.homing)
        && *axis != Some(Axis::Rotation)
        && homing.may_move_either_way()
    {
        print_stderr(format_args!(
            "warning: stage.insertion.homing.method is {}: the bench cannot know in which direction the axis moves, \
             see the drive's manual and its home switch; the needle must be off",
            homing.method
        ));
    }
    let run_config = motion.plan(config)?;
    if let RunConfig::Operation(_, Operation::Home { axes, .. }) = &run_config
        && config.is_emulated()
    {
        for axis in Axis::BOTH.into_iter().filter(|axis| axes[*axis]) {
            check_emulated_homing(axis, config.stage.axis(axis).homing)?;
        }
    }
    Ok(Job { config, run_config, motion: Some(motion), options })
}

/// Refuses a homing method of `axis` that no emulated drive has.
fn check_emulated_homing(axis: Axis, homing: Option<HomingConfig>) -> Result<()> {
    match homing {
        Some(HomingConfig { method, .. }) if !HOMING_METHODS.contains(&method) => {
            let methods = HOMING_METHODS.map(|method| method.to_string()).join(", ");
            let key = format!("stage.{axis}.homing.method");
            Err(Failure::configuration(format_args!(
                "{key} is {method}, which the emulated drives lack; they have {methods}: rehearse with \
                 one of these (--set {key}=N)"
            )))
        }
        _ => Ok(()),
    }
}

fn to_json(name: &str, performed: &Performed, proof: &Option<String>) -> Value {
    let axis = |done: &AxisMove| {
        let (to, unit) = done.axis.in_unit(done.to);
        let from = done.from.map(|from| done.axis.in_unit(from).0);
        let mut object = json!({ "axis": done.axis.to_string() });
        object[format!("from_{unit}")] = json!(from);
        object[format!("to_{unit}")] = json!(to);
        object
    };
    let object = json!({
        "operation": name,
        "axes": performed.done.iter().map(axis).collect::<Vec<_>>(),
        "proof": proof,
    });
    merged(object, &end_json(&performed.report))
}

/// What the motion has proved, from its record.
fn proof_of(report: &RunReport) -> Option<String> {
    proof(&std::fs::read_to_string(report.run_dir.as_ref()?.join(file::EVENTS)).ok()?)
}

/// The summary, the stop reason last.
fn summary(config: &Config, path: Option<&Path>, motion: &Motion, performed: &Performed) -> String {
    let Performed { report, done, .. } = performed;
    let line = |done: &AxisMove| {
        let (to, unit) = done.axis.in_unit(done.to);
        let axis = done.axis;
        match done.from.map(|from| axis.in_unit(from).0) {
            Some(from) => format!("{axis:<11} from {from:.3} to {to:.3} {unit}"),
            None => format!("{axis:<11} home, at {to:.3} {unit}"),
        }
    };
    let remaining = motion.remaining(done, config.stage.insertion.limits.min);
    let next = after_operation(config, path, remaining.as_deref(), report);
    let lines = done.iter().map(line).chain(next).chain([ending(config, report)]);
    lines.collect::<Vec<_>>().join("\n")
}
