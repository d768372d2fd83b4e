//! `needle-bench evaluate`: runs the observers over recorded insertions and scores them.

use super::Failure;
use super::insertions::insertions;
use super::output::{give, tell};
use super::sources::{configuration_among, load};
use crate::session::ObserverConfig;
use crate::study::{Evaluation, Recording, Score, evaluate as score};
use crate::text::screen;
use clap::Args;
use minijinja::context;
use serde::Serialize;
use serde_json::json;
use std::path::PathBuf;
use std::process::ExitCode;

/// The default configuration: the needle and the sensor's mount of the public recordings.
pub(super) const RECORDINGS_TOML: (&str, &str) =
    ("bench-config/recordings.toml", include_str!("../../bench-config/recordings.toml"));

#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Recorded insertions: run folders, or CSV with insertion_mm,rotation_rad,x_mm,y_mm,z_mm and, for
    /// scoring, qw,qx,qy,qz. A TOML file among them is the configuration.
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Needle, observers and sensor mount; by default bench-config/recordings.toml.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// The observer to score first, as with `--set observer.kind=…`; the others of the
    /// configuration follow.
    #[arg(long, value_name = "KIND")]
    observer: Option<String>,
    /// Set a key of the configuration, for example 'needle.curvature_per_mm=0.012'.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// One JSON object on stdout.
    #[arg(long)]
    pub(super) json: bool,
}

/// One observer's figures, and its score for each recording.
#[derive(Serialize)]
struct Scored {
    observer: &'static str,
    #[serde(flatten)]
    figures: Evaluation,
    files: Vec<ScoredFile>,
}

#[derive(Serialize)]
struct ScoredFile {
    file: String,
    #[serde(flatten)]
    score: Score,
}

pub(super) fn evaluate(arguments: &Arguments) -> Result<ExitCode, Failure> {
    let observer = arguments.observer.iter().map(|kind| format!("observer.kind={kind:?}"));
    let set: Vec<String> = arguments.set.iter().cloned().chain(observer).collect();
    let (path, files) = configuration_among(&arguments.files, arguments.config.as_deref())?;
    let config = load(path, Some(RECORDINGS_TOML), &set)?;
    let needle = config.believed_needle().map_err(Failure::configuration)?;
    let torsion = config.believed_torsion().map_err(Failure::configuration)?;
    let scoring = config.scoring().map_err(Failure::configuration)?;
    let scored_by = |observer: &ObserverConfig, recording: &Recording| {
        let mut observer = observer.build(needle, torsion).map_err(|error| error.to_string())?;
        score(observer.as_mut(), recording, &scoring).map_err(|error| error.to_string())
    };
    let recordings = insertions(&files)?;
    let files: Vec<String> = files.iter().map(|path| path.display().to_string()).collect();
    for (file, (_, recording)) in files.iter().zip(&recordings) {
        if recording.has_constant_orientation() {
            tell(format_args!("warning: {file}: its orientations never change: no roll is scored"));
        }
    }
    let mut observers = Vec::new();
    for observer in config.observers() {
        let scores = files.iter().zip(&recordings).map(|(file, (_, recording))| {
            let score = one(&observer, |observer| scored_by(observer, recording))
                .map_err(|error| Failure::Configuration(format!("{file}: {error}")))?;
            Ok(ScoredFile { file: file.clone(), score })
        });
        let files = scores.collect::<Result<Vec<_>, Failure>>()?;
        let figures = Evaluation::of(files.iter().map(|file| &file.score));
        observers.push(Scored { observer: observer.name(), figures, files });
    }
    // The figures of the first observer are at the top, those of all observers under `observers`.
    let mut object = observers.first().map_or_else(|| json!({}), |first| json!(first));
    object["observers"] = json!(observers);
    let text = || screen(include_str!("evaluate.txt"), &object, context! {});
    give(arguments.json, &object, text)?;
    Ok(ExitCode::SUCCESS)
}

fn one(
    observer: &ObserverConfig,
    scored: impl Fn(&ObserverConfig) -> Result<Score, String>,
) -> Result<Score, String> {
    let told = scored(observer)?;
    let untold = observer.with_roll_unknown().as_ref().map(&scored).transpose()?;
    let roll_unknown_rms_deg = untold.and_then(|score| score.roll_rms_deg);
    Ok(Score { roll_unknown_rms_deg, ..told })
}
