//! The figures of a run, with their limits.

use super::run::{Condition, Folder, Run};
use crate::archive::{RunOutcome, StepsTable};
use crate::config::{Config, ConfigError, GoalKind};
use crate::stage::Axis;
use crate::study::{FigureReport, OFF_PLANE_LIMIT_MM, RunFigures, TipError};
use crate::text::fixed;
use serde_json::Value;
use std::collections::BTreeMap;

/// The figures of a run: key, label, unit and decimals.
const FIGURES: [(&str, &str, &str, usize); 14] = [
    (DEPTH, "depth", "mm", 2),
    (OFF_PLANE, "off plane", "mm", 3),
    ("target_error_mm", "distance from the target at the last step, true", "mm", 3),
    ("target_error_est_mm", "distance from the target at the last step, estimated", "mm", 3),
    ("clearance_mm_min", "distance from an obstacle, min, estimated", "mm", 2),
    ("settling_mm", "within 1 mm of the plane from", "mm", 1),
    ("steps", "steps", "", 0),
    ("steps_saturated", "steps in which the law saturated", "", 0),
    (TIP_AGE, "age of the tip position at a step, max", "s", 3),
    ("tip_lag_mm_max", "depth past the step's tip position, max", "mm", 3),
    ("blind_s_max", "age of the newest tip position, max", "s", 3),
    (BLIND_DEPTH, "depth past the newest tip position, max", "mm", 3),
    ("following_error_mm_max", "following error of the insertion, max", "mm", 3),
    ("following_error_deg_max", "following error of the rotation, max", "deg", 2),
];
/// How late SYNCs left the bench. A run in virtual time has no such figures.
const TIMING: [(&str, &str, &str, usize); 3] = [
    ("sync_late_us_p50", "SYNC delay, median", "µs", 0),
    ("sync_late_us_p99", "SYNC delay, 99 %", "µs", 0),
    ("sync_late_us_max", "SYNC delay, max", "µs", 0),
];
/// The final depth. Its limit is a lower limit; all other limits are upper limits.
const DEPTH: &str = "insertion_mm";
pub(super) const OFF_PLANE: &str = "off_plane_rms_mm";
pub(super) const TIP_AGE: &str = "tip_age_s_max";
pub(super) const BLIND_DEPTH: &str = "blind_mm_max";

/// The configured depth, among the limits.
pub(super) const TARGET_DEPTH: &str = "depth_mm";

/// The limits of the figures, by their keys, and the configured depth.
pub(super) type Limits = BTreeMap<&'static str, f64>;

/// One figure of a run.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Figure {
    /// Its key in JSON, unit included.
    pub(super) key: String,
    /// Its name in words.
    pub(super) label: String,
    /// Its unit; empty for counts.
    pub(super) unit: &'static str,
    /// Digits shown after the point.
    pub(super) decimals: usize,
    /// `None` if it is not known.
    pub(super) value: Option<f64>,
    /// Its limit, if it has one.
    pub(super) limit: Option<f64>,
}

impl Figure {
    /// True if the figure is known and outside its limit.
    pub(super) fn is_outside(&self) -> bool {
        let is_within =
            |value, limit| if self.key == DEPTH { value >= limit } else { value <= limit };
        self.value.zip(self.limit).is_some_and(|(value, limit)| !is_within(value, limit))
    }

    /// The value, or a dash.
    pub(super) fn value_text(&self) -> String {
        fixed(self.value, self.decimals)
    }

    /// The limit with its sign; empty without one.
    pub(super) fn limit_text(&self) -> String {
        let sign = if self.key == DEPTH { '≥' } else { '≤' };
        self.limit.map(|limit| format!("{sign} {limit:.*}", self.decimals)).unwrap_or_default()
    }
}

