//! `needle-bench tracker rest`: the noise of the tracker while the tool is at rest.

use super::described;
use super::listen::listen;
use crate::cli::Failure;
use crate::cli::calibrate::Output;
use crate::cli::calibrate::tracker::{present, rest_sample};
use crate::cli::output::{number_in, tell};
use crate::cli::sources::Configured;
use clap::Args;
use std::process::ExitCode;

#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(flatten)]
    configured: Configured,
    /// How long the tool rests, s; Ctrl-C ends it sooner.
    #[arg(long, value_name = "SECONDS", default_value_t = 60.0, value_parser = number_in(5.0..=3600.0, "seconds"))]
    seconds: f64,
    #[command(flatten)]
    output: Output,
}

pub(super) fn rest(arguments: &Arguments) -> Result<ExitCode, Failure> {
    let mut listener = listen(&arguments.configured, false)?;
    let source = described(&listener.config);
    tell(format_args!(
        "tracker: hold \"{}\" still for {} s",
        listener.config.tracker.tool, arguments.seconds
    ));
    let mut samples = Vec::new();
    listener.samples(Some(arguments.seconds), |sample| {
        samples.push(rest_sample(sample));
        Ok(())
    })?;
    present(&samples, &source, &arguments.output)
}
