//! The end of a run: its exit status and last lines, where the needle is, what the drives are doing, and
//! which command comes next.

use super::{ENVIRONMENT_FAILED, STOPPED};
use crate::archive::file;
use crate::canopen::cia402::DriveState;
use crate::config::{Config, GoalKind, OnFailure};
use crate::runtime::RunReport;
use crate::session::{Outcome, StageAtEnd};
use crate::stage::{Axis, DriveReport, Reference};
use crate::study::{OFF_PLANE_LIMIT_MM, PlanStatus};
use crate::text::{fixed, shell_word};
use derive_more::Display;
use std::fmt;
use std::fs;
use std::path::Path;

/// A needle that bends by less than this part of its configured curvature misses the plane for that reason.
const BENT_PART_MIN: f64 = 0.5;

/// The exit status of a run. Success means that the run completed and left its record, whole if `config` requires
/// that.
pub(super) fn status(config: &Config, report: &RunReport) -> u8 {
    let must_be_whole = config.record.on_failure == OnFailure::Stop;
    match &report.record {
        Err(_) => ENVIRONMENT_FAILED,
        Ok(_) if report.outcome != Outcome::Completed => STOPPED,
        // The record failed while it was being closed, when nothing was left to stop.
        Ok(record) if must_be_whole && !record.faults.is_empty() => ENVIRONMENT_FAILED,
        Ok(_) => 0,
    }
}

/// The last lines of a summary: the record, and how the run ended.
pub(super) fn ending(config: &Config, report: &RunReport) -> String {
    let run_dir = report.run_dir.as_deref().unwrap_or(Path::new(""));
    let (dir, word) = (run_dir.display(), shell_word(run_dir.display()));
    let recording = run_dir.join(file::RECORDING);
    let mut lines = Vec::new();
    match &report.record {
        Err(error) if report.run_dir.is_none() => lines.push(format!("record      none: {error}")),
        Err(error) if !run_dir.exists() => lines.push(format!(
            "record      {dir} is no longer there: {error}; if it was renamed, close it under its new name: \
             needle-bench review FOLDER --repair"
        )),
        Err(error) => lines.push(format!(
            "record      {dir}, left open: {error}; close it: needle-bench review {word} --repair"
        )),
        Ok(finished) => {
            let incomplete = |fault| format!("record      incomplete: {fault}");
            lines.extend(finished.faults.iter().map(incomplete));
            let look = match recording.exists() {
                true => format!("look at it: rerun {}", shell_word(recording.display())),
                false => format!("make its run.rrd: needle-bench review {word} --repair"),
            };
            let megabytes = folder_bytes(run_dir) as f64 * 1e-6;
            lines.push(format!("record      {dir} ({megabytes:.1} MB); {look}"));
        }
    }
    lines.push(match (report.outcome.stop_reason(), plane_missed_by_mm(report)) {
        (None, _) if plan_status(config, report) == Some(PlanStatus::Missed) => format!(
            "completed, not at the target: {} mm from it by the estimate (limit goal.tolerance_mm = {}); \
             see target_error_pred_mm and, off the plane, x_est_mm in steps.csv",
            fixed(report.figures.report().target_error_est_mm, 3),
            config.goal.tolerance_mm
        ),
        (None, None) if report.figures.is_unsteered() => {
            "completed, not steered: the observer had no estimate at any step; see observer.kind and its section"
                .to_owned()
        }
        (None, None) => "completed".to_owned(),
        (None, Some(off_mm)) => match bent_part(config, report).filter(|part| *part < BENT_PART_MIN) {
            Some(part) => format!(
                "completed, not in the plane: {off_mm:.1} mm RMS off it by the estimate (limit \
                 {OFF_PLANE_LIMIT_MM:.1}); the needle bent by {:.0}% of what needle.radius_mm says: check bevel, \
                 tissue and radius (needle-bench calibrate needle)",
                100.0 * part
            ),
            None => format!(
                "completed, not in the plane: {off_mm:.1} mm RMS off it over the last third by the estimate (limit \
                 {OFF_PLANE_LIMIT_MM:.1}); start nearer to it, or insert deeper if the tip was still approaching it"
            ),
        },
        (Some(reason), _) => format!("stopped: {reason}"),
    });
    lines.join("\n")
}

/// The size of the files in `dir`; a file that cannot be read counts as empty.
pub(super) fn folder_bytes(dir: &Path) -> u64 {
    let Ok(files) = fs::read_dir(dir) else { return 0 };
    files.flatten().filter_map(|file| file.metadata().ok()).map(|file| file.len()).sum()
}

/// What became of the plan; `None` without a target.
pub(super) fn plan_status(config: &Config, report: &RunReport) -> Option<PlanStatus> {
    let is_completed = report.outcome == Outcome::Completed;
    let status = report.figures.report().plan_status(is_completed, config.goal.tolerance_mm);
    status.filter(|_| config.goal.kind == GoalKind::Target)
}

