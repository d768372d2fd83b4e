//! The SDO client: one transfer at a time with one node.

use std::cmp::Ordering;
use std::collections::VecDeque;
use std::time::Duration;

use super::codec::{ClientFrame, Initiate, Segment, ServerFrame};
use super::{AbortCode, MAX_TRANSFER_BYTES, SdoError, SdoErrorKind, SdoReply, SdoRequest};
use crate::canopen::{Frame, NodeId, ObjectAddress, cob};
use crate::units::Time;

/// The answer a transfer waits for.
#[derive(Debug, Clone, Copy)]
enum Awaited {
    Upload,
    UploadSegment { toggle: bool, announced: Option<u32> },
    Download,
    DownloadSegment { toggle: bool, sent: usize },
}

#[derive(Debug, Clone)]
struct Transfer {
    object: ObjectAddress,
    awaited: Awaited,
    /// What was received so far, or all that is to be sent.
    data: Vec<u8>,
    deadline: Time,
}

/// What one answer led to.
enum Step {
    /// Not an answer to this transfer: wait on.
    Ignore,
    Send(ClientFrame),
    Done(SdoReply),
    /// Failed; tell the node with this code unless it was the node that said so.
    Fail(SdoErrorKind, Option<AbortCode>),
}

/// Reads and writes objects of one node, one transfer at a time.
///
/// Start a transfer, then: hand in every frame, drain [`poll_transmit`](Self::poll_transmit),
/// call [`handle_timeout`](Self::handle_timeout) at [`deadline`](Self::deadline), until
/// [`poll_result`](Self::poll_result) gives the result. Retries are the caller's.
///
/// Answers about another object, left over from a transfer that timed out, are never taken for
/// ours. What no client can tell apart is a late answer about the very same object and
/// direction; read back what matters.
#[derive(Debug, Clone)]
pub struct SdoClient {
    node: NodeId,
    timeout: Duration,
    transfer: Option<Transfer>,
    outgoing: VecDeque<ClientFrame>,
    result: Option<Result<SdoReply, SdoError>>,
}

impl SdoClient {
    /// A client of `node` that waits at most `timeout` for each answer (150 ms is common; 20 ms
    /// is too short for real drives).
    pub fn new(node: NodeId, timeout: Duration) -> Self {
        SdoClient { node, timeout, transfer: None, outgoing: VecDeque::new(), result: None }
    }

    /// The server.
    pub fn node(&self) -> NodeId {
        self.node
    }

    /// Starts a transfer. A result not yet polled is dropped.
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
            SdoRequest::Upload(_) => {
                (ClientFrame::InitiateUpload(object), Awaited::Upload, Vec::new())
            }
            SdoRequest::Download(_, data) if data.len() > MAX_TRANSFER_BYTES => {
                return Err(self.error(object, SdoErrorKind::TooLong(data.len())));
            }
            SdoRequest::Download(_, data) => {
                let frame = ClientFrame::InitiateDownload(object, Initiate::for_data(&data));
                (frame, Awaited::Download, data)
            }
        };
        self.result = None;
        self.outgoing.push_back(frame);
        self.transfer = Some(Transfer { object, awaited, data, deadline: now + self.timeout });
        Ok(())
    }

    /// Takes any frame; only this node's SDO answers matter.
    pub fn handle_frame(&mut self, now: Time, frame: &Frame) {
        if frame.cob_id() != Some(cob::sdo_tx(self.node)) {
            return;
        }
        let Some(answer) = ServerFrame::decode(frame.data()) else { return };
        let Some(mut transfer) = self.transfer.take() else { return };
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

    /// Gives up a transfer whose answer is overdue, and tells the node so (0504 0000).
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

    /// When [`handle_timeout`](Self::handle_timeout) wants to be called.
    pub fn deadline(&self) -> Time {
        self.transfer.as_ref().map_or(Time::NEVER, |transfer| transfer.deadline)
    }

    /// True while a transfer is under way.
    pub fn is_busy(&self) -> bool {
        self.transfer.is_some()
    }

    fn error(&self, object: ObjectAddress, kind: SdoErrorKind) -> SdoError {
        SdoError { node: self.node, object, kind }
    }

    fn fail(&mut self, object: ObjectAddress, kind: SdoErrorKind, abort: Option<AbortCode>) {
        self.outgoing.extend(abort.map(|code| ClientFrame::Abort(object, code)));
        self.result = Some(Err(self.error(object, kind)));
    }
}

