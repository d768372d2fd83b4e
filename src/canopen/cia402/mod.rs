//! The drive profile (CiA 402): statusword, controlword, modes, and the steps to Operation Enabled.

pub mod object;

use std::fmt;

/// The states of a drive (CiA 402-2, power drive system state machine).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, derive_more::Display)]
pub enum DriveState {
    /// Starting up.
    #[display("not ready to switch on")]
    NotReadyToSwitchOn,
    /// Waiting for Shutdown.
    #[display("switch on disabled")]
    SwitchOnDisabled,
    /// Power may be applied.
    #[display("ready to switch on")]
    ReadyToSwitchOn,
    /// Power is applied, no torque.
    #[display("switched on")]
    SwitchedOn,
    /// The drive follows its set-points.
    #[display("operation enabled")]
    OperationEnabled,
    /// Quick stop is under way or holds the axis.
    #[display("quick stop active")]
    QuickStopActive,
    /// Stopping because of a fault.
    #[display("fault reaction active")]
    FaultReactionActive,
    /// Stopped by a fault; waits for a reset.
    #[display("fault")]
    Fault,
}

impl DriveState {
    /// True in Fault and in Fault Reaction Active.
    pub fn is_fault(self) -> bool {
        matches!(self, DriveState::Fault | DriveState::FaultReactionActive)
    }

    /// True if the motor may have power.
    pub fn may_have_power(self) -> bool {
        use DriveState::{FaultReactionActive, OperationEnabled, QuickStopActive, SwitchedOn};
        matches!(self, SwitchedOn | OperationEnabled | QuickStopActive | FaultReactionActive)
    }
}

/// Object 0x6041.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Statusword(pub u16);

impl Statusword {
    /// Bit 4: the power stage has its supply.
    pub const VOLTAGE_ENABLED: u16 = 1 << 4;
    /// Bit 7: the drive warns.
    pub const WARNING: u16 = 1 << 7;
    /// Bit 9: the drive obeys the controlword.
    pub const REMOTE: u16 = 1 << 9;
    /// Bit 10: the target is reached; in homing, the axis stands.
    pub const TARGET_REACHED: u16 = 1 << 10;
    /// Bit 11: an internal limit is active.
    pub const INTERNAL_LIMIT: u16 = 1 << 11;
    /// Bit 12 in CSP: the drive follows the command value.
    pub const FOLLOWS_COMMAND: u16 = 1 << 12;
    /// Bit 12 in homing: the axis is homed.
    pub const HOMING_ATTAINED: u16 = 1 << 12;
    /// Bit 13 in PP and CSP: the position has left the following-error window.
    pub const FOLLOWING_ERROR: u16 = 1 << 13;
    /// Bit 13 in homing: homing error.
    pub const HOMING_ERROR: u16 = 1 << 13;

    /// Each state, the mask of the bits that identify it, and their value.
    const STATES: [(DriveState, u16, u16); 8] = [
        (DriveState::NotReadyToSwitchOn, 0x4f, 0x00),
        (DriveState::SwitchOnDisabled, 0x4f, 0x40),
        (DriveState::FaultReactionActive, 0x4f, 0x0f),
        (DriveState::Fault, 0x4f, 0x08),
        (DriveState::ReadyToSwitchOn, 0x6f, 0x21),
        (DriveState::SwitchedOn, 0x6f, 0x23),
        (DriveState::OperationEnabled, 0x6f, 0x27),
        (DriveState::QuickStopActive, 0x6f, 0x07),
    ];

    /// True in Fault and in Fault Reaction Active.
    pub fn is_fault(self) -> bool {
        self.state().is_some_and(DriveState::is_fault)
    }

    /// The drive's state; `None` for a pattern the profile does not define.
    pub fn state(self) -> Option<DriveState> {
        let state = Self::STATES.iter().find(|(_, mask, bits)| self.0 & mask == *bits);
        state.map(|(state, ..)| *state)
    }

