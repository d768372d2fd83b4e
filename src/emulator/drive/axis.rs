//! The axis behind the node: state machine, stops and faults. It reads its commands from the objects, and
//! writes its state to them.

use super::device::Device;
use super::homing::{self, Homing};
use super::inputs::{End, Inputs};
use super::motion::Motion;
use super::profile::Profile;
use super::state_machine::{Command, transition};
use super::{DriveConfig, Model};
use crate::canopen::ObjectAddress;
use crate::canopen::cia402::{Controlword, DriveState, Mode, Statusword, object};
use crate::canopen::emcy::EmcyCode;
use crate::canopen::nmt::NmtState;
use crate::canopen::object_dictionary::ObjectDictionary;
use crate::canopen::sdo::AbortCode;
use crate::units::Time;

/// The modes that the drive supports.
const MODES: [Mode; 3] = [Mode::NONE, Mode::HOMING, Mode::CSP];
/// Manufacturer-specific emergency codes of limit switches, those of an EPOS4.
const NEGATIVE_LIMIT_SWITCH: EmcyCode = EmcyCode(0xff06);
const POSITIVE_LIMIT_SWITCH: EmcyCode = EmcyCode(0xff07);
/// Bit 15, manufacturer-specific: the axis was homed.
const REFERENCED: u16 = 1 << 15;

/// The axis behind the node. Positions are encoder counts, not wrapped to 32 bits; positions on the
/// bus are relative to `zero`.
#[derive(Debug, Clone)]
pub(super) struct Axis {
    pub(super) config: DriveConfig,
    pub(super) inputs: Inputs,
    state: DriveState,
    pub(super) motion: Motion,
    /// The last target taken, in counts.
    pub(super) demand: i64,
    /// Demand minus position at the end of the interpolation period, in counts.
    pub(super) lag: i64,
    /// Since when the lag has exceeded the window 0x6065 without a break.
    pub(super) behind_since: Option<Time>,
    /// The encoder position that is 0 on the bus.
    pub(super) zero: i64,
    /// True if the last target was outside the software limits and was clamped to them.
    pub(super) target_limited: bool,
    /// The state to enter when the axis stands.
    after_stop: Option<DriveState>,
    last_controlword: Controlword,
    pub(super) has_voltage: bool,
    /// True while something blocks the axis.
    pub(super) is_stalled: bool,
    /// True while a supervised node is lost: a fault reset and Operation Enabled are refused.
    supervised_node_lost: bool,
    updated: Time,
    pub(super) homing: Homing,
    /// True if the last homing since power-on succeeded.
    pub(super) referenced: bool,
}

impl Axis {
    pub(super) fn new(config: DriveConfig) -> Self {
        Axis {
            inputs: Inputs { switches: config.switches, ..Inputs::default() },
            state: DriveState::SwitchOnDisabled,
            motion: Motion::Hold { at: config.start_counts as f64 },
            demand: config.start_counts,
            lag: 0,
            behind_since: None,
            zero: 0,
            target_limited: false,
            after_stop: None,
            last_controlword: Controlword::default(),
            has_voltage: true,
            is_stalled: false,
            supervised_node_lost: false,
            updated: Time::ZERO,
            homing: Homing::default(),
            referenced: config.homed,
            config,
        }
    }

    pub(super) fn state(&self) -> DriveState {
        self.state
    }

    pub(super) fn has_torque(&self) -> bool {
        self.has_voltage && !self.inputs.interlocked
    }

    fn handle_controlword(&mut self, now: Time, device: &mut Device) {
        let controlword = Controlword(device.objects.integer(object::CONTROLWORD) as u16);
        let before = std::mem::replace(&mut self.last_controlword, controlword);
        if self.state == DriveState::Fault {
            let reset = Controlword::FAULT_RESET_BIT;
            let rising = controlword.has(reset) && !before.has(reset);
            if rising && self.has_torque() && !self.supervised_node_lost {
                device.clear_all();
                device.objects.set(object::ERROR_CODE, 0);
                self.power_off(now); // transition 15
            }
            return;
        }
        let command = Command::of(controlword);
        while let Some(next) = transition(self.state, command).filter(|next| self.may_enter(*next))
        {
            self.enter(now, next, &device.objects);
        }
        let halt = controlword.has(Controlword::HALT_BIT);
        let braking = matches!(self.motion, Motion::Brake(_));
        if halt && !braking && self.state == DriveState::OperationEnabled {
            self.interrupt_homing(now, &device.objects);
            self.brake(now, halt_deceleration(&device.objects));
        }
        if self.may_move(device) {
            self.handle_homing_bit(now, controlword, before, device);
        }
    }

