//! The task that steers: one insertion, from the first tip seen to the full depth.

mod hold;
mod start;
#[cfg(test)]
mod tests;

use self::hold::{EndedHold, Hold};
use self::start::Start;
use super::config::SessionConfig;
use super::estimation::{Estimation, Measurement};
use super::insertion::{DueStep, Insertion};
use super::record::{Lane, Record, Severity, StepRecord};
use super::shell::{Power, Shell};
use super::state::State;
use super::steering::Decision;
use super::target::TargetTracking;
use super::task::Task;
use super::tracking::{HoldReason, Tracking};
use super::{OperatorCommand, Progress, tracker_news};
use crate::geometry::coordinates;
use crate::observer::Estimate;
use crate::stage::{Feedback, SetPoint, StageEvent};
use crate::text::clipped;
use crate::tracker::{Event, GateCounts, StageHistory, StagePoint};
use crate::units::Time;
use std::time::Duration;

/// The stage's positions are kept this much longer than a measurement can be old.
const HISTORY_MARGIN: Duration = Duration::from_secs(1);

/// An insertion, with the tracking and the estimation that steer it.
///
/// A set-point is computed only while the newest believed tip position is young enough.
pub(super) struct InsertTask {
    config: SessionConfig,
    begun: Time,
    /// The bench's judgement of the start, until the insertion begins.
    start: Start,
    tracking: Tracking,
    /// The track of the target, if the target is a tool of its own.
    target: Option<TargetTracking>,
    /// Measured stage positions, with a depth that never decreases: the path that the needle has cut.
    history: StageHistory,
    estimation: Estimation,
    /// `None` until the axes have power and the tip is seen at an accepted start.
    insertion: Option<Insertion>,
    hold: Option<Hold>,
    /// The last hold by the tracker that ended by itself.
    ended_hold: Option<EndedHold>,
    /// Measurements that have not corrected the observers yet.
    pending: Vec<Measurement>,
    /// The time of the feedback up to which the observers must still be corrected.
    catch_up_to: Option<Time>,
    progress: Progress,
}

impl InsertTask {
    pub(super) fn new(config: SessionConfig, now: Time) -> Self {
        InsertTask {
            begun: now,
            start: Start::Unknown,
            tracking: Tracking::new(&config),
            target: config
                .goal
                .as_ref()
                .and_then(|goal| goal.tool.clone())
                .map(|tool| TargetTracking::new(tool, &config.tracker, &config.x_wp)),
            history: StageHistory::new(history_points(&config)),
            estimation: Estimation::new(&config),
            insertion: None,
            hold: None,
            ended_hold: None,
            pending: Vec::new(),
            catch_up_to: None,
            progress: Progress { depth_mm: config.insertion.depth_mm, ..Progress::default() },
            config,
        }
    }

    /// Records what the tracking has to report, and its state.
    fn drain_tracking(&mut self, shell: &mut Shell) {
        self.tracking.records.drain(..).for_each(|record| shell.record(record));
        shell.enter(self.tracking.state(shell.now));
    }

    /// Refuses an insertion from `at` that would end beyond a soft limit.
    fn check_depth(&self, shell: &Shell, at: SetPoint) -> Result<(), String> {
        let depth_mm = self.config.insertion.depth_mm;
        let end = SetPoint { insertion_mm: at.insertion_mm + depth_mm, ..at };
        shell.check_goal(end).map_err(|error| {
            format!(
                "{error}; the axis stands at {:.3} mm, and insertion.depth_mm is {depth_mm:.3}",
                at.insertion_mm
            )
        })
    }

    /// Handles the answers of both drives to a SYNC: pairs, estimates, decides and commands.
    fn take_feedback(&mut self, shell: &mut Shell, feedback: &Feedback) -> Result<(), String> {
        let cut_mm = self.history.newest().map_or(f64::NEG_INFINITY, |point| point.insertion_mm);
        // A reading deeper than the set-point is wrong and must not count as cut. In a stop the axis may pass its
        // last target, so there this limit does not apply.
        let inserting = self.insertion.as_ref().filter(|_| shell.is_running());
        let deepest_mm = inserting
            .map_or(f64::INFINITY, |insertion| insertion.deepest_stage_mm(feedback.commanded));
        let point = StagePoint {
            time: feedback.time,
            insertion_mm: feedback.measured.insertion_mm.min(deepest_mm).max(cut_mm),
            rotation_rad: feedback.measured.rotation_rad,
        };
        self.history.push(point)?;
        let measurements = self.tracking.judge(shell.now, &self.history, &self.estimation);
        self.drain_tracking(shell);
        if self.insertion.is_none() && shell.is_running() {
            self.begin_if_ready(shell, feedback)?;
        }
        let Some(mut insertion) = self.insertion.take() else { return Ok(()) };
        let at = insertion.measured(feedback.measured);
        let commanded = insertion.commanded(feedback.commanded);
        self.progress.insertion_meas_mm = at.insertion_mm;
        shell.record(Record::Stage(Feedback { measured: at, commanded, ..*feedback }));
        let mut inserted = Ok(());
        if shell.is_running() {
            measurements.into_iter().for_each(|measurement| {
                self.estimation.add_to_batch(&measurement);
                self.pending.extend(insertion.take_measurement(measurement));
            });
            inserted = self.insert(shell, feedback, at, &mut insertion);
        }
        self.insertion = Some(insertion);
        inserted
    }

