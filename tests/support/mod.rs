//! Helpers that the test binaries share.
#![allow(dead_code, reason = "each test binary uses a part")]

pub(crate) mod bench;
pub(crate) mod drives;
pub(crate) mod link;
pub(crate) mod needed;
pub(crate) mod peers;
pub(crate) mod program;
pub(crate) mod programs;
pub(crate) mod protocol;
pub(crate) mod python_drives;
pub(crate) mod recorded;
pub(crate) mod recording;
pub(crate) mod relay;
pub(crate) mod replays;
pub(crate) mod stop;
pub(crate) mod terminal;
pub(crate) mod udp_stage;
pub(crate) mod vcan;
pub(crate) mod witness;
