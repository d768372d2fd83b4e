//! `[[emulator.fault]]`: faults scripted into the emulated stage.

mod line;
mod script;

pub(super) use line::FaultyLine;
pub(super) use script::{Script, ScriptEvent};

use crate::canopen::emcy::EmcyCode;
use crate::canopen::{CanId, Frame, NodeId, cob};
use crate::keys::{Field, Rule, choice, over, section, within};
use std::fmt;
use std::time::Duration;

const FRAME: Rule =
    Rule::Text("a frame such as \"181#37020000\"", |text| data_frame(text).is_some());

section! {
    /// One `[[emulator.fault]]`: what goes wrong in the emulated stage, when, and for how long. It begins
    /// once.
    pub struct Fault {
        /// What goes wrong.
        kind: FaultKind;
        /// It begins when the needle has truly moved this far since the stage was switched on, mm; negative is
        /// withdrawn.
        at_mm: Option<f64> [within(-1000.0, 1000.0)];
        /// It begins this long after the stage was switched on.
        start_after as "at_s": Option<Duration> [within(0.0, 86_400.0)], instead_of("at_mm");
        /// The drives that have the fault.
        axis: FaultyDrives = "both";
        /// How long the fault lasts; left out, for good.
        duration as "duration_s": Option<Duration> [over(0.0, 86_400.0)];
        /// For faults of frames: which frames are affected. Heartbeats toward the drives are those of the bench.
        frames: FrameClass = "any";
        /// For faults of frames: their direction.
        toward: Toward = "bench";
        /// For faults of frames: how many frames are affected; left out, all.
        count: Option<u32> [within(1.0, u32::MAX as f64)];
        /// For "delay": how late the frames are; with frames = "sdo" a slow server.
        delay as "delay_ms": Option<Duration> [over(0.0, 60_000.0)];
        /// For "corrupt": the byte that is changed, from 0; left out, the first.
        byte: Option<u8> [within(0.0, 7.0)];
        /// For "corrupt": the bits of that byte that are inverted; left out, all. With frames = "pdo", byte = 1 and
        /// mask = 2 a drive shows bit 9 of its statusword inverted.
        mask: Option<u8> [within(1.0, 255.0)];
        /// For "resize": the new length, bytes.
        length: Option<u8> [within(0.0, 8.0)];
        /// For "drive-fault": the emergency code.
        code: Option<u16> [within(1.0, u16::MAX as f64)];
        /// For "tissue", "chuck-slip" and "buckling": which part is left of the needle's curvature, of each turn of
        /// the base, or of each advance of the base.
        share: Option<f64> [within(0.0, 10.0)];
        /// For "foreign": the frame, as candump writes it.
        frame: Option<String> [FRAME];
        /// For "foreign": time between two frames; left out, one frame.
        period as "period_ms": Option<Duration> [within(0.1, 60_000.0)];
    }
    beside {
        /// The node of the bench, whose heartbeat the drives watch.
        pub bench: Option<NodeId> = None,
    }
}

choice! {
    /// What goes wrong.
    pub enum FaultKind {
        /// Frames are lost.
        Drop = "drop",
        /// Frames come late.
        Delay = "delay",
        /// Frames come twice.
        Duplicate = "duplicate",
        /// Frames come after the next.
        Reorder = "reorder",
        /// A byte of frames is changed.
        Corrupt = "corrupt",
        /// Frames have another length.
        Resize = "resize",
        /// A node is off the bus.
        Silent = "silent",
        /// A node restarts.
        Restart = "restart",
        /// An axis is blocked.
        Stall = "stall",
        /// A drive finds a fault by itself.
        DriveFault = "drive-fault",
        /// The negative limit switch closes.
        NegativeSwitch = "negative-switch",
        /// The positive limit switch closes.
        PositiveSwitch = "positive-switch",
        /// The safety input opens.
        EmergencyStop = "emergency-stop",
        /// The power stage loses its supply.
        NoVoltage = "no-voltage",
        /// The bench's controller goes bus-off.
        BusOff = "bus-off",
        /// The bench's interface is down.
        BusDown = "bus-down",
        /// The transmit queue of the bench's interface is full.
        BusFull = "bus-full",
        /// The bench's interface holds its frames, and sends them in a burst at the end.
        BusStuck = "bus-stuck",
        /// Another node sends a frame.
        Foreign = "foreign",
        /// The tissue bends the needle more, or less.
        Tissue = "tissue",
        /// The needle turns less than its chuck.
        ChuckSlip = "chuck-slip",
        /// The shaft buckles outside the tissue: the tip advances less than the base.
        Buckling = "buckling",
    }
}

