//! `needle-bench evaluate`: runs the observers over recorded insertions and scores them.

use super::output::{merged, print_result, print_stderr};
use super::records::{Insertion, Insertions};
use super::{Failure, Result};
use crate::session::ObserverConfig;
use crate::study::{
    Evaluation, RecordedRoll, Recording, RecordingScore, evaluate as evaluate_observer,
};
use crate::text::screen;
use clap::Args;
use minijinja::context;
use serde_json::json;

#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(flatten)]
    insertions: Insertions,
    /// The observer to score first, as with `--set observer.kind=…`; the shadows of the configuration follow.
    #[arg(long, value_name = "KIND")]
    observer: Option<String>,
    /// One JSON object on stdout.
    #[arg(long)]
    json: bool,
}

pub(super) fn evaluate(arguments: &Arguments) -> Result<()> {
    let observer = arguments.observer.as_ref().map(|kind| format!("observer.kind={kind:?}"));
    let (config, insertions) = arguments.insertions.read(observer)?;
    let (needle, torsion) = config.believed_needle()?;
    let scoring = config.scoring()?;
    let score_once = |observer: &ObserverConfig, recording: &Recording| {
        let mut observer = observer.build(needle, torsion);
        evaluate_observer(observer.as_mut(), recording, &scoring)
    };
    for Insertion { path, recording, .. } in &insertions {
        match recording.roll() {
            None | Some(RecordedRoll::Turns) => {}
            Some(why) => {
                print_stderr(format_args!("warning: {}: no roll is scored: {why}", path.display()))
            }
        }
    }
    let mut observers = Vec::new();
    for observer in config.observer.observers() {
        let (mut scores, mut files) = (Vec::new(), Vec::new());
        for Insertion { path, recording, .. } in &insertions {
            let scored = score_once(&observer, recording).and_then(|score| {
                // An observer that is told the roll at the start is scored again without it.
                let roll_unknown = observer.with_roll_unknown();
                let without_roll = roll_unknown.map(|other| score_once(&other, recording));
                let roll_unknown_rms_deg = without_roll.transpose()?.and_then(|it| it.roll_rms_deg);
                Ok(RecordingScore { roll_unknown_rms_deg, ..score })
            });
            let score = scored.map_err(|error| Failure::bad_input(path, error))?;
            files.push(merged(json!({ "file": path.display().to_string() }), &json!(score)));
            scores.push(score);
        }
        let figures = json!(Evaluation::of(scores.iter()));
        let named = json!({ "observer": observer.name(), "files": files });
        observers.push(merged(named, &figures));
    }
    // The figures of the first observer are at the top, those of all observers under `observers`.
    let first = observers.first().cloned().unwrap_or_default();
    let object = merged(first, &json!({ "observers": observers }));
    let text = || screen(include_str!("evaluate.txt"), &object, context! {});
    print_result(arguments.json, &object, text)
}
