//! What the drives and others say, and what of it ends a run.

use super::machine::Phase;
use super::other_master::word_of_another_master;
use super::{Axis, Ignored, Stage, StageEvent, StageFault};
use crate::canopen::cia402::{DriveState, Statusword};
use crate::canopen::emcy::{EmcyCode, parse_emcy};
use crate::canopen::heartbeat::HeartbeatEvent;
use crate::canopen::nmt::NmtState;
use crate::canopen::{Frame, cob};
use crate::units::Time;

impl Stage {
    /// Before anything is sent, and while the drives are commanded, nobody else may.
    pub(super) fn watch_for_another_master(&mut self, now: Time, frame: &Frame) {
        if matches!(self.phase, Phase::Stopping { .. } | Phase::Disabling { .. } | Phase::Stopped) {
            return;
        }
        let nodes = self.config.nodes();
        let drives = [nodes.insertion, nodes.rotation];
        if let Some(word) = word_of_another_master(frame, self.config.bench_node, drives) {
            self.fail(now, StageFault::AnotherMaster(word, *frame));
        }
    }

    /// True for an identifier under which nobody but the bench sends.
    pub(super) fn is_own(&self, cob_id: u16) -> bool {
        let of_drive = |axis: Axis| {
            let node = self.config.axis(axis).node;
            [cob::rpdo(node), cob::sdo_rx(node)].contains(&cob_id)
        };
        [cob::NMT, cob::SYNC, cob::heartbeat(self.config.bench_node)].contains(&cob_id)
            || Axis::BOTH.into_iter().any(of_drive)
    }

    pub(super) fn handle_sdo(&mut self, now: Time, axis: Axis, frame: &Frame) {
        if frame.data().len() != 8 {
            return self.ignore(Ignored::WrongLength, frame);
        }
        match &mut self.bring_ups[axis] {
            Some(bring_up) => {
                self.beside_cycle -= 1;
                bring_up.conversation.handle_frame(now, frame);
                self.drain_bring_ups(now);
            }
            None if matches!(
                self.phase,
                Phase::Stopping { .. } | Phase::Disabling { .. } | Phase::Stopped
            ) =>
            {
                self.take_look(axis, frame);
            }
            None => self.ignore(Ignored::Unexpected, frame),
        }
    }

    pub(super) fn handle_heartbeat(&mut self, now: Time, axis: Axis, frame: &Frame) {
        if frame.data().len() != 1 {
            return self.ignore(Ignored::WrongLength, frame);
        }
        if let Some(event) = self.monitors[axis].handle_frame(now, frame) {
            self.handle_heartbeat_event(now, axis, event);
        }
    }

    pub(super) fn handle_heartbeat_event(&mut self, now: Time, axis: Axis, event: HeartbeatEvent) {
        if let Some(bring_up) = &mut self.bring_ups[axis] {
            // A loss means nothing yet: the drive may still have another heartbeat period.
            if event == HeartbeatEvent::BootUp {
                bring_up.handle_boot_up(now);
                self.drain_bring_ups(now);
            }
            return;
        }
        // Nobody has begun to watch.
        if matches!(self.phase, Phase::Listening { .. }) {
            return;
        }
        let within = self.config.heartbeat.consumer_time;
        match event {
            HeartbeatEvent::BootUp => self.fail(now, StageFault::Rebooted(axis)),
            HeartbeatEvent::Lost => self.fail(now, StageFault::HeartbeatLost(axis, within)),
            HeartbeatEvent::State(NmtState::Operational) => {}
            HeartbeatEvent::State(state) => match self.phase {
                // A heartbeat may still be from before the start command.
                Phase::BringUp | Phase::Standby { .. } | Phase::Enabling { .. } => {}
                _ => self.fail(now, StageFault::NotOperational(axis, state)),
            },
        }
    }

