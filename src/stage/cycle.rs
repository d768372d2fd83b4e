//! The SYNC cycle: sends set-points, takes positions, enables and stops the axes.

use super::drive::Drive;
use super::machine::Phase;
use super::supervision::refused_to_switch_on;
use super::{Axis, Feedback, PerAxis, SetPoint, Stage, StageEvent, StageProgress};
use crate::canopen::cia402::{Controlword, DriveState, Statusword, object};
use crate::canopen::nmt::NmtState;
use crate::canopen::sdo::codec::ServerFrame;
use crate::canopen::sdo::{SdoReply, SdoRequest};
use crate::canopen::sync::sync_frame;
use crate::canopen::{Frame, ObjectAddress};
use crate::units::Time;
use std::time::Duration;

/// Interval at which a drive that does not obey is commanded again by SDO.
const REPEAT_PERIOD: Duration = Duration::from_millis(100);
/// A position becomes the first target of an axis if it differs from the one before by at most this part of the
/// following-error window, or by this many counts: otherwise one of the two readings is wrong, or the axis moves.
const STEADY_PART: f64 = 0.02;
const STEADY_COUNTS: f64 = 2.0;
/// A drive that does not answer the first SYNC before the next is due may have started late, or may answer late. The
/// stage sends it another SYNC after this time, when the answers to earlier SYNCs must have come.
const DRAIN: Duration = Duration::from_millis(250);
/// Minimum interval between two SDO reads of a drive that sends no TPDO.
const READ_PERIOD: Duration = Duration::from_millis(30);

/// The last SDO read of a drive that is being stopped.
#[derive(Debug, Clone, Copy)]
pub(super) struct Reading {
    pub(super) object: ObjectAddress,
    pub(super) sent: Time,
    pub(super) is_answered: bool,
}

impl Reading {
    /// The state at the beginning of a stop: the statusword is read next.
    pub(super) fn begun(now: Time) -> Self {
        Reading { object: object::POSITION_ACTUAL, sent: now, is_answered: true }
    }
}

impl Stage {
    /// Checks the answers to the last SYNC, then sends the RPDOs that were not sent ahead, and the next SYNC.
    pub(super) fn cycle(&mut self, now: Time) {
        self.check_unexplained_faults(now);
        self.judge_feedback(now);
        match self.phase {
            Phase::Standby { give_up, located } => {
                if !self.stand_by(now, give_up, located) {
                    return;
                }
            }
            Phase::Enabling { give_up } => self.enable(now, give_up),
            Phase::Ready | Phase::Homing(_) => {
                self.drives.insertion.advance_target();
                self.drives.rotation.advance_target();
                self.check_homing_timeout(now);
            }
            Phase::Stopping { quick, give_up } => self.stop(now, quick, give_up),
            Phase::Disabling { quick, standing, give_up } => {
                if self.drives.all(Drive::is_off) || quick && now >= give_up {
                    return self.finish(standing);
                }
                if now >= give_up {
                    let trouble = "the drive still has power";
                    self.fail_orderly_end(now, Drive::is_off, trouble, "shutdown");
                }
                self.repeat_by_sdo(now, |drive| !drive.is_off());
            }
            Phase::Listening { .. } | Phase::BringUp | Phase::Stopped => return,
        }
        for axis in Axis::BOTH {
            self.read_by_sdo(now, axis);
            if let Some(rpdo) = self.drives[axis].rpdo_due() {
                self.send(rpdo);
            }
        }
        self.send(sync_frame());
        self.sync_time = now;
        self.sync_count += 1;
        for axis in Axis::BOTH {
            self.drives[axis].answers.begin(self.sync_count);
        }
    }

