//! `run.rrd`: the run for rerun's viewer. Nothing outside this module names rerun.
//!
//! Everything is gathered in columns and sent every two seconds, since a call to rerun costs
//! tens of microseconds and a chunk about a kilobyte, however little is in it. Angles are in
//! degrees here: this is read by people, `steps.csv` by programs.

mod can;
mod document;
mod index;
mod layout;
mod log;
mod palette;
mod plots;
mod progress;
mod scene;
mod space;
mod steps;
mod trail;

use self::index::Moment;
use self::log::{Lines, States};
use self::palette::{COMMANDED, MEASURED, NEUTRAL};
use self::plots::{Plot, Plots};
use self::progress::Progress;
use super::worker::{Closing, Sink};
use super::{Entry, RunInfo, TelemetryError};
use crate::archive::{Manifest, unix_us};
use crate::session::{Record, SampleRecord, Severity, StageRecord};
use crate::units::Time;
use rerun::sink::SinkFlushError;
use rerun::{RecordingStream, RecordingStreamBuilder, RecordingStreamResult, TextDocument};
use std::path::Path;
use std::time::{Duration, Instant};

/// The application under which a viewer files our recordings and keeps their layout.
const APPLICATION: &str = "needle-bench";
/// Rows are gathered for this long.
const SEND_EVERY: Duration = Duration::from_secs(2);
/// A flush is the only call that tells of a full disk, so one is made this often.
const FLUSH_EVERY: Duration = Duration::from_millis(500);
/// The first flush, before the run, is given this long.
const FIRST_FLUSH_LIMIT: Duration = Duration::from_secs(30);
/// A flush is given this long; the next one may succeed. A longer one would be taken for silence.
const FLUSH_LIMIT: Duration = Duration::from_millis(400);
/// The last flush is given this long.
const LAST_FLUSH_LIMIT: Duration = Duration::from_secs(10);

/// The recording of a run. It stays on the thread that opened it.
pub(super) struct Recording {
    stream: RecordingStream,
    next_send: Instant,
    next_flush: Instant,
    progress: Progress,
    now: Moment,
    frames: can::Selection,
    lines: Lines,
    states: States,
    stage: Plots,
    samples: Plots,
    steps: steps::Steps,
    space: space::Space,
}

impl Recording {
    /// Opens the recording `path` and logs what stands still. Returns when that is on disk, so
    /// that a disk which takes nothing is known before anything moves.
    pub(super) fn open(
        path: &Path,
        info: &RunInfo,
        manifest: &Manifest,
    ) -> Result<Self, TelemetryError> {
        let failed =
            |reason: String| TelemetryError::Recording { path: path.to_path_buf(), reason };
        let mut recording =
            Self::try_open(path, info, manifest).map_err(|e| failed(e.to_string()))?;
        let flushed = recording.stream.flush_with_timeout(FIRST_FLUSH_LIMIT);
        flushed.map_err(|e| failed(e.to_string()))?;
        recording.progress.made();
        Ok(recording)
    }

    fn try_open(path: &Path, info: &RunInfo, manifest: &Manifest) -> RecordingStreamResult<Self> {
        let stream = RecordingStreamBuilder::new(APPLICATION)
            .recording_id(format!("{}-{}", manifest.started_utc, manifest.name))
            .recording_name(info.name.as_str())
            .recording_started(rerun::datatypes::TimeInt(unix_us(info.started_utc) * 1000))
            // A recording identity switches the properties off, and RERUN=0 the whole recording.
            .send_properties(true)
            .enabled(true)
            .save(path)?;
        layout::send(&stream, APPLICATION, &info.scene)?;
        scene::log(&stream, &info.scene)?;
        log_manifest(&stream, manifest)?;
        stream.log_static(
            "config",
            &TextDocument::from_markdown(document::config(&info.config_toml)),
        )?;
        let now = Instant::now();
        Ok(Recording {
            stream,
            next_send: now + SEND_EVERY,
            next_flush: now + FLUSH_EVERY,
            progress: Progress::new(path, now),
            now: Moment::default(),
            frames: can::Selection::default(),
            lines: Lines::default(),
            states: States::default(),
            stage: Plots::new(stage_plots()),
            samples: Plots::new([Plot::line(
                "tracker/delay_ms",
                "acquisition to reception [ms]",
                COMMANDED,
            )
            .dots()]),
            steps: steps::Steps::new(),
            space: space::Space::new(),
        })
    }

    fn at(&self, time: Time) -> Moment {
        Moment { time, ..self.now }
    }

    fn push_stage(&mut self, stage: &StageRecord) {
        self.now.set_depth(stage.insertion_meas_mm);
        let rotation_cmd_deg = stage.rotation_cmd_rad.to_degrees();
        let rotation_meas_deg = stage.rotation_meas_rad.to_degrees();
        self.stage.push(
            self.at(stage.time),
            &[
                stage.insertion_cmd_mm,
                stage.insertion_meas_mm,
                rotation_cmd_deg,
                rotation_meas_deg,
                stage.insertion_cmd_mm - stage.insertion_meas_mm,
                rotation_cmd_deg - rotation_meas_deg,
            ],
        );
    }

