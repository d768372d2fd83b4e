//! Tests in real time, over the host's sockets, files and processes. Each holds
//! `support::programs::beside_others()`: it mostly waits, on a bus of its own, and runs beside others. A test
//! that floods the machine, or whose peer hears every bus over UDP, holds `alone()`. `protocol` takes as long as all
//! others and holds neither.

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
