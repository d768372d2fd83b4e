//! The server by its frames, and together with the client over a link that loses and repeats frames.

use super::super::SdoClient;
use super::*;
use proptest::prelude::*;

const NODE: NodeId = NodeId::new(5).unwrap();
const OBJECT: ObjectAddress = ObjectAddress::new(0x2000, 3);
const TIMEOUT: Duration = Duration::from_millis(100);

/// A dictionary of one object.
struct Store(Vec<u8>);

impl ObjectAccess for Store {
    fn read(&mut self, object: ObjectAddress) -> Result<Vec<u8>, AbortCode> {
        if object == OBJECT { Ok(self.0.clone()) } else { Err(AbortCode::NO_SUCH_OBJECT) }
    }

    fn write(&mut self, object: ObjectAddress, value: SdoValue) -> Result<(), AbortCode> {
        if object != OBJECT {
            return Err(AbortCode::NO_SUCH_OBJECT);
        }
        self.0 = value.as_bytes().to_vec();
        Ok(())
    }
}

fn exchange(server: &mut SdoServer, store: &mut Store, request: [u8; 8]) -> String {
    server.handle_frame(Time::ZERO, &Frame::new(0x605, &request), store);
    std::iter::from_fn(|| server.poll_transmit()).map(|frame| frame.to_string()).collect()
}

#[test]
fn expedited_requests_get_the_answers_of_cia_301() {
    let (mut server, mut store) = (SdoServer::new(NODE, TIMEOUT), Store(vec![0xfb, 0, 0, 0]));
    let mut ask = |request| exchange(&mut server, &mut store, request);
    assert_eq!(ask([0x40, 0x00, 0x20, 3, 0, 0, 0, 0]), "585#43002003FB000000");
    assert_eq!(ask([0x2b, 0x00, 0x20, 3, 0xe8, 3, 0, 0]), "585#6000200300000000");
    assert_eq!(ask([0x40, 0x00, 0x20, 3, 0, 0, 0, 0]), "585#4B002003E8030000");
    assert_eq!(ask([0x40, 0x01, 0x20, 0, 0, 0, 0, 0]), "585#8001200000000206");
    assert_eq!(ask([0xe0, 0x00, 0x20, 3, 0, 0, 0, 0]), "585#8000200301000405", "reserved command");
    assert_eq!(ask([0x80, 0x00, 0x20, 3, 0, 0, 4, 5]), "", "an abort is not answered");
}

#[test]
fn segmented_upload() {
    let mut server = SdoServer::new(NODE, TIMEOUT);
    let mut store = Store(b"abcdefgh".to_vec());
    let mut ask = |request| exchange(&mut server, &mut store, request);
    assert_eq!(ask([0x40, 0x00, 0x20, 3, 0, 0, 0, 0]), "585#4100200308000000");
    assert_eq!(ask([0x60, 0, 0, 0, 0, 0, 0, 0]), "585#0061626364656667");
    assert_eq!(ask([0x70, 0, 0, 0, 0, 0, 0, 0]), "585#1D68000000000000");
    assert_eq!(ask([0x60, 0, 0, 0, 0, 0, 0, 0]), "585#8000000001000405", "the upload has ended");
}

#[test]
fn a_segment_asked_for_twice_aborts() {
    let (mut server, mut store) = (SdoServer::new(NODE, TIMEOUT), Store(vec![0; 20]));
    let mut ask = |request| exchange(&mut server, &mut store, request);
    ask([0x40, 0x00, 0x20, 3, 0, 0, 0, 0]);
    assert_eq!(ask([0x60, 0, 0, 0, 0, 0, 0, 0]), "585#0000000000000000");
    assert_eq!(ask([0x60, 0, 0, 0, 0, 0, 0, 0]), "585#8000200300000305");
}

/// No object that can be written is longer than 4 bytes.
#[test]
fn segmented_download_is_refused() {
    let (mut server, mut store) = (SdoServer::new(NODE, TIMEOUT), Store(Vec::new()));
    let mut ask = |request| exchange(&mut server, &mut store, request);
    assert_eq!(ask([0x21, 0x00, 0x20, 3, 8, 0, 0, 0]), "585#8000200301000405");
    assert_eq!(ask(*b"\x00abcdefg"), "585#8000000001000405");
    assert!(store.0.is_empty());
}

