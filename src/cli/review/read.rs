//! Reads run folders for a review.

use crate::archive::{StepsTable, TrackerTimes, file};
use crate::cli::Result;
use crate::cli::records::folders_in;
use crate::review::{
    Condition, Folder, Line, Motion, Run, figures_of_steps, parse_event, parse_frame,
};
use crate::telemetry::{RunFolder, TelemetryError, is_being_written};
use crate::text::shell_word;
use std::io;
use std::path::Path;

/// The whole run in `path`. [`Run::unreadable`] names the files that cannot be read.
pub(super) fn run(path: &Path) -> Result<Run> {
    let (record, folder) = open(path)?;
    let mut unreadable = Vec::new();
    let shown = path.join(file::STEPS);
    let steps = record.text(file::STEPS).map_err(|error| error.to_string()).and_then(|text| {
        StepsTable::parse(&text).map_err(|error| format!("{}: {error}", shown.display()))
    });
    let steps = steps.unwrap_or_else(|error| {
        unreadable.push(error);
        StepsTable::default()
    });
    unreadable.extend(steps.miscount().map(|why| format!("{}: {why}", shown.display())));
    let samples = lines(&record, file::TRACKER, TrackerTimes::parse, &mut unreadable);
    let samples = folder.tip_samples(samples);
    let motion = Motion::new(&lines(&record, file::CAN, parse_frame, &mut unreadable), &folder);
    let events = lines(&record, file::EVENTS, parse_event, &mut unreadable);
    // A record that is not closed has no `run.rrd` yet.
    let is_closed = !matches!(folder.condition, Condition::BeingWritten | Condition::Open);
    if let Some(change) = record.change(file::RECORDING)?.filter(|_| is_closed) {
        let dir = shell_word(path.display());
        unreadable.push(format!("{change}; make it: needle-bench review {dir} --repair"));
    }
    Ok(Run { folder, steps, samples, motion, events, unreadable })
}

/// The lines of the file `name`, parsed by `parse`. Adds to `unreadable` what cannot be read or parsed.
fn lines<T>(
    folder: &RunFolder,
    name: &str,
    parse: impl Fn(&str) -> Option<T>,
    unreadable: &mut Vec<String>,
) -> Vec<T> {
    let path = folder.dir.join(name);
    match folder.lines(name).and_then(|lines| lines.parse(parse)) {
        Ok((values, damaged)) => {
            let count = damaged.len();
            unreadable.extend(damaged.first().map(|first| {
                format!("{} line {first} cannot be read, {count} in all", path.display())
            }));
            values
        }
        Err(error) => {
            unreadable.push(format!("{}: {error}", path.display()));
            Vec::new()
        }
    }
}

/// The line of a run folder in a campaign.
fn campaign_line(path: &Path) -> Line {
    match open(path) {
        Ok((_, folder)) => Line::run(folder),
        Err(error) => Line::unreadable(path.display().to_string(), error.to_string()),
    }
}

/// The lines of a campaign for the run folder `path`, or for the folders in it, by name.
pub(super) fn campaign_lines(path: &Path) -> io::Result<Vec<Line>> {
    match is_folder_of_runs(path) {
        true => Ok(folders_in(path)?.iter().map(|path| campaign_line(path)).collect()),
        false => Ok(vec![campaign_line(path)]),
    }
}

/// True if `path` is not a run folder but contains some.
pub(super) fn is_folder_of_runs(path: &Path) -> bool {
    let is_run = |path: &Path| path.join(file::MANIFEST).exists();
    let folders = folders_in(path).unwrap_or_default();
    !is_run(path) && folders.iter().any(|folder| is_run(folder))
}

/// Opens the run folder `path`; returns also its manifest, configuration and condition.
pub(super) fn open(path: &Path) -> Result<(RunFolder, Folder), TelemetryError> {
    let record = RunFolder::open(path)?;
    let condition = match record.verify() {
        Ok(()) if record.is_closed() => Condition::Whole,
        Ok(()) if is_being_written(path) => Condition::BeingWritten,
        Ok(()) => Condition::Open,
        Err(TelemetryError::Unusable { reason, .. }) => Condition::Changed(reason),
        Err(error) => return Err(error),
    };
    let figures_of_steps = match record.manifest.figures.is_empty() {
        true => record.text(file::STEPS).ok().and_then(|text| figures_of_steps(&text)),
        false => None,
    };
    let folder = Folder {
        figures_of_steps,
        dir: path.display().to_string(),
        manifest: record.manifest.clone(),
        condition,
        // If it is missing, the condition says so.
        config_toml: record.text(file::CONFIG).ok(),
    };
    Ok((record, folder))
}
