//! What runs of one kind come to.

use super::configuration::Keys;
use super::interval::{Median, Proportion};
use super::run::Folder;
use super::text::{count, number};
use crate::archive::RunOutcome;
use crate::study::{FigureReport, OFF_PLANE_LIMIT_MM};
use serde_json::{Value, json};
use std::collections::BTreeSet;

/// Runs of one name, or of one value of a key, and what they come to.
#[derive(Debug, Clone, PartialEq)]
pub struct Group {
    /// The name or the value.
    pub label: String,
    /// How many different configurations there are among them.
    pub configurations: usize,
    /// The keys that these differ in.
    pub varied: Vec<String>,
    /// Those that reached their depth.
    pub completed: Proportion,
    /// Those that did, and within 1 mm RMS of the plane over the last third.
    pub settled: Proportion,
    /// Distance from the plane over the last third, RMS, mm; infinite for a run that was stopped.
    pub off_plane_rms_mm: Option<Median>,
    /// Depth after which the tip stays within 1 mm of the plane, mm; infinite where it does not.
    pub settling_mm: Option<Median>,
}

/// What the runs of one group come to. A run that was stopped is as far out as can be.
pub(super) fn group(label: String, runs: &[(&Folder, Keys)]) -> Group {
    let figures: Vec<Option<FigureReport>> = runs
        .iter()
        .map(|(run, _)| {
            let is_completed = run.manifest.outcome == Some(RunOutcome::Completed);
            is_completed.then(|| run.figures().unwrap_or_default())
        })
        .collect();
    let completed = figures.iter().flatten().count();
    let pick = |of: fn(&FigureReport) -> Option<f64>| -> Vec<f64> {
        figures.iter().map(|f| f.as_ref().and_then(of).unwrap_or(f64::INFINITY)).collect()
    };
    let off_plane = pick(|figures| figures.off_plane_rms_mm);
    let settled = off_plane.iter().filter(|rms_mm| **rms_mm < OFF_PLANE_LIMIT_MM).count();
    let hashes: BTreeSet<&str> =
        runs.iter().map(|(run, _)| run.manifest.config_sha256.as_str()).collect();
    Group {
        label,
        configurations: hashes.len(),
        varied: varied(runs),
        completed: Proportion { count: completed, of: runs.len() },
        settled: Proportion { count: settled, of: runs.len() },
        off_plane_rms_mm: Median::of(&off_plane),
        settling_mm: Median::of(&pick(|figures| figures.settling_mm)),
    }
}

/// The keys that do not have one value in all of `runs`.
fn varied(runs: &[(&Folder, Keys)]) -> Vec<String> {
    let all: BTreeSet<&String> = runs.iter().flat_map(|(_, keys)| keys.keys()).collect();
    let differs = |key: &&String| {
        let values: BTreeSet<Option<&String>> =
            runs.iter().map(|(_, keys)| keys.get(*key)).collect();
        values.len() > 1
    };
    all.into_iter().filter(differs).cloned().collect()
}

impl Group {
    /// Varied keys that a line of text has room for.
    const VARIED_MAX: usize = 6;

    pub(super) fn to_lines(&self) -> Vec<String> {
        let runs = count(self.completed.of, "run");
        let mut first = format!("{}: {runs}", self.label);
        if self.configurations > 1 {
            let shown: Vec<&str> =
                self.varied.iter().take(Self::VARIED_MAX).map(String::as_str).collect();
            let more = self.varied.len().saturating_sub(shown.len());
            let more = if more > 0 { format!(" and {more} more") } else { String::new() };
            first += &format!(
                " of {} configurations, which differ in {}{more}",
                self.configurations,
                shown.join(", ")
            );
        }
        let share = |proportion: &Proportion| {
            let percent = |share: f64| format!("{:.0}", share * 100.0);
            let interval = proportion.interval().map(|[low, high]| {
                format!(" ({} to {} %, Wilson 95 %)", percent(low), percent(high))
            });
            let share = proportion.share().map(percent).unwrap_or_default();
            let interval = interval.unwrap_or_default();
            format!("{} of {}, {share} %{interval}", proportion.count, proportion.of)
        };
        let median = |median: &Median, decimals: usize| {
            let interval = match median.interval {
                Some([low, high]) => format!(
                    "({} to {}, order statistics, 95 % or more)",
                    number(low, decimals),
                    number(high, decimals)
                ),
                None => "(an interval of 95 % takes six runs)".to_owned(),
            };
            let unit = if median.value.is_finite() { " mm" } else { "" };
            format!("median {}{unit} {interval}", number(median.value, decimals))
        };
        let mut lines = vec![
            first,
            format!("  completed   {}", share(&self.completed)),
            format!("  settled     {}: completed, under 1 mm RMS", share(&self.settled)),
        ];
        lines.extend(self.off_plane_rms_mm.map(|m| format!("  off plane   {}", median(&m, 3))));
        lines.extend(self.settling_mm.map(|m| format!("  settled at  {}", median(&m, 1))));
        lines
    }

    pub(super) fn to_json(&self) -> Value {
        let finite = |value: f64| value.is_finite().then_some(value);
        let share = |proportion: &Proportion| {
            json!({
                "count": proportion.count,
                "of": proportion.of,
                "fraction": proportion.share(),
                "wilson_95": proportion.interval(),
            })
        };
        let median = |median: Option<Median>| {
            median.map(|median| {
                json!({
                    "median": finite(median.value),
                    "order_statistics_95": median.interval.map(|interval| interval.map(finite)),
                })
            })
        };
        json!({
            "group": self.label,
            "configurations": self.configurations,
            "varied": self.varied,
            "completed": share(&self.completed),
            "settled": share(&self.settled),
            "off_plane_rms_mm": median(self.off_plane_rms_mm),
            "settling_mm": median(self.settling_mm),
        })
    }
}