/// How far a completed run missed the plane, mm; `None` if it did not.
pub(super) fn plane_missed_by_mm(report: &RunReport) -> Option<f64> {
    let is_completed = report.outcome == Outcome::Completed;
    report.figures.plane_missed_by_mm().filter(|_| is_completed)
}

/// The estimated curvature at the end as a part of the configured one; `None` if the observer has no belief.
fn bent_part(config: &Config, report: &RunReport) -> Option<f64> {
    let estimated_per_mm = report.figures.curvature_per_mm()?;
    Some((estimated_per_mm / config.needle.arc.curvature_per_mm()).max(0.0))
}

/// The lines after an insertion with the configuration at `path`: where the needle is, and the next command.
/// `None` after a run on emulated drives that completed.
pub(super) fn after_insertion(
    config: &Config,
    path: Option<&Path>,
    report: &RunReport,
) -> Option<String> {
    if config.is_emulated() {
        return report.outcome.stop_reason().and_then(|_| next_review(report));
    }
    let depth_mm = depth_mm(config, report);
    let next = match (required(config, &report.stage_at_end), possible_withdrawal(config, report)) {
        (Some(required), _) => next_stage(&required.to_string(), "", path, report),
        (None, Err(_)) if depth_mm.is_none() => match unhomed_withdrawal(config, report) {
            Some(options) => next_stage("withdraw", &options, path, report),
            None => next_stage("status", "", path, report),
        },
        (None, Err(_)) => next_review(report)?,
        (None, Ok(withdrawal)) => next_stage("withdraw", &withdrawal.options(), path, report),
    };
    let needle = match depth_mm {
        None => format!(
            "its depth is not known, this run inserted {:.1} mm",
            report.figures.report().insertion_mm
        ),
        Some(mm) => needle_at(config, mm),
    };
    Some(format!("needle      {needle}; {}\n{next}", drives(&report.stage_at_end)))
}

/// Where the insertion axis stands after an insertion, mm. `None` if the drives have not reported it, or if it is less
/// than the lower limit plus what the run inserted: then a drive has restarted and counts anew.
fn depth_mm(config: &Config, report: &RunReport) -> Option<f64> {
    let depth_mm = report.stage_at_end.position_of(Axis::Insertion)?;
    let least_mm = config.stage.insertion.limits.min + report.figures.report().insertion_mm;
    (depth_mm >= least_mm - config.insertion.arrival_mm).then_some(depth_mm)
}

/// The options of the `stage withdraw` after a run whose drive has lost its home, by a restart.
fn unhomed_withdrawal(config: &Config, report: &RunReport) -> Option<String> {
    let is_lost = config.stage.insertion.reference == Reference::Homing
        && report.stage_at_end.position.is_some();
    let inserted_mm = report.figures.report().insertion_mm;
    (is_lost && inserted_mm >= BY_ROUNDING_MM)
        .then(|| format!(" --by {inserted_mm:.1}mm --unhomed"))
}

/// Where the needle is. An axis without a configured zero knows only its travel in the run.
fn needle_at(config: &Config, depth_mm: f64) -> String {
    match config.stage.insertion.zero {
        None => format!("{depth_mm:.1} mm in from where the run began"),
        Some(_) if depth_mm <= config.insertion.arrival_mm => format!("out, at {depth_mm:.2} mm"),
        Some(_) => format!("{depth_mm:.1} mm in"),
    }
}

/// The lines after an operation that was stopped or left a drive in Fault: where the axes are, and the next
/// command. For a withdrawal, `remaining` holds the options of the `stage withdraw` that finishes it.
pub(super) fn after_operation(
    config: &Config,
    path: Option<&Path>,
    remaining: Option<&str>,
    report: &RunReport,
) -> Option<String> {
    let is_stopped = report.outcome.stop_reason().is_some();
    if config.is_emulated() {
        return next_review(report).filter(|_| is_stopped);
    }
    let required = required(config, &report.stage_at_end);
    if !is_stopped && required.is_none() {
        return None;
    }
    let position_of = |axis| report.stage_at_end.position_of(axis);
    let shown = |axis: Axis| match position_of(axis) {
        Some(position) => format!("{axis} at {}", axis.shown(position)),
        None => format!("not known where the {axis} stands"),
    };
    let positions = match report.stage_at_end.position {
        Some(_) => Axis::BOTH.map(shown).join(", "),
        None => "not known where the axes stand".to_owned(),
    };
    let remaining = remaining.filter(|_| position_of(Axis::Insertion).is_some());
    let next = match (required, remaining) {
        (Some(required), _) => next_stage(&required.to_string(), "", path, report),
        (None, Some(remaining)) => next_stage("withdraw", remaining, path, report),
        (None, None) => next_stage("status", "", path, report),
    };
    Some(format!("stage       {positions}; {}\n{next}", drives(&report.stage_at_end)))
}