    pub(super) fn handle_emcy(&mut self, now: Time, axis: Axis, frame: &Frame) {
        let Some((_, emcy)) = parse_emcy(frame) else {
            return self.ignore(Ignored::WrongLength, frame);
        };
        if self.drives[axis].is_news(emcy) {
            self.tell(StageEvent::Emergency(axis, emcy));
        }
        // What was wrong with a drive before it was looked at shows in its statusword.
        let is_watched = self.bring_ups[axis].as_ref().is_none_or(|drive| drive.so_far().disarmed)
            && !matches!(self.phase, Phase::Listening { .. } | Phase::Stopped);
        let is_of_the_fault_found = self.drives[axis].excuses(emcy.code);
        if is_watched && !is_of_the_fault_found && emcy.code != EmcyCode::NO_ERROR {
            self.fail(now, StageFault::Emergency(axis, emcy));
        }
    }

    pub(super) fn handle_tpdo(&mut self, now: Time, axis: Axis, frame: &Frame) {
        let Ok(payload) = frame.data().try_into() else {
            return self.ignore(Ignored::WrongLength, frame);
        };
        if !self.sync_runs() || self.sync_count == 0 || self.drives[axis].fresh {
            self.drives[axis].take_second(frame, payload);
            return self.ignore(Ignored::Unexpected, frame);
        }
        self.beside_cycle -= 1;
        let was = self.drives[axis].state();
        self.drives[axis].take_tpdo(payload);
        self.check_statusword(now, axis, was);
        if self.drives.all(|drive| drive.fresh) {
            self.window_complete(now);
        }
    }

    fn check_statusword(&mut self, now: Time, axis: Axis, was: Option<DriveState>) {
        let Some(statusword) = self.drives[axis].statusword() else { return };
        let state = statusword.state();
        let standby = matches!(self.phase, Phase::Standby { .. });
        let enabling = matches!(self.phase, Phase::Enabling { .. });
        let must_follow = match self.phase {
            Phase::Ready | Phase::Homing(_) | Phase::Stopping { quick: false, .. } => true,
            // From the first time that it says so, while it waits for the other, too.
            Phase::Standby { .. } | Phase::Enabling { .. } => {
                [was, state].contains(&Some(DriveState::OperationEnabled))
            }
            _ => false,
        };
        let faulty = matches!(state, Some(DriveState::Fault | DriveState::FaultReactionActive));
        use DriveState as S;
        let fell_back = enabling
            && matches!(
                (was, state),
                (
                    Some(S::ReadyToSwitchOn | S::SwitchedOn),
                    Some(S::SwitchOnDisabled | S::NotReadyToSwitchOn)
                ) | (Some(S::SwitchedOn), Some(S::ReadyToSwitchOn))
            );
        if must_follow && self.drives[axis].meets_internal_limit() {
            self.tell(StageEvent::InternalLimit(axis));
        }
        if must_follow && let Some(count) = self.drives[axis].begins_to_warn() {
            self.tell(StageEvent::Warns { axis, statusword, count });
        }
        if faulty && !((standby || enabling) && self.drives[axis].may_be_in_fault()) {
            self.fail(now, StageFault::DriveFault(axis, statusword));
        } else if fell_back {
            self.fail(now, StageFault::SwitchOnRefused(axis, statusword));
        } else if must_follow && state != Some(DriveState::OperationEnabled) {
            self.fail(now, StageFault::LeftOperationEnabled(axis, statusword));
        } else if (must_follow || enabling)
            && let Some(flag) = self.drives[axis].lost_flag()
        {
            self.fail(now, StageFault::FlagLost(axis, flag, statusword));
        } else if self.drives[axis].homes {
            // It follows no target, and its bit 13 is of its homing.
        } else if state == Some(DriveState::OperationEnabled)
            && statusword.has(Statusword::FOLLOWING_ERROR)
        {
            let following_error = self.drives[axis].following_error();
            self.fail(now, StageFault::FollowingError(axis, following_error));
        } else if must_follow && let Some(fault) = self.drives[axis].not_following() {
            self.fail(now, fault);
        }
    }
}
