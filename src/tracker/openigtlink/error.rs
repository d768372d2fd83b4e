//! What can be wrong with bytes that should be OpenIGTLink.

use thiserror::Error;

/// Bytes that are not a message the bench can take.
///
/// The protocol has no mark to look for the next message by. After every error but
/// [`DecodeError::Content`] the reader no longer knows where a message starts: the connection
/// must be dropped and made anew.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum DecodeError {
    /// The bytes end before the message does.
    #[error("openigtlink: {have} bytes of a message of {need}; it was cut off")]
    Truncated {
        /// Bytes there are.
        have: usize,
        /// Bytes needed, as far as is known.
        need: u64,
    },
    /// A header version other than 1 and 2; most often not OpenIGTLink at all.
    #[error(
        "openigtlink: header version {0} (1 or 2 expected); is that port an OpenIGTLink server?"
    )]
    Version(u16),
    /// A body beyond what is kept ([`super::BODY_LIMIT`]) or skipped
    /// ([`super::SKIPPED_BODY_LIMIT`]).
    #[error("openigtlink: {message_type} \"{device_name}\": body of {size} bytes (limit {limit})")]
    BodyTooLarge {
        /// The message's type.
        message_type: String,
        /// The device it names.
        device_name: String,
        /// The size its header states, bytes.
        size: u64,
        /// The largest size accepted, bytes.
        limit: u64,
    },
    /// The body is not what was sent.
    #[error(
        "openigtlink: {message_type} \"{device_name}\": CRC {computed:016x}, header says \
         {stated:016x}; bytes were lost or changed on the way"
    )]
    Crc {
        /// The message's type.
        message_type: String,
        /// The device it names.
        device_name: String,
        /// The checksum in the header.
        stated: u64,
        /// The checksum of the body.
        computed: u64,
    },
    /// A whole message with a good checksum whose inside is wrong: the sender's mistake. The
    /// next message starts where it should, so reading can go on.
    #[error("openigtlink: {message_type} \"{device_name}\": {problem}")]
    Content {
        /// The message's type.
        message_type: String,
        /// The device it names.
        device_name: String,
        /// What is wrong.
        problem: ContentError,
    },
}

impl DecodeError {
    /// True when the connection must be dropped: the start of the next message is lost.
    pub fn loses_framing(&self) -> bool {
        !matches!(self, DecodeError::Content { .. })
    }
}

/// What is wrong inside a message that arrived whole.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum ContentError {
    /// A body that is not as long as its type.
    #[error("content of {len} bytes ({expected} expected)")]
    Length {
        /// Bytes there are.
        len: usize,
        /// The sizes that the type has.
        expected: &'static str,
    },
    /// A version 2 extended header that is too short or goes beyond the body.
    #[error("extended header of {stated} bytes in a body of {body} (12 or more expected)")]
    ExtendedHeader {
        /// The size it states.
        stated: u16,
        /// The size of the body.
        body: usize,
    },
    /// Metadata sizes that go beyond the body.
    #[error("{stated} bytes of metadata where the body has {room}")]
    MetadataBeyondBody {
        /// Index and text together, as stated.
        stated: u64,
        /// Bytes after the extended header.
        room: usize,
    },
    /// More metadata entries stated than the metadata index has room for.
    #[error("{count} metadata entries in an index of {len} bytes")]
    MetadataIndex {
        /// Entries stated.
        count: u16,
        /// Bytes of the index.
        len: usize,
    },
    /// A metadata entry that goes beyond the metadata's text.
    #[error("metadata entry {index} goes beyond the {len} bytes of metadata text")]
    MetadataEntry {
        /// Which entry, from 0.
        index: u16,
        /// Bytes of text.
        len: usize,
    },
}
