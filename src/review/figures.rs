//! The figures of a run, with their limits.

use super::limits::Limits;
use super::run::{Folder, Run};
use super::text::optional;
use crate::archive::{RunOutcome, StepsTable};
use crate::study::{FigureReport, RunFigures, TipError};
use serde_json::{Map, Value};

/// The limit of a figure, in the figure's unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Bound {
    /// An upper limit.
    AtMost(f64),
    /// A lower limit.
    AtLeast(f64),
}

impl Bound {
    /// Whether `value` is within the limit.
    pub fn holds(&self, value: f64) -> bool {
        match *self {
            Bound::AtMost(most) => value <= most,
            Bound::AtLeast(least) => value >= least,
        }
    }

    /// The limit itself.
    pub(super) fn limit(&self) -> f64 {
        match *self {
            Bound::AtMost(limit) | Bound::AtLeast(limit) => limit,
        }
    }
}

/// One figure of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Figure {
    /// Its key in JSON, unit included.
    pub key: String,
    /// Its name in words.
    pub label: String,
    /// Its unit; empty for counts.
    pub unit: &'static str,
    /// Digits shown after the point.
    pub decimals: usize,
    /// `None` if it is not known.
    pub value: Option<f64>,
    /// Its limit, if it has one.
    pub bound: Option<Bound>,
}

impl Figure {
    fn new(
        key: &str,
        label: &str,
        unit: &'static str,
        decimals: usize,
        value: Option<f64>,
    ) -> Self {
        let (key, label) = (key.to_owned(), label.to_owned());
        Figure { key, label, unit, decimals, value, bound: None }
    }

    fn bounded(self, bound: Option<Bound>) -> Self {
        Figure { bound, ..self }
    }

    /// True if the figure is known and outside its limit.
    pub fn is_outside(&self) -> bool {
        self.value.zip(self.bound).is_some_and(|(value, bound)| !bound.holds(value))
    }

    /// The value, or a dash.
    pub(super) fn value_text(&self) -> String {
        optional(self.value, self.decimals)
    }

    /// The limit with its sign; empty without one.
    pub(super) fn limit_text(&self) -> String {
        let decimals = self.decimals;
        match self.bound {
            Some(Bound::AtMost(most)) => format!("≤ {most:.decimals$}"),
            Some(Bound::AtLeast(least)) => format!("≥ {least:.decimals$}"),
            None => String::new(),
        }
    }
}

/// The figures of a run with their limits. An operation of the stage without a needle has fewer.
pub fn figures(folder: &Folder, report: &FigureReport, limits: Option<&Limits>) -> Vec<Figure> {
    let most = |limit: fn(&Limits) -> f64| limits.map(limit).map(Bound::AtMost);
    let is_insertion = folder.manifest.operation.is_none();
    let depth = limits.filter(|_| is_insertion);
    let depth = depth.map(|limits| Bound::AtLeast(limits.depth_mm - limits.arrival_mm));
    let known = if report.final_error.is_some() { "true" } else { "estimated" };
    let off_plane = format!("off plane ({known}), RMS over {}", last_third(folder, report));
    let saturated = report.steps_saturated.map(|count| count as f64);
    let (age, newest) =
        ("tip position at a step, oldest", "newest tip position at any time, oldest");
    let (lag, blind) = ("inserted since it, most", "inserted since that, most");
    let (behind, turned) = ("insertion from its target, most", "rotation from its target, most");
    let mut all = vec![
        Figure::new("insertion_mm", "depth", "mm", 2, Some(report.insertion_mm)).bounded(depth),
        Figure::new("off_plane_rms_mm", &off_plane, "mm", 3, report.off_plane_rms_mm)
            .bounded(most(|limits| limits.off_plane_mm)),
        Figure::new("settling_mm", "within 1 mm of the plane from", "mm", 1, report.settling_mm),
        Figure::new("steps", "steps", "", 0, Some(report.steps as f64)),
        Figure::new("steps_saturated", "steps in which the law saturated", "", 0, saturated),
        Figure::new("tip_age_s_max", age, "s", 3, report.tip_age_s_max)
            .bounded(most(|limits| limits.tip_age_s)),
        Figure::new("tip_lag_mm_max", lag, "mm", 3, report.tip_lag_mm_max)
            .bounded(most(|limits| limits.tip_lag_mm)),
        Figure::new("blind_s_max", newest, "s", 3, report.blind_s_max)
            .bounded(most(|limits| limits.tip_age_s)),
        Figure::new("blind_mm_max", blind, "mm", 3, report.blind_mm_max)
            .bounded(most(|limits| limits.tip_lag_mm)),
        Figure::new("following_error_mm_max", behind, "mm", 3, report.following_error_mm_max)
            .bounded(most(|limits| limits.following_error_mm)),
        Figure::new("following_error_deg_max", turned, "deg", 2, report.following_error_deg_max)
            .bounded(most(|limits| limits.following_error_deg)),
    ];
    if !is_insertion {
        all.retain(|figure| figure.key == "insertion_mm" || figure.key.starts_with("following"));
    }
    all.extend(timing(&folder.manifest.timing));
    all
}

/// Names the depth that the figures of the last third cover. In a run that was stopped this is the
/// last third of the depth reached.
pub(super) fn last_third(folder: &Folder, report: &FigureReport) -> String {
    match folder.manifest.outcome {
        Some(RunOutcome::Completed) => "the last third".to_owned(),
        Some(RunOutcome::Stopped) => {
            format!("the last third of {:.1} mm, stopped", report.insertion_mm)
        }
        None => format!("the last third of {:.1} mm, not closed", report.insertion_mm),
    }
}

