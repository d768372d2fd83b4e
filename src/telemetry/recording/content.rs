//! What a viewer is given of a run, whichever way it gets there.

use super::index::Moment;
use super::log::{Lines, Meaning, States, level};
use super::messages::messages;
use super::motion::Motion;
use super::samples::Samples;
use super::space::Space;
use super::steps::Steps;
use super::{can, document, layout, scene};
use crate::archive::Manifest;
use crate::session::{Record, Severity};
use crate::telemetry::clock::unix_us;
use crate::telemetry::{Entry, RunInfo};
use crate::units::Time;
use rerun::external::re_log_types::StoreId;
use rerun::log::{ChunkBatcherConfig, LogMsg};
use rerun::{
    DynamicArchetype, RecordingStream, RecordingStreamBuilder, RecordingStreamResult, TextDocument,
};
use std::time::Duration;

/// The application under which a viewer files our recordings and keeps their layout.
const APPLICATION: &str = "needle-bench";
/// Rows that are not sent in columns, which are few, are held back for this long.
const HELD_BACK: Duration = Duration::from_millis(50);

/// The recording that both a file and viewers get: they have one identity.
pub(super) fn builder(info: &RunInfo, manifest: &Manifest) -> RecordingStreamBuilder {
    RecordingStreamBuilder::new(APPLICATION)
        .recording_id(format!("{}-{}", manifest.started_utc, manifest.name))
        .recording_name(info.name.as_str())
        .recording_started(rerun::datatypes::TimeInt(unix_us(info.started_utc) * 1000))
        .batcher_config(ChunkBatcherConfig { flush_tick: HELD_BACK, ..Default::default() })
        // A recording identity switches the properties off, and RERUN=0 the whole recording.
        .send_properties(true)
        .enabled(true)
}

/// Gathers the records of a run as rows, and sends them on. Bound to the thread that opened it.
pub(super) struct Content {
    stream: RecordingStream,
    now: Moment,
    frames: can::Selection,
    lines: Lines,
    states: States,
    motion: Motion,
    samples: Samples,
    steps: Steps,
    space: Space,
}

impl Content {
    /// Sends what stands still: the layout, the scene, the manifest and the configuration.
    pub(super) fn open(
        stream: RecordingStream,
        info: &RunInfo,
        manifest: &Manifest,
    ) -> RecordingStreamResult<Self> {
        let scene = &info.scene;
        layout::send(&stream, APPLICATION, scene)?;
        scene::log(&stream, scene)?;
        log_manifest(&stream, manifest)?;
        let config = TextDocument::from_markdown(document::config(&info.config_toml));
        stream.log_static("config", &config)?;
        Ok(Content {
            now: Moment::default(),
            frames: can::Selection::new(&scene.stage),
            lines: Lines::default(),
            states: States::default(),
            motion: Motion::new(scene),
            samples: Samples::new(),
            steps: Steps::new(scene),
            space: Space::open(&stream, scene.truth)?,
            stream,
        })
    }

    /// The way it all goes.
    pub(super) fn stream(&self) -> &RecordingStream {
        &self.stream
    }

    fn at(&self, time: Time) -> Moment {
        Moment { time, ..self.now }
    }

    /// Makes rows of a record.
    pub(super) fn take(&mut self, entry: Entry) {
        match entry.record {
            Record::Begun { .. } | Record::Input { .. } => {}
            Record::Can { time, direction, frame } => {
                let moment = self.at(time);
                if let Some((axis, state)) = self.frames.entered(&frame) {
                    let meaning = Meaning::of_drive(state);
                    self.states.push(moment, &format!("drive_{axis}"), state.to_string(), meaning);
                }
                if let Some(line) = self.frames.line(self.now.step, direction, &frame) {
                    self.lines.push(moment, "can", line.level, line.text);
                }
            }
            Record::Sample(sample) => {
                let moment = self.at(sample.receive_time);
                self.samples.push(moment, &sample, &mut self.lines, &mut self.states);
            }
            Record::Stage(stage) => {
                self.now.reach(stage.insertion_meas_mm);
                self.frames.locate(&stage);
                self.motion.push(self.at(stage.time), &stage);
            }
            Record::Step(step) => {
                self.now.step = step.step;
                self.now.reach(step.insertion_meas_mm);
                let moment = self.at(step.time);
                self.steps.push(moment, &step, entry.truth.as_ref());
                self.space.push(moment, &step, entry.truth.as_ref());
            }
            Record::Drive { time, axis, node, identity } => {
                let text = format!("{axis}: node {node}, {identity}");
                self.lines.push(self.at(time), "events/stage", level(Severity::Info), text);
            }
            Record::State { time, state } => {
                let (lane, meaning) = (state.lane().to_string(), Meaning::of(state));
                self.states.push(self.at(time), &lane, state.to_string(), meaning);
            }
            Record::Event { time, lane, severity, text } => {
                let path = format!("events/{lane}");
                let text = format!("{lane}: {text}");
                self.lines.push(self.at(time), &path, level(severity), text);
            }
        }
    }

    /// Sends the rows that wait.
    pub(super) fn send(&mut self) -> RecordingStreamResult<()> {
        self.lines.send(&self.stream)?;
        self.states.send(&self.stream)?;
        self.motion.send(&self.stream)?;
        self.samples.send(&self.stream)?;
        self.steps.send(&self.stream)?;
        self.space.send(&self.stream)
    }

    /// Sends what is left, and the manifest as it ended.
    pub(super) fn end(&mut self, manifest: &Manifest) -> RecordingStreamResult<()> {
        self.motion.end();
        self.send()?;
        log_manifest(&self.stream, manifest)
    }
}

/// The entities that tell of the manifest.
pub(super) const MANIFEST_PAGES: [&str; 2] = ["/manifest", "/__properties/run"];

/// What a recording that is finished tells of `manifest`, for the recording `run`.
pub(super) fn manifest_pages(
    run: &StoreId,
    manifest: &Manifest,
) -> RecordingStreamResult<Vec<LogMsg>> {
    let builder = RecordingStreamBuilder::from_store_id(run).send_properties(false);
    let messages = messages(builder, |stream| log_manifest(stream, manifest))?;
    Ok(messages.into_iter().filter(|message| matches!(message, LogMsg::ArrowMsg(..))).collect())
}

fn log_manifest(stream: &RecordingStream, manifest: &Manifest) -> RecordingStreamResult<()> {
    let page = document::manifest(manifest);
    stream.log_static("manifest", &TextDocument::from_markdown(page))?;
    let outcome =
        manifest.outcome.map_or_else(|| "not ended".to_owned(), |outcome| outcome.to_string());
    let run = [
        ("version", &manifest.version),
        ("config_sha256", &manifest.config_sha256),
        ("bus", &manifest.bus),
        ("tracker", &manifest.tracker),
        ("outcome", &outcome),
    ]
    .into_iter()
    .fold(DynamicArchetype::new("run"), |run, (name, text)| {
        let text = rerun::components::Text::from(text.as_str());
        run.with_component::<rerun::components::Text>(name, [text])
    });
    stream.send_property("run", &run)
}
