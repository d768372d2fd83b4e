//! The OpenIGTLink protocol: the messages a tracker sends, as bytes.
//!
//! Read: header versions 1 and 2 with metadata; TRANSFORM, POSITION, TDATA, QTDATA and STATUS. Every
//! other type is skipped over, whatever it holds, and reported by its name. Written: version 1, also
//! the requests that start and stop TDATA and QTDATA; GET_STATUS in version 2. Numbers are big-endian;
//! positions are in mm.
//!
//! Source: the OpenIGTLink protocol specification, versions 1 to 3, and the byte fixtures of its
//! reference library.

mod body;
mod decoder;
mod header;
mod message;
mod metadata;

pub use body::{Body, Quaternion, Status, Tool, ToolStream, tool_kind};
pub use decoder::{DecodeError, StreamDecoder};
pub use header::{BODY_LIMIT, DEVICE_NAME_LEN, HEADER_LEN, IgtlStamp, SKIPPED_BODY_LIMIT, crc64};
pub use message::{Message, encode, get_status};

#[cfg(test)]
mod tests;
