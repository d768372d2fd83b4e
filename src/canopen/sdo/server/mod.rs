//! The SDO server: answers one client about a node's objects.

#[cfg(test)]
mod tests;

use std::collections::VecDeque;
use std::time::Duration;

use super::codec::{ClientFrame, Initiate, Segment, ServerFrame};
use super::{AbortCode, MAX_TRANSFER_BYTES, check_size};
use crate::canopen::{Frame, NodeId, ObjectAddress, cob};
use crate::units::Time;

/// The object in the abort of a request that belongs to no transfer.
const NOTHING: ObjectAddress = ObjectAddress::new(0, 0);

/// The objects that a server gives access to.
pub trait ObjectAccess {
    /// The bytes of `object`.
    ///
    /// # Errors
    /// The abort code to refuse with.
    fn read(&mut self, object: ObjectAddress) -> Result<Vec<u8>, AbortCode>;

    /// Writes `data` to `object`.
    ///
    /// # Errors
    /// The abort code to refuse with.
    fn write(&mut self, object: ObjectAddress, data: &[u8]) -> Result<(), AbortCode>;
}

/// A segmented transfer under way.
#[derive(Debug, Clone)]
struct Transfer {
    object: ObjectAddress,
    toggle: bool,
    data: Vec<u8>,
    direction: Direction,
    deadline: Time,
}

#[derive(Debug, Clone)]
enum Direction {
    Upload { sent: usize },
    Download { announced: Option<u32> },
}

/// Serves the objects of one node on its default SDO.
///
/// A new request ends a transfer that was not finished, as CiA 301 requires.
#[derive(Debug, Clone)]
pub struct SdoServer {
    node: NodeId,
    timeout: Duration,
    transfer: Option<Transfer>,
    outgoing: VecDeque<ServerFrame>,
}

impl SdoServer {
    /// A server of `node` that waits at most `timeout` for the next segment.
    pub fn new(node: NodeId, timeout: Duration) -> Self {
        SdoServer { node, timeout, transfer: None, outgoing: VecDeque::new() }
    }

    /// Takes any frame; all but requests to this node are ignored.
    pub fn handle_frame(&mut self, now: Time, frame: &Frame, objects: &mut impl ObjectAccess) {
        if frame.cob_id() != Some(cob::sdo_rx(self.node)) {
            return;
        }
        let Some(request) = ClientFrame::decode(frame.data()) else { return };
        let transfer = self.transfer.take();
        let answer = match (request, transfer) {
            (ClientFrame::Abort(..), _) => None,
            (ClientFrame::InitiateUpload(object), _) => {
                Some(self.begin_upload(now, object, objects))
            }
            (ClientFrame::InitiateDownload(object, initiate), _) => {
                Some(self.begin_download(now, object, initiate, objects))
            }
            (ClientFrame::UploadSegment { toggle }, Some(transfer)) => {
                Some(self.send_segment(now, transfer, toggle))
            }
            (ClientFrame::DownloadSegment(segment), Some(transfer)) => {
                Some(self.take_segment(now, transfer, segment, objects))
            }
            (ClientFrame::Unsupported(_, object), _) => {
                Some(ServerFrame::Abort(object, AbortCode::UnknownSpecifier))
            }
            (ClientFrame::UploadSegment { .. } | ClientFrame::DownloadSegment(_), None) => {
                Some(ServerFrame::Abort(NOTHING, AbortCode::UnknownSpecifier))
            }
        };
        self.outgoing.extend(answer);
    }

    /// Aborts a transfer whose next segment is overdue.
    pub fn handle_timeout(&mut self, now: Time) {
        if let Some(transfer) = self.transfer.take_if(|transfer| now >= transfer.deadline) {
            self.outgoing.push_back(ServerFrame::Abort(transfer.object, AbortCode::Timeout));
        }
    }

    /// Drops the transfer and all answers, as a reset of communication does.
    pub fn reset(&mut self) {
        self.transfer = None;
        self.outgoing.clear();
    }

