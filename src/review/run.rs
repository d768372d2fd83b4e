//! A run as recorded in its folder.

use super::compare::{Keys, keys};
use super::figures::{Limits, limits};
use super::motion::{Course, Motion};
use crate::archive::{EventKind, EventLine, Manifest, RunOutcome, StepsTable, TrackerTimes};
use crate::config::{CanInterface, Config, GoalKind, Source, TrackerSource};
use crate::session::{Lane, Severity, State};
use crate::study::{FigureReport, PlanStatus};
use crate::text::{escaped, shell_word};
use serde::Serialize;
use std::borrow::Cow;
use std::fmt::Display;

/// The condition of a run folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Condition {
    /// Closed and unchanged since.
    Whole,
    /// The bench is still writing it.
    BeingWritten,
    /// Not closed: the bench ended before it closed the record.
    Open,
    /// Changed after it was closed; the text names the files.
    Changed(String),
}

/// The part of a run folder that every review needs.
#[derive(Debug, Clone, PartialEq)]
pub struct Folder {
    /// Its path, as named by the user.
    pub dir: String,
    /// Its manifest.
    pub manifest: Manifest,
    /// Its condition.
    pub condition: Condition,
    /// The figures computed from its steps, if its manifest has none: the record was not closed, or closed by a
    /// repair.
    pub figures_of_steps: Option<FigureReport>,
    /// Its `config.toml`; `None` if the file is missing.
    pub config_toml: Option<String>,
}

/// A change of the run's state.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct StateChange {
    /// Time since the start of the run, s.
    pub(super) time_s: f64,
    /// Depth at that time, mm; `None` before the insertion.
    pub(super) insertion_mm: Option<f64>,
    /// The state.
    pub(super) state: String,
}

/// A run with all of its text files.
#[derive(Debug, Clone, PartialEq)]
pub struct Run {
    /// Its folder.
    pub folder: Folder,
    /// `steps.csv`.
    pub steps: StepsTable,
    /// The times of the needle's tip in `tracker.ndjson`.
    pub samples: Vec<TrackerTimes>,
    /// The motion of the axes.
    pub motion: Motion,
    /// `events.log`.
    pub events: Vec<EventLine<'static>>,
    /// Files that could not be read, or whose rows are not those written, with the reasons.
    pub unreadable: Vec<String>,
}

impl Run {
    /// The depth, mm, at a time in s, from the measured positions of the insertion axis, or without them from the
    /// steps; `None` before the first step.
    pub(super) fn depth_over_time(&self) -> impl Fn(f64) -> Option<f64> + use<> {
        let (times, depths) = (self.steps.column("time_s"), self.steps.column("insertion_mm"));
        let steps: Course = times.into_iter().zip(depths).filter_map(|(s, mm)| s.zip(mm)).collect();
        let recorded = &self.motion.measured.insertion;
        let last_s = |course: &Course| course.last().map(|(time_s, _)| *time_s);
        // Positions that end before the last step were truncated.
        let course = if last_s(recorded) >= last_s(&steps) { recorded } else { &steps }.clone();
        let start = steps.first().and_then(|(time_s, depth_mm)| {
            Some((*time_s, position_mm(&course, *time_s)? - depth_mm))
        });
        move |time_s| {
            let (_, start_mm) = start.filter(|(begun_s, _)| time_s >= *begun_s)?;
            Some(position_mm(&course, time_s)? - start_mm)
        }
    }

    /// The times, s, and names of the states that the run itself went through.
    fn session_states(&self) -> impl Iterator<Item = (f64, &str)> {
        let is_state =
            |line: &&EventLine<'_>| line.lane == Lane::Session && line.kind == EventKind::State;
        self.events.iter().filter(is_state).map(|line| (line.time.as_secs_f64(), &*line.text))
    }

    /// When the insertion was held, from and to in s.
    pub(super) fn held(&self) -> Vec<(f64, f64)> {
        let ends = self.session_states().skip(1).map(|(time_s, _)| time_s).chain([f64::INFINITY]);
        let is_held = |name| State::named(Lane::Session, name).is_some_and(State::is_held);
        let held = self.session_states().zip(ends).filter(|((_, name), _)| is_held(name));
        held.map(|((from_s, _), to_s)| (from_s, to_s)).collect()
    }

