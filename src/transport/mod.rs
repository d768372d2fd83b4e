//! The outside world: CAN buses and sockets. What the bytes mean is decided elsewhere; here they
//! are moved.

pub mod bus_error;
pub mod can;
pub mod link;
#[cfg(test)]
pub(crate) mod memory;
mod pipe;
pub mod record;
mod replay;
#[cfg(target_os = "linux")]
pub mod socketcan;
pub mod tcp;
#[cfg(target_os = "linux")]
pub mod udp;
pub mod unconfirmed;
#[cfg(target_os = "linux")]
mod wait;
