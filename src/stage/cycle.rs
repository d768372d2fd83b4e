//! The SYNC cycle: set-points out, positions in, and the way to standstill.

use super::drive::Drive;
use super::machine::Phase;
use super::{Axis, Feedback, PerAxis, Progress, SetPoint, Stage, StageEvent};
use crate::canopen::Frame;
use crate::canopen::cia402::{Controlword, DriveState, Statusword, object};
use crate::canopen::nmt::NmtState;
use crate::canopen::sdo::codec::ServerFrame;
use crate::canopen::sdo::{SdoReply, SdoRequest};
use crate::units::Time;
use std::time::Duration;

/// Interval at which a drive that does not obey is commanded again by SDO.
const REPEAT_PERIOD: Duration = Duration::from_millis(100);
/// SYNCs between two looks by SDO at an object of a drive that sends no TPDO.
const LOOK_SYNCS: u64 = 10;

impl Stage {
    /// One SYNC: judges the last, then sends the RPDOs that were not sent ahead, and `sync`.
    pub(super) fn cycle(&mut self, now: Time, sync: Frame) {
        self.judge_feedback(now);
        match self.phase {
            Phase::Standby { give_up, located } => self.stand_by(now, give_up, located),
            Phase::Enabling { give_up } => self.enable(now, give_up),
            Phase::Ready | Phase::Homing(_) => {
                self.drives.insertion.advance_target();
                self.drives.rotation.advance_target();
                self.check_home_in_time(now);
            }
            Phase::Stopping { quick, give_up } => self.stop(now, quick, give_up),
            Phase::Disabling { quick, standing, give_up } => {
                if self.drives.all(|drive| drive.is_off()) || quick && now >= give_up {
                    return self.finish(standing);
                }
                if now >= give_up {
                    self.fail_orderly_end(
                        now,
                        |drive| !drive.is_off(),
                        "the drive still has power",
                        "shutdown",
                    );
                }
                self.repeat_by_sdo(now, |drive| !drive.is_off());
            }
            Phase::Listening { .. } | Phase::BringUp | Phase::Stopped => return,
        }
        for axis in Axis::BOTH {
            self.look_by_sdo(axis);
            if let Some(rpdo) = self.drives[axis].rpdo_due() {
                self.send(rpdo);
            }
            self.drives[axis].fresh = false;
        }
        self.send(sync);
        self.sync_time = now;
        self.sync_count += 1;
    }

