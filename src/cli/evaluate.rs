//! `needle-bench evaluate`: runs the observers over recorded insertions and scores them.

use super::Failure;
use super::output::give;
use super::sources::{load, text_of};
use crate::config::EvaluationSettings;
use crate::session::ObserverConfig;
use crate::study::{Evaluation, Quantiles, Recording, Score, evaluate as score};
use clap::Args;
use serde::Serialize;
use serde_json::{Value, json};
use std::path::PathBuf;
use std::process::ExitCode;

/// The default configuration: the needle and the sensor's mount of the public recordings.
pub(super) const RECORDINGS_TOML: (&str, &str) =
    ("bench-config/recordings.toml", include_str!("../../bench-config/recordings.toml"));

#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Recorded insertions: CSV with insertion_mm,rotation_rad,x_mm,y_mm,z_mm and, for scoring,
    /// qw,qx,qy,qz.
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

/// One observer's scores, one for each recording.
struct Scored {
    name: &'static str,
    scores: Vec<Score>,
}

pub(super) fn evaluate(arguments: &Arguments) -> Result<ExitCode, Failure> {
    let observer = arguments.observer.iter().map(|kind| format!("observer.kind={kind:?}"));
    let set: Vec<String> = arguments.set.iter().cloned().chain(observer).collect();
    let config = load(arguments.config.as_deref(), Some(RECORDINGS_TOML), &set)?;
    let settings = config.evaluation().map_err(Failure::configuration)?;
    let mut recordings = Vec::new();
    for path in &arguments.files {
        let text = text_of(path)?;
        let recording = Recording::parse(&text).map_err(|error| Failure::in_file(path, error))?;
        recordings.push((path.display().to_string(), recording));
    }
    let mut scored = Vec::new();
    for observer in &settings.observers {
        scored.push(Scored {
            name: observer.name(),
            scores: recordings
                .iter()
                .map(|(path, recording)| {
                    one(observer, recording, &settings)
                        .map_err(|error| Failure::Configuration(format!("{path}: {error}")))
                })
                .collect::<Result<_, _>>()?,
        });
    }
    give(arguments.json, || to_json(&scored, &recordings), || table(&scored, &recordings))?;
    Ok(ExitCode::SUCCESS)
}

fn one(
    observer: &ObserverConfig,
    recording: &Recording,
    settings: &EvaluationSettings,
) -> Result<Score, String> {
    let scored = |observer: &ObserverConfig| {
        let mut observer =
            observer.build(settings.needle, settings.torsion).map_err(|error| error.to_string())?;
        score(observer.as_mut(), recording, &settings.scoring).map_err(|error| error.to_string())
    };
    let told = scored(observer)?;
    let untold = observer.with_roll_unknown().as_ref().map(scored).transpose()?;
    let roll_unknown_rms_deg = untold.and_then(|score| score.roll_rms_deg);
    Ok(Score { roll_unknown_rms_deg, ..told })
}

/// The figures of the first observer are at the top, those of all observers under `observers`.
fn to_json(scored: &[Scored], recordings: &[(String, Recording)]) -> Value {
    #[derive(Serialize)]
    struct OfObserver<'a> {
        observer: &'a str,
        #[serde(flatten)]
        figures: Evaluation,
        files: Vec<OfFile<'a>>,
    }
    #[derive(Serialize)]
    struct OfFile<'a> {
        file: &'a str,
        #[serde(flatten)]
        score: &'a Score,
    }
    let of = |Scored { name, scores }: &Scored| {
        let files = recordings.iter().zip(scores);
        let files = files.map(|((file, _), score)| OfFile { file, score }).collect();
        json!(OfObserver { observer: name, figures: Evaluation::of(scores), files })
    };
    let mut top = scored.first().map_or_else(|| json!({}), of);
    top["observers"] = scored.iter().map(of).collect();
    top
}

/// The scores by observer and file, followed by each observer's figures.
fn table(scored: &[Scored], recordings: &[(String, Recording)]) -> String {
    let number = |value: Option<f64>| value.map_or("-".to_owned(), |v| format!("{v:.2}"));
    let mut lines = vec![
        format!("{:<18} {:>9} {:>9} {:>9} {:>10}", "", "roll", "untold", "position", "5 mm ahead"),
        format!("{:<18} {:>9} {:>9} {:>9} {:>10}  file", "observer", "deg", "deg", "mm", "mm"),
    ];
    for Scored { name, scores } in scored {
        for ((path, _), score) in recordings.iter().zip(scores) {
            lines.push(format!(
                "{name:<18} {:>9} {:>9} {:>9} {:>10}  {path}",
                number(score.roll_rms_deg),
                number(score.roll_unknown_rms_deg),
                number(score.position_rms_mm),
                number(score.prediction_5mm_rms_mm),
            ));
        }
    }
    for Scored { name, scores } in scored {
        let figures = Evaluation::of(scores);
        let quantiles = |Quantiles { median, p90 }: Quantiles| {
            format!("{} deg median, {} deg 90%", number(median), number(p90))
        };
        lines.push(format!("{name}, {} insertions:", scores.len()));
        lines.push(format!("  roll RMS {}", quantiles(figures.roll_rms_deg)));
        lines.push(format!(
            "  roll RMS, start roll not told, {}",
            quantiles(figures.roll_unknown_rms_deg)
        ));
        lines.push(format!(
            "  position RMS {} mm, 5 mm ahead {} mm, medians",
            number(figures.position_rms_mm),
            number(figures.prediction_5mm_rms_mm)
        ));
    }
    lines.join("\n")
}
