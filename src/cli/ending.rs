//! The exit status and the last lines of a run.

use super::{COMPLETED, ENVIRONMENT_FAILED, STOPPED};
use crate::archive::file;
use crate::config::{Config, OnFailure};
use crate::runtime::RunReport;
use crate::session::Outcome;
use crate::study::OFF_PLANE_LIMIT_MM;
use crate::telemetry::{Finished, TelemetryError};
use std::fs;
use std::path::Path;

/// Success means that the run completed and left its record, whole if `config` requires that.
pub(super) fn status(config: &Config, report: &RunReport) -> u8 {
    let is_wanted = config.record.on_failure == OnFailure::Stop;
    match (&report.outcome, &report.record) {
        (_, Err(_)) => ENVIRONMENT_FAILED,
        (Outcome::Stopped(_), Ok(_)) => STOPPED,
        // The record failed while it was being closed, when nothing was left to stop.
        (Outcome::Completed, Ok(record)) if is_wanted && !record.faults.is_empty() => {
            ENVIRONMENT_FAILED
        }
        (Outcome::Completed, Ok(_)) => COMPLETED,
    }
}

/// Why the record is not whole; `None` if it is.
pub(super) fn record_error(record: &Result<Finished, TelemetryError>) -> Option<String> {
    match record {
        Ok(finished) => finished.faults.first().cloned(),
        Err(error) => Some(error.to_string()),
    }
}

/// The last lines of a summary: the record, and how the run ended.
pub(super) fn ending(report: &RunReport) -> String {
    let dir = report.run_dir.display();
    let mut lines = match &report.record {
        Err(error) => vec![format!(
            "record      {dir}, left open: {error}; close it: needle-bench review {dir} --repair"
        )],
        Ok(finished) => {
            let faults = finished.faults.iter();
            let mut lines: Vec<String> =
                faults.map(|fault| format!("record      incomplete: {fault}")).collect();
            let megabytes = folder_bytes(&report.run_dir) as f64 * 1e-6;
            let recording = report.run_dir.join(file::RECORDING);
            lines.push(match recording.exists() {
                true => format!(
                    "record      {dir} ({megabytes:.1} MB); look at it: rerun {}",
                    recording.display()
                ),
                false => format!(
                    "record      {dir} ({megabytes:.1} MB); make its {}: needle-bench review {dir} \
                     --repair",
                    file::RECORDING
                ),
            });
            lines
        }
    };
    lines.push(match (report.outcome.stop_reason(), plane_missed_by_mm(report)) {
        (None, None) => "completed".to_owned(),
        (None, Some(off_mm)) => format!(
            "completed, not in the plane: {off_mm:.1} mm RMS off it over the last third by the estimate \
             (limit {OFF_PLANE_LIMIT_MM:.1}); start nearer to it or insert deeper"
        ),
        (Some(reason), _) => format!("stopped: {reason}"),
    });
    lines.join("\n")
}

/// Where the needle is after a run on a bus, what the drives are doing, and the one next command, with
/// the configuration at `path`. On emulated drives nothing is left to do after a run that completed.
pub(super) fn after(config: &Config, path: Option<&Path>, report: &RunReport) -> Option<String> {
    let dir = &report.run_dir;
    let review = || format!("next        needle-bench review {}", dir.display());
    if config.is_emulated() {
        return report.outcome.stop_reason().map(|_| review());
    }
    let unknown = report.left_unknown;
    let drives = unknown.unwrap_or("both axes stand, power is off");
    let inserted_mm = report.figures.report().insertion_mm;
    let path = path.map_or_else(|| dir.join(file::CONFIG), Path::to_path_buf);
    let next = match withdrawal(config, report) {
        Err(_) if unknown.is_some() => {
            format!("next        needle-bench stage status {}", path.display())
        }
        Err(_) => review(),
        Ok(words) => {
            let words: String = words.iter().map(|word| format!(" {word}")).collect();
            format!("next        needle-bench stage withdraw {}{words}", path.display())
        }
    };
    Some(format!("needle      {inserted_mm:.1} mm in; {drives}\n{next}"))
}

/// What `stage withdraw` has to be told to take the needle out after a run, whether it completed or was
/// stopped.
///
/// # Errors
/// Why the needle is not withdrawn, in a few words.
pub(super) fn withdrawal(config: &Config, report: &RunReport) -> Result<Vec<String>, String> {
    let inserted_mm = report.figures.report().insertion_mm;
    if config.is_emulated() {
        Err("the emulated stage ended with its run".to_owned())
    } else if inserted_mm <= config.insertion.arrival_mm {
        Err(format!("the needle is out, at {inserted_mm:.2} mm"))
    } else if report.left_unknown.is_some() {
        Err("the drives are not known to stand; look at the stage".to_owned())
    } else {
        Ok(withdrawal_by(config, inserted_mm))
    }
}

fn withdrawal_by(config: &Config, inserted_mm: f64) -> Vec<String> {
    let insertion = &config.stage.insertion;
    if insertion.zero.is_some() {
        return Vec::new();
    }
    // The axis reads 0 where the withdrawal begins, and its limits count from there.
    let mut words = vec!["--by".to_owned(), format!("{inserted_mm:.1}mm")];
    let needed_mm = -(inserted_mm + 0.05).ceil();
    if insertion.min > needed_mm {
        words.extend(["--set".to_owned(), format!("stage.insertion.min_mm={needed_mm:.1}")]);
    }
    words
}