    /// Both positions of this SYNC are in. Nothing moves before both drives' heartbeats
    /// were heard, and say that PDOs are taken.
    pub(super) fn window_complete(&mut self, now: Time) {
        let enabled = |state| state == Some(DriveState::OperationEnabled);
        if matches!(self.phase, Phase::Enabling { .. })
            && self.drives.all(|drive| drive.is_armed() && enabled(drive.state()))
            && self.monitors.all(|monitor| monitor.state == Some(NmtState::Operational))
        {
            self.phase = Phase::Ready;
            self.tell(StageEvent::Ready);
            for axis in Axis::BOTH {
                for flag in self.drives[axis].flags_not_shown() {
                    self.tell(StageEvent::NotShown(axis, flag));
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
            self.tell(StageEvent::Feedback(Feedback {
                time: self.sync_time,
                sync: self.sync_count,
                measured: self.both(Drive::measured),
                commanded: self.both(Drive::commanded),
            }));
        }
    }

    pub(super) fn both(&self, position: impl Fn(&Drive) -> f64) -> SetPoint {
        let PerAxis { insertion, rotation } = &self.drives;
        SetPoint { insertion_mm: position(insertion), rotation_rad: position(rotation) }
    }

    /// Counts SYNCs without both positions, once both drives have been heard.
    fn judge_feedback(&mut self, now: Time) {
        if !self.both_heard() {
            return;
        }
        let missed_max = u32::from(self.config.bus.missed_feedback_max);
        for axis in Axis::BOTH {
            let drive = &mut self.drives[axis];
            let missed = drive.missed_in_a_row.saturating_add(1);
            drive.missed_in_a_row = if drive.fresh { 0 } else { missed };
            if let Some((syncs, frame)) = drive.conflicts_in_a_row()
                && syncs > missed_max
            {
                let fault = format!(
                    "{axis}: two TPDO1 that differ after each of {syncs} SYNCs in a row, the second \
                     {frame}; does another node have the same ID, or does the drive answer late?"
                );
                return self.fail(now, fault);
            }
        }
        if self.drives.all(|drive| drive.fresh) {
            self.missed_in_a_row = 0;
            return;
        }
        self.missed_in_a_row = self.missed_in_a_row.saturating_add(1);
        self.counters.feedback_missed += 1;
        if self.missed_in_a_row > missed_max {
            let syncs = self.missed_in_a_row;
            // The other may merely be late this time.
            let PerAxis { insertion, rotation } = &self.drives;
            let axis = match rotation.missed_in_a_row > insertion.missed_in_a_row {
                true => Axis::Rotation,
                false => Axis::Insertion,
            };
            let fault = format!(
                "{axis}: no TPDO1 for {syncs} SYNCs in a row, check bus load, cable and the drive"
            );
            self.fail(now, fault);
        }
    }

    pub(super) fn both_heard(&self) -> bool {
        self.drives.all(|drive| drive.statusword.is_some())
    }

    /// Tells where the axes stand, and begins to enable them once they may have power.
    fn stand_by(&mut self, now: Time, give_up: Time, located: bool) {
        if !self.both_heard() {
            if now >= give_up {
                self.fail_enabling(now, |drive| drive.statusword.is_none());
            }
            return;
        }
        if !located {
            self.phase = Phase::Standby { give_up, located: true };
            self.tell(StageEvent::Located(self.both(Drive::commanded)));
        }
        if self.power_permitted {
            self.phase = Phase::Enabling { give_up: now + self.config.power.enable_timeout };
            self.tell(StageEvent::Progress(Progress::Enabling));
            // Targets are armed in a later cycle: the owner may refuse to go on from here.
            self.lead_to_enabled();
        }
    }

    /// Enabling has timed out; the first drive that `is_late` is the reason.
    fn fail_enabling(&mut self, now: Time, is_late: impl Fn(&Drive) -> bool) {
        let (axis, statusword) = self.first(is_late);
        let timeout_ms = self.config.power.enable_timeout.as_millis();
        let heard = match statusword {
            Some(word) => format!("statusword {word}"),
            None => "no TPDO1 was heard".to_owned(),
        };
        let fault = format!(
            "{axis}: not in operation enabled within {timeout_ms} ms ({heard}), check power stage, \
             enable input and brake"
        );
        self.fail(now, fault);
    }

    /// The first axis whose drive `is_late`, and its statusword.
    fn first(&self, is_late: impl Fn(&Drive) -> bool) -> (Axis, Option<Statusword>) {
        let axis = Axis::BOTH.into_iter().find(|axis| is_late(&self.drives[*axis]));
        let axis = axis.unwrap_or(Axis::Insertion);
        (axis, self.drives[axis].statusword)
    }

    /// Leads both drives to Operation Enabled, the last step together.
    fn enable(&mut self, now: Time, give_up: Time) {
        if now >= give_up {
            let is_late = |drive: &Drive| drive.state() != Some(DriveState::OperationEnabled);
            return self.fail_enabling(now, is_late);
        }
        for axis in Axis::BOTH {
            if let Some(statusword) =
                self.drives[axis].refuses_to_switch_on(self.config.power.state_transition_timeout)
            {
                return self.fail_switch_on(now, axis, statusword);
            }
        }
        let both_on = self.drives.all(|drive| {
            matches!(drive.state(), Some(DriveState::SwitchedOn | DriveState::OperationEnabled))
        });
        if both_on && !self.drives.all(Drive::is_armed) {
            for axis in Axis::BOTH {
                if let Err(limit) = self.drives[axis].arm() {
                    let fault = format!(
                        "cannot start: the axis stands outside its limits: {limit}; move it back, or \
                         correct its limits or zero"
                    );
                    return self.fail(now, fault);
                }
            }
        }
        self.lead_to_enabled();
    }

    /// A drive on its way to Operation Enabled went back, or did not leave a state in time.
    pub(super) fn fail_switch_on(&mut self, now: Time, axis: Axis, statusword: Statusword) {
        let fault = format!(
            "{axis}: the drive refused to switch on (statusword {statusword}); check safety input, \
             emergency stop and supply, then start again"
        );
        self.fail(now, fault);
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
        let enabled = |drive: &Drive| drive.state() == Some(DriveState::OperationEnabled);
        let standing = self.drives.all(|drive| drive.stands() && !(quick && enabled(drive)));
        if !quick && !standing && now >= give_up {
            self.fail_orderly_end(
                now,
                |drive| !drive.stands(),
                "not seen to stand",
                "its last target",
            );
        } else if standing || now >= give_up {
            let give_up = now + self.config.power.stop_timeout;
            self.phase = Phase::Disabling { quick, standing, give_up };
            self.tell(StageEvent::Progress(Progress::Disabling));
            if quick {
                // Shutdown is not a way out of Quick Stop Active.
                self.command_also_by_sdo(now, Controlword::DISABLE_VOLTAGE);
            } else {
                self.set_controlwords(Controlword::SHUTDOWN);
            }
        }
        self.repeat_by_sdo(now, enabled);
    }

    /// An orderly end has timed out; the first drive that `is_late` is the reason.
    fn fail_orderly_end(
        &mut self,
        now: Time,
        is_late: impl Fn(&Drive) -> bool,
        what: &str,
        since: &str,
    ) {
        let (axis, statusword) = self.first(is_late);
        let (statusword, ms) =
            (statusword.unwrap_or_default(), self.config.power.stop_timeout.as_millis());
        let fault = format!(
            "{axis}: {what} {ms} ms after {since} (statusword {statusword}); if it does not stop now, \
             press the emergency stop"
        );
        self.fail(now, fault);
    }

    pub(super) fn begin_stop(&mut self, now: Time, quick: bool) {
        self.phase = Phase::Stopping { quick, give_up: now + self.config.power.stop_timeout };
        self.tell(StageEvent::Progress(Progress::Stopping));
        for axis in Axis::BOTH {
            self.drives[axis].next_counts = None;
            self.drives[axis].watch_standstill();
        }
    }

    /// From any phase in which SYNC runs.
    pub(super) fn begin_quick_stop(&mut self, now: Time) {
        match self.phase {
            Phase::Standby { .. }
            | Phase::Enabling { .. }
            | Phase::Ready
            | Phase::Homing(_)
            | Phase::Stopping { quick: false, .. }
            | Phase::Disabling { quick: false, .. } => {}
            _ => return,
        }
        self.begin_stop(now, true);
        self.command_also_by_sdo(now, Controlword::QUICK_STOP);
    }

    /// By SDO at once too: a drive that left Operational takes no PDOs.
    fn command_also_by_sdo(&mut self, now: Time, controlword: Controlword) {
        self.set_controlwords(controlword);
        self.send_controlwords(now, |_| true);
    }

    /// A drive that left Operational sends no TPDO. While it stops it is asked by SDO, a few times a
    /// second, one object at a time, what it does and where it is.
    fn look_by_sdo(&mut self, axis: Axis) {
        let stops = matches!(self.phase, Phase::Stopping { .. } | Phase::Disabling { .. });
        if !stops || self.drives[axis].fresh {
            return;
        }
        let object = match self.sync_count % LOOK_SYNCS {
            3 => object::STATUSWORD,
            7 => object::POSITION_ACTUAL,
            _ => return,
        };
        self.drives[axis].asked = Some(object);
        self.send_sdo(axis, SdoRequest::Upload(object));
    }

    /// What a drive answers to such a look.
    pub(super) fn take_look(&mut self, axis: Axis, frame: &Frame) {
        let Some(ServerFrame::Reply(object, SdoReply::Uploaded(value))) =
            ServerFrame::decode(frame.data())
        else {
            return;
        };
        // An answer without a request may be another node's.
        if self.drives[axis].asked.take_if(|asked| *asked == object).is_none() {
            return;
        }
        match (object, value.as_bytes()) {
            (object::STATUSWORD, &[low, high] | &[low, high, _, _]) => {
                self.drives[axis].take_statusword(Statusword(u16::from_le_bytes([low, high])));
            }
            (object::POSITION_ACTUAL, &[a, b, c, d]) => {
                let after = self.config.bus.sync_period().saturating_mul(LOOK_SYNCS as u32);
                self.drives[axis].take_position(i32::from_le_bytes([a, b, c, d]), after);
            }
            _ => {}
        }
    }

    /// In a quick stop: commands the drives that `disobey` again, at intervals.
    fn repeat_by_sdo(&mut self, now: Time, disobey: impl Fn(&Drive) -> bool) {
        let quick = matches!(
            self.phase,
            Phase::Stopping { quick: true, .. } | Phase::Disabling { quick: true, .. }
        );
        if quick && now >= self.repeat_due {
            self.send_controlwords(now, disobey);
        }
    }

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