    /// Starts the insertion once the stage is enabled and the tip is seen at a good start.
    fn begin_if_ready(&mut self, shell: &mut Shell, feedback: &Feedback) -> Result<(), String> {
        let is_on = matches!(shell.power(), Power::On(_));
        if !is_on || !self.accepts_start(shell)? {
            return Ok(());
        }
        let (measured, held) = (feedback.measured, feedback.commanded);
        // The axes may have been moved by hand since they were located.
        self.check_depth(shell, held)?;
        let mut insertion = Insertion::new(self.config.insertion, measured, held);
        match &self.hold {
            None => shell.enter(State::Inserting),
            Some(_) => {
                insertion.profile.hold(self.config.tracker.hold.braking_mm_per_s2);
                shell.enter(State::HeldByOperator);
            }
        }
        self.insertion = Some(insertion);
        Ok(())
    }

    /// Corrects the observers with what was measured until `time`. An error is the reason to stop the run.
    fn correct(&mut self, time: Time) -> Result<(), String> {
        let pending = std::mem::take(&mut self.pending);
        for same_time in pending.chunk_by(|a, b| a.acquisition_time == b.acquisition_time) {
            // Positions that are received at once are dated the same. The last is the newest.
            if let Some(newest) = same_time.last() {
                self.estimation.take(newest, &self.history)?;
            }
        }
        self.estimation.predict_to(time - self.config.tracker.hold.after, &self.history)
    }

    /// Handles one SYNC of the insertion: makes the checks, takes the step that is due, and sends the next set-point.
    /// An error is the reason to stop the run.
    fn insert(
        &mut self,
        shell: &mut Shell,
        feedback: &Feedback,
        at: SetPoint,
        insertion: &mut Insertion,
    ) -> Result<(), String> {
        self.catch_up_to = Some(feedback.time);
        self.tracking.check_stream(at.insertion_mm)?;
        self.watch_tip(shell, feedback.time, at.insertion_mm, insertion)?;
        insertion.check_arrival(feedback.time, at.insertion_mm)?;
        if let Some(due) = insertion.take_due_step(feedback.time, at.insertion_mm) {
            self.correct(feedback.time)?;
            self.step(shell, feedback.time, at, insertion, &due)?;
        }
        match shell.is_running() {
            true => shell.command(insertion.advance(self.config.stage.bus.sync_period())),
            false => Ok(()),
        }
    }

