//! The figures of a run, with the limits that they are held against.

use super::limits::Limits;
use super::run::{Folder, Run};
use crate::archive::{RunOutcome, StepsTable};
use crate::study::{FigureReport, RunFigures, TipError};
use serde_json::{Map, Value};

/// What a figure is held against, in its unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Bound {
    /// It may not be more.
    AtMost(f64),
    /// It may not be less.
    AtLeast(f64),
}

impl Bound {
    /// Whether `value` keeps it.
    pub fn holds(&self, value: f64) -> bool {
        match *self {
            Bound::AtMost(most) => value <= most,
            Bound::AtLeast(least) => value >= least,
        }
    }

    /// With its sign, the limit itself.
    pub(super) fn signed(&self) -> (&'static str, f64) {
        match *self {
            Bound::AtMost(most) => ("≤", most),
            Bound::AtLeast(least) => ("≥", least),
        }
    }
}

/// One figure of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Figure {
    /// Its key in JSON, unit included.
    pub key: String,
    /// What it is, in words.
    pub label: String,
    /// Its unit; empty for counts.
    pub unit: &'static str,
    /// Digits after the point that mean something.
    pub decimals: usize,
    /// None where it is not known.
    pub value: Option<f64>,
    /// What it is held against, if anything.
    pub bound: Option<Bound>,
}

impl Figure {
    /// True where the figure is known not to keep its limit.
    pub fn is_outside(&self) -> bool {
        self.value.zip(self.bound).is_some_and(|(value, bound)| !bound.holds(value))
    }
}

/// The figures of `run`, those that have limits with them. Of what the stage did without a needle
/// there are fewer.
pub fn figures(folder: &Folder, report: &FigureReport, limits: Option<&Limits>) -> Vec<Figure> {
    let figure = |key: &str, label: &str, unit, decimals, value| Figure {
        key: key.to_owned(),
        label: label.to_owned(),
        unit,
        decimals,
        value,
        bound: None,
    };
    let most = |limit: fn(&Limits) -> f64| limits.map(limit).map(Bound::AtMost);
    let is_insertion = folder.manifest.operation.is_none();
    let depth = limits.map(|limits| Bound::AtLeast(limits.depth_mm - limits.arrival_mm));
    let known = if report.final_error.is_some() { "true" } else { "estimated" };
    let third = last_third(folder, report);
    let off_plane = format!("off plane ({known}), RMS over {third}");
    let counted = |count: usize| Some(count as f64);
    let mut all = vec![
        Figure {
            bound: depth.filter(|_| is_insertion),
            ..figure("insertion_mm", "depth", "mm", 2, Some(report.insertion_mm))
        },
        Figure {
            bound: most(|l| l.off_plane_mm),
            ..figure("off_plane_rms_mm", &off_plane, "mm", 3, report.off_plane_rms_mm)
        },
        figure("settling_mm", "within 1 mm of the plane from", "mm", 1, report.settling_mm),
        figure("steps", "steps", "", 0, counted(report.steps)),
        figure(
            "steps_saturated",
            "steps in which the law saturated",
            "",
            0,
            report.steps_saturated.and_then(counted),
        ),
        Figure {
            bound: most(|l| l.tip_age_s),
            ..figure(
                "tip_age_s_max",
                "tip position at a step, oldest",
                "s",
                3,
                report.tip_age_s_max,
            )
        },
        Figure {
            bound: most(|l| l.tip_lag_mm),
            ..figure("tip_lag_mm_max", "inserted since it, most", "mm", 3, report.tip_lag_mm_max)
        },
        Figure {
            bound: most(|l| l.tip_age_s),
            ..figure(
                "blind_s_max",
                "newest tip position at any time, oldest",
                "s",
                3,
                report.blind_s_max,
            )
        },
        Figure {
            bound: most(|l| l.tip_lag_mm),
            ..figure("blind_mm_max", "inserted since that, most", "mm", 3, report.blind_mm_max)
        },
        Figure {
            bound: most(|l| l.following_error_mm),
            ..figure(
                "following_error_mm_max",
                "insertion from its target, most",
                "mm",
                3,
                report.following_error_mm_max,
            )
        },
        Figure {
            bound: most(|l| l.following_error_deg),
            ..figure(
                "following_error_deg_max",
                "rotation from its target, most",
                "deg",
                2,
                report.following_error_deg_max,
            )
        },
    ];
    if !is_insertion {
        all.retain(|figure| figure.key == "insertion_mm" || figure.key.starts_with("following"));
    }
    all.extend(timing(&folder.manifest.timing));
    all
}

