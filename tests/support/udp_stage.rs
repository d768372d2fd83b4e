//! `vcan-stage` as a process of its own, on a bus over UDP or on vcan.

use super::drives::assert_the_drives_stand;
use super::programs::{self, Program, free_address};
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};
use std::sync::atomic::{AtomicU8, Ordering};

/// Counts per mm of the insertion drive in bench-config/vcan.toml.
pub(crate) const COUNTS_PER_MM: f64 = 4646.0;

/// A multicast group of this process and test alone, at python-can's default port: python-canopen cannot name
/// another.
pub(crate) fn group() -> SocketAddrV4 {
    static GROUPS: AtomicU8 = AtomicU8::new(0);
    let [a, b, ..] = std::process::id().to_le_bytes();
    let test = GROUPS.fetch_add(1, Ordering::Relaxed) % 100;
    SocketAddrV4::new(Ipv4Addr::new(239, 75 + test, a, b), 43_113)
}

/// The virtual stage on its bus.
pub(crate) struct Stage {
    pub(crate) program: Program,
    /// The bus, if it is over UDP.
    pub(crate) group: SocketAddrV4,
    /// Address of the tracker server.
    pub(crate) tracker: SocketAddr,
    /// The bench's settings for this bus and tracker.
    settings: [String; 2],
}

impl Stage {
    pub(crate) fn start(arguments: &[&str]) -> Self {
        let group = group();
        Stage { group, ..Stage::start_on(&format!("udp:{group}"), arguments) }
    }

    /// Starts the stage on a bus that `can.interface` names.
    pub(crate) fn start_on(interface: &str, arguments: &[&str]) -> Self {
        let bus = format!("can.interface=\"{interface}\"");
        let tracker = free_address();
        let address = format!("tracker.address=\"{tracker}\"");
        let sets = ["--set", &bus, "--set", &address];
        let program = programs::stage(&[&sets[..], arguments].concat());
        let group = SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0);
        Stage { program, group, tracker, settings: [bus, address] }
    }

    pub(crate) fn settings<'a>(&'a self, more: &[&'a str]) -> Vec<&'a str> {
        self.settings.iter().map(String::as_str).chain(more.iter().copied()).collect()
    }

    /// Asserts that both drives stand and take no targets. Returns the position of the insertion drive, mm.
    #[track_caller]
    pub(crate) fn assert_it_stands(&self) -> f64 {
        let [insertion, _] = assert_the_drives_stand(&self.settings(&[]));
        insertion.position_counts as f64 / COUNTS_PER_MM
    }
}
