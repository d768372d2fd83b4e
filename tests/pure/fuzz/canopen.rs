//! CANopen: for any frames in any order and at any time, SDO client and server answer, abort or time out, and keep no
//! more data than they received. A message that is decoded encodes back to the same frame.

use super::fuzz;
use needle_bench::canopen::emcy::parse_emcy;
use needle_bench::canopen::nmt::{heartbeat_frame, nmt_frame, parse_heartbeat, parse_nmt};
use needle_bench::canopen::pdo::{MappedObject, PdoMapping};
use needle_bench::canopen::sdo::{
    AbortCode, ObjectAccess, SdoClient, SdoReply, SdoRequest, SdoServer, SdoValue,
};
use needle_bench::canopen::{CanId, Frame, NodeId, ObjectAddress};
use needle_bench::emulator::drive::{Drive, DriveConfig};
use needle_bench::units::Time;
use std::time::Duration;

const NODE: NodeId = NodeId::new(1).unwrap();
const TIMEOUT: Duration = Duration::from_millis(150);
/// The subindex of objects that hold as many bytes as their index says.
const STORE: u8 = 7;
/// The most frames that an emulated drive sends after one frame or timeout.
const DRIVE_FRAMES_MAX: usize = 16;

/// A frame and the time before it in twelve bytes, so that mutations of bytes change identifiers, lengths, data,
/// times and the order of frames.
pub(crate) fn written(wait_ms: u8, frame: &Frame) -> [u8; 12] {
    let mut bytes = [0; 12];
    let id = frame.cob_id().expect("a base identifier").to_be_bytes();
    let head = [wait_ms, id[0], id[1], frame.data().len() as u8];
    bytes[..4].copy_from_slice(&head);
    bytes[4..4 + frame.data().len()].copy_from_slice(frame.data());
    bytes
}

/// The frames in `input`, each with the time before it. They may be remote or extended.
pub(crate) fn frames(input: &[u8]) -> impl Iterator<Item = (Duration, Frame)> {
    input.chunks_exact(12).map(|chunk| {
        let high = chunk[1];
        let id = u16::from_be_bytes([high & 0x07, chunk[2]]);
        let id = if high & 0x40 == 0 { CanId::Base(id) } else { CanId::Extended(id.into()) };
        let len = usize::from(chunk[3] % 9);
        let frame = Frame::from_parts(id, high & 0x80 != 0, &chunk[4..4 + len]);
        (Duration::from_millis(chunk[0].into()), frame.expect("in range"))
    })
}

/// Objects of every length, and the number of bytes written to them.
#[derive(Default)]
struct Store {
    written: usize,
}

impl ObjectAccess for Store {
    fn read(&mut self, object: ObjectAddress) -> Result<Vec<u8>, AbortCode> {
        match object.subindex {
            STORE => Ok((0..object.index % 2048).map(|n| n as u8).collect()),
            _ => Err(AbortCode::NO_SUCH_OBJECT),
        }
    }

    fn write(&mut self, object: ObjectAddress, value: SdoValue) -> Result<(), AbortCode> {
        self.written += value.as_bytes().len();
        if object.subindex == STORE { Ok(()) } else { Err(AbortCode::READ_ONLY) }
    }
}

/// Transfers of each kind and of many lengths. Those over 4 bytes are segmented, which the bench's client refuses.
fn requests() -> impl Iterator<Item = SdoRequest> {
    let object = |len| ObjectAddress::new(len, STORE);
    let lengths = [0, 1, 4, 5, 7, 8, 14, 15, 100, 889, 890, 2000];
    let uploads = lengths.map(|len| SdoRequest::Upload(object(len)));
    let values = [SdoValue::from(1_u8), SdoValue::from(2_u16), SdoValue::from(3_u32)];
    let downloads = values.map(|value| SdoRequest::Download(object(7), value));
    uploads.into_iter().chain(downloads)
}

/// The frames of both sides, in order, in an undisturbed transfer of each of [`requests`].
fn transfers() -> Vec<Vec<u8>> {
    let converse = |request: SdoRequest| {
        let now = Time::ZERO;
        let (mut client, mut server) =
            (SdoClient::new(NODE, TIMEOUT), SdoServer::new(NODE, TIMEOUT));
        let mut store = Store::default();
        let mut script = Vec::new();
        client.start(now, request);
        loop {
            if let Some(frame) = client.poll_transmit() {
                script.extend(written(0, &frame));
                server.handle_frame(now, &frame, &mut store);
            } else if let Some(frame) = server.poll_transmit() {
                script.extend(written(0, &frame));
                client.handle_frame(now, &frame);
            } else {
                client.poll_result().expect("over").ok();
                return script;
            }
        }
    };
    requests().map(converse).collect()
}

#[test]
fn an_sdo_server_takes_no_more_than_it_was_given() {
    fuzz(&transfers(), |input, _| {
        let (mut server, mut store) = (SdoServer::new(NODE, TIMEOUT), Store::default());
        let (mut now, mut given) = (Time::ZERO, 0);
        for (wait, frame) in frames(input) {
            now = now + wait;
            if server.deadline() <= now {
                server.handle_timeout(now);
            }
            given += frame.data().len();
            server.handle_frame(now, &frame, &mut store);
            let answers = std::iter::from_fn(|| server.poll_transmit());
            assert!(answers.inspect(is_sdo).count() <= 2, "one answer, and one to a timeout");
            assert!(store.written <= given, "{} bytes out of {given}", store.written);
        }
        assert!(server.deadline() <= now + TIMEOUT || server.deadline() == Time::NEVER);
    });
}

