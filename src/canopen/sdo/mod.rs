//! Service data objects (CiA 301, 7.2.4): reading and writing a node's object dictionary.
//!
//! Expedited and segmented transfer, both directions, both sides. Block transfer is refused.

pub mod abort;
pub mod client;
pub mod codec;
pub mod server;
pub mod transfer;

pub use abort::AbortCode;
pub use client::SdoClient;
pub use server::{ObjectAccess, SdoServer};
pub use transfer::{SdoError, SdoErrorKind, SdoReply, SdoRequest};

/// The longest transfer accepted in either direction, in bytes.
pub const MAX_TRANSFER_BYTES: usize = 64 * 1024;
