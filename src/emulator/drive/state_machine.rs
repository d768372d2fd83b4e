//! The transitions a controlword can cause (CiA 402-2, power drive system state machine).
//!
//! The table leaves out the events of the drive: transitions 0 and 1 are power-on, 13 and 14 a fault,
//! 15 the rising edge of bit 7. The end of a quick stop also causes transition 12. The axis allows 16 only
//! if the drive stays in Quick Stop Active (0x605A: 5 or 6).

use crate::canopen::cia402::{Controlword, DriveState};

/// The command in bits 0 to 3 of a controlword.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Command {
    DisableVoltage,
    QuickStop,
    Shutdown,
    /// Also called Disable Operation, when operation is enabled.
    SwitchOn,
    EnableOperation,
}

impl Command {
    pub(super) fn of(controlword: Controlword) -> Self {
        if !controlword.has(Controlword::ENABLE_VOLTAGE_BIT) {
            Command::DisableVoltage
        } else if !controlword.has(Controlword::NO_QUICK_STOP_BIT) {
            Command::QuickStop
        } else if !controlword.has(Controlword::SWITCH_ON_BIT) {
            Command::Shutdown
        } else if !controlword.has(Controlword::ENABLE_OPERATION_BIT) {
            Command::SwitchOn
        } else {
            Command::EnableOperation
        }
    }
}

/// The state `command` leads to from `state` in one transition; `None` when it causes none.
pub(super) fn transition(state: DriveState, command: Command) -> Option<DriveState> {
    use Command as C;
    use DriveState as S;
    Some(match (state, command) {
        (S::SwitchOnDisabled, C::Shutdown) => S::ReadyToSwitchOn, // 2
        // With Enable Operation this is the first half of 3 + 4 in one command.
        (S::ReadyToSwitchOn, C::SwitchOn | C::EnableOperation) => S::SwitchedOn, // 3
        (S::SwitchedOn, C::EnableOperation) => S::OperationEnabled,              // 4
        (S::OperationEnabled, C::SwitchOn) => S::SwitchedOn,                     // 5
        (S::SwitchedOn, C::Shutdown) => S::ReadyToSwitchOn,                      // 6
        (S::ReadyToSwitchOn, C::QuickStop | C::DisableVoltage) => S::SwitchOnDisabled, // 7
        (S::OperationEnabled, C::Shutdown) => S::ReadyToSwitchOn,                // 8
        (S::OperationEnabled, C::DisableVoltage) => S::SwitchOnDisabled,         // 9
        (S::SwitchedOn, C::QuickStop | C::DisableVoltage) => S::SwitchOnDisabled, // 10
        (S::OperationEnabled, C::QuickStop) => S::QuickStopActive,               // 11
        (S::QuickStopActive, C::DisableVoltage) => S::SwitchOnDisabled,          // 12
        (S::QuickStopActive, C::EnableOperation) => S::OperationEnabled,         // 16
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use DriveState as S;

    /// Rows and columns are as in the standard. `-` is no transition.
    #[test]
    fn every_state_answers_every_command_as_in_cia_402() {
        let columns = [0x00, 0x02, 0x06, 0x07, 0x0f];
        let states = [
            ('N', S::NotReadyToSwitchOn),
            ('D', S::SwitchOnDisabled),
            ('R', S::ReadyToSwitchOn),
            ('S', S::SwitchedOn),
            ('E', S::OperationEnabled),
            ('Q', S::QuickStopActive),
            ('A', S::FaultReactionActive),
            ('F', S::Fault),
        ];
        let table = [
            ('N', "-----"),
            ('D', "--R--"),
            ('R', "DD-SS"),
            ('S', "DDR-E"),
            ('E', "DQRS-"),
            ('Q', "D---E"),
            ('A', "-----"),
            ('F', "-----"),
        ];
        let named = |wanted| states.iter().find(|(name, _)| *name == wanted).map(|(_, s)| *s);
        for (from, row) in table {
            for (controlword, to) in columns.into_iter().zip(row.chars()) {
                let command = Command::of(Controlword(controlword));
                let reached = transition(named(from).unwrap(), command);
                assert_eq!(reached, named(to), "{from} with 0x{controlword:02X}");
            }
        }
    }

    #[test]
    fn a_command_is_decoded_by_its_own_bits_only() {
        for (controlword, command) in [
            (0x008d, Command::DisableVoltage),
            (0x000b, Command::QuickStop),
            (0x011e, Command::Shutdown),
            (0x01f7, Command::SwitchOn),
            (0x001f, Command::EnableOperation),
        ] {
            assert_eq!(Command::of(Controlword(controlword)), command, "0x{controlword:04X}");
        }
    }
}