    /// Takes one step: observe, decide, record, and steer on. After the last step the insertion is complete.
    /// An error is the reason to stop the run.
    fn step(
        &mut self,
        shell: &mut Shell,
        time: Time,
        at: SetPoint,
        insertion: &mut Insertion,
        due: &DueStep,
    ) -> Result<(), String> {
        let history = &self.history;
        if let Some(measurement) = &due.measurement {
            self.estimation.take(measurement, history)?;
        }
        let target_mm = self.target.as_ref().and_then(TargetTracking::position_mm);
        target_mm.into_iter().for_each(|target_mm| self.estimation.steering.set_target(target_mm));
        let corrections = self.estimation.corrections.take();
        let newest = corrections.map(|corrections| corrections.newest);
        let decision = self.estimation.decide(time, history, due.is_last)?;
        let Decision { estimate, rotation_cmd_rad_per_mm, command_saturated, .. } = decision;
        let refused = decision.refused.clone();
        let path = decision.approach.as_ref().and_then(|approach| approach.path.as_ref());
        // The path begins at the estimate, which was predicted along the history.
        let estimated_mm = history.newest().map(|point| insertion.depth_mm(point.insertion_mm));
        let end_mm = estimated_mm.zip(path).map(|(from_mm, path)| from_mm + path.length_mm());
        let observer = match &estimate {
            None => State::NoEstimate,
            Some(estimate) if !estimate.is_roll_known() => State::RollUnknown,
            Some(_) => State::Estimating,
        };
        shell.enter_at(time, observer);
        self.progress.x_mm = estimate.map(|estimate| estimate.x_pb.translation.x);
        let rolled = estimate.filter(Estimate::is_roll_known);
        self.progress.roll_rad = rolled.map(|estimate| coordinates(&estimate.x_pb)[5]);
        if let Some(warning) = decision.warning.clone() {
            shell.report_at(time, Lane::Observer, Severity::Warning, warning);
        }
        let control = if command_saturated { State::Saturated } else { State::Steering };
        shell.enter_at(time, control);
        shell.record(Record::Step(Box::new(StepRecord {
            step: due.step,
            time,
            insertion_meas_mm: at.insertion_mm,
            rotation_meas_rad: at.rotation_rad,
            tip_positions: corrections.map_or(0, |corrections| corrections.positions),
            tip_meas_mm: newest.map(|m| m.tip_meas.mm()),
            tip_meas_insertion_mm: newest.map(|m| insertion.depth_mm(m.stage_insertion_meas_mm)),
            tip_meas_age_s: newest.map(|m| time.seconds_after(m.acquisition_time)),
            innovation_mm: corrections.and_then(|corrections| corrections.innovation_mm),
            decision,
        })));
        if let Some(reason) = refused {
            return Err(reason);
        }
        let Some(rotation_rad_per_mm) = rotation_cmd_rad_per_mm else {
            // A target that comes toward the tip is reached at speed: the needle brakes first.
            match due.is_last || insertion.profile.is_at_rest() {
                true => shell.complete(),
                false => self.progress.depth_mm = insertion.end_now(),
            }
            return Ok(());
        };
        if let Some(end_mm) = end_mm {
            self.progress.depth_mm = insertion.end_at(end_mm);
        }
        insertion.steer(rotation_rad_per_mm);
        Ok(())
    }

    /// True while the tip is seen, and the target if that is a tool of its own.
    fn is_seen(&self, now: Time) -> bool {
        let sees_target =
            self.target.as_ref().is_none_or(|target| target.hold_reason(now).is_none());
        self.tracking.is_seen(now) && sees_target
    }

    /// When the run gives up waiting for a tip to start from: `tracker.timeout_s` after the last position of tip
    /// and target, or, once the run waits for nothing else, that long after this wait began, even if positions
    /// are still seen. A start in doubt is decided first.
    fn tip_due(&self, power: Power) -> Time {
        let tip = self.tracking.last_acquisition();
        let target = self.target.as_ref().map_or(tip, TargetTracking::last_acquisition);
        let last_seen = tip.min(target).unwrap_or(self.begun).max(self.begun);
        let waiting_since = match power {
            Power::Off | Power::Enabling => last_seen,
            // The start is accepted; power comes on, or the insertion begins, at the next SYNC.
            Power::Awaited(_) | Power::On(_) if matches!(self.start, Start::Accepted(_)) => {
                last_seen
            }
            Power::Awaited(since) | Power::On(since) => since.min(last_seen),
        };
        self.start.decided_by(waiting_since + self.config.tracker.timeout)
    }

    /// Why there is no tip to start from.
    fn explain_no_tip(&self, now: Time) -> String {
        let limit_s = self.config.tracker.timeout.as_secs_f64();
        let target = self.target.as_ref().filter(|_| self.tracking.is_seen(now));
        let text = match target.and_then(|target| target.hold_reason(now)) {
            Some(HoldReason { what, why, .. }) => {
                format!("tracker: no target within {limit_s:.1} s; {what}; {why}")
            }
            None => {
                let fresh_s = self.config.tracker.hold.after.as_secs_f64();
                let seen = self
                    .tracking
                    .age_s(now)
                    .map(|age_s| format!("the last was {age_s:.2} s old (limit {fresh_s:.2}); "));
                let (seen, silence) = (seen.unwrap_or_default(), self.tracking.explain_silence());
                format!("tracker: no tip within {limit_s:.1} s; {seen}{silence}")
            }
        };
        clipped(&text, hold::MESSAGE_MAX).into_owned()
    }
}

impl Task for InsertTask {
    fn tip_age_max(&self) -> Option<Duration> {
        Some(self.config.tracker.hold.after)
    }

    fn begin(&mut self, shell: &mut Shell) {
        shell.enter(State::AwaitingTip);
    }

