//! Tests in real time, over the host's sockets, files and processes. Most tests mostly wait, on a bus of their
//! own, and run beside others: they hold `support::programs::beside_others()`. A test that floods the machine, or
//! whose peer hears every bus over UDP, holds `alone()`. `protocol` takes as long as all others together and holds
//! neither.

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
