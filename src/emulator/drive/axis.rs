//! The drive's program: state machine, cyclic synchronous position, stops and faults.

use std::time::Duration;

use super::DriveConfig;
use super::motion::Motion;
use super::state_machine::{Command, transition};
use crate::canopen::ObjectAddress;
use crate::canopen::cia402::{AbortConnection, Controlword, DriveState, Mode, Statusword, object};
use crate::canopen::emcy::{EmcyCode, error_register};
use crate::canopen::nmt::NmtState;
use crate::canopen::node::{Application, Device};
use crate::canopen::object_dictionary::ObjectDictionary;
use crate::canopen::sdo::AbortCode;
use crate::units::Time;

/// Following-error window that switches the supervision off (CiA 402-2, 0x6065).
const WINDOW_OFF: i64 = u32::MAX as i64;

/// The axis behind the node. Positions are counts on the unwrapped line.
#[derive(Debug, Clone)]
pub(super) struct Axis {
    speed_max_counts_per_s: f64,
    negative_switch_counts: Option<i64>,
    positive_switch_counts: Option<i64>,
    state: DriveState,
    motion: Motion,
    /// The last target taken, in counts.
    demand: i64,
    /// How far the speed limit keeps the axis behind its demand.
    lag: i64,
    /// A target was cut to the software limits.
    target_limited: bool,
    /// The state to go to once the axis stands.
    after_stop: Option<DriveState>,
    /// Bit 7 of the last controlword.
    reset_bit: bool,
    voltage: bool,
    /// A supervised node is missing: a fault reset is refused.
    partner_lost: bool,
    /// Whole counts at the last update.
    counts: i64,
}

impl Axis {
    pub(super) fn new(config: &DriveConfig) -> Self {
        Axis {
            speed_max_counts_per_s: config.speed_max_counts_per_s.into(),
            negative_switch_counts: config.negative_switch_counts,
            positive_switch_counts: config.positive_switch_counts,
            state: DriveState::SwitchOnDisabled,
            motion: Motion::Hold { at: config.start_counts as f64 },
            demand: config.start_counts,
            lag: 0,
            target_limited: false,
            after_stop: None,
            reset_bit: false,
            voltage: true,
            partner_lost: false,
            counts: config.start_counts,
        }
    }

    pub(super) fn state(&self) -> DriveState {
        self.state
    }

    pub(super) fn counts(&self) -> i64 {
        self.counts
    }

    pub(super) fn position_at(&self, now: Time) -> f64 {
        self.motion.position_at(now)
    }

    /// Counts per second, without sign.
    #[cfg(test)]
    pub(super) fn speed_at(&self, now: Time) -> f64 {
        self.motion.velocity_at(now).abs()
    }

    /// The power stage's supply comes or goes.
    pub(super) fn set_voltage(&mut self, now: Time, on: bool, device: &mut Device) {
        self.voltage = on;
        let powered = matches!(
            self.state,
            DriveState::SwitchedOn | DriveState::OperationEnabled | DriveState::QuickStopActive
        );
        if !on && powered {
            self.stand(now);
            self.fault(now, EmcyCode::UNDERVOLTAGE, error_register::VOLTAGE, device);
        }
    }

    fn controlword_written(&mut self, now: Time, device: &mut Device) {
        let controlword = Controlword(device.objects.integer(object::CONTROLWORD) as u16);
        let reset_bit = controlword.has(Controlword::FAULT_RESET_BIT);
        let rising = reset_bit && !self.reset_bit;
        self.reset_bit = reset_bit;
        if self.state == DriveState::Fault {
            if rising && self.voltage && !self.partner_lost {
                device.clear_all();
                device.objects.set(object::ERROR_CODE, 0);
                self.power_off(now); // 15
            }
            return;
        }
        let command = Command::of(controlword);
        while let Some(next) = transition(self.state, command).filter(|next| self.may_enter(*next))
        {
            self.enter(now, next, &device.objects);
        }
        let halt = controlword.has(Controlword::HALT_BIT);
        let braking = matches!(self.motion, Motion::Brake { .. });
        if halt && !braking && self.state == DriveState::OperationEnabled {
            self.brake(now, halt_deceleration(&device.objects));
        }
    }

