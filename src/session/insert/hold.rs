//! The insertion is held while the tip is not seen, in seconds and in millimetres, and as soon as the
//! stream contradicts the model.

use super::Insert;
use crate::session::config::Resume;
use crate::session::insertion::Insertion;
use crate::session::shell::Shell;
use crate::session::{Lane, Severity, State};
use crate::stage::SetPoint;
use crate::text::clipped;
use crate::units::Time;

/// A message about a tip that is not seen has at most this many characters.
pub(super) const MESSAGE_MAX: usize = 200;
/// What to look at when the stream contradicts the model.
const JUMP_ADVICE: &str = "check the tracker, and needle.radius_mm";

/// An insertion that is held: set-points brake to a standstill, and both axes stay enabled.
#[derive(Debug, Clone)]
pub(super) struct Hold {
    since: Time,
    /// How long and how far it had gone on blind, or how the stream contradicts the model.
    cause: String,
    /// Why the tip was not seen, or what to look at.
    why: String,
}

impl Insert {
    /// Holds the insertion when the tip has not been seen lately, and decides what becomes of a
    /// hold: with [`Resume::Automatic`] the insertion goes on once the tip is found again.
    ///
    /// # Errors
    /// The reason to stop for: with [`Resume::Stop`] as soon as the needle stands, and else after
    /// `tracker.hold_timeout_s`.
    pub(super) fn watch_tip(
        &mut self,
        shell: &mut Shell,
        now: Time,
        at: SetPoint,
        insertion: &mut Insertion,
    ) -> Result<(), String> {
        let cause = self.cause(now, at, insertion);
        let Some(hold) = &self.hold else {
            if let Some((cause, why)) = cause {
                let text = format!("{cause}; insertion held; {why}");
                let text = clipped(&text, MESSAGE_MAX).into_owned();
                insertion.hold(self.config.tracker.hold.braking_mm_per_s2);
                self.hold = Some(Hold { since: now, cause, why });
                shell.state_at(now, State::Holding);
                shell.event_at(now, Lane::Tracker, Severity::Warning, text);
            }
            return Ok(());
        };
        let tracker = &self.config.tracker;
        let is_standing = insertion.is_standing(at.insertion_mm);
        if tracker.hold.resume == Resume::Automatic
            && is_standing
            && cause.is_none()
            && self.tracking.is_held()
        {
            let held_s = now.seconds_after(hold.since);
            let text = format!("the tip is seen again; insertion goes on, held for {held_s:.2} s");
            insertion.release();
            self.hold = None;
            shell.state_at(now, State::Inserting);
            shell.event_at(now, Lane::Tracker, Severity::Info, text);
            return Ok(());
        }
        let end = if tracker.hold.resume == Resume::Stop && is_standing {
            "held and stopped".to_owned()
        } else if now.since(hold.since) >= tracker.hold.timeout {
            format!("held for {:.1} s and stopped", tracker.hold.timeout.as_secs_f64())
        } else {
            return Ok(());
        };
        let text = format!("tracker: {}; {end}; {}", hold.cause, hold.why);
        Err(clipped(&text, MESSAGE_MAX).into_owned())
    }

    /// What calls for a hold, and why it came to that or what to look at.
    fn cause(&self, now: Time, at: SetPoint, insertion: &Insertion) -> Option<(String, String)> {
        if let Some(jump) = self.tracking.jump() {
            return Some((jump.to_owned(), JUMP_ADVICE.to_owned()));
        }
        let blindness = self.blindness(now, at, insertion)?;
        Some((blindness, self.tracking.explain_silence()))
    }

    /// How long and how far the insertion has gone on blind, where that calls for a hold: by age,
    /// or because the needle would otherwise not stand before the limit.
    fn blindness(&self, now: Time, at: SetPoint, insertion: &Insertion) -> Option<String> {
        let tracker = &self.config.tracker;
        let seen_at_mm = self.tracking.seen_at_mm().unwrap_or(f64::NEG_INFINITY);
        let seen_at = SetPoint { insertion_mm: seen_at_mm, rotation_rad: 0.0 };
        let seen_at_mm = insertion.measured(seen_at).insertion_mm.max(0.0);
        let stands_at_mm =
            insertion.held_at_mm(tracker.hold.braking_mm_per_s2, self.config.stage.sync_period);
        let (age_s, limit_s) =
            (self.tracking.age_s(now).unwrap_or(f64::INFINITY), tracker.hold.after.as_secs_f64());
        let (blind_mm, braking_mm) = (at.insertion_mm - seen_at_mm, stands_at_mm - at.insertion_mm);
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
