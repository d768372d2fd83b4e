//! `needle-bench tracker`: looks at the tracker without a run; and opens the source of tip positions
//! that the configuration names.

mod list;
mod listen;
mod record;
mod rest;
mod watch;

pub(super) use self::listen::{Listener, listen};

use super::Failure;
use super::sources::text_of;
use crate::config::{Config, TrackerConfig, TrackerMode, TrackerSource};
use crate::runtime::Clock;
use crate::tracker::{Replay, csv, ndjson};
use crate::transport::link::{Link, LinkSettings};
use crate::units::Time;
use clap::{Args, Subcommand};
use std::path::Path;
use std::process::ExitCode;
use tokio::net::TcpListener;
use tokio::runtime::Runtime;

#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(subcommand)]
    look: Look,
}

#[derive(Debug, Subcommand)]
enum Look {
    /// The tools that the tracker sends, with types and rates.
    #[command(after_help = "Examples:\n  needle-bench tracker list my-rig.toml")]
    List(list::Arguments),
    /// One line a second: position, rate, age, refusals; until Ctrl-C.
    #[command(after_help = "Examples:\n  needle-bench tracker watch my-rig.toml")]
    Watch(watch::Arguments),
    /// Write the tool's positions to a file; until Ctrl-C.
    #[command(after_help = "Examples:\n  needle-bench tracker record touched.csv my-rig.toml")]
    Record(record::Arguments),
    /// Measure the tracker's noise while the tool is at rest, as `calibrate tracker` does.
    #[command(after_help = "Examples:\n  needle-bench tracker rest my-rig.toml --out noise.toml")]
    Rest(rest::Arguments),
}

pub(super) fn tracker(arguments: &Arguments) -> Result<ExitCode, Failure> {
    match &arguments.look {
        Look::List(arguments) => list::list(arguments),
        Look::Watch(arguments) => watch::watch(arguments),
        Look::Record(arguments) => record::record(arguments),
        Look::Rest(arguments) => rest::rest(arguments),
    }
}

/// The stream of the tracker's tool, and of the target where that is one, in real time.
pub(super) fn open_tracker(
    config: &Config,
    runtime: &Runtime,
    clock: Clock,
) -> Result<Link, Failure> {
    let tools = [Some(&config.tracker.tool), config.goal.tool.as_ref()];
    open(config, tools.into_iter().flatten().cloned().collect(), runtime, clock)
}

/// The stream of `tools`, or of every tool where none is named, in real time.
fn open(
    config: &Config,
    tools: Vec<String>,
    runtime: &Runtime,
    clock: Clock,
) -> Result<Link, Failure> {
    let tracker = &config.tracker;
    let source = config.tip_source();
    let now = move || clock.now();
    let settings = LinkSettings {
        protocol: tracker.to_protocol(),
        tools,
        request: tracker.to_request(),
        ..LinkSettings::default()
    };
    if let Some(replay) = replay(tracker, clock.now())? {
        let _in_runtime = runtime.enter();
        return Ok(Link::replay(replay, &settings, now));
    }
    let address = &tracker.address;
    match (source, tracker.mode) {
        (TrackerSource::Emulated, _) => Err(Failure::Configuration(
            "tracker.source = \"emulated\" belongs to can.interface = \"memory\"".to_owned(),
        )),
        _ if tracker.is_standard_input() => {
            Ok(Link::read(std::io::stdin(), "standard input", settings, now))
        }
        (_, TrackerMode::Connect) => {
            let _in_runtime = runtime.enter();
            Ok(Link::connect(address, settings, now))
        }
        (_, TrackerMode::Listen) => {
            let listener = runtime.block_on(TcpListener::bind(address)).map_err(|error| {
                Failure::Environment(format!("tracker: cannot listen at {address}: {error}"))
            })?;
            let _in_runtime = runtime.enter();
            Ok(Link::listen(listener, settings, now))
        }
    }
}

/// The recording that replaces a tracker, from `start` on; `None` if the configuration names none.
pub(super) fn replay(tracker: &TrackerConfig, start: Time) -> Result<Option<Replay>, Failure> {
    let Some(file) = &tracker.file else { return Ok(None) };
    let text = text_of(Path::new(file))?;
    let recording = match tracker.source {
        TrackerSource::Csv => csv::recording(&text, &tracker.csv, &tracker.tool)
            .map_err(|error| format!("{file}: {error}; see [tracker.csv]")),
        _ => ndjson::recording(&text).map_err(|error| format!("{file}: {error}")),
    };
    Ok(Some(Replay::new(file, recording.map_err(Failure::Configuration)?, start)))
}

/// The source in a few words, for the manifest.
pub(super) fn described(config: &Config) -> String {
    let tracker = &config.tracker;
    let TrackerConfig { mode, address, .. } = tracker;
    let source = config.tip_source();
    match (source, &tracker.file) {
        (TrackerSource::Emulated, _) => source.to_string(),
        (_, Some(file)) => format!("{source} {file}"),
        _ if tracker.is_standard_input() => format!("{source} standard input"),
        _ => format!("{source} {mode} {address}"),
    }
}
