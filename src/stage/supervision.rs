//! Takes frames from the drives and from other nodes, and decides which of them stop the run.

use super::machine::Phase;
use super::{Axis, DriveFlag, Ignored, Stage, StageEvent};
use crate::canopen::cia402::{DriveState, Statusword};
use crate::canopen::emcy::{EmcyCode, parse_emcy};
use crate::canopen::heartbeat::HeartbeatEvent;
use crate::canopen::nmt::{NmtCommand, NmtState};
use crate::canopen::{Frame, NodeId, cob};
use crate::units::Time;

impl Stage {
    /// Stops if another master commands the drives. While this stage stops them, that is no fault:
    /// `needle-bench stop` may stop them as well.
    pub(super) fn watch_for_another_master(&mut self, now: Time, frame: &Frame) {
        if self.is_ending() {
            return;
        }
        let nodes = self.config.nodes();
        let drives = [nodes.insertion, nodes.rotation];
        if let Some(what) = command_of_another_master(frame, self.config.bus.bench_node, drives) {
            let fault = format!(
                "another master on the bus: {what} ({frame}); stop it, or give it other nodes: two \
                 masters cannot share an axis"
            );
            self.fail(now, fault);
        }
    }

    /// True for an identifier under which only the bench sends.
    pub(super) fn is_own(&self, cob_id: u16) -> bool {
        let of_drive = |axis: Axis| {
            let node = self.config.axis(axis).node;
            [cob::rpdo1(node), cob::sdo_rx(node)].contains(&cob_id)
        };
        [cob::NMT, cob::SYNC, cob::heartbeat(self.config.bus.bench_node)].contains(&cob_id)
            || Axis::BOTH.into_iter().any(of_drive)
    }

    pub(super) fn handle_sdo(&mut self, now: Time, axis: Axis, frame: &Frame) {
        if frame.data().len() != 8 {
            return self.ignore(Ignored::WrongLength, frame);
        }
        if let Some(bring_up) = &mut self.bring_ups[axis] {
            self.flood.frames -= 1;
            bring_up.runner.handle_frame(now, frame);
            self.drain_bring_ups(now);
        } else if self.is_ending() {
            self.take_reading(axis, frame);
        } else {
            self.ignore(Ignored::Unexpected, frame);
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
            // A loss is no fault yet: the drive's heartbeat may still have another period.
            if event == HeartbeatEvent::BootUp {
                bring_up.handle_boot_up(now);
                self.drain_bring_ups(now);
            }
            return;
        }
        // Heartbeats are supervised only from bring-up on.
        if matches!(self.phase, Phase::Listening { .. }) {
            return;
        }
        if event == HeartbeatEvent::State(NmtState::Stopped) {
            // In Stopped a node takes no SDO, so a command that was sent to this drive by SDO was lost.
            self.repeat_due = now;
        }
        // The heartbeat may have been sent before the drive took the start command.
        let may_be_old =
            matches!(self.phase, Phase::BringUp | Phase::Standby { .. } | Phase::Enabling { .. });
        let fault = match event {
            HeartbeatEvent::BootUp => {
                self.drives[axis].restarted = true;
                "boot-up message in mid-run, the drive restarted; is its supply stable?".to_owned()
            }
            HeartbeatEvent::Lost => {
                let ms = self.config.bus.heartbeat_timeout_ms;
                format!("no heartbeat for {ms} ms, is the drive powered and on the bus?")
            }
            HeartbeatEvent::State(_) if self.may_leave_operational(axis) => return,
            HeartbeatEvent::State(state) if state != NmtState::Operational && !may_be_old => {
                let fault = format!(
                    "NMT state {state} instead of operational, is there another master, or an error in its \
                     error register (0x1001)?"
                );
                return self.fail_drive(now, axis, &fault);
            }
            HeartbeatEvent::State(_) => return,
        };
        self.fail(now, format!("{axis}: {fault}"));
    }

    pub(super) fn handle_emcy(&mut self, now: Time, axis: Axis, frame: &Frame) {
        let Some((_, emcy)) = parse_emcy(frame) else {
            return self.ignore(Ignored::WrongLength, frame);
        };
        if self.drives[axis].note_emcy(emcy) {
            self.emit(StageEvent::Emergency(axis, emcy));
        }
        // Errors from before bring-up took power off stop nothing: bring-up reads the statusword instead.
        let is_watched =
            self.bring_ups[axis].as_ref().is_none_or(|drive| drive.state().is_power_off)
                && !matches!(self.phase, Phase::Listening { .. } | Phase::Stopped)
                && !self.drives[axis].sent_to_pre_operational;
        let is_of_found_fault = self.drives[axis].is_of_found_fault(emcy.code);
        let is_expected = emcy.code == EmcyCode::NO_ERROR
            || emcy.code == EmcyCode::HEARTBEAT && self.note_silence_noticed(axis);
        if is_watched && !is_of_found_fault && !is_expected {
            let hint = match emcy.code {
                EmcyCode::HEARTBEAT => {
                    ": the drive missed the bench's heartbeat; is the bench stalled or unplugged?"
                }
                _ => "",
            };
            self.fail(now, format!("{axis}: emergency {emcy}{hint}"));
        }
    }

