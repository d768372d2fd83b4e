//! A campaign of many runs: a line for each, their totals, and the runs that are left out, with the reasons.

use super::compare::Keys;
use super::group::{Group, group};
use super::run::{Condition, Folder, utc};
use crate::archive::{VerdictKind, file};
use crate::config::nearest_key;
use crate::study::FigureReport;
use crate::text::{escaped, fixed, screen};
use minijinja::context;
use minijinja::value::Serde;
use serde::Serialize;
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};

/// Why a run does not count in the totals.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Exclusion {
    /// Its last verdict is "invalid".
    Invalid,
    /// The bench is still writing it.
    BeingWritten,
    /// Its record was never closed.
    NotClosed,
    /// Its files were changed after the record was closed.
    Edited,
    /// It is an operation of the stage, such as homing.
    Operation,
    /// It is a copy of another record of the campaign.
    Copy,
    /// It repeats another emulated run of the campaign, bit for bit.
    Repeat,
    /// It is not a run folder, or has the format of another version.
    Unreadable,
}

/// A folder of the campaign, with its line in the list.
#[derive(Debug, Clone, PartialEq)]
pub struct Line {
    /// The path of the folder.
    pub dir: String,
    /// The run; `None` if it cannot be read.
    pub run: Option<Box<Folder>>,
    /// Why it does not count, and the details; `None` if it counts.
    pub excluded: Option<(Exclusion, String)>,
}

impl Line {
    /// A run folder.
    pub fn run(folder: Folder) -> Self {
        let excluded = exclusion(&folder);
        Line { dir: folder.dir.clone(), run: Some(Box::new(folder)), excluded }
    }

    /// A folder that cannot be read as a run, and why.
    pub fn unreadable(dir: String, reason: String) -> Self {
        Line { dir, run: None, excluded: Some((Exclusion::Unreadable, reason)) }
    }
}

/// A campaign.
#[derive(Debug, Clone, PartialEq)]
pub struct Campaign {
    /// Every folder, in the order of the runs' start times.
    pub lines: Vec<Line>,
    /// The totals of the runs that count.
    pub groups: Vec<Group>,
}

impl Campaign {
    /// The campaign of these folders, with totals for each name, or for each value of the configuration
    /// key `by`.
    ///
    /// # Errors
    /// None of the runs that count has the key `by`.
    pub fn of(mut lines: Vec<Line>, by: Option<&str>) -> Result<Self, String> {
        lines.sort_by(|a, b| sort_key(a).cmp(&sort_key(b)));
        exclude_copies(&mut lines);
        exclude_repeats(&mut lines, by);
        let mut groups: BTreeMap<(String, bool), Vec<(&Folder, Keys)>> = BTreeMap::new();
        let mut known = BTreeSet::new();
        for line in lines.iter().filter(|line| line.excluded.is_none()) {
            let Some(folder) = &line.run else { continue };
            let keys = folder.keys().unwrap_or_default();
            let label = match by {
                None => folder.manifest.name.clone(),
                Some(key) => {
                    let value = keys.get(key).cloned().unwrap_or_else(|| "not set".to_owned());
                    format!("{key} = {value}")
                }
            };
            known.extend(keys.keys().cloned());
            let has_truth = folder.has_truth();
            groups.entry((label, has_truth)).or_default().push((folder, keys));
        }
        if let Some(key) = by.filter(|key| !known.is_empty() && !known.contains(*key)) {
            let inside = format!("{key}.");
            let hint = match known.iter().find(|known| known.starts_with(&inside)) {
                Some(known) => format!("{key} is a table: name one of its keys, such as {known}"),
                None => nearest_key(key, known.iter().map(String::as_str)),
            };
            return Err(format!("--by {key}: no configuration of these runs has that key; {hint}"));
        }
        let kinds = groups.keys().cloned().collect::<BTreeSet<_>>();
        let groups = groups.into_iter().map(|((label, has_truth), runs)| {
            let is_mixed = kinds.contains(&(label.clone(), !has_truth));
            let kind = match (is_mixed, has_truth) {
                (false, _) => "",
                (true, true) => ", the true tip known",
                (true, false) => ", the tip as estimated",
            };
            group(label + kind, &runs)
        });
        let groups = groups.collect();
        Ok(Campaign { lines, groups })
    }

