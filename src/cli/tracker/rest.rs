//! `needle-bench tracker rest`: the tracker's noise, measured while the tool is at rest.

use super::{listen, source_label};
use crate::cli::Failure;
use crate::cli::arguments::{Configured, number_in};
use crate::cli::calibrate::Output;
use crate::cli::calibrate::tracker::{fit_and_write, rest_sample};
use crate::cli::output::print_stderr;
use clap::Args;

#[derive(Debug, Args)]
pub(in crate::cli) struct RestArguments {
    #[command(flatten)]
    configured: Configured,
    /// How long the tool rests, s; Ctrl-C ends it sooner.
    #[arg(long, value_name = "SECONDS", default_value_t = 60.0, value_parser = number_in(5.0..=3600.0, "seconds"))]
    seconds: f64,
    #[command(flatten)]
    output: Output,
}

pub(super) fn rest(arguments: &RestArguments) -> Result<(), Failure> {
    arguments.output.refuse_existing()?;
    let mut listener = listen(&arguments.configured, false)?;
    let source = source_label(&listener.config);
    print_stderr(format_args!(
        "tracker: hold \"{}\" still for {} s",
        listener.config.tracker.tool, arguments.seconds
    ));
    let gate = listener.config.tracker.to_unregistered_gate();
    let mut samples = Vec::new();
    listener.for_each_sample(Some(arguments.seconds), |sample| {
        samples.push(rest_sample(&gate, sample));
        Ok(())
    })?;
    fit_and_write(&samples, &source, None, &arguments.output)
}
