//! `needle-bench stop`: quick stop of both drives, whichever program moves them.

use super::output::{say, tell};
use super::perform::open_bus;
use super::runs::{RUNS, last_run_on_a_bus};
use super::sources::{Configured, load};
use super::{ENVIRONMENT_FAILED, Failure};
use crate::canopen::Frame;
use crate::config::{Source, StopConfig};
use crate::runtime::{BusTrouble, Clock, talk_despite_errors};
use crate::stage::{Axis, Halt};
use clap::Args;
use serde_json::json;
use std::fs;
use std::path::Path;
use std::process::ExitCode;

#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(flatten)]
    pub(super) configured: Configured,
    /// One JSON object on stdout.
    #[arg(long)]
    pub(super) json: bool,
    /// Flags of other commands that a hurried operator may leave: no stop is refused for them.
    #[arg(long, short, hide = true)]
    quiet: bool,
    #[arg(long, hide = true)]
    yes: bool,
    #[arg(long, hide = true)]
    realtime: bool,
}

/// Stops both axes. Errors of the configuration other than the bus and the nodes are reported after
/// the stop.
pub(super) fn stop(
    config: Option<&Path>,
    sets: &[String],
    as_json: bool,
) -> Result<ExitCode, Failure> {
    let settings = settings(config, sets)?;
    let mut bus = open_bus(&settings.interface).map_err(|failure| match failure {
        Failure::Configuration(message) | Failure::Environment(message) => {
            Failure::Environment(format!("nothing was stopped: {message}; use the emergency stop"))
        }
    })?;
    let clock = Clock::start();
    let begun = clock.now();
    let mut halt = Halt::new(&settings.stage, begun);
    let give_up = begun + settings.stage.stop_timeout;
    let trouble = talk_despite_errors(&mut halt, bus.as_mut(), clock, give_up);
    let status = report(&halt, &trouble, as_json);
    let checked = load(config, None, sets)
        .and_then(|config| config.stage.to_stage(&config.can).map_err(Failure::configuration));
    if let Err(Failure::Configuration(message) | Failure::Environment(message)) = checked {
        tell(format_args!(
            "warning: the stop was sent, but every other command would refuse this configuration:\n\
             {message}"
        ));
    }
    status
}

fn settings(config: Option<&Path>, sets: &[String]) -> Result<StopConfig, Failure> {
    let (mut problems, mut source) = (Vec::new(), None);
    match config.map(|path| (path, fs::read(path))) {
        Some((path, Ok(bytes))) => {
            // A byte that is no text, in a comment, does not keep a stop from being sent.
            let text = String::from_utf8_lossy(&bytes).into_owned();
            source = Some((path.display().to_string(), text));
        }
        Some((path, Err(error))) => {
            problems.push(format!("{}: cannot be read: {error}", path.display()));
        }
        None => {}
    }
    let source = source.as_ref().map(|(name, text)| Source { name, text });
    StopConfig::from_source(source, sets).map_err(|error| {
        problems.extend([error.to_string(), format!("nothing was stopped: {}", name_the_stage())]);
        Failure::Configuration(problems.join("\n"))
    })
}

/// A hint how to name the stage to stop.
fn name_the_stage() -> String {
    let last = last_run_on_a_bus(Path::new(RUNS)).map(|config| {
        format!("\nthe last run on a bus: needle-bench stop --config {}", config.display())
    });
    format!(
        "name the stage, needle-bench stop --config my-rig.toml or needle-bench stop --set \
         can.interface=can0 --set stage.insertion.node=1 --set stage.rotation.node=2{}",
        last.unwrap_or_default()
    )
}

/// Reports which stops were confirmed, which were not, and which frames were not sent.
fn report(halt: &Halt, trouble: &BusTrouble, as_json: bool) -> Result<ExitCode, Failure> {
    let mut object = json!({});
    let (mut errors, mut stands) = (Vec::new(), Vec::new());
    for axis in Axis::BOTH {
        let counts = halt.result(axis).and_then(|result| result.map_err(|e| errors.push(e)).ok());
        if let (Some(counts), false) = (counts, as_json) {
            stands.push(format!("{axis:<11} stands without power, at {counts} counts"));
        }
        let is_standing = counts.is_some();
        object[axis.to_string()] = json!({ "stands": is_standing, "position_counts": counts });
    }
    let first = trouble.first.as_ref().map(ToString::to_string).unwrap_or_default();
    if !trouble.unsent.is_empty() {
        errors.push(format!("not sent: {}: {first}", listed(&trouble.unsent)));
    } else if trouble.first.is_some() {
        tell(format_args!(
            "warning: every frame was sent in the end, after {} refusals: {first}",
            trouble.refused
        ));
    }
    for error in &errors {
        tell(format_args!("error: {error}"));
    }
    let is_confirmed = errors.is_empty();
    if !is_confirmed {
        tell("an axis whose stop was not confirmed may still move: use the emergency stop");
    }
    // Stdout comes last: if it blocks, everything on stderr was written already.
    for line in stands {
        say(line)?;
    }
    if as_json {
        if !is_confirmed {
            object["error"] = json!(errors.join("; "));
        }
        say(object)?;
    }
    Ok(if is_confirmed { ExitCode::SUCCESS } else { ExitCode::from(ENVIRONMENT_FAILED) })
}

fn listed(frames: &[Frame]) -> String {
    frames.iter().map(Frame::to_string).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// As an editor that writes Latin-1 saves a degree sign.
    #[test]
    fn a_byte_that_is_no_text_does_not_keep_a_stop_from_being_sent() {
        let path = std::env::temp_dir().join(format!("needle-bench-stop-{}", std::process::id()));
        let text = b"# 90\xb0\n[can]\ninterface = \"can7\"\n[stage.insertion]\nnode = 3\n\
                     [stage.rotation]\nnode = 4\n";
        fs::write(&path, text).unwrap();
        let read = settings(Some(&path), &[]);
        fs::remove_file(&path).unwrap();
        let Ok(read) = read else { panic!("it was refused") };
        assert_eq!(read.interface.to_string(), "can7");
        assert_eq!((read.stage.insertion.node.get(), read.stage.rotation.node.get()), (3, 4));
    }
}
