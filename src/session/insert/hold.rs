//! Holds of the insertion: while the tip is not seen (limits in seconds and in millimetres), when the stream
//! contradicts the model, when the operator asks for it, and after a single step.

use super::InsertTask;
use crate::session::config::Resume;
use crate::session::insertion::Insertion;
use crate::session::shell::Shell;
use crate::session::tracking::{HoldReason, Jump};
use crate::session::{Lane, Severity, State};
use crate::text::clipped;
use crate::units::Time;
use std::time::Duration;

/// A message about a tip that is not seen has at most this many characters.
pub(super) const MESSAGE_MAX: usize = 200;
/// Advice to the operator when the stream contradicts the model.
const JUMP_ADVICE: &str = "check the tracker, needle.radius_mm, tip_offset_mm";
/// Advice to the operator when the tip does not move: the needle may be loose, or the axes exchanged.
const FROZEN_ADVICE: &str = "check the tracker, the needle's clamp, and which drive is which";
/// Advice to the operator when the tip travels less far than the needle is inserted.
const BEHIND_ADVICE: &str = "buckled shaft or slipping clamp? check the tracker";
/// Why a command is refused before the insertion.
pub(super) const NOT_BEGUN: &str = "the insertion has not begun";
/// Why the operator can neither prolong nor end a hold by the tracker with `tracker.resume = "stop"`.
const RUN_WILL_END: &str =
    "the tracker holds it, and the run ends once the needle stands (tracker.resume)";

/// A hold of the insertion: set-points brake to a standstill, and both axes stay enabled.
#[derive(Debug, Clone)]
pub(super) struct Hold {
    since: Time,
    /// The time that earlier holds by the tracker have already used of `tracker.hold_timeout_s`.
    before: Duration,
    by: HeldBy,
}

/// The last hold by the tracker that ended by itself. Its time, which includes that of the holds before it, counts
/// towards `tracker.hold_timeout_s` of the next hold, less the time for which the insertion went on in between. So
/// the run ends if the stream causes holds for longer than it is believed.
#[derive(Debug, Clone, Copy)]
pub(super) struct EndedHold {
    at: Time,
    lasted: Duration,
}

/// The cause of a hold. A hold by the operator or by a step lasts until the operator ends it.
#[derive(Debug, Clone)]
enum HeldBy {
    Tracker {
        /// How long and how far the insertion went on blind, or how the stream contradicts the model; and why the
        /// tip was not seen, or what the operator should check.
        reason: HoldReason,
        /// The hold interrupted a single step, which never goes on by itself.
        in_step: bool,
        /// The last message to the operator about this hold said that the insertion may go on.
        may_go_on_reported: bool,
    },
    Operator,
    Step,
}

