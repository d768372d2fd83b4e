//! Service data objects (CiA 301, 7.2.4): reading and writing a node's object dictionary.
//!
//! Client and server make expedited and segmented transfers. Block transfer is refused.

use std::cmp::Ordering;

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

/// Checks a segmented transfer after a segment: `announced` is its size, if the sender gave one.
fn check_size(received: usize, announced: Option<u32>, last: bool) -> Result<(), AbortCode> {
    if received > MAX_TRANSFER_BYTES {
        return Err(AbortCode::OutOfMemory);
    }
    match announced.map(|size| received.cmp(&(size as usize))) {
        Some(Ordering::Greater) => Err(AbortCode::LengthTooHigh),
        Some(Ordering::Less) if last => Err(AbortCode::LengthTooLow),
        _ => Ok(()),
    }
}
