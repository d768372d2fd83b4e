//! The drive profile (CiA 402): statusword, controlword, modes, and the way to Operation Enabled.

pub mod object;

use std::fmt;

/// The states of a drive (CiA 402-2, power drive system state machine).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum DriveState {
    /// Starting up.
    NotReadyToSwitchOn,
    /// Waiting for Shutdown.
    SwitchOnDisabled,
    /// Power may be applied.
    ReadyToSwitchOn,
    /// Power is applied, no torque.
    SwitchedOn,
    /// The drive follows its set-points.
    OperationEnabled,
    /// Quick stop is under way or holds the axis.
    QuickStopActive,
    /// Stopping because of a fault.
    FaultReactionActive,
    /// Stopped by a fault; waits for a reset.
    Fault,
}

impl fmt::Display for DriveState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            DriveState::NotReadyToSwitchOn => "not ready to switch on",
            DriveState::SwitchOnDisabled => "switch on disabled",
            DriveState::ReadyToSwitchOn => "ready to switch on",
            DriveState::SwitchedOn => "switched on",
            DriveState::OperationEnabled => "operation enabled",
            DriveState::QuickStopActive => "quick stop active",
            DriveState::FaultReactionActive => "fault reaction active",
            DriveState::Fault => "fault",
        })
    }
}

/// Object 0x6041.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Statusword(pub u16);

impl Statusword {
    /// Bit 4: power is on.
    pub const VOLTAGE_ENABLED: u16 = 1 << 4;
    /// Bit 7.
    pub const WARNING: u16 = 1 << 7;
    /// Bit 9: the drive obeys the controlword.
    pub const REMOTE: u16 = 1 << 9;
    /// Bit 10.
    pub const TARGET_REACHED: u16 = 1 << 10;
    /// Bit 11: a limit inside the drive holds.
    pub const INTERNAL_LIMIT: u16 = 1 << 11;
    /// Bit 12 in CSP: the drive follows the command value.
    pub const FOLLOWS_COMMAND: u16 = 1 << 12;
    /// Bit 12 in homing: the axis is homed.
    pub const HOMING_ATTAINED: u16 = 1 << 12;
    /// Bit 13 in PP and CSP.
    pub const FOLLOWING_ERROR: u16 = 1 << 13;
    /// Bit 13 in homing: it failed.
    pub const HOMING_ERROR: u16 = 1 << 13;

    /// The drive's state; `None` for a pattern the profile does not define.
    pub const fn state(self) -> Option<DriveState> {
        Some(match (self.0 & 0x4f, self.0 & 0x6f) {
            (0x00, _) => DriveState::NotReadyToSwitchOn,
            (0x40, _) => DriveState::SwitchOnDisabled,
            (0x0f, _) => DriveState::FaultReactionActive,
            (0x08, _) => DriveState::Fault,
            (_, 0x21) => DriveState::ReadyToSwitchOn,
            (_, 0x23) => DriveState::SwitchedOn,
            (_, 0x27) => DriveState::OperationEnabled,
            (_, 0x07) => DriveState::QuickStopActive,
            _ => return None,
        })
    }

    /// The bits 0 to 3, 5 and 6 that say `state`.
    pub const fn state_bits(state: DriveState) -> u16 {
        match state {
            DriveState::NotReadyToSwitchOn => 0x00,
            DriveState::SwitchOnDisabled => 0x40,
            DriveState::ReadyToSwitchOn => 0x21,
            DriveState::SwitchedOn => 0x23,
            DriveState::OperationEnabled => 0x27,
            DriveState::QuickStopActive => 0x07,
            DriveState::FaultReactionActive => 0x0f,
            DriveState::Fault => 0x08,
        }
    }

    const fn has(self, bit: u16) -> bool {
        self.0 & bit != 0
    }

    /// Bit 7.
    pub const fn warning(self) -> bool {
        self.has(Self::WARNING)
    }

    /// Bit 9: the drive obeys the controlword.
    pub const fn remote(self) -> bool {
        self.has(Self::REMOTE)
    }

    /// Bit 10.
    pub const fn target_reached(self) -> bool {
        self.has(Self::TARGET_REACHED)
    }

    /// Bit 11: a limit inside the drive holds.
    pub const fn internal_limit(self) -> bool {
        self.has(Self::INTERNAL_LIMIT)
    }

