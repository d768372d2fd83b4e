//! `[can]`: the bus and the times of CANopen on it.

use std::fmt;

use serde::{Serialize, Serializer};

use super::drive::node_number;
use super::rule::Range;
use super::section::Section;
use crate::canopen::NodeId;

/// `[can]`: the bus and the times of CANopen on it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CanConfig {
    /// Which bus.
    pub interface: CanInterface,
    /// Period of SYNC, ms.
    pub sync_ms: u16,
    /// The bench's own node number.
    #[serde(serialize_with = "node_number")]
    pub bench_node: NodeId,
    /// Period of the bench's and the drives' heartbeats, ms.
    pub heartbeat_ms: u16,
    /// A heartbeat missed for this long stops the run, ms.
    pub heartbeat_timeout_ms: u16,
    /// For the answer to one SDO request, ms.
    pub sdo_timeout_ms: u16,
    /// How often an SDO request is made before giving up.
    pub sdo_attempts: u8,
    /// For a drive to boot, s.
    pub boot_timeout_s: f64,
    /// How often a drive is brought up that restarts in the middle of it.
    pub boot_attempts: u8,
    /// SYNCs in a row without both drives' answers that are tolerated.
    pub missed_feedback_max: u8,
}

/// A CAN bus by its name.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum CanInterface {
    /// `memory`: inside this process, with the virtual stage on it.
    Memory,
    /// A network interface of Linux, such as `can0`.
    Socket(String),
}

impl CanInterface {
    /// True for a bus made for tests, which never drives a real stage.
    pub fn is_for_tests(&self) -> bool {
        matches!(self, CanInterface::Memory)
    }

    fn named(name: String) -> Self {
        match name.as_str() {
            "memory" => CanInterface::Memory,
            _ => CanInterface::Socket(name),
        }
    }
}

impl fmt::Display for CanInterface {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            CanInterface::Memory => "memory",
            CanInterface::Socket(name) => name,
        })
    }
}

impl Serialize for CanInterface {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// What Linux takes for the name of a network interface: under 16 bytes (IFNAMSIZ), no space, no
/// slash.
fn is_interface(name: &str) -> bool {
    (1..16).contains(&name.len())
        && name.bytes().all(|byte| byte.is_ascii_graphic() && byte != b'/')
}

impl CanConfig {
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        let interfaces = "\"memory\" or the name of a CAN interface such as \"can0\"";
        CanConfig {
            interface: CanInterface::named(s.text("interface", interfaces, is_interface)),
            sync_ms: s.integer("sync_ms", 1, 100),
            bench_node: s.node("bench_node"),
            heartbeat_ms: s.integer("heartbeat_ms", 5, 10_000),
            heartbeat_timeout_ms: s.integer("heartbeat_timeout_ms", 10, 60_000),
            sdo_timeout_ms: s.integer("sdo_timeout_ms", 10, 10_000),
            sdo_attempts: s.integer("sdo_attempts", 1, 20),
            boot_timeout_s: s.number("boot_timeout_s", Range::within(0.1, 120.0)),
            boot_attempts: s.integer("boot_attempts", 1, 20),
            missed_feedback_max: s.integer("missed_feedback_max", 0, 100),
        }
    }
}
