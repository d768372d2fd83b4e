//! `[[emulator.fault]]`: what goes wrong in the emulated stage, and when.

use std::time::Duration;

use serde::Serialize;

use super::choice::choice;
use super::error::ConfigError;
use super::rule::Range;
use super::section::Section;
use crate::canopen::emcy::EmcyCode;
use crate::canopen::{Frame, NodeId};
use crate::emulator::drive::End;
use crate::emulator::fault::{
    BusFault, Fault, FaultKind, FaultyDrives, FrameAction, FrameClass, Toward, Trigger,
};

choice! {
    /// What goes wrong.
    FaultName {
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
    /// Which drives a fault strikes.
    FaultAxis {
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
    FrameName {
        /// Any.
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
    /// The way of frames.
    FrameWay {
        /// From the drives.
        Bench = "bench",
        /// To the drives.
        Drives = "drives",
    }
}

/// One `[[emulator.fault]]`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FaultConfig {
    /// What goes wrong.
    pub kind: FaultName,
    /// It strikes when the needle is so deep, mm …
    #[serde(skip_serializing_if = "Option::is_none")]
    pub at_mm: Option<f64>,
    /// … or so long after the stage was switched on, s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub at_s: Option<f64>,
    /// Where.
    pub axis: FaultAxis,
    /// For so long, s; else for good.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub duration_s: Option<f64>,
    /// Of faults of frames: which frames.
    pub frames: FrameName,
    /// Of faults of frames: on their way to whom.
    pub toward: FrameWay,
    /// Of faults of frames: so many; else all.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub count: Option<u32>,
    /// Of late frames, ms.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub delay_ms: Option<f64>,
    /// Of corrupted frames: which byte, from 0; else the first.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub byte: Option<u8>,
    /// Of frames of another length: how many bytes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub length: Option<u8>,
    /// Of a drive's fault: its emergency code.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub code: Option<u16>,
    /// Of a foreign node: the frame it sends, as candump writes it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frame: Option<String>,
    /// Of a foreign node: the time from frame to frame, ms; else one frame.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub period_ms: Option<f64>,
}

impl FaultConfig {
    /// The keys, for the message about what a fault is made of.
    pub(super) const KEYS: &'static str = "kind, at_mm or at_s, axis and more";

    pub(super) fn read(s: &mut Section<'_>) -> Self {
        let (frames, toward) = (s.optional_choice("frames"), s.optional_choice("toward"));
        let axis = s.optional_choice("axis");
        let (at_mm, at_s) = s.either(
            ("at_mm", Range::within(-1000.0, 1000.0)),
            ("at_s", Range::within(0.0, 86_400.0)),
        );
        let fault = FaultConfig {
            kind: s.choice("kind"),
            at_mm,
            at_s,
            axis: axis.unwrap_or(FaultAxis::Both),
            duration_s: s.optional_number("duration_s", Range::over(0.0, 86_400.0)),
            frames: frames.unwrap_or(FrameName::Any),
            toward: toward.unwrap_or(FrameWay::Bench),
            count: s.optional_integer("count", 1, u32::MAX),
            delay_ms: s.optional_number("delay_ms", Range::over(0.0, 60_000.0)),
            byte: s.optional_integer("byte", 0, 7),
            length: s.optional_integer("length", 0, 8),
            code: s.optional_integer("code", 1, u16::MAX),
            frame: s.optional_text_that("frame", "a frame such as \"181#37020000\"", |text| {
                data_frame(text).is_some()
            }),
            period_ms: s.optional_number("period_ms", Range::within(0.1, 60_000.0)),
        };
        if !s.is_wrong() {
            fault.check(s);
        }
        fault
    }

    /// Notes keys that this kind of fault does not have, and keys that it lacks.
    fn check(&self, s: &mut Section<'_>) {
        // A recorded configuration has the first three in every fault, with their defaults.
        let given = [
            ("axis", self.axis != FaultAxis::Both),
            ("frames", self.frames != FrameName::Any),
            ("toward", self.toward != FrameWay::Bench),
            ("count", self.count.is_some()),
            ("delay_ms", self.delay_ms.is_some()),
            ("byte", self.byte.is_some()),
            ("length", self.length.is_some()),
            ("code", self.code.is_some()),
            ("frame", self.frame.is_some()),
            ("period_ms", self.period_ms.is_some()),
        ];
        let keys = self.kind.keys();
        for (key, _) in given.iter().filter(|(key, is_given)| *is_given && !keys.contains(key)) {
            let known = [&["at_mm", "at_s", "duration_s"], keys].concat().join(", ");
            let kind = self.kind;
            s.refuse_key(key, &format!("a fault of kind \"{kind}\" has no such key, only {known}"));
        }
        if s.is_wrong() {
            return;
        }
        if let Some(message) = self.frames.nobody_sends(self.toward) {
            s.refuse("frames", message);
        }
        // Any node will do: what is missing does not depend on it.
        let bench = const { NodeId::new(127).unwrap() };
        if let Err(error) = self.to_fault(bench) {
            s.refuse("kind", &error.to_string());
        }
    }

    /// The fault that the emulated stage is told; the heartbeat that the drives watch is that of the
    /// node `bench`.
    ///
    /// # Errors
    /// A fault without its moment, or a kind without the key it needs.
    pub(super) fn to_fault(&self, bench: NodeId) -> Result<Fault, ConfigError> {
        let needs = |key: &str| {
            let kind = self.kind;
            ConfigError::of(format!("a fault of kind \"{kind}\" needs {key}"))
        };
        let trigger = match (self.at_mm, self.at_s) {
            (Some(mm), _) => Trigger::AtDepth(mm),
            (None, Some(s)) => Trigger::AtTime(Duration::from_secs_f64(s)),
            (None, None) => return Err(needs("at_mm or at_s")),
        };
        let millis = |ms: f64| Duration::from_secs_f64(ms * 1e-3);
        let frames = |action| FaultKind::Frames {
            action,
            frames: match (self.frames, self.toward) {
                (FrameName::Heartbeat, FrameWay::Drives) => FrameClass::HeartbeatOf(bench),
                (frames, _) => frames.class(),
            },
            toward: match self.toward {
                FrameWay::Bench => Toward::Bench,
                FrameWay::Drives => Toward::Drives,
            },
            count: self.count,
        };
        let kind = match self.kind {
            FaultName::Drop => frames(FrameAction::Drop),
            FaultName::Delay => {
                let delay_ms = self.delay_ms.ok_or_else(|| needs("delay_ms"))?;
                frames(FrameAction::Delay(millis(delay_ms)))
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
                frame: self.frame.as_deref().and_then(data_frame).ok_or_else(|| needs("frame"))?,
                every: self.period_ms.map(millis),
            },
        };
        let drives = match self.axis {
            FaultAxis::Both => FaultyDrives::Both,
            FaultAxis::Insertion => FaultyDrives::Insertion,
            FaultAxis::Rotation => FaultyDrives::Rotation,
        };
        Ok(Fault { trigger, kind, drives, duration: self.duration_s.map(Duration::from_secs_f64) })
    }
}

impl FaultName {
    /// The keys that such a fault has, but for `kind`, `at_mm`, `at_s` and `duration_s`, which all have.
    fn keys(self) -> &'static [&'static str] {
        match self {
            FaultName::Drop | FaultName::Duplicate | FaultName::Reorder => {
                &["axis", "frames", "toward", "count"]
            }
            FaultName::Delay => &["axis", "frames", "toward", "count", "delay_ms"],
            FaultName::Corrupt => &["axis", "frames", "toward", "count", "byte"],
            FaultName::Resize => &["axis", "frames", "toward", "count", "length"],
            FaultName::Silent
            | FaultName::Restart
            | FaultName::Stall
            | FaultName::NegativeSwitch
            | FaultName::PositiveSwitch
            | FaultName::EmergencyStop
            | FaultName::NoVoltage => &["axis"],
            FaultName::DriveFault => &["axis", "code"],
            FaultName::BusOff | FaultName::BusDown | FaultName::BusFull | FaultName::BusStuck => {
                &[]
            }
            FaultName::Foreign => &["frame", "period_ms"],
        }
    }
}

impl FrameName {
    /// Why a fault of these frames on that way would do nothing, where it would.
    fn nobody_sends(self, toward: FrameWay) -> Option<&'static str> {
        match (self, toward) {
            (FrameName::Emergency, FrameWay::Drives) => {
                Some("frames = \"emergency\" go toward = \"bench\" alone: no drive reads them")
            }
            (FrameName::Sync, FrameWay::Bench) => {
                Some("frames = \"sync\" go toward = \"drives\" alone: the bench sends them")
            }
            _ => None,
        }
    }

    fn class(self) -> FrameClass {
        match self {
            FrameName::Any => FrameClass::Any,
            FrameName::Pdo => FrameClass::Pdo,
            FrameName::Sdo => FrameClass::Sdo,
            FrameName::Heartbeat => FrameClass::Heartbeat,
            FrameName::Emergency => FrameClass::Emergency,
            FrameName::Sync => FrameClass::Sync,
        }
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
