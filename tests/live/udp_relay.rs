//! The runs of tests/support/relay.rs, over UDP.
#![cfg(target_os = "linux")]

use crate::support::programs::beside_others;
use crate::support::relay::{self, Buses};

#[test]
fn a_new_emergency_of_a_drive_that_was_found_in_fault_stops_the_run() {
    let _machine = beside_others();
    relay::a_new_emergency_of_a_drive_that_was_found_in_fault_stops_the_run(Buses::Udp);
}

#[test]
fn a_drive_fault_stops_the_run_if_its_emergency_message_is_changed_or_lost() {
    let _machine = beside_others();
    relay::a_drive_fault_stops_the_run_if_its_emergency_message_is_changed_or_lost(Buses::Udp);
}

#[test]
fn a_drive_that_ignores_every_command_to_power_off_is_reported() {
    let _machine = beside_others();
    relay::a_drive_that_ignores_every_command_to_power_off_is_reported(Buses::Udp);
}

#[test]
fn statusword_bit_9_4_or_12_cleared_stops_the_run() {
    let _machine = beside_others();
    relay::statusword_bit_9_4_or_12_cleared_stops_the_run(Buses::Udp);
}

#[test]
fn a_run_completes_although_a_drive_warns() {
    let _machine = beside_others();
    relay::a_run_completes_although_a_drive_warns(Buses::Udp);
}