    /// The bits that identify `state`, of bits 0 to 3, 5 and 6.
    pub fn state_bits(state: DriveState) -> u16 {
        let bits = Self::STATES.iter().find(|(known, ..)| *known == state);
        bits.map_or(0, |(.., bits)| *bits)
    }

    /// True when any of `bits` is set.
    pub const fn has(self, bits: u16) -> bool {
        self.0 & bits != 0
    }
}

/// `0x1637 operation enabled`.
impl fmt::Display for Statusword {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "0x{:04X} ", self.0)?;
        match self.state() {
            Some(state) => state.fmt(f),
            None => f.write_str("undefined drive state"),
        }
    }
}

/// Object 0x6040: the commands and their bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Controlword(pub u16);

impl Controlword {
    /// Bit 0.
    pub const SWITCH_ON_BIT: u16 = 1 << 0;
    /// Bit 1.
    pub const ENABLE_VOLTAGE_BIT: u16 = 1 << 1;
    /// Bit 2: quick stop when *clear*.
    pub const NO_QUICK_STOP_BIT: u16 = 1 << 2;
    /// Bit 3.
    pub const ENABLE_OPERATION_BIT: u16 = 1 << 3;
    /// Bit 4 in homing: homing starts on its rising edge and goes on while it is set.
    pub const HOMING_START_BIT: u16 = 1 << 4;
    /// Bit 7: a fault is reset on its rising edge.
    pub const FAULT_RESET_BIT: u16 = 1 << 7;
    /// Bit 8: halt.
    pub const HALT_BIT: u16 = 1 << 8;

    /// Power off at once, the axis coasts.
    pub const DISABLE_VOLTAGE: Self = Controlword(0x0000);
    /// Brake as 0x605A says.
    pub const QUICK_STOP: Self = Controlword(0x0002);
    /// To Ready To Switch On.
    pub const SHUTDOWN: Self = Controlword(0x0006);
    /// To Switched On.
    pub const SWITCH_ON: Self = Controlword(0x0007);
    /// To Operation Enabled.
    pub const ENABLE_OPERATION: Self = Controlword(0x000f);
    /// In Operation Enabled and in homing mode, start homing.
    pub const START_HOMING: Self = Controlword(0x001f);
    /// Its rising edge leaves Fault.
    pub const FAULT_RESET: Self = Controlword(0x0080);

    /// True when any of `bits` is set.
    pub const fn has(self, bits: u16) -> bool {
        self.0 & bits != 0
    }
}

/// A mode of operation, objects 0x6060 and 0x6061. Negative ones are the manufacturer's own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Mode(pub i8);

impl Mode {
    /// No mode.
    pub const NONE: Self = Mode(0);
    /// Homing.
    pub const HOMING: Self = Mode(6);
    /// Cyclic synchronous position.
    pub const CSP: Self = Mode(8);

    /// True when `supported_modes` (object 0x6502) has this mode's bit set.
    pub const fn is_in(self, supported_modes: u32) -> bool {
        matches!(self.0, 1..=32) && supported_modes >> (self.0 - 1) & 1 != 0
    }
}

/// `cyclic synchronous position`.
impl fmt::Display for Mode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self.0 {
            0 => "no mode",
            1 => "profile position",
            2 => "velocity",
            3 => "profile velocity",
            4 => "profile torque",
            6 => "homing",
            7 => "interpolated position",
            8 => "cyclic synchronous position",
            9 => "cyclic synchronous velocity",
            10 => "cyclic synchronous torque",
            mode => return write!(f, "mode {mode}"),
        })
    }
}

/// Leads a drive from any state to Operation Enabled, one controlword for each statusword. A new sequence
/// does not know which controlword the drive was sent last.
#[derive(Debug, Clone, Default)]
pub struct EnableSequence {
    /// Bit 7 (fault reset) of the last controlword was clear, so that the next can make its rising edge.
    reset_bit_was_clear: bool,
}

