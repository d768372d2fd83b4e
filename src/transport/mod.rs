//! The ways in and out: CAN buses for the control thread, sockets for the tracker.
//!
//! Nothing above `runtime` sees a socket: sessions take frames and bytes, and give them.

pub mod bus_error;
pub mod can;
pub mod memory;
#[cfg(target_os = "linux")]
pub mod socketcan;
//! The outside world: sockets and buses. What the bytes mean is decided elsewhere; here they are
//! moved.

pub mod tcp;
