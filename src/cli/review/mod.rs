//! `needle-bench review`: shows, compares, judges and repairs recorded runs.

mod judge;
mod read;

use self::judge::Judgement;
use super::output::{give, tell};
use super::runs::{RUNS, newest_first};
use super::{BAD_CONFIGURATION, Failure};
use crate::archive::file;
use crate::review::{
    Campaign, Comparison, Condition, GENERATOR, Line, Run, html, to_json, to_text,
};
use clap::Args;
use serde_json::json;
use std::fs::{self, File};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};

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
    #[command(flatten)]
    judgement: Judgement,
    /// One JSON object on stdout.
    #[arg(long)]
    pub(super) json: bool,
}

pub(super) fn review(arguments: &Arguments) -> Result<ExitCode, Failure> {
    let newest = || {
        let run = newest_first(Path::new(RUNS)).next().map(|run| run.dir().to_path_buf());
        run.ok_or_else(|| Failure::Configuration(format!("no run in {RUNS}: name a run folder")))
    };
    let paths = match arguments.paths.is_empty() {
        true => vec![newest()?],
        false => arguments.paths.clone(),
    };
    let (is_campaign, is_one) = match paths.as_slice() {
        _ if arguments.judgement.is_asked() => (false, false),
        [path] => (read::is_folder_of_runs(path), !read::is_folder_of_runs(path)),
        paths => (paths.len() > 2, false),
    };
    let applies = |flag: &str, is_given: bool, applies: bool, to: &str| match is_given && !applies {
        true => Err(Failure::Configuration(format!("{flag} is about {to}"))),
        false => Ok(()),
    };
    applies("--by", arguments.by.is_some(), is_campaign, "a campaign: name a folder of runs")?;
    applies("--html", arguments.html.is_some(), is_one, "one run, which has a page: name one")?;
    applies("--open", arguments.open, is_one, "one run: name one")?;
    match paths.as_slice() {
        [path] if arguments.judgement.is_asked() => {
            arguments.judgement.give(path, arguments.json)?;
            Ok(ExitCode::SUCCESS)
        }
        _ if arguments.judgement.is_asked() => Err(Failure::Configuration(
            "--verdict and --repair are about one run: name one run folder".to_owned(),
        )),
        [path] if read::is_folder_of_runs(path) => {
            campaign(read::entries(path).map_err(Failure::environment)?, arguments)
        }
        [path] => one(path, arguments),
        [a, b] => {
            let (a, b) = (read::run(a)?, read::run(b)?);
            let comparison = Comparison::of(&a, &b);
            give(arguments.json, &comparison.to_json(), || comparison.to_text())?;
            Ok(status(&[&a, &b]))
        }
        many => {
            let entries =
                many.iter().map(|path| read::entries(path)).collect::<io::Result<Vec<_>>>();
            campaign(entries.map_err(Failure::environment)?.concat(), arguments)
        }
    }
}

/// One run: its page, then its summary.
fn one(path: &Path, arguments: &Arguments) -> Result<ExitCode, Failure> {
    let run = read::run(path)?;
    let page = match &arguments.html {
        _ if arguments.no_html => None,
        Some(file) => Some(file.clone()),
        None => Some(path.join(file::REPORT)),
    };
    let written = page.map(|page| {
        let written = html(&run).map_err(io::Error::other).and_then(|text| match arguments.html {
            None => write_report(&page, &text),
            Some(_) => File::create_new(&page)?.write_all(text.as_bytes()),
        });
        let path = page.display();
        let hint = "--html FILE puts it into a new file, --no-html leaves it";
        written.map(|()| path.to_string()).map_err(|error| format!("{path}: {error}; {hint}"))
    });
    let report = written.as_ref().and_then(|written| written.as_deref().ok());
    let mut object = to_json(&run);
    object["report"] = json!(report);
    give(arguments.json, &object, || to_text(&run, report))?;
    match written {
        // The summary was printed already; the error follows it.
        Some(Err(error)) => {
            tell(format_args!("error: {error}"));
            Ok(ExitCode::from(super::ENVIRONMENT_FAILED))
        }
        _ if arguments.open => open_viewer(&path.join(file::RECORDING)).map(|()| status(&[&run])),
        _ => Ok(status(&[&run])),
    }
}

/// Starts the viewer with `recording`, and does not wait for it.
fn open_viewer(recording: &Path) -> Result<(), Failure> {
    let shown = recording.display();
    if !recording.is_file() {
        return Err(Failure::Configuration(format!(
            "{shown} is not there: make it by needle-bench review --repair"
        )));
    }
    let started = Command::new("rerun").arg(recording).stdout(Stdio::null()).spawn();
    started.map(drop).map_err(|error| {
        Failure::Environment(format!("rerun {shown}: {error}; install it: pip install rerun-sdk"))
    })
}

/// Writes the report beside the record atomically; it replaces an earlier report.
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

fn campaign(entries: Vec<Line>, arguments: &Arguments) -> Result<ExitCode, Failure> {
    let campaign =
        Campaign::of(entries, arguments.by.as_deref()).map_err(Failure::configuration)?;
    give(arguments.json, &campaign.to_json(), || campaign.to_text())?;
    Ok(ExitCode::SUCCESS)
}

/// An edited record is bad input: it is not what the run recorded.
fn status(runs: &[&Run]) -> ExitCode {
    let is_edited = |run: &&Run| matches!(run.folder.condition, Condition::Changed(_));
    match runs.iter().any(is_edited) {
        true => ExitCode::from(BAD_CONFIGURATION),
        false => ExitCode::SUCCESS,
    }
}