impl Transfer {
    /// What `answer` means to this transfer.
    fn step(&mut self, answer: ServerFrame) -> Step {
        use ServerFrame as S;
        let object = self.object;
        match (self.awaited, answer) {
            (_, S::Abort(about, code)) if about == object => {
                Step::Fail(SdoErrorKind::Aborted(code), None)
            }
            (_, S::Unsupported(command)) => Step::Fail(
                SdoErrorKind::UnexpectedCommand(command),
                Some(AbortCode::UnknownSpecifier),
            ),
            (Awaited::Upload, S::InitiateUpload(about, initiate)) if about == object => {
                match initiate {
                    Initiate::Expedited(chunk) => {
                        Step::Done(SdoReply::Uploaded(chunk.as_slice().to_vec()))
                    }
                    Initiate::Segmented(announced) => self.begin_upload(announced),
                }
            }
            (Awaited::UploadSegment { toggle, announced }, S::UploadSegment(segment)) => {
                self.take_segment(toggle, announced, segment)
            }
            (Awaited::Download, S::InitiateDownload(about)) if about == object => {
                match Initiate::for_data(&self.data) {
                    Initiate::Expedited(_) => Step::Done(SdoReply::Downloaded),
                    Initiate::Segmented(_) => self.send_segment(0, false),
                }
            }
            (
                Awaited::DownloadSegment { toggle, sent },
                S::DownloadSegment { toggle: answered },
            ) => {
                if answered != toggle {
                    Step::Fail(SdoErrorKind::Toggle(sent), Some(AbortCode::ToggleNotAlternated))
                } else if sent == self.data.len() {
                    Step::Done(SdoReply::Downloaded)
                } else {
                    self.send_segment(sent, !toggle)
                }
            }
            // Left over from a transfer given up before: a segment, or another object's answer.
            _ => Step::Ignore,
        }
    }

    fn begin_upload(&mut self, announced: Option<u32>) -> Step {
        let size = announced.map_or(0, |size| usize::try_from(size).unwrap_or(usize::MAX));
        if size > MAX_TRANSFER_BYTES {
            return Step::Fail(SdoErrorKind::TooLong(size), Some(AbortCode::OutOfMemory));
        }
        self.awaited = Awaited::UploadSegment { toggle: false, announced };
        Step::Send(ClientFrame::UploadSegment { toggle: false })
    }

    fn take_segment(&mut self, toggle: bool, announced: Option<u32>, segment: Segment) -> Step {
        if segment.toggle != toggle {
            let kind = SdoErrorKind::Toggle(self.data.len());
            return Step::Fail(kind, Some(AbortCode::ToggleNotAlternated));
        }
        self.data.extend_from_slice(segment.chunk.as_slice());
        let received = self.data.len();
        if received > MAX_TRANSFER_BYTES {
            return Step::Fail(SdoErrorKind::TooLong(received), Some(AbortCode::OutOfMemory));
        }
        if let Some(announced) = announced {
            let size = usize::try_from(announced).unwrap_or(usize::MAX);
            let code = match received.cmp(&size) {
                Ordering::Greater => Some(AbortCode::LengthTooHigh),
                Ordering::Less if segment.last => Some(AbortCode::LengthTooLow),
                _ => None,
            };
            if code.is_some() {
                return Step::Fail(SdoErrorKind::Size { announced, received }, code);
            }
        }
        if segment.last {
            return Step::Done(SdoReply::Uploaded(std::mem::take(&mut self.data)));
        }
        self.awaited = Awaited::UploadSegment { toggle: !toggle, announced };
        Step::Send(ClientFrame::UploadSegment { toggle: !toggle })
    }

