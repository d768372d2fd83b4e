//! The SDO server: answers one client about a node's objects.

use std::cmp::Ordering;
use std::collections::VecDeque;
use std::time::Duration;

use super::codec::{ClientFrame, Initiate, Segment, ServerFrame};
use super::{AbortCode, MAX_TRANSFER_BYTES};
use crate::canopen::{Frame, NodeId, ObjectAddress, cob};
use crate::units::Time;

/// What a server gives access to.
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

/// A segmented transfer under way; expedited ones are over with their first frame.
#[derive(Debug, Clone)]
struct Transfer {
    object: ObjectAddress,
    toggle: bool,
    data: Vec<u8>,
    direction: Direction,
    deadline: Time,
}

#[derive(Debug, Clone, Copy)]
enum Direction {
    Upload { sent: usize },
    Download { announced: Option<u32> },
}

/// Serves the objects of one node on its default SDO.
///
/// A new request ends a transfer that was left unfinished, as CiA 301 asks.
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

    /// Takes any frame; only requests to this node matter.
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
                let nothing = ObjectAddress::new(0, 0);
                Some(ServerFrame::Abort(nothing, AbortCode::UnknownSpecifier))
            }
        };
        self.outgoing.extend(answer);
    }

    /// Gives up a transfer whose next segment is overdue, and tells the client so.
    pub fn handle_timeout(&mut self, now: Time) {
        if let Some(transfer) = self.transfer.take_if(|transfer| now >= transfer.deadline) {
            self.outgoing.push_back(ServerFrame::Abort(transfer.object, AbortCode::Timeout));
        }
    }

    /// Forgets everything, as a reset of communication does.
    pub fn reset(&mut self) {
        self.transfer = None;
        self.outgoing.clear();
    }

    /// The next frame to send.
    pub fn poll_transmit(&mut self) -> Option<Frame> {
        let frame = self.outgoing.pop_front()?;
        Some(Frame::new(cob::sdo_tx(self.node), &frame.encode()))
    }

    /// When [`handle_timeout`](Self::handle_timeout) wants to be called.
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
        match objects.read(object) {
            Err(code) => ServerFrame::Abort(object, code),
            Ok(data) => {
                let initiate = Initiate::for_data(&data);
                if matches!(initiate, Initiate::Segmented(_)) {
                    self.begin(now, object, data, Direction::Upload { sent: 0 });
                }
                ServerFrame::InitiateUpload(object, initiate)
            }
        }
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