    /// The number of runs that count.
    pub fn counted(&self) -> usize {
        self.lines.iter().filter(|line| line.excluded.is_none()).count()
    }

    /// The list, the totals, and the runs that are left out.
    ///
    /// # Errors
    /// A fault in the template `campaign.txt`.
    pub fn to_text(&self) -> Result<String, minijinja::Error> {
        let rows = self.lines.iter().filter_map(|line| Some(row(line.run.as_deref()?)));
        let more = context! {
            rows => rows.collect::<Vec<_>>(),
            // Not from the JSON, in which infinite medians are null.
            groups => minijinja::Value::from(Serde(&self.groups)),
            left_out => self.lines.len() - self.counted(),
        };
        screen(include_str!("campaign.txt"), &self.to_json(), more)
    }

    /// One JSON object, units in its keys.
    pub fn to_json(&self) -> Value {
        let mut excluded: BTreeMap<Exclusion, Vec<Value>> = BTreeMap::new();
        for Line { dir, excluded: why, .. } in &self.lines {
            if let Some((reason, detail)) = why {
                excluded.entry(*reason).or_default().push(json!({ "dir": dir, "why": detail }));
            }
        }
        let excluded =
            excluded.iter().map(|(reason, runs)| json!({ "reason": reason, "runs": runs }));
        json!({
            "runs": self.lines.iter().map(Line::to_json).collect::<Vec<_>>(),
            "counted": self.counted(),
            "groups": self.groups,
            "excluded": excluded.collect::<Vec<_>>(),
        })
    }
}

/// Sorts by the start of the run; folders that cannot be read come last.
fn sort_key(line: &Line) -> (bool, &str, &str) {
    let started = line.run.as_ref().map_or("", |run| run.manifest.started_utc.as_str());
    (line.run.is_none(), started, &line.dir)
}

/// Of records with the same frames at the same times (the same seal) only the first counts, or none
/// if one was judged invalid.
fn exclude_copies(lines: &mut [Line]) {
    let is_invalid = |line: &Line| matches!(line.excluded, Some((Exclusion::Invalid, _)));
    // A copy may be older than the verdict, so the runs judged invalid come first.
    let (first, rest): (Vec<&mut Line>, Vec<&mut Line>) =
        lines.iter_mut().partition(|line| is_invalid(line));
    exclude_equal(
        first.into_iter().chain(rest),
        |run| seal(run, file::CAN),
        |first| (Exclusion::Copy, format!("the record in {first}")),
    );
}

/// The seal of the file `name`; none of an empty one, since those of all runs are equal.
fn seal(run: &Folder, name: &str) -> Option<String> {
    let seal = run.manifest.files.get(name).filter(|seal| seal.bytes > 0)?;
    Some(seal.sha256.clone())
}

/// Emulated runs with the same steps, or without steps but with the same tip positions, are the same insertion,
/// whatever their names and folders. Counted as independent runs they would narrow the intervals. With a key
/// `by`, such an insertion counts once for each value of the key.
fn exclude_repeats(lines: &mut [Line], by: Option<&str>) {
    let counted = lines.iter_mut().filter(|line| line.excluded.is_none());
    let insertion = |run: &Folder| {
        let has_steps = run.manifest.counts.is_some_and(|counts| counts.steps > 0);
        let file = if has_steps { file::STEPS } else { file::TRACKER };
        let seal = seal(run, file).filter(|_| run.is_emulated())?;
        let value = by.and_then(|key| run.keys().ok()?.remove(key));
        Some((seal, value))
    };
    exclude_equal(counted, insertion, |first| {
        (Exclusion::Repeat, format!("as {first}: the same emulated insertion"))
    });
}

