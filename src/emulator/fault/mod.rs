//! Faults scripted into an emulated stage: what goes wrong, where, when and for how long.

mod line;
mod script;
mod settings;

pub use line::FrameAction;
pub(super) use line::{FaultyLine, FrameFault};
pub(super) use script::{Change, Script};
pub use settings::{FaultConfig, FaultName};

use std::fmt;
use std::time::Duration;

use super::drive::End;
use crate::canopen::emcy::EmcyCode;
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
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, derive_more::Display)]
pub enum FaultyDrives {
    /// The insertion drive.
    #[display("insertion")]
    Insertion,
    /// The rotation drive.
    #[display("rotation")]
    Rotation,
    /// Both.
    #[display("both drives")]
    Both,
}

impl FaultyDrives {
    /// True for drive number `drive`: 0 is insertion, 1 is rotation.
    pub(super) fn has(self, drive: usize) -> bool {
        matches!((self, drive), (Self::Both, _) | (Self::Insertion, 0) | (Self::Rotation, 1))
    }
}

/// What goes wrong.
#[derive(Debug, Clone, Copy, PartialEq, derive_more::Display)]
pub enum FaultKind {
    /// Frames from or to the drives.
    #[display("{frames} {toward} {action}{}", of_them(*count))]
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
    #[display("off the bus")]
    Silent,
    /// The node restarts; while the fault lasts it is off the bus.
    #[display("restart")]
    Restart,
    /// Something blocks the axis.
    #[display("blocked")]
    Stall,
    /// The drive detects a fault, such as 0x8611, a following error.
    #[display("fault {_0}")]
    Drive(EmcyCode),
    /// A limit switch closes.
    #[display("{_0} limit switch closed")]
    Switch(End),
    /// The safety input opens: no torque.
    #[display("safety input open")]
    Interlock,
    /// The power stage loses its supply.
    #[display("no voltage")]
    NoVoltage,
    /// The bus, as the bench sees it. No frame passes either way.
    #[display("{_0}")]
    Bus(BusFault),
    /// Another node sends this frame.
    #[display("foreign frame {frame}{}", repeated(*every))]
    Foreign {
        /// The frame.
        frame: Frame,
        /// The time until it sends the frame again; `None`: it sends it once.
        every: Option<Duration>,
    },
}

/// Frames by what they carry.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, derive_more::Display)]
pub enum FrameClass {
    /// Any.
    #[display("frames")]
    Any,
    /// PDO 1 of this direction.
    #[display("PDOs")]
    Pdo,
    /// Service data.
    #[display("SDOs")]
    Sdo,
    /// Heartbeats and boot-up messages of the drive.
    #[display("heartbeats")]
    Heartbeat,
    /// Heartbeats of this other node, such as the bench's.
    #[display("heartbeats of node {_0}")]
    HeartbeatOf(NodeId),
    /// Emergency messages of the drive.
    #[display("emergency messages")]
    Emergency,
    /// SYNC.
    #[display("SYNCs")]
    Sync,
}

impl FrameClass {
    /// The identifier of these frames of `node` in that direction; `None` for all frames.
    pub(super) fn id(self, node: NodeId, toward: Toward) -> Option<CanId> {
        let cob_id = match (self, toward) {
            (FrameClass::Any, _) => return None,
            (FrameClass::Pdo, Toward::Bench) => cob::tpdo(node),
            (FrameClass::Pdo, Toward::Drives) => cob::rpdo(node),
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
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, derive_more::Display)]
pub enum Toward {
    /// From a drive.
    #[display("to the bench")]
    Bench,
    /// To a drive.
    #[display("to the drives")]
    Drives,
}

/// What is wrong with the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, derive_more::Display)]
pub enum BusFault {
    /// The bench's controller went bus-off, and says so.
    #[display("bus off")]
    Off,
    /// The bench's interface is down: it takes no frame.
    #[display("interface down")]
    Down,
    /// Its transmit queue is full (ENOBUFS): it takes no frame.
    #[display("transmit queue full")]
    Full,
    /// Nobody acknowledges: what it takes is held, and leaves in a burst at the end.
    #[display("frames held by the interface")]
    Stuck,
}

fn of_them(count: Option<u32>) -> String {
    count.map_or(String::new(), |count| format!(", {count} of them"))
}

fn repeated(every: Option<Duration>) -> String {
    every.map_or(String::new(), |every| format!(" every {} ms", every.as_secs_f64() * 1e3))
}

/// `insertion: PDOs to the bench lost`.
impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !matches!(self.kind, FaultKind::Bus(_) | FaultKind::Foreign { .. }) {
            write!(f, "{}: ", self.drives)?;
        }
        write!(f, "{}", self.kind)?;
        match self.duration {
            Some(duration) => write!(f, ", for {} s", duration.as_secs_f64()),
            None => Ok(()),
        }
    }
}
