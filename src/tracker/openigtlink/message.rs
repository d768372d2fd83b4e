//! A whole message and its bytes.

use super::body::Body;
use super::header::{DEVICE_NAME_LEN, Header, IgtlStamp, TYPE_LEN, crc64, padded};
use super::metadata;

/// The metadata key under which a device name too long for the header is sent in full.
const DEVICE_NAME_KEY: &str = "IGTL_DEVICE_NAME";

/// One OpenIGTLink message.
#[derive(Debug, Clone, PartialEq)]
pub struct Message {
    /// The device's name as in the header, where it is truncated to 20 bytes; see
    /// [`Message::full_device_name`].
    pub device_name: String,
    /// When the data were made; `None` if the sender gives no stamp.
    pub timestamp: Option<IgtlStamp>,
    /// Type and content.
    pub body: Body,
    /// Key and value pairs, in the order received. Header version 2 only.
    pub metadata: Vec<(String, String)>,
}

impl Message {
    /// A message without metadata.
    pub fn new(device_name: &str, timestamp: Option<IgtlStamp>, body: Body) -> Self {
        Message { device_name: device_name.to_owned(), timestamp, body, metadata: Vec::new() }
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
    ///
    /// # Errors
    /// What is wrong with the body.
    pub(super) fn from_parts(header: &Header, body: &[u8]) -> Result<Self, String> {
        let (content, metadata) = match header.version {
            1 => (body, Vec::new()),
            _ => metadata::split(body)?,
        };
        let body = Body::decode(header.type_bytes(), content)?;
        Ok(Message { metadata, ..Message::new(&header.device_name(), header.timestamp(), body) })
    }

    /// A message whose body was skipped.
    pub(super) fn skipped(header: &Header) -> Self {
        Message::new(&header.device_name(), header.timestamp(), Body::Other(header.message_type()))
    }
}

/// The bytes of a message in version 1: a device name over 20 bytes is truncated, metadata are left out.
pub fn encode(message: &Message) -> Vec<u8> {
    let Message { device_name, timestamp, body, .. } = message;
    packet(1, body.type_name(), device_name, *timestamp, &body.encode())
}

/// The bytes of GET_STATUS, which a server that is alive answers with STATUS.
///
/// They are of version 2: a server such as PLUS sends metadata only to a client that has sent this version.
pub fn get_status() -> Vec<u8> {
    packet(2, "GET_STATUS", "", None, &metadata::WITHOUT_CONTENT)
}

/// The bytes of a message with this header version and body.
pub(super) fn packet(
    version: u16,
    message_type: &str,
    device_name: &str,
    timestamp: Option<IgtlStamp>,
    body: &[u8],
) -> Vec<u8> {
    [
        &version.to_be_bytes()[..],
        &padded::<TYPE_LEN>(message_type),
        &padded::<DEVICE_NAME_LEN>(device_name),
        &timestamp.map_or(0, IgtlStamp::bits).to_be_bytes(),
        &(body.len() as u64).to_be_bytes(),
        &crc64(body).to_be_bytes(),
        body,
    ]
    .concat()
}
