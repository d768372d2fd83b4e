//! A whole message and its bytes.

use super::body::Body;
use super::crc64::crc64;
use super::error::DecodeError;
use super::header::{HEADER_LEN, Header, NAME_LEN, TYPE_LEN, padded};
use super::stamp::IgtlStamp;
use super::{DEVICE_NAME_KEY, metadata};

/// One OpenIGTLink message.
#[derive(Debug, Clone, PartialEq)]
pub struct Message {
    /// The header version in which it came or will be sent.
    pub version: Version,
    /// The device's name as in the header, where it is cut to 20 bytes; see
    /// [`Message::full_device_name`].
    pub device_name: String,
    /// When the data were made; `None` if the sender gives no stamp.
    pub timestamp: Option<IgtlStamp>,
    /// Type and content.
    pub body: Body,
    /// Key and value pairs, in the order sent. Version 2 only: version 1 leaves them out.
    pub metadata: Vec<(String, String)>,
}

/// The version of a header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Version {
    /// Protocol versions 1 and 2; every peer reads it.
    V1,
    /// Protocol version 3: extended header and metadata.
    V2 {
        /// The sender's number of the message.
        message_id: u32,
    },
}

impl Message {
    /// A version 1 message without metadata.
    pub fn new(device_name: &str, timestamp: Option<IgtlStamp>, body: Body) -> Self {
        Message {
            version: Version::V1,
            device_name: device_name.to_owned(),
            timestamp,
            body,
            metadata: Vec::new(),
        }
    }

    /// The value of a metadata key.
    pub fn metadata(&self, key: &str) -> Option<&str> {
        self.metadata.iter().find(|(k, _)| k == key).map(|(_, value)| value.as_str())
    }

    /// The device's whole name: from the metadata if it is there, else from the header.
    pub fn full_device_name(&self) -> &str {
        self.metadata(DEVICE_NAME_KEY).unwrap_or(&self.device_name)
    }

    /// A message from its header and its whole body, whose checksum has been checked.
    pub(super) fn from_parts(header: &Header, body: &[u8]) -> Result<Self, DecodeError> {
        let read = || -> Result<Self, String> {
            let (version, content, metadata) = if header.version == 1 {
                (Version::V1, body, Vec::new())
            } else {
                let extended = metadata::split(body)?;
                let version = Version::V2 { message_id: extended.message_id };
                (version, extended.content, extended.metadata)
            };
            Ok(Message {
                version,
                device_name: header.device_name(),
                timestamp: header.timestamp(),
                body: Body::decode(header.type_bytes(), content)?,
                metadata,
            })
        };
        read()
            .map_err(|problem| DecodeError::Content { message: header.type_and_device(), problem })
    }

    /// The message whose body was skipped.
    pub(super) fn skipped(header: &Header) -> Self {
        Message::new(&header.device_name(), header.timestamp(), Body::Other(header.message_type()))
    }
}

/// The bytes of a message, in the version it asks for.
///
/// A device name over 20 bytes is cut in the header; version 2 also sends it whole, as metadata
/// `IGTL_DEVICE_NAME`.
pub fn encode(message: &Message) -> Vec<u8> {
    let mut content = Vec::new();
    message.body.encode(&mut content);
    let (version, body) = match message.version {
        Version::V1 => (1_u16, content),
        Version::V2 { message_id } => (2, {
            let mut metadata = message.metadata.clone();
            if message.device_name.len() > NAME_LEN && message.metadata(DEVICE_NAME_KEY).is_none() {
                metadata.push((DEVICE_NAME_KEY.to_owned(), message.device_name.clone()));
            }
            metadata::join(message_id, &content, &metadata)
        }),
    };
    let stamp_bits = message.timestamp.map_or(0, IgtlStamp::bits);
    let mut bytes = Vec::with_capacity(HEADER_LEN + body.len());
    bytes.extend_from_slice(&version.to_be_bytes());
    bytes.extend_from_slice(&padded::<TYPE_LEN>(message.body.type_name()));
    bytes.extend_from_slice(&padded::<NAME_LEN>(&message.device_name));
    bytes.extend_from_slice(&stamp_bits.to_be_bytes());
    bytes.extend_from_slice(&(body.len() as u64).to_be_bytes());
    bytes.extend_from_slice(&crc64(&body).to_be_bytes());
    bytes.extend_from_slice(&body);
    bytes
}