/// The limits of a run with this `config`.
///
/// # Errors
/// This version of the bench refuses the stage.
pub(super) fn limits(config: &Config) -> Result<Limits, ConfigError> {
    let stage = config.to_stage()?;
    let following = |axis| stage.axis(axis).following_error_limit(stage.bus.sync_period());
    let (insertion, tracker) = (&config.insertion, &config.tracker);
    let mut limits = Limits::from([
        (TARGET_DEPTH, insertion.depth_mm),
        (DEPTH, insertion.depth_mm - insertion.arrival_mm),
        (OFF_PLANE, OFF_PLANE_LIMIT_MM),
        (TIP_AGE, tracker.hold.after.as_secs_f64()),
        ("tip_lag_mm_max", tracker.hold.after_mm),
        ("blind_s_max", tracker.hold.after.as_secs_f64()),
        (BLIND_DEPTH, tracker.hold.after_mm),
        ("following_error_mm_max", following(Axis::Insertion)),
        ("following_error_deg_max", following(Axis::Rotation).to_degrees()),
    ]);
    if config.goal.kind == GoalKind::Target {
        limits.retain(|key, _| ![TARGET_DEPTH, DEPTH, OFF_PLANE].contains(key));
        limits.extend(
            ["target_error_mm", "target_error_est_mm"].map(|key| (key, config.goal.tolerance_mm)),
        );
    }
    Ok(limits)
}

/// The figures of a run with their limits. An operation of the stage has fewer.
fn figures(folder: &Folder, report: Option<&FigureReport>, limits: &Limits) -> Vec<Figure> {
    let is_insertion = folder.manifest.operation.is_none();
    let has_ended = folder.condition != Condition::BeingWritten;
    let values = serde_json::to_value(report).unwrap_or_default();
    let of_report = |&(key, label, unit, decimals): &(&'static str, &str, _, _)| Figure {
        key: key.to_owned(),
        label: label.to_owned(),
        unit,
        decimals,
        value: values[key].as_f64(),
        limit: limits.get(key).copied().filter(|_| is_insertion && has_ended || key != DEPTH),
    };
    let mut all: Vec<Figure> = FIGURES.iter().map(of_report).collect();
    // An open record's manifest may not name the bus. The last step may have no estimate.
    let has_error = report.is_some_and(|it| it.final_error.or(it.estimate_rms).is_some());
    let has_truth = folder.has_truth() || has_error;
    let provenance = if has_truth { "true" } else { "estimated" };
    for figure in all.iter_mut().filter(|figure| figure.key == OFF_PLANE) {
        figure.label = format!("off plane ({provenance}), RMS over {}", last_third(folder, report));
    }
    if !limits.contains_key("target_error_mm") {
        all.retain(|figure| !figure.key.starts_with("target") && figure.key != "clearance_mm_min");
    }
    if !is_insertion {
        all.retain(|figure| figure.key == DEPTH || figure.key.starts_with("following"));
    }
    let timing = |key: &str| folder.manifest.timing.get(key).and_then(Value::as_f64);
    let of_timing = TIMING.iter().map(|row| Figure {
        value: timing(row.0),
        limit: timing("sync_late_limit_us"),
        ..of_report(row)
    });
    all.extend(of_timing.filter(|figure| figure.value.is_some()));
    all
}

/// The depth that the figures of the last third cover, in words. In a run that was stopped this is the last
/// third of the depth that it reached.
pub(super) fn last_third(folder: &Folder, report: Option<&FigureReport>) -> String {
    let ending = match folder.manifest.outcome {
        Some(RunOutcome::Completed) => return "the last third".to_owned(),
        Some(RunOutcome::Stopped) => "stopped",
        None => "not closed",
    };
    let of = report.map(|report| format!(" of {:.1} mm", report.insertion_mm));
    format!("the last third{}, {ending}", of.unwrap_or_default())
}

