//! The worked protocol of docs/rig.md over vcan0, between the public programs and pyigtl.

use crate::support::protocol::follow;
use crate::support::vcan;

#[test]
fn the_worked_protocol_from_power_on_to_the_calibrated_needle() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let done = follow();
    assert_eq!(done.len(), 23, "{done:#?}");
}
