//! Logs a run for viewers: to its file, or to the live view.

use super::document::log_manifest;
use super::motion::Motion;
use super::samples::{Samples, log_refused};
use super::space::Space;
use super::states::{Meaning, States, drive_lane};
use super::steps::Steps;
use super::{Logged, can};
use crate::archive::{Manifest, unix_us_of};
use crate::session::{Record, Severity};
use crate::telemetry::{Entry, Scene};
use crate::units::Time;
use rerun::time::TimeCell;
use rerun::{RecordingStream, RecordingStreamBuilder, TextDocument, TextLog};

/// The application name, by which a viewer groups recordings and keeps their layout.
pub(super) const APPLICATION: &str = "needle-bench";

/// The run's own time.
pub(super) const RUN_TIME: &str = "run_time";
/// Number of the newest step.
pub(super) const STEP: &str = "step";
/// Greatest depth so far, µm. It never decreases, not even when the needle is withdrawn, since the rows of a
/// chunk must be in order on every time line.
pub(super) const INSERTION_DEPTH: &str = "insertion_depth";

/// The recording of the run of `manifest`: file and live view have one identity.
pub(super) fn builder(manifest: &Manifest) -> RecordingStreamBuilder {
    let started_us = unix_us_of(&manifest.started_utc).unwrap_or_default();
    RecordingStreamBuilder::new(APPLICATION)
        .recording_id(format!("{}-{}", manifest.started_utc, manifest.name))
        .recording_name(manifest.name.as_str())
        .recording_started(rerun::datatypes::TimeInt(started_us.saturating_mul(1000)))
        // Setting an identity turns the properties off, and RERUN=0 in the environment turns everything off.
        .send_properties(true)
        .enabled(true)
}

/// Logs the records of a run. They must all come on one thread, since rerun's time lines are thread-local.
pub(super) struct Content {
    pub(super) stream: RecordingStream,
    step: u32,
    depth_um: i64,
    frames: can::Selection,
    states: States,
    /// Time of the newest page of states.
    page_time: Time,
    motion: Motion,
    samples: Samples,
    steps: Steps,
    space: Space,
}

impl Content {
    /// Logs what does not change: the layout, the scene, the manifest and the configuration.
    pub(super) fn open(
        stream: RecordingStream,
        manifest: &Manifest,
        config_toml: &str,
        scene: &Scene,
    ) -> Logged<Self> {
        stream.set_log_time_enabled(false);
        let space = Space::open(&stream, scene)?;
        log_manifest(&stream, manifest)?;
        let config = TextDocument::from_markdown(format!(
            "# Configuration as used\n\n```toml\n{config_toml}\n```\n"
        ));
        stream.log_static("config", &config)?;
        Ok(Content {
            step: 0,
            depth_um: 0,
            frames: can::Selection::new(&scene.stage),
            states: States::default(),
            page_time: Time::ZERO,
            motion: Motion::new(scene),
            samples: Samples::default(),
            steps: Steps::default(),
            space,
            stream,
        })
    }

    /// Sets the time lines for everything logged from here on: to `time`, the newest step and the depth.
    fn set_time(&self, time: Time) {
        let nanos = TimeCell::from_duration_nanos(time.as_nanos());
        self.stream.set_time(RUN_TIME, nanos);
        self.stream.set_time(STEP, TimeCell::from_sequence(i64::from(self.step)));
        self.stream.set_time(INSERTION_DEPTH, TimeCell::from_sequence(self.depth_um));
    }

    /// Logs a record.
    pub(super) fn take(&mut self, Entry { record, truth }: Entry) -> Logged {
        match record {
            Record::Begun { .. } | Record::Input { .. } => Ok(()),
            Record::Can { time, direction, frame } => {
                if let Some((axis, state)) = self.frames.entered(&frame) {
                    let meaning = Meaning::of_drive(state);
                    self.enter(time, &drive_lane(axis), &state.to_string(), meaning)?;
                }
                if let Some((axis, emcy)) = self.frames.emergency(&frame) {
                    self.states.explain(time, &drive_lane(axis), &emcy.to_string());
                    self.log_page(time)?;
                }
                self.set_time(time);
                match self.frames.line(self.step, direction, &frame) {
                    Some((level, text)) => self.line("can", level, text),
                    None => Ok(()),
                }
            }
            Record::Sample(sample) => {
                self.set_time(sample.received.receive_time);
                self.samples.log(&self.stream, &sample, &mut self.states)
            }
            Record::Target(sample) => {
                self.set_time(sample.received.receive_time);
                log_refused(&self.stream, &sample)
            }
            Record::Stage(stage) => {
                self.depth_um = deepest_um(self.depth_um, stage.measured.insertion_mm);
                self.set_time(stage.time);
                self.motion.log(&self.stream, &stage)
            }
            Record::Step(step) => {
                self.step = step.step;
                self.depth_um = deepest_um(self.depth_um, step.insertion_meas_mm);
                self.set_time(step.time);
                self.steps.log(&self.stream, &step, truth.as_ref())?;
                self.space.log(&self.stream, &step, truth.as_ref())
            }
            Record::Drive { time, axis, node, identity } => {
                self.set_time(time);
                let text = format!("{axis}: node {node}, {identity}");
                self.line("events/stage", level(Severity::Info), text)
            }
            Record::State { time, state } => {
                self.enter(time, &state.lane().to_string(), state.as_str(), Meaning::of(state))
            }
            Record::Event { time, lane, severity, text } => {
                self.set_time(time);
                let (path, line) = (format!("events/{lane}"), format!("{lane}: {text}"));
                self.line(&path, level(severity), line)?;
                self.states.event(time, lane, severity, &text);
                self.log_page(time)
            }
        }
    }

    /// Logs that `lane` enters `state`.
    fn enter(&mut self, time: Time, lane: &str, state: &str, meaning: Meaning) -> Logged {
        self.set_time(time);
        self.states.log_lane(&self.stream, lane, state, meaning)?;
        self.states.enter(time, lane, state, meaning);
        self.log_page(time)
    }

    /// Logs the page of states. If `time` is before the previous page, the change appears at the time of that
    /// page.
    fn log_page(&mut self, time: Time) -> Logged {
        self.page_time = self.page_time.max(time);
        self.set_time(self.page_time);
        self.states.log_page(&self.stream)
    }

    fn line(&self, path: &str, level: &'static str, text: String) -> Logged {
        self.stream.log(path, &TextLog::new(text).with_level(level))
    }
}

/// The greatest depth so far, µm: `before_um`, or `insertion_mm` if it is deeper.
fn deepest_um(before_um: i64, insertion_mm: f64) -> i64 {
    match insertion_mm.is_finite() {
        true => before_um.max((insertion_mm * 1e3).round() as i64),
        false => before_um,
    }
}

/// rerun's name of a severity.
fn level(severity: Severity) -> &'static str {
    match severity {
        Severity::Info => "INFO",
        Severity::Warning => "WARN",
        Severity::Fault => "ERROR",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_depth_never_decreases() {
        let mut depth_um = 0;
        let depths_um = [1.0, 2.5, 2.499, f64::NAN, -3.0, 3.0].map(|insertion_mm| {
            depth_um = deepest_um(depth_um, insertion_mm);
            depth_um
        });
        assert_eq!(depths_um, [1000, 2500, 2500, 2500, 2500, 3000]);
    }
}