    fn push_sample(&mut self, sample: &SampleRecord) {
        let moment = self.at(sample.receive_time);
        if let Some(reason) = &sample.refused {
            let text = format!("tracker: sample of {:?} refused: {reason}", sample.tool);
            self.lines.push(moment, "events/tracker", "WARN", text);
        }
        if let Some(acquisition_time) = sample.acquisition_time {
            let delay_ms = sample.receive_time.seconds_after(acquisition_time) * 1e3;
            self.samples.push(moment, &[delay_ms]);
        }
    }

    /// A slow disk or a busy machine is no fault, since rerun holds what it could not write; a disk
    /// that takes nothing for [`progress::STALL_LIMIT`] is. A full one shows as either.
    fn flush(&mut self) -> Result<(), String> {
        match self.stream.flush_with_timeout(FLUSH_LIMIT) {
            Ok(()) => {
                self.progress.made();
                Ok(())
            }
            Err(SinkFlushError::Failed { message }) => Err(message),
            Err(SinkFlushError::Timeout) => self.progress.check(),
        }
    }

    fn send(&mut self) -> RecordingStreamResult<()> {
        self.lines.send(&self.stream)?;
        self.states.send(&self.stream)?;
        self.stage.send(&self.stream)?;
        self.samples.send(&self.stream)?;
        self.steps.send(&self.stream)?;
        self.space.send(&self.stream)
    }
}

impl Sink for Recording {
    fn take(&mut self, entry: Entry) -> Result<(), String> {
        match entry.record {
            Record::Can { time, direction, frame } => {
                if let Some(line) = self.frames.line(self.now.step, direction, &frame) {
                    self.lines.push(self.at(time), "can", line.level, line.text);
                }
            }
            Record::Sample(sample) => self.push_sample(&sample),
            Record::Stage(stage) => self.push_stage(&stage),
            Record::Step(step) => {
                self.now.step = step.step;
                self.now.set_depth(step.insertion_meas_mm);
                let moment = self.at(step.time);
                self.steps.push(moment, &step, entry.truth.as_ref());
                self.space.push(moment, &step, entry.truth.as_ref());
            }
            Record::Drive { time, axis, node, identity } => {
                let text = format!("{axis}: node {node}, {identity}");
                self.lines.push(self.at(time), "events/stage", log::level(Severity::Info), text);
            }
            Record::State { time, lane, state } => self.states.push(self.at(time), lane, &state),
            Record::Event { time, lane, severity, text } => {
                let path = format!("events/{lane}");
                let text = format!("{lane}: {text}");
                self.lines.push(self.at(time), &path, log::level(severity), text);
            }
        }
        Ok(())
    }

    fn tick(&mut self) -> Result<(), String> {
        let now = Instant::now();
        if now >= self.next_send {
            self.send().map_err(|e| e.to_string())?;
            self.next_send = now + SEND_EVERY;
        }
        if now >= self.next_flush {
            self.flush()?;
            self.next_flush = Instant::now() + FLUSH_EVERY;
        }
        Ok(())
    }

    fn close(&mut self, closing: &Closing) -> Result<(), String> {
        self.send().map_err(|e| e.to_string())?;
        log_manifest(&self.stream, &closing.manifest).map_err(|e| e.to_string())?;
        self.stream.flush_with_timeout(LAST_FLUSH_LIMIT).map_err(|e| e.to_string())?;
        // Writes the footer and waits for it.
        self.stream.finalize_deferred_sinks();
        Ok(())
    }
}

fn log_manifest(stream: &RecordingStream, manifest: &Manifest) -> RecordingStreamResult<()> {
    let page = document::manifest(manifest);
    stream.log_static("manifest", &TextDocument::from_markdown(page))?;
    let text = |value: &str| rerun::components::Text::from(value);
    let run = rerun::DynamicArchetype::new("run")
        .with_component::<rerun::components::Text>("version", [text(&manifest.version)])
        .with_component::<rerun::components::Text>("config_sha256", [text(&manifest.config_sha256)])
        .with_component::<rerun::components::Text>("bus", [text(&manifest.bus)])
        .with_component::<rerun::components::Text>("tracker", [text(&manifest.tracker)])
        .with_component::<rerun::components::Text>(
            "outcome",
            [text(&manifest.outcome.map_or("not ended".to_owned(), |outcome| outcome.to_string()))],
        );
    stream.send_property("run", &run)
}

fn stage_plots() -> [Plot; 6] {
    [
        Plot::line("stage/insertion_mm/commanded", "insertion commanded [mm]", COMMANDED).wide(),
        Plot::line("stage/insertion_mm/measured", "insertion measured [mm]", MEASURED),
        Plot::line("stage/rotation_deg/commanded", "rotation commanded [deg]", COMMANDED).wide(),
        Plot::line("stage/rotation_deg/measured", "rotation measured [deg]", MEASURED),
        Plot::line("stage/lag/insertion_mm", "insertion lag [mm]", NEUTRAL),
        Plot::line("stage/lag/rotation_deg", "rotation lag [deg]", NEUTRAL),
    ]
}
