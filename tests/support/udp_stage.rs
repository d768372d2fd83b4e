//! The virtual stage as a process of its own, on a bus over UDP or on vcan.

use super::drives::assert_the_drives_stand;
use super::programs::{self, Program};
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, TcpListener};
use std::sync::atomic::{AtomicU8, Ordering};

/// Counts per mm of the insertion drive in bench-config/vcan.toml.
pub(crate) const COUNTS_PER_MM: f64 = 4646.0;

/// A multicast group that no other process and no other test has, at python-can's default port:
/// canopen has no way to name another.
pub(crate) fn group() -> SocketAddrV4 {
    static GROUPS: AtomicU8 = AtomicU8::new(0);
    let [a, b, ..] = std::process::id().to_le_bytes();
    let test = GROUPS.fetch_add(1, Ordering::Relaxed) % 100;
    SocketAddrV4::new(Ipv4Addr::new(239, 75 + test, a, b), 43_113)
}

/// A bus, and the stage on it.
pub(crate) struct Stage {
    pub(crate) program: Program,
    /// Where the bus is, if it is over UDP.
    pub(crate) group: SocketAddrV4,
    tracker: SocketAddr,
    /// What the bench has to be told to find it.
    settings: [String; 2],
}

impl Stage {
    pub(crate) fn start(arguments: &[&str]) -> Self {
        let group = group();
        Stage { group, ..Stage::start_on(&format!("udp:{group}"), arguments) }
    }

    /// The same on another interface.
    pub(crate) fn start_on(interface: &str, arguments: &[&str]) -> Self {
        let bus = format!("can.interface=\"{interface}\"");
        let free = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).expect("a free port");
        let address = free.local_addr().expect("an address");
        drop(free);
        let tracker = format!("tracker.address=\"{address}\"");
        let there = ["--set", &bus, "--set", &tracker];
        let program = programs::stage(&[&there[..], arguments].concat());
        let settings = [bus, tracker];
        let group = SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0);
        Stage { program, group, tracker: address, settings }
    }

    /// Where its tracker serves.
    #[allow(dead_code, reason = "not every test needs it")]
    pub(crate) fn tracker(&self) -> SocketAddr {
        self.tracker
    }

    pub(crate) fn settings<'a>(&'a self, more: &[&'a str]) -> Vec<&'a str> {
        self.settings.iter().map(String::as_str).chain(more.iter().copied()).collect()
    }

    /// The drives stand and take no targets; where the insertion's does, mm.
    #[track_caller]
    pub(crate) fn assert_it_stands(&self) -> f64 {
        let [insertion, _] = assert_the_drives_stand(&self.settings(&[]));
        insertion.position_counts as f64 / COUNTS_PER_MM
    }
}