    /// Takes both answers to this SYNC, once both have come. The stage is ready only when the heartbeats of
    /// both drives say Operational, in which a drive takes PDOs.
    pub(super) fn handle_feedback(&mut self, now: Time) {
        if matches!(self.phase, Phase::Enabling { .. })
            && self.drives.all(|drive| drive.is_armed() && drive.is_enabled())
            && self.monitors.all(|monitor| monitor.state() == Some(NmtState::Operational))
        {
            self.phase = Phase::Ready;
            self.emit(StageEvent::Ready);
            for axis in Axis::BOTH {
                for flag in self.drives[axis].flags_not_shown() {
                    self.emit(StageEvent::NotShown(axis, flag));
                }
            }
        }
        if let Phase::Homing(homing) = self.phase {
            self.watch_homing(now, homing);
        }
        if matches!(self.phase, Phase::Standby { .. } | Phase::Enabling { .. }) {
            return;
        }
        if self.drives.all(Drive::is_armed) {
            self.emit(StageEvent::Feedback(Feedback {
                time: self.sync_time,
                sync: self.sync_count,
                measured: self.positions(Drive::measured),
                commanded: self.positions(Drive::commanded),
            }));
        }
    }

    pub(super) fn positions(&self, position: impl Fn(&Drive) -> f64) -> SetPoint {
        let PerAxis { insertion, rotation } = &self.drives;
        SetPoint { insertion_mm: position(insertion), rotation_rad: position(rotation) }
    }

    /// Counts the SYNCs that were not answered by both drives, once both have answered one in time. Too many of them
    /// stop the stage, whether in a row or in all.
    fn judge_feedback(&mut self, now: Time) {
        let is_located = !matches!(self.phase, Phase::Standby { located: false, .. });
        let missed_max = u32::from(self.config.bus.missed_feedback_max);
        for axis in Axis::BOTH {
            let may_be_silent = !is_located || self.may_leave_operational(axis);
            if let Some(fault) = self.drives[axis].answers.judge(missed_max, may_be_silent) {
                return self.fail(now, format!("{axis}: {fault}"));
            }
        }
        if !is_located {
            return;
        }
        let all_answered = self.drives.all(|drive| drive.answers.missed_in_a_row == 0);
        let missed = self.missed_in_a_row.saturating_add(1);
        self.missed_in_a_row = if all_answered { 0 } else { missed };
        self.counters.feedback_missed += u64::from(!all_answered);
        if self.missed_in_a_row > missed_max {
            let syncs = self.missed_in_a_row;
            // Name the drive that has missed more: the other may have missed only this SYNC.
            let PerAxis { insertion, rotation } = &self.drives;
            let is_rotation = rotation.answers.missed_in_a_row > insertion.answers.missed_in_a_row;
            let axis = if is_rotation { Axis::Rotation } else { Axis::Insertion };
            let fault = match self.drives[axis].answers.wrong_length {
                Some(bytes) => format!(
                    "TPDO1 of {bytes} bytes after {syncs} SYNCs in a row, 6 are mapped; does \
                     another node have the same ID, or another tool map it?"
                ),
                None => format!(
                    "no TPDO1 for {syncs} SYNCs in a row, check bus load, cable and the drive"
                ),
            };
            return self.fail_drive(now, axis, &fault);
        }
        for axis in Axis::BOTH {
            if let Some(fault) = self.drives[axis].answers.fault_of_unanswered(missed_max) {
                self.fail_drive(now, axis, &fault);
            }
        }
    }

    /// Reports where the axes stand, and begins to enable them once they may have power. Returns whether the next
    /// SYNC may be sent.
    fn stand_by(&mut self, now: Time, give_up: Time, located: bool) -> bool {
        if !located {
            let prompt = self.sync_time + self.config.bus.sync_period().mul_f64(1.5);
            if now >= prompt || !self.drives.all(|drive| drive.answers.fresh) {
                if now >= give_up {
                    self.fail_enabling(now);
                    return true;
                }
                for axis in Axis::BOTH {
                    self.drives[axis].answers.fresh = false;
                }
                return self.sync_count == 0 || now >= self.sync_time + self.drain_time();
            }
            self.phase = Phase::Standby { give_up, located: true };
            self.emit(StageEvent::Located(self.positions(Drive::commanded)));
        }
        if self.power_permitted {
            self.phase = Phase::Enabling { give_up: now + self.config.power.enable_timeout };
            self.emit(StageEvent::Progress(StageProgress::Enabling));
            // The drives are armed in a later cycle: until then the caller may refuse to go on from here.
            self.lead_to_enabled();
        }
        true
    }