fn check_size(received: usize, announced: Option<u32>, last: bool) -> Result<(), AbortCode> {
    if received > MAX_TRANSFER_BYTES {
        return Err(AbortCode::OutOfMemory);
    }
    match announced.map(|size| received.cmp(&(size as usize))) {
        Some(Ordering::Greater) => Err(AbortCode::LengthTooHigh),
        Some(Ordering::Less) if last => Err(AbortCode::LengthTooLow),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::super::{SdoClient, SdoReply, SdoRequest};
    use super::*;
    use proptest::prelude::*;

    const NODE: NodeId = NodeId::new(5).unwrap();
    const OBJECT: ObjectAddress = ObjectAddress::new(0x2000, 3);
    const TIMEOUT: Duration = Duration::from_millis(100);

    /// One object that can be read and written.
    struct Store(Vec<u8>);

    impl ObjectAccess for Store {
        fn read(&mut self, object: ObjectAddress) -> Result<Vec<u8>, AbortCode> {
            if object == OBJECT { Ok(self.0.clone()) } else { Err(AbortCode::NoSuchObject) }
        }

        fn write(&mut self, object: ObjectAddress, data: &[u8]) -> Result<(), AbortCode> {
            if object != OBJECT {
                return Err(AbortCode::NoSuchObject);
            }
            self.0 = data.to_vec();
            Ok(())
        }
    }

    fn exchange(server: &mut SdoServer, store: &mut Store, request: [u8; 8]) -> String {
        server.handle_frame(Time::ZERO, &Frame::new(0x605, &request), store);
        std::iter::from_fn(|| server.poll_transmit()).map(|frame| frame.to_string()).collect()
    }

    #[test]
    fn frozen_exchanges() {
        let (mut server, mut store) = (SdoServer::new(NODE, TIMEOUT), Store(vec![0xfb, 0, 0, 0]));
        let mut ask = |request| exchange(&mut server, &mut store, request);
        assert_eq!(ask([0x40, 0x00, 0x20, 3, 0, 0, 0, 0]), "585#43002003FB000000");
        assert_eq!(ask([0x2b, 0x00, 0x20, 3, 0xe8, 3, 0, 0]), "585#6000200300000000");
        assert_eq!(ask([0x40, 0x00, 0x20, 3, 0, 0, 0, 0]), "585#4B002003E8030000");
        assert_eq!(ask([0x40, 0x01, 0x20, 0, 0, 0, 0, 0]), "585#8001200000000206");
        assert_eq!(ask([0x21, 0x00, 0x20, 3, 8, 0, 0, 0]), "585#6000200300000000");
        assert_eq!(ask(*b"\x00abcdefg"), "585#2000000000000000");
        assert_eq!(ask(*b"\x1dh\0\0\0\0\0\0"), "585#3000000000000000");
        assert_eq!(ask([0x40, 0x00, 0x20, 3, 0, 0, 0, 0]), "585#4100200308000000");
        assert_eq!(ask([0x60, 0, 0, 0, 0, 0, 0, 0]), "585#0061626364656667");
        assert_eq!(ask([0x70, 0, 0, 0, 0, 0, 0, 0]), "585#1D68000000000000");
        assert_eq!(ask([0x60, 0, 0, 0, 0, 0, 0, 0]), "585#8000000001000405", "nothing is left");
        assert_eq!(ask([0xa0, 0x00, 0x20, 3, 0, 0, 0, 0]), "585#8000200301000405", "no blocks");
        assert_eq!(ask([0x80, 0x00, 0x20, 3, 0, 0, 4, 5]), "", "an abort is not answered");
    }

    #[test]
    fn a_repeated_segment_and_wrong_sizes_abort() {
        let (mut server, mut store) = (SdoServer::new(NODE, TIMEOUT), Store(Vec::new()));
        let mut ask = |request| exchange(&mut server, &mut store, request);
        ask([0x21, 0x00, 0x20, 3, 20, 0, 0, 0]);
        ask(*b"\x00abcdefg");
        assert_eq!(ask(*b"\x00abcdefg"), "585#8000200300000305");
        ask([0x21, 0x00, 0x20, 3, 20, 0, 0, 0]);
        assert_eq!(ask(*b"\x01abcdefg"), "585#8000200313000706");
        ask([0x21, 0x00, 0x20, 3, 5, 0, 0, 0]);
        assert_eq!(ask(*b"\x01abcdefg"), "585#8000200312000706");
        assert_eq!(ask([0x21, 0x00, 0x20, 3, 0, 0, 0, 1]), "585#8000200305000405");
    }

    #[test]
    fn a_client_that_goes_silent_is_given_up() {
        let (mut server, mut store) = (SdoServer::new(NODE, TIMEOUT), Store(vec![0; 20]));
        exchange(&mut server, &mut store, [0x40, 0x00, 0x20, 3, 0, 0, 0, 0]);
        assert_eq!(server.deadline(), Time::ZERO + TIMEOUT);
        server.handle_timeout(Time::ZERO + TIMEOUT);
        assert_eq!(server.poll_transmit().unwrap().to_string(), "585#8000200300000405");
        assert_eq!(server.deadline(), Time::NEVER);
    }

    /// What the link does with each frame, in turn.
    #[derive(Debug, Clone, Copy)]
    enum Fate {
        Pass,
        Drop,
        Double,
    }

    fn fates() -> impl Strategy<Value = Vec<Fate>> {
        let fate =
            prop_oneof![20 => Just(Fate::Pass), 1 => Just(Fate::Drop), 1 => Just(Fate::Double)];
        proptest::collection::vec(fate, 1..64)
    }

    /// Runs one transfer in virtual time over a link that follows `fates`, over and over.
    fn transfer(request: SdoRequest, store: &mut Store, fates: &[Fate]) -> Option<SdoReply> {
        let mut fates = fates.iter().cycle();
        let mut link = |frame: Frame| match fates.next() {
            Some(Fate::Drop) => vec![],
            Some(Fate::Double) => vec![frame; 2],
            _ => vec![frame],
        };
        let mut now = Time::ZERO;
        let (mut client, mut server) =
            (SdoClient::new(NODE, TIMEOUT), SdoServer::new(NODE, TIMEOUT * 2));
        client.start(now, request).unwrap();
        loop {
            if let Some(frame) = client.poll_transmit() {
                link(frame).iter().for_each(|frame| server.handle_frame(now, frame, store));
            } else if let Some(frame) = server.poll_transmit() {
                link(frame).iter().for_each(|frame| client.handle_frame(now, frame));
            } else if let Some(result) = client.poll_result() {
                return result.ok();
            } else {
                now = client.deadline().min(server.deadline());
                assert_ne!(now, Time::NEVER, "the client waits for something that cannot come");
                client.handle_timeout(now);
                server.handle_timeout(now);
            }
        }
    }

    proptest! {
        #[test]
        fn a_good_link_carries_any_payload(data in proptest::collection::vec(any::<u8>(), 0..200)) {
            let mut store = Store(Vec::new());
            let written = transfer(SdoRequest::Download(OBJECT, data.clone()), &mut store, &[Fate::Pass]);
            prop_assert_eq!(written, Some(SdoReply::Downloaded));
            prop_assert_eq!(&store.0, &data);
            let read = transfer(SdoRequest::Upload(OBJECT), &mut store, &[Fate::Pass]);
            prop_assert_eq!(read, Some(SdoReply::Uploaded(data)));
        }

        #[test]
        fn a_bad_link_gives_the_right_result_or_an_error(
            data in proptest::collection::vec(any::<u8>(), 0..200),
            fates in fates(),
        ) {
            let mut store = Store(Vec::new());
            let written = transfer(SdoRequest::Download(OBJECT, data.clone()), &mut store, &fates);
            if written.is_some() {
                prop_assert_eq!(&store.0, &data);
            }
            let mut store = Store(data.clone());
            if let Some(reply) = transfer(SdoRequest::Upload(OBJECT), &mut store, &fates) {
                prop_assert_eq!(reply, SdoReply::Uploaded(data));
            }
        }

        #[test]
        fn garbage_never_panics(
            requests in proptest::collection::vec(any::<[u8; 8]>(), 0..50),
        ) {
            let (mut server, mut store) = (SdoServer::new(NODE, TIMEOUT), Store(vec![1; 30]));
            let mut client = SdoClient::new(NODE, TIMEOUT);
            client.start(Time::ZERO, SdoRequest::Upload(OBJECT)).unwrap();
            for bytes in requests {
                exchange(&mut server, &mut store, bytes);
                client.handle_frame(Time::ZERO, &Frame::new(0x585, &bytes));
            }
        }
    }
}
