//! `needle-bench review`: shows, compares and repairs recorded runs, and records verdicts on them.

mod read;

use super::output::{print_result, print_result_despite, print_stderr};
use super::records::{RUNS, describe, newest_first, open};
use super::{Failure, Result};
use crate::archive::{Verdict, VerdictKind, file};
use crate::review::{
    Campaign, Comparison, Condition, Folder, GENERATOR, Run, html, to_json, to_text,
};
use crate::runtime::make_recording;
use crate::telemetry::{RunFolder, is_being_written, lock, repair, utc_text, write_manifest};
use crate::text::{escaped, shell_word};
use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use serde_json::json;
use std::fs::{self, File};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::SystemTime;

#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// A run folder, by default the newest in runs; two of them to compare; a folder of run folders, or
    /// three or more run folders, for a campaign.
    #[arg(value_name = "RUN")]
    paths: Vec<PathBuf>,
    /// Write the page of a run to FILE instead of report.html in its folder.
    #[arg(long, value_name = "FILE", conflicts_with = "no_html")]
    html: Option<PathBuf>,
    /// Write no page.
    #[arg(long)]
    no_html: bool,
    /// Open the run's recording in the rerun viewer.
    #[arg(long)]
    open: bool,
    /// In a campaign: totals for each value of this configuration key, instead of each name.
    #[arg(long, value_name = "KEY")]
    by: Option<String>,
    /// Record whether the run counts. The manifest keeps earlier verdicts.
    #[arg(long, requires = "reason", value_parser = verdict_parser())]
    verdict: Option<VerdictKind>,
    /// The reason for the verdict.
    #[arg(long, value_name = "TEXT", requires = "verdict")]
    reason: Option<String>,
    /// Close the record of a run whose bench was killed or lost power before it closed the record.
    #[arg(long, conflicts_with = "verdict")]
    repair: bool,
    /// One JSON object on stdout.
    #[arg(long)]
    json: bool,
}

pub(super) fn review(arguments: &Arguments) -> Result<()> {
    let mut paths = arguments.paths.clone();
    if paths.is_empty() {
        let newest = newest_first(Path::new(RUNS)).next();
        let none = || Failure::configuration(format_args!("no run in {RUNS}: name a run folder"));
        paths.push(newest.ok_or_else(none)?.dir);
    }
    let changes_record = arguments.verdict.is_some() || arguments.repair;
    let is_campaign = !changes_record
        && match &paths[..] {
            [path] => read::is_folder_of_runs(path),
            paths => paths.len() > 2,
        };
    let is_one_run = !changes_record && !is_campaign && paths.len() == 1;
    let one_run = "the review of one run: name one run folder";
    for (flag, is_given, applies, to) in [
        ("--by", arguments.by.is_some(), is_campaign, "a campaign: name a folder of runs"),
        ("--html", arguments.html.is_some(), is_one_run, one_run),
        ("--open", arguments.open, is_one_run, one_run),
    ] {
        if is_given && !applies {
            return Err(Failure::configuration(format_args!("{flag} applies only to {to}")));
        }
    }
    match &paths[..] {
        [path] if changes_record => match (arguments.verdict, &arguments.reason) {
            (Some(verdict), Some(reason)) => add_verdict(path, verdict, reason, arguments.json),
            _ => close_record(path, arguments.json),
        },
        _ if changes_record => Err(Failure::configuration(
            "--verdict and --repair apply to one run: name one run folder",
        )),
        [path] if is_one_run => review_one(path, arguments),
        [a, b] => {
            let (a, b) = (read::run(a)?, read::run(b)?);
            let comparison = Comparison::of(&a, &b);
            let edited = check_unedited(&a).and_then(|()| check_unedited(&b));
            let text = || comparison.to_text();
            print_result_despite(edited, arguments.json, &comparison.to_json(), text)
        }
        paths => {
            let lines = paths.iter().map(|path| read::campaign_lines(path));
            let lines = lines.collect::<io::Result<Vec<_>>>()?.concat();
            let campaign = Campaign::of(lines, arguments.by.as_deref());
            let campaign = campaign.map_err(Failure::configuration)?;
            print_result(arguments.json, &campaign.to_json(), || campaign.to_text())
        }
    }
}

/// Reviews one run: writes its page, then prints its summary.
fn review_one(path: &Path, arguments: &Arguments) -> Result<()> {
    let run = read::run(path)?;
    let page = arguments.html.clone().unwrap_or_else(|| path.join(file::REPORT));
    let page_written = (!arguments.no_html).then(|| {
        let written = html(&run).map_err(io::Error::other).and_then(|text| match arguments.html {
            None => write_report(&page, &text),
            Some(_) => File::create_new(&page)?.write_all(text.as_bytes()),
        });
        let path = page.display();
        let hint = "--html FILE writes it to a new file, --no-html leaves it out";
        written.map(|()| path.to_string()).map_err(|error| format!("{path}: {error}; {hint}"))
    });
    let (report, shown) = match page_written.transpose() {
        Err(error) => (None, Err(Failure::environment(error))),
        Ok(report) if arguments.open => (report, open_viewer(path)),
        Ok(report) => (report, Ok(())),
    };
    let mut object = to_json(&run);
    object["report"] = json!(report);
    let checked = shown.and_then(|()| check_unedited(&run));
    print_result_despite(checked, arguments.json, &object, || to_text(&run, report.as_deref()))
}