    /// The next frame to send.
    pub fn poll_transmit(&mut self) -> Option<Frame> {
        let frame = self.outgoing.pop_front()?;
        Some(Frame::new(cob::sdo_tx(self.node), &frame.encode()))
    }

    /// When [`handle_timeout`](Self::handle_timeout) is due.
    pub fn deadline(&self) -> Time {
        self.transfer.as_ref().map_or(Time::NEVER, |transfer| transfer.deadline)
    }

    fn begin(&mut self, now: Time, object: ObjectAddress, data: Vec<u8>, direction: Direction) {
        let deadline = now + self.timeout;
        self.transfer = Some(Transfer { object, toggle: false, data, direction, deadline });
    }

    fn begin_upload(
        &mut self,
        now: Time,
        object: ObjectAddress,
        objects: &mut impl ObjectAccess,
    ) -> ServerFrame {
        let data = match objects.read(object) {
            Err(code) => return ServerFrame::Abort(object, code),
            Ok(data) => data,
        };
        let initiate = Initiate::for_data(&data);
        if matches!(initiate, Initiate::Segmented(_)) {
            self.begin(now, object, data, Direction::Upload { sent: 0 });
        }
        ServerFrame::InitiateUpload(object, initiate)
    }

    fn begin_download(
        &mut self,
        now: Time,
        object: ObjectAddress,
        initiate: Initiate,
        objects: &mut impl ObjectAccess,
    ) -> ServerFrame {
        match initiate {
            Initiate::Expedited(chunk) => match objects.write(object, chunk.as_slice()) {
                Ok(()) => ServerFrame::InitiateDownload(object),
                Err(code) => ServerFrame::Abort(object, code),
            },
            Initiate::Segmented(Some(size)) if size as usize > MAX_TRANSFER_BYTES => {
                ServerFrame::Abort(object, AbortCode::OutOfMemory)
            }
            Initiate::Segmented(announced) => {
                self.begin(now, object, Vec::new(), Direction::Download { announced });
                ServerFrame::InitiateDownload(object)
            }
        }
    }

    fn send_segment(&mut self, now: Time, mut transfer: Transfer, toggle: bool) -> ServerFrame {
        let object = transfer.object;
        let Direction::Upload { sent } = transfer.direction else {
            return ServerFrame::Abort(object, AbortCode::UnknownSpecifier);
        };
        if toggle != transfer.toggle {
            return ServerFrame::Abort(object, AbortCode::ToggleNotAlternated);
        }
        let segment = Segment::at(&transfer.data, sent, toggle);
        if !segment.last {
            let sent = sent + segment.chunk.as_slice().len();
            transfer.direction = Direction::Upload { sent };
            transfer.toggle = !toggle;
            transfer.deadline = now + self.timeout;
            self.transfer = Some(transfer);
        }
        ServerFrame::UploadSegment(segment)
    }

    fn take_segment(
        &mut self,
        now: Time,
        mut transfer: Transfer,
        segment: Segment,
        objects: &mut impl ObjectAccess,
    ) -> ServerFrame {
        let object = transfer.object;
        let Direction::Download { announced } = transfer.direction else {
            return ServerFrame::Abort(object, AbortCode::UnknownSpecifier);
        };
        if segment.toggle != transfer.toggle {
            return ServerFrame::Abort(object, AbortCode::ToggleNotAlternated);
        }
        transfer.data.extend_from_slice(segment.chunk.as_slice());
        if let Err(code) = check_size(transfer.data.len(), announced, segment.last) {
            return ServerFrame::Abort(object, code);
        }
        if segment.last {
            if let Err(code) = objects.write(object, &transfer.data) {
                return ServerFrame::Abort(object, code);
            }
        } else {
            transfer.toggle = !segment.toggle;
            transfer.deadline = now + self.timeout;
            self.transfer = Some(transfer);
        }
        ServerFrame::DownloadSegment { toggle: segment.toggle }
    }
}