choice! {
    /// The drives of a fault.
    pub enum FaultyDrives {
        /// Both.
        Both = "both",
        /// The insertion drive.
        Insertion = "insertion",
        /// The rotation drive.
        Rotation = "rotation",
    }
}

choice! {
    /// Frames by what they carry.
    pub enum FrameClass {
        /// All.
        Any = "any",
        /// Process data.
        Pdo = "pdo",
        /// Service data.
        Sdo = "sdo",
        /// Heartbeats and boot-up messages.
        Heartbeat = "heartbeat",
        /// Emergency messages.
        Emergency = "emergency",
        /// SYNC.
        Sync = "sync",
    }
}

choice! {
    /// The direction of a frame.
    pub enum Toward {
        /// From the drives.
        Bench = "bench",
        /// To the drives.
        Drives = "drives",
    }
}

impl Fault {
    /// A fault of this kind; all other keys have their defaults.
    pub fn of(kind: FaultKind) -> Self {
        Fault { kind, ..Fault::take(None) }
    }

    /// Refuses a fault without a start, a kind without the key that it needs, and frames in a direction in
    /// which they are never sent.
    ///
    /// # Errors
    /// The key that is wrong, and why.
    pub(crate) fn check(&self) -> Result<(), (&'static str, String)> {
        let needs = match self.kind {
            _ if self.at_mm.is_none() && self.start_after.is_none() => Some("at_mm or at_s"),
            FaultKind::Delay if self.delay.is_none() => Some("delay_ms"),
            FaultKind::Resize if self.length.is_none() => Some("length"),
            FaultKind::DriveFault if self.code.is_none() => Some("code"),
            FaultKind::Foreign if self.frame.is_none() => Some("frame"),
            kind if kind.has("share") && self.share.is_none() => Some("share"),
            FaultKind::ChuckSlip | FaultKind::Buckling if self.share_left() > 1.0 => {
                return Err((
                    "share",
                    format!("a fault of kind \"{}\" leaves a share of at most 1", self.kind),
                ));
            }
            _ => None,
        };
        if let Some(key) = needs {
            return Err(("kind", format!("a fault of kind \"{}\" needs {key}", self.kind)));
        }
        let message = match (self.frames, self.toward) {
            (FrameClass::Emergency, Toward::Drives) => {
                "frames = \"emergency\" needs toward = \"bench\": no drive reads emergency messages"
            }
            (FrameClass::Sync, Toward::Bench) => {
                "frames = \"sync\" needs toward = \"drives\": the bench sends SYNC"
            }
            _ => return Ok(()),
        };
        Err(("frames", message.to_owned()))
    }

    /// True for drive number `drive`: 0 is insertion, 1 is rotation.
    pub(super) fn concerns(&self, drive: usize) -> bool {
        matches!(
            (self.axis, drive),
            (FaultyDrives::Both, _) | (FaultyDrives::Insertion, 0) | (FaultyDrives::Rotation, 1)
        )
    }

    /// The identifier of the frames of `node` that the fault acts on; `None` for all frames.
    pub(super) fn frame_id(&self, node: NodeId) -> Option<CanId> {
        let cob_id = match (self.frames, self.toward) {
            (FrameClass::Any, _) => return None,
            (FrameClass::Pdo, Toward::Bench) => cob::tpdo1(node),
            (FrameClass::Pdo, Toward::Drives) => cob::rpdo1(node),
            (FrameClass::Sdo, Toward::Bench) => cob::sdo_tx(node),
            (FrameClass::Sdo, Toward::Drives) => cob::sdo_rx(node),
            (FrameClass::Heartbeat, Toward::Bench) => cob::heartbeat(node),
            (FrameClass::Heartbeat, Toward::Drives) => cob::heartbeat(self.bench?),
            (FrameClass::Emergency, _) => cob::emcy(node),
            (FrameClass::Sync, _) => cob::SYNC,
        };
        Some(CanId::Base(cob_id))
    }

    /// The part that is left by a fault of needle or tissue.
    pub(super) fn share_left(&self) -> f64 {
        self.share.unwrap_or(1.0)
    }

    /// The frame that another node sends.
    pub(super) fn foreign_frame(&self) -> Option<Frame> {
        self.frame.as_deref().and_then(data_frame)
    }

    /// What happens to the frames, in words.
    fn action(&self) -> String {
        match self.kind {
            FaultKind::Delay => {
                let delay = self.delay.unwrap_or_default();
                format!("late by {} ms", delay.as_nanos() as f64 / 1e6)
            }
            FaultKind::Duplicate => "doubled".to_owned(),
            FaultKind::Reorder => "out of order".to_owned(),
            FaultKind::Corrupt => format!("with byte {} corrupted", self.byte.unwrap_or(0)),
            FaultKind::Resize => format!("of {} bytes", self.length.unwrap_or(0)),
            _ => "lost".to_owned(),
        }
    }
}

