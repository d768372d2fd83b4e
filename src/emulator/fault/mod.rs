//! Faults written beforehand into an emulated stage: what goes wrong, where, when, for how long.

mod line;
mod script;

pub(super) use line::Line;
pub(super) use script::{Change, Script};

use std::fmt;
use std::time::Duration;

use super::drive::End;
use crate::canopen::Frame;
use crate::canopen::emcy::EmcyCode;

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
    /// When the needle is truly so deep, mm; looked at every millisecond and at every frame.
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
    Frames(FrameFault),
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

/// What becomes of frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameFault {
    /// What is done to each.
    pub effect: Effect,
    /// To which.
    pub frames: FrameClass,
    /// On which way.
    pub toward: Toward,
    /// To so many and no more; `None` for all while the fault lasts.
    pub count: Option<u32>,
}

/// What is done to a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Effect {
    /// It is lost.
    Drop,
    /// It comes so much later.
    Delay(Duration),
    /// It comes twice.
    Duplicate,
    /// It comes after the next.
    Reorder,
    /// The first byte of its data is inverted.
    Corrupt,
    /// It lacks its last byte.
    Shorten,
}

/// Frames by what they carry.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum FrameClass {
    /// Any.
    Any,
    /// Process data, either way.
    Pdo,
    /// Service data, either way.
    Sdo,
    /// Heartbeats and boot-up messages.
    Heartbeat,
    /// Emergency messages.
    Emergency,
    /// SYNC.
    Sync,
}

impl FrameClass {
    pub(super) fn has(self, frame: &Frame) -> bool {
        let Some(cob_id) = frame.cob_id() else { return self == FrameClass::Any };
        match self {
            FrameClass::Any => true,
            FrameClass::Pdo => (0x181..0x580).contains(&cob_id),
            FrameClass::Sdo => (0x581..0x680).contains(&cob_id),
            FrameClass::Heartbeat => (0x701..0x780).contains(&cob_id),
            FrameClass::Emergency => (0x081..0x100).contains(&cob_id),
            FrameClass::Sync => cob_id == 0x080,
        }
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

impl fmt::Display for FrameFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let frames = match self.frames {
            FrameClass::Any => "frames",
            FrameClass::Pdo => "PDOs",
            FrameClass::Sdo => "SDOs",
            FrameClass::Heartbeat => "heartbeats",
            FrameClass::Emergency => "emergency messages",
            FrameClass::Sync => "SYNCs",
        };
        let way = match self.toward {
            Toward::Bench => "to the bench",
            Toward::Drives => "to the drives",
        };
        write!(f, "{frames} {way} ")?;
        match self.effect {
            Effect::Drop => f.write_str("lost")?,
            Effect::Delay(delay) => write!(f, "late by {} ms", delay.as_secs_f64() * 1e3)?,
            Effect::Duplicate => f.write_str("doubled")?,
            Effect::Reorder => f.write_str("out of order")?,
            Effect::Corrupt => f.write_str("corrupted")?,
            Effect::Shorten => f.write_str("too short")?,
        }
        self.count.map_or(Ok(()), |count| write!(f, ", {count} of them"))
    }
}

/// `insertion: PDOs to the bench lost`.
impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let on = self.on;
        match self.kind {
            FaultKind::Frames(frames) => write!(f, "{on}: {frames}")?,
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
