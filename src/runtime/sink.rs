//! Passes a session's records on to the recorder, to the figures and to the operator's screen.

use super::drive::RunMonitor;
use super::interrupt::Interrupt;
use super::timing::{DurationHistogram, TimingReport};
use super::virtual_time::EmulationReport;
use crate::archive::{DriveIdentity, Manifest};
use crate::canopen::NodeId;
use crate::emulator::Truth;
use crate::session::{
    Lane, Machine, OperatorCommand, Outcome, Progress, Record, Severity, StageAtEnd, State,
};
use crate::stage::{Axis, Identity};
use crate::study::RunFigures;
use crate::telemetry::{Entry, RecordNews, Recorder, TelemetryError};
use crate::tracker::GateCounts;
use crate::units::Time;
use serde::Serialize;
use serde_json::{Map, Value, json};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// The operator's screen and keys: shows progress and events as they happen, gives commands.
/// No method may block: the control thread calls them.
pub trait Operator {
    /// Shows the progress of the run.
    fn progress(&mut self, progress: Progress);
    /// Shows an event.
    fn event(&mut self, time: Time, lane: Lane, severity: Severity, text: &str);
    /// Takes each record as it is made.
    fn record(&mut self, _record: &Record) {}
    /// Shows a problem with the record; an event reports it too.
    fn record_trouble(&mut self, _text: &str) {}
    /// Takes the folder in which the run is recorded.
    fn recorded_to(&mut self, _folder: &Path) {}
    /// The operator's next command, if there is one.
    fn command(&mut self) -> Option<OperatorCommand> {
        None
    }
}

/// How often an insertion was held, by cause.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct Holds {
    /// Holds by the tracker: the tip was not seen, or the stream contradicted the model.
    pub tracker: u32,
    /// Holds by the operator.
    pub operator: u32,
    /// Holds after a single step.
    pub step: u32,
}

/// Takes the records of a run.
pub struct Sink<'a> {
    /// The recorder; an error if the run is not recorded.
    recorder: Result<Recorder, TelemetryError>,
    figures: RunFigures,
    holds: Holds,
    /// If the run goes on when recording fails, what the warning says about it; `None` if the run stops.
    goes_on: Option<&'static str>,
    /// How long it took to hand each record to the recorder, ns.
    record_times: DurationHistogram,
    operator: &'a mut dyn Operator,
    interrupt: Interrupt,
}

/// The result of a run.
#[derive(Debug)]
pub struct RunReport {
    /// How it ended.
    pub outcome: Outcome,
    /// Its figures.
    pub figures: RunFigures,
    /// The state in which it left the stage.
    pub stage_at_end: StageAtEnd,
    /// How often it was held.
    pub holds: Holds,
    /// The numbers of samples that the tracker's gates accepted and refused.
    pub gates: GateCounts,
    /// The session's time at the end.
    pub end: Time,
    /// How punctual the run was; `None` in virtual time.
    pub timing: Option<TimingReport>,
    /// The run folder; `None` for a withdrawal without a record.
    pub run_dir: Option<PathBuf>,
    /// The manifest of the closed record. An error if the run was not recorded, or the record not closed.
    pub record: Result<Manifest, TelemetryError>,
    /// The facts that are known only in an emulated run; `None` in any other.
    pub emulated: Option<EmulationReport>,
}

impl<'a> Sink<'a> {
    /// Passes records to `recorder` and events to `operator`, and stops the run once `interrupt` is raised. If
    /// recording fails, the run is stopped, unless `goes_on` has the text of a warning about what goes on. Lost records
    /// are then reported and counted.
    pub fn new(
        recorder: Result<Recorder, TelemetryError>,
        goes_on: Option<&'static str>,
        operator: &'a mut dyn Operator,
        interrupt: &Interrupt,
    ) -> Self {
        if let Ok(recorder) = &recorder {
            operator.recorded_to(&recorder.run_dir);
        }
        Sink {
            recorder,
            figures: RunFigures::default(),
            holds: Holds::default(),
            goes_on,
            record_times: DurationHistogram::default(),
            operator,
            interrupt: interrupt.clone(),
        }
    }

    fn identify(&mut self, axis: Axis, node: NodeId, identity: &Identity) {
        let Ok(recorder) = &mut self.recorder else { return };
        recorder.identify_drive(DriveIdentity {
            axis: axis.to_string(),
            node: node.get(),
            vendor_id: identity.vendor,
            product_code: identity.product,
            revision: identity.revision,
            serial: identity.serial,
        });
    }

