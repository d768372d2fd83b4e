//! The drive's statusword, object 0x6041.

use super::{Axis, End, Homing, Model};
use crate::canopen::cia402::{DriveState, Mode, Statusword};
use crate::canopen::emcy::EmcyCode;
use crate::canopen::nmt::NmtState;
use crate::canopen::node::Device;
use crate::units::Time;

/// Bit 15, manufacturer-specific: the axis was homed.
const REFERENCED: u16 = 1 << 15;

impl Axis {
    pub(super) fn statusword(&self, now: Time, device: &Device) -> u16 {
        let follows = self.follows(device);
        let powered =
            matches!(self.state, DriveState::OperationEnabled | DriveState::QuickStopActive);
        let stands = self.motion.end().is_none_or(|end| now >= end);
        let limited = self.target_limited || self.lag != 0;
        let on_switch = [End::Negative, End::Positive]
            .into_iter()
            .any(|end| self.inputs.is_closed(end, self.counts));
        // The meaning of bits 10, 12 and 13 depends on the mode. In CSP bit 10 is reserved; this drive
        // sets it when a halt or quick stop is over.
        let following_error = device.is_active(EmcyCode::FOLLOWING_ERROR);
        let (reached, bit_12, bit_13) = match self.mode(&device.objects) {
            Mode::HOMING => {
                let failed = self.homing == Homing::Failed;
                (powered && stands, self.referenced && !failed, failed)
            }
            _ => (powered && stands && !follows, follows && !limited, following_error),
        };
        let flags = [
            (Statusword::VOLTAGE_ENABLED, self.voltage),
            (Statusword::REMOTE, device.nmt_state() == NmtState::Operational),
            (Statusword::TARGET_REACHED, reached),
            (Statusword::INTERNAL_LIMIT, follows && limited || powered && on_switch),
            // These two bits have other names in homing.
            (Statusword::FOLLOWS_COMMAND, bit_12),
            (Statusword::FOLLOWING_ERROR, bit_13),
            (REFERENCED, self.referenced && self.model == Model::Epos4),
        ];
        let set = flags.iter().filter(|(_, set)| *set).map(|(bit, _)| *bit);
        set.fold(Statusword::state_bits(self.state), |word, bit| word | bit)
    }
}