    /// Power needs voltage, and operation needs the partner this drive is told to rely on.
    fn may_enter(&self, next: DriveState) -> bool {
        match next {
            DriveState::SwitchedOn => self.voltage,
            DriveState::OperationEnabled => self.voltage && !self.partner_lost,
            _ => true,
        }
    }

    fn enter(&mut self, now: Time, next: DriveState, objects: &ObjectDictionary) {
        match next {
            DriveState::QuickStopActive => self.quick_stop(now, objects),
            DriveState::OperationEnabled => {
                self.state = next;
                self.after_stop = None;
                self.demand = whole(self.motion.position_at(now));
                self.lag = 0;
            }
            _ => {
                self.stand(now);
                self.state = next;
            }
        }
    }

    /// Quick stop as 0x605A says: by which ramp, and whether power stays on afterwards.
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

    /// Faults once; while a fault holds, another only adds its emergency message.
    fn fault(&mut self, now: Time, code: EmcyCode, register: u8, device: &mut Device) {
        device.raise(code, register, [0; 5]);
        if matches!(self.state, DriveState::Fault | DriveState::FaultReactionActive) {
            return;
        }
        device.objects.set(object::ERROR_CODE, code.0.into());
        let deceleration = match device.objects.integer(object::FAULT_REACTION_OPTION) {
            1 => device.objects.integer(object::PROFILE_DECELERATION),
            2 => device.objects.integer(object::QUICK_STOP_DECELERATION),
            _ => {
                self.stand(now);
                0
            }
        };
        self.state = DriveState::FaultReactionActive; // 13
        self.brake(now, deceleration);
        self.after_stop = Some(DriveState::Fault); // 14
    }

    /// Communication failed: the reaction of 0x6007.
    fn abort_connection(&mut self, now: Time, code: EmcyCode, device: &mut Device) {
        let option = device.objects.integer(object::ABORT_CONNECTION_OPTION);
        let enabled = self.state == DriveState::OperationEnabled;
        match AbortConnection::from_i16(option as i16) {
            AbortConnection::FaultSignal => {
                self.fault(now, code, error_register::COMMUNICATION, device);
            }
            AbortConnection::DisableVoltage if enabled => self.power_off(now),
            AbortConnection::QuickStop if enabled => self.quick_stop(now, &device.objects),
            // No action: the state stays, but nothing commands the axis any more.
            _ if enabled => self.brake(now, halt_deceleration(&device.objects)),
            _ => {}
        }
    }

    fn power_off(&mut self, now: Time) {
        self.stand(now);
        self.state = DriveState::SwitchOnDisabled;
    }

    /// Stops dead: without power a lead screw or a high gear does not coast.
    fn stand(&mut self, now: Time) {
        self.motion = Motion::Hold { at: self.motion.position_at(now) };
        self.after_stop = None;
        self.lag = 0;
    }

    fn brake(&mut self, now: Time, deceleration: i64) {
        self.motion = self.motion.brake(now, deceleration.max(1) as f64);
        self.lag = 0;
    }

    /// True while the axis takes targets.
    fn follows(&self, device: &Device) -> bool {
        let objects = &device.objects;
        let controlword = Controlword(objects.integer(object::CONTROLWORD) as u16);
        self.state == DriveState::OperationEnabled
            && self.voltage
            && device.nmt_state() == NmtState::Operational
            && mode(objects) == Mode::CyclicSynchronousPosition
            && !controlword.has(Controlword::HALT_BIT)
    }