    /// How long the stage waits for late answers before it sends another SYNC. If answers are later than this, so many
    /// SYNCs stay unanswered that it is a fault.
    fn drain_time(&self) -> Duration {
        let syncs = u32::from(self.config.bus.missed_feedback_max) + 2;
        let time = DRAIN.max(self.config.bus.sync_period() * syncs);
        time.min(self.config.power.enable_timeout / 2)
    }

    /// Fails because enabling has timed out. The fault names the first of these that is found: a drive that is not in
    /// NMT Operational, that was not heard, that answers late, that moves, that is not enabled, or that sends no
    /// heartbeat.
    fn fail_enabling(&mut self, now: Time) {
        let timeout_ms = self.config.power.enable_timeout.as_millis();
        let first = |fails: &dyn Fn(Axis) -> bool| Axis::BOTH.into_iter().find(|axis| fails(*axis));
        let other_state = Axis::BOTH.into_iter().find_map(|axis| {
            let state = self.monitors[axis].state()?;
            (state != NmtState::Operational).then_some((axis, state))
        });
        let fault = if let Some((axis, state)) = other_state {
            format!(
                "{axis}: NMT state {state} instead of operational {timeout_ms} ms after the start command, \
                 is there another master, or an error in its error register (0x1001)?"
            )
        } else if let Some(axis) = first(&|axis| self.drives[axis].statusword.is_none()) {
            format!(
                "{axis}: not in operation enabled within {timeout_ms} ms (no TPDO1 was heard), check \
                 cable and the drive"
            )
        } else if matches!(self.phase, Phase::Standby { located: false, .. }) {
            format!(
                "in {timeout_ms} ms the drives did not both answer one SYNC before the next was due ({} ms): \
                 their positions would be too old; what delays frames on the bus, or this bench?",
                self.config.bus.sync_ms
            )
        } else if let Some(axis) =
            first(&|axis| !self.drives[axis].is_armed() && !self.is_steady(axis))
        {
            format!(
                "{axis}: its position still changed from one SYNC to the next after {timeout_ms} ms without a \
                 target; does the axis move, or is its encoder faulty?"
            )
        } else if let Some(axis) = first(&|axis| !self.drives[axis].is_enabled()) {
            let statusword = self.drives[axis].statusword.unwrap_or_default();
            format!(
                "{axis}: not in operation enabled within {timeout_ms} ms (statusword {statusword}), \
                 check power stage, enable input and brake"
            )
        } else {
            match first(&|axis| self.monitors[axis].state().is_none()) {
                Some(axis) => format!(
                    "{axis}: enabled, but no heartbeat within {timeout_ms} ms, is can.heartbeat_ms longer?"
                ),
                None => format!(
                    "both drives were enabled only as {timeout_ms} ms ended; raise \
                     stage.enable_timeout_s"
                ),
            }
        };
        self.fail(now, fault);
    }

    /// Leads both drives to Operation Enabled, the last step together.
    fn enable(&mut self, now: Time, give_up: Time) {
        if now >= give_up {
            return self.fail_enabling(now);
        }
        for axis in Axis::BOTH {
            if let Some(statusword) =
                self.drives[axis].count_transition(self.config.power.state_transition_timeout)
            {
                let fault = refused_to_switch_on(statusword);
                return self.fail(now, format!("{axis}: {fault}"));
            }
        }
        let both_on = self.drives.all(|drive| {
            matches!(drive.state(), Some(DriveState::SwitchedOn | DriveState::OperationEnabled))
        });
        let is_steady = self.drives.all(|drive| drive.answers.fresh)
            && Axis::BOTH.into_iter().all(|axis| self.is_steady(axis));
        self.before_power_counts = PerAxis::from_fn(|axis| self.drives[axis].commanded.counts);
        if both_on && is_steady && !self.drives.all(Drive::is_armed) {
            for axis in Axis::BOTH {
                if let Err(limit) = self.drives[axis].arm() {
                    let fault = format!(
                        "cannot start: the axis stands outside its limits: {limit}; jog it back, or \
                         correct its limits or zero"
                    );
                    return self.fail(now, fault);
                }
            }
        }
        self.lead_to_enabled();
    }