/// The size of the files in `dir`; a file that cannot be seen counts as empty.
pub(super) fn folder_bytes(dir: &Path) -> u64 {
    let Ok(files) = fs::read_dir(dir) else { return 0 };
    files.flatten().filter_map(|file| file.metadata().ok()).map(|file| file.len()).sum()
}

/// How far a completed run missed the plane, mm; `None` if it did not.
pub(super) fn plane_missed_by_mm(report: &RunReport) -> Option<f64> {
    let is_completed = report.outcome == Outcome::Completed;
    report.figures.plane_missed_by_mm().filter(|_| is_completed)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::archive::{Counts, Dropped};
    use crate::cli::sources::load;
    use crate::runtime::Holds;
    use crate::study::RunFigures;
    use crate::tracker::GateCounts;
    use crate::units::Time;
    use std::path::PathBuf;

    fn report(outcome: Outcome, faults: &[&str]) -> RunReport {
        let run_dir = PathBuf::from("runs/a");
        let finished = Finished {
            run_dir: run_dir.clone(),
            counts: Counts::default(),
            dropped: Dropped::default(),
            faults: faults.iter().map(|fault| (*fault).to_owned()).collect(),
        };
        RunReport {
            outcome,
            figures: RunFigures::default(),
            left_unknown: None,
            holds: Holds::default(),
            gates: GateCounts::default(),
            end: Time::ZERO,
            timing: None,
            run_dir,
            record: Ok(finished),
            emulated: None,
        }
    }

    #[test]
    fn a_record_left_open_is_named_with_what_closes_it() {
        let mut report = report(Outcome::Completed, &[]);
        let source = std::io::ErrorKind::NotFound.into();
        report.record = Err(TelemetryError::File { path: "runs/a/manifest.json".into(), source });
        let said = ending(&report);
        let said: Vec<&str> = said.lines().collect();
        assert!(said[0].starts_with("record      runs/a, left open: "), "{said:?}");
        assert!(said[0].ends_with("; close it: needle-bench review runs/a --repair"), "{said:?}");
        assert_eq!(said[1], "completed");
    }

    /// The needle is withdrawn after a stop as after a completed run, unless the drives may still move.
    #[test]
    fn a_needle_is_withdrawn_from_drives_that_are_known_to_stand() {
        let real = load(Some(Path::new("bench-config/vcan.toml")), None, &[]).unwrap();
        let report = |insertion_mm: f64, left_unknown: Option<&'static str>| {
            let stopped = Outcome::Stopped("operator: interrupted".to_owned());
            let mut report = RunReport { left_unknown, ..report(stopped, &[]) };
            report.figures.take_scored(insertion_mm, None, None);
            report
        };
        let why = |report: &RunReport| withdrawal(&real, report).unwrap_err();
        assert_eq!(withdrawal(&real, &report(5.0, None)), Ok(withdrawal_by(&real, 5.0)));
        assert_eq!(why(&report(0.01, None)), "the needle is out, at 0.01 mm");
        let stopped = report(5.0, Some("the axes were not seen to stand"));
        assert_eq!(why(&stopped), "the drives are not known to stand; look at the stage");
        let said = after(&real, Some(Path::new("rig.toml")), &stopped).unwrap();
        assert!(said.ends_with("\nnext        needle-bench stage status rig.toml"), "{said}");
        let said = after(&real, Some(Path::new("rig.toml")), &report(5.0, None)).unwrap();
        let next = "\nnext        needle-bench stage withdraw rig.toml --by 5.0mm";
        assert!(said.contains(next), "{said}");
    }

    /// An axis that reads 0 wherever it starts may not go as far back as the needle went in.
    #[test]
    fn the_withdrawal_that_is_named_is_one_that_the_limits_allow() {
        let words = |sets: &[&str]| {
            let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
            withdrawal_by(&load(None, None, &sets).unwrap(), 12.96).join(" ")
        };
        assert_eq!(words(&[]), "");
        let start = "stage.insertion.zero=\"start\"";
        assert_eq!(words(&[start]), "--by 13.0mm --set stage.insertion.min_mm=-14.0");
        assert_eq!(words(&[start, "stage.insertion.min_mm=-20"]), "--by 13.0mm");
    }

    /// With `record.on_failure = "stop"` a run without a whole record is no success.
    #[test]
    fn a_completed_run_without_its_record_is_a_failure() {
        let mut config = load(None, None, &[]).unwrap();
        let lost = ["recording: the disk took nothing for 5.0 s"];
        assert_eq!(status(&config, &report(Outcome::Completed, &[])), 0);
        assert_eq!(status(&config, &report(Outcome::Completed, &lost)), 3);
        assert_eq!(status(&config, &report(Outcome::Stopped("tracker".to_owned()), &lost)), 1);
        config.record.on_failure = OnFailure::GoOn;
        assert_eq!(status(&config, &report(Outcome::Completed, &lost)), 0);
    }
}