    /// Bit 12 in homing: the axis is homed.
    pub const fn homing_attained(self) -> bool {
        self.has(Self::HOMING_ATTAINED)
    }

    /// Bit 13 in homing: it failed.
    pub const fn homing_error(self) -> bool {
        self.has(Self::HOMING_ERROR)
    }

    /// Bit 13 in PP and CSP.
    pub const fn following_error(self) -> bool {
        self.has(Self::FOLLOWING_ERROR)
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

impl fmt::Debug for Statusword {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Statusword({self})")
    }
}

/// Object 0x6040: the commands, and the bits they are made of.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Default)]
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
    /// Bit 4 in homing: start on the rising edge, go on while it is set.
    pub const HOMING_START_BIT: u16 = 1 << 4;
    /// Bit 7: a fault is reset on its rising edge.
    pub const FAULT_RESET_BIT: u16 = 1 << 7;
    /// Bit 8.
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
    /// In Operation Enabled, find home.
    pub const START_HOMING: Self = Controlword(0x001f);
    /// Its rising edge leaves Fault.
    pub const FAULT_RESET: Self = Controlword(0x0080);

    /// True when any of `bits` is set.
    pub const fn has(self, bits: u16) -> bool {
        self.0 & bits != 0
    }
}

impl fmt::Debug for Controlword {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Controlword(0x{:04X})", self.0)
    }
}

/// Object 0x6060 and 0x6061.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Mode {
    /// 0.
    None,
    /// 1, PP.
    ProfilePosition,
    /// 2, VL.
    Velocity,
    /// 3, PV.
    ProfileVelocity,
    /// 4, TQ.
    ProfileTorque,
    /// 6, HM.
    Homing,
    /// 7, IP.
    InterpolatedPosition,
    /// 8, CSP.
    CyclicSynchronousPosition,
    /// 9, CSV.
    CyclicSynchronousVelocity,
    /// 10, CST.
    CyclicSynchronousTorque,
    /// Reserved, or the manufacturer's own (negative).
    Unknown(i8),
}

impl Mode {
    /// From the object's value.
    pub const fn from_i8(value: i8) -> Self {
        match value {
            0 => Mode::None,
            1 => Mode::ProfilePosition,
            2 => Mode::Velocity,
            3 => Mode::ProfileVelocity,
            4 => Mode::ProfileTorque,
            6 => Mode::Homing,
            7 => Mode::InterpolatedPosition,
            8 => Mode::CyclicSynchronousPosition,
            9 => Mode::CyclicSynchronousVelocity,
            10 => Mode::CyclicSynchronousTorque,
            other => Mode::Unknown(other),
        }
    }

    /// The object's value.
    pub const fn to_i8(self) -> i8 {
        match self {
            Mode::None => 0,
            Mode::ProfilePosition => 1,
            Mode::Velocity => 2,
            Mode::ProfileVelocity => 3,
            Mode::ProfileTorque => 4,
            Mode::Homing => 6,
            Mode::InterpolatedPosition => 7,
            Mode::CyclicSynchronousPosition => 8,
            Mode::CyclicSynchronousVelocity => 9,
            Mode::CyclicSynchronousTorque => 10,
            Mode::Unknown(other) => other,
        }
    }

    /// True when `supported_modes`, object 0x6502, has this mode's bit.
    pub const fn is_in(self, supported_modes: u32) -> bool {
        match self.to_i8() {
            mode @ 1..=32 => supported_modes >> (mode - 1) & 1 != 0,
            _ => false,
        }
    }
}

/// `cyclic synchronous position`.
impl fmt::Display for Mode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Mode::None => "no mode",
            Mode::ProfilePosition => "profile position",
            Mode::Velocity => "velocity",
            Mode::ProfileVelocity => "profile velocity",
            Mode::ProfileTorque => "profile torque",
            Mode::Homing => "homing",
            Mode::InterpolatedPosition => "interpolated position",
            Mode::CyclicSynchronousPosition => "cyclic synchronous position",
            Mode::CyclicSynchronousVelocity => "cyclic synchronous velocity",
            Mode::CyclicSynchronousTorque => "cyclic synchronous torque",
            Mode::Unknown(mode) => return write!(f, "mode {mode}"),
        })
    }
}