    /// True if the position of `axis`, which has no target yet, is that of the SYNC before.
    fn is_steady(&self, axis: Axis) -> bool {
        let counts = self.drives[axis].commanded.counts;
        self.is_same_place(axis, counts, self.before_power_counts[axis])
    }

    /// True if `axis`, which has its first target, is no longer there.
    pub(super) fn is_off_first_target(&self, axis: Axis) -> bool {
        let drive = &self.drives[axis];
        !self.is_same_place(axis, drive.commanded.counts, drive.position.counts())
    }

    fn is_same_place(&self, axis: Axis, a_counts: i64, b_counts: i64) -> bool {
        let config = self.config.axis(axis);
        let window = config.following_error_window() * config.scale(axis, 0).counts_per_unit();
        a_counts.abs_diff(b_counts) as f64 <= STEADY_COUNTS.max(STEADY_PART * window)
    }

    /// Sets the controlwords that lead both drives one step on.
    fn lead_to_enabled(&mut self) {
        let next = PerAxis::from_fn(|axis| self.drives[axis].next_controlword());
        let armed = self.drives.all(Drive::is_armed);
        for axis in Axis::BOTH {
            let enables = next[axis] == Controlword::ENABLE_OPERATION;
            self.drives[axis].controlword =
                if enables && !armed { Controlword::SWITCH_ON } else { next[axis] };
        }
    }

    /// Holds, or quick-stops, until both axes stand.
    fn stop(&mut self, now: Time, quick: bool, give_up: Time) {
        let standing =
            self.drives.all(|drive| drive.standstill.stands() && !(quick && drive.is_enabled()));
        if !quick && !standing && now >= give_up {
            let stands = |drive: &Drive| drive.standstill.stands();
            self.fail_orderly_end(now, stands, "not seen to stand", "its last target");
        } else if standing || now >= give_up {
            let give_up = now + self.config.power.stop_timeout;
            self.phase = Phase::Disabling { quick, standing, give_up };
            self.emit(StageEvent::Progress(StageProgress::Disabling));
            if quick {
                // A drive does not leave Quick Stop Active by Shutdown.
                self.set_controlwords(Controlword::DISABLE_VOLTAGE);
                self.send_controlwords(now, |_| true);
            } else {
                self.set_controlwords(Controlword::SHUTDOWN);
            }
        }
        self.repeat_by_sdo(now, Drive::is_enabled);
    }

    /// Fails because an orderly end has timed out: the stop timeout after its `last_step`, the first drive that is not
    /// `done` still has this `trouble`.
    fn fail_orderly_end(
        &mut self,
        now: Time,
        done: impl Fn(&Drive) -> bool,
        trouble: &str,
        last_step: &str,
    ) {
        let axis = if done(&self.drives.insertion) { Axis::Rotation } else { Axis::Insertion };
        let statusword = self.drives[axis].statusword.unwrap_or_default();
        let ms = self.config.power.stop_timeout.as_millis();
        let fault = format!(
            "{axis}: {trouble} {ms} ms after {last_step} (statusword {statusword}); if it does not stop now, \
             press the emergency stop"
        );
        self.fail(now, fault);
    }

    pub(super) fn begin_stop(&mut self, now: Time, quick: bool) {
        self.phase = Phase::Stopping { quick, give_up: now + self.config.power.stop_timeout };
        self.emit(StageEvent::Progress(StageProgress::Stopping));
        for axis in Axis::BOTH {
            self.drives[axis].begin_stop(now, self.sync_count, quick);
        }
    }

    /// Begins a quick stop in a phase in which SYNC runs, unless one is under way.
    pub(super) fn begin_quick_stop(&mut self, now: Time) {
        if !self.sync_runs() || self.is_quick_stopping() {
            return;
        }
        self.begin_stop(now, true);
        self.set_controlwords(Controlword::QUICK_STOP);
        // A set-point that was sent ahead would enable a drive again at the next SYNC, on which this RPDO1 is sent
        // once more.
        for axis in Axis::BOTH {
            self.send(self.drives[axis].rpdo_now());
        }
        self.send_controlwords(now, |_| true);
    }