    /// Takes the target for the next interpolation period.
    ///
    /// The axis reaches it exactly at the period's end, unless its speed does not suffice: then
    /// it stays behind, and when it would stay behind by more than 0x6065 it faults instead of
    /// moving.
    fn take_target(&mut self, now: Time, device: &mut Device) {
        let objects = &device.objects;
        let target = objects.integer(object::TARGET_POSITION) as i32;
        let allowed = within_limits(target, objects);
        self.target_limited = allowed != target;
        // 32 bits wrap: the nearest position of that name is meant.
        let step = allowed.wrapping_sub(self.demand as i32);
        self.demand = self.demand.saturating_add(step.into());

        let period = interpolation_period(objects);
        let from = self.motion.position_at(now);
        let distance = self.demand as f64 - from;
        let reach = self.speed_limit(objects) * period.as_secs_f64();
        let to = if distance.abs() <= reach {
            self.demand as f64
        } else {
            (from + reach.copysign(distance)).round()
        };
        self.lag = self.demand.saturating_sub(whole(to));
        let window = objects.integer(object::FOLLOWING_ERROR_WINDOW);
        if window != WINDOW_OFF && self.lag.unsigned_abs() > window.unsigned_abs() {
            let register = error_register::PROFILE;
            self.fault(now, EmcyCode::FOLLOWING_ERROR, register, device);
        } else {
            self.motion = Motion::linear(now, from, to, period);
        }
    }

    fn speed_limit(&self, objects: &ObjectDictionary) -> f64 {
        let set = objects.integer(object::MAX_PROFILE_VELOCITY) as f64;
        set.min(self.speed_max_counts_per_s)
    }

    fn statusword(&self, now: Time, device: &Device) -> u16 {
        let follows = self.follows(device);
        let powered =
            matches!(self.state, DriveState::OperationEnabled | DriveState::QuickStopActive);
        let stands = self.motion.end().is_none_or(|end| now >= end);
        let limited = self.target_limited || self.lag != 0;
        let flags = [
            (Statusword::VOLTAGE_ENABLED, self.voltage),
            (Statusword::REMOTE, device.nmt_state() == NmtState::Operational),
            // In CSP the bit is reserved: here it says that a halt or quick stop is over.
            (Statusword::TARGET_REACHED, powered && stands && !follows),
            (Statusword::INTERNAL_LIMIT, follows && limited),
            (Statusword::FOLLOWS_COMMAND, follows && !limited),
            (Statusword::FOLLOWING_ERROR, device.is_active(EmcyCode::FOLLOWING_ERROR)),
        ];
        let set = flags.iter().filter(|(_, set)| *set).map(|(bit, _)| *bit);
        set.fold(Statusword::state_bits(self.state), |word, bit| word | bit)
    }

    fn digital_inputs(&self) -> i64 {
        let negative = self.negative_switch_counts.is_some_and(|at| self.counts <= at);
        let positive = self.positive_switch_counts.is_some_and(|at| self.counts >= at);
        i64::from(negative) | i64::from(positive) << 1
    }
}

impl Application for Axis {
    fn update(&mut self, now: Time, device: &mut Device) {
        if let Motion::Brake { end, to, .. } = self.motion
            && now >= end
        {
            self.motion = Motion::Hold { at: to };
        }
        if matches!(self.motion, Motion::Hold { .. })
            && let Some(next) = self.after_stop.take()
        {
            self.state = next;
        }
        self.counts = whole(self.motion.position_at(now));
        let values = [
            (object::STATUSWORD, self.statusword(now, device).into()),
            (object::MODES_OF_OPERATION_DISPLAY, mode(&device.objects).to_i8().into()),
            (object::POSITION_ACTUAL, self.counts),
            (object::POSITION_DEMAND, self.counts.wrapping_add(self.lag)),
            (object::FOLLOWING_ERROR_ACTUAL, self.lag),
            (object::VELOCITY_ACTUAL, whole(self.motion.velocity_at(now))),
            (object::DIGITAL_INPUTS, self.digital_inputs()),
        ];
        values.into_iter().for_each(|(address, value)| device.objects.set(address, value));
    }

