//! `needle-bench tracker`: lists, watches, records and measures the tracker without a run.

use super::list::{ListArguments, list};
use super::record::{RecordArguments, record};
use super::rest::{RestArguments, rest};
use super::watch::{WatchArguments, watch};
use crate::cli::Failure;
use clap::Subcommand;

#[derive(Debug, Subcommand)]
pub(in crate::cli) enum TrackerCommand {
    /// The tools that the tracker sends, with types and rates.
    List(ListArguments),
    /// One line a second: position, rate, age, refusals; until Ctrl-C.
    Watch(WatchArguments),
    /// Write the tool's positions to a file; until Ctrl-C.
    Record(RecordArguments),
    /// Measure the tracker's noise while the tool is at rest, as `calibrate tracker` does.
    Rest(RestArguments),
}

pub(in crate::cli) fn tracker(command: &TrackerCommand) -> Result<(), Failure> {
    match command {
        TrackerCommand::List(arguments) => list(arguments),
        TrackerCommand::Watch(arguments) => watch(arguments),
        TrackerCommand::Record(arguments) => record(arguments),
        TrackerCommand::Rest(arguments) => rest(arguments),
    }
}
