//! `needle-bench calibrate tracker`: noise, drift and pace of the tracker from a recording at rest.

use super::{Output, fit as fit_of};
use crate::calibration::{Measured, NoiseFit, RestSample, TrackerFit};
use crate::cli::Failure;
use crate::cli::sources::{Configured, text_of};
use crate::config::TrackerConfig;
use crate::table::Table;
use crate::text::escaped;
use crate::tracker::{CsvMapping, Event, Gate, Sample, TimeColumns, csv, gate, ndjson};
use crate::units::Time;
use clap::Args;
use minijinja::context;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// The columns that `tracker record` writes into a CSV file.
pub(in crate::cli) const RECEIVED: &str = "receive_time_ns";
pub(in crate::cli) const STAMP: &str = "stamp_unix_ns";
pub(in crate::cli) const POSITION: [&str; 3] = ["x_mm", "y_mm", "z_mm"];
pub(in crate::cli) const QUATERNION: [&str; 4] = ["qw", "qx", "qy", "qz"];

/// The least noise that a configuration takes, mm.
const SD_MIN_MM: f64 = 0.001;
const AXES: [&str; 3] = ["x", "y", "z"];

#[derive(Debug, Args)]
pub(in crate::cli) struct Arguments {
    /// The tracker at rest: a CSV or NDJSON file as `tracker record` writes it, a run's
    /// tracker.ndjson, or a CSV file as [tracker.csv] describes it.
    file: PathBuf,
    #[command(flatten)]
    configured: Configured,
    #[command(flatten)]
    pub(super) output: Output,
}

pub(super) fn calibrate(arguments: &Arguments) -> Result<ExitCode, Failure> {
    let path = &arguments.file;
    let config = arguments.configured.load(None)?;
    let text = text_of(path)?;
    let refused = |error: String| Failure::in_file(path, error);
    let samples = recorded(&text, &config.tracker).map_err(refused)?;
    let fit = TrackerFit::of(&samples).map_err(|error| refused(error.to_string()))?;
    give(&fit, path, &text, &arguments.output)
}

/// Prints what was found in `samples`, whose source is `name`.
pub(in crate::cli) fn present(
    samples: &[RestSample],
    name: &str,
    output: &Output,
) -> Result<ExitCode, Failure> {
    let fit = TrackerFit::of(samples)
        .map_err(|error| Failure::configuration(format!("{name}: {error}")))?;
    give(&fit, Path::new(name), "", output)
}

/// A sample as the calibration takes it.
pub(in crate::cli) fn rest_sample(sample: &Sample) -> RestSample {
    RestSample {
        receive_time: sample.receive_time,
        source_unix_ns: sample.source_unix_ns,
        position_mm: Gate::is_measurement(sample).then_some(sample.position_mm),
    }
}

/// The samples of the tool in the recording `text`.
fn recorded(text: &str, tracker: &TrackerConfig) -> Result<Vec<RestSample>, String> {
    let events = match text.trim_start().starts_with('{') {
        true => ndjson::recording(text).map_err(|error| error.to_string())?,
        false => csv::recording(text, &mapping(text, &tracker.csv), &tracker.tool)
            .map_err(|error| format!("{error}; see [tracker.csv]"))?,
    };
    let samples = || {
        events.iter().filter_map(|(_, event): &(Time, Event)| match event {
            Event::Sample(sample) => Some(sample),
            _ => None,
        })
    };
    let of_tool = |sample: &&Sample| gate::is_tool(&sample.tool, &tracker.tool);
    let found: Vec<RestSample> = samples().filter(of_tool).map(rest_sample).collect();
    if found.is_empty() {
        let other = samples().map(|sample| sample.tool.as_str()).next().unwrap_or_default();
        return Err(format!(
            "no sample of \"{}\", but of \"{other}\"; give --set 'tracker.tool=\"{other}\"'",
            tracker.tool
        ));
    }
    Ok(found)
}

