//! What the runtime does with a session's records: telemetry, figures, news for the operator.

use super::emulated::Emulated;
use super::timing::TimingReport;
use crate::archive::DriveIdentity;
use crate::canopen::NodeId;
use crate::emulator::Truth;
use crate::session::{Lane, Outcome, Progress, Record, Severity};
use crate::stage::{Axis, Identity};
use crate::study::RunFigures;
use crate::telemetry::{Entry, Finished, Recorder, Summary, TelemetryError};
use crate::tracker::GateCounts;
use crate::units::Time;
use serde::Serialize;
use serde_json::{Map, Value, json};

/// The operator's eyes: told of progress and events as they happen.
pub trait Operator {
    /// The run has come this far.
    fn progress(&mut self, progress: Progress);
    /// Something happened.
    fn event(&mut self, time: Time, lane: Lane, severity: Severity, text: &str);
}

/// Takes the records of a run.
pub struct Sink<'a> {
    recorder: Recorder,
    figures: RunFigures,
    drives: Vec<DriveIdentity>,
    operator: &'a mut dyn Operator,
}

/// What a run came to.
#[derive(Debug)]
pub struct RunReport {
    /// How it ended.
    pub outcome: Outcome,
    /// Its figures.
    pub figures: RunFigures,
    /// What the tracker's gates did with its samples.
    pub gates: GateCounts,
    /// The session's time at the end.
    pub end: Time,
    /// How well time was kept; none in virtual time.
    pub timing: Option<TimingReport>,
    /// What telemetry left behind, or why it could not.
    pub record: Result<Finished, TelemetryError>,
    /// Of an emulated run, what nobody else knows.
    pub emulated: Option<Emulated>,
}

impl<'a> Sink<'a> {
    /// Records go to `recorder`, news to `operator`.
    pub fn new(recorder: Recorder, operator: &'a mut dyn Operator) -> Self {
        Sink { recorder, figures: RunFigures::default(), drives: Vec::new(), operator }
    }

    /// Takes one record, with the truth of its moment where the run is emulated.
    pub(crate) fn take(&mut self, record: Record, truth: Option<Truth>) {
        match &record {
            Record::Step(step) => self.figures.take(step, truth.as_ref()),
            Record::Event { time, lane, severity, text } => {
                self.operator.event(*time, *lane, *severity, text);
            }
            Record::Drive { axis, node, identity, .. } => self.identify(*axis, *node, identity),
            Record::Stage(stage) => self.figures.follow(stage),
            Record::Can { .. } | Record::Sample(_) | Record::State { .. } => {}
        }
        let truth = truth.filter(|_| matches!(record, Record::Step(_)));
        self.recorder.record(Entry { record, truth });
    }

    fn identify(&mut self, axis: Axis, node: NodeId, identity: &Identity) {
        self.drives.push(DriveIdentity {
            axis: axis.to_string(),
            node: node.get(),
            vendor_id: identity.vendor,
            product_code: identity.product,
            revision: identity.revision,
            serial: identity.serial,
        });
        if let Err(error) = self.recorder.identify_drives(self.drives.clone()) {
            self.operator.event(Time::ZERO, Lane::Session, Severity::Warning, &error.to_string());
        }
    }

    /// Tells the operator how far the run is.
    pub(crate) fn progress(&mut self, progress: Progress) {
        self.operator.progress(progress);
    }

    /// Why recording has failed, if it has.
    pub(crate) fn failure(&self) -> Option<String> {
        self.recorder.health().err().map(|error| format!("record: {error}"))
    }

    /// Closes the record.
    pub(crate) fn finish(
        self,
        outcome: Outcome,
        end: Time,
        gates: GateCounts,
        timing: Option<TimingReport>,
    ) -> RunReport {
        let summary = Summary {
            end,
            gates: gates_to_json(&gates),
            figures: object(&self.figures.report()),
            timing: object(&timing),
        };
        let record = self.recorder.finish(&outcome, summary);
        RunReport { outcome, figures: self.figures, gates, end, timing, record, emulated: None }
    }
}

/// The keys of what serialises as an object; none of anything else.
fn object(figures: &impl Serialize) -> Map<String, Value> {
    match serde_json::to_value(figures) {
        Ok(Value::Object(keys)) => keys,
        _ => Map::new(),
    }
}

/// Samples of the tool accepted, and refused by each gate that refused any.
pub fn gates_to_json(gates: &GateCounts) -> Map<String, Value> {
    let refused: Map<String, Value> =
        gates.by_gate().map(|(gate, count)| (gate.to_string(), json!(count))).collect();
    Map::from_iter([
        ("accepted".to_owned(), json!(gates.accepted)),
        ("refused".to_owned(), Value::Object(refused)),
    ])
}