    /// Switched On needs torque, and Operation Enabled also the nodes that this drive supervises (0x1016). A
    /// quick stop after which the drive switches its power off (0x605A: 1 or 2) goes on to its end.
    fn may_enter(&self, next: DriveState) -> bool {
        match next {
            DriveState::SwitchedOn => self.has_torque(),
            DriveState::OperationEnabled => {
                self.has_torque() && !self.supervised_node_lost && self.after_stop.is_none()
            }
            _ => true,
        }
    }

    fn enter(&mut self, now: Time, next: DriveState, objects: &ObjectDictionary) {
        match next {
            DriveState::QuickStopActive => self.quick_stop(now, objects),
            DriveState::OperationEnabled => {
                self.state = next;
                self.demand = whole(self.motion.position_at(now));
                self.homing = Homing::default();
            }
            _ => {
                self.stop_at_once(now);
                self.state = next;
            }
        }
    }

    /// Quick stop. Object 0x605A selects the ramp, and whether power stays on afterwards.
    fn quick_stop(&mut self, now: Time, objects: &ObjectDictionary) {
        let option = objects.integer(object::QUICK_STOP_OPTION);
        let ramp = match option {
            1 | 5 => objects.integer(object::PROFILE_DECELERATION),
            2 | 6 => objects.integer(object::QUICK_STOP_DECELERATION),
            _ => return self.power_off(now),
        };
        self.state = DriveState::QuickStopActive;
        self.brake(now, ramp);
        self.after_stop = (option <= 2).then_some(DriveState::SwitchOnDisabled);
    }

    /// Enters the fault reaction. During a fault, another one only sends its emergency message.
    pub(super) fn fault(&mut self, now: Time, code: EmcyCode, device: &mut Device) {
        device.raise(code, [0; 5]);
        if self.state.is_fault() {
            return;
        }
        device.objects.set(object::ERROR_CODE, code.0.into());
        let deceleration = match device.objects.integer(object::FAULT_REACTION_OPTION) {
            1 => device.objects.integer(object::PROFILE_DECELERATION),
            2 => device.objects.integer(object::QUICK_STOP_DECELERATION),
            _ => {
                self.stop_at_once(now);
                0
            }
        };
        self.state = DriveState::FaultReactionActive; // transition 13
        self.brake(now, deceleration);
        self.after_stop = Some(DriveState::Fault); // transition 14
    }

    /// Communication failed. Object 0x6007 selects the reaction: 0 no action, 1 fault signal,
    /// 2 disable voltage, 3 quick stop.
    fn abort_connection(&mut self, now: Time, code: EmcyCode, device: &mut Device) {
        let option = device.objects.integer(object::ABORT_CONNECTION_OPTION);
        let enabled = self.state == DriveState::OperationEnabled;
        match option {
            1 => self.fault(now, code, device),
            2 if enabled => self.power_off(now),
            3 if enabled => self.quick_stop(now, &device.objects),
            // No action: the state stays. The axis stops, because no targets come any more.
            _ if enabled => self.brake(now, halt_deceleration(&device.objects)),
            _ => {}
        }
    }

    fn power_off(&mut self, now: Time) {
        self.stop_at_once(now);
        self.state = DriveState::SwitchOnDisabled;
    }

    /// Stops without a ramp: without power a lead screw or a high gear ratio does not coast.
    pub(super) fn stop_at_once(&mut self, now: Time) {
        self.motion = Motion::Hold { at: self.motion.position_at(now) };
        self.after_stop = None;
        self.stop_following();
    }

    pub(super) fn brake(&mut self, now: Time, deceleration: i64) {
        self.motion = self.motion.brake(now, deceleration.max(1) as f64);
        self.stop_following();
    }

    /// An axis that does not follow its target has no following error and no limited target.
    fn stop_following(&mut self) {
        self.lag = 0;
        self.behind_since = None;
        self.target_limited = false;
    }

    /// True while commands may move the axis.
    pub(super) fn may_move(&self, device: &Device) -> bool {
        let controlword = Controlword(device.objects.integer(object::CONTROLWORD) as u16);
        self.state == DriveState::OperationEnabled
            && self.has_torque()
            && device.nmt_state == NmtState::Operational
            && !controlword.has(Controlword::HALT_BIT)
    }

