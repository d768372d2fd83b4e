//! The server alone, by the byte, and with the client over a good and a bad link.

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
    assert_eq!(ask([0xe0, 0x00, 0x20, 3, 0, 0, 0, 0]), "585#8000200301000405", "reserved");
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

const STRING: &[u8] = b"A really really long string...";

/// The block transfers in python-canopen's tests, byte for byte.
#[test]
fn frozen_block_exchanges() {
    let (mut server, mut store) = (SdoServer::new(NODE, TIMEOUT), Store(Vec::new()));
    let mut ask = |request| exchange(&mut server, &mut store, request);
    assert_eq!(ask([0xc6, 0x00, 0x20, 3, 30, 0, 0, 0]), "585#A40020037F000000");
    for segment in [b"\x01A reall", b"\x02y reall", b"\x03y long ", b"\x04string."] {
        assert_eq!(ask(*segment), "");
    }
    assert_eq!(ask(*b"\x85..\0\0\0\0\0"), "585#A2057F0000000000");
    assert_eq!(ask([0xd5, 0x45, 0x69, 0, 0, 0, 0, 0]), "585#A100000000000000");
    assert_eq!(store.0, STRING);

    let mut store = Store(b"Tiny Node - Mega Domains !".to_vec());
    let mut ask = |request| exchange(&mut server, &mut store, request);
    assert_eq!(ask([0xa4, 0x00, 0x20, 3, 0x7f, 0, 0, 0]), "585#C60020031A000000");
    assert_eq!(
        ask([0xa3, 0, 0, 0, 0, 0, 0, 0]),
        "585#0154696E79204E6F585#026465202D204D65585#03676120446F6D61585#84696E7320210000"
    );
    assert_eq!(ask([0xa2, 4, 0x7f, 0, 0, 0, 0, 0]), "585#C940E10000000000");
    assert_eq!(ask([0xa1, 0, 0, 0, 0, 0, 0, 0]), "");
    assert_eq!(server.deadline(), Time::NEVER);
}

/// What is missing of a block is sent again, from the segment behind the last one acknowledged.
#[test]
fn a_lost_segment_is_sent_again() {
    let (mut server, mut store) = (SdoServer::new(NODE, TIMEOUT), Store(Vec::new()));
    let mut ask = |request| exchange(&mut server, &mut store, request);
    ask([0xc6, 0x00, 0x20, 3, 30, 0, 0, 0]);
    assert_eq!(ask(*b"\x01A reall"), "");
    assert_eq!(ask(*b"\x03y long "), "");
    assert_eq!(ask(*b"\x85..\0\0\0\0\0"), "585#A2017F0000000000", "from the second on");
    for segment in [b"\x01y reall", b"\x02y long ", b"\x03string."] {
        assert_eq!(ask(*segment), "");
    }
    assert_eq!(ask(*b"\x84..\0\0\0\0\0"), "585#A2047F0000000000");
    assert_eq!(ask([0xd5, 0x45, 0x69, 0, 0, 0, 0, 0]), "585#A100000000000000");
    assert_eq!(store.0, STRING);

    let mut store = Store(STRING.to_vec());
    let mut ask = |request| exchange(&mut server, &mut store, request);
    ask([0xa4, 0x00, 0x20, 3, 3, 0, 0, 0]);
    assert_eq!(ask([0xa3, 0, 0, 0, 0, 0, 0, 0]).matches("585#").count(), 3);
    let again = ask([0xa2, 1, 2, 0, 0, 0, 0, 0]);
    assert_eq!(again, "585#0179207265616C6C585#0279206C6F6E6720", "blocks of two from now on");
}

#[test]
fn block_transfers_are_refused_by_name() {
    let (mut server, mut store) = (SdoServer::new(NODE, TIMEOUT), Store(STRING.to_vec()));
    let mut ask = |request| exchange(&mut server, &mut store, request);
    let announced = [0xc6, 0x00, 0x20, 3, 5, 0, 0, 0];
    assert_eq!(ask([0xa4, 0x00, 0x20, 3, 0, 0, 0, 0]), "585#8000200302000405", "block size");
    assert_eq!(ask([0xa4, 0x00, 0x20, 3, 128, 0, 0, 0]), "585#8000200302000405");
    assert_eq!(ask([0xa4, 0x01, 0x20, 0, 127, 0, 0, 0]), "585#8001200000000206", "no object");
    assert_eq!(ask([0xc6, 0x00, 0x20, 3, 0, 0, 0, 1]), "585#8000200305000405", "too long");
    ask(announced);
    ask(*b"\x81abcde\0\0");
    assert_eq!(ask([0xc9, 0x12, 0x34, 0, 0, 0, 0, 0]), "585#8000200304000405", "CRC");
    ask(announced);
    ask(*b"\x81abcde\0\0");
    assert_eq!(ask([0xc1, 0, 0, 0, 0, 0, 0, 0]), "585#8000200312000706", "longer than announced");
    ask([0xa4, 0x00, 0x20, 3, 2, 0, 0, 0]);
    ask([0xa3, 0, 0, 0, 0, 0, 0, 0]);
    assert_eq!(ask([0xa2, 3, 2, 0, 0, 0, 0, 0]), "585#8000200303000405", "sequence number");
    assert_eq!(ask([0xa1, 0, 0, 0, 0, 0, 0, 0]), "585#8000000001000405", "nothing is left");
}