    pub(super) fn handle_tpdo(&mut self, now: Time, axis: Axis, frame: &Frame) {
        let Ok(payload) = frame.data().try_into() else {
            self.drives[axis].answers.wrong_length = Some(frame.data().len());
            return self.ignore(Ignored::WrongLength, frame);
        };
        let may_answer = self.sync_runs() && self.sync_count > 0;
        if !may_answer || !self.drives[axis].answers.take(frame, payload) {
            return self.ignore(Ignored::Unexpected, frame);
        }
        self.flood.frames -= 1;
        let previous = self.drives[axis].state();
        self.drives[axis].take_tpdo(payload, self.sync_count);
        self.check_statusword(now, axis, previous);
        let drive = &self.drives[axis];
        if self.is_quick_stopping() && drive.ignores_stop() && !drive.sent_to_pre_operational {
            self.stop_by_sdo_alone(axis);
        }
        if self.drives.all(|drive| drive.answers.fresh) {
            self.handle_feedback(now);
        }
    }

    fn check_statusword(&mut self, now: Time, axis: Axis, previous: Option<DriveState>) {
        let Some(statusword) = self.drives[axis].statusword else { return };
        use DriveState as S;
        let state = statusword.state();
        let standby = matches!(self.phase, Phase::Standby { .. });
        let enabling = matches!(self.phase, Phase::Enabling { .. });
        let stops_by_itself = self.has_noticed_silence(axis) && state != Some(S::OperationEnabled);
        let must_follow = match self.phase {
            _ if stops_by_itself => false,
            Phase::Ready | Phase::Homing(_) | Phase::Stopping { quick: false, .. } => true,
            // As soon as the drive is in Operation Enabled, even if it still waits for the other drive.
            Phase::Enabling { .. } => [previous, state].contains(&Some(S::OperationEnabled)),
            _ => false,
        };
        let fell_back = enabling
            && matches!(
                (previous, state),
                (
                    Some(S::ReadyToSwitchOn | S::SwitchedOn),
                    Some(S::SwitchOnDisabled | S::NotReadyToSwitchOn)
                ) | (Some(S::SwitchedOn), Some(S::ReadyToSwitchOn))
            );
        let has_power =
            matches!(state, Some(S::SwitchedOn | S::OperationEnabled | S::QuickStopActive));
        if must_follow {
            let drive = &mut self.drives[axis];
            // In homing the axis may rest on a limit switch.
            let is_limited = statusword.has(Statusword::INTERNAL_LIMIT) && !drive.in_homing_mode();
            let limited = drive.limited.take(is_limited);
            let warned = drive.warnings.take(statusword.has(Statusword::WARNING));
            if limited.is_some() {
                self.emit(StageEvent::InternalLimit(axis));
            }
            if let Some(count) = warned {
                self.emit(StageEvent::Warns { axis, statusword, count });
            }
        }
        let drive = &self.drives[axis];
        let fault = if standby && has_power {
            format!(
                "the drive has power before the bench gave it any (statusword {statusword}), does an \
                 input or another tool enable it?"
            )
        } else if statusword.is_fault()
            && !stops_by_itself
            && !((standby || enabling) && drive.may_be_in_found_fault())
        {
            format!("drive in fault (statusword {statusword})")
        } else if fell_back {
            refused_to_switch_on(statusword)
        } else if must_follow && state != Some(S::OperationEnabled) {
            format!(
                "drive left operation enabled (statusword {statusword}), was an enable or limit switch \
                 opened?"
            )
        } else if (must_follow || enabling)
            && let Some(flag) = drive.lost_flag()
        {
            lost_flag_fault(flag, statusword)
        } else if drive.in_homing_mode() {
            // The drive follows no target, and bit 13 means a homing error.
            return;
        } else if state == Some(S::OperationEnabled) && statusword.has(Statusword::FOLLOWING_ERROR)
        {
            let off = axis.shown(drive.following_error());
            format!("following error reported by the drive; target minus position is {off}")
        } else if must_follow && let Some(fault) = drive.following_error_fault() {
            fault
        } else if enabling && !must_follow && self.is_off_first_target(axis) {
            let off = axis.shown(drive.following_error());
            format!(
                "the axis left its first target before the drive was enabled, target minus position is {off}; \
                 does it sag, is it pushed, or does the drive find its commutation?"
            )
        } else {
            return;
        };
        self.fail_drive(now, axis, &fault);
    }
}

