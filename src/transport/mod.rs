//! CAN buses and the links to trackers. This folder moves bytes; others decide what they mean.

pub mod can;
pub mod link;
pub mod socketcan;
pub mod tcp;
#[cfg(test)]
pub(crate) mod tests;
pub mod udp;
pub mod unconfirmed;
