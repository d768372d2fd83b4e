//! `needle-bench check`: what a run would start with. Nothing moves.

use super::output::{number_in, say, show, tell};
use super::plan::mask_reader;
use super::preflight::Preflight;
use super::sources::{Configured, load_with_warnings};
use super::{BAD_CONFIGURATION, ENVIRONMENT_FAILED, Failure};
use crate::config::Config;
use crate::preflight::to_text;
use crate::stage::{Axis, AxisStatus};
use clap::Args;
use serde_json::{Value, json};
use std::process::ExitCode;
use std::time::Duration;

#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(flatten)]
    configured: Configured,
    /// Read the drives' identity and position, and listen to the tracker.
    #[arg(long)]
    connect: bool,
    /// How long to listen to the tracker, s.
    #[arg(long, value_name = "SECONDS", default_value_t = 2.0, requires = "connect",
          value_parser = number_in(0.1..=3600.0, "seconds"))]
    listen: f64,
    /// Print the whole configuration as it would be used.
    #[arg(long, conflicts_with = "json")]
    print: bool,
    /// Print every key with what it means, what it may be, and its default, as a TOML file.
    #[arg(long, conflicts_with_all = ["config", "named", "set", "connect", "print", "json", "schema"])]
    reference: bool,
    /// Print a JSON Schema of the configuration, for editors.
    #[arg(long, conflicts_with_all = ["config", "named", "set", "connect", "print", "json"])]
    schema: bool,
    /// One JSON object on stdout.
    #[arg(long)]
    pub(super) json: bool,
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
    let (config, warnings) =
        load_with_warnings(arguments.configured.path(), None, &arguments.configured.set)?;
    for warning in &warnings {
        tell(format_args!("warning: {warning}"));
    }
    check_goal(&config, arguments)?;
    if arguments.print {
        say(config.to_toml().map_err(Failure::environment)?.trim_end())?;
        return Ok(ExitCode::SUCCESS);
    }
    let mut report = json!({ "configuration": "ok", "name": config.name });
    if !arguments.connect {
        if arguments.json {
            report["warnings"] = json!(warnings);
            report["troubles"] = json!([]);
            say(report)?;
        } else {
            say(format_args!("configuration: ok\nname: {}", config.name))?;
        }
        return Ok(ExitCode::SUCCESS);
    }
    let preflight = Preflight::look(&config, Duration::from_secs_f64(arguments.listen))?;
    let troubles = preflight.troubles();
    let error = troubles.join("\n       ");
    if !troubles.is_empty() {
        tell(format_args!("error: {error}"));
        report["error"] = json!(error);
    }
    if arguments.json {
        report["drives"] = match config.is_emulated() {
            true => json!("emulated in memory, nothing to connect to"),
            false => preflight.drives.iter().map(|(axis, status)| drive(*axis, status)).collect(),
        };
        report["tracker"] = match &preflight.tracker {
            Some(heard) => json!(heard),
            None => json!("emulated, nothing to listen to"),
        };
        report["warnings"] = json!(warnings);
        report["troubles"] = json!(troubles);
        report["checks"] = json!(preflight.checks);
        say(report)?;
    } else {
        show(to_text(&preflight.checks))?;
    }
    Ok(match (troubles.len(), config.tracker.registration.is_none()) {
        (0, _) => ExitCode::SUCCESS,
        // Nothing fails but what the configuration lacks.
        (1, true) => ExitCode::from(BAD_CONFIGURATION),
        _ => ExitCode::from(ENVIRONMENT_FAILED),
    })
}

/// Checks what a run would be told, and plans its path to the target, with the masks.
fn check_goal(config: &Config, arguments: &Arguments) -> Result<(), Failure> {
    let read_mask = mask_reader(arguments.configured.path());
    let goal = config.to_goal(&read_mask).map_err(Failure::configuration)?;
    goal.map_err(Failure::configuration)?;
    // Without a registration the tracker can still be looked at; the list says that it is missing.
    if arguments.connect && config.tracker.registration.is_none() {
        return Ok(());
    }
    config.session_without_goal().map(drop).map_err(Failure::configuration)
}

/// A drive as it describes itself.
fn drive(axis: Axis, status: &AxisStatus) -> Value {
    json!({
        "axis": axis.to_string(),
        "node": status.node.get(),
        "device_type": status.device_type,
        "vendor_id": status.identity.vendor,
        "product_code": status.identity.product,
        "statusword": status.statusword.0,
        "position_counts": status.position_counts,
    })
}
