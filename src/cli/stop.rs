//! `needle-bench stop`: quick stop of both drives, whatever program moves them.

use super::arguments::Configured;
use super::output::{print_stderr, print_stdout};
use super::perform::open_bus;
use super::records::last_run_on_a_bus;
use super::{ENVIRONMENT_FAILED, Failure, Result, finish_with};
use crate::canopen::Frame;
use crate::config::{Source, StopConfig};
use crate::runtime::{BusErrors, Clock, talk_live};
use crate::stage::{Axis, QuickStop};
use clap::Args;
use serde_json::json;
use std::fs;

#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(flatten)]
    pub(super) configured: Configured,
    /// One JSON object on stdout.
    #[arg(long)]
    pub(super) json: bool,
    /// Flags of other commands, accepted without effect: a stop must not fail because they were left in.
    #[arg(long, short, hide = true)]
    quiet: bool,
    #[arg(long, hide = true)]
    yes: bool,
    #[arg(long, hide = true)]
    realtime: bool,
}

/// Stops both axes. Errors of the configuration other than the bus and the nodes are reported after
/// the stop.
pub(super) fn stop(configured: &Configured, as_json: bool) -> Result<()> {
    let settings = settings(configured)?;
    let mut bus = open_bus(&settings.interface).map_err(|failure| {
        Failure::environment(format_args!("nothing was stopped: {failure}; use the emergency stop"))
    })?;
    let clock = Clock::start();
    let begun = clock.now();
    let mut quick_stop = QuickStop::new(&settings.stage, begun);
    let deadline = begun + settings.stage.power.stop_timeout;
    let trouble = talk_live(&mut quick_stop, bus.as_mut(), clock, Some(deadline));
    let status = report(&quick_stop, &trouble, as_json);
    let checked = configured.load(None).and_then(|config| Ok(config.to_stage()?));
    if let Err(failure) = checked {
        print_stderr(format_args!(
            "warning: the stop was sent, but every other command would refuse this configuration:\n\
             {failure}"
        ));
    }
    status
}

fn settings(configured: &Configured) -> Result<StopConfig> {
    let (mut problems, mut source) = (Vec::new(), None);
    if let Some(path) = configured.path() {
        let name = path.display().to_string();
        match fs::read(path) {
            // A byte that is not UTF-8, in a comment say, must not prevent the stop.
            Ok(bytes) => source = Some((name, String::from_utf8_lossy(&bytes).into_owned())),
            Err(error) => problems.push(format!("{name}: cannot be read: {error}")),
        }
    }
    let source = source.as_ref().map(|(name, text)| Source { name, text });
    StopConfig::from_source(source, &configured.set).map_err(|error| {
        problems.push(format!(
            "{error}\nnothing was stopped: name the stage, needle-bench stop --config my-rig.toml or \
             needle-bench stop --set can.interface=can0 --set stage.insertion.node=1 --set \
             stage.rotation.node=2{}",
            last_run_on_a_bus("needle-bench stop ")
        ));
        Failure::configuration(problems.join("\n"))
    })
}

/// Reports which stops were confirmed, which were not, and which frames were not sent.
fn report(quick_stop: &QuickStop, trouble: &BusErrors, as_json: bool) -> Result<()> {
    let mut object = json!({});
    let (mut errors, mut confirmed) = (Vec::new(), Vec::new());
    for axis in Axis::BOTH {
        let counts =
            quick_stop.outcome(axis).and_then(|result| result.map_err(|e| errors.push(e)).ok());
        let line = |counts| format!("{axis:<11} stands without power, at {counts} counts");
        confirmed.extend(counts.map(line));
        let is_standing = counts.is_some();
        object[axis.to_string()] = json!({ "stands": is_standing, "position_counts": counts });
    }
    let first_error = trouble.first.as_ref().map(ToString::to_string).unwrap_or_default();
    if !trouble.unsent.is_empty() {
        let unsent: Vec<String> = trouble.unsent.iter().map(Frame::to_string).collect();
        errors.push(format!("not sent: {}: {first_error}", unsent.join(", ")));
    } else if trouble.first.is_some() {
        print_stderr(format_args!(
            "warning: every frame was sent in the end, after {} refusals: {first_error}",
            trouble.refused
        ));
    }
    for error in &errors {
        print_stderr(format_args!("error: {error}"));
    }
    let is_confirmed = errors.is_empty();
    if !is_confirmed {
        object["error"] = json!(errors.join("; "));
        print_stderr("an axis whose stop was not confirmed may still move: use the emergency stop");
    }
    // Stdout comes last: if it blocks, everything on stderr was written already.
    match as_json {
        true => print_stdout(object)?,
        false => confirmed.iter().try_for_each(print_stdout)?,
    }
    finish_with(if is_confirmed { 0 } else { ENVIRONMENT_FAILED })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An editor that writes Latin-1 saves a degree sign as this byte.
    #[test]
    fn a_byte_that_is_not_utf8_does_not_prevent_a_stop() {
        let path = std::env::temp_dir().join(format!("needle-bench-stop-{}", std::process::id()));
        let text = b"# 90\xb0\n[can]\ninterface = \"can7\"\n[stage.insertion]\nnode = 3\n\
                     [stage.rotation]\nnode = 4\n";
        fs::write(&path, text).unwrap();
        let read = settings(&Configured::new(Some(&path), vec![]));
        fs::remove_file(&path).unwrap();
        let Ok(read) = read else { panic!("it was refused") };
        assert_eq!(read.interface.to_string(), "can7");
        assert_eq!((read.stage.insertion.node.get(), read.stage.rotation.node.get()), (3, 4));
    }
}
