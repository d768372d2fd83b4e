//! Errors of bytes that should be OpenIGTLink.

use thiserror::Error;

/// Bytes that are not a message the bench can take.
///
/// The protocol has no mark that shows where the next message starts. After every error but
/// [`DecodeError::Content`] the reader has lost it: drop the connection and make a new one.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum DecodeError {
    /// The bytes end before the message does.
    #[error("openigtlink: {have} bytes of a message of {need}; it was cut off")]
    Truncated {
        /// Bytes received.
        have: usize,
        /// Bytes needed, as far as is known.
        need: u64,
    },
    /// The header version is not 1 or 2; most often the peer does not speak OpenIGTLink at all.
    #[error(
        "openigtlink: header version {0} (1 or 2 expected); is that port an OpenIGTLink server?"
    )]
    Version(u16),
    /// The body is larger than what is kept ([`super::BODY_LIMIT`]) or skipped
    /// ([`super::SKIPPED_BODY_LIMIT`]).
    #[error("openigtlink: {message}: body of {size} bytes (limit {limit})")]
    BodyTooLarge {
        /// The message's type and device.
        message: String,
        /// The size that its header states, bytes.
        size: u64,
        /// The largest size accepted, bytes.
        limit: u64,
    },
    /// The body is not the one that was sent.
    #[error(
        "openigtlink: {message}: CRC {computed:016x}, header says {stated:016x}; bytes were lost or \
         changed on the way"
    )]
    Crc {
        /// The message's type and device.
        message: String,
        /// The checksum in the header.
        stated: u64,
        /// The checksum of the body.
        computed: u64,
    },
    /// The message is whole and its checksum is right, but its content is wrong: the sender made a
    /// mistake. The reader goes on with the next message.
    #[error("openigtlink: {message}: {problem}")]
    Content {
        /// The message's type and device.
        message: String,
        /// What is wrong.
        problem: String,
    },
}

impl DecodeError {
    /// True when the connection must be dropped: the start of the next message is lost.
    pub fn loses_framing(&self) -> bool {
        !matches!(self, DecodeError::Content { .. })
    }
}
