//! `[can]`: the bus and the times of CANopen on it.

use core::net::{Ipv4Addr, SocketAddrV4};
use std::fmt;
use std::time::Duration;

use toml::Value;

use crate::canopen::NodeId;
use crate::keys::{Field, Kind, Rule, choice, section, within};

section! {
    /// `[can]`: the bus and the times of CANopen on it.
    pub struct CanConfig {
        /// The bus. "memory" is inside this process, with the virtual stage on it. "udp" is
        /// python-can's udp_multicast, for machines without CAN; "udp:239.74.163.2:43113" names its
        /// group. Anything else is a network interface of Linux.
        interface: CanInterface [BUS] = "memory";
        /// What the bench receives, where the kernel can choose.
        listen: Listen = "all";
        /// Period of SYNC, ms.
        sync_ms: u16 [within(1.0, 100.0)] = 10;
        /// The bench's own node number: the drives watch its heartbeat.
        bench_node: NodeId = 127;
        /// Period of the bench's and the drives' heartbeats, ms.
        heartbeat_ms: u16 [within(5.0, 10_000.0)] = 25;
        /// A heartbeat that is missing for this long stops the run, and the drives, ms.
        heartbeat_timeout_ms: u16 [within(10.0, 60_000.0)] = 100;
        /// Longest wait for the answer to one SDO request, ms.
        sdo_timeout_ms: u16 [within(10.0, 10_000.0)] = 150;
        /// How often an SDO request is sent before giving up.
        sdo_attempts: u8 [within(1.0, 20.0)] = 3;
        /// Longest wait for a drive to boot, s.
        boot_timeout as "boot_timeout_s": Duration [within(0.1, 120.0)] = 2.0;
        /// How often the bring-up of a drive is begun, if the drive restarts in the middle of it.
        boot_attempts: u8 [within(1.0, 20.0)] = 3;
        /// SYNCs in a row without both drives' answers that are tolerated.
        missed_feedback_max: u8 [within(0.0, 100.0)] = 1;
    }
}

choice! {
    /// What is received of the bus, where the kernel can choose.
    pub enum Listen {
        /// Everything: the record holds all traffic, and foreign nodes are counted.
        All = "all",
        /// For a busy bus: only frames of or for the bench and its drives, whoever sends them, and
        /// frames for all nodes.
        Stage = "stage",
    }
}

const BUS: Rule = Rule::Text(
    "\"memory\", \"udp\", \"udp:ADDRESS:PORT\" or the name of a CAN interface such as \"can0\"",
    |name| CanInterface::named(name).is_some(),
);

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

    /// The bus of this name; `None` where no bus can have it.
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

impl Field for CanInterface {
    const KIND: Kind = Kind::Text;
    fn take(value: Option<&Value>) -> Self {
        CanInterface::named(&String::take(value)).unwrap_or(CanInterface::Memory)
    }
}

impl Field for NodeId {
    const KIND: Kind = Kind::Integer(1.0, 127.0);
    fn take(value: Option<&Value>) -> Self {
        NodeId::new(u8::take(value)).unwrap_or(const { NodeId::new(1).unwrap() })
    }
}

/// What Linux takes for the name of a network interface: under 16 bytes (IFNAMSIZ), no space, no
/// slash.
fn is_interface(name: &str) -> bool {
    (1..16).contains(&name.len())
        && name.bytes().all(|byte| byte.is_ascii_graphic() && byte != b'/')
}