    /// The states that the run itself went through, with their depths.
    pub(super) fn states(&self) -> Vec<StateChange> {
        let depth_mm = self.depth_over_time();
        let change = |(time_s, name): (f64, &str)| StateChange {
            time_s,
            insertion_mm: depth_mm(time_s),
            state: name.to_owned(),
        };
        self.session_states().map(change).collect()
    }

    /// When the run was stopped, s; `None` if it was not stopped, or if the time is not recorded.
    pub(super) fn stop_time_s(&self) -> Option<f64> {
        let is_stopped = self.folder.manifest.outcome == Some(RunOutcome::Stopped);
        let change = self.session_states().find(|(_, name)| *name == State::Stopping.as_str());
        change.filter(|_| is_stopped).map(|(time_s, _)| time_s)
    }

    /// The events of at least the severity `least`.
    pub(super) fn events_from(&self, least: Severity) -> impl Iterator<Item = &EventLine<'static>> {
        self.events.iter().filter(
            move |line| matches!(line.kind, EventKind::Event(severity) if severity >= least),
        )
    }
}

/// The position at a time, linear between two points of `course`; `None` without any point.
fn position_mm(course: &Course, time_s: f64) -> Option<f64> {
    let after = course.partition_point(|(s, _)| *s <= time_s);
    let before = after.checked_sub(1).and_then(|before| course.get(before));
    match (before, course.get(after)) {
        (Some((s0, mm0)), Some((s1, mm1))) => Some(mm0 + (mm1 - mm0) * (time_s - s0) / (s1 - s0)),
        (only, other) => Some(only.or(other)?.1),
    }
}

/// Parses a line of `events.log`.
pub fn parse_event(line: &str) -> Option<EventLine<'static>> {
    let line = EventLine::parse(line)?;
    Some(EventLine { text: Cow::Owned(line.text.into_owned()), ..line })
}

/// `2026-03-01 14:30:00 UTC` from `2026-03-01T14:30:00.123456Z`; other text is unchanged.
pub(super) fn utc(rfc3339: &str) -> String {
    match (rfc3339.get(..10), rfc3339.get(10..11), rfc3339.get(11..19)) {
        (Some(date), Some("T"), Some(time)) => format!("{date} {time} UTC"),
        _ => rfc3339.to_owned(),
    }
}

fn first_line(error: impl Display) -> String {
    error.to_string().lines().next().unwrap_or_default().to_owned()
}

