//! What the stage and the tracker's link tell a run.

use super::{Phase, Session};
use crate::session::{Lane, Outcome, Record, Severity};
use crate::stage::StageEvent;
use crate::tracker::Event;
use crate::units::Time;

impl Session {
    /// What the stage says, acted upon.
    pub(super) fn take_stage_event(&mut self, now: Time, event: StageEvent) {
        let (severity, text) = match event {
            StageEvent::Feedback(feedback) => return self.take_feedback(now, &feedback),
            StageEvent::Ready => {
                self.ready_since = Some(now);
                return self.state(now, Lane::Stage, "operation enabled");
            }
            StageEvent::Identity(axis, identity) => {
                let node = self.config.stage.axis(axis).node;
                return self.record(Record::Drive { time: now, axis, node, identity });
            }
            StageEvent::Fault(fault) => return self.stop(now, format!("stage: {fault}")),
            StageEvent::Stopped { standing } => {
                // What it still sends belongs to the run, whose end is the last word.
                self.drain_stage(now);
                self.state(now, Lane::Stage, "stopped");
                return self.stage_stopped(now, standing);
            }
            StageEvent::Homed { axis, position } => {
                (Severity::Info, format!("{axis}: home, at {position:.3} {}", axis.unit()))
            }
            StageEvent::Progress(progress) => (Severity::Info, progress.to_string()),
            StageEvent::Emergency(axis, emcy) => {
                (Severity::Warning, format!("{axis}: emergency {emcy}"))
            }
            StageEvent::Ignored { why, count, frame } => {
                (Severity::Warning, format!("{why}, {count} so far, the newest {frame}"))
            }
            StageEvent::SyncSkipped(periods) => {
                (Severity::Warning, format!("the bench was late: {periods} SYNC periods skipped"))
            }
        };
        self.event(now, Lane::Stage, severity, text);
    }

    /// The stage is powerless; the run is over.
    fn stage_stopped(&mut self, now: Time, standing: bool) {
        let outcome = match &self.phase {
            Phase::Stopping { outcome, .. } => outcome.clone(),
            Phase::Done(_) => return,
            Phase::Preparing | Phase::Inserting => {
                Outcome::Stopped("stage: stopped by itself".to_owned())
            }
        };
        if self.insertion.is_some() && !standing {
            let text = "the axes were not seen to stand before power was taken off".to_owned();
            self.event(now, Lane::Stage, Severity::Warning, text);
        }
        self.finish(now, outcome);
    }

    /// What the tracker's link says, acted upon.
    pub(super) fn take_tracker_event(&mut self, now: Time, event: Event) {
        let (severity, text) = match event {
            Event::Sample(sample) => {
                self.tracking.take(now, sample, self.insertion.is_some());
                return self.drain_tracking(now);
            }
            Event::Connected { ref peer } => (Severity::Info, format!("connected to {peer}")),
            Event::Unreachable { ref reason } => (Severity::Warning, reason.clone()),
            Event::Status { ref device, ref status } => (
                Severity::Info,
                format!(
                    "{device}: status {} {} {}",
                    status.code, status.error_name, status.message
                ),
            ),
            Event::SawTool { ref tool, ref message_type } => {
                (Severity::Info, format!("\"{tool}\" is on the stream ({message_type})"))
            }
            Event::Malformed(ref error) => (Severity::Warning, error.to_string()),
            Event::Disconnected { ref reason } => (Severity::Warning, reason.clone()),
        };
        self.tracking.note(&event);
        self.drain_tracking(now);
        self.event(now, Lane::Tracker, severity, text);
    }
}
