//! `[[emulator.fault]]`: what goes wrong in the emulated stage, and when.

use std::time::Duration;

use super::{BusFault, Fault, FaultKind, FaultyDrives, FrameAction, FrameClass, Toward, Trigger};
use crate::canopen::emcy::EmcyCode;
use crate::canopen::{Frame, NodeId};
use crate::emulator::drive::End;
use crate::keys::{Rule, choice, over, section, within};

const FRAME: Rule =
    Rule::Text("a frame such as \"181#37020000\"", |text| data_frame(text).is_some());

section! {
    /// One `[[emulator.fault]]`.
    pub struct FaultConfig {
        /// What goes wrong.
        kind: FaultName;
        /// It begins when the needle truly passes this depth, either way, mm.
        at_mm: Option<f64> [within(-1000.0, 1000.0)];
        /// It begins so long after the stage was switched on.
        at as "at_s": Option<Duration> [within(0.0, 86_400.0)], instead_of("at_mm");
        /// The drives that have the fault.
        axis: FaultyDrives = "both";
        /// How long the fault lasts; left out, for good.
        duration as "duration_s": Option<Duration> [over(0.0, 86_400.0)];
        /// Of faults of frames: which frames. Heartbeats toward the drives are the bench's.
        frames: FrameClass = "any";
        /// Of faults of frames: on their way to whom.
        toward: Toward = "bench";
        /// Of faults of frames: so many frames; left out, all.
        count: Option<u32> [within(1.0, u32::MAX as f64)];
        /// Of "delay": how late the frames are; with frames = "sdo" a slow server.
        delay as "delay_ms": Option<Duration> [over(0.0, 60_000.0)];
        /// Of "corrupt": the byte that is inverted, from 0; left out, the first.
        byte: Option<u8> [within(0.0, 7.0)];
        /// Of "resize": bytes.
        length: Option<u8> [within(0.0, 8.0)];
        /// Of "drive-fault": its emergency code.
        code: Option<u16> [within(1.0, u16::MAX as f64)];
        /// Of "foreign": the frame, as candump writes it.
        frame: Option<String> [FRAME];
        /// Of "foreign": time between two frames; left out, one frame.
        period as "period_ms": Option<Duration> [within(0.1, 60_000.0)];
    }
}

choice! {
    /// What goes wrong.
    pub enum FaultName {
        /// Frames are lost.
        Drop = "drop",
        /// Frames come late.
        Delay = "delay",
        /// Frames come twice.
        Duplicate = "duplicate",
        /// Frames come after the next.
        Reorder = "reorder",
        /// A byte of frames is inverted.
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
        /// Its transmit queue is full.
        BusFull = "bus-full",
        /// Its frames are held, and leave in a burst at the end.
        BusStuck = "bus-stuck",
        /// Another node sends a frame.
        Foreign = "foreign",
    }
}

choice! {
    for FaultyDrives {
        /// Both.
        Both = "both",
        /// The insertion drive.
        Insertion = "insertion",
        /// The rotation drive.
        Rotation = "rotation",
    }
}

choice! {
    for FrameClass {
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
    for Toward {
        /// From the drives.
        Bench = "bench",
        /// To the drives.
        Drives = "drives",
    }
}

impl FaultConfig {
    /// The fault of an emulated stage whose drives watch the heartbeat of the node `bench`.
    ///
    /// # Errors
    /// The key that is wrong, and why: a fault without its moment, a kind without the key it needs,
    /// frames that go the other way.
    pub(crate) fn to_fault(&self, bench: NodeId) -> Result<Fault, (&'static str, String)> {
        let kind = self.kind;
        let needs = |key: &str| ("kind", format!("a fault of kind \"{kind}\" needs {key}"));
        let trigger = match (self.at_mm, self.at) {
            (Some(mm), _) => Trigger::AtDepth(mm),
            (None, Some(after)) => Trigger::AtTime(after),
            (None, None) => return Err(needs("at_mm or at_s")),
        };
        let way = match (self.frames, self.toward) {
            (FrameClass::Emergency, Toward::Drives) => {
                Some("frames = \"emergency\" go toward = \"bench\" alone: no drive reads them")
            }
            (FrameClass::Sync, Toward::Bench) => {
                Some("frames = \"sync\" go toward = \"drives\" alone: the bench sends them")
            }
            _ => None,
        };
        if let Some(message) = way {
            return Err(("frames", message.to_owned()));
        }
        let frames = |action| FaultKind::Frames {
            action,
            frames: match (self.frames, self.toward) {
                (FrameClass::Heartbeat, Toward::Drives) => FrameClass::HeartbeatOf(bench),
                (frames, _) => frames,
            },
            toward: self.toward,
            count: self.count,
        };
        let frame = self.frame.as_deref().and_then(data_frame);
        let kind = match kind {
            FaultName::Drop => frames(FrameAction::Drop),
            FaultName::Delay => {
                frames(FrameAction::Delay(self.delay.ok_or_else(|| needs("delay_ms"))?))
            }
            FaultName::Duplicate => frames(FrameAction::Duplicate),
            FaultName::Reorder => frames(FrameAction::Reorder),
            FaultName::Corrupt => frames(FrameAction::Corrupt(self.byte.unwrap_or(0))),
            FaultName::Resize => {
                frames(FrameAction::Resize(self.length.ok_or_else(|| needs("length"))?))
            }
            FaultName::Silent => FaultKind::Silent,
            FaultName::Restart => FaultKind::Restart,
            FaultName::Stall => FaultKind::Stall,
            FaultName::DriveFault => {
                FaultKind::Drive(EmcyCode(self.code.ok_or_else(|| needs("code"))?))
            }
            FaultName::NegativeSwitch => FaultKind::Switch(End::Negative),
            FaultName::PositiveSwitch => FaultKind::Switch(End::Positive),
            FaultName::EmergencyStop => FaultKind::Interlock,
            FaultName::NoVoltage => FaultKind::NoVoltage,
            FaultName::BusOff => FaultKind::Bus(BusFault::Off),
            FaultName::BusDown => FaultKind::Bus(BusFault::Down),
            FaultName::BusFull => FaultKind::Bus(BusFault::Full),
            FaultName::BusStuck => FaultKind::Bus(BusFault::Stuck),
            FaultName::Foreign => FaultKind::Foreign {
                frame: frame.ok_or_else(|| needs("frame"))?,
                every: self.period,
            },
        };
        Ok(Fault { trigger, kind, drives: self.axis, duration: self.duration })
    }
}

impl FaultName {
    /// The keys that such a fault has beside its kind.
    pub(crate) fn keys(self) -> Vec<&'static str> {
        let own: &[_] = match self {
            FaultName::Drop | FaultName::Duplicate | FaultName::Reorder => {
                &["axis", "frames", "toward", "count"]
            }
            FaultName::Delay => &["axis", "frames", "toward", "count", "delay_ms"],
            FaultName::Corrupt => &["axis", "frames", "toward", "count", "byte"],
            FaultName::Resize => &["axis", "frames", "toward", "count", "length"],
            FaultName::DriveFault => &["axis", "code"],
            FaultName::Foreign => &["frame", "period_ms"],
            FaultName::BusOff | FaultName::BusDown | FaultName::BusFull | FaultName::BusStuck => {
                &[]
            }
            _ => &["axis"],
        };
        [&["at_mm", "at_s", "duration_s"], own].concat()
    }
}

/// A data frame as candump writes it.
fn data_frame(text: &str) -> Option<Frame> {
    text.parse().ok().filter(|frame: &Frame| !frame.is_remote())
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
