//! The SDO client: one transfer at a time with one node.

mod segmented;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;
use std::time::Duration;

use super::codec::{ClientFrame, Initiate, ServerFrame};
use super::{AbortCode, MAX_TRANSFER_BYTES, SdoError, SdoErrorKind, SdoReply, SdoRequest};
use crate::canopen::{Frame, NodeId, ObjectAddress, cob};
use crate::units::Time;

/// One of these is read before the next request when an old answer may still come. Every node has
/// both.
const FENCES: [ObjectAddress; 2] = [ObjectAddress::new(0x1001, 0), ObjectAddress::new(0x1000, 0)];

/// The object in an abort that names none.
const NO_OBJECT: ObjectAddress = ObjectAddress::new(0, 0);

/// The answer a transfer waits for.
#[derive(Debug, Clone)]
enum Awaited {
    /// The answer to the fence. Then the request is sent, and its own answer is awaited.
    Fence(ObjectAddress, ClientFrame, Box<Awaited>),
    Upload,
    UploadSegment {
        toggle: bool,
        announced: Option<u32>,
    },
    Download,
    DownloadSegment {
        toggle: bool,
        sent: usize,
    },
}

#[derive(Debug, Clone)]
struct Transfer {
    object: ObjectAddress,
    awaited: Awaited,
    /// The data received so far, or all data to send.
    data: Vec<u8>,
    deadline: Time,
}

/// What to do after an answer.
enum Step {
    /// Not an answer to this transfer: wait on.
    Ignore,
    Send(ClientFrame),
    Done(SdoReply),
    /// Failed. Abort with this code, unless the node itself aborted.
    Fail(SdoErrorKind, Option<AbortCode>),
}

/// Reads and writes objects of one node, one transfer at a time.
///
/// Start a transfer, then: hand in every frame, drain [`poll_transmit`](Self::poll_transmit),
/// call [`handle_timeout`](Self::handle_timeout) at [`deadline`](Self::deadline), until
/// [`poll_result`](Self::poll_result) gives the result. The client does not retry.
///
/// A late answer is never taken for the answer to the next request. Answers name their object, so an
/// answer about another object is ignored. After a transfer that the client itself ended (by a
/// timeout or an abort) even an answer about the same object may be old. Then the client first reads
/// the error register (0x1001) and ignores everything before that answer. A node answers in order,
/// so no old answer comes after it.
#[derive(Debug, Clone)]
pub struct SdoClient {
    node: NodeId,
    timeout: Duration,
    transfer: Option<Transfer>,
    /// An answer to an earlier request may still come.
    owed: bool,
    outgoing: VecDeque<ClientFrame>,
    result: Option<Result<SdoReply, SdoError>>,
}

impl SdoClient {
    /// A client of `node` that waits at most `timeout` for each answer (150 ms is common; 20 ms
    /// is too short for real drives).
    pub fn new(node: NodeId, timeout: Duration) -> Self {
        SdoClient {
            node,
            timeout,
            transfer: None,
            owed: false,
            outgoing: VecDeque::new(),
            result: None,
        }
    }

    /// The server.
    pub fn node(&self) -> NodeId {
        self.node
    }

    /// Starts a transfer. A result that was not polled is dropped.
    ///
    /// # Errors
    /// [`SdoErrorKind::Busy`] while another is under way, [`SdoErrorKind::TooLong`] for a
    /// download over [`MAX_TRANSFER_BYTES`].
    pub fn start(&mut self, now: Time, request: SdoRequest) -> Result<(), SdoError> {
        let object = request.object();
        if let Some(transfer) = &self.transfer {
            return Err(self.error(object, SdoErrorKind::Busy(transfer.object)));
        }
        let (frame, awaited, data) = match request {
            SdoRequest::Download(_, data) if data.len() > MAX_TRANSFER_BYTES => {
                return Err(self.error(object, SdoErrorKind::TooLong(data.len())));
            }
            SdoRequest::Upload(_) => {
                (ClientFrame::InitiateUpload(object), Awaited::Upload, Vec::new())
            }
            SdoRequest::Download(_, data) => {
                let frame = ClientFrame::InitiateDownload(object, Initiate::for_data(&data));
                (frame, Awaited::Download, data)
            }
        };
        let (frame, awaited) =
            if self.owed { behind_a_fence(frame, awaited) } else { (frame, awaited) };
        self.result = None;
        self.outgoing.push_back(frame);
        self.transfer = Some(Transfer { object, awaited, data, deadline: now + self.timeout });
        Ok(())
    }