    fn check_write(&self, _: &Device, address: ObjectAddress, value: i64) -> Result<(), AbortCode> {
        let known = match address {
            object::MODES_OF_OPERATION => [Mode::None, Mode::CyclicSynchronousPosition]
                .map(Mode::to_i8)
                .contains(&(value as i8)),
            object::QUICK_STOP_OPTION => matches!(value, 0 | 1 | 2 | 5 | 6),
            _ => true,
        };
        if known { Ok(()) } else { Err(AbortCode::InvalidValue) }
    }

    fn written(&mut self, now: Time, address: ObjectAddress, device: &mut Device) {
        match address {
            object::CONTROLWORD => self.controlword_written(now, device),
            object::MODES_OF_OPERATION if mode(&device.objects) == Mode::None => {
                self.brake(now, halt_deceleration(&device.objects));
            }
            _ => {}
        }
    }

    fn sample(&mut self, now: Time, device: &mut Device) {
        self.motion.settle(now);
        self.update(now, device);
    }

    fn sync(&mut self, now: Time, device: &mut Device) {
        if self.follows(device) {
            self.take_target(now, device);
        }
    }

    fn nmt_state_changed(&mut self, now: Time, before: NmtState, device: &mut Device) {
        let left = before == NmtState::Operational;
        if left && self.state == DriveState::OperationEnabled {
            self.abort_connection(now, EmcyCode::COMMUNICATION, device);
        }
    }

    fn heartbeat_lost(&mut self, now: Time, device: &mut Device) {
        self.partner_lost = true;
        self.abort_connection(now, EmcyCode::HEARTBEAT, device);
    }

    fn heartbeat_returned(&mut self, _: Time, device: &mut Device) {
        self.partner_lost = false;
        // In a fault the error stays until the fault is reset.
        if !matches!(self.state, DriveState::Fault | DriveState::FaultReactionActive) {
            device.clear(EmcyCode::HEARTBEAT);
        }
    }

    fn reset(&mut self, now: Time, _: &mut Device) {
        self.power_off(now);
        self.demand = whole(self.motion.position_at(now));
        self.target_limited = false;
        self.reset_bit = false;
        self.partner_lost = false;
    }

    fn deadline(&self) -> Time {
        match self.motion {
            Motion::Brake { end, .. } => end,
            Motion::Hold { .. } | Motion::Linear { .. } => Time::NEVER,
        }
    }
}

fn mode(objects: &ObjectDictionary) -> Mode {
    Mode::from_i8(objects.integer(object::MODES_OF_OPERATION) as i8)
}

fn whole(counts: f64) -> i64 {
    counts.round() as i64
}

fn halt_deceleration(objects: &ObjectDictionary) -> i64 {
    objects.integer(match objects.integer(object::HALT_OPTION) {
        2 => object::QUICK_STOP_DECELERATION,
        _ => object::PROFILE_DECELERATION,
    })
}

/// Object 0x60C2: value times a power of ten, in seconds.
fn interpolation_period(objects: &ObjectDictionary) -> Duration {
    let value = objects.integer(object::INTERPOLATION_PERIOD_VALUE) as f64;
    let exponent = objects.integer(object::INTERPOLATION_PERIOD_EXPONENT) as i32;
    Duration::from_secs_f64(value * 10f64.powi(exponent))
}

/// `target` cut to 0x607D, which is off while both limits are 0.
fn within_limits(target: i32, objects: &ObjectDictionary) -> i32 {
    let min = objects.integer(object::SOFTWARE_LIMIT_MIN) as i32;
    let max = objects.integer(object::SOFTWARE_LIMIT_MAX) as i32;
    if min == 0 && max == 0 { target } else { target.min(max).max(min) }
}