/// For example `insertion: PDOs to the bench lost`.
impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.kind.has("axis") {
            match self.axis {
                FaultyDrives::Both => write!(f, "both drives: "),
                drive => write!(f, "{drive}: "),
            }?;
        }
        match self.kind {
            FaultKind::Silent => write!(f, "off the bus"),
            FaultKind::Restart => write!(f, "restart"),
            FaultKind::Stall => write!(f, "blocked"),
            FaultKind::DriveFault => write!(f, "fault {}", EmcyCode(self.code.unwrap_or(0))),
            FaultKind::NegativeSwitch => write!(f, "negative limit switch closed"),
            FaultKind::PositiveSwitch => write!(f, "positive limit switch closed"),
            FaultKind::EmergencyStop => write!(f, "safety input open"),
            FaultKind::NoVoltage => write!(f, "no voltage"),
            FaultKind::BusOff => write!(f, "bus off"),
            FaultKind::BusDown => write!(f, "interface down"),
            FaultKind::BusFull => write!(f, "transmit queue full"),
            FaultKind::BusStuck => write!(f, "frames held by the interface"),
            FaultKind::Foreign => {
                write!(f, "foreign frame {}", self.frame.as_deref().unwrap_or_default())?;
                self.period.map_or(Ok(()), |period| {
                    write!(f, " every {} ms", period.as_nanos() as f64 / 1e6)
                })
            }
            FaultKind::Tissue => write!(f, "tissue: {} of the curvature", self.share_left()),
            FaultKind::ChuckSlip => write!(f, "chuck: {} of each turn", self.share_left()),
            FaultKind::Buckling => write!(f, "shaft: {} of each advance", self.share_left()),
            _ => {
                f.write_str(match self.frames {
                    FrameClass::Any => "frames",
                    FrameClass::Pdo => "PDOs",
                    FrameClass::Sdo => "SDOs",
                    FrameClass::Heartbeat => "heartbeats",
                    FrameClass::Emergency => "emergency messages",
                    FrameClass::Sync => "SYNCs",
                })?;
                let bench = self.bench.filter(|_| self.frames == FrameClass::Heartbeat);
                if let (Toward::Drives, Some(bench)) = (self.toward, bench) {
                    write!(f, " of node {bench}")?;
                }
                write!(f, " to the {} {}", self.toward, self.action())?;
                self.count.map_or(Ok(()), |count| write!(f, ", {count} of them"))
            }
        }?;
        self.duration.map_or(Ok(()), |duration| write!(f, ", for {} s", duration.as_secs_f64()))
    }
}

impl FaultKind {
    /// True if a fault of this kind has this key.
    pub(super) fn has(self, key: &str) -> bool {
        self.keys().contains(&key)
    }

    /// True for a fault of the bus as the bench sees it: no frame passes either way.
    pub(super) fn is_of_bus(self) -> bool {
        matches!(
            self,
            FaultKind::BusOff | FaultKind::BusDown | FaultKind::BusFull | FaultKind::BusStuck
        )
    }

    /// The keys that a fault of this kind has beside its kind.
    pub(crate) fn keys(self) -> Vec<&'static str> {
        let own: &[_] = match self {
            FaultKind::Drop | FaultKind::Duplicate | FaultKind::Reorder => {
                &["axis", "frames", "toward", "count"]
            }
            FaultKind::Delay => &["axis", "frames", "toward", "count", "delay_ms"],
            FaultKind::Corrupt => &["axis", "frames", "toward", "count", "byte", "mask"],
            FaultKind::Resize => &["axis", "frames", "toward", "count", "length"],
            FaultKind::DriveFault => &["axis", "code"],
            FaultKind::Foreign => &["frame", "period_ms"],
            FaultKind::Tissue | FaultKind::ChuckSlip | FaultKind::Buckling => &["share"],
            kind if kind.is_of_bus() => &[],
            _ => &["axis"],
        };
        [&["at_mm", "at_s", "duration_s"], own].concat()
    }
}

/// A data frame as candump writes it.
fn data_frame(text: &str) -> Option<Frame> {
    Frame::parse(text).filter(|frame| !frame.is_remote())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_foreign_frame_is_a_data_frame() {
        assert_eq!(data_frame("181#00"), Some(Frame::new(0x181, &[0])));
        assert_eq!((data_frame("181#R"), data_frame("181")), (None, None));
    }
}