/// Excludes every line whose `key` equals that of an earlier line, with the `reason` that names the earlier one.
/// Lines that are excluded already are ignored, except for those with a verdict: these can be the earlier one.
fn exclude_equal<'a, K: Ord>(
    lines: impl Iterator<Item = &'a mut Line>,
    key: impl Fn(&Folder) -> Option<K>,
    reason: impl Fn(&str) -> (Exclusion, String),
) {
    let mut seen: BTreeMap<K, String> = BTreeMap::new();
    for line in lines.filter(|l| matches!(l.excluded, None | Some((Exclusion::Invalid, _)))) {
        let Some(key) = line.run.as_deref().and_then(&key) else { continue };
        match seen.get(&key) {
            Some(first) if line.excluded.is_none() => line.excluded = Some(reason(first)),
            Some(_) => {}
            None => drop(seen.insert(key, line.dir.clone())),
        }
    }
}

/// The first reason why `folder` does not count; `None` if it counts.
fn exclusion(folder: &Folder) -> Option<(Exclusion, String)> {
    let manifest = &folder.manifest;
    let caution = folder.caution().unwrap_or_default();
    match folder.condition {
        Condition::Whole => {}
        Condition::BeingWritten => return Some((Exclusion::BeingWritten, caution)),
        Condition::Open => return Some((Exclusion::NotClosed, caution)),
        Condition::Changed(_) => return Some((Exclusion::Edited, caution)),
    }
    if let Some(verdict) = manifest.verdict().filter(|v| v.verdict == VerdictKind::Invalid) {
        return Some((Exclusion::Invalid, escaped(&verdict.reason).into_owned()));
    }
    let operation = manifest.operation.as_ref()?;
    Some((Exclusion::Operation, format!("the stage's {operation}")))
}

fn row(folder: &Folder) -> [String; 8] {
    let manifest = &folder.manifest;
    let figures = folder.figures();
    let depth_mm = figures.as_ref().map(|figures| figures.insertion_mm);
    let figures = figures.unwrap_or_default();
    let outcome = match (folder.condition == Condition::BeingWritten, manifest.outcome) {
        (true, _) => "going on".to_owned(),
        (false, None) => "not closed".to_owned(),
        (false, Some(outcome)) => outcome.to_string(),
    };
    let incomplete = if folder.is_incomplete() { ", incomplete" } else { "" };
    let verdict = manifest.verdict().map(|verdict| verdict.verdict.to_string());
    [
        escaped(&folder.dir).into_owned(),
        fixed(depth_mm, 1),
        fixed(figures.off_plane_rms_mm, 3),
        fixed(figures.settling_mm, 0),
        fixed(figures.target_error(), 3),
        outcome + incomplete,
        verdict.unwrap_or_default(),
        utc(&manifest.started_utc),
    ]
}

