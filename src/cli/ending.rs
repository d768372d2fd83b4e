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
pub(in crate::cli) mod tests {
    use super::*;
    use crate::archive::{Counts, Dropped};
    use crate::cli::sources::load;
    use crate::runtime::Holds;
    use crate::session::Left;
    use crate::study::RunFigures;
    use crate::tracker::GateCounts;
    use crate::units::Time;
    use std::path::PathBuf;

    pub(in crate::cli) fn report(outcome: Outcome, faults: &[&str]) -> RunReport {
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
            left: Left::default(),
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
