//! The part of a run that differs from task to task.

use super::shell::Shell;
use super::{AxisMove, Lane, OperatorCommand, Progress, Record, SampleRecord, tracker_news};
use crate::canopen::Frame;
use crate::stage::StageEvent;
use crate::tracker::{Event, GateCounts};
use crate::units::Time;
use std::time::Duration;

/// A task: an insertion, or an operation of the stage alone.
///
/// The [`Session`](super::Session) around it brings the stage up, supervises it, stops it and takes
/// power off. A task decides what to do between [`StageEvent::Ready`] and the stop. If a method returns an
/// error, the run stops for that reason, unless the method says otherwise.
pub(crate) trait Task {
    /// Called once when the run begins.
    fn begin(&mut self, _shell: &mut Shell) {}

    /// Whether the axes may be given power now. The session asks after every input until they have power.
    fn permits_power(&mut self, _shell: &mut Shell) -> Result<bool, String> {
        Ok(true)
    }

    /// Takes an event of the stage. While the run is being stopped, only feedback is passed on.
    fn take_stage_event(&mut self, shell: &mut Shell, event: &StageEvent) -> Result<(), String>;

    /// Takes an event of the tracker's link. By default, for a task that does not use the tracker, the events
    /// are recorded, and a failure to connect is ignored.
    fn take_tracker_event(&mut self, shell: &mut Shell, event: Event) {
        if let Event::Unreachable { .. } = event {
            return;
        }
        if let Some((severity, text)) = tracker_news(&event) {
            shell.report(Lane::Tracker, severity, text);
        }
        if let Event::Sample(sample) = event {
            shell.record(Record::Sample(SampleRecord::received(sample)));
        }
    }

    /// The maximum age of the tip position during the task; `None` if the task needs no tip position.
    fn tip_age_max(&self) -> Option<Duration> {
        None
    }

    /// Takes a frame of the bus, after the stage has taken it.
    fn take_frame(&mut self, _shell: &Shell, _frame: &Frame) {}

    /// Does the work that the last input left over, so that the frames in response to it are sent first.
    /// Called before the next input. While there is such work, [`deadline`](Self::deadline) is in the past.
    fn catch_up(&mut self) -> Result<(), String> {
        Ok(())
    }

    /// Does what is due; called after every input.
    fn handle_timeout(&mut self, _shell: &mut Shell) -> Result<(), String> {
        Ok(())
    }

    /// When [`handle_timeout`](Self::handle_timeout) or [`catch_up`](Self::catch_up) next has something to
    /// do, unless the run is being stopped.
    fn deadline(&self, _shell: &Shell) -> Time {
        Time::NEVER
    }

    /// Called once when the run is over, for the last records of the task.
    fn end(&mut self, _shell: &mut Shell) {}

    /// Takes a command of the operator, and returns its effect as text.
    ///
    /// # Errors
    /// Why the command is refused; the task goes on as before.
    fn take_operator(
        &mut self,
        _shell: &mut Shell,
        _command: OperatorCommand,
    ) -> Result<String, String> {
        Err("only an insertion can be held; stop the operation".to_owned())
    }

    /// The progress of the task.
    fn progress(&self, _now: Time) -> Progress {
        Progress::default()
    }

    /// The numbers of samples that the tracker's gates accepted and refused.
    fn gate_counts(&self) -> GateCounts {
        GateCounts::default()
    }

    /// The moves so far, of a task that moves one axis after the other.
    fn moves(&self) -> &[AxisMove] {
        &[]
    }
}
