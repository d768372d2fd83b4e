//! Requests to an SDO client, and their results.

use std::time::Duration;

use thiserror::Error;

use super::{AbortCode, MAX_TRANSFER_BYTES};
use crate::canopen::{NodeId, ObjectAddress};

/// A transfer to start.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SdoRequest {
    /// Read the object.
    Upload(ObjectAddress),
    /// Write these bytes, little-endian, to the object.
    Download(ObjectAddress, Vec<u8>),
}

impl SdoRequest {
    /// The object read or written.
    pub fn object(&self) -> ObjectAddress {
        match self {
            SdoRequest::Upload(object) | SdoRequest::Download(object, _) => *object,
        }
    }
}

/// The result of a transfer that succeeded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SdoReply {
    /// The bytes read, little-endian.
    Uploaded(Vec<u8>),
    /// The node confirmed the write.
    Downloaded,
}

/// A transfer that failed.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("node {node} {object}: {kind}")]
pub struct SdoError {
    /// The server.
    pub node: NodeId,
    /// The object read or written.
    pub object: ObjectAddress,
    /// The cause.
    pub kind: SdoErrorKind,
}

/// Why a transfer failed.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum SdoErrorKind {
    /// Another transfer with this node is under way.
    #[error("an SDO transfer about {0} is still under way")]
    Busy(ObjectAddress),
    /// The node did not answer within this time.
    #[error("no SDO reply within {} ms", .0.as_millis())]
    Timeout(Duration),
    /// The node refused.
    #[error("refused with SDO abort {0}")]
    Aborted(AbortCode),
    /// The toggle bit of a segment did not alternate: a segment was lost or repeated.
    #[error("toggle bit not alternated after {0} bytes")]
    Toggle(usize),
    /// The node sent more or fewer bytes than it announced.
    #[error("{received} bytes received where {announced} were announced")]
    Size {
        /// As the node announced.
        announced: u32,
        /// As received so far.
        received: usize,
    },
    /// The response is not an expedited or segmented one.
    #[error("answer with unexpected command 0x{0:02X}")]
    UnexpectedCommand(u8),
    /// The transfer is longer than [`MAX_TRANSFER_BYTES`].
    #[error("transfer of {0} bytes is over the limit of {MAX_TRANSFER_BYTES}")]
    TooLong(usize),
    /// The caller cancelled it.
    #[error("cancelled")]
    Cancelled,
}
