//! Objects of the drive profile.

use crate::canopen::ObjectAddress;

macro_rules! objects {
    ($($(#[$doc:meta])* $name:ident = $index:literal : $subindex:literal;)*) => {
        $($(#[$doc])* pub const $name: ObjectAddress = ObjectAddress::new($index, $subindex);)*
    };
}

objects! {
    /// u16: emergency code of the fault.
    ERROR_CODE = 0x603f:0;
    /// i16: what a drive does when communication is lost: 0 nothing, 1 fault, 2 disable voltage,
    /// 3 quick stop.
    ABORT_CONNECTION_OPTION = 0x6007:0;
    /// u16.
    CONTROLWORD = 0x6040:0;
    /// u16.
    STATUSWORD = 0x6041:0;
    /// i16: how quick stop decelerates.
    QUICK_STOP_OPTION = 0x605a:0;
    /// i16: how halt decelerates.
    HALT_OPTION = 0x605d:0;
    /// i16: how a fault stops the drive.
    FAULT_REACTION_OPTION = 0x605e:0;
    /// i8.
    MODES_OF_OPERATION = 0x6060:0;
    /// i8.
    MODES_OF_OPERATION_DISPLAY = 0x6061:0;
    /// i32, counts.
    POSITION_DEMAND = 0x6062:0;
    /// i32, counts.
    POSITION_ACTUAL = 0x6064:0;
    /// u32, counts: largest distance of actual from demand.
    FOLLOWING_ERROR_WINDOW = 0x6065:0;
    /// u16, ms: how long the window may be left before it is a fault.
    FOLLOWING_ERROR_TIMEOUT = 0x6066:0;
    /// i32, counts per second.
    VELOCITY_ACTUAL = 0x606c:0;
    /// i32, counts.
    TARGET_POSITION = 0x607a:0;
    /// i32, counts: beyond these two the position wraps to the other one; 0 and 0 for no wrapping.
    POSITION_RANGE_MIN = 0x607b:1;
    /// i32, counts.
    POSITION_RANGE_MAX = 0x607b:2;
    /// i32, counts: from the home position to zero.
    HOME_OFFSET = 0x607c:0;
    /// i32, counts.
    SOFTWARE_LIMIT_MIN = 0x607d:1;
    /// i32, counts.
    SOFTWARE_LIMIT_MAX = 0x607d:2;
    /// u32, counts per second.
    MAX_PROFILE_VELOCITY = 0x607f:0;
    /// u32, counts per second squared.
    PROFILE_DECELERATION = 0x6084:0;
    /// u32, counts per second squared.
    QUICK_STOP_DECELERATION = 0x6085:0;
    /// i8: how home is found.
    HOMING_METHOD = 0x6098:0;
    /// u32, counts per second: towards the switch.
    HOMING_SPEED_SWITCH = 0x6099:1;
    /// u32, counts per second: towards zero.
    HOMING_SPEED_ZERO = 0x6099:2;
    /// u32, counts per second squared.
    HOMING_ACCELERATION = 0x609a:0;
    /// i32, counts: the drive adds it to each target in cyclic synchronous position.
    POSITION_OFFSET = 0x60b0:0;
    /// i32, counts per second: the same for the velocity.
    VELOCITY_OFFSET = 0x60b1:0;
    /// i16, thousandths of the rated torque: the same for the torque.
    TORQUE_OFFSET = 0x60b2:0;
    /// u8: mantissa of the interpolation period.
    INTERPOLATION_PERIOD_VALUE = 0x60c2:1;
    /// i8: power of ten, in seconds, of the interpolation period.
    INTERPOLATION_PERIOD_EXPONENT = 0x60c2:2;
    /// i32, counts.
    FOLLOWING_ERROR_ACTUAL = 0x60f4:0;
    /// u32: bit 0 negative limit switch, 1 positive, 2 home.
    DIGITAL_INPUTS = 0x60fd:0;
    /// u32: bit n set for mode n+1.
    SUPPORTED_MODES = 0x6502:0;
}
