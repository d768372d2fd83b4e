//! `needle-bench replay`: runs a recorded session again.

use super::output::{give, write_new};
use super::{Failure, STOPPED, stage};
use crate::archive::{Manifest, file};
use crate::config::{Config, Source};
use crate::operation::Plan;
use crate::replay::{Cut, Files, Recorded, Replayed, replay as run_again};
use crate::session::ObserverConfig;
use crate::study::RunFigures;
use crate::telemetry::RunFolder;
use clap::Args;
use serde::Serialize;
use serde_json::{Value, json};
use std::fmt::{self, Display};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// The run folder.
    run: PathBuf,
    /// Show what another observer would have estimated from the same measurements, for example
    /// 'observer.kind="coupled"'. Keys that would have changed the needle's path are refused.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Write the replayed steps.csv here; a file that exists is not overwritten.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// One JSON object on stdout.
    #[arg(long)]
    pub(super) json: bool,
}

/// A replay with its question.
struct Report<'a> {
    run: &'a Path,
    replayed: Replayed,
    /// The observer that steered; `None` of an operation.
    observer: Option<&'static str>,
    /// The observer of the question; `None` without one.
    what_if: Option<&'static str>,
    /// Session time divided by computing time.
    speed: f64,
    /// The bench that recorded the run.
    recorded_by: Bench<'a>,
}

/// A bench: its version, and the git state of its build, if known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
struct Bench<'a> {
    version: &'a str,
    git: Option<&'a str>,
}

/// The bench that runs here.
const THIS_BENCH: Bench<'static> =
    Bench { version: env!("CARGO_PKG_VERSION"), git: option_env!("NEEDLE_BENCH_GIT") };

impl Display for Bench<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({})", self.version, self.git.unwrap_or("git state unknown"))
    }
}

pub(super) fn replay(arguments: &Arguments) -> Result<ExitCode, Failure> {
    let folder = RunFolder::open(&arguments.run)?;
    folder.verify()?;
    let text = |name| folder.text(name).map_err(Failure::from);
    let config = text(file::CONFIG)?;
    let what_if = what_if(&config, &arguments.set)?;
    let config = configured(&config, &[])?;
    let (plan, observer) = match stage::recorded(folder.manifest(), &config)? {
        Some(operation) => (Plan::from(operation), None),
        None => {
            let session = config.session().map_err(Failure::configuration)?;
            let observer = session.observer.name();
            (Plan::from(session), Some(observer))
        }
    };
    let (inputs, can) = (text(file::INPUTS)?, text(file::CAN)?);
    let (tracker, steps) = (text(file::TRACKER)?, text(file::STEPS)?);
    let files = Files { inputs: &inputs, can: &can, tracker: &tracker, steps: &steps };
    let refused = |error| Failure::in_file(&arguments.run, error);
    let recorded = Recorded::new(folder.manifest(), plan, files).map_err(refused)?;
    let begun = Instant::now();
    let replayed = run_again(&recorded, what_if).map_err(refused)?;
    let speed = replayed.duration_s() / begun.elapsed().as_secs_f64();
    if let Some(path) = &arguments.out {
        write_new(path, &replayed.steps_csv())?;
    }
    let status = match replayed.difference {
        None => ExitCode::SUCCESS,
        Some(_) => ExitCode::from(STOPPED),
    };
    let what_if = what_if.map(|observer| observer.name());
    let Manifest { version, git, .. } = folder.manifest();
    let recorded_by = Bench { version, git: git.as_deref() };
    let report = Report { run: &arguments.run, replayed, observer, what_if, speed, recorded_by };
    give(arguments.json, || to_json(&report), || summary(&report))?;
    Ok(status)
}

