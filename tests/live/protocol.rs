//! The worked protocol of docs/rig.md over UDP, between the public programs and pyigtl.
#![cfg(target_os = "linux")]

use crate::support::protocol::{Change, follow};
use crate::support::udp_stage::group;
use std::net::SocketAddrV4;

/// The changes of the operator's file on this bus, with their reasons, as in docs/rig.md.
const CHANGES: [Change; 3] = [
    // The bench refuses hardware = true on a UDP bus. Without the raw values it writes those of the keys, in counts/s².
    ("hardware = true\n", "hardware = false\n"),
    (
        "[[stage.insertion.sdo]]\nindex = 0x6085\nsubindex = 0\nvalue = 10_000                        # \
         MEASURE: the axis must stop within 0.1 mm from full speed\nbits = 32\n",
        "",
    ),
    ("[[stage.rotation.sdo]]\nindex = 0x6085\nsubindex = 0\nvalue = 10_000\nbits = 32\n", ""),
];

/// This takes as long as all other tests here together, so it runs beside each of them, also beside those that are
/// alone: it mostly waits, and no peer of theirs hears this port.
#[test]
fn every_command_of_the_worked_protocol_succeeds() {
    let group = SocketAddrV4::new(*group().ip(), 43_114);
    let done = follow(&format!("udp:{group}"), &CHANGES, |_| true);
    assert_eq!(done.len(), 24, "{done:#?}");
}
