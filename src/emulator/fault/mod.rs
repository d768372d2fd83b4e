//! Faults written beforehand into an emulated stage: what goes wrong, where, when, for how long.

mod script;

pub(super) use script::{Change, Script};

use std::fmt;
use std::time::Duration;

use super::drive::End;
use crate::canopen::emcy::EmcyCode;
use crate::canopen::faulty_line::Harm;
use crate::canopen::pdo::PdoNumber;
use crate::canopen::{CanId, Frame, NodeId, cob};

/// A fault to come.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fault {
    /// When it strikes, once.
    pub strikes: Strikes,
    /// What goes wrong.
    pub kind: FaultKind,
    /// Where, of what has to do with a drive.
    pub on: On,
    /// `None`: for good.
    pub lasts: Option<Duration>,
}

/// When a fault strikes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Strikes {
    /// When the needle truly passes this depth, mm from where the stage was switched on, either way;
    /// looked at every millisecond and at every frame.
    AtDepth(f64),
    /// So long after the stage was switched on.
    AtTime(Duration),
}

/// Which drives.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum On {
    /// The insertion drive.
    Insertion,
    /// The rotation drive.
    Rotation,
    /// Both.
    Both,
}

impl On {
    /// True for the drive of this place, insertion first.
    pub(super) fn has(self, drive: usize) -> bool {
        matches!((self, drive), (On::Both, _) | (On::Insertion, 0) | (On::Rotation, 1))
    }
}

/// What goes wrong.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FaultKind {
    /// Frames of the drives, or for them.
    Frames {
        /// What becomes of them.
        harm: Harm,
        /// Which.
        frames: FrameClass,
        /// On which way.
        toward: Toward,
        /// So many and no more; `None` for all while the fault lasts.
        count: Option<u32>,
    },
    /// The node is off the bus: it says nothing and hears nothing, and goes on by itself.
    Silent,
    /// The node's electronics restart; for as long as the fault lasts it is off the bus.
    Restart,
    /// Something blocks the axis.
    Stall,
    /// The drive finds a fault by itself, such as 0x8611, a following error.
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
        /// And again, so long after; `None` for once.
        every: Option<Duration>,
    },
}

/// Frames by what they carry.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum FrameClass {
    /// Any.
    Any,
    /// The first PDO of the way.
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
    /// The identifier of these frames of `node` on that way; `None` for all.
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

/// The way of a frame.
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

impl fmt::Display for On {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            On::Insertion => "insertion",
            On::Rotation => "rotation",
            On::Both => "both drives",
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

/// What becomes of frames, in words.
fn harmed(harm: Harm) -> String {
    match harm {
        Harm::Drop => "lost".to_owned(),
        Harm::Delay(delay) => format!("late by {} ms", delay.as_secs_f64() * 1e3),
        Harm::Duplicate => "doubled".to_owned(),
        Harm::Reorder => "out of order".to_owned(),
        Harm::Corrupt { byte, .. } => format!("with byte {byte} corrupted"),
        Harm::Resize(len) => format!("of {len} bytes"),
    }
}

/// `insertion: PDOs to the bench lost`.
impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let on = self.on;
        match self.kind {
            FaultKind::Frames { harm, frames, toward, count } => {
                write!(f, "{on}: {frames} {toward} {}", harmed(harm))?;
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
        match self.lasts {
            Some(lasts) => write!(f, ", for {} s", lasts.as_secs_f64()),
            None => Ok(()),
        }
    }
}
