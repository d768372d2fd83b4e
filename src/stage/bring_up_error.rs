//! Who a drive is, and why it could not be brought up.

use std::fmt;
use std::time::Duration;

use super::BringUpPart;
use crate::canopen::ObjectAddress;
use crate::canopen::cia402::{Mode, Statusword};
use crate::canopen::emcy::EmcyCode;
use crate::canopen::sdo::{AbortCode, SdoError, SdoValue};

/// CiA 402, the low word of 0x1000.
pub(super) const DRIVE_PROFILE: u16 = 402;

/// Who a drive says it is (object 0x1018).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Identity {
    /// 0x1018:01.
    pub vendor: u32,
    /// 0x1018:02.
    pub product: u32,
    /// 0x1018:03, when the drive has it.
    pub revision: Option<u32>,
    /// 0x1018:04, when the drive has it.
    pub serial: Option<u32>,
}

impl fmt::Display for Identity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "vendor 0x{:08X}, product 0x{:08X}", self.vendor, self.product)?;
        if let Some(revision) = self.revision {
            write!(f, ", revision 0x{revision:08X}")?;
        }
        if let Some(serial) = self.serial {
            write!(f, ", serial 0x{serial:08X}")?;
        }
        Ok(())
    }
}

/// A fault that a drive was found in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FoundFault {
    /// 0x6041.
    pub statusword: Statusword,
    /// 0x603F, when the drive has it.
    pub error_code: Option<EmcyCode>,
    /// 0x1003:01, when there is an entry.
    pub history: Option<u32>,
}

/// Why a drive could not be brought up.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum BringUpError {
    /// Nothing was heard of it on this identifier, for so long.
    #[error(
        "no answer on {0:X}h within {s:.1} s, is the drive powered, node-id and bitrate right?",
        s = .1.as_secs_f64()
    )]
    NoAnswer(u16, Duration),
    /// It answered before, but not this.
    #[error(
        "{object}: no SDO reply within {} ms (attempt {attempts} of {attempts}), check cable, termination and bus load",
        timeout.as_millis()
    )]
    NoReply {
        /// The object.
        object: ObjectAddress,
        /// Of each attempt.
        timeout: Duration,
        /// How many were made.
        attempts: u32,
    },
    /// The drive refused to have the object read.
    #[error("{0}: reading was refused with SDO abort {1}{hint}", hint = hint(*.1))]
    ReadRefused(ObjectAddress, AbortCode),
    /// The drive refused to have this value written to the object.
    #[error("{0}: writing {1} was refused with SDO abort {2}{hint}", hint = hint(*.2))]
    WriteRefused(ObjectAddress, SdoValue, AbortCode),
    /// The SDO protocol was broken.
    #[error("{0}: {1}")]
    Sdo(ObjectAddress, SdoError),
    /// The position, an object of 4 bytes, has another length.
    #[error("{0}: expected 4 bytes, received {1}")]
    Length(ObjectAddress, usize),
    /// What was read is not what was written, or not what is needed.
    #[error("{object}: expected {expected}, received {received}")]
    Mismatch {
        /// The object.
        object: ObjectAddress,
        /// As written or needed.
        expected: SdoValue,
        /// As read.
        received: SdoValue,
    },
    /// The node is no drive: the low word of 0x1000.
    #[error(
        "0x1000:00: device profile {0} where {DRIVE_PROFILE} (drives) is needed, is the node-id right?"
    )]
    Profile(u16),
    /// A drive of another make or type.
    #[error(
        "{object}: expected {expected:#010X}, received {received:#010X}, is this the drive of the configuration?"
    )]
    Identity {
        /// 0x1018:01 or :02.
        object: ObjectAddress,
        /// As configured.
        expected: u32,
        /// As read.
        received: u32,
    },
    /// The drive's supported modes, as read, lack one that is needed.
    #[error("0x6502:00: supported modes {1:#010X} lack {0} (bit {bit})", bit = .0.0 - 1)]
    NoMode(Mode, u32),
    /// The drive does not say that it was homed: its statusword, and the bit that would say so.
    #[error("not homed (statusword {0}, bit {1} clear), home it first: needle-bench stage home")]
    NotHomed(Statusword, u8),
    /// The drive was found in Fault.
    #[error(
        "drive found in fault (statusword {}, 0x603F {}, 0x1003:01 {}); clear its cause, then: needle-bench stage reset",
        .0.statusword,
        .0.error_code.map_or("absent".to_string(), |code| code.to_string()),
        .0.history.map_or("empty".to_string(), |error| format!("{error:#010X}"))
    )]
    Fault(FoundFault),
    /// The drive restarted while it was brought up.
    #[error("boot-up message while {0}, is its supply stable?")]
    Rebooted(BringUpPart),
}

fn hint(code: AbortCode) -> &'static str {
    if is_absent(code) { "; list it as optional if the drive does without" } else { "" }
}

pub(super) fn is_absent(code: AbortCode) -> bool {
    matches!(code, AbortCode::NO_SUCH_OBJECT | AbortCode::NO_SUCH_SUBINDEX)
}
