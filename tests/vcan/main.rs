//! Tests on vcan0 and vcan1, which `vcan/run.sh` provides. Each test holds `support::vcan::alone_on_it()`, because
//! only one at a time can use the bus.
#![cfg(target_os = "linux")]

mod peers;
mod preflight;
mod protocol;
mod relay;
mod run;
mod smoke;
#[path = "../support/mod.rs"]
mod support;