    fn send_segment(&mut self, offset: usize, toggle: bool) -> Step {
        let segment = Segment::at(&self.data, offset, toggle);
        let sent = offset + segment.chunk.as_slice().len();
        self.awaited = Awaited::DownloadSegment { toggle, sent };
        Step::Send(ClientFrame::DownloadSegment(segment))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NODE: NodeId = NodeId::new(5).unwrap();
    const VENDOR: ObjectAddress = ObjectAddress::new(0x1018, 1);
    const STATUS: ObjectAddress = ObjectAddress::new(0x6041, 0);
    const TIMEOUT: Duration = Duration::from_millis(150);

    fn at(ms: i64) -> Time {
        Time::from_nanos(ms * 1_000_000)
    }

    fn started(request: SdoRequest) -> SdoClient {
        let mut client = SdoClient::new(NODE, TIMEOUT);
        client.start(at(0), request).unwrap();
        client
    }

    fn answer(client: &mut SdoClient, bytes: [u8; 8]) {
        client.handle_frame(at(1), &Frame::new(0x585, &bytes));
    }

    fn sent(client: &mut SdoClient) -> String {
        std::iter::from_fn(|| client.poll_transmit())
            .map(|frame| frame.to_string())
            .collect::<Vec<_>>()
            .join(" ")
    }

    #[test]
    fn expedited_upload() {
        let mut client = started(SdoRequest::Upload(VENDOR));
        assert_eq!(sent(&mut client), "605#4018100100000000");
        answer(&mut client, [0x43, 0x18, 0x10, 0x01, 0xfb, 0, 0, 0]);
        assert_eq!(client.poll_result(), Some(Ok(SdoReply::Uploaded(vec![0xfb, 0, 0, 0]))));
        assert!(!client.is_busy());
        assert_eq!(client.poll_result(), None);
    }

    #[test]
    fn expedited_download() {
        let object = ObjectAddress::new(0x1017, 0);
        let mut client = started(SdoRequest::Download(object, 1000u16.to_le_bytes().to_vec()));
        assert_eq!(sent(&mut client), "605#2B171000E8030000");
        answer(&mut client, [0x60, 0x17, 0x10, 0, 0, 0, 0, 0]);
        assert_eq!(client.poll_result(), Some(Ok(SdoReply::Downloaded)));
    }

    #[test]
    fn segmented_upload() {
        let mut client = started(SdoRequest::Upload(ObjectAddress::new(0x1008, 0)));
        sent(&mut client);
        answer(&mut client, [0x41, 0x08, 0x10, 0x00, 10, 0, 0, 0]);
        assert_eq!(sent(&mut client), "605#6000000000000000");
        answer(&mut client, *b"\x000123456");
        assert_eq!(sent(&mut client), "605#7000000000000000");
        answer(&mut client, *b"\x19789\0\0\0\0");
        assert_eq!(client.poll_result(), Some(Ok(SdoReply::Uploaded(b"0123456789".to_vec()))));
    }

    #[test]
    fn segmented_download() {
        let object = ObjectAddress::new(0x2000, 0);
        let mut client = started(SdoRequest::Download(object, b"0123456789".to_vec()));
        assert_eq!(sent(&mut client), "605#210020000A000000");
        answer(&mut client, [0x60, 0x00, 0x20, 0, 0, 0, 0, 0]);
        assert_eq!(sent(&mut client), "605#0030313233343536");
        answer(&mut client, [0x20, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(sent(&mut client), "605#1937383900000000");
        answer(&mut client, [0x30, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(client.poll_result(), Some(Ok(SdoReply::Downloaded)));
    }

    #[test]
    fn a_refusal_is_named() {
        let mut client = started(SdoRequest::Upload(STATUS));
        sent(&mut client);
        answer(&mut client, [0x80, 0x41, 0x60, 0x00, 0x00, 0x00, 0x02, 0x06]);
        let error = client.poll_result().unwrap().unwrap_err();
        assert_eq!(error.kind, SdoErrorKind::Aborted(AbortCode::NoSuchObject));
        assert_eq!(
            error.to_string(),
            "node 5 0x6041:00: refused with SDO abort 0x06020000 object does not exist"
        );
        assert_eq!(sent(&mut client), "", "an abort is not answered");
    }

    #[test]
    fn silence_times_out_and_the_node_is_told() {
        let mut client = started(SdoRequest::Upload(STATUS));
        sent(&mut client);
        assert_eq!(client.deadline(), at(150));
        client.handle_timeout(at(149));
        assert_eq!(client.poll_result(), None);
        client.handle_timeout(at(150));
        let error = client.poll_result().unwrap().unwrap_err();
        assert_eq!(error.to_string(), "node 5 0x6041:00: no SDO reply within 150 ms");
        assert_eq!(sent(&mut client), "605#8041600000000405");
        assert_eq!(client.deadline(), Time::NEVER);
    }

    #[test]
    fn a_late_answer_is_not_taken_for_another_objects() {
        let mut client = started(SdoRequest::Upload(VENDOR));
        client.handle_timeout(at(150));
        client.start(at(151), SdoRequest::Upload(STATUS)).unwrap();
        sent(&mut client);
        answer(&mut client, [0x43, 0x18, 0x10, 0x01, 0xfb, 0, 0, 0]);
        answer(&mut client, [0x80, 0x18, 0x10, 0x01, 0x00, 0x00, 0x02, 0x06]);
        answer(&mut client, *b"\x000123456");
        answer(&mut client, [0x60, 0x41, 0x60, 0x00, 0, 0, 0, 0]);
        assert_eq!(client.poll_result(), None);
        assert_eq!(client.deadline(), at(301), "a stale answer does not prolong the wait");
        answer(&mut client, [0x4b, 0x41, 0x60, 0x00, 0x37, 0x02, 0, 0]);
        assert_eq!(client.poll_result(), Some(Ok(SdoReply::Uploaded(vec![0x37, 0x02]))));
    }

    #[test]
    fn a_repeated_segment_is_an_error() {
        let mut client = started(SdoRequest::Upload(ObjectAddress::new(0x1008, 0)));
        answer(&mut client, [0x41, 0x08, 0x10, 0x00, 20, 0, 0, 0]);
        answer(&mut client, *b"\x000123456");
        sent(&mut client);
        answer(&mut client, *b"\x000123456");
        let error = client.poll_result().unwrap().unwrap_err();
        assert_eq!(error.kind, SdoErrorKind::Toggle(7));
        assert_eq!(sent(&mut client), "605#8008100000000305");
    }

    #[test]
    fn sizes_are_held_to_what_was_announced() {
        for (announced, last) in [(3, false), (20, true)] {
            let mut client = started(SdoRequest::Upload(ObjectAddress::new(0x1008, 0)));
            answer(&mut client, [0x41, 0x08, 0x10, 0x00, announced, 0, 0, 0]);
            let mut segment = *b"\x000123456";
            segment[0] |= u8::from(last);
            answer(&mut client, segment);
            let error = client.poll_result().unwrap().unwrap_err();
            let expected = SdoErrorKind::Size { announced: announced.into(), received: 7 };
            assert_eq!(error.kind, expected);
        }
    }

    #[test]
    fn huge_transfers_are_refused_before_they_start() {
        let mut client = started(SdoRequest::Upload(VENDOR));
        answer(&mut client, [0x41, 0x18, 0x10, 0x01, 0xff, 0xff, 0xff, 0xff]);
        let error = client.poll_result().unwrap().unwrap_err();
        assert_eq!(error.kind, SdoErrorKind::TooLong(0xffff_ffff));
        let data = vec![0; MAX_TRANSFER_BYTES + 1];
        assert!(client.start(at(0), SdoRequest::Download(VENDOR, data)).is_err());
    }

    #[test]
    fn one_transfer_at_a_time() {
        let mut client = started(SdoRequest::Upload(VENDOR));
        let error = client.start(at(1), SdoRequest::Upload(STATUS)).unwrap_err();
        assert_eq!(error.kind, SdoErrorKind::Busy(VENDOR));
        client.cancel();
        assert_eq!(client.poll_result().unwrap().unwrap_err().kind, SdoErrorKind::Cancelled);
        assert_eq!(sent(&mut client), "605#4018100100000000 605#8018100100000008");
        assert!(client.start(at(2), SdoRequest::Upload(STATUS)).is_ok());
    }

    #[test]
    fn a_block_transfer_answer_is_an_error() {
        let mut client = started(SdoRequest::Upload(VENDOR));
        sent(&mut client);
        answer(&mut client, [0xc2, 0x18, 0x10, 0x01, 0, 0, 0, 0]);
        let error = client.poll_result().unwrap().unwrap_err();
        assert_eq!(error.kind, SdoErrorKind::UnexpectedCommand(0xc2));
    }
}
