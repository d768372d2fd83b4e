//! Runs through a relay between bench and drives, over SocketCAN: what is tried is in tests/support/relay.rs.

use crate::support::relay::{self, Buses};
use crate::support::vcan;

#[test]
fn an_emergency_on_vcan_of_a_drive_that_was_found_in_fault() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    relay::an_emergency_of_a_drive_that_was_found_in_fault(Buses::Vcan);
}

#[test]
fn a_drive_that_takes_no_command_on_vcan() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    relay::a_drive_that_takes_no_command_at_the_end(Buses::Vcan);
}

#[test]
fn statuswords_on_vcan_of_a_drive_that_no_longer_obeys_or_follows() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    relay::statuswords_of_a_drive_that_no_longer_obeys_or_follows(Buses::Vcan);
}
