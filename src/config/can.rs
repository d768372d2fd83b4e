//! `[can]`: the bus and the times of CANopen on it.

use core::net::{Ipv4Addr, SocketAddrV4};
use std::fmt;

use serde::{Serialize, Serializer};

use super::choice::choice;
use super::drive::node_number;
use super::rule::Range;
use super::section::Section;
use crate::canopen::NodeId;

/// `[can]`: the bus and the times of CANopen on it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CanConfig {
    /// Which bus.
    pub interface: CanInterface,
    /// What the bench hears of the bus.
    pub listen: Listen,
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

choice! {
    /// How much of the bus is received, where the kernel can choose.
    Listen {
        /// Everything: the record holds all traffic, and foreign nodes are counted.
        All = "all",
        /// What is of or for the bench and its drives, whoever sends it, and what is for all nodes.
        Stage = "stage",
    }
}

/// python-can's default group for IPv4, and its default port.
const UDP_GROUP: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(239, 74, 163, 2), 43_113);

/// A CAN bus by its name.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum CanInterface {
    /// `memory`: inside this process, with the virtual stage on it.
    Memory,
    /// `udp`, or `udp:ADDRESS:PORT`: the multicast group of python-can's `udp_multicast`.
    Udp(SocketAddrV4),
    /// A network interface of Linux, such as `can0`.
    Socket(String),
}

impl CanInterface {
    /// True for a bus made for tests, which never drives a real stage.
    pub fn is_for_tests(&self) -> bool {
        matches!(self, CanInterface::Memory | CanInterface::Udp(_))
    }

    /// True for a bus without a wire, on which the drives are emulated: `memory`, `udp`, and network
    /// interfaces whose names begin with `vcan` or `vxcan`, as Linux names its virtual ones.
    pub fn is_virtual(&self) -> bool {
        match self {
            CanInterface::Memory | CanInterface::Udp(_) => true,
            CanInterface::Socket(name) => name.starts_with("vcan") || name.starts_with("vxcan"),
        }
    }

    /// The key `interface` of `[can]`.
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        let interfaces = "\"memory\", \"udp\", \"udp:ADDRESS:PORT\" or the name of a CAN interface such as \"can0\"";
        let is_bus = |name: &str| CanInterface::named(name).is_some();
        let interface = s.text("interface", interfaces, is_bus);
        CanInterface::named(&interface).unwrap_or(CanInterface::Memory)
    }

    /// `None` where `name` is none of a bus.
    pub(super) fn named(name: &str) -> Option<Self> {
        match name.split_once(':') {
            None if name == "memory" => Some(CanInterface::Memory),
            None if name == "udp" => Some(CanInterface::Udp(UDP_GROUP)),
            Some(("udp", group)) => group.parse().ok().map(CanInterface::Udp),
            _ => is_interface(name).then(|| CanInterface::Socket(name.to_owned())),
        }
    }
}

impl fmt::Display for CanInterface {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            CanInterface::Memory => f.pad("memory"),
            CanInterface::Udp(UDP_GROUP) => f.pad("udp"),
            CanInterface::Udp(group) => f.pad(&format!("udp:{group}")),
            CanInterface::Socket(name) => f.pad(name),
        }
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
        CanConfig {
            interface: CanInterface::read(s),
            listen: s.choice("listen"),
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
