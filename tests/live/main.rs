//! Tests in real time, over the host's sockets, files and processes. Each test holds
//! `support::programs::alone()`, so that no other disturbs its times. Tests that mostly wait, on a bus
//! of their own, hold `beside_others()` and run beside one another.

mod console;
mod openigtlink_peers;
mod protocol;
mod recording_peers;
mod records;
#[path = "../support/mod.rs"]
mod support;
mod tracker_commands;
mod tracker_flood;
mod tracker_hostile;
mod tracker_peers;
mod udp_relay;
mod udp_run;
