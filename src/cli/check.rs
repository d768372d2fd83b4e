//! `needle-bench check`: what a run would start with. Nothing moves.

use super::output::{say, tell};
use super::perform::open_bus;
use super::plan::task;
use super::sources::load_with_warnings;
use super::tracker::open_tracker;
use super::{ENVIRONMENT_FAILED, Failure, io_runtime};
use crate::config::{CanInterface, Config, GoalKind, TrackerSource};
use crate::runtime::{Clock, probe_tracker, talk_live};
use crate::stage::{Axis, AxisStatus, StatusReader};
use clap::Args;
use serde_json::{Value, json};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Configuration; without one, bench-config/virtual.toml.
    config: Option<PathBuf>,
    /// Set a key of the configuration.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Read the drives' identity and position, and listen to the tracker.
    #[arg(long)]
    connect: bool,
    /// How long to listen to the tracker, s.
    #[arg(long, value_name = "SECONDS", default_value_t = 2.0, value_parser = listening_time)]
    listen: f64,
    /// Print the whole configuration as it would be used.
    #[arg(long, conflicts_with = "json")]
    print: bool,
    /// Print every key with what it means, what it may be, and its default, as a TOML file.
    #[arg(long, conflicts_with_all = ["config", "set", "connect", "print", "json", "schema"])]
    reference: bool,
    /// Print a JSON Schema of the configuration, for editors.
    #[arg(long, conflicts_with_all = ["config", "set", "connect", "print", "json"])]
    schema: bool,
    /// One JSON object on stdout.
    #[arg(long)]
    pub(super) json: bool,
}

fn listening_time(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(seconds) if (0.1..=3600.0).contains(&seconds) => Ok(seconds),
        _ => Err("0.1 to 3600 seconds".to_owned()),
    }
}

pub(super) fn check(arguments: &Arguments) -> Result<ExitCode, Failure> {
    if arguments.reference || arguments.schema {
        let text = match arguments.schema {
            true => format!("{:#}", Config::json_schema()),
            false => Config::reference(),
        };
        say(text.trim_end())?;
        return Ok(ExitCode::SUCCESS);
    }
    let (config, warnings) = load_with_warnings(arguments.config.as_deref(), None, &arguments.set)?;
    for warning in &warnings {
        tell(format_args!("warning: {warning}"));
    }
    check_goal(&config, arguments)?;
    if arguments.print {
        say(config.to_toml().map_err(Failure::environment)?.trim_end())?;
        return Ok(ExitCode::SUCCESS);
    }
    let mut report = json!({ "configuration": "ok", "name": config.name });
    let mut troubles = Vec::new();
    if arguments.connect {
        report["drives"] = match config.bus() {
            CanInterface::Memory => json!("emulated in memory, nothing to connect to"),
            CanInterface::Udp(_) | CanInterface::Socket(_) => drives(&config, &mut troubles)?,
        };
        report["tracker"] = match config.tip_source() {
            TrackerSource::Emulated => json!("emulated, nothing to listen to"),
            _ => tracker(&config, arguments, &mut troubles)?,
        };
    }
    let error = (!troubles.is_empty()).then(|| troubles.join("\n       "));
    if let Some(error) = &error {
        tell(format_args!("error: {error}"));
    }
    if arguments.json {
        report["warnings"] = json!(warnings);
        report["troubles"] = json!(troubles);
        if let Some(error) = &error {
            report["error"] = json!(error);
        }
        say(report)?;
    } else {
        for (what, found) in report.as_object().into_iter().flatten() {
            let found = found.as_str().map_or_else(|| found.to_string(), str::to_owned);
            say(format_args!("{what}: {found}"))?;
        }
    }
    Ok(error.map_or(ExitCode::SUCCESS, |_| ExitCode::from(ENVIRONMENT_FAILED)))
}