/// What the figures of the last third are of. Of a run that was stopped it is the third of what was
/// inserted until then.
pub(super) fn last_third(folder: &Folder, report: &FigureReport) -> String {
    match folder.manifest.outcome {
        Some(RunOutcome::Completed) => "the last third".to_owned(),
        Some(RunOutcome::Stopped) => {
            format!("the last third of {:.1} mm, stopped", report.insertion_mm)
        }
        None => format!("the last third of {:.1} mm, not closed", report.insertion_mm),
    }
}

/// How late SYNCs left; nothing of a run in virtual time.
fn timing(timing: &Map<String, Value>) -> Vec<Figure> {
    let number = |key: &str| timing.get(key).and_then(Value::as_f64);
    let bound = number("sync_late_limit_us").map(Bound::AtMost);
    let late = [
        ("sync_late_us_p50", "SYNC late, median"),
        ("sync_late_us_p99", "SYNC late, 99 %"),
        ("sync_late_us_max", "SYNC late, most"),
    ];
    let figure = |(key, label): (&str, &str)| Figure {
        key: key.to_owned(),
        label: label.to_owned(),
        unit: "µs",
        decimals: 0,
        value: number(key),
        bound,
    };
    late.into_iter().map(figure).filter(|figure| figure.value.is_some()).collect()
}

/// The estimate's errors of `report`, each coordinate a figure.
pub(super) fn errors(folder: &Folder, report: &FigureReport) -> Vec<Figure> {
    const NAMES: [(&str, &str, usize); 6] = [
        ("x", "mm", 3),
        ("y", "mm", 3),
        ("z", "mm", 3),
        ("yaw", "deg", 2),
        ("pitch", "deg", 2),
        ("roll", "deg", 2),
    ];
    let of = |set: &str, label: &str, error: Option<TipError>| {
        let coordinates = error.map(|error| error.coordinates());
        let figure = |(i, (name, unit, decimals)): (usize, &(&str, &'static str, usize))| Figure {
            key: format!("{set}.{name}_{unit}"),
            label: format!("{label} {name}"),
            unit,
            decimals: *decimals,
            value: coordinates.map(|coordinates| coordinates[i]),
            bound: None,
        };
        NAMES.iter().enumerate().map(figure).collect::<Vec<_>>()
    };
    let rms = format!("estimate's error, RMS over {},", last_third(folder, report));
    let mut all = of("estimate_rms", &rms, report.estimate_rms);
    all.extend(of("final_error", "estimate's error at the end,", report.final_error));
    all
}

/// The figures that `steps_csv` alone tells; none of what is no such file.
pub fn figures_of_steps(steps_csv: &str) -> Option<FigureReport> {
    StepsTable::parse(steps_csv).ok().map(|steps| report_of(&steps))
}

/// The figures that `steps.csv` alone tells: of a run that was not closed.
pub(super) fn report_of(steps: &StepsTable) -> FigureReport {
    let six = |provenance: &str| {
        ["x_mm", "y_mm", "z_mm", "yaw_rad", "pitch_rad", "roll_rad"].map(|name| {
            let (coordinate, unit) = name.split_once('_').unwrap_or((name, ""));
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
    /// The run's figures, with its limits where its configuration is read.
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