#[test]
fn an_sdo_client_takes_no_more_than_it_was_given_and_always_ends() {
    let requests: Vec<SdoRequest> = requests().collect();
    fuzz(&transfers(), |input, mutator| {
        let mut client = SdoClient::new(NODE, TIMEOUT);
        let mut frames = frames(input);
        let mut now = Time::ZERO;
        // Frames of the first transfer must not be taken for those of the second.
        for _ in 0..2 {
            let request = requests[mutator.below(requests.len())];
            client.start(now, request);
            let mut given = 0;
            let result = loop {
                let sent = std::iter::from_fn(|| client.poll_transmit());
                assert!(sent.inspect(is_sdo).count() <= 2, "a request, and an abort before it");
                if let Some(result) = client.poll_result() {
                    break result;
                }
                match frames.next() {
                    Some((wait, frame)) => {
                        now = now + wait;
                        given += frame.data().len();
                        client.handle_frame(now, &frame);
                    }
                    None => now = now.max(client.deadline()),
                }
                if client.deadline() <= now {
                    client.handle_timeout(now);
                }
            };
            if let Ok(SdoReply::Uploaded(value)) = result {
                assert!(value.as_bytes().len() <= given, "{value} out of {given} bytes");
            }
        }
    });
}

/// A frame of node 1's SDO, of eight bytes (CiA 301, 7.2.4.3).
fn is_sdo(frame: &Frame) {
    assert!(matches!(frame.cob_id(), Some(0x581 | 0x601)) && frame.data().len() == 8, "{frame}");
}

#[test]
fn an_emulated_drive_sends_few_frames_and_keeps_its_node() {
    fuzz(&transfers(), |input, _| {
        let mut drive = Drive::new(DriveConfig::new(NODE, 1, 2));
        let mut now = Time::ZERO;
        for (wait, frame) in frames(input) {
            now = now + wait;
            while drive.deadline() <= now {
                drive.handle_timeout(drive.deadline());
                while drive.poll_transmit().is_some() {}
            }
            drive.handle_frame(now, &frame);
            let answers = std::iter::from_fn(|| drive.poll_transmit());
            let mine = |frame: &Frame| frame.cob_id().is_some_and(|id| id != 0);
            assert!(answers.inspect(|answer| assert!(mine(answer))).count() <= DRIVE_FRAMES_MAX);
        }
        assert_eq!(drive.id(), NODE);
    });
}

#[test]
fn a_decoded_frame_encodes_back_to_itself() {
    let corpus: Vec<Vec<u8>> = [
        Frame::new(0x081, &[0x11, 0x86, 0x21, 0, 0, 0, 0, 0]),
        Frame::new(0x0FF, &[0, 0, 0, 1, 2, 3, 4, 5]),
        Frame::new(0x701, &[0x05]),
        Frame::new(0x77F, &[0x00]),
        Frame::new(0x000, &[0x01, 0x00]),
        Frame::new(0x000, &[0x81, 0x02]),
    ]
    .iter()
    .map(|frame| written(0, frame).repeat(4))
    .collect();
    fuzz(&corpus, |input, _| {
        for (_, frame) in frames(input) {
            if let Some((node, emcy)) = parse_emcy(&frame) {
                assert_eq!(emcy.to_frame(node), frame);
                assert!(!emcy.to_string().is_empty());
            }
            if let Some((node, state)) = parse_heartbeat(&frame) {
                // The frame may differ in the reserved bit, the toggle bit of node guarding.
                assert_eq!(parse_heartbeat(&heartbeat_frame(node, state)), Some((node, state)));
            }
            if let Some((command, node)) = parse_nmt(&frame) {
                assert_eq!(nmt_frame(command, node), frame);
            }
        }
    });
}

#[test]
fn a_pdo_fills_its_mapping_or_is_refused() {
    let entry = |object: MappedObject| object.to_u32().to_le_bytes();
    let word = MappedObject::new(0x6041, 0, 16);
    let position = MappedObject::new(0x6064, 0, 32);
    let corpus = [
        [[2, 0, 0, 0], entry(word), entry(position), *b"payl", *b"oad!"].concat(),
        [[1, 0, 0, 0], entry(MappedObject::new(0x60FD, 0, 3)), *b"payl"].concat(),
    ];
    fuzz(&corpus, |input, _| {
        let [count, _, _, _, rest @ ..] = input else { return };
        let (entries, payload) = rest.split_at((usize::from(*count) * 4).min(rest.len()));
        let entries = entries.as_chunks::<4>().0.iter();
        let objects: Vec<MappedObject> =
            entries.map(|entry| MappedObject::from_u32(u32::from_le_bytes(*entry))).collect();
        let Some(mapping) = PdoMapping::new(objects) else { return };
        assert!(mapping.len_bytes() <= 8);
        match mapping.unpack(payload) {
            None => assert!(payload.len() < mapping.len_bytes()),
            Some(values) => {
                assert_eq!(values.len(), mapping.objects().len());
                let packed = mapping.pack(values.iter().map(|(_, value)| *value));
                let again = mapping.unpack(&packed).expect("as long as the mapping");
                assert_eq!(again, values);
            }
        }
    });
}