/// The errors of the estimate: a figure for each coordinate.
fn errors(folder: &Folder, report: Option<&FigureReport>) -> Vec<Figure> {
    let rms = format!("estimate's error, RMS over {},", last_third(folder, report));
    let sets = [
        ("estimate_rms", rms.as_str(), report.and_then(|it| it.estimate_rms)),
        ("final_error", "estimate's error at the last step,", report.and_then(|it| it.final_error)),
    ];
    let mut all = Vec::new();
    for (set, label, error) in sets {
        let values = error.map(|error| error.coordinates());
        for (i, name) in TipError::COORDINATES.into_iter().enumerate() {
            let (coordinate, unit) = name.split_once('_').unwrap_or((name, ""));
            all.push(Figure {
                key: format!("{set}.{name}"),
                label: format!("{label} {coordinate}"),
                unit,
                decimals: if unit == "mm" { 3 } else { 2 },
                value: values.map(|values| values[i]),
                limit: None,
            });
        }
    }
    all
}

/// The figures that can be computed from `steps.csv` alone, for a run that was not closed; `None` if the text is
/// not such a file.
pub fn figures_of_steps(steps_csv: &str) -> Option<FigureReport> {
    let steps = StepsTable::parse(steps_csv).ok()?;
    let coordinates = |provenance: &str| {
        TipError::COORDINATES.map(|name| {
            let (coordinate, unit) = name.split_once('_').unwrap_or((name, ""));
            let unit = if unit == "mm" { "mm" } else { "rad" };
            steps.column(&format!("{coordinate}_{provenance}_{unit}"))
        })
    };
    let values_at = |columns: &[Vec<Option<f64>>; 6], row: usize| -> Option<[f64; 6]> {
        let mut values = [0.0; 6];
        for (value, column) in values.iter_mut().zip(columns) {
            *value = column.get(row).copied().flatten()?;
        }
        Some(values)
    };
    let (est, truth) = (coordinates("est"), coordinates("true"));
    let depths = steps.column("insertion_mm");
    let mut figures = RunFigures::default();
    for (row, depth) in depths.into_iter().enumerate() {
        let Some(depth_mm) = depth else { continue };
        let (est, truth) = (values_at(&est, row), values_at(&truth, row));
        let error = est.zip(truth).map(|(est, truth)| TipError::between(est, truth));
        figures.take_scored(depth_mm, truth.or(est).map(|coordinates| coordinates[0]), error);
    }
    Some(FigureReport { steps_saturated: None, ..figures.report() })
}

impl Run {
    /// The run's figures, with limits if its configuration can be read.
    pub(super) fn limited_figures(&self) -> Vec<Figure> {
        let report = self.folder.figures();
        figures(&self.folder, report.as_ref(), &self.folder.limits().unwrap_or_default())
    }

    /// Those of the figures that are known; all of them, as unknown, if none can be read.
    pub(super) fn shown_figures(&self) -> Vec<Figure> {
        let is_read = self.folder.figures().is_some();
        let all = self.limited_figures().into_iter();
        all.filter(|figure| figure.value.is_some() || !is_read).collect()
    }

    /// The run's figures with their limits, and the errors of the estimate.
    pub(super) fn all_figures(&self) -> Vec<Figure> {
        let mut all = self.limited_figures();
        all.extend(errors(&self.folder, self.folder.figures().as_ref()));
        all
    }
}

#[cfg(test)]
mod tests {
    use super::super::run::tests::{run, steps_csv};
    use super::{Run, figures_of_steps, limits};
    use crate::config::Config;
    use crate::session::Outcome;

    #[test]
    fn figures_beyond_the_limits_of_the_run_are_outside() {
        let mut run = run();
        run.folder.manifest.figures.insert("off_plane_rms_mm".to_owned(), 1.25.into());
        let figures = run.limited_figures();
        let outside: Vec<&str> =
            figures.iter().filter(|figure| figure.is_outside()).map(|f| f.key.as_str()).collect();
        assert_eq!(outside, ["off_plane_rms_mm", "sync_late_us_max"]);
    }

