//! The OpenIGTLink protocol: the messages a tracker sends, as bytes.
//!
//! Read: header versions 1 and 2 with metadata; TRANSFORM, POSITION, TDATA, QTDATA and STATUS, and
//! the requests that start and stop TDATA and QTDATA. Every other type is skipped over, whatever it
//! holds, and reported by its name. Written: version 1 by default. Numbers are big-endian;
//! positions are in mm.
//!
//! Source: the OpenIGTLink protocol specification, versions 1 to 3, and the byte fixtures of its
//! reference library.

mod body;
mod crc64;
mod decoder;
mod error;
mod header;
mod message;
mod metadata;
mod stamp;
mod tracking_data;

pub use body::{Body, Quaternion, Status};
pub use crc64::crc64;
pub use decoder::StreamDecoder;
pub use error::DecodeError;
pub use header::{BODY_LIMIT, HEADER_LEN, SKIPPED_BODY_LIMIT};
pub use message::{Message, Version, encode};
pub use stamp::IgtlStamp;
pub use tracking_data::{StartStream, Tool, ToolKind, ToolStream};

/// The longest device name that fits the header; a longer one is cut there.
pub const DEVICE_NAME_LEN: usize = header::NAME_LEN;

/// The metadata key under which a device name too long for the header is sent in full.
pub const DEVICE_NAME_KEY: &str = "IGTL_DEVICE_NAME";

#[cfg(test)]
mod tests;