impl Line {
    fn to_json(&self) -> Value {
        let excluded = self.excluded.as_ref().map(|(why, _)| why);
        let Some(run) = &self.run else { return json!({ "dir": self.dir, "excluded": excluded }) };
        let (manifest, figures) = (&run.manifest, run.figures());
        json!({
            "dir": self.dir,
            "name": manifest.name,
            "started_utc": manifest.started_utc,
            "outcome": manifest.outcome,
            "stop_reason": manifest.stop_reason,
            "verdict": manifest.verdict(),
            "condition": run.condition_name(),
            "insertion_mm": figures.as_ref().map(|figures| figures.insertion_mm),
            "off_plane_rms_mm": figures.as_ref().and_then(|figures| figures.off_plane_rms_mm),
            "settling_mm": figures.as_ref().and_then(|figures| figures.settling_mm),
            "target_error_mm": figures.as_ref().and_then(FigureReport::target_error),
            "plan_status": run.plan_status(),
            "excluded": excluded,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::group::Proportion;
    use super::super::run::tests::run;
    use super::*;
    use crate::archive::{Counts, FileSeal, Verdict};
    use crate::session::Outcome;

    fn folder(n: u32, change: impl FnOnce(&mut Folder)) -> Line {
        let mut folder = run().folder;
        folder.dir = format!("runs/{n}");
        folder.manifest.started_utc = format!("2023-11-14T22:13:{n:02}.000000Z");
        change(&mut folder);
        Line::run(folder)
    }

    fn entries() -> Vec<Line> {
        let unreadable = Line::unreadable("runs/x".to_owned(), "format 3".to_owned());
        let invalid = |folder: &mut Folder| {
            folder.manifest.verdicts.push(Verdict {
                verdict: VerdictKind::Invalid,
                reason: "wrong gain".to_owned(),
                given_utc: String::new(),
            });
        };
        let stopped = |folder: &mut Folder| {
            folder.manifest.set_outcome(&Outcome::Stopped("tracker lost".to_owned()));
        };
        let other = |folder: &mut Folder| {
            let toml = folder.config_toml.as_mut().unwrap();
            *toml = toml.replace("radius_mm = 122.0", "radius_mm = 121.0");
            folder.manifest.config_sha256 = "other".to_owned();
        };
        let mut entries = vec![unreadable, folder(3, invalid), folder(2, stopped)];
        entries.push(folder(1, other));
        entries.push(folder(4, |folder| folder.condition = Condition::Open));
        entries.push(folder(5, |folder| folder.manifest.operation = Some("jog".to_owned())));
        entries.extend((6..12).map(|n| folder(n, |_| ())));
        entries
    }

    #[test]
    fn excluded_runs_are_listed_by_reason() {
        let campaign = Campaign::of(entries(), None).unwrap();
        assert_eq!((campaign.lines.len(), campaign.counted()), (12, 8));
        assert_eq!(campaign.lines[0].dir, "runs/1");
        let [group] = campaign.groups.as_slice() else { panic!("{:?}", campaign.groups) };
        assert_eq!(group.completed, Proportion::new(7, 8));
        assert_eq!(group.configurations, 2);
        assert_eq!(group.varied, ["emulator.radius_mm", "needle.radius_mm"]);
        let off_plane = group.off_plane_rms_mm.unwrap();
        assert_eq!((off_plane.value, off_plane.interval), (0.5, Some([0.5, f64::INFINITY])));
        insta::assert_snapshot!(campaign.to_text().unwrap());
    }

    #[test]
    fn a_seeded_run_counts_once_however_often_it_was_run() {
        let seeded = |n, steps: &'static [u8], bus: &'static str| {
            folder(n, |folder| {
                // A run with another name or folder is not another run.
                folder.manifest.name = format!("trial-{}", n % 2);
                folder.manifest.config_sha256 = format!("other {n}");
                let toml = folder.config_toml.as_mut().unwrap();
                *toml = toml.replace("dir = \"runs\"", &format!("dir = \"runs-{n}\""));
                folder.manifest.bus = bus.to_owned();
                folder.manifest.counts = Some(Counts { steps: 4, ..Counts::default() });
                folder.manifest.files.insert(file::STEPS.to_owned(), FileSeal::of(steps));
            })
        };
        let mut entries: Vec<Line> = (0..6).map(|n| seeded(n, b"seed 1", "memory")).collect();
        entries.push(seeded(6, b"seed 2", "memory"));
        // The steps of a real stage never repeat exactly, so the rule does not apply to them.
        entries.extend((7..9).map(|n| seeded(n, b"seed 1", "can0")));
        let by_folder = Campaign::of(entries.clone(), Some("record.dir")).unwrap();
        assert_eq!(by_folder.counted(), 9, "each value of the grouping key counts");
        let campaign = Campaign::of(entries, None).unwrap();
        assert_eq!(campaign.counted(), 4);
        let (exclusion, why) = campaign.lines[5].excluded.clone().unwrap();
        assert_eq!(
            (exclusion, why.as_str()),
            (Exclusion::Repeat, "as runs/0: the same emulated insertion")
        );
        assert!(
            campaign.to_text().unwrap().contains("the same run again: 5"),
            "{}",
            campaign.to_text().unwrap()
        );
    }

    /// Of three runs to a target, one missed it and one was stopped; the fourth run has no target.
    #[test]
    fn runs_to_a_target_are_judged_by_their_target() {
        let to_target = |n, error_mm: f64| {
            folder(n, |folder| {
                let toml = folder.config_toml.as_mut().unwrap();
                let goal = "kind = \"target\"\nposition_mm = [0.0, 10.0, 100.0]\ntool_range_mm";
                *toml = toml.replace("kind = \"plane\"", "").replace("tool_range_mm", goal);
                folder.manifest.figures.insert("target_error_mm".to_owned(), error_mm.into());
                folder.manifest.figures.insert("target_error_est_mm".to_owned(), error_mm.into());
            })
        };
        let mut stopped = to_target(3, 0.5);
        let manifest = &mut stopped.run.as_mut().unwrap().manifest;
        manifest.set_outcome(&Outcome::Stopped("no path to the target is left".to_owned()));
        let entries = vec![to_target(1, 0.25), to_target(2, 1.5), stopped, folder(4, |_| ())];
        let campaign = Campaign::of(entries, None).unwrap();
        let [group] = campaign.groups.as_slice() else { panic!("{:?}", campaign.groups) };
        assert_eq!(group.completed, Proportion::new(3, 4));
        assert_eq!((group.reached, group.settled), (Proportion::new(1, 3), Proportion::new(1, 1)));
        assert_eq!(group.target_error_mm.unwrap().value, 1.5);
        let json = campaign.to_json();
        let statuses = [0, 1, 2, 3].map(|n| json["runs"][n]["plan_status"].clone());
        assert_eq!(json!(statuses), json!(["arrived", "missed", "lost", null]));
        let text = campaign.to_text().unwrap();
        assert!(text.contains("reached     1 of 3, 33 % "), "{text}");
    }

    /// Without tip positions, nothing shows that two runs without a step are the same.
    #[test]
    fn runs_without_a_step_are_told_apart_by_their_tip_positions() {
        let waiting = |n, positions: &'static [u8]| {
            folder(n, |folder| {
                folder.manifest.bus = "memory".to_owned();
                folder.manifest.files.insert(file::STEPS.to_owned(), FileSeal::of(b"header"));
                folder.manifest.files.insert(file::TRACKER.to_owned(), FileSeal::of(positions));
            })
        };
        let entries = vec![waiting(0, b"seed 1"), waiting(1, b"seed 2"), waiting(2, b"seed 1")];
        assert_eq!(Campaign::of(entries, None).unwrap().counted(), 2);
        let entries = vec![waiting(0, b""), waiting(1, b"")];
        assert_eq!(Campaign::of(entries, None).unwrap().counted(), 2);
    }

    #[test]
    fn runs_can_be_grouped_by_the_values_of_a_key() {
        let campaign = Campaign::of(entries(), Some("needle.radius_mm")).unwrap();
        let labels: Vec<&str> = campaign.groups.iter().map(|group| group.label.as_str()).collect();
        assert_eq!(labels, ["needle.radius_mm = 121.0", "needle.radius_mm = 122.0"]);
        let said = Campaign::of(entries(), Some("needle.radius")).unwrap_err().to_string();
        assert!(said.ends_with("did you mean \"needle.radius_mm\"?"), "{said}");
    }

    #[test]
    fn json_has_runs_exclusions_and_groups() {
        let json = Campaign::of(entries(), None).unwrap().to_json();
        assert_eq!(
            (json["counted"].as_u64(), json["runs"].as_array().unwrap().len()),
            (Some(8), 12)
        );
        assert_eq!(json["excluded"][0]["reason"], "invalid");
        assert_eq!(json["groups"][0]["off_plane_rms_mm"]["order_statistics_95"][1], Value::Null);
        assert_eq!(json["groups"][0]["settled"]["count"], 7);
    }
}
