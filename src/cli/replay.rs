//! `needle-bench replay`: runs a recorded session again.

use super::output::{give, write_new};
use super::recording::recorded_plan;
use super::{Failure, STOPPED};
use crate::archive::file;
use crate::config::{Config, Source};
use crate::operation::Plan;
use crate::replay::{Recorded, replay as run_again};
use crate::session::ObserverConfig;
use crate::study::FigureReport;
use crate::telemetry::RunFolder;
use crate::text::screen;
use clap::Args;
use minijinja::context;
use serde_json::json;
use std::path::PathBuf;
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

pub(super) fn replay(arguments: &Arguments) -> Result<ExitCode, Failure> {
    let folder = RunFolder::open(&arguments.run)?;
    folder.verify()?;
    let config = folder.text(file::CONFIG)?;
    let what_if = what_if(&config, &arguments.set)?;
    let config = configured(&config, &[])?;
    let plan = recorded_plan(folder.manifest(), &config)?;
    let observer = match &plan {
        Plan::Insertion(session) => Some(session.observer.name()),
        Plan::Operation(_) => None,
    };
    let recorded = Recorded { manifest: folder.manifest(), plan, open: &|name| folder.lines(name) };
    let begun = Instant::now();
    let replayed =
        run_again(&recorded, what_if).map_err(|error| Failure::in_file(&arguments.run, error))?;
    let speed = replayed.duration_s() / begun.elapsed().as_secs_f64();
    if let Some(path) = &arguments.out {
        write_new(path, &replayed.steps_csv())?;
    }
    let what_if = what_if.map(|observer| observer.name()).zip(replayed.what_if.as_ref());
    let recorded = (observer, &replayed.figures);
    let figures_json = |observer: Option<&str>, figures: &FigureReport| {
        let FigureReport { estimate_rms, final_error, .. } = figures;
        json!({ "observer": observer, "estimate_rms": estimate_rms, "final_error": final_error })
    };
    let object = json!({
        "run_dir": arguments.run.display().to_string(),
        "recorded_by": { "version": folder.manifest().version, "git": folder.manifest().git },
        "replayed_by": {
            "version": env!("CARGO_PKG_VERSION"),
            "git": option_env!("NEEDLE_BENCH_GIT"),
        },
        "identical": replayed.difference.is_none(),
        "difference": replayed.difference,
        "rows": replayed.rows,
        "frames_sent": replayed.frames,
        "samples": replayed.samples,
        "cut": replayed.cut.as_ref().map(|cut| json!({
            "end_s": cut.end.as_secs_f64(),
            "first_file": cut.file,
            "first_file_end_s": cut.file_end.as_secs_f64(),
            "rows_beyond": cut.rows_beyond,
        })),
        "outcome": replayed.outcome,
        "duration_s": replayed.duration_s(),
        "real_time_factor": speed,
        "recorded": figures_json(recorded.0, recorded.1),
        "what_if": what_if.map(|(observer, figures)| figures_json(Some(observer), figures)),
    });
    let shown =
        [("recorded", recorded.0.map(|observer| (observer, recorded.1))), ("what if", what_if)];
    let shown = shown.into_iter().filter_map(|(title, of)| {
        let (observer, FigureReport { estimate_rms, final_error, .. }) = of?;
        Some(context! {
            title,
            observer,
            rms => (*estimate_rms)?.to_string(),
            last => (*final_error)?.to_string(),
        })
    });
    let more = context! { figures => shown.collect::<Vec<_>>() };
    let text = || screen(include_str!("replay.txt"), &object, more);
    give(arguments.json, &object, text)?;
    Ok(replayed.difference.map_or(ExitCode::SUCCESS, |_| ExitCode::from(STOPPED)))
}

/// The observer that `sets` describe; `None` without any.
fn what_if(config: &str, sets: &[String]) -> Result<Option<ObserverConfig>, Failure> {
    if sets.is_empty() {
        return Ok(None);
    }
    let asked = configured(config, sets)?.session_without_goal().map_err(Failure::configuration)?;
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
