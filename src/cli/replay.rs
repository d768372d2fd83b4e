//! `needle-bench replay`: runs a recorded session again and compares the results.

use super::output::{print_result_despite, print_stderr, refuse_unwritable, write_new};
use super::records::{open, recorded_run_config};
use super::{Failure, Result, STOPPED, finish_with};
use crate::archive::file;
use crate::config::{Config, Source, TrackerSource};
use crate::operation::RunConfig;
use crate::replay::{Recorded, replay as run_again};
use crate::session::ObserverConfig;
use crate::study::FigureReport;
use crate::text::screen;
use clap::Args;
use minijinja::context;
use serde_json::json;
use std::path::{Path, PathBuf};
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
    json: bool,
}

pub(super) fn replay(arguments: &Arguments) -> Result<()> {
    refuse_unwritable(arguments.out.as_deref())?;
    let (folder, config) = open(&arguments.run)?;
    let what_if = what_if(&folder.text(file::CONFIG)?, &arguments.set)?;
    let run_config = recorded_run_config(&folder.manifest, &config)?;
    let observer = match &run_config {
        RunConfig::Insertion(session) => Some(session.observer.name()),
        RunConfig::Operation(..) => None,
    };
    let recorded =
        Recorded { manifest: &folder.manifest, run_config, open: &|name| folder.lines(name) };
    let begun = Instant::now();
    let replayed =
        run_again(&recorded, what_if).map_err(|error| Failure::bad_input(&arguments.run, error))?;
    let speed = replayed.duration_s / begun.elapsed().as_secs_f64();
    let written = match &arguments.out {
        Some(path) => write_new(path, &replayed.steps_csv()),
        None => Ok(()),
    };
    let mut object = json!({
        "run_dir": arguments.run.display().to_string(),
        "recorded_by": { "version": folder.manifest.version, "git": folder.manifest.git },
        "replayed_by": {
            "version": env!("CARGO_PKG_VERSION"),
            "git": option_env!("NEEDLE_BENCH_GIT"),
        },
        "identical": replayed.difference.is_none(),
        "difference": replayed.difference,
        "rows": replayed.rows,
        "frames_sent": replayed.frames,
        "samples": replayed.samples,
        "cut": replayed.truncation.as_ref().map(|cut| json!({
            "end_s": cut.end.as_secs_f64(),
            "first_file": cut.file,
            "first_file_end_s": cut.file_end.as_secs_f64(),
            "rows_beyond": cut.rows_beyond,
        })),
        "outcome": replayed.outcome,
        "duration_s": replayed.duration_s,
        "real_time_factor": speed,
        "what_if": null,
    });
    let mut rows = Vec::new();
    let what_if_observer = what_if.map(|observer| observer.name());
    for (title, observer, figures) in [
        ("recorded", observer, Some(&replayed.figures)),
        ("what_if", what_if_observer, replayed.what_if.as_ref()),
    ] {
        let Some(FigureReport { estimate_rms, final_error, .. }) = figures else { continue };
        object[title] = json!({
            "observer": observer,
            "estimate_rms": estimate_rms,
            "final_error": final_error,
        });
        let is_known = estimate_rms.is_some() && final_error.is_some();
        if is_known || title == "what_if" {
            let title = title.replace('_', " ");
            let rms = estimate_rms.map(|error| error.to_string());
            let last = final_error.map(|error| error.to_string());
            rows.push(context! { title, observer, rms, last });
        }
    }
    let has_truth = folder.manifest.tracker == TrackerSource::Emulated.to_string();
    let more = context! { figures => rows, has_truth };
    let text = || screen(include_str!("replay.txt"), &object, more);
    print_result_despite(written, arguments.json, &object, text)?;
    finish_with(replayed.difference.map_or(0, |_| STOPPED))
}

/// The observer that the keys `sets` describe over the configuration `text`; `None` without any key.
fn what_if(text: &str, sets: &[String]) -> Result<Option<ObserverConfig>> {
    if sets.is_empty() {
        return Ok(None);
    }
    for set in sets {
        let key = set.split('=').next().unwrap_or_default().trim();
        if key == "observer.shadows" {
            return Err(Failure::configuration(format_args!(
                "--set {key}: a replay tries one other observer; name the observer by observer.kind"
            )));
        }
        if key == "observer.samples" {
            return Err(Failure::configuration(format_args!(
                "--set {key}: a replay corrects with the samples that the run took; to try others: \
                 needle-bench evaluate RUN"
            )));
        }
        if !key.starts_with("observer.") {
            return Err(Failure::configuration(format_args!(
                "--set {key}: a replay takes observer.… alone, since the needle's path is as \
                 recorded; for another path insert again, with needle-bench run or study"
            )));
        }
    }
    let source = Source { name: file::CONFIG, text };
    let unread = |_: &Path| Err("a replay reads no other file".to_owned());
    // Without the run's shadows, a key of an observer that is not chosen gives a warning.
    let sets = [&["observer.shadows=[]".to_owned()], sets].concat();
    let (config, warnings) = Config::with_warnings(&[source], &sets, &unread)?;
    for warning in warnings {
        print_stderr(format_args!("warning: {warning}"));
    }
    Ok(Some(config.session_without_goal()?.observer))
}