impl Folder {
    /// The condition in a word. `whole` means that nothing of the run is missing.
    pub(super) fn condition_name(&self) -> &'static str {
        match self.condition {
            Condition::Whole if self.is_incomplete() => "incomplete",
            Condition::Whole => "whole",
            Condition::BeingWritten => "being written",
            Condition::Open => "open",
            Condition::Changed(_) => "edited",
        }
    }

    /// True if the stage was emulated in memory.
    pub(super) fn is_emulated(&self) -> bool {
        self.manifest.bus == CanInterface::Memory.to_string()
    }

    /// True if the truth is recorded: the tip positions are those of the emulated needle.
    pub(super) fn has_truth(&self) -> bool {
        self.is_emulated() && self.manifest.tracker == TrackerSource::Emulated.to_string()
    }

    /// True if the manifest says that a part of the run is missing.
    pub(super) fn is_incomplete(&self) -> bool {
        let manifest = &self.manifest;
        let lost = manifest.dropped.unwrap_or_default();
        let is_repaired = manifest.repaired_utc.is_some();
        is_repaired || !manifest.faults.is_empty() || lost.text_files + lost.recording > 0
    }

    /// A reason for caution with the record; `None` for a whole one.
    pub(super) fn caution(&self) -> Option<String> {
        let dir = shell_word(&self.dir);
        match &self.condition {
            Condition::Whole => None,
            Condition::BeingWritten => {
                Some("the run is still going on; this shows the record so far".to_owned())
            }
            Condition::Open => Some(format!(
                "the record is not closed; if its bench has ended, close it: needle-bench review {dir} --repair"
            )),
            Condition::Changed(what) => Some(what.clone()),
        }
    }

    /// How its run ended, and if it was stopped, why.
    pub(super) fn ending(&self) -> String {
        let Manifest { outcome, stop_reason, .. } = &self.manifest;
        match (outcome, stop_reason) {
            _ if self.condition == Condition::BeingWritten => "going on".to_owned(),
            (None, _) => "not closed: the bench ended before the run did".to_owned(),
            (Some(RunOutcome::Completed), _) => match self.plan_status() {
                Some(PlanStatus::Missed) => "completed, not at the target".to_owned(),
                _ => "completed".to_owned(),
            },
            (Some(RunOutcome::Stopped), Some(reason)) => format!("stopped: {}", escaped(reason)),
            (Some(RunOutcome::Stopped), None) => "stopped".to_owned(),
        }
    }

    fn toml(&self) -> Result<&str, String> {
        self.config_toml.as_deref().ok_or_else(|| "config.toml is missing".to_owned())
    }

    /// Its configuration.
    ///
    /// # Errors
    /// Why it cannot be read, in one line; for example another version of the bench wrote it.
    pub(super) fn config(&self) -> Result<Config, String> {
        let source = Source { name: "config.toml", text: self.toml()? };
        Config::from_sources(&[source], &[]).map_err(first_line)
    }

    /// Those of `samples` that are not of the target, which a run may track as well.
    pub fn tip_samples(&self, mut samples: Vec<TrackerTimes>) -> Vec<TrackerTimes> {
        let goal = self.config().ok().map(|config| config.goal);
        let target = goal.filter(|goal| goal.kind == GoalKind::Target).and_then(|goal| goal.tool);
        samples.retain(|sample| !target.as_ref().is_some_and(|tool| sample.is_of(tool)));
        samples
    }

    /// Every key of its configuration.
    ///
    /// # Errors
    /// Why they are not known, in words.
    pub(super) fn keys(&self) -> Result<Keys, String> {
        keys(self.toml()?).map_err(first_line)
    }

    /// The limits of its figures.
    ///
    /// # Errors
    /// Why they are not known, in words.
    pub(super) fn limits(&self) -> Result<Limits, String> {
        limits(&self.config()?).map_err(first_line)
    }

    /// `goal.tolerance_mm` of a run to a target; `None` for any other run or without a configuration.
    pub(super) fn tolerance_mm(&self) -> Option<f64> {
        self.limits().ok()?.get("target_error_mm").copied()
    }

    /// Whether the run reached its target; `None` without a target.
    pub(super) fn plan_status(&self) -> Option<PlanStatus> {
        let is_completed = self.manifest.outcome? == RunOutcome::Completed;
        let tolerance_mm = self.tolerance_mm().filter(|_| self.manifest.operation.is_none())?;
        self.figures()?.plan_status(is_completed, tolerance_mm)
    }

    /// The figures in the manifest, or else those computed from the steps.
    pub(super) fn figures(&self) -> Option<FigureReport> {
        self.figures_of_manifest().or_else(|| self.figures_of_steps.clone())
    }

    fn figures_of_manifest(&self) -> Option<FigureReport> {
        let figures = self.manifest.figures.clone();
        (!figures.is_empty()).then(|| serde_json::from_value(figures.into()).ok()).flatten()
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::config::DEFAULT_TOML;
    use crate::session::Outcome;
    use serde_json::json;

    pub(in crate::review) fn steps_csv() -> String {
        let mut steps = "step,time_s,insertion_mm,rotation_rad,rotation_cmd_rad_per_mm,\
                         x_meas_mm,x_est_mm,y_est_mm,z_est_mm,yaw_est_rad,pitch_est_rad,roll_est_rad,\
                         x_sd_mm,roll_sd_rad,\
                         x_true_mm,y_true_mm,z_true_mm,yaw_true_rad,pitch_true_rad,roll_true_rad\n"
            .to_owned();
        for n in 0..4 {
            steps += &format!("{n},{}.0,{n}.0,0,0.1,0.6,0.75,0,{n},0,0,3.1,0.2,0.1,", n + 2);
            steps += &format!("0.5,0,{n},0,0,-3.1\n");
        }
        steps
    }

    /// Four steps a second apart from 2 s on, 0.5 mm off the plane, the estimate 0.25 mm beside it.
    pub(in crate::review) fn run() -> Run {
        let mut manifest = Manifest::new("virtual", "2023-11-14T22:13:20.000000Z".to_owned());
        manifest.version = "0.1.0".to_owned();
        manifest.set_outcome(&Outcome::Completed);
        let figures = json!({
            "insertion_mm": 3.0, "steps": 4, "steps_saturated": 1, "off_plane_rms_mm": 0.5,
            "settling_mm": 0.0, "following_error_mm_max": 0.125,
        });
        let timing = json!({
            "sync_late_us_p50": 12, "sync_late_us_max": 1300, "sync_late_limit_us": 1000,
            "syncs_skipped": 2,
        });
        manifest.figures = figures.as_object().unwrap().clone();
        manifest.timing = timing.as_object().unwrap().clone();
        let events = [
            "    0.000 s  session   state    preparing",
            "    0.500 s  tracker   info     connected",
            "    2.000 s  session   state    inserting",
            "    3.500 s  tracker   warning  last tip 0.51 s old (limit 0.50)",
            "    3.500 s  session   state    holding",
            "    9.000 s  session   state    stopping",
            "   10.000 s  sess",
        ];
        let mut motion = Motion::default();
        motion.measured.insertion = vec![(1.0, 10.0), (2.0, 10.0), (5.0, 13.0), (9.0, 13.0)];
        Run {
            folder: Folder {
                dir: "runs/a".to_owned(),
                manifest,
                condition: Condition::Whole,
                figures_of_steps: None,
                config_toml: Some(DEFAULT_TOML.replace("depth_mm = 250.0", "depth_mm = 3.0")),
            },
            steps: StepsTable::parse(&steps_csv()).unwrap(),
            samples: Vec::new(),
            motion,
            events: events.iter().filter_map(|line| parse_event(line)).collect(),
            unreadable: Vec::new(),
        }
    }

    #[test]
    fn times_are_shown_to_the_second() {
        assert_eq!(utc("2026-03-01T14:30:00.123456Z"), "2026-03-01 14:30:00 UTC");
        assert_eq!(utc("yesterday"), "yesterday");
    }

    #[test]
    fn states_are_listed_with_their_depths() {
        let states = run().states();
        let listed: Vec<(f64, Option<f64>, &str)> =
            states.iter().map(|s| (s.time_s, s.insertion_mm, s.state.as_str())).collect();
        assert_eq!(
            listed,
            [
                (0.0, None, "preparing"),
                (2.0, Some(0.0), "inserting"),
                (3.5, Some(1.5), "holding"),
                (9.0, Some(3.0), "stopping"),
            ]
        );
    }

    /// The target's samples are no tip positions: with them the curves would hide a tip that is lost.
    #[test]
    fn the_samples_of_a_tracked_target_are_not_those_of_the_tip() {
        let of = |tool: &str| TrackerTimes {
            tool: tool.to_owned(),
            receive_time_ns: 0,
            acquisition_time_ns: None,
            refused: None,
        };
        let samples = ["NeedleToTracker", "Target"].map(of).to_vec();
        let mut folder = run().folder;
        assert_eq!(folder.tip_samples(samples.clone()), samples);
        let target =
            "[goal]\nkind = \"target\"\nposition_mm = [0.0, 0.0, 100.0]\ntool = \"Target\"\n";
        folder.config_toml = Some(target.to_owned());
        assert_eq!(folder.tip_samples(samples), [of("NeedleToTracker")]);
    }

    /// The depth counts from the first step, at 2 s.
    #[test]
    fn the_depth_at_a_time_is_the_measured_one() {
        let mut run = run();
        run.motion.measured.insertion = vec![(1.0, 9.5), (2.5, 10.5), (3.0, 10.5), (5.0, 14.5)];
        let depth_mm = run.depth_over_time();
        assert_eq!(depth_mm(1.9), None);
        let at_begin_mm = 9.5 + 1.0 / 1.5;
        for (time_s, stage_mm) in [(2.0, at_begin_mm), (2.75, 10.5), (3.5, 11.5), (60.0, 14.5)] {
            let off_mm = depth_mm(time_s).unwrap() - (stage_mm - at_begin_mm);
            assert!(off_mm.abs() < 1e-9, "{time_s} s: {off_mm} mm off");
        }
        run.motion.measured.insertion.pop();
        // Without positions up to the last step, at 5 s in 3 mm, the steps have to do.
        assert_eq!(run.depth_over_time()(4.5), Some(2.5));
        run.steps = StepsTable::default();
        assert_eq!(run.depth_over_time()(3.0), None);
    }
}
