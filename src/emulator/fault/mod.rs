//! Faults scripted into an emulated stage: what goes wrong, where, when and for how long.

mod line;
mod script;

pub use line::FrameAction;
pub(super) use line::{FaultyLine, FrameFault};
pub(super) use script::{Change, Script};

use std::fmt;
use std::time::Duration;

use super::drive::End;
use crate::canopen::emcy::EmcyCode;
use crate::canopen::pdo::PdoNumber;
use crate::canopen::{CanId, Frame, NodeId, cob};

/// A scripted fault. It begins once.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fault {
    /// When it begins.
    pub trigger: Trigger,
    /// What goes wrong.
    pub kind: FaultKind,
    /// The drives it concerns, if it concerns a drive.
    pub drives: FaultyDrives,
    /// How long it lasts; `None` for the rest of the run.
    pub duration: Option<Duration>,
}

/// When a fault begins.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Trigger {
    /// When the true depth passes this value in either direction, mm from the position at power-on.
    /// The depth is checked every millisecond and at every frame.
    AtDepth(f64),
    /// This long after power-on.
    AtTime(Duration),
}

/// The drives of a fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum FaultyDrives {
    /// The insertion drive.
    Insertion,
    /// The rotation drive.
    Rotation,
    /// Both.
    Both,
}

impl FaultyDrives {
    /// True for drive number `drive`: 0 is insertion, 1 is rotation.
    pub(super) fn has(self, drive: usize) -> bool {
        matches!((self, drive), (Self::Both, _) | (Self::Insertion, 0) | (Self::Rotation, 1))
    }
}

/// What goes wrong.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FaultKind {
    /// Frames from or to the drives.
    Frames {
        /// What happens to them.
        action: FrameAction,
        /// Which frames.
        frames: FrameClass,
        /// Their direction.
        toward: Toward,
        /// How many frames at most; `None` for all while the fault lasts.
        count: Option<u32>,
    },
    /// The node is off the bus: it sends and receives nothing, and goes on by itself.
    Silent,
    /// The node restarts; while the fault lasts it is off the bus.
    Restart,
    /// Something blocks the axis.
    Stall,
    /// The drive detects a fault, such as 0x8611, a following error.
    Drive(EmcyCode),
    /// A limit switch closes.
    Switch(End),
    /// The safety input opens: no torque.
    Interlock,
    /// The power stage loses its supply.
    NoVoltage,
    /// The bus, as the bench sees it. No frame passes either way.
    Bus(BusFault),
    /// Another node sends this frame.
    Foreign {
        /// The frame.
        frame: Frame,
        /// The time until it sends the frame again; `None`: it sends it once.
        every: Option<Duration>,
    },
}

/// Frames by what they carry.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum FrameClass {
    /// Any.
    Any,
    /// PDO 1 of this direction.
    Pdo,
    /// Service data.
    Sdo,
    /// Heartbeats and boot-up messages of the drive.
    Heartbeat,
    /// Heartbeats of this other node, such as the bench's.
    HeartbeatOf(NodeId),
    /// Emergency messages of the drive.
    Emergency,
    /// SYNC.
    Sync,
}

impl FrameClass {
    /// The identifier of these frames of `node` in that direction; `None` for all frames.
    pub(super) fn id(self, node: NodeId, toward: Toward) -> Option<CanId> {
        let cob_id = match (self, toward) {
            (FrameClass::Any, _) => return None,
            (FrameClass::Pdo, Toward::Bench) => cob::tpdo(node, PdoNumber::One),
            (FrameClass::Pdo, Toward::Drives) => cob::rpdo(node, PdoNumber::One),
            (FrameClass::Sdo, Toward::Bench) => cob::sdo_tx(node),
            (FrameClass::Sdo, Toward::Drives) => cob::sdo_rx(node),
            (FrameClass::Heartbeat, _) => cob::heartbeat(node),
            (FrameClass::HeartbeatOf(other), _) => cob::heartbeat(other),
            (FrameClass::Emergency, _) => cob::emcy(node),
            (FrameClass::Sync, _) => cob::SYNC,
        };
        Some(CanId::Base(cob_id))
    }
}

/// The direction of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Toward {
    /// From a drive.
    Bench,
    /// To a drive.
    Drives,
}

/// What is wrong with the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum BusFault {
    /// The bench's controller went bus-off, and says so.
    Off,
    /// The bench's interface is down: it takes no frame.
    Down,
    /// Its transmit queue is full (ENOBUFS): it takes no frame.
    Full,
    /// Nobody acknowledges: what it takes is held, and leaves in a burst at the end.
    Stuck,
}

impl fmt::Display for FaultyDrives {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            FaultyDrives::Insertion => "insertion",
            FaultyDrives::Rotation => "rotation",
            FaultyDrives::Both => "both drives",
        })
    }
}

impl fmt::Display for FrameClass {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            FrameClass::Any => "frames",
            FrameClass::Pdo => "PDOs",
            FrameClass::Sdo => "SDOs",
            FrameClass::Heartbeat => "heartbeats",
            FrameClass::HeartbeatOf(node) => return write!(f, "heartbeats of node {node}"),
            FrameClass::Emergency => "emergency messages",
            FrameClass::Sync => "SYNCs",
        })
    }
}

impl fmt::Display for Toward {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Toward::Bench => "to the bench",
            Toward::Drives => "to the drives",
        })
    }
}

impl fmt::Display for FrameAction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            FrameAction::Drop => write!(f, "lost"),
            FrameAction::Delay(delay) => write!(f, "late by {} ms", delay.as_secs_f64() * 1e3),
            FrameAction::Duplicate => write!(f, "doubled"),
            FrameAction::Reorder => write!(f, "out of order"),
            FrameAction::Corrupt(byte) => write!(f, "with byte {byte} corrupted"),
            FrameAction::Resize(len) => write!(f, "of {len} bytes"),
        }
    }
}

/// `insertion: PDOs to the bench lost`.
impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let on = self.drives;
        match self.kind {
            FaultKind::Frames { action, frames, toward, count } => {
                write!(f, "{on}: {frames} {toward} {action}")?;
                count.map_or(Ok(()), |count| write!(f, ", {count} of them"))?;
            }
            FaultKind::Silent => write!(f, "{on}: off the bus")?,
            FaultKind::Restart => write!(f, "{on}: restart")?,
            FaultKind::Stall => write!(f, "{on}: blocked")?,
            FaultKind::Drive(code) => write!(f, "{on}: fault {code}")?,
            FaultKind::Switch(End::Negative) => write!(f, "{on}: negative limit switch closed")?,
            FaultKind::Switch(End::Positive) => write!(f, "{on}: positive limit switch closed")?,
            FaultKind::Interlock => write!(f, "{on}: safety input open")?,
            FaultKind::NoVoltage => write!(f, "{on}: no voltage")?,
            FaultKind::Bus(BusFault::Off) => f.write_str("bus off")?,
            FaultKind::Bus(BusFault::Down) => f.write_str("interface down")?,
            FaultKind::Bus(BusFault::Full) => f.write_str("transmit queue full")?,
            FaultKind::Bus(BusFault::Stuck) => f.write_str("frames held by the interface")?,
            FaultKind::Foreign { frame, every: None } => write!(f, "foreign frame {frame}")?,
            FaultKind::Foreign { frame, every: Some(every) } => {
                write!(f, "foreign frame {frame} every {} ms", every.as_secs_f64() * 1e3)?;
            }
        }
        match self.duration {
            Some(duration) => write!(f, ", for {} s", duration.as_secs_f64()),
            None => Ok(()),
        }
    }
}