    /// The active mode.
    pub(super) fn mode(&self, objects: &ObjectDictionary) -> Mode {
        Mode(objects.integer(object::MODES_OF_OPERATION) as i8)
    }

    /// Stops an axis that moves onto a limit switch that is closed at `counts`: an EPOS4 faults, others make a quick
    /// stop. Homing may move onto the switch that it seeks.
    fn check_switches(&mut self, now: Time, counts: i64, device: &mut Device) {
        let Some(end) = self.heading(now) else { return };
        if self.state != DriveState::OperationEnabled || !self.inputs.is_closed(end, counts) {
            return;
        }
        if let Homing::InProgress { onto, .. } = self.homing {
            if onto != Some(end) {
                self.homing = Homing::Failed;
                self.brake(now, halt_deceleration(&device.objects));
            }
            return;
        }
        match (self.config.model, end) {
            (Model::Generic, _) => self.quick_stop(now, &device.objects),
            (Model::Epos4, End::Negative) => self.fault(now, NEGATIVE_LIMIT_SWITCH, device),
            (Model::Epos4, End::Positive) => self.fault(now, POSITIVE_LIMIT_SWITCH, device),
        }
    }

    /// The end that the axis moves towards.
    fn heading(&self, now: Time) -> Option<End> {
        match self.motion.velocity_at(now) {
            speed if speed > 0.0 => Some(End::Positive),
            speed if speed < 0.0 => Some(End::Negative),
            _ => None,
        }
    }

    /// Handles a mode that was written. A change of mode ends the motion of the old mode; writing the active
    /// mode again changes nothing.
    fn handle_mode(&mut self, now: Time, device: &Device) {
        let active = device.objects.integer(object::MODES_OF_OPERATION_DISPLAY);
        if device.objects.integer(object::MODES_OF_OPERATION) == active {
            return;
        }
        self.homing = Homing::default();
        let ramped = matches!(self.motion, Motion::Ramped(_));
        if ramped || self.mode(&device.objects) == Mode::NONE {
            self.brake(now, halt_deceleration(&device.objects));
        }
    }

    /// Object 0x6041 at the position `counts`.
    fn statusword(&self, now: Time, counts: i64, device: &Device) -> u16 {
        let follows = self.follows_targets(device);
        let powered =
            matches!(self.state, DriveState::OperationEnabled | DriveState::QuickStopActive);
        let is_standing = self.motion.end().is_none_or(|end| now >= end);
        let limited = self.target_limited || self.lag != 0;
        let on_switch = [End::Negative, End::Positive]
            .into_iter()
            .any(|end| self.inputs.is_closed(end, counts));
        // The meaning of bits 10, 12 and 13 depends on the mode. In CSP bit 10 is reserved; this drive
        // sets it when a halt or quick stop has ended.
        let following_error = device.is_active(EmcyCode::FOLLOWING_ERROR);
        let (reached, bit_12, bit_13) = match self.mode(&device.objects) {
            Mode::HOMING => {
                let failed = self.homing == Homing::Failed;
                (powered && is_standing, self.referenced && !failed, failed)
            }
            _ => (powered && is_standing && !follows, follows && !limited, following_error),
        };
        let flags = [
            (Statusword::VOLTAGE_ENABLED, self.has_voltage),
            (Statusword::REMOTE, device.nmt_state == NmtState::Operational),
            (Statusword::TARGET_REACHED, reached),
            (Statusword::INTERNAL_LIMIT, (follows && limited) || (powered && on_switch)),
            // In homing these two bits are "homing attained" and "homing error".
            (Statusword::FOLLOWS_COMMAND, bit_12),
            (Statusword::FOLLOWING_ERROR, bit_13),
            (REFERENCED, self.referenced && self.config.model == Model::Epos4),
        ];
        let set = flags.iter().filter(|(_, set)| *set).map(|(bit, _)| *bit);
        set.fold(Statusword::state_bits(self.state), |word, bit| word | bit)
    }

    /// When the axis will reach a limit switch.
    fn switch_due(&self) -> Time {
        let switches = &self.inputs.switches;
        let ends = [switches.negative_counts, switches.positive_counts];
        let due = |counts: i64| self.motion.reaches(self.updated, counts as f64);
        match self.state {
            DriveState::OperationEnabled => {
                ends.into_iter().flatten().filter_map(due).min().unwrap_or(Time::NEVER)
            }
            _ => Time::NEVER,
        }
    }

