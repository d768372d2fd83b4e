//! Splits a stream of bytes into messages.

use super::body;
use super::header::{BODY_LIMIT, HEADER_LEN, Header, SKIPPED_BODY_LIMIT, crc64};
use super::message::Message;
use thiserror::Error;

/// Bytes that are not a message the bench can read.
///
/// The protocol has no mark that shows where the next message starts. If only the content of a message
/// is wrong, the sender made a mistake, and the reader goes on with the next message.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("openigtlink: {problem}")]
pub struct DecodeError {
    problem: String,
    /// The start of the next message is lost: drop the connection and make a new one.
    pub loses_framing: bool,
}

impl DecodeError {
    pub(super) fn framing(problem: String) -> Self {
        DecodeError { problem, loses_framing: true }
    }

    /// The content of the message is wrong.
    fn content(header: &Header, problem: &str) -> Self {
        let problem = format!("{}: {problem}", header.type_and_device());
        DecodeError { problem, loses_framing: false }
    }
}

/// Turns the chunks of a connection into messages, wherever the chunks were cut.
///
/// Push what was received, then poll until `Ok(None)`. Memory grows only with bytes that have
/// arrived, never with a length that a peer states. If polls follow every push, it stays below
/// [`BODY_LIMIT`], a header and one chunk.
#[derive(Debug, Default)]
pub struct StreamDecoder {
    buffer: Vec<u8>,
    /// Bytes of `buffer` already used.
    used: usize,
    state: State,
}

#[derive(Debug, Default)]
enum State {
    #[default]
    Header,
    Body(Header),
    /// The checksum is not checked: nothing of the body is used, and images are large.
    Skipping {
        header: Header,
        remaining: u64,
    },
    /// The start of the next message is lost.
    Lost(DecodeError),
}

impl StreamDecoder {
    /// Adds what was received. After an error that loses the framing, input is ignored.
    pub fn push(&mut self, chunk: &[u8]) {
        if matches!(self.state, State::Lost(_)) {
            return;
        }
        self.buffer.drain(..self.used);
        self.used = 0;
        self.buffer.extend_from_slice(chunk);
    }

    /// The next message, or `None` until more bytes are pushed. A type that the bench does not read
    /// becomes [`super::Body::Other`], without its content and unchecked.
    ///
    /// # Errors
    /// [`DecodeError`]. If it [loses the framing](DecodeError::loses_framing), every later poll gives
    /// the same error. Otherwise poll on.
    pub fn poll(&mut self) -> Result<Option<Message>, DecodeError> {
        let result = self.advance();
        if let Err(error) = &result
            && error.loses_framing
        {
            *self = StreamDecoder { state: State::Lost(error.clone()), ..Self::default() };
        }
        result
    }

    /// Ends the stream.
    ///
    /// # Errors
    /// If it ends within a message, or the framing was lost before.
    pub fn finish(&self) -> Result<(), DecodeError> {
        let unread = self.unread().len() as u64;
        let whole = |header: &Header| HEADER_LEN as u64 + header.body_size;
        let (have, need) = match &self.state {
            State::Header if unread == 0 => return Ok(()),
            State::Header => (unread, HEADER_LEN as u64),
            State::Body(header) => (HEADER_LEN as u64 + unread, whole(header)),
            State::Skipping { header, remaining } => (whole(header) - remaining, whole(header)),
            State::Lost(error) => return Err(error.clone()),
        };
        let problem = format!("{have} bytes of a message of {need}; it was cut off");
        Err(DecodeError::framing(problem))
    }

    pub(super) fn unread(&self) -> &[u8] {
        self.buffer.get(self.used..).unwrap_or_default()
    }

    fn advance(&mut self) -> Result<Option<Message>, DecodeError> {
        loop {
            // Not `self.unread()`: the state is borrowed apart from the buffer.
            let unread = self.buffer.get(self.used..).unwrap_or_default();
            match &mut self.state {
                State::Header => {
                    let Some(bytes) = unread.first_chunk() else { return Ok(None) };
                    let header = Header::parse(bytes)?;
                    let is_read = body::is_read(header.type_bytes());
                    let limit = if is_read { BODY_LIMIT } else { SKIPPED_BODY_LIMIT };
                    let size = header.body_size;
                    if size > limit {
                        let message = header.type_and_device();
                        let problem = format!("{message}: body of {size} bytes (limit {limit})");
                        return Err(DecodeError::framing(problem));
                    }
                    self.used += HEADER_LEN;
                    self.state = match is_read {
                        true => State::Body(header),
                        false => State::Skipping { header, remaining: size },
                    };
                }
                State::Body(header) => {
                    let len = usize::try_from(header.body_size).unwrap_or(usize::MAX);
                    let Some(body) = unread.get(..len) else { return Ok(None) };
                    let (computed, stated) = (crc64(body), header.crc);
                    if stated == 0 && computed != 0 {
                        return Err(DecodeError::framing(format!(
                            "{}: CRC 0: the sender computes no checksum; the bench needs one (CRC-64 ECMA-182)",
                            header.type_and_device()
                        )));
                    }
                    if computed != stated {
                        return Err(DecodeError::framing(format!(
                            "{}: CRC {computed:016x}, header says {stated:016x}; bytes were lost or \
                             changed on the way",
                            header.type_and_device()
                        )));
                    }
                    let message = Message::from_parts(header, body)
                        .map_err(|problem| DecodeError::content(header, &problem));
                    self.used += len;
                    self.state = State::Header;
                    return message.map(Some);
                }
                State::Skipping { header, remaining } => {
                    let len = usize::try_from(*remaining).unwrap_or(usize::MAX).min(unread.len());
                    *remaining -= len as u64;
                    self.used += len;
                    if *remaining > 0 {
                        return Ok(None);
                    }
                    let message = Message::skipped(header);
                    self.state = State::Header;
                    return Ok(Some(message));
                }
                State::Lost(error) => return Err(error.clone()),
            }
        }
    }
}