/// Checks what a run would be told, and the target with its masks.
fn check_goal(config: &Config, arguments: &Arguments) -> Result<(), Failure> {
    if config.goal.kind == GoalKind::Target {
        let (world, problem) = task(config, arguments.config.as_deref())?;
        let inside_mm = -world.distance_mm(&problem.target_mm);
        if inside_mm > 0.0 {
            return Err(Failure::Configuration(format!(
                "goal.position_mm is {inside_mm:.1} mm inside an obstacle; move one of the two"
            )));
        }
    }
    let mut of_a_run = config.clone();
    of_a_run.goal.kind = GoalKind::Plane;
    of_a_run.session().map(|_| ()).map_err(Failure::configuration)
}

fn drives(config: &Config, troubles: &mut Vec<String>) -> Result<Value, Failure> {
    let stage = config.stage.to_stage(&config.can).map_err(Failure::configuration)?;
    let mut bus = open_bus(config.bus())?;
    let clock = Clock::start();
    let mut reader = StatusReader::new(&stage, clock.now());
    if let Err(error) = talk_live(&mut reader, bus.as_mut(), clock) {
        troubles.push(error.to_string());
        return Ok(json!([]));
    }
    let mut found = Vec::new();
    for axis in Axis::BOTH {
        match reader.status(axis).and_then(|status| drive(axis, &status)) {
            Ok(drive) => found.push(drive),
            Err(trouble) => troubles.push(trouble),
        }
    }
    Ok(Value::Array(found))
}

/// What a run needs of a drive: its device type and its position have to be there.
fn drive(axis: Axis, status: &AxisStatus) -> Result<Value, String> {
    let node = status.node;
    let lacks = |what: &str| format!("{axis}: node {node} does not give its {what}");
    let device_type = status.device_type.ok_or_else(|| lacks("device type (0x1000)"))?;
    let position_counts = status.position_counts.ok_or_else(|| lacks("position (0x6064)"))?;
    Ok(json!({
        "axis": axis.to_string(),
        "node": node.get(),
        "device_type": device_type,
        "vendor_id": status.identity.vendor,
        "product_code": status.identity.product,
        "statusword": status.statusword.0,
        "position_counts": position_counts,
    }))
}

fn tracker(
    config: &Config,
    arguments: &Arguments,
    troubles: &mut Vec<String>,
) -> Result<Value, Failure> {
    let runtime = io_runtime()?;
    let gate = config.tracker.to_gate().map_err(Failure::configuration)?;
    let registration = gate.registration;
    let clock = Clock::start();
    let mut link = open_tracker(config, &runtime, clock)?;
    let duration = Duration::from_secs_f64(arguments.listen);
    let tool = &config.tracker.tool;
    let report = probe_tracker(&mut link, &gate, &registration, tool, clock, duration, &runtime);
    troubles.extend(report.trouble.clone());
    Ok(json!(report))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::canopen::NodeId;
    use crate::canopen::cia402::Statusword;
    use crate::stage::Identity;

    #[test]
    fn a_drive_without_position_is_no_drive() {
        let status = AxisStatus {
            node: NodeId::new(1).unwrap(),
            device_type: Some(0x0002_0192),
            identity: Identity { vendor: 0xfb, product: 7, revision: None, serial: None },
            statusword: Statusword(0x0240),
            mode: None,
            position_counts: Some(-5),
            position: None,
            homed: None,
            error_code: None,
            digital_inputs: None,
            nmt_state: None,
        };
        let given = drive(Axis::Insertion, &status).unwrap();
        let expected = json!({
            "axis": "insertion", "node": 1, "device_type": 0x0002_0192, "vendor_id": 0xfb,
            "product_code": 7, "statusword": 0x0240, "position_counts": -5,
        });
        assert_eq!(given, expected);
        let silent = AxisStatus { position_counts: None, ..status };
        assert_eq!(
            drive(Axis::Insertion, &silent).unwrap_err(),
            "insertion: node 1 does not give its position (0x6064)"
        );
    }
}
