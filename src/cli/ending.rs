//! The end of a run: its exit status and last lines, where the needle is, what the drives are doing, and
//! which command comes next.

use super::{ENVIRONMENT_FAILED, STOPPED};
use crate::archive::file;
use crate::canopen::cia402::DriveState;
use crate::config::{Config, OnFailure};
use crate::runtime::RunReport;
use crate::session::{Outcome, StageAtEnd};
use crate::stage::{Axis, DriveReport};
use crate::study::{OFF_PLANE_LIMIT_MM, PlanStatus};
use crate::telemetry::{Finished, TelemetryError};
use crate::text::fixed;
use std::fmt;
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
        (Outcome::Completed, Ok(_)) => 0,
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
pub(super) fn ending(config: &Config, report: &RunReport) -> String {
    let dir = report.run_dir.display();
    let recording = report.run_dir.join(file::RECORDING);
    let mut lines = Vec::new();
    match &report.record {
        Err(error) => lines.push(format!(
            "record      {dir}, left open: {error}; close it: needle-bench review {dir} --repair"
        )),
        Ok(finished) => {
            let incomplete = |fault| format!("record      incomplete: {fault}");
            lines.extend(finished.faults.iter().map(incomplete));
            let look = match recording.exists() {
                true => format!("look at it: rerun {}", recording.display()),
                false => format!("make its run.rrd: needle-bench review {dir} --repair"),
            };
            let megabytes = folder_bytes(&report.run_dir) as f64 * 1e-6;
            lines.push(format!("record      {dir} ({megabytes:.1} MB); {look}"));
        }
    }
    lines.push(match (report.outcome.stop_reason(), plane_missed_by_mm(report)) {
        (None, _) if plan_status(config, report) == Some(PlanStatus::Missed) => format!(
            "completed, not at the target: {} mm from it by the estimate (limit goal.tolerance_mm = {}); \
             target_error_pred_mm in steps.csv shows where it was lost",
            fixed(report.figures.report().target_error_est_mm, 3),
            config.goal.tolerance_mm
        ),
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

/// What became of the plan; `None` without a target.
pub(super) fn plan_status(config: &Config, report: &RunReport) -> Option<PlanStatus> {
    let is_completed = report.outcome == Outcome::Completed;
    report.figures.report().plan_status(is_completed, config.goal.tolerance_mm)
}

/// How far a completed run missed the plane, mm; `None` if it did not.
pub(super) fn plane_missed_by_mm(report: &RunReport) -> Option<f64> {
    let is_completed = report.outcome == Outcome::Completed;
    report.figures.plane_missed_by_mm().filter(|_| is_completed)
}

/// The lines of an insertion on a bus, with the configuration at `path`. On emulated drives nothing is left
/// to do after a run that completed.
pub(super) fn after_insertion(
    config: &Config,
    path: Option<&Path>,
    report: &RunReport,
) -> Option<String> {
    if config.is_emulated() {
        return report.outcome.stop_reason().map(|_| review(report));
    }
    let inserted_mm = report.figures.report().insertion_mm;
    let next = match (needed(config, &report.left), withdrawal(config, report)) {
        (Some(operation), _) => stage(operation, path, report),
        (None, Err(_)) => review(report),
        (None, Ok(withdrawal)) => stage("withdraw", path, report) + &withdrawal.options(),
    };
    Some(format!("needle      {inserted_mm:.1} mm in; {}\n{next}", drives(&report.left)))
}

/// The lines of an operation that was stopped, or that left a drive in Fault. Of a withdrawal `rest` are the
/// words after `stage withdraw` that finish it.
pub(super) fn after_operation(
    config: &Config,
    path: Option<&Path>,
    rest: Option<&str>,
    report: &RunReport,
) -> Option<String> {
    let is_stopped = report.outcome.stop_reason().is_some();
    if config.is_emulated() {
        return is_stopped.then(|| review(report));
    }
    let needed = needed(config, &report.left);
    if !is_stopped && needed.is_none() {
        return None;
    }
    let place = match report.left.position {
        Some(position) => {
            let place = |axis: Axis| format!("{axis} at {}", axis.shown(position.along(axis)));
            Axis::BOTH.map(place).join(", ")
        }
        None => "not known where the axes stand".to_owned(),
    };
    let next = match (needed, rest) {
        (None, Some(rest)) => stage("withdraw", path, report) + rest,
        _ => stage(needed.unwrap_or("status"), path, report),
    };
    Some(format!("stage       {place}; {}\n{next}", drives(&report.left)))
}

fn review(report: &RunReport) -> String {
    format!("next        needle-bench review {}", report.run_dir.display())
}

/// The next command where it is an `operation` of the stage.
fn stage(operation: &str, path: Option<&Path>, report: &RunReport) -> String {
    let path = path.map_or_else(|| report.run_dir.join(file::CONFIG), Path::to_path_buf);
    format!("next        needle-bench stage {operation} {}", path.display())
}

/// The operation of the stage that its drives need before any other.
fn needed(config: &Config, left: &StageAtEnd) -> Option<&'static str> {
    let is_in_fault = !left.drives.all(|drive| !is_in_fault(drive));
    match left.unknown {
        Some(_) => Some("status"),
        None => (is_in_fault && !config.stage.power.fault_reset_on_start).then_some("reset"),
    }
}

fn is_in_fault(drive: &DriveReport) -> bool {
    drive.state.is_some_and(DriveState::is_fault)
}

/// What the drives are doing.
fn drives(left: &StageAtEnd) -> String {
    let known = match left.had_power {
        true => "both axes stand, power is off",
        false => "no power was given",
    };
    let mut text = left.unknown.unwrap_or(known).to_owned();
    for axis in Axis::BOTH.into_iter().filter(|axis| is_in_fault(&left.drives[*axis])) {
        let error = left.drives[axis].error.map(|error| format!(" ({error})"));
        text += &format!("; {axis} is in fault{}", error.unwrap_or_default());
    }
    text
}

/// How `stage withdraw` takes the needle out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Withdrawal {
    /// How far back, mm; `None` to depth 0, where the axis has one.
    by_mm: Option<f64>,
    /// The position limit that it needs in place of the configured one, mm.
    min_mm: Option<f64>,
}

impl Withdrawal {
    /// Out of a depth of `inserted_mm`.
    fn of(config: &Config, inserted_mm: f64) -> Self {
        let insertion = &config.stage.insertion;
        if insertion.zero.is_some() {
            return Withdrawal { by_mm: None, min_mm: None };
        }
        // The axis reads 0 where the withdrawal begins, and its limits count from there.
        let needed_mm = -(inserted_mm + 0.05).ceil();
        let min_mm = (insertion.limits.min > needed_mm).then_some(needed_mm);
        Withdrawal { by_mm: Some(inserted_mm), min_mm }
    }

    /// The option of `stage withdraw` that says how far.
    pub(super) fn by(self) -> String {
        self.by_mm.map_or(String::new(), |mm| format!(" --by {mm:.1}mm"))
    }

    /// The options of `stage withdraw`.
    fn options(self) -> String {
        let set = self.min_mm.map(|mm| format!(" --set stage.insertion.min_mm={mm:.1}"));
        self.by() + &set.unwrap_or_default()
    }

    /// The configuration that allows it after the run of `report`.
    pub(super) fn allowed(self, mut config: Config, report: &RunReport) -> Config {
        if config.is_emulated()
            && let Some(position) = report.left.position
        {
            // Another emulated stage, which stands where that of the run ended.
            config.emulator.insertion_start_mm = position.insertion_mm;
        }
        if let Some(min_mm) = self.min_mm {
            config.stage.insertion.limits.min = min_mm;
        }
        config
    }
}

impl fmt::Display for Withdrawal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.by_mm {
            Some(mm) => write!(f, "by {mm:.1} mm"),
            None => f.write_str("to depth 0"),
        }
    }
}

