//! Who a drive is, and why it could not be brought up.

use std::fmt;
use std::time::Duration;

use super::{Axis, BringUpPart};
use crate::canopen::cia402::{Mode, Statusword};
use crate::canopen::emcy::EmcyCode;
use crate::canopen::sdo::{AbortCode, SdoError, SdoValue};
use crate::canopen::{NodeId, ObjectAddress};

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

/// Why a drive could not be brought up.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("node {node} ({axis}): {kind}")]
pub struct BringUpError {
    /// Whose drive.
    pub axis: Axis,
    /// Its node.
    pub node: NodeId,
    /// What happened.
    pub kind: BringUpErrorKind,
}

/// What went wrong in bring-up.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum BringUpErrorKind {
    /// Nothing was heard of it.
    #[error(
        "no answer on {cob_id:X}h within {:.1} s, is the drive powered, node-id and bitrate right?",
        within.as_secs_f64()
    )]
    NoAnswer {
        /// Where it was asked.
        cob_id: u16,
        /// For how long.
        within: Duration,
    },
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
    #[error("{object}: reading was refused with SDO abort {code}{}", hint(*code))]
    ReadRefused {
        /// The object.
        object: ObjectAddress,
        /// The drive's reason.
        code: AbortCode,
    },
    /// The drive refused to have the object written.
    #[error("{object}: writing {value} was refused with SDO abort {code}{}", hint(*code))]
    WriteRefused {
        /// The object.
        object: ObjectAddress,
        /// What was written.
        value: SdoValue,
        /// The drive's reason.
        code: AbortCode,
    },
    /// The SDO protocol was broken.
    #[error("{object}: {error}")]
    Sdo {
        /// The object.
        object: ObjectAddress,
        /// How.
        error: SdoError,
    },
    /// The object has another length than its type.
    #[error("{object}: expected {expected} bytes, received {received}")]
    Length {
        /// The object.
        object: ObjectAddress,
        /// Bytes of its type.
        expected: usize,
        /// Bytes read.
        received: usize,
    },
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
    /// The node is no drive.
    #[error(
        "0x1000:00: device profile {received} where {DRIVE_PROFILE} (drives) is needed, is the node-id right?"
    )]
    Profile {
        /// The low word of 0x1000.
        received: u16,
    },
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
    /// The drive lacks a mode.
    #[error("0x6502:00: supported modes {supported:#010X} lack {mode} (bit {})", mode.0 - 1)]
    NoMode {
        /// The mode needed.
        mode: Mode,
        /// As read.
        supported: u32,
    },
    /// The drive does not say that it was homed.
    #[error(
        "not homed (statusword {statusword}, bit {bit} clear), home it first: needle-bench stage home"
    )]
    NotHomed {
        /// 0x6041.
        statusword: Statusword,
        /// The bit that would say so.
        bit: u8,
    },
    /// The drive was found in Fault.
    #[error(
        "drive found in fault (statusword {statusword}, 0x603F {}, 0x1003:01 {}); clear its cause, then set fault_reset_on_start",
        error_code.map_or("absent".to_string(), |code| code.to_string()),
        history.map_or("empty".to_string(), |error| format!("{error:#010X}"))
    )]
    Fault {
        /// 0x6041.
        statusword: Statusword,
        /// 0x603F, when the drive has it.
        error_code: Option<EmcyCode>,
        /// 0x1003:01, when there is an entry.
        history: Option<u32>,
    },
    /// The drive restarted while it was brought up.
    #[error("boot-up message while {0}, is its supply stable?")]
    Rebooted(BringUpPart),
}

fn hint(code: AbortCode) -> &'static str {
    if is_absent(code) { "; list it as optional if the drive does without" } else { "" }
}

pub(super) fn is_absent(code: AbortCode) -> bool {
    matches!(code, AbortCode::NoSuchObject | AbortCode::NoSuchSubindex)
}