/// With a threshold the server may answer with an ordinary upload, and does.
#[test]
fn short_data_needs_no_block() {
    let (mut server, mut store) = (SdoServer::new(NODE, TIMEOUT), Store(vec![1, 2]));
    let mut ask = |request| exchange(&mut server, &mut store, request);
    assert_eq!(ask([0xa4, 0x00, 0x20, 3, 127, 8, 0, 0]), "585#4B00200301020000");
    assert_eq!(ask([0xa4, 0x00, 0x20, 3, 127, 1, 0, 0]), "585#C600200302000000");
}

/// A request of another client, taken for a segment out of order, does not keep a block alive.
#[test]
fn what_is_out_of_order_does_not_prolong_a_block() {
    let (mut server, mut store) = (SdoServer::new(NODE, TIMEOUT), Store(Vec::new()));
    exchange(&mut server, &mut store, [0xc6, 0x00, 0x20, 3, 30, 0, 0, 0]);
    let late = Time::ZERO + TIMEOUT / 2;
    server.handle_frame(late, &Frame::new(0x605, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]), &mut store);
    assert_eq!(server.deadline(), Time::ZERO + TIMEOUT);
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
    let fate = prop_oneof![20 => Just(Fate::Pass), 1 => Just(Fate::Drop), 1 => Just(Fate::Double)];
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

/// Reads and writes, in segments or in blocks.
fn requests(blocks: bool, data: &[u8]) -> [SdoRequest; 2] {
    match blocks {
        true => [SdoRequest::BlockDownload(OBJECT, data.to_vec()), SdoRequest::BlockUpload(OBJECT)],
        false => [SdoRequest::Download(OBJECT, data.to_vec()), SdoRequest::Upload(OBJECT)],
    }
}

proptest! {
    #[test]
    fn a_good_link_carries_any_payload(
        data in proptest::collection::vec(any::<u8>(), 0..2000),
        blocks: bool,
    ) {
        let [write, read] = requests(blocks, &data);
        let mut store = Store(Vec::new());
        let written = transfer(write, &mut store, &[Fate::Pass]);
        prop_assert_eq!(written, Some(SdoReply::Downloaded));
        prop_assert_eq!(&store.0, &data);
        let read = transfer(read, &mut store, &[Fate::Pass]);
        prop_assert_eq!(read, Some(SdoReply::Uploaded(data)));
    }

    #[test]
    fn a_bad_link_gives_the_right_result_or_an_error(
        data in proptest::collection::vec(any::<u8>(), 0..300),
        blocks: bool,
        fates in fates(),
    ) {
        let [write, read] = requests(blocks, &data);
        let mut store = Store(Vec::new());
        if transfer(write, &mut store, &fates).is_some() {
            prop_assert_eq!(&store.0, &data);
        }
        let mut store = Store(data.clone());
        if let Some(reply) = transfer(read, &mut store, &fates) {
            prop_assert_eq!(reply, SdoReply::Uploaded(data));
        }
    }

    #[test]
    fn garbage_never_panics(
        requests in proptest::collection::vec(any::<[u8; 8]>(), 0..50),
        blocks: bool,
        read: bool,
    ) {
        let (mut server, mut store) = (SdoServer::new(NODE, TIMEOUT), Store(vec![1; 30]));
        let mut client = SdoClient::new(NODE, TIMEOUT);
        let [download, upload] = self::requests(blocks, &[1; 2000]);
        client.start(Time::ZERO, if read { upload } else { download }).unwrap();
        for bytes in requests {
            exchange(&mut server, &mut store, bytes);
            client.handle_frame(Time::ZERO, &Frame::new(0x585, &bytes));
        }
    }
}