/// How the needle can be taken out after a run, whether it completed or was stopped.
///
/// # Errors
/// Why the needle is not withdrawn, in a few words.
pub(super) fn withdrawal(config: &Config, report: &RunReport) -> Result<Withdrawal, String> {
    let inserted_mm = report.figures.report().insertion_mm;
    if inserted_mm <= config.insertion.arrival_mm {
        return Err(format!("the needle is out, at {inserted_mm:.2} mm"));
    }
    match needed(config, &report.left) {
        None => Ok(Withdrawal::of(config, inserted_mm)),
        Some("reset") => Err("a drive is in fault: find why, then stage reset".to_owned()),
        Some(_) => Err("the drives are not known to stand; look at the stage".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::archive::{Counts, Dropped};
    use crate::canopen::emcy::EmcyCode;
    use crate::cli::arguments::Configured;
    use crate::runtime::Holds;
    use crate::stage::{PerAxis, SetPoint};
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
            left: StageAtEnd::default(),
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
        let said = ending(&Config::from_sources(&[], &[]).unwrap(), &report);
        let said: Vec<&str> = said.lines().collect();
        assert!(said[0].starts_with("record      runs/a, left open: "), "{said:?}");
        assert!(said[0].ends_with("; close it: needle-bench review runs/a --repair"), "{said:?}");
        assert_eq!(said[1], "completed");
    }

    /// With `record.on_failure = "stop"` a run without a whole record is no success.
    #[test]
    fn a_completed_run_without_its_record_is_a_failure() {
        let mut config = Configured::default().load(None).unwrap();
        let lost = ["recording: the disk took nothing for 5.0 s"];
        assert_eq!(status(&config, &report(Outcome::Completed, &[])), 0);
        assert_eq!(status(&config, &report(Outcome::Completed, &lost)), 3);
        assert_eq!(status(&config, &report(Outcome::Stopped("tracker".to_owned()), &lost)), 1);
        config.record.on_failure = OnFailure::GoOn;
        assert_eq!(status(&config, &report(Outcome::Completed, &lost)), 0);
    }

    const RIG: &str = "rig.toml";

    fn config(sets: &[&str]) -> Config {
        let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
        Configured::new(Some(Path::new("bench-config/vcan.toml")), sets).load(None).unwrap()
    }

    fn stopped(insertion_mm: f64, left: StageAtEnd) -> RunReport {
        let stopped = Outcome::Stopped("operator: interrupted".to_owned());
        let mut report = RunReport { left, ..report(stopped, &[]) };
        report.figures.take_scored(insertion_mm, None, None);
        report
    }

    /// Both drives had power and stand at 5 mm and 90 degrees.
    fn stood() -> StageAtEnd {
        let off = DriveReport { state: Some(DriveState::SwitchOnDisabled), error: None };
        let position = SetPoint { insertion_mm: 5.0, rotation_rad: 90_f64.to_radians() };
        let drives = PerAxis::from_fn(|_| off);
        StageAtEnd { had_power: true, unknown: None, drives, position: Some(position) }
    }

    /// The rotation's drive is in Fault besides.
    fn in_fault() -> StageAtEnd {
        let mut left = stood();
        left.drives.rotation =
            DriveReport { state: Some(DriveState::Fault), error: Some(EmcyCode::HEARTBEAT) };
        left
    }

    #[test]
    fn a_needle_is_withdrawn_after_a_stop_as_after_a_completed_run() {
        let real = config(&[]);
        assert_eq!(withdrawal(&real, &stopped(5.0, stood())), Ok(Withdrawal::of(&real, 5.0)));
        let out = withdrawal(&real, &stopped(0.01, stood()));
        assert_eq!(out.unwrap_err(), "the needle is out, at 0.01 mm");
        let said = after_insertion(&real, Some(Path::new(RIG)), &stopped(5.0, stood())).unwrap();
        assert!(
            said.starts_with(
                "needle      5.0 mm in; both axes stand, power is off\n\
                 next        needle-bench stage withdraw rig.toml --by 5.0mm"
            ),
            "{said}"
        );
    }

    #[test]
    fn drives_that_may_move_are_looked_at_first() {
        let real = config(&[]);
        let unknown = Some("the axes were not seen to stand");
        let stopped = stopped(5.0, StageAtEnd { unknown, ..in_fault() });
        let why = withdrawal(&real, &stopped).unwrap_err();
        assert_eq!(why, "the drives are not known to stand; look at the stage");
        let path = Some(Path::new(RIG));
        for said in [
            after_insertion(&real, path, &stopped).unwrap(),
            after_operation(&real, path, Some(""), &stopped).unwrap(),
        ] {
            assert!(said.contains("; the axes were not seen to stand; rotation is in"), "{said}");
            assert!(said.ends_with("\nnext        needle-bench stage status rig.toml"), "{said}");
        }
    }

    #[test]
    fn a_drive_in_fault_is_named_and_reset_first() {
        let real = config(&[]);
        let stopped = stopped(5.0, in_fault());
        assert_eq!(
            after_insertion(&real, Some(Path::new(RIG)), &stopped).unwrap(),
            "needle      5.0 mm in; both axes stand, power is off; rotation is in fault (0x8130 \
             heartbeat or life guard lost)\n\
             next        needle-bench stage reset rig.toml"
        );
        let why = withdrawal(&real, &stopped).unwrap_err();
        assert_eq!(why, "a drive is in fault: find why, then stage reset");
        let resets = config(&["stage.fault_reset_on_start=true"]);
        let said = after_insertion(&resets, Some(Path::new(RIG)), &stopped).unwrap();
        assert!(
            said.contains("\nnext        needle-bench stage withdraw rig.toml --by 5"),
            "{said}"
        );
    }

    #[test]
    fn an_operation_says_where_it_left_the_axes() {
        let real = config(&[]);
        let said = |report: &RunReport| after_operation(&real, Some(Path::new(RIG)), None, report);
        assert_eq!(
            said(&stopped(5.0, stood())).unwrap(),
            "stage       insertion at 5.000 mm, rotation at 90.000 deg; both axes stand, power is \
             off\nnext        needle-bench stage status rig.toml"
        );
        assert_eq!(
            said(&stopped(0.0, StageAtEnd::default())).unwrap(),
            "stage       not known where the axes stand; no power was given\n\
             next        needle-bench stage status rig.toml"
        );
        let withdrawal = stopped(5.0, stood());
        let said_of_it =
            after_operation(&real, Some(Path::new(RIG)), Some(" --by 5.0mm"), &withdrawal).unwrap();
        assert!(
            said_of_it.ends_with("\nnext        needle-bench stage withdraw rig.toml --by 5.0mm"),
            "{said_of_it}"
        );
        let done = RunReport { outcome: Outcome::Completed, ..stopped(5.0, stood()) };
        assert_eq!(said(&done), None);
        let proved = RunReport { left: in_fault(), ..done };
        let next = "\nnext        needle-bench stage reset rig.toml";
        assert!(said(&proved).unwrap().ends_with(next));
    }

    /// An axis that reads 0 wherever it starts may not go as far back as the needle went in.
    #[test]
    fn the_withdrawal_that_is_named_is_one_that_the_limits_allow() {
        let options = |sets: &[&str]| {
            let sets = sets.iter().map(|set| (*set).to_owned()).collect();
            let config = Configured::new(None, sets).load(None).unwrap();
            let withdrawal = Withdrawal::of(&config, 12.96);
            let allowed = withdrawal.allowed(config, &stopped(12.96, stood()));
            assert_eq!(allowed.emulator.insertion_start_mm, 5.0, "where the stage stands");
            assert!(allowed.stage.insertion.limits.min <= -13.0 || withdrawal.by_mm.is_none());
            withdrawal.options()
        };
        assert_eq!(options(&[]), "");
        let start = "stage.insertion.zero=\"start\"";
        assert_eq!(options(&[start]), " --by 13.0mm --set stage.insertion.min_mm=-14.0");
        assert_eq!(options(&[start, "stage.insertion.min_mm=-20"]), " --by 13.0mm");
    }
}
