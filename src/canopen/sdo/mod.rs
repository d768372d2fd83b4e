//! Service data objects (CiA 301, 7.2.4): reading and writing a node's object dictionary.
//!
//! The bench reads and writes values of 1 to 4 bytes, each in one frame (expedited transfer). The server
//! also sends longer values, such as a device's name, in segments.

use std::time::Duration;

use super::ObjectAddress;

pub mod abort;
pub mod client;
pub mod codec;
pub mod server;
mod value;

pub use abort::AbortCode;
pub use client::SdoClient;
pub use server::{ObjectAccess, SdoServer};
pub use value::SdoValue;

/// A transfer to start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SdoRequest {
    /// Read the object.
    Upload(ObjectAddress),
    /// Write this value to the object.
    Download(ObjectAddress, SdoValue),
}

impl SdoRequest {
    /// The object read or written.
    pub fn object(self) -> ObjectAddress {
        match self {
            SdoRequest::Upload(object) | SdoRequest::Download(object, _) => object,
        }
    }
}

/// The result of a transfer that succeeded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SdoReply {
    /// The value read.
    Uploaded(SdoValue),
    /// The node confirmed the write.
    Downloaded,
}

/// Why a transfer failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum SdoError {
    /// The node did not answer within this time.
    #[error("no SDO reply within {} ms", .0.as_millis())]
    Timeout(Duration),
    /// The node refused.
    #[error("refused with SDO abort {0}")]
    Aborted(AbortCode),
    /// The value is longer than the 4 bytes of one frame.
    #[error("value of more than 4 bytes, is it an object of this drive?")]
    TooLong,
    /// The response is none of these.
    #[error("answer with unexpected command 0x{0:02X}")]
    UnexpectedCommand(u8),
}
