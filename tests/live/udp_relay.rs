//! Runs through a relay between bench and drives, over UDP: what is tried is in tests/support/relay.rs.
#![cfg(target_os = "linux")]

use crate::support::programs::beside_others;
use crate::support::relay::{self, Buses};

#[test]
fn an_emergency_of_a_drive_that_was_found_in_fault() {
    let _machine = beside_others();
    relay::an_emergency_of_a_drive_that_was_found_in_fault(Buses::Udp);
}

#[test]
fn an_emergency_message_that_is_changed_or_lost_on_the_way() {
    let _machine = beside_others();
    relay::an_emergency_message_that_is_changed_or_lost_on_the_way(Buses::Udp);
}

#[test]
fn a_drive_that_takes_no_command_at_the_end() {
    let _machine = beside_others();
    relay::a_drive_that_takes_no_command_at_the_end(Buses::Udp);
}

#[test]
fn statuswords_of_a_drive_that_no_longer_obeys_or_follows() {
    let _machine = beside_others();
    relay::statuswords_of_a_drive_that_no_longer_obeys_or_follows(Buses::Udp);
}

#[test]
fn a_drive_that_warns_goes_on() {
    let _machine = beside_others();
    relay::a_drive_that_warns_goes_on(Buses::Udp);
}
