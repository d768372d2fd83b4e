//! The totals of runs of one kind.

use super::configuration::Keys;
use super::interval::{MedianInterval, Proportion};
use super::run::Folder;
use crate::archive::RunOutcome;
use crate::study::{FigureReport, OFF_PLANE_LIMIT_MM};
use serde::Serialize;
use std::collections::BTreeSet;

/// Runs of one name, or of one value of a key, and their totals.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Group {
    /// The name or the value.
    #[serde(rename = "group")]
    pub label: String,
    /// Number of different configurations.
    pub configurations: usize,
    /// The keys in which the configurations differ.
    pub varied: Vec<String>,
    /// The runs that reached their depth.
    pub completed: Proportion,
    /// The runs that reached it within 1 mm RMS of the plane over the last third.
    pub settled: Proportion,
    /// Distance from the plane over the last third, RMS, mm; infinite for a run that was stopped.
    pub off_plane_rms_mm: Option<MedianInterval>,
    /// Depth after which the tip stays within 1 mm of the plane, mm; infinite where it does not.
    pub settling_mm: Option<MedianInterval>,
}

/// The totals of one group. A run that was stopped counts as infinitely far off the plane.
pub(super) fn group(label: String, runs: &[(&Folder, Keys)]) -> Group {
    let figures = runs.iter().map(|(run, _)| {
        let is_completed = run.manifest.outcome == Some(RunOutcome::Completed);
        is_completed.then(|| run.figures().unwrap_or_default())
    });
    let figures: Vec<Option<FigureReport>> = figures.collect();
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
        completed: Proportion::new(completed, runs.len()),
        settled: Proportion::new(settled, runs.len()),
        off_plane_rms_mm: MedianInterval::of(&off_plane),
        settling_mm: MedianInterval::of(&pick(|figures| figures.settling_mm)),
    }
}

/// The keys that differ between `runs`.
fn varied(runs: &[(&Folder, Keys)]) -> Vec<String> {
    let all: BTreeSet<&String> = runs.iter().flat_map(|(_, keys)| keys.keys()).collect();
    let differs = |key: &&String| {
        let values: BTreeSet<Option<&String>> =
            runs.iter().map(|(_, keys)| keys.get(*key)).collect();
        values.len() > 1
    };
    all.into_iter().filter(differs).cloned().collect()
}
