//! `needle-bench evaluate`: runs the observers over recorded insertions and scores them.

use super::Failure;
use super::output::{give, tell};
use super::records::{Insertion, Insertions};
use crate::session::ObserverConfig;
use crate::study::{Evaluation, Recording, Score, evaluate as score};
use crate::text::screen;
use clap::Args;
use minijinja::context;
use serde::Serialize;
use serde_json::json;
use std::process::ExitCode;

#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(flatten)]
    insertions: Insertions,
    /// The observer to score first, as with `--set observer.kind=…`; the others of the
    /// configuration follow.
    #[arg(long, value_name = "KIND")]
    observer: Option<String>,
    /// One JSON object on stdout.
    #[arg(long)]
    json: bool,
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
    let observer = arguments.observer.as_ref().map(|kind| format!("observer.kind={kind:?}"));
    let (config, insertions) = arguments.insertions.read(observer)?;
    let (needle, torsion) = (config.believed_needle()?, config.believed_torsion()?);
    let scoring = config.scoring()?;
    let scored_by = |observer: &ObserverConfig, recording: &Recording| {
        let mut observer = observer.build(needle, torsion).map_err(|error| error.to_string())?;
        score(observer.as_mut(), recording, &scoring).map_err(|error| error.to_string())
    };
    for Insertion { path, recording, .. } in &insertions {
        if recording.has_constant_orientation() {
            tell(format_args!(
                "warning: {}: its orientations never change: no roll is scored",
                path.display()
            ));
        }
    }
    let mut observers = Vec::new();
    for observer in config.observers() {
        let scores = insertions.iter().map(|Insertion { path, recording, .. }| {
            let score = one(&observer, |observer| scored_by(observer, recording));
            let score = score.map_err(|error| Failure::in_file(path, error))?;
            Ok(ScoredFile { file: path.display().to_string(), score })
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