    /// Takes any frame; all but this node's SDO answers are ignored.
    pub fn handle_frame(&mut self, now: Time, frame: &Frame) {
        if frame.cob_id() != Some(cob::sdo_tx(self.node)) {
            return;
        }
        let Some(mut transfer) = self.transfer.take() else { return };
        let Some(answer) = ServerFrame::decode(frame.data()) else {
            self.transfer = Some(transfer);
            return;
        };
        if let Awaited::Fence(fence, request, awaited) = &transfer.awaited {
            if answer.object() == Some(*fence) {
                self.owed = false;
                self.outgoing.push_back(*request);
                transfer.awaited = awaited.as_ref().clone();
                transfer.deadline = now + self.timeout;
            }
            self.transfer = Some(transfer);
            return;
        }
        match transfer.step(answer) {
            Step::Ignore => self.transfer = Some(transfer),
            Step::Send(frame) => {
                self.outgoing.push_back(frame);
                transfer.deadline = now + self.timeout;
                self.transfer = Some(transfer);
            }
            Step::Done(reply) => self.result = Some(Ok(reply)),
            Step::Fail(kind, abort) => self.fail(transfer.object, kind, abort),
        }
    }

    /// Aborts a transfer whose answer is overdue (0504 0000).
    pub fn handle_timeout(&mut self, now: Time) {
        if let Some(transfer) = self.transfer.take_if(|transfer| now >= transfer.deadline) {
            let kind = SdoErrorKind::Timeout(self.timeout);
            self.fail(transfer.object, kind, Some(AbortCode::Timeout));
        }
    }

    /// Ends the transfer under way, if any: the node gets an abort, the caller
    /// [`SdoErrorKind::Cancelled`].
    pub fn cancel(&mut self) {
        if let Some(transfer) = self.transfer.take() {
            self.fail(transfer.object, SdoErrorKind::Cancelled, Some(AbortCode::General));
        }
    }

    /// The next frame to send.
    pub fn poll_transmit(&mut self) -> Option<Frame> {
        let frame = self.outgoing.pop_front()?;
        Some(Frame::new(cob::sdo_rx(self.node), &frame.encode()))
    }

    /// The result of the transfer, once.
    pub fn poll_result(&mut self) -> Option<Result<SdoReply, SdoError>> {
        self.result.take()
    }

    /// When [`handle_timeout`](Self::handle_timeout) is due.
    pub fn deadline(&self) -> Time {
        self.transfer.as_ref().map_or(Time::NEVER, |transfer| transfer.deadline)
    }

    fn error(&self, object: ObjectAddress, kind: SdoErrorKind) -> SdoError {
        SdoError { node: self.node, object, kind }
    }

    /// Ends a transfer. When the client aborts it, the node's answer may still come.
    fn fail(&mut self, object: ObjectAddress, kind: SdoErrorKind, abort: Option<AbortCode>) {
        self.owed |= abort.is_some();
        self.outgoing.extend(abort.map(|code| ClientFrame::Abort(object, code)));
        self.result = Some(Err(self.error(object, kind)));
    }
}

/// The fence before a transfer that begins with `request`: its frame, and the answer to await.
fn behind_a_fence(request: ClientFrame, awaited: Awaited) -> (ClientFrame, Awaited) {
    let [usual, other] = FENCES;
    let fence = if request.object() == Some(usual) { other } else { usual };
    (ClientFrame::InitiateUpload(fence), Awaited::Fence(fence, request, Box::new(awaited)))
}