impl EnableSequence {
    /// The controlword to send now: one step nearer to Operation Enabled, or 0x0000 in a state that the
    /// drive must leave by itself. In Fault, 0x0000 and 0x0080 alternate, so that a drive that missed or
    /// refused one rising edge of Fault Reset gets another.
    pub fn step(&mut self, statusword: Statusword) -> Controlword {
        let controlword = match statusword.state() {
            Some(DriveState::SwitchOnDisabled) => Controlword::SHUTDOWN,
            Some(DriveState::ReadyToSwitchOn) => Controlword::SWITCH_ON,
            Some(DriveState::SwitchedOn | DriveState::OperationEnabled) => {
                Controlword::ENABLE_OPERATION
            }
            Some(DriveState::Fault) if self.reset_bit_was_clear => Controlword::FAULT_RESET,
            _ => Controlword::DISABLE_VOLTAGE,
        };
        self.reset_bit_was_clear = controlword != Controlword::FAULT_RESET;
        controlword
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use DriveState as S;

    #[test]
    fn states_are_decoded_by_their_masks() {
        let words = [
            (0x0000, Some(S::NotReadyToSwitchOn)),
            (0x0250, Some(S::SwitchOnDisabled)),
            (0x0270, Some(S::SwitchOnDisabled)),
            (0x0231, Some(S::ReadyToSwitchOn)),
            (0x0233, Some(S::SwitchedOn)),
            (0x1637, Some(S::OperationEnabled)),
            (0x0217, Some(S::QuickStopActive)),
            (0x021f, Some(S::FaultReactionActive)),
            (0x0218, Some(S::Fault)),
            (0x0238, Some(S::Fault)),
            (0x0022, None),
            (0x0067, None),
        ];
        for (word, state) in words {
            assert_eq!(Statusword(word).state(), state, "0x{word:04X}");
        }
        assert_eq!(Statusword(0x1637).to_string(), "0x1637 operation enabled");
    }

    #[test]
    fn every_state_has_bits_that_decode_to_it() {
        for state in [
            S::NotReadyToSwitchOn,
            S::SwitchOnDisabled,
            S::ReadyToSwitchOn,
            S::SwitchedOn,
            S::OperationEnabled,
            S::QuickStopActive,
            S::FaultReactionActive,
            S::Fault,
        ] {
            assert_eq!(Statusword(Statusword::state_bits(state)).state(), Some(state));
        }
    }

    #[test]
    fn enabling_commands_shutdown_then_switch_on_then_enable() {
        let mut sequence = EnableSequence::default();
        let mut step = |state| sequence.step(Statusword(Statusword::state_bits(state)));
        assert_eq!(step(S::NotReadyToSwitchOn).0, 0x00);
        assert_eq!(step(S::SwitchOnDisabled).0, 0x06);
        assert_eq!(step(S::ReadyToSwitchOn).0, 0x07);
        assert_eq!(step(S::SwitchedOn).0, 0x0f);
        assert_eq!(step(S::OperationEnabled).0, 0x0f);
        assert_eq!(step(S::QuickStopActive).0, 0x00);
    }

    #[test]
    fn fault_reset_follows_a_controlword_with_bit_7_low() {
        let fault = Statusword(Statusword::state_bits(S::Fault));
        let mut sequence = EnableSequence::default();
        let sent: Vec<u16> = (0..4).map(|_| sequence.step(fault).0).collect();
        assert_eq!(sent, [0x00, 0x80, 0x00, 0x80]);

        let mut sequence = EnableSequence::default();
        sequence.step(Statusword(0x1637));
        assert_eq!(sequence.step(fault).0, 0x80, "the 0x0F before had bit 7 low");
    }

    #[test]
    fn a_mode_is_supported_by_its_bit_in_6502() {
        assert!(Mode::CSP.is_in(0x3a5));
        assert!(Mode::HOMING.is_in(0x3a5));
        assert!(!Mode(7).is_in(0x3a5), "interpolated position");
        assert!(!Mode::NONE.is_in(u32::MAX) && !Mode(-1).is_in(u32::MAX));
        assert!(!Mode(33).is_in(u32::MAX));
        assert_eq!(
            (Mode(3).to_string(), Mode(-1).to_string()),
            ("profile velocity".into(), "mode -1".into())
        );
    }
}