/// The columns of `tracker record`, where the file has them; else those that are configured.
fn mapping(text: &str, configured: &CsvMapping) -> CsvMapping {
    let header = Table::parse(text.lines().next().unwrap_or_default());
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

fn give(fit: &TrackerFit, source: &Path, text: &str, output: &Output) -> Result<ExitCode, Failure> {
    let mut fitted = fit_of(source, text, []);
    if text.is_empty() {
        fitted["sha256"] = Value::Null;
    }
    let found = serde_json::to_value(fit).map_err(Failure::environment)?;
    for (key, value) in found.as_object().into_iter().flatten() {
        fitted[key] = value.clone();
    }
    let all = &fit.together;
    let json = json!({
        "tracker": {
            "noise": {
                "white_sd_mm": all.white_sd_mm.value,
                "correlated_sd_mm": all.correlated_sd_mm.value,
                "correlation_time_s": all.correlation_time_s.value,
            },
            "gates": { "noise_sd_mm": all.sd_mm.value.max(SD_MIN_MM) },
        },
        "observer": { "invariant": { "position_sd_mm": all.sd_mm.value.max(SD_MIN_MM) } },
        "fit": fitted,
    });
    output.give_toml((include_str!("tracker.txt"), context! {}), &toml(fit, &json["fit"]), &json)
}

/// The result as TOML, each number with its standard error beside it.
fn toml(fit: &TrackerFit, fitted: &Value) -> String {
    let all = &fit.together;
    let line = |key: &str, of: fn(&NoiseFit) -> Measured| {
        let Measured { value, error } = of(all);
        let each = fit.axes.iter().zip(AXES).map(|(axis, name)| {
            let Measured { value, error } = of(&axis.noise);
            format!("{name} {value:.5} +- {error:.5}")
        });
        let each: Vec<String> = each.collect();
        format!("{key} = {value:.5}  # +- {error:.5}; {}\n", each.join(", "))
    };
    let beside = |Measured { value, error }: Measured| format!("{value:.4} +- {error:.4}");
    let count = |count: usize| format!("{count} +- {:.1}", (count as f64).sqrt());
    let drift: Vec<String> = fit
        .axes
        .iter()
        .zip(AXES)
        .map(|(axis, name)| format!("{name} {}", beside(axis.drift_mm_per_min)))
        .collect();
    let jitter = fit.latency_jitter_ms.zip(fit.latency_p99_ms).map_or_else(
        || "not known: no stamps".to_owned(),
        |(jitter, p99)| format!("{} ms, 99% within {p99:.4} ms of the quickest", beside(jitter)),
    );
    let text = |key: &str| escaped(fitted[key].as_str().unwrap_or("-")).into_owned();
    let sd_mm = all.sd_mm.value.max(SD_MIN_MM);
    let error = all.sd_mm.error;
    [
        "# The noise of a tracker at rest, by `needle-bench calibrate tracker`. Its tables go into the\n\
         # configuration of the rig. In motion the model, the registration and a distorted field add\n\
         # to it. After +- stands the standard error.\n"
            .to_owned(),
        format!("# From {} (SHA-256 {}), {}\n", text("file"), text("sha256"), text("date_utc")),
        format!("# {} positions in {:.1} s\n\n", fit.positions, fit.duration_s),
        "[tracker.noise]\n".to_owned(),
        line("white_sd_mm", |noise| noise.white_sd_mm),
        line("correlated_sd_mm", |noise| noise.correlated_sd_mm),
        line("correlation_time_s", |noise| noise.correlation_time_s),
        format!("\n[tracker.gates]\nnoise_sd_mm = {sd_mm:.5}  # +- {error:.5}\n"),
        format!("\n[observer.invariant]\nposition_sd_mm = {sd_mm:.5}  # +- {error:.5}\n"),
        "\n# Beside it, without keys of their own:\n".to_owned(),
        format!("# drift {} mm/min; {}\n", beside(fit.drift_mm_per_min), drift.join(", ")),
        format!("# rate {} Hz, {} dropouts, ", beside(fit.rate_hz), count(fit.dropouts)),
        format!("{} outliers, ", count(fit.outliers)),
        format!("{} invalid, {} repeats\n", count(fit.invalid), count(fit.repeats)),
        format!("# latency jitter {jitter}\n"),
    ]
    .concat()
}