/// CiA 301, table 22: 0504 0001, command specifier not valid or unknown. Any new request ends the transfer under
/// way, also this one.
#[test]
fn block_transfer_is_refused() {
    let (mut server, mut store) = (SdoServer::new(NODE, TIMEOUT), Store(vec![0; 20]));
    let mut ask = |request| exchange(&mut server, &mut store, request);
    assert_eq!(ask([0xa4, 0x00, 0x20, 3, 0x7f, 0, 0, 0]), "585#8000200301000405", "upload");
    assert_eq!(ask([0xc6, 0x00, 0x20, 3, 30, 0, 0, 0]), "585#8000200301000405", "download");
    ask([0x40, 0x00, 0x20, 3, 0, 0, 0, 0]);
    assert_eq!(ask([0xa4, 0x00, 0x20, 3, 0x7f, 0, 0, 0]), "585#8000200301000405");
    assert_eq!(ask([0x60, 0, 0, 0, 0, 0, 0, 0]), "585#8000000001000405", "the upload has ended");
}

#[test]
fn the_server_aborts_when_the_client_falls_silent() {
    let (mut server, mut store) = (SdoServer::new(NODE, TIMEOUT), Store(vec![0; 20]));
    exchange(&mut server, &mut store, [0x40, 0x00, 0x20, 3, 0, 0, 0, 0]);
    assert_eq!(server.deadline(), Time::ZERO + TIMEOUT);
    server.handle_timeout(Time::ZERO + TIMEOUT);
    assert_eq!(server.poll_transmit().unwrap().to_string(), "585#8000200300000405");
    assert_eq!(server.deadline(), Time::NEVER);
}

/// What the link does with one frame.
#[derive(Debug, Clone, Copy)]
enum Delivery {
    Pass,
    Drop,
    Double,
}

fn deliveries() -> impl Strategy<Value = Vec<Delivery>> {
    let delivery = prop_oneof![20 => Just(Delivery::Pass), 1 => Just(Delivery::Drop), 1 => Just(Delivery::Double)];
    proptest::collection::vec(delivery, 1..64)
}

/// Runs one transfer in virtual time over a link that repeats `deliveries`.
fn transfer(request: SdoRequest, store: &mut Store, deliveries: &[Delivery]) -> Option<SdoReply> {
    let mut deliveries = deliveries.iter().cycle();
    let mut link = |frame: Frame| match deliveries.next() {
        Some(Delivery::Drop) => vec![],
        Some(Delivery::Double) => vec![frame; 2],
        _ => vec![frame],
    };
    let mut now = Time::ZERO;
    let (mut client, mut server) =
        (SdoClient::new(NODE, TIMEOUT), SdoServer::new(NODE, TIMEOUT * 2));
    client.start(now, request);
    loop {
        if let Some(frame) = client.poll_transmit() {
            link(frame).iter().for_each(|frame| server.handle_frame(now, frame, store));
        } else if let Some(frame) = server.poll_transmit() {
            link(frame).iter().for_each(|frame| client.handle_frame(now, frame));
        } else if let Some(result) = client.poll_result() {
            return result.ok();
        } else {
            now = client.deadline().min(server.deadline());
            assert_ne!(now, Time::NEVER, "no frame and no timeout is left to wait for");
            client.handle_timeout(now);
            server.handle_timeout(now);
        }
    }
}

fn requests(data: u32) -> [SdoRequest; 2] {
    [SdoRequest::Download(OBJECT, data.into()), SdoRequest::Upload(OBJECT)]
}

proptest! {
    #[test]
    fn a_bad_link_gives_the_right_result_or_an_error(data: u32, deliveries in deliveries()) {
        let [write, read] = requests(data);
        let bytes = data.to_le_bytes().to_vec();
        let mut store = Store(Vec::new());
        if transfer(write, &mut store, &deliveries).is_some() {
            prop_assert_eq!(&store.0, &bytes);
        }
        if let Some(reply) = transfer(read, &mut Store(bytes), &deliveries) {
            prop_assert_eq!(reply, SdoReply::Uploaded(data.into()));
        }
    }

    #[test]
    fn garbage_never_panics(
        frames in proptest::collection::vec(any::<[u8; 8]>(), 0..50),
        read: bool,
    ) {
        let (mut server, mut store) = (SdoServer::new(NODE, TIMEOUT), Store(vec![1; 30]));
        let mut client = SdoClient::new(NODE, TIMEOUT);
        client.start(Time::ZERO, requests(1)[usize::from(read)]);
        for bytes in frames {
            exchange(&mut server, &mut store, bytes);
            client.handle_frame(Time::ZERO, &Frame::new(0x585, &bytes));
        }
    }
}
