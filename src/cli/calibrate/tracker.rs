//! `needle-bench calibrate tracker`: noise, drift and rate of the tracker from a recording at rest; and
//! `needle-bench tracker rest`, which measures them at once.

use super::{Output, fit_table};
use crate::calibration::{RestSample, TrackerFit};
use crate::cli::arguments::{Configured, number_in, text_of};
use crate::cli::output::print_stderr;
use crate::cli::tracker::{Unreadable, listen, source_label};
use crate::cli::{Failure, Result};
use crate::config::TrackerSection;
use crate::table::Table;
use crate::text::escaped;
use crate::tracker::gate::is_same_tool;
use crate::tracker::{CsvMapping, Event, Gate, Sample, TimeColumns, csv, ndjson};
use crate::units::IN_METRES;
use clap::Args;
use minijinja::context;
use serde_json::json;
use std::path::PathBuf;

/// The columns that `tracker record` writes into a CSV file.
pub(in crate::cli) const RECEIVED: &str = "receive_time_ns";
pub(in crate::cli) const STAMP: &str = "stamp_unix_ns";
pub(in crate::cli) const POSITION: [&str; 3] = ["x_mm", "y_mm", "z_mm"];
pub(in crate::cli) const QUATERNION: [&str; 4] = ["qw", "qx", "qy", "qz"];

/// The smallest noise that the configuration accepts, mm.
const SD_MIN_MM: f64 = 0.001;
/// From this noise on, mm, it may be that of positions in metres.
const SD_IN_METRES_MIN_MM: f64 = 1e-6;

#[derive(Debug, Args)]
pub(in crate::cli) struct Arguments {
    /// The tracker at rest: a CSV or NDJSON file as `tracker record` writes it, a run's
    /// tracker.ndjson, or a CSV file as [tracker.csv] describes it.
    file: PathBuf,
    #[command(flatten)]
    configured: Configured,
    #[command(flatten)]
    output: Output,
}

pub(super) fn calibrate(arguments: &Arguments) -> Result<()> {
    arguments.output.refuse_unwritable()?;
    let path = &arguments.file;
    let config = arguments.configured.load(None)?;
    let text = text_of(path)?;
    let samples =
        recorded(&text, &config.tracker).map_err(|error| Failure::bad_input(path, error))?;
    fit_and_write(&samples, &path.display().to_string(), Some(&text), &arguments.output)
}

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

pub(in crate::cli) fn rest(arguments: &RestArguments) -> Result<()> {
    arguments.output.refuse_unwritable()?;
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

/// Fits the `samples` of `source` and writes the result. `text` is the content of `source` if it is a file.
fn fit_and_write(
    samples: &[RestSample],
    source: &str,
    text: Option<&str>,
    output: &Output,
) -> Result<()> {
    let bad_input = |error| Failure::bad_input(source.as_ref(), error);
    let fit = TrackerFit::of(samples).map_err(bad_input)?;
    if let Some(remark) = fit.remark() {
        print_stderr(format_args!("warning: {remark}"));
    }
    let found = serde_json::to_value(&fit).map_err(Failure::environment)?;
    let all = &fit.together;
    let sd_mm = all.sd_mm.value;
    if sd_mm < SD_MIN_MM {
        let hint = match sd_mm >= SD_IN_METRES_MIN_MM {
            true => IN_METRES,
            false => "is this an emulated tracker without noise?",
        };
        let error = format!("the noise is {sd_mm:.5} mm (at least {SD_MIN_MM} needed): {hint}");
        return Err(Failure::bad_input(source.as_ref(), error));
    }
    let json = json!({
        "tracker": {
            "noise": {
                "white_sd_mm": all.white_sd_mm.value,
                "correlated_sd_mm": all.correlated_sd_mm.value,
                "correlation_time_s": all.correlation_time_s.value,
            },
            "gates": { "noise_sd_mm": sd_mm },
        },
        "observer": { "invariant": { "position_sd_mm": sd_mm } },
        "fit": fit_table(source, text, &found),
    });
    let more = context! { source => escaped(source) };
    output.write(&json, more, include_str!("tracker.txt"), Some(include_str!("noise.toml")))
}

/// The part of a sample that the calibration uses.
fn rest_sample(gate: &Gate, sample: &Sample) -> RestSample {
    RestSample {
        receive_time: sample.receive_time,
        source_unix_ns: sample.source_unix_ns,
        position_mm: gate.check_content(sample).is_ok().then_some(sample.position_mm),
    }
}

/// The samples of the tool in the recording `text`. Warns of lines that cannot be read.
fn recorded(text: &str, tracker: &TrackerSection) -> Result<Vec<RestSample>, String> {
    let text = text.trim_start_matches('\u{feff}');
    let events = match text.trim_start().starts_with('{') {
        true => ndjson::recording(text)?,
        false => csv::recording(text, &mapping(text, &tracker.csv), &tracker.tool)
            .map_err(|error| format!("{error}; see [tracker.csv]"))?,
    };
    let (mut samples, mut unreadable) = (Vec::new(), Unreadable::default());
    for (_, event) in &events {
        unreadable.note(event);
        if let Event::Sample(sample) = event {
            samples.push(sample);
        }
    }
    unreadable.warn();
    let gate = tracker.to_unregistered_gate();
    let of_tool = samples.iter().filter(|sample| is_same_tool(&sample.tool, &tracker.tool));
    let found: Vec<RestSample> = of_tool.map(|sample| rest_sample(&gate, sample)).collect();
    if found.is_empty() {
        let other = samples.first().map_or("", |sample| &sample.tool);
        return Err(format!(
            "no sample of \"{}\", but of \"{other}\"; give --set 'tracker.tool=\"{other}\"'",
            tracker.tool
        ));
    }
    Ok(found)
}

/// The columns of `tracker record` if the file has them; else the configured ones.
fn mapping(text: &str, configured: &CsvMapping) -> CsvMapping {
    let header = Table::parse(text);
    let has = |name: &str| header.column(name).is_ok();
    if !(has(RECEIVED) && POSITION.iter().all(|name| has(name))) {
        return configured.clone();
    }
    let column = |name: &str| TimeColumns { ns: Some(name.to_owned()), ..TimeColumns::default() };
    CsvMapping {
        time: column(RECEIVED),
        stamp: has(STAMP).then(|| column(STAMP)),
        position: POSITION.map(str::to_owned),
        position_unit_mm: 1.0,
        quaternion_wxyz: None,
        skip: configured.skip,
    }
}
