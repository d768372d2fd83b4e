//! Changes to a record after the run: a verdict, and the repair of a record left open.

use super::super::output::{say, tell};
use super::super::recording::describe;
use super::{Failure, read};
use crate::archive::{Verdict, VerdictKind, file};
use crate::config::{Config, Source};
use crate::review::Condition;
use crate::runtime::make_recording;
use crate::telemetry::{
    RunFolder, TelemetryError, lock, note_recording, repair, utc_text, write_manifest,
};
use crate::text::escaped;
use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use serde_json::json;
use std::path::Path;
use std::time::SystemTime;

#[derive(Debug, Args)]
pub(super) struct Judgement {
    /// Record whether the run counts. The manifest keeps earlier verdicts.
    #[arg(long, requires = "reason", value_parser = verdict())]
    verdict: Option<VerdictKind>,
    /// The reason for the verdict.
    #[arg(long, value_name = "TEXT", requires = "verdict")]
    reason: Option<String>,
    /// Close the record of a run whose bench was ended before it could: killed, or without power.
    #[arg(long, conflicts_with = "verdict")]
    repair: bool,
}

/// A parser of a verdict's name, for clap.
fn verdict() -> impl TypedValueParser<Value = VerdictKind> {
    PossibleValuesParser::new(["valid", "invalid"]).map(|name| match name.as_str() {
        "valid" => VerdictKind::Valid,
        _ => VerdictKind::Invalid,
    })
}

impl Judgement {
    /// Whether the command line asks for a verdict or a repair.
    pub(super) fn is_asked(&self) -> bool {
        self.verdict.is_some() || self.repair
    }

    /// Applies it to the run in `path` and prints the result.
    pub(super) fn give(&self, path: &Path, json: bool) -> Result<(), Failure> {
        match (self.verdict, &self.reason) {
            (Some(verdict), Some(reason)) => judge(path, verdict, reason, json),
            _ => close(path, json),
        }
    }
}

/// Closes a record that was left open.
fn close(path: &Path, json: bool) -> Result<(), Failure> {
    let repaired = match repair(path) {
        Ok(repaired) => Some(repaired),
        Err(TelemetryError::Closed { .. }) if lacks_recording(path) => {
            note_recording(path, None)?;
            None
        }
        Err(error) => return Err(error.into()),
    };
    let folder = RunFolder::open(path)?;
    folder.verify()?;
    let text = folder.text(file::CONFIG)?;
    let config = Config::from_sources(&[Source { name: file::CONFIG, text: &text }], &[])
        .map_err(Failure::configuration)?;
    let fault = make_recording(path, describe(config), &mut |made| {
        tell(format_args!(
            "making {}: {:.0} s of the run done",
            file::RECORDING,
            made.as_secs_f64()
        ));
    });
    let dir = path.display();
    if let Some(fault) = fault {
        let text = format!("{dir}: {fault}");
        if lacks_recording(path) {
            return Err(Failure::Environment(text));
        }
        tell(text);
    }
    let Some(repaired) = repaired else {
        return match json {
            true => say(json!({ "run_dir": dir.to_string(), "recording_made": true })),
            false => say(format_args!("{dir}: {} made", file::RECORDING)),
        };
    };
    if !json {
        return say(format_args!("{dir}: closed: {repaired}"));
    }
    let cut = |(file, bytes): &(String, u64)| json!({ "file": file, "bytes": bytes });
    say(json!({
        "run_dir": dir.to_string(),
        "stop_reason": repaired.stop_reason,
        "counts": repaired.counts,
        "cut": repaired.cuts.iter().map(cut).collect::<Vec<_>>(),
    }))
}

/// Whether the record in `path` has no `run.rrd`, or none that its manifest knows.
fn lacks_recording(path: &Path) -> bool {
    let is_known = |run: RunFolder| run.manifest().files.contains_key(file::RECORDING);
    !path.join(file::RECORDING).exists() || !RunFolder::open(path).is_ok_and(is_known)
}

/// Adds a verdict to the manifest of a record that is closed and unchanged.
fn judge(path: &Path, verdict: VerdictKind, reason: &str, json: bool) -> Result<(), Failure> {
    if reason.trim().is_empty() {
        return Err(Failure::Configuration("--reason is empty: say why".to_owned()));
    }
    read::open(path)?;
    // The lock covers reading and writing of the manifest; otherwise two verdicts at once would
    // lose one.
    let Some(_lock) = lock(path).map_err(Failure::environment)? else {
        return Err(Failure::Environment(format!(
            "{}: another program is using this record; try again",
            path.display()
        )));
    };
    let (_, folder) = read::open(path)?;
    match folder.condition {
        Condition::Whole => {}
        // This program has the lock, so the bench has ended.
        Condition::Open | Condition::BeingWritten => {
            return Err(Failure::Configuration(format!(
                "{}: the record is not closed, and only a whole one is judged: needle-bench review \
                 {} --repair",
                folder.dir, folder.dir
            )));
        }
        Condition::Changed(what) => {
            return Err(Failure::Configuration(format!(
                "{}: {what}: it is not judged",
                folder.dir
            )));
        }
    }
    let mut manifest = folder.manifest;
    let given_utc = utc_text(SystemTime::now());
    manifest.verdicts.push(Verdict { verdict, reason: reason.to_owned(), given_utc });
    write_manifest(path, &manifest).map_err(Failure::environment)?;
    if json {
        return say(json!({ "run_dir": folder.dir, "verdicts": manifest.verdicts }));
    }
    say(format_args!("{}: {verdict}, {}", folder.dir, escaped(reason)))
}