    /// Reports the recorder's news, and records them as far as possible. Returns the reason to stop the run if
    /// recording has failed, unless the run continues without a record or `is_ending` anyway.
    fn check_record(&mut self, now: Time, is_ending: bool) -> Option<String> {
        let mut reason = None;
        while let Some(news) = self.recorder.as_mut().ok().and_then(Recorder::news) {
            let trouble = match (news, self.goes_on) {
                (RecordNews::Failed(error), Some(goes_on)) => format!("{error}; {goes_on}"),
                (RecordNews::Failed(error), None) if reason.is_none() && !is_ending => {
                    self.operator.record_trouble(&error);
                    reason = Some(format!("record: {error}"));
                    continue;
                }
                (RecordNews::Failed(text) | RecordNews::Warning(text), _) => text,
            };
            self.operator.record_trouble(&trouble);
            let text = format!("record: {trouble}");
            let (lane, severity) = (Lane::Session, Severity::Warning);
            self.take(Record::Event { time: now, lane, severity, text }, None);
        }
        reason
    }

    /// Closes the record.
    pub(crate) fn finish(
        self,
        session: &dyn Machine,
        outcome: Outcome,
        end: Time,
        timing: Option<TimingReport>,
    ) -> RunReport {
        self.operator.progress(session.progress());
        let gates = session.gate_counts();
        let timing = timing.map(|timing| timing.with_record_times(&self.record_times));
        let run_dir = self.recorder.as_ref().ok().map(|recorder| recorder.run_dir.clone());
        let sum_up = |manifest: &mut Manifest| {
            manifest.set_outcome(&outcome);
            manifest.duration_s = Some(end.as_nanos() as f64 / 1e9);
            manifest.gates = gates_to_json(&gates);
            manifest.figures = json_keys(&self.figures.report());
            manifest.timing = json_keys(&timing);
        };
        let record = self.recorder.and_then(|recorder| recorder.finish(sum_up));
        RunReport {
            outcome,
            figures: self.figures,
            stage_at_end: session.stage_at_end(),
            holds: self.holds,
            gates,
            end,
            timing,
            run_dir,
            record,
            emulated: None,
        }
    }
}

impl RunMonitor for Sink<'_> {
    fn take(&mut self, record: Record, truth: Option<Truth>) {
        self.operator.record(&record);
        match &record {
            Record::Step(step) => self.figures.take_step(step, truth.as_ref()),
            Record::Event { time, lane, severity, text } => {
                self.operator.event(*time, *lane, *severity, text);
            }
            Record::Drive { axis, node, identity, .. } => self.identify(*axis, *node, identity),
            Record::Stage(stage) => self.figures.take_feedback(stage),
            Record::Sample(sample) => self.figures.take_sample(sample),
            Record::State { state: State::Holding, .. } => self.holds.tracker += 1,
            Record::State { state: State::HeldByOperator, .. } => self.holds.operator += 1,
            Record::State { state: State::HeldAfterStep, .. } => self.holds.step += 1,
            _ => {}
        }
        let truth = truth.filter(|_| matches!(record, Record::Step(_)));
        let Ok(recorder) = &mut self.recorder else { return };
        let begun = Instant::now();
        recorder.record(Entry { record, truth });
        self.record_times.add_ns(begun.elapsed());
    }

    fn progress(&mut self, progress: Progress) {
        self.operator.progress(progress);
    }

    fn command(&mut self) -> Option<OperatorCommand> {
        self.operator.command()
    }

    fn stop_reason(&mut self, now: Time, is_stopping: bool) -> Option<String> {
        let is_interrupted = self.interrupt.is_raised();
        let record_reason = self.check_record(now, is_stopping || is_interrupted);
        if is_stopping {
            None
        } else if is_interrupted {
            Some("operator: interrupted".to_owned())
        } else {
            record_reason
        }
    }
}

/// The keys of `value` if it serialises as a JSON object; none otherwise.
fn json_keys(value: &impl Serialize) -> Map<String, Value> {
    match serde_json::to_value(value) {
        Ok(Value::Object(keys)) => keys,
        _ => Map::new(),
    }
}

/// The number of accepted samples of the tool, and the number refused by each gate that refused any.
pub fn gates_to_json(gates: &GateCounts) -> Map<String, Value> {
    let refused: Map<String, Value> =
        gates.by_gate().map(|(gate, count)| (gate.to_string(), json!(count))).collect();
    Map::from_iter([
        ("accepted".to_owned(), json!(gates.accepted)),
        ("refused".to_owned(), Value::Object(refused)),
    ])
}