    #[test]
    fn a_run_that_was_not_closed_has_its_figures_from_its_steps() {
        let mut run = run();
        let kept = run.folder.figures().unwrap();
        run.folder.manifest.figures.clear();
        run.folder.figures_of_steps = figures_of_steps(&steps_csv());
        let found = run.folder.figures().unwrap();
        assert_eq!((found.insertion_mm, found.steps), (kept.insertion_mm, kept.steps));
        assert_eq!((found.off_plane_rms_mm, found.steps_saturated), (Some(0.5), None));
        assert_eq!(found.estimate_rms.unwrap().x_mm, 0.25);
    }

    #[test]
    fn figures_that_nothing_tells_are_unknown() {
        let mut run = run();
        run.folder.manifest.figures.clear();
        let mut figures = run.limited_figures();
        figures.retain(|figure| !figure.key.starts_with("sync"));
        assert!(figures.len() > 8 && figures.iter().all(|figure| figure.value.is_none()));
    }

    #[test]
    fn figures_of_a_stopped_run_are_labelled_as_stopped() {
        let mut run = run();
        run.folder.manifest.set_outcome(&Outcome::Stopped("tracker: no tip".to_owned()));
        let labels: Vec<String> = run.limited_figures().into_iter().map(|f| f.label).collect();
        let said = "off plane (estimated), RMS over the last third of 3.0 mm, stopped";
        assert!(labels.iter().any(|label| label == said), "{labels:?}");
    }

    #[test]
    fn an_operation_has_no_figures_of_a_plane_or_of_steps() {
        let mut run = run();
        run.folder.manifest.operation = Some("jog".to_owned());
        let keys: Vec<String> = run.limited_figures().into_iter().map(|f| f.key).collect();
        assert!(keys.iter().any(|key| key == "following_error_mm_max"), "{keys:?}");
        assert!(keys.iter().all(|key| !key.contains("plane") && key != "steps"), "{keys:?}");
    }

    /// The following errors are the travel of 30 ms of servo lag and two SYNCs of 10 ms, at 10 mm/s and 360°/s.
    #[test]
    fn limits_come_from_the_configuration_of_the_run() {
        let sets = ["insertion.depth_mm=120.0", "tracker.hold_after_s=0.25"].map(str::to_owned);
        let limits = limits(&Config::from_sources(&[], &sets).unwrap()).unwrap();
        assert_eq!(limits["depth_mm"], 120.0);
        let arrival_mm = 120.0 - limits["insertion_mm"];
        assert!(arrival_mm > 0.0 && arrival_mm < 0.1, "{arrival_mm}");
        assert_eq!((limits["tip_age_s_max"], limits["tip_lag_mm_max"]), (0.25, 1.0));
        assert!((limits["following_error_mm_max"] - 0.5).abs() < 1e-12);
        assert!((limits["following_error_deg_max"] - 18.0).abs() < 1e-12);
    }

    #[test]
    fn a_distance_from_the_plane_is_named_true_where_the_truth_is_recorded() {
        let is_true = |run: &Run| {
            let mut figures = run.limited_figures().into_iter();
            figures.any(|figure| figure.label.starts_with("off plane (true), "))
        };
        let mut closed = run();
        assert!(!is_true(&closed));
        closed.folder.manifest.bus = "memory".to_owned();
        closed.folder.manifest.tracker = "csv tip.csv".to_owned();
        assert!(!is_true(&closed), "the recording is of another needle");
        closed.folder.manifest.tracker = "emulated".to_owned();
        assert!(is_true(&closed));
        let mut open = run();
        open.folder.manifest.figures.clear();
        let mut steps = figures_of_steps(&steps_csv()).unwrap();
        steps.final_error = None;
        open.folder.figures_of_steps = Some(steps);
        assert!(is_true(&open), "the last step has no estimate");
    }
}
