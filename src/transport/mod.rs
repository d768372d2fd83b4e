//! CAN buses and the links to trackers. This folder moves bytes; others decide what they mean.

pub mod bus_error;
pub mod can;
pub mod link;
mod pipe;
mod replay;
#[cfg(target_os = "linux")]
pub mod socketcan;
pub mod tcp;
#[cfg(test)]
pub(crate) mod tests;
#[cfg(target_os = "linux")]
pub mod udp;
pub mod unconfirmed;
#[cfg(target_os = "linux")]
mod wait;