    /// True during a quick stop, until power is off.
    pub(super) fn is_quick_stopping(&self) -> bool {
        matches!(
            self.phase,
            Phase::Stopping { quick: true, .. } | Phase::Disabling { quick: true, .. }
        )
    }

    /// In a quick stop, sends an enabled drive to Pre-operational, where it takes no RPDO1, and commands it by SDO
    /// alone. Set-points that are late on the bus could otherwise enable it again and again.
    pub(super) fn stop_by_sdo_alone(&mut self, axis: Axis) {
        let drive = &mut self.drives[axis];
        drive.sent_to_pre_operational = true;
        let (controlword, statusword) = (drive.controlword, drive.statusword.unwrap_or_default());
        self.emit(StageEvent::StopNotObeyed(axis, statusword));
        self.send_controlword(axis, controlword);
    }

    /// True if the drive may be in another NMT state than Operational, and send no TPDO1.
    pub(super) fn may_leave_operational(&self, axis: Axis) -> bool {
        self.has_noticed_silence(axis) || self.drives[axis].sent_to_pre_operational
    }

    /// While the stage stops, reads the statusword and the position of a drive that sends no TPDO, such as
    /// one that has left Operational: in turn, each after the answer to the other.
    fn read_by_sdo(&mut self, now: Time, axis: Axis) {
        if !self.is_ending() || self.drives[axis].answers.fresh {
            return;
        }
        let Reading { object, sent, is_answered } = self.drives[axis].reading;
        let answer_time = if is_answered { Duration::ZERO } else { self.config.bus.sdo_timeout() };
        let wait = answer_time.max(READ_PERIOD);
        let waited = now.since(sent);
        // Leave the drive time for a controlword sent just before: an SDO server takes one request at a time.
        let is_commanded = self.repeat_due == now + REPEAT_PERIOD;
        if waited < wait || is_commanded && waited < 2 * wait {
            return;
        }
        let object = match object {
            object::STATUSWORD => object::POSITION_ACTUAL,
            _ => object::STATUSWORD,
        };
        self.drives[axis].reading = Reading { object, sent: now, is_answered: false };
        self.send_sdo(axis, SdoRequest::Upload(object));
    }

    /// Takes a drive's reply to [`Stage::read_by_sdo`].
    pub(super) fn take_reading(&mut self, axis: Axis, frame: &Frame) {
        let Some(ServerFrame::Reply(object, SdoReply::Uploaded(value))) =
            ServerFrame::decode(frame.data())
        else {
            return;
        };
        let drive = &mut self.drives[axis];
        // A reply without a request may be another node's.
        if drive.reading.is_answered || drive.reading.object != object {
            return;
        }
        drive.reading.is_answered = true;
        if object == object::STATUSWORD {
            if let Some(word) = value.at_least(2) {
                drive.take_statusword(Statusword(word as u16), self.sync_count);
            }
        } else if let Some(counts) = value.at_least(4) {
            drive.take_position(counts as i32, self.sync_count);
        }
    }

    /// In a quick stop, commands the drives that `disobey` again, every [`REPEAT_PERIOD`].
    fn repeat_by_sdo(&mut self, now: Time, disobey: impl Fn(&Drive) -> bool) {
        if self.is_quick_stopping() && now >= self.repeat_due {
            self.send_controlwords(now, disobey);
        }
    }

    /// Sends each drive that `to` selects its controlword by SDO: a drive that has left Operational takes no PDOs.
    fn send_controlwords(&mut self, now: Time, to: impl Fn(&Drive) -> bool) {
        self.repeat_due = now + REPEAT_PERIOD;
        for axis in Axis::BOTH {
            let drive = &self.drives[axis];
            if to(drive) {
                self.send_controlword(axis, drive.controlword);
            }
        }
    }

    fn set_controlwords(&mut self, controlword: Controlword) {
        for axis in Axis::BOTH {
            self.drives[axis].controlword = controlword;
        }
    }
}