/// Object 0x6007: what a drive does when communication is lost or the node leaves Operational.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum AbortConnection {
    /// 0: nothing.
    NoAction,
    /// 1: fault.
    FaultSignal,
    /// 2: disable voltage.
    DisableVoltage,
    /// 3: quick stop.
    QuickStop,
    /// A value the profile does not define.
    Unknown(i16),
}

impl AbortConnection {
    /// From the object's value.
    pub const fn from_i16(value: i16) -> Self {
        match value {
            0 => AbortConnection::NoAction,
            1 => AbortConnection::FaultSignal,
            2 => AbortConnection::DisableVoltage,
            3 => AbortConnection::QuickStop,
            other => AbortConnection::Unknown(other),
        }
    }
}

/// The controlword that takes a drive one step from `state` towards Operation Enabled; `None`
/// where only waiting helps. From Fault it is Fault Reset, which works on its rising edge only:
/// [`EnableSequence`] makes that edge.
pub const fn next_controlword(state: DriveState) -> Option<u16> {
    match state {
        DriveState::NotReadyToSwitchOn | DriveState::FaultReactionActive => None,
        DriveState::SwitchOnDisabled => Some(Controlword::SHUTDOWN.0),
        DriveState::ReadyToSwitchOn => Some(Controlword::SWITCH_ON.0),
        DriveState::SwitchedOn | DriveState::OperationEnabled => {
            Some(Controlword::ENABLE_OPERATION.0)
        }
        DriveState::QuickStopActive => Some(Controlword::DISABLE_VOLTAGE.0),
        DriveState::Fault => Some(Controlword::FAULT_RESET.0),
    }
}

/// Leads a drive from any state to Operation Enabled, one controlword for each statusword.
#[derive(Debug, Clone, Default)]
pub struct EnableSequence {
    /// The last controlword had bit 7 low, so that the next can raise it.
    armed: bool,
}

impl EnableSequence {
    /// A new sequence; knows nothing of the controlword sent before.
    pub fn new() -> Self {
        Self::default()
    }

    /// The controlword to send now. In Fault it goes 0x0000, 0x0080, 0x0000 and so on, so that
    /// a drive that missed or refused one rising edge gets another.
    pub fn step(&mut self, statusword: Statusword) -> u16 {
        let wanted = statusword.state().and_then(next_controlword).unwrap_or(0);
        let raises = Controlword(wanted).has(Controlword::FAULT_RESET_BIT);
        let sent = if raises && !self.armed { 0 } else { wanted };
        self.armed = !Controlword(sent).has(Controlword::FAULT_RESET_BIT);
        sent
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
    fn the_way_up_is_shutdown_switch_on_enable() {
        let mut sequence = EnableSequence::new();
        let mut step = |state| sequence.step(Statusword(Statusword::state_bits(state)));
        assert_eq!(step(S::NotReadyToSwitchOn), 0x00);
        assert_eq!(step(S::SwitchOnDisabled), 0x06);
        assert_eq!(step(S::ReadyToSwitchOn), 0x07);
        assert_eq!(step(S::SwitchedOn), 0x0f);
        assert_eq!(step(S::OperationEnabled), 0x0f);
        assert_eq!(step(S::QuickStopActive), 0x00);
    }

    #[test]
    fn a_fault_is_reset_on_a_rising_edge_the_sequence_made_itself() {
        let fault = Statusword(Statusword::state_bits(S::Fault));
        let mut sequence = EnableSequence::new();
        let sent: Vec<u16> = (0..4).map(|_| sequence.step(fault)).collect();
        assert_eq!(sent, [0x00, 0x80, 0x00, 0x80]);

        let mut sequence = EnableSequence::new();
        sequence.step(Statusword(0x1637));
        assert_eq!(sequence.step(fault), 0x80, "0x0F before it was low already");
    }

    #[test]
    fn modes_are_bits_of_6502() {
        assert!(Mode::CyclicSynchronousPosition.is_in(0x3a5));
        assert!(Mode::Homing.is_in(0x3a5));
        assert!(!Mode::InterpolatedPosition.is_in(0x3a5));
        assert!(!Mode::None.is_in(u32::MAX) && !Mode::Unknown(-1).is_in(u32::MAX));
        for value in i8::MIN..=i8::MAX {
            assert_eq!(Mode::from_i8(value).to_i8(), value);
        }
    }
}