/// The line with the next command, a review of the run; `None` without a record.
fn next_review(report: &RunReport) -> Option<String> {
    let run_dir = report.run_dir.as_ref()?;
    Some(format!("next        needle-bench review {}", shell_word(run_dir.display())))
}

/// The line with the next command, an `operation` of the stage with `options`.
fn next_stage(operation: &str, options: &str, path: Option<&Path>, report: &RunReport) -> String {
    let recorded = report.run_dir.as_ref().map(|dir| dir.join(file::CONFIG));
    match path.map(Path::to_path_buf).or(recorded.filter(|path| path.exists())) {
        Some(path) => {
            let path = shell_word(path.display());
            format!("next        needle-bench stage {operation} {path}{options}")
        }
        None => format!(
            "next        needle-bench stage {operation} CONFIG{options}, CONFIG and its --set as before"
        ),
    }
}

/// An operation of the stage that is required before any other.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Display)]
#[display(rename_all = "lowercase")]
enum Required {
    /// The drives are not known to stand without power.
    Status,
    /// A drive is in Fault, and a run would not reset it.
    Reset,
}

fn required(config: &Config, stage: &StageAtEnd) -> Option<Required> {
    if stage.unknown.is_some() {
        return Some(Required::Status);
    }
    let is_any_in_fault = Axis::BOTH.into_iter().any(|axis| is_in_fault(&stage.drives[axis]));
    (is_any_in_fault && !config.stage.power.fault_reset_on_start).then_some(Required::Reset)
}

fn is_in_fault(drive: &DriveReport) -> bool {
    drive.state.is_some_and(DriveState::is_fault)
}

/// The last known state of the drives.
fn drives(stage: &StageAtEnd) -> String {
    let known = match stage.had_power {
        true => "both axes stand, power is off",
        false => "no power was given",
    };
    let mut text = stage.unknown.unwrap_or(known).to_owned();
    for axis in Axis::BOTH.into_iter().filter(|axis| is_in_fault(&stage.drives[*axis])) {
        let error = stage.drives[axis].error.map(|error| format!(" ({error})"));
        text += &format!("; {axis} is in fault{}", error.unwrap_or_default());
    }
    text
}

/// `--by` is printed in tenths of a mm, so that it may exceed the depth by this.
const BY_ROUNDING_MM: f64 = 0.05;

/// How `stage withdraw` takes the needle out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Withdrawal {
    /// Distance, mm; `None` to depth 0, if the axis has a configured zero.
    by_mm: Option<f64>,
    /// The lower position limit that this distance requires, mm; `None` if the configured one allows it.
    min_mm: Option<f64>,
}

impl Withdrawal {
    /// The withdrawal from where the axis reads `inserted_mm`.
    fn from_depth(config: &Config, inserted_mm: f64) -> Self {
        let insertion = &config.stage.insertion;
        if insertion.zero.is_some() {
            return Withdrawal { by_mm: None, min_mm: None };
        }
        // The axis reads 0 where the withdrawal begins, and its limits count from there.
        let needed_mm = -(inserted_mm + BY_ROUNDING_MM).ceil();
        let min_mm = (insertion.limits.min > needed_mm).then_some(needed_mm);
        Withdrawal { by_mm: Some(inserted_mm), min_mm }
    }

    /// The option of `stage withdraw` for the distance; empty for depth 0.
    pub(super) fn by_option(self) -> String {
        self.by_mm.map_or(String::new(), |mm| format!(" --by {mm:.1}mm"))
    }

    /// The options of `stage withdraw`.
    fn options(self) -> String {
        let set = self.min_mm.map(|mm| format!(" --set stage.insertion.min_mm={mm:.1}"));
        self.by_option() + &set.unwrap_or_default()
    }

    /// The configuration for this withdrawal after the run of `report`.
    pub(super) fn configuration(self, mut config: Config, report: &RunReport) -> Config {
        if config.is_emulated()
            && let Some(position) = report.stage_at_end.position
        {
            // The withdrawal has a new emulated stage: it starts where that of the run ended.
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
pub(super) fn possible_withdrawal(
    config: &Config,
    report: &RunReport,
) -> Result<Withdrawal, String> {
    let Some(depth_mm) = depth_mm(config, report) else {
        return Err("the needle's depth is not known; look at the stage".to_owned());
    };
    if depth_mm <= config.insertion.arrival_mm {
        return Err(format!("the needle is {}", needle_at(config, depth_mm)));
    }
    match required(config, &report.stage_at_end) {
        None => Ok(Withdrawal::from_depth(config, depth_mm)),
        Some(Required::Reset) => Err("a drive is in fault: find why, then stage reset".to_owned()),
        Some(Required::Status) => {
            Err("the drives are not known to stand; look at the stage".to_owned())
        }
    }
}

#[cfg(test)]
mod tests;
