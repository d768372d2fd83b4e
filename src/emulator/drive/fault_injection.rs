//! The scripted faults of the axis.

use super::axis::Axis;
use super::device::Device;
use super::inputs::End;
use super::motion::Motion;
use crate::canopen::emcy::EmcyCode;
use crate::emulator::fault::{Fault, FaultKind};
use crate::units::Time;

/// Emergency code of the safety input: an external error.
const INTERLOCK: EmcyCode = EmcyCode(0x9000);

impl Axis {
    /// A fault of the axis begins or ends.
    pub(super) fn apply_fault(
        &mut self,
        now: Time,
        fault: &Fault,
        begins: bool,
        device: &mut Device,
    ) {
        match fault.kind {
            FaultKind::Stall => {
                self.is_stalled = begins;
                if begins {
                    let ramped = matches!(self.motion, Motion::Ramped(_));
                    self.motion = Motion::Hold { at: self.motion.position_at(now) };
                    if ramped {
                        self.fault(now, EmcyCode::FOLLOWING_ERROR, device);
                    }
                }
            }
            FaultKind::DriveFault if begins => {
                self.fault(now, EmcyCode(fault.code.unwrap_or_default()), device);
            }
            FaultKind::NegativeSwitch => {
                self.inputs.stuck[End::Negative as usize] = begins;
            }
            FaultKind::PositiveSwitch => {
                self.inputs.stuck[End::Positive as usize] = begins;
            }
            FaultKind::EmergencyStop => {
                self.inputs.interlocked = begins;
                self.handle_torque_loss(now, INTERLOCK, device);
            }
            FaultKind::NoVoltage => {
                self.has_voltage = !begins;
                self.handle_torque_loss(now, EmcyCode::UNDERVOLTAGE, device);
            }
            _ => {}
        }
    }

    /// Stops an axis that has lost its torque at once, also in its fault reaction, and raises `code`.
    fn handle_torque_loss(&mut self, now: Time, code: EmcyCode, device: &mut Device) {
        if !self.has_torque() && self.state().may_have_power() {
            self.motion = Motion::Hold { at: self.motion.position_at(now) };
            self.fault(now, code, device);
        }
    }
}
