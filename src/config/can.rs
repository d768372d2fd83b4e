//! `[can]`: the bus and the times of CANopen on it.

use core::net::{Ipv4Addr, SocketAddrV4};

use derive_more::Display;
use toml::Value;

use crate::canopen::NodeId;
use crate::keys::{Field, Kind, Rule, choice, section};
use crate::stage::BusConfig;

section! {
    /// `[can]`: the bus and the times of CANopen on it.
    pub struct CanConfig {
        /// The bus. "memory" is inside this process, with the virtual stage on it. "udp" is
        /// python-can's udp_multicast, for machines without CAN; "udp:239.74.163.2:43113" names its
        /// group. Anything else is a network interface of Linux.
        interface: CanInterface [BUS] = "memory";
        /// The frames that the bench receives, if the kernel can filter.
        listen: Listen = "all";
        /// Periods, timeouts and the bench's node number.
        bus: BusConfig, flat;
    }
}

choice! {
    /// The frames that the bench receives, if the kernel can filter.
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
#[derive(Debug, Clone, PartialEq, Eq, Hash, Display)]
pub enum CanInterface {
    /// `memory`: inside this process, with the virtual stage on it.
    #[display("memory")]
    Memory,
    /// `udp`, or `udp:ADDRESS:PORT`: the multicast group of python-can's `udp_multicast`.
    #[display("{}", if *_0 == UDP_GROUP { "udp".to_owned() } else { format!("udp:{_0}") })]
    Udp(SocketAddrV4),
    /// A network interface of Linux, such as `can0`.
    Socket(String),
}

impl CanInterface {
    /// True for a bus that exists only for tests and never reaches a real stage.
    pub fn is_for_tests(&self) -> bool {
        matches!(self, CanInterface::Memory | CanInterface::Udp(_))
    }

    /// True for a bus without a wire, on which the drives are emulated: `memory`, `udp`, and Linux's virtual
    /// CAN interfaces, whose names begin with `vcan` or `vxcan`.
    pub fn is_virtual(&self) -> bool {
        let is_virtual = |name: &str| name.starts_with("vcan") || name.starts_with("vxcan");
        self.is_for_tests() || matches!(self, CanInterface::Socket(name) if is_virtual(name))
    }

    /// The bus of this name; `None` if no bus can have it.
    pub(super) fn named(name: &str) -> Option<Self> {
        match name.split_once(':') {
            None if name == "memory" => Some(CanInterface::Memory),
            None if name == "udp" => Some(CanInterface::Udp(UDP_GROUP)),
            Some(("udp", group)) => {
                let group = group.parse().ok();
                let is_group = |to: &SocketAddrV4| to.ip().is_multicast() && to.port() != 0;
                group.filter(is_group).map(CanInterface::Udp)
            }
            _ => is_interface(name).then(|| CanInterface::Socket(name.to_owned())),
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

/// True if Linux accepts this name for a network interface: under 16 bytes (IFNAMSIZ), no space, slash or
/// colon, and neither `.` nor `..`.
fn is_interface(name: &str) -> bool {
    (1..16).contains(&name.len())
        && name.bytes().all(|byte| byte.is_ascii_graphic() && !b"/:".contains(&byte))
        && ![".", ".."].contains(&name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_that_no_bus_can_have_is_refused() {
        for name in ["vcan0:1", "memory:1", ".", "..", "udp:127.0.0.1:43113", "udp:239.1.2.3:0"] {
            assert_eq!(CanInterface::named(name), None, "{name}");
        }
        let group = CanInterface::named("udp:239.1.2.3:43113");
        assert!(matches!(group, Some(CanInterface::Udp(_))), "{group:?}");
    }
}