impl InsertTask {
    /// Holds the insertion when the tip has not been seen lately, and ends a hold by the tracker:
    /// with [`Resume::Automatic`] the insertion goes on once the tip is found again.
    ///
    /// # Errors
    /// The reason to stop the run: with [`Resume::Stop`] as soon as the needle stands, otherwise after
    /// `tracker.hold_timeout_s`.
    pub(super) fn watch_tip(
        &mut self,
        shell: &mut Shell,
        now: Time,
        insertion_meas_mm: f64,
        insertion: &mut Insertion,
    ) -> Result<(), String> {
        let found = self.hold_reason(now, insertion_meas_mm, insertion);
        let Some(hold) = &self.hold else {
            if let Some(reason) = found {
                let text = format!("{}; insertion held; {}", reason.what, reason.why);
                let text = clipped(&text, MESSAGE_MAX).into_owned();
                insertion.profile.hold(self.config.tracker.hold.braking_mm_per_s2);
                let in_step = insertion.profile.is_stepping();
                let by = HeldBy::Tracker { reason, in_step, may_go_on_reported: false };
                let before = self.ended_hold.map_or(Duration::ZERO, |ended| {
                    ended.lasted.saturating_sub(now.since(ended.at))
                });
                self.hold = Some(Hold { since: now, before, by });
                shell.enter_at(now, State::Holding);
                shell.report_at(now, Lane::Tracker, Severity::Warning, text);
            } else if insertion.profile.has_finished_step() {
                self.hold_after_step(shell, now, insertion);
            }
            return Ok(());
        };
        let HeldBy::Tracker { reason: first, in_step, may_go_on_reported } = &hold.by else {
            return Ok(());
        };
        let lost = first.of;
        let tracker = &self.config.tracker;
        let is_standing = insertion.is_standing(insertion_meas_mm);
        let may_go_on = is_standing && found.is_none() && self.is_seen(now);
        if tracker.hold.resume == Resume::Operator && may_go_on != *may_go_on_reported {
            let held = now.since(hold.since) + hold.before;
            let left_s = tracker.hold.timeout.saturating_sub(held).as_secs_f64();
            let text = match may_go_on {
                true => format!(
                    "the {lost} is seen again; resume within {left_s:.1} s, or the run ends"
                ),
                false => format!("the {lost} is lost again; {left_s:.1} s are left"),
            };
            shell.report_at(now, Lane::Tracker, Severity::Info, text);
            if let Some(Hold { by: HeldBy::Tracker { may_go_on_reported, .. }, .. }) =
                &mut self.hold
            {
                *may_go_on_reported = may_go_on;
            }
            return Ok(());
        }
        if may_go_on && tracker.hold.resume == Resume::Automatic {
            if *in_step {
                self.hold_after_step(shell, now, insertion);
                return Ok(());
            }
            let held = now.since(hold.since);
            let held_s = held.as_secs_f64();
            let text =
                format!("the {lost} is seen again; insertion goes on, held for {held_s:.2} s");
            self.ended_hold = Some(EndedHold { at: now, lasted: held + hold.before });
            insertion.profile.release(None);
            self.hold = None;
            shell.enter_at(now, State::Inserting);
            shell.report_at(now, Lane::Tracker, Severity::Info, text);
            return Ok(());
        }
        let is_over = is_standing || insertion.must_stand(now.since(hold.since));
        let (end, reason) = if tracker.hold.resume == Resume::Stop && is_over {
            ("held and stopped".to_owned(), first)
        } else if now.since(hold.since) + hold.before >= tracker.hold.timeout {
            let in_a_row = if hold.before.is_zero() { "" } else { " in a row" };
            let timeout_s = tracker.hold.timeout.as_secs_f64();
            let end = format!("held for {timeout_s:.1} s{in_a_row} and stopped");
            // The first reason may no longer apply, and another may hold the insertion now.
            match (&found, insertion.explain_miss(insertion_meas_mm)) {
                (None, Some(off)) if self.is_seen(now) => {
                    return Err(format!("tracker: the {lost} is seen again, but {off}; {end}"));
                }
                (None, None) if tracker.hold.resume == Resume::Operator && self.is_seen(now) => {
                    let nobody = "but the operator did not resume (tracker.hold_timeout_s)";
                    return Err(format!("tracker: the {lost} is seen again, {nobody}; {end}"));
                }
                _ => (end, found.as_ref().unwrap_or(first)),
            }
        } else {
            return Ok(());
        };
        let text = format!("tracker: {}; {end}; {}", reason.what, reason.why);
        Err(clipped(&text, MESSAGE_MAX).into_owned())
    }

    /// Holds the insertion after a single step, whether it was completed or interrupted.
    fn hold_after_step(&mut self, shell: &mut Shell, now: Time, insertion: &mut Insertion) {
        insertion.profile.hold(self.config.tracker.hold.braking_mm_per_s2);
        self.hold = Some(Hold { since: now, before: Duration::ZERO, by: HeldBy::Step });
        shell.enter_at(now, State::HeldAfterStep);
        let text = format!("the step ends; held, {:.2} mm left", insertion.remaining_mm());
        shell.report_at(now, Lane::Session, Severity::Info, text);
    }

    /// Holds the insertion. If it has not begun, it will begin held.
    pub(super) fn hold_for_operator(&mut self, shell: &mut Shell) -> Result<String, String> {
        match self.hold.as_ref().map(|hold| &hold.by) {
            Some(HeldBy::Operator) => return Ok("hold: it is held already".to_owned()),
            Some(HeldBy::Tracker { .. }) if self.config.tracker.hold.resume == Resume::Stop => {
                return Err(RUN_WILL_END.to_owned());
            }
            _ => {}
        }
        self.hold = Some(Hold { since: shell.now, before: Duration::ZERO, by: HeldBy::Operator });
        let Some(insertion) = &mut self.insertion else {
            return Ok("hold: the insertion will begin held".to_owned());
        };
        insertion.profile.hold(self.config.tracker.hold.braking_mm_per_s2);
        shell.enter(State::HeldByOperator);
        Ok(format!("hold at {:.2} mm", self.progress.insertion_meas_mm))
    }

