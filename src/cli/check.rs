//! `needle-bench check`: checks a configuration and, with --connect, the equipment. Nothing moves.

use super::arguments::{Configured, number_in};
use super::mask::{file_crc32, mask_reader, print_warning, warn_of_far_obstacles};
use super::output::{print_stderr, print_stdout, print_wrapped};
use super::preflight::{Preflight, troubles};
use super::stage::drive_json;
use super::{BAD_CONFIGURATION, ENVIRONMENT_FAILED, Failure, Result, finish_with};
use crate::config::Config;
use crate::preflight::to_text;
use clap::Args;
use serde_json::json;
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
    #[arg(long, conflicts_with_all = ["json", "connect"])]
    print: bool,
    /// Print every key with what it means, what it may be, and its default, as a TOML file.
    #[arg(long, conflicts_with_all = ["config", "named", "set", "connect", "print", "json", "schema"])]
    reference: bool,
    /// Print a JSON Schema of the configuration, for editors.
    #[arg(long, conflicts_with_all = ["config", "named", "set", "connect", "print", "json"])]
    schema: bool,
    /// One JSON object on stdout.
    #[arg(long)]
    json: bool,
}

pub(super) fn check(arguments: &Arguments) -> Result<()> {
    if arguments.reference || arguments.schema {
        let text = match arguments.schema {
            true => format!("{:#}", Config::json_schema()),
            false => Config::reference(),
        };
        return print_stdout(text.trim_end());
    }
    let (config, warnings) = arguments.configured.load_with_warnings()?;
    let goal = config.to_goal(&mask_reader(arguments.configured.path(), print_warning))?;
    if let Some(goal) = goal.map_err(Failure::configuration)? {
        warn_of_far_obstacles(&goal.world, goal.problem.clearance_mm);
    }
    // Without a registration the tracker can still be checked; the checks say that it is missing.
    if !arguments.connect || config.tracker.registration.is_some() {
        config.session_without_goal()?;
    }
    if arguments.print {
        let config = arguments.configured.completed(&config, |mask| file_crc32(mask).ok());
        return print_stdout(config.to_toml().map_err(Failure::environment)?.trim_end());
    }
    let mut report = json!({
        "configuration": "ok",
        "name": config.name,
        "warnings": warnings,
        "troubles": [],
    });
    if !arguments.connect {
        return match arguments.json {
            true => print_stdout(report),
            false => print_stdout(format_args!("configuration: ok\nname: {}", config.name)),
        };
    }
    let preflight = Preflight::inspect(&config, &config, Duration::from_secs_f64(arguments.listen));
    let troubles = troubles(&preflight.checks);
    if !troubles.is_empty() {
        print_stderr(format_args!("error: {}", troubles.join("\n       ")));
        report["error"] = json!(troubles.join("; "));
    }
    if arguments.json {
        report["drives"] = match config.is_emulated() {
            true => json!("emulated in memory, nothing to connect to"),
            false => {
                preflight.drives.iter().map(|(axis, status)| drive_json(*axis, status)).collect()
            }
        };
        report["tracker"] = match &preflight.tracker {
            Some(report) => json!(report),
            None => json!("emulated, nothing to listen to"),
        };
        report["troubles"] = json!(troubles);
        report["checks"] = json!(preflight.checks);
        print_stdout(report)?;
    } else {
        print_wrapped(to_text(&preflight.checks))?;
    }
    finish_with(match (troubles.len(), config.tracker.registration.is_none()) {
        (0, _) => 0,
        // The missing registration is the only trouble.
        (1, true) => BAD_CONFIGURATION,
        _ => ENVIRONMENT_FAILED,
    })
}