    /// Brings the axis's objects up to `now`. Called before an object is read, sampled or sent.
    pub(super) fn update(&mut self, now: Time, device: &mut Device) {
        self.updated = now;
        if self.motion.profile().is_some_and(|profile| now >= profile.end()) {
            self.motion = Motion::Hold { at: self.motion.to() };
            if self.after_stop.is_none() && self.may_move(device) {
                self.begin_next_leg(now, device);
            }
        }
        if matches!(self.motion, Motion::Hold { .. })
            && let Some(next) = self.after_stop.take()
        {
            self.state = next;
        }
        let counts = whole(self.motion.position_at(now));
        self.check_switches(now, counts, device);
        let reported = counts.wrapping_sub(self.zero);
        let demand = match self.motion {
            Motion::Ramped(_) => reported,
            _ => reported.wrapping_add(self.lag),
        };
        let values = [
            (object::STATUSWORD, self.statusword(now, counts, device).into()),
            (object::MODES_OF_OPERATION_DISPLAY, self.mode(&device.objects).0.into()),
            (object::POSITION_ACTUAL, reported),
            (object::POSITION_DEMAND, demand),
            (object::FOLLOWING_ERROR_ACTUAL, self.lag),
            (object::VELOCITY_ACTUAL, whole(self.motion.velocity_at(now))),
            (object::DIGITAL_INPUTS, self.inputs.bits(counts)),
        ];
        values.into_iter().for_each(|(address, value)| device.objects.set(address, value));
    }

    /// Whether the object at `address` may become `value`. Type, access and limits have been checked.
    ///
    /// # Errors
    /// The abort code to refuse with.
    pub(super) fn check_write(&self, address: ObjectAddress, value: i64) -> Result<(), AbortCode> {
        let is_supported = match address {
            object::MODES_OF_OPERATION => MODES.contains(&Mode(value as i8)),
            object::HOMING_METHOD => homing::is_supported(value, &self.inputs.switches),
            object::QUICK_STOP_OPTION => matches!(value, 0 | 1 | 2 | 5 | 6),
            _ => true,
        };
        if is_supported { Ok(()) } else { Err(AbortCode::INVALID_VALUE) }
    }

    /// Handles an object that was written over the bus.
    pub(super) fn handle_write(&mut self, now: Time, address: ObjectAddress, device: &mut Device) {
        match address {
            object::CONTROLWORD => self.handle_controlword(now, device),
            object::MODES_OF_OPERATION => self.handle_mode(now, device),
            _ => {}
        }
    }

    /// Handles the first half of a SYNC in Operational: updates the objects that the TPDOs sample.
    pub(super) fn sample(&mut self, now: Time, device: &mut Device) {
        self.motion.align_to_sync(now);
        self.update(now, device);
    }

    /// The NMT state is no longer `before`; the new one is in `device`.
    pub(super) fn nmt_state_changed(&mut self, now: Time, before: NmtState, device: &mut Device) {
        let was_operational = before == NmtState::Operational;
        if was_operational && self.state == DriveState::OperationEnabled {
            self.abort_connection(now, EmcyCode::COMMUNICATION, device);
        }
    }

    /// A node that this one supervises fell silent or restarted. [`EmcyCode::HEARTBEAT`] is raised.
    pub(super) fn heartbeat_lost(&mut self, now: Time, device: &mut Device) {
        self.supervised_node_lost = true;
        self.abort_connection(now, EmcyCode::HEARTBEAT, device);
    }

    /// All supervised nodes that were lost are back.
    pub(super) fn heartbeat_returned(&mut self, device: &mut Device) {
        self.supervised_node_lost = false;
        // During a fault the error stays active until the fault is reset.
        if !self.state.is_fault() {
            device.clear(EmcyCode::HEARTBEAT);
        }
    }

    /// Resets the axis after its objects and errors were reset.
    pub(super) fn reset(&mut self, now: Time) {
        self.power_off(now);
        self.demand = whole(self.motion.position_at(now));
        self.last_controlword = Controlword::default();
        self.supervised_node_lost = false;
        self.homing = Homing::default();
        self.referenced = false;
    }

    /// When the axis is due.
    pub(super) fn deadline(&self) -> Time {
        self.motion.profile().map_or(Time::NEVER, Profile::end).min(self.switch_due())
    }
}

pub(super) fn whole(counts: f64) -> i64 {
    counts.round() as i64
}

fn halt_deceleration(objects: &ObjectDictionary) -> i64 {
    objects.integer(match objects.integer(object::HALT_OPTION) {
        2 => object::QUICK_STOP_DECELERATION,
        _ => object::PROFILE_DECELERATION,
    })
}