    /// Ends a hold at the operator's command: the insertion goes on, or makes a single step of `step_mm`.
    /// Refused unless the needle stands and nothing would cause another hold at once.
    pub(super) fn resume(
        &mut self,
        shell: &mut Shell,
        step_mm: Option<f64>,
    ) -> Result<String, String> {
        let hold = self.hold.as_ref().ok_or("the insertion is not held; hold it first")?;
        match (&hold.by, self.config.tracker.hold.resume) {
            (HeldBy::Tracker { .. }, Resume::Stop) => return Err(RUN_WILL_END.to_owned()),
            (HeldBy::Tracker { reason, .. }, Resume::Automatic) => {
                return Err(format!("the tracker holds it, until the {} is seen again", reason.of));
            }
            _ => {}
        }
        let held_s = shell.now.seconds_after(hold.since);
        if !self.tracking.is_seen(shell.now) {
            let limit_s = self.config.tracker.hold.after.as_secs_f64();
            let last = match self.tracking.age_s(shell.now) {
                Some(_) if self.tracking.is_fresh(shell.now) => {
                    "the tip is not found yet".to_owned()
                }
                Some(age_s) => format!("the last tip is {age_s:.2} s old (limit {limit_s:.2})"),
                None => "no tip was accepted yet".to_owned(),
            };
            let text = format!("{last}; {}", self.tracking.explain_silence());
            return Err(clipped(&text, MESSAGE_MAX).into_owned());
        }
        let Some(insertion) = &self.insertion else {
            if step_mm.is_some() {
                return Err(NOT_BEGUN.to_owned());
            }
            self.hold = None;
            return Ok("resume: the insertion will begin by itself".to_owned());
        };
        let insertion_mm = self.progress.insertion_meas_mm;
        if !insertion.is_standing(insertion_mm) {
            return Err(match insertion.explain_miss(insertion_mm) {
                Some(off) => format!("{off}; try again once it is there"),
                None => "the needle is still braking; try again once it stands".to_owned(),
            });
        }
        if let Some(HoldReason { what, why, .. }) =
            self.hold_reason(shell.now, insertion_mm, insertion)
        {
            return Err(clipped(&format!("{what}; {why}"), MESSAGE_MAX).into_owned());
        }
        let remaining_mm = insertion.remaining_mm();
        // Many steps accumulate rounding errors; the insertion still ends exactly at its depth.
        if step_mm.is_some_and(|mm| !(mm > 0.0 && mm <= remaining_mm + 5e-4)) {
            return Err(format!("allowed: over 0 and up to the {remaining_mm:.3} mm left"));
        }
        self.hold = None;
        if let Some(insertion) = &mut self.insertion {
            insertion.profile.release(step_mm);
        }
        shell.enter(if step_mm.is_some() { State::Stepping } else { State::Inserting });
        let what = step_mm.map_or("resume".to_owned(), |mm| format!("step of {mm} mm"));
        Ok(format!("{what} at {insertion_mm:.2} mm, held for {held_s:.2} s"))
    }

    /// Why the insertion must be held; `None` if nothing calls for a hold.
    fn hold_reason(
        &self,
        now: Time,
        insertion_meas_mm: f64,
        insertion: &Insertion,
    ) -> Option<HoldReason> {
        let of = "tip";
        if let Some(jump) = &self.tracking.jump {
            let why = match jump {
                Jump { is_frozen: true, .. } => FROZEN_ADVICE,
                Jump { is_behind: true, .. } => BEHIND_ADVICE,
                Jump { .. } => JUMP_ADVICE,
            };
            return Some(HoldReason { of, what: jump.what.clone(), why: why.to_owned() });
        }
        if let Some(what) = self.blindness(now, insertion_meas_mm, insertion) {
            return Some(HoldReason { of, what, why: self.tracking.explain_silence() });
        }
        self.target.as_ref()?.hold_reason(now)
    }

    /// How long and how far the insertion has gone on blind, if it must be held for that: the tip is too old,
    /// or the needle would otherwise pass the limit in millimetres before it stands.
    fn blindness(
        &self,
        now: Time,
        insertion_meas_mm: f64,
        insertion: &Insertion,
    ) -> Option<String> {
        let tracker = &self.config.tracker;
        let seen_at_mm = self.tracking.track.last_believed().and_then(|fix| fix.insertion_mm);
        let seen_at_mm = seen_at_mm.map_or(0.0, |mm| insertion.depth_mm(mm).max(0.0));
        let stands_at_mm = insertion
            .profile
            .hold_depth_mm(tracker.hold.braking_mm_per_s2, self.config.stage.bus.sync_period());
        let (age_s, limit_s) =
            (self.tracking.age_s(now).unwrap_or(f64::INFINITY), tracker.hold.after.as_secs_f64());
        let (blind_mm, braking_mm) =
            (insertion_meas_mm - seen_at_mm, stands_at_mm - insertion_meas_mm);
        let is_blind = age_s > limit_s || blind_mm + braking_mm > tracker.hold.after_mm;
        is_blind.then(|| {
            format!(
                "last tip {age_s:.2} s old (limit {limit_s:.2}), {blind_mm:.2} mm blind + \
                 {braking_mm:.2} to brake (limit {:.2})",
                tracker.hold.after_mm
            )
        })
    }
}
