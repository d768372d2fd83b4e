//! What a run is for: the part of it that differs from task to task.

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
/// power off. A task decides what to do between [`StageEvent::Ready`] and the stop. An error of a
/// method is the reason to stop for, except where it says otherwise.
pub(crate) trait Task {
    /// The run begins.
    fn begin(&mut self, _shell: &mut Shell) {}

    /// Whether the axes may be given power now; asked after every input until they are.
    fn permits_power(&mut self, _shell: &mut Shell) -> Result<bool, String> {
        Ok(true)
    }

    /// Takes an event of the stage. Feedback comes while the axes are stopped, too; everything else
    /// comes before.
    fn take_stage_event(&mut self, shell: &mut Shell, event: &StageEvent) -> Result<(), String>;

    /// Takes an event of the tracker's link. A task that does not use the tracker records the events, and
    /// ignores that no connection can be made.
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

    /// Takes any frame of the bus, which the stage has taken already.
    fn take_frame(&mut self, _shell: &Shell, _frame: &Frame) {}

    /// Does what the last input left to do, once the frames that answer it may have left; called before
    /// the next one. Until then [`deadline`](Self::deadline) is past.
    fn catch_up(&mut self) -> Result<(), String> {
        Ok(())
    }

    /// Does what is due; called after every input.
    fn handle_timeout(&mut self, _shell: &mut Shell) -> Result<(), String> {
        Ok(())
    }

    /// When [`handle_timeout`](Self::handle_timeout) has something to do, while nothing is stopped.
    fn deadline(&self, _shell: &Shell) -> Time {
        Time::NEVER
    }

    /// The run is over: the last records of the task.
    fn end(&mut self, _shell: &mut Shell) {}

    /// Takes a command of the operator, and says what comes of it.
    ///
    /// # Errors
    /// Why it is refused; the task goes on as before.
    fn take_operator(
        &mut self,
        _shell: &mut Shell,
        _command: OperatorCommand,
    ) -> Result<String, String> {
        Err("only an insertion can be held; stop the operation".to_owned())
    }

    /// How far the task is.
    fn progress(&self, _now: Time) -> Progress {
        Progress::default()
    }

    /// What the tracker's gates did with its samples.
    fn gate_counts(&self) -> GateCounts {
        GateCounts::default()
    }

    /// The moves so far, of a task that moves one axis after the other.
    fn moves(&self) -> &[AxisMove] {
        &[]
    }
}
