//! The SDO server: answers one client about a node's objects.

#[cfg(test)]
mod tests;

use std::collections::VecDeque;
use std::time::Duration;

use super::codec::{ClientFrame, NO_OBJECT, SdoBytes, ServerFrame, encode_segment};
use super::{AbortCode, SdoReply, SdoRequest, SdoValue};
use crate::canopen::{Frame, NodeId, ObjectAddress, cob};
use crate::units::Time;

/// The objects that a server gives access to.
pub trait ObjectAccess {
    /// The bytes of `object`.
    ///
    /// # Errors
    /// The abort code to refuse with.
    fn read(&mut self, object: ObjectAddress) -> Result<Vec<u8>, AbortCode>;

    /// Writes `value` to `object`.
    ///
    /// # Errors
    /// The abort code to refuse with.
    fn write(&mut self, object: ObjectAddress, value: SdoValue) -> Result<(), AbortCode>;
}

/// A segmented upload under way.
#[derive(Debug, Clone)]
struct Upload {
    object: ObjectAddress,
    toggle: bool,
    /// The data that is still to be sent.
    unsent: Vec<u8>,
    deadline: Time,
}

/// Serves the objects of one node on its default SDO.
///
/// A new request ends a transfer that was not finished, as CiA 301 requires.
#[derive(Debug, Clone)]
pub struct SdoServer {
    node: NodeId,
    timeout: Duration,
    upload: Option<Upload>,
    outgoing: VecDeque<SdoBytes>,
}

impl SdoServer {
    /// A server of `node` that waits at most `timeout` for the next segment.
    pub fn new(node: NodeId, timeout: Duration) -> Self {
        SdoServer { node, timeout, upload: None, outgoing: VecDeque::new() }
    }

    /// Takes any frame; all but requests to this node are ignored.
    pub fn handle_frame(&mut self, now: Time, frame: &Frame, objects: &mut impl ObjectAccess) {
        if frame.cob_id() != Some(cob::sdo_rx(self.node)) {
            return;
        }
        let Some(request) = ClientFrame::decode(frame.data()) else { return };
        let upload = self.upload.take();
        let answer = match (request, upload) {
            (ClientFrame::Abort(..), _) => return,
            (ClientFrame::Request(SdoRequest::Upload(object)), _) => {
                self.read(now, object, objects).encode()
            }
            (ClientFrame::Request(SdoRequest::Download(object, value)), _) => {
                match objects.write(object, value) {
                    Ok(()) => ServerFrame::Reply(object, SdoReply::Downloaded).encode(),
                    Err(code) => ServerFrame::Abort(object, code).encode(),
                }
            }
            (ClientFrame::UploadSegment(toggle), Some(upload)) => self.segment(now, upload, toggle),
            (ClientFrame::UploadSegment(_), None) => {
                ServerFrame::Abort(NO_OBJECT, AbortCode::UNKNOWN_SPECIFIER).encode()
            }
            (ClientFrame::Unsupported(object), _) => {
                ServerFrame::Abort(object, AbortCode::UNKNOWN_SPECIFIER).encode()
            }
        };
        self.outgoing.push_back(answer);
    }

    /// Aborts a transfer whose next segment is overdue.
    pub fn handle_timeout(&mut self, now: Time) {
        if let Some(upload) = self.upload.take_if(|upload| now >= upload.deadline) {
            let abort = ServerFrame::Abort(upload.object, AbortCode::TIMEOUT);
            self.outgoing.push_back(abort.encode());
        }
    }

    /// Drops the transfer and all answers, as a reset of communication does.
    pub fn reset(&mut self) {
        self.upload = None;
        self.outgoing.clear();
    }

    /// The next frame to send.
    pub fn poll_transmit(&mut self) -> Option<Frame> {
        Some(Frame::new(cob::sdo_tx(self.node), &self.outgoing.pop_front()?))
    }

    /// When [`handle_timeout`](Self::handle_timeout) is due.
    pub fn deadline(&self) -> Time {
        self.upload.as_ref().map_or(Time::NEVER, |upload| upload.deadline)
    }

    fn read(
        &mut self,
        now: Time,
        object: ObjectAddress,
        objects: &mut impl ObjectAccess,
    ) -> ServerFrame {
        match objects.read(object).map(|data| (SdoValue::from_bytes(&data), data)) {
            Err(code) => ServerFrame::Abort(object, code),
            Ok((Some(value), _)) => ServerFrame::Reply(object, SdoReply::Uploaded(value)),
            Ok((None, unsent)) => {
                let size = u32::try_from(unsent.len()).unwrap_or(u32::MAX);
                let deadline = now + self.timeout;
                self.upload = Some(Upload { object, toggle: false, unsent, deadline });
                ServerFrame::InitiateUpload(object, size)
            }
        }
    }

    fn segment(&mut self, now: Time, mut upload: Upload, toggle: bool) -> SdoBytes {
        if toggle != upload.toggle {
            return ServerFrame::Abort(upload.object, AbortCode::TOGGLE_NOT_ALTERNATED).encode();
        }
        let (segment, unsent) = encode_segment(&upload.unsent, toggle);
        if !unsent.is_empty() {
            upload.unsent = unsent.to_vec();
            upload.toggle = !toggle;
            upload.deadline = now + self.timeout;
            self.upload = Some(upload);
        }
        segment
    }
}