/// Starts the viewer with the recording of the run in `path`, without waiting for it to end.
fn open_viewer(path: &Path) -> Result<()> {
    let recording = path.join(file::RECORDING);
    let shown = recording.display();
    if !recording.is_file() {
        return Err(Failure::configuration(format_args!(
            "{shown} is not there; make it: needle-bench review {} --repair",
            shell_word(path.display())
        )));
    }
    let started = Command::new("rerun").arg(&recording).stdout(Stdio::null()).spawn();
    started.map(drop).map_err(|error| {
        let why = match error.kind() {
            io::ErrorKind::NotFound => "was not found".to_owned(),
            _ => format!("did not start: {error}"),
        };
        Failure::environment(format!(
            "the viewer, the program rerun, {why}; install it: pip install rerun-sdk==0.36.3, then: rerun {}",
            shell_word(shown)
        ))
    })
}

/// Writes the report beside the record, atomically. Replaces an earlier report, but no other file.
fn write_report(path: &Path, page: &str) -> io::Result<()> {
    let is_ours = || -> io::Result<bool> {
        let is_file = fs::symlink_metadata(path)?.is_file();
        Ok(is_file && String::from_utf8_lossy(&fs::read(path)?).contains(GENERATOR))
    };
    match is_ours() {
        Ok(false) => return Err(io::Error::other("exists and is not a report of this program")),
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    let new = path.with_extension(format!("html.new-{}", std::process::id()));
    let mut file = File::create_new(&new)?;
    let written = file.write_all(page.as_bytes()).and_then(|()| fs::rename(&new, path));
    written.inspect_err(|_| {
        let _ = fs::remove_file(&new);
    })
}

/// The failure of the review of an edited record: it is bad input, since it is not what the run recorded.
fn check_unedited(Run { folder, .. }: &Run) -> Result<()> {
    let Condition::Changed(what) = &folder.condition else { return Ok(()) };
    Err(Failure::bad_input(folder.dir.as_ref(), what))
}

/// A parser of a verdict's name, for clap.
fn verdict_parser() -> impl TypedValueParser<Value = VerdictKind> {
    PossibleValuesParser::new(["valid", "invalid"]).map(|name| match name.as_str() {
        "valid" => VerdictKind::Valid,
        _ => VerdictKind::Invalid,
    })
}

/// Closes a record that was left open, and makes its `run.rrd` if that is missing or was changed.
fn close_record(path: &Path, json: bool) -> Result<()> {
    let is_closed = RunFolder::open(path)?.is_closed() && !is_being_written(path);
    let repaired = match is_closed && lacks_recording(path)? {
        true => None,
        false => Some(repair(path)?),
    };
    let (_, config) = open(path)?;
    // If it cannot be made, a changed one must not be taken for it.
    let recording = path.join(file::RECORDING);
    match fs::remove_file(&recording) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            return Err(Failure::io(&recording, error));
        }
        _ => {}
    }
    let fault = make_recording(path, describe(config), &mut |made| {
        print_stderr(format_args!(
            "making {}: {:.0} s of the run done",
            file::RECORDING,
            made.as_secs_f64()
        ));
    });
    let dir = path.display();
    if let Some(fault) = fault {
        let text = format!("{dir}: {fault}");
        if lacks_recording(path)? {
            return Err(Failure::environment(text));
        }
        print_stderr(text);
    }
    let Some(repaired) = repaired else {
        let object = json!({ "run_dir": dir.to_string(), "recording_made": true });
        return print_result(json, &object, || Ok(format!("{dir}: {} made", file::RECORDING)));
    };
    let cut = |(file, bytes): &(String, u64)| json!({ "file": file, "bytes": bytes });
    let object = json!({
        "run_dir": dir.to_string(),
        "stop_reason": repaired.stop_reason,
        "counts": repaired.counts,
        "cut": repaired.cuts.iter().map(cut).collect::<Vec<_>>(),
        "missing": repaired.missing,
    });
    print_result(json, &object, || Ok(format!("{dir}: closed: {repaired}")))
}

/// True if the record in `path` does not have the `run.rrd` that its manifest lists.
fn lacks_recording(path: &Path) -> Result<bool> {
    Ok(RunFolder::open(path)?.change(file::RECORDING)?.is_some())
}

/// Adds a verdict to the manifest of a record that is closed and unchanged.
fn add_verdict(path: &Path, verdict: VerdictKind, reason: &str, json: bool) -> Result<()> {
    if reason.trim().is_empty() {
        return Err(Failure::configuration("--reason is empty: say why"));
    }
    read::open(path)?;
    // The lock covers reading and writing of the manifest; otherwise two verdicts at once would
    // lose one.
    let Some(_lock) = lock(path).map_err(Failure::environment)? else {
        let why = "a bench is still writing this record, or another program has it; wait for it";
        return Err(Failure::environment(format_args!("{}: {why}", path.display())));
    };
    let (_, Folder { dir, condition, mut manifest, .. }) = read::open(path)?;
    let why = match condition {
        Condition::Whole => None,
        // This program has the lock, so no bench is writing the record.
        Condition::Open | Condition::BeingWritten => Some(format!(
            "a verdict needs a closed record; close it: needle-bench review {} --repair",
            shell_word(&dir)
        )),
        Condition::Changed(what) => Some(format!("{what}; a verdict needs the unchanged record")),
    };
    if let Some(why) = why {
        return Err(Failure::configuration(format_args!("{dir}: {why}")));
    }
    let given_utc = utc_text(SystemTime::now());
    manifest.verdicts.push(Verdict { verdict, reason: reason.to_owned(), given_utc });
    write_manifest(path, &manifest).map_err(Failure::environment)?;
    let object = json!({ "run_dir": dir, "verdicts": manifest.verdicts });
    print_result(json, &object, || Ok(format!("{dir}: {verdict}, {}", escaped(reason))))
}
