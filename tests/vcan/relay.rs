//! The runs of tests/support/relay.rs, over SocketCAN.

use crate::support::relay::{self, Buses};
use crate::support::vcan;

#[test]
fn a_new_emergency_on_vcan_of_a_drive_that_was_found_in_fault_stops_the_run() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    relay::a_new_emergency_of_a_drive_that_was_found_in_fault_stops_the_run(Buses::Vcan);
}

#[test]
fn a_drive_on_vcan_that_ignores_every_command_to_power_off_is_reported() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    relay::a_drive_that_ignores_every_command_to_power_off_is_reported(Buses::Vcan);
}

#[test]
fn statusword_bit_4_cleared_on_vcan_stops_the_run() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    relay::statusword_bit_9_4_or_12_cleared_stops_the_run(Buses::Vcan);
}