/// The fault of a drive that, on its way to Operation Enabled, went back or did not leave a state in time.
pub(super) fn refused_to_switch_on(statusword: Statusword) -> String {
    format!(
        "the drive refused to switch on (statusword {statusword}); check safety input, emergency stop and \
         supply, then start again"
    )
}

/// The fault of an enabled drive that has cleared a bit of its statusword.
fn lost_flag_fault(flag: DriveFlag, statusword: Statusword) -> String {
    match flag {
        DriveFlag::Remote => format!(
            "the drive no longer obeys the bus (statusword {statusword}, bit 9 clear): it will \
             ignore a stop; press the emergency stop"
        ),
        DriveFlag::Voltage => format!(
            "the drive has lost its supply (statusword {statusword}, bit 4 clear), is an emergency \
             stop pressed, or a fuse blown?"
        ),
        DriveFlag::FollowsCommand => format!(
            "the drive ignores its targets (statusword {statusword}, bit 12 clear), does an input or \
             another tool hold it?"
        ),
    }
}

// Client command specifiers (CiA 301, 7.2.4.3).
const INITIATE_DOWNLOAD: u8 = 1;
const BLOCK_DOWNLOAD: u8 = 6;

/// Names what a received `frame` is if only another master can have sent it: a command to one of `drives`, or
/// a heartbeat with the node number of `bench`. `None` for any other frame, and for two harmless commands: a
/// request to read an object, and Start Remote Node.
fn command_of_another_master(
    frame: &Frame,
    bench: NodeId,
    drives: [NodeId; 2],
) -> Option<&'static str> {
    let cob_id = frame.cob_id()?;
    let is_one_of = |of: fn(NodeId) -> u16| drives.into_iter().any(|node| of(node) == cob_id);
    if cob_id == cob::SYNC {
        Some("SYNC")
    } else if cob_id == cob::NMT {
        let &[command, node] = frame.data() else { return None };
        let is_ours = node == 0 || drives.iter().any(|drive| drive.get() == node);
        let is_harmless = command == NmtCommand::StartRemoteNode as u8;
        (is_ours && !is_harmless).then_some("an NMT command")
    } else if cob_id == cob::heartbeat(bench) {
        // The drives would take it for the bench's heartbeat, and not notice if the bench dies.
        Some("a heartbeat of the bench's own node number")
    } else if is_one_of(cob::rpdo1) {
        Some("RPDO1 of a drive")
    } else if is_one_of(cob::sdo_rx) {
        let specifier = frame.data().first().map(|command| command >> 5);
        let writes = matches!(specifier, Some(INITIATE_DOWNLOAD | BLOCK_DOWNLOAD));
        writes.then_some("a write to a drive's object dictionary")
    } else {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_that_move_or_configure_a_drive_are_commands_of_a_master() {
        let node = |n| NodeId::new(n).unwrap();
        let command = |id, data: &[u8]| {
            command_of_another_master(&Frame::new(id, data), node(127), [node(1), node(2)])
        };
        let of_a_master: [(u16, &[u8]); 9] = [
            (0x080, &[]),
            (0x000, &[0x80, 1]),
            (0x000, &[0x02, 0]),
            (0x000, &[0x81, 2]),
            (0x201, &[0x0F, 0, 0, 0, 0, 0]),
            (0x202, &[]),
            (0x77F, &[5]),
            (0x601, &[0x23, 0x16, 0x10, 1, 0, 0, 0, 0]),
            (0x602, &[0xC2, 0x10, 0x10, 1, 0, 0, 0, 0]),
        ];
        for (id, data) in of_a_master {
            assert!(command(id, data).is_some(), "{id:03X} {data:?}");
        }
        let harmless: [(u16, &[u8]); 9] = [
            (0x000, &[0x01, 0]),
            (0x000, &[0x80, 3]),
            (0x000, &[]),
            (0x181, &[0; 6]),
            (0x203, &[0; 6]),
            (0x601, &[0x40, 0x41, 0x60, 0, 0, 0, 0, 0]),
            (0x603, &[0x2B, 0x40, 0x60, 0, 0, 0, 0, 0]),
            (0x77E, &[5]),
            (0x601, &[]),
        ];
        for (id, data) in harmless {
            assert_eq!(command(id, data), None, "{id:03X} {data:?}");
        }
    }
}