    /// The axes get power only while the tip is seen at a start from which the plane, or the target, can be
    /// reached.
    fn permits_power(&mut self, shell: &mut Shell) -> Result<bool, String> {
        self.accepts_start(shell)
    }

    /// A set-point between two steps does not depend on the observers. It is sent first, because correcting
    /// the observers takes far longer.
    fn catch_up(&mut self) -> Result<(), String> {
        let Some(time) = self.catch_up_to.take() else { return Ok(()) };
        self.correct(time)?;
        let after = self.config.tracker.hold.after;
        self.estimation.correct_watch(time - after / 2, time - after, &self.history)
    }

    fn take_stage_event(&mut self, shell: &mut Shell, event: &StageEvent) -> Result<(), String> {
        match event {
            StageEvent::Feedback(feedback) => self.take_feedback(shell, feedback),
            StageEvent::Located(at) => self.check_depth(shell, *at),
            _ => Ok(()),
        }
    }

    fn take_tracker_event(&mut self, shell: &mut Shell, event: Event) {
        let text = tracker_news(&event);
        self.tracking.note(shell.now, &event);
        match event {
            Event::Sample(sample) => match &mut self.target {
                Some(target) if target.is_own(&sample) => {
                    let inserted = self.insertion.as_ref();
                    let insertion_mm = inserted.map(|_| self.progress.insertion_meas_mm);
                    self.tracking.record_target(target.take(sample, insertion_mm));
                }
                _ => self.tracking.take(shell.now, sample, self.insertion.is_some()),
            },
            Event::Connected { .. } => {
                self.target.iter_mut().for_each(TargetTracking::reconnected);
            }
            _ => {}
        }
        self.drain_tracking(shell);
        if let Some((severity, text)) = text {
            shell.report(Lane::Tracker, severity, text);
        }
    }

    fn handle_timeout(&mut self, shell: &mut Shell) -> Result<(), String> {
        if !shell.is_running() {
            self.tracking.refuse_unpaired(shell.now);
            self.drain_tracking(shell);
            return Ok(());
        }
        let is_overdue = |this: &Self, shell: &Shell| {
            this.insertion.is_none() && shell.now >= this.tip_due(shell.power())
        };
        if is_overdue(self, shell) {
            // A start in doubt is decided first.
            self.accepts_start(shell)?;
        }
        if is_overdue(self, shell) { Err(self.explain_no_tip(shell.now)) } else { Ok(()) }
    }

    fn deadline(&self, shell: &Shell) -> Time {
        match self.insertion {
            None => self.tip_due(shell.power()),
            // Now, not at `catch_up_to`: that SYNC may be long past although the bench is not late.
            Some(_) => self.catch_up_to.map_or(Time::NEVER, |_| shell.now),
        }
    }

    fn end(&mut self, shell: &mut Shell) {
        self.tracking.close(shell.now);
        self.drain_tracking(shell);
    }

    fn take_operator(
        &mut self,
        shell: &mut Shell,
        command: OperatorCommand,
    ) -> Result<String, String> {
        match command {
            OperatorCommand::Hold => self.hold_for_operator(shell),
            OperatorCommand::Resume => self.resume(shell, None),
            OperatorCommand::Step { mm } => self.resume(shell, Some(mm)),
            OperatorCommand::Speed { mm_per_s } => {
                let insertion = self.insertion.as_mut().ok_or(hold::NOT_BEGUN)?;
                let before = insertion.profile.speed_max_mm_per_s;
                insertion.set_speed(mm_per_s)?;
                Ok(format!("{command}, was {before:.3}"))
            }
        }
    }

    fn progress(&self, now: Time) -> Progress {
        let (insertion, is_held) = (self.insertion.as_ref(), self.hold.is_some());
        Progress {
            speed_mm_per_s: insertion.map_or(0.0, |insertion| insertion.profile.speed_max_mm_per_s),
            remaining_s: insertion.filter(|_| !is_held).map(Insertion::remaining_s),
            tip_age_s: self.tracking.age_s(now),
            ..self.progress
        }
    }

    fn gate_counts(&self) -> GateCounts {
        self.tracking.counts.clone()
    }
}

/// How many SYNCs the history holds: those to which a measurement may refer, and a margin.
fn history_points(config: &SessionConfig) -> usize {
    // The handedness watch averages the positions of half of `hold_after` before it uses their mean.
    let span = config.tracker.hold.after * 2 + HISTORY_MARGIN;
    (span.as_nanos() / config.stage.bus.sync_period().as_nanos().max(1)) as usize + 2
}
