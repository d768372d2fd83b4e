//! The SDO client: one transfer at a time with one node.

#[cfg(test)]
mod tests;

use std::collections::VecDeque;
use std::time::Duration;

use super::codec::{ClientFrame, NO_OBJECT, ServerFrame};
use super::{AbortCode, SdoError, SdoReply, SdoRequest};
use crate::canopen::object::communication::{DEVICE_TYPE, ERROR_REGISTER};
use crate::canopen::{Frame, NodeId, ObjectAddress, cob};
use crate::units::Time;

/// Fence objects. If an old answer may still come, the client first reads the first of these that the next request
/// does not name. Every node has both.
const FENCES: [ObjectAddress; 2] = [ERROR_REGISTER, DEVICE_TYPE];
/// Extra answers are recognized for this many of the last requests: a second drive with the same node number may
/// answer later than the first.
const ANSWERED_MAX: usize = 8;

#[derive(Debug, Clone, Copy)]
struct Transfer {
    request: SdoRequest,
    /// The request is sent once the node has answered about this object.
    fence: Option<ObjectAddress>,
    deadline: Time,
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
/// another object as a fence, usually the error register (0x1001), and ignores everything before the answer
/// to that. A node answers in order, so no old answer comes after it.
#[derive(Debug, Clone)]
pub struct SdoClient {
    node: NodeId,
    timeout: Duration,
    transfer: Option<Transfer>,
    /// An answer to an earlier request may still come.
    expects_old_answer: bool,
    /// The last requests that were answered since one was aborted.
    answered: VecDeque<SdoRequest>,
    answers: u32,
    extra_answers: u32,
    /// Another client has sent the node a request.
    has_other_client: bool,
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
            expects_old_answer: false,
            answered: VecDeque::new(),
            answers: 0,
            extra_answers: 0,
            has_other_client: false,
            outgoing: VecDeque::new(),
            result: None,
        }
    }

    /// The node whose objects are read and written.
    pub fn node(&self) -> NodeId {
        self.node
    }

    /// Starts a transfer. One that is under way is [cancelled](Self::cancel), and a result that was not
    /// polled is dropped.
    pub fn start(&mut self, now: Time, request: SdoRequest) {
        self.cancel();
        let fence = FENCES.into_iter().find(|fence| *fence != request.object());
        let fence = fence.filter(|_| self.expects_old_answer);
        let first = fence.map_or(request, SdoRequest::Upload);
        self.outgoing.push_back(ClientFrame::Request(first));
        self.transfer = Some(Transfer { request, fence, deadline: now + self.timeout });
    }

    /// Takes any frame that another node sent; all but this node's SDO answers, and requests to it, are ignored.
    pub fn handle_frame(&mut self, now: Time, frame: &Frame) {
        self.has_other_client |= frame.cob_id() == Some(cob::sdo_rx(self.node));
        if frame.cob_id() != Some(cob::sdo_tx(self.node)) {
            return;
        }
        let Some(answer) = ServerFrame::decode(frame.data()) else { return };
        self.extra_answers += u32::from(self.is_extra(answer));
        let Some(transfer) = &mut self.transfer else { return };
        let object = transfer.request.object();
        if transfer.fence.is_some() {
            if answer.object() == transfer.fence {
                self.expects_old_answer = false;
                transfer.fence = None;
                transfer.deadline = now + self.timeout;
                self.outgoing.push_back(ClientFrame::Request(transfer.request));
            }
            return;
        }
        match answer {
            // Some servers name no object. One transfer runs at a time, so the abort is for it.
            ServerFrame::Abort(about, code) if about == object || about == NO_OBJECT => {
                self.end(Err(SdoError::Aborted(code)));
            }
            ServerFrame::Unsupported(command) => {
                self.abort(AbortCode::UNKNOWN_SPECIFIER);
                self.end(Err(SdoError::UnexpectedCommand(command)));
            }
            ServerFrame::InitiateUpload(about, _) if about == object => {
                self.abort(AbortCode::OUT_OF_MEMORY);
                self.end(Err(SdoError::TooLong));
            }
            ServerFrame::Reply(about, reply) if about == object => {
                let is_read = matches!(transfer.request, SdoRequest::Upload(_));
                if is_read == matches!(reply, SdoReply::Uploaded(_)) {
                    self.end(Ok(reply));
                }
            }
            _ => {}
        }
    }

    /// Aborts a transfer whose answer is overdue (0504 0000).
    pub fn handle_timeout(&mut self, now: Time) {
        if now >= self.deadline() {
            self.abort(AbortCode::TIMEOUT);
            self.end(Err(SdoError::Timeout(self.timeout)));
        }
    }

    /// Ends the transfer under way, if any, without a result. The node gets an abort.
    pub fn cancel(&mut self) {
        self.abort(AbortCode::GENERAL);
        self.result = None;
    }

    /// The number of requests that were answered.
    pub fn answers(&self) -> u32 {
        self.answers
    }

    /// The number of answers beyond the first to one of the last eight requests. 0 if another client asks the node
    /// too, since the answers to that client look the same.
    pub fn extra_answers(&self) -> u32 {
        if self.has_other_client { 0 } else { self.extra_answers }
    }

    /// Whether `answer` repeats the answer to one of the last requests. False while an answer from before a timeout may
    /// still come.
    fn is_extra(&self, answer: ServerFrame) -> bool {
        let is_due = self.transfer.is_some_and(|transfer| can_answer(answer, transfer.request));
        let was_given = self.answered.iter().any(|request| can_answer(answer, *request));
        !self.expects_old_answer && was_given && !is_due
    }

    /// The next frame to send.
    pub fn poll_transmit(&mut self) -> Option<Frame> {
        Some(self.outgoing.pop_front()?.to_frame(self.node))
    }

    /// The result of the transfer, once.
    pub fn poll_result(&mut self) -> Option<Result<SdoReply, SdoError>> {
        self.result.take()
    }

    /// When [`handle_timeout`](Self::handle_timeout) is due.
    pub fn deadline(&self) -> Time {
        self.transfer.as_ref().map_or(Time::NEVER, |transfer| transfer.deadline)
    }

    fn end(&mut self, result: Result<SdoReply, SdoError>) {
        // A transfer that was aborted is gone already.
        if let Some(transfer) = self.transfer.take() {
            self.answers += 1;
            self.answered.push_back(transfer.request);
            if self.answered.len() > ANSWERED_MAX {
                self.answered.pop_front();
            }
        }
        self.result = Some(result);
    }

    /// Ends the transfer and tells the node, whose answer may still come.
    fn abort(&mut self, code: AbortCode) {
        if let Some(transfer) = self.transfer.take() {
            self.expects_old_answer = true;
            self.answered.clear();
            self.outgoing.push_back(ClientFrame::Abort(transfer.request.object(), code));
        }
    }
}

/// Whether `answer` can be one to `request`.
fn can_answer(answer: ServerFrame, request: SdoRequest) -> bool {
    let is_kind = match answer {
        ServerFrame::Reply(_, SdoReply::Downloaded) => matches!(request, SdoRequest::Download(..)),
        ServerFrame::Reply(..) => matches!(request, SdoRequest::Upload(_)),
        _ => true,
    };
    is_kind && answer.object() == Some(request.object())
}