/// The observer that `sets` describe; `None` without any.
fn what_if(config: &str, sets: &[String]) -> Result<Option<ObserverConfig>, Failure> {
    if sets.is_empty() {
        return Ok(None);
    }
    let asked = configured(config, sets)?.session().map_err(Failure::configuration)?;
    for set in sets {
        let key = set.split('=').next().unwrap_or_default().trim();
        if key == "observer.shadows" {
            return Err(Failure::Configuration(format!(
                "--set {key}: shadows are not asked about; name the observer by observer.kind"
            )));
        }
        if !key.starts_with("observer.") {
            return Err(Failure::Configuration(format!(
                "--set {key}: a replay takes observer.… alone, since the needle's path is as \
                 recorded; for another path insert again, by needle-bench run or study"
            )));
        }
    }
    Ok(Some(asked.observer))
}

fn configured(text: &str, sets: &[String]) -> Result<Config, Failure> {
    Config::from_sources(&[Source { name: file::CONFIG, text }], sets)
        .map_err(Failure::configuration)
}

fn figures_json(observer: Option<&str>, figures: &RunFigures) -> Value {
    json!({
        "observer": observer,
        "estimate_rms": figures.estimate_rms(),
        "final_error": figures.final_error(),
    })
}

fn cut_json(cut: &Cut) -> Value {
    json!({
        "end_s": cut.end.as_secs_f64(),
        "first_file": cut.file,
        "first_file_end_s": cut.file_end.as_secs_f64(),
        "rows_beyond": cut.rows_beyond,
    })
}

fn to_json(report: &Report<'_>) -> Value {
    let Report { run, replayed, observer, what_if, speed, recorded_by } = report;
    let what_if = what_if.zip(replayed.what_if.as_ref());
    json!({
        "run_dir": run.display().to_string(),
        "recorded_by": recorded_by,
        "replayed_by": THIS_BENCH,
        "identical": replayed.difference.is_none(),
        "difference": replayed.difference.as_ref().map(ToString::to_string),
        "rows": replayed.rows,
        "frames_sent": replayed.frames,
        "samples": replayed.samples,
        "cut": replayed.cut.as_ref().map(cut_json),
        "outcome": replayed.outcome,
        "duration_s": replayed.duration_s(),
        "real_time_factor": speed,
        "recorded": figures_json(*observer, &replayed.figures),
        "what_if": what_if.map(|(observer, figures)| figures_json(Some(observer), figures)),
    })
}

/// One screen; whether the replay is identical is the last line.
fn summary(report: &Report<'_>) -> String {
    let Report { run, replayed, observer, what_if, speed, recorded_by } = report;
    let Replayed { rows, frames, samples, .. } = replayed;
    let mut lines = vec![format!(
        "replayed    {}: {rows} rows, {frames} frames sent, {samples} samples; {:.1} s, {speed:.0} \
         times as fast",
        run.display(),
        replayed.duration_s(),
    )];
    if *recorded_by != THIS_BENCH {
        lines.push(format!("bench       recorded by {recorded_by}, replayed by {THIS_BENCH}"));
    }
    let mut figures = |title: &str, observer: &str, figures: &RunFigures| {
        if let (Some(rms), Some(last)) = (figures.estimate_rms(), figures.final_error()) {
            lines.push(format!("{title} {observer}: {rms} RMS over the last third"));
            lines.push(format!("            at the end {last}"));
        }
    };
    if let Some(observer) = observer {
        figures("recorded   ", observer, &replayed.figures);
    }
    if let Some((observer, shadow)) = what_if.zip(replayed.what_if.as_ref()) {
        figures("what if    ", observer, shadow);
    }
    if let Some(cut) = &replayed.cut {
        lines.push(format!(
            "cut         the record ends before its run did, at {:.3} s; of its files {} ends first, \
             {:.3} s before; {} rows come after what could be replayed",
            cut.end.as_secs_f64(),
            cut.file,
            cut.apart_s(),
            cut.rows_beyond,
        ));
    }
    lines.push(match &replayed.difference {
        None => "identical".to_owned(),
        Some(difference) => format!("differs: {difference}"),
    });
    lines.join("\n")
}
