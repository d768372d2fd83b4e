//! What the stage and the tracker's link tell a run.

use super::{Phase, Power, Session};
use crate::session::{Lane, Outcome, Record, Severity, StageState, left_unknown, news};
use crate::stage::{Progress, SetPoint, StageEvent};
use crate::tracker::Event;
use crate::units::Time;

impl Session {
    /// What the stage says, acted upon.
    pub(super) fn take_stage_event(&mut self, now: Time, event: StageEvent) {
        if event == StageEvent::Progress(Progress::Enabling) {
            self.power = Power::ComingOn;
        }
        if let Some((severity, text)) = news(&event) {
            return self.event(now, Lane::Stage, severity, text);
        }
        match event {
            StageEvent::Feedback(feedback) => self.take_feedback(now, &feedback),
            StageEvent::Located(at) => {
                self.power = Power::Awaited(now);
                self.check_depth(now, at);
            }
            StageEvent::Ready => {
                self.power = Power::On(now);
                self.state(now, StageState::Enabled);
            }
            StageEvent::Identity(axis, identity) => {
                let node = self.config.stage.axis(axis).node;
                self.record(Record::Drive { time: now, axis, node, identity });
            }
            StageEvent::Fault(fault) => self.stop(now, format!("stage: {fault}")),
            StageEvent::Stopped { standing, off } => {
                // What it still sends belongs to the run, whose end is the last word.
                self.drain_stage(now);
                self.state(now, StageState::Stopped);
                self.stage_stopped(now, standing, off);
            }
            _ => {}
        }
    }

    /// Refuses an insertion that would run into a soft limit, before the axes have power.
    fn check_depth(&mut self, now: Time, at: SetPoint) {
        let depth_mm = self.config.insertion.depth_mm;
        let end = SetPoint { insertion_mm: at.insertion_mm + depth_mm, ..at };
        if let Err(error) = self.stage.check_goal(end) {
            let from_mm = at.insertion_mm;
            self.stop(
                now,
                format!(
                    "stage: {error}; the axis stands at {from_mm:.3} mm, and insertion.depth_mm is \
                     {depth_mm:.3}"
                ),
            );
        }
    }

    /// The stage has done what it can to take power off; the run is over.
    fn stage_stopped(&mut self, now: Time, standing: bool, off: bool) {
        let outcome = match &self.phase {
            Phase::Stopping { outcome, .. } => outcome.clone(),
            Phase::Done(_) => return,
            Phase::Preparing | Phase::Inserting => {
                Outcome::Stopped("stage: stopped by itself".to_owned())
            }
        };
        if self.insertion.is_some()
            && let Some(text) = left_unknown(standing, off)
        {
            self.event(now, Lane::Stage, Severity::Warning, text.to_owned());
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
            Event::PassedOver { dropped, .. } => {
                self.tracking.note(&event);
                if let Some(text) = self.tracking.count_dropped(dropped) {
                    self.event(now, Lane::Tracker, Severity::Warning, text);
                }
                return;
            }
        };
        self.tracking.note(&event);
        self.drain_tracking(now);
        self.event(now, Lane::Tracker, severity, text);
    }
}