/// How late SYNCs left the bench; a run in virtual time has no such figures.
fn timing(timing: &Map<String, Value>) -> impl Iterator<Item = Figure> {
    let number = |key: &str| timing.get(key).and_then(Value::as_f64);
    let bound = number("sync_late_limit_us").map(Bound::AtMost);
    let late = [
        ("sync_late_us_p50", "SYNC late, median"),
        ("sync_late_us_p99", "SYNC late, 99 %"),
        ("sync_late_us_max", "SYNC late, most"),
    ];
    let figure = move |(key, label)| Figure::new(key, label, "µs", 0, number(key)).bounded(bound);
    late.into_iter().map(figure).filter(|figure| figure.value.is_some())
}

/// The estimate's errors, a figure for each coordinate.
pub(super) fn errors(folder: &Folder, report: &FigureReport) -> Vec<Figure> {
    let rms = format!("estimate's error, RMS over {},", last_third(folder, report));
    let sets = [
        ("estimate_rms", rms.as_str(), report.estimate_rms),
        ("final_error", "estimate's error at the end,", report.final_error),
    ];
    let of = |(set, label, error): (&str, &str, Option<TipError>)| {
        let coordinates = error.map(|error| error.coordinates());
        let figure = |(i, name): (usize, &&'static str)| {
            let (coordinate, unit) = name.split_once('_').unwrap_or((name, ""));
            let decimals = if unit == "mm" { 3 } else { 2 };
            let value = coordinates.map(|values| values[i]);
            let (key, label) = (format!("{set}.{name}"), format!("{label} {coordinate}"));
            Figure::new(&key, &label, unit, decimals, value)
        };
        TipError::COORDINATES.iter().enumerate().map(figure).collect::<Vec<_>>()
    };
    sets.into_iter().flat_map(of).collect()
}

/// The figures that `steps.csv` alone gives; `None` if the text is not such a file.
pub fn figures_of_steps(steps_csv: &str) -> Option<FigureReport> {
    StepsTable::parse(steps_csv).ok().map(|steps| report_of(&steps))
}

/// The figures that `steps.csv` alone gives: those of a run that was not closed.
pub(super) fn report_of(steps: &StepsTable) -> FigureReport {
    let six = |provenance: &str| {
        TipError::COORDINATES.map(|name| {
            let (coordinate, unit) = name.split_once('_').unwrap_or((name, ""));
            let unit = if unit == "mm" { "mm" } else { "rad" };
            steps.column(&format!("{coordinate}_{provenance}_{unit}"))
        })
    };
    let at = |columns: &[Vec<Option<f64>>; 6], row: usize| -> Option<[f64; 6]> {
        let mut values = [0.0; 6];
        for (value, column) in values.iter_mut().zip(columns) {
            *value = column.get(row).copied().flatten()?;
        }
        Some(values)
    };
    let (est, truth, depths) = (six("est"), six("true"), steps.column("insertion_mm"));
    let mut figures = RunFigures::default();
    for (row, depth) in depths.into_iter().enumerate() {
        let Some(depth_mm) = depth else { continue };
        let (est, truth) = (at(&est, row), at(&truth, row));
        let error = est.zip(truth).map(|(est, truth)| TipError::between(est, truth));
        figures.take_scored(depth_mm, truth.or(est).map(|coordinates| coordinates[0]), error);
    }
    FigureReport { steps_saturated: None, ..figures.report() }
}

impl Run {
    /// The run's figures, with limits if its configuration can be read.
    pub(super) fn limited_figures(&self) -> Vec<Figure> {
        let limits = self.folder.limits().ok();
        figures(&self.folder, &self.figures(), limits.as_ref())
    }
}

#[cfg(test)]
mod tests {
    use super::super::run::tests::run;
    use crate::session::Outcome;

    #[test]
    fn a_figure_is_held_against_the_limit_that_the_run_was_under() {
        let mut run = run();
        run.folder.manifest.figures.insert("off_plane_rms_mm".to_owned(), 1.25.into());
        let figures = run.limited_figures();
        let outside: Vec<&str> =
            figures.iter().filter(|figure| figure.is_outside()).map(|f| f.key.as_str()).collect();
        assert_eq!(outside, ["off_plane_rms_mm", "sync_late_us_max"]);
    }

    #[test]
    fn steps_alone_tell_the_figures_of_a_run_that_was_not_closed() {
        let mut run = run();
        let kept = run.figures();
        run.folder.manifest.figures.clear();
        let told = run.figures();
        assert_eq!((told.insertion_mm, told.steps), (kept.insertion_mm, kept.steps));
        assert_eq!((told.off_plane_rms_mm, told.steps_saturated), (Some(0.5), None));
        assert_eq!(told.estimate_rms.unwrap().x_mm, 0.25);
    }

    #[test]
    fn figures_of_a_stopped_run_say_so() {
        let mut run = run();
        run.folder.manifest.set_outcome(&Outcome::Stopped("tracker: no tip".to_owned()));
        let labels: Vec<String> = run.limited_figures().into_iter().map(|f| f.label).collect();
        let said = "off plane (estimated), RMS over the last third of 3.0 mm, stopped";
        assert!(labels.iter().any(|label| label == said), "{labels:?}");
    }

    #[test]
    fn the_stage_without_a_needle_has_no_plane() {
        let mut run = run();
        run.folder.manifest.operation = Some("jog".to_owned());
        let keys: Vec<String> = run.limited_figures().into_iter().map(|f| f.key).collect();
        assert!(keys.iter().all(|key| !key.contains("plane") && key != "steps"), "{keys:?}");
    }
}
