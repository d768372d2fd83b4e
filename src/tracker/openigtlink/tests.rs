//! Whole messages against bytes of other implementations, and streams that are cut or damaged anywhere.
//!
//! Frozen bytes, do not edit. `TRANSFORM_*` and `STRING` are `pack()` of pyigtl 0.3.4 (PyPI) with
//! timestamp 1700000000.5; `STATUS` and `POSITION_24` are the specification's tables written with
//! Python's `struct` and checksummed by `crcmod` (polynomial 0x142F0E1EBA9EA3693); TDATA, QTDATA
//! and their requests are the reference library's own (libopenigtlink 1.11), `GET_STATUS` that of its
//! commit 94244fed, which has header version 2.

use super::*;
use proptest::prelude::*;
use proptest::sample::Index;

const TRANSFORM_V1: &str = "\
    00015452414e53464f524d0000004e6565646c65546f547261636b657200000000006553f1008000000000000000\
    0000003004a7d6467769ca6b000000003f80000000000000bf800000000000000000000000000000000000003f80\
    000041480000c050000042c80000";
const TRANSFORM_V2: &str = "\
    00025452414e53464f524d0000004e6565646c65546970546f547261636b657242616553f1008000000000000000\
    000000a964c04169c1bb6d1d000c001a0000005300000007000000003f80000000000000bf800000000000000000\
    000000000000000000003f80000041480000c050000042c8000000030010000300000016000e000300000005000f\
    00030000000b4947544c5f4445564943455f4e414d454e6565646c65546970546f547261636b6572426173655472\
    616e73666f726d56616c696446616c73655472616e73666f726d5374617475734f55545f4f465f56494557";
const STRING_V1: &str = "\
    0001535452494e47000000000000436f6e736f6c65000000000000000000000000006553f1008000000000000000\
    0000000911bb731ffe0317650003000568656c6c6f";
const STATUS_V1: &str = "\
    0001535441545553000000000000547261636b6572000000000000000000000000006553f1008000000000000000\
    00000029fd196b515c3856b2000dfffffffffffffffb4e4f545f524541445900000000000000000000007761726d\
    696e6720757000";
const POSITION_24_V1: &str = "\
    0001504f534954494f4e000000005469700000000000000000000000000000000000000000000000000000000000\
    00000018bc9669d772b2ec143f80000040000000404000003f0000003f0000003f000000";
const TDATA_V1: &str = "\
    0001544441544100000000000000547261636b6572000000000000000000000000006553f1007fffffff00000000\
    0000008c039c740a8dd80e554e6565646c65546f547261636b657200000000000200000000003f80000000000000\
    bf800000000000000000000000000000000000003f80000041480000c050000042c8000042616c6c000000000000\
    0000000000000000000003003f8000000000000000000000000000003f8000000000000000000000000000003f80\
    00003f8000004000000040400000";
const QTDATA_V1: &str = "\
    0001515444415441000000000000547261636b6572000000000000000000000000006553f1007fffffff00000000\
    00000032b28553c76c0d5a0c4e6565646c65546f547261636b6572000000000004003f8000004000000040400000\
    3f000000bf0000003f0000003f000000";
const STT_TDATA_V1: &str = "\
    00015354545f544441544100000042656e63680000000000000000000000000000006553f1007fffffff00000000\
    0000002496967603e74df5b70000001950617469656e740000000000000000000000000000000000000000000000\
    0000";
const STT_QTDATA_V1: &str = "\
    00015354545f515444415441000042656e63680000000000000000000000000000006553f1007fffffff00000000\
    00000024000000000000000000000000000000000000000000000000000000000000000000000000000000000000\
    0000";
const STP_TDATA_V1: &str = "\
    00015354505f544441544100000042656e63680000000000000000000000000000006553f1007fffffff00000000\
    000000000000000000000000";
const STP_QTDATA_V1: &str = "\
    00015354505f515444415441000042656e63680000000000000000000000000000006553f1007fffffff00000000\
    000000000000000000000000";
const GET_STATUS_V2: &str = "\
    00024745545f535441545553000000000000000000000000000000000000000000000000000000000000000000\
    000000000eb21e4ee882505334000c000200000000000000000000";

fn bytes(hex: &str) -> Vec<u8> {
    (0..hex.len())
        .step_by(2)
        .map(|at| u8::from_str_radix(&hex[at..at + 2], 16).expect("hex"))
        .collect()
}

fn stamp() -> Option<IgtlStamp> {
    IgtlStamp::from_unix_ns(1_700_000_000_500_000_000)
}

/// A quarter turn about z at (12.5, −3.25, 100) mm.
const TURNED: Body =
    Body::Transform([0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 12.5, -3.25, 100.0]);

fn frozen() -> [(&'static str, Message); 11] {
    let metadata = |pairs: &[(&str, &str)]| {
        pairs.iter().map(|(key, value)| (key.to_string(), value.to_string())).collect()
    };
    let status = Status {
        code: 13,
        subcode: -5,
        error_name: "NOT_READY".to_owned(),
        message: "warming up".to_owned(),
    };
    let position = Body::Position {
        position_mm: [1.0, 2.0, 3.0],
        quaternion: Quaternion::Imaginary([0.5, 0.5, 0.5]),
    };
    // The reference library rounds its stamps down.
    let stamped = |device: &str, body| {
        Message::new(device, IgtlStamp::from_bits(0x6553_F100_7FFF_FFFF), body)
    };
    let tool = |name: &str, kind, pose| Tool { name: name.to_owned(), kind, pose };
    let Body::Transform(turned) = TURNED else { unreachable!("is one") };
    let ball = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 2.0, 3.0];
    let matrices = vec![
        tool("NeedleToTracker", tool_kind::SIX_D, turned),
        tool("Ball", tool_kind::THREE_D, ball),
    ];
    let quaternions = vec![Tool {
        name: "NeedleToTracker".to_owned(),
        kind: tool_kind::FIVE_D,
        pose: [1.0, 2.0, 3.0, 0.5, -0.5, 0.5, 0.5],
    }];
    let request = |name: &str| stamped("Bench", Body::Other(name.to_owned()));
    [
        (TDATA_V1, stamped("Tracker", Body::TrackingData(matrices))),
        (QTDATA_V1, stamped("Tracker", Body::QuaternionTrackingData(quaternions))),
        (STT_TDATA_V1, request("STT_TDATA")),
        (STT_QTDATA_V1, request("STT_QTDATA")),
        (STP_TDATA_V1, request("STP_TDATA")),
        (STP_QTDATA_V1, request("STP_QTDATA")),
        (TRANSFORM_V1, Message::new("NeedleToTracker", stamp(), TURNED)),
        (
            TRANSFORM_V2,
            Message {
                metadata: metadata(&[
                    ("IGTL_DEVICE_NAME", "NeedleTipToTrackerBase"),
                    ("TransformValid", "False"),
                    ("TransformStatus", "OUT_OF_VIEW"),
                ]),
                ..Message::new("NeedleTipToTrackerBa", stamp(), TURNED)
            },
        ),
        (STRING_V1, Message::new("Console", stamp(), Body::Other("STRING".to_owned()))),
        (STATUS_V1, Message::new("Tracker", stamp(), Body::Status(status))),
        (POSITION_24_V1, Message::new("Tip", None, position)),
    ]
}

#[test]
fn bytes_of_other_implementations_are_read_and_written_alike() {
    for (hex, message) in frozen() {
        assert_eq!(decode(&bytes(hex)).as_ref(), Ok(&message));
        if !matches!(message.body, Body::Other(_)) && message.metadata.is_empty() {
            assert_eq!(encode(&message), bytes(hex), "{}", message.body.type_name());
        }
    }
}

/// Reads one whole message.
fn decode(bytes: &[u8]) -> Result<Message, DecodeError> {
    let mut decoder = StreamDecoder::default();
    decoder.push(bytes);
    decoder.poll().map(|message| message.expect("whole"))
}

#[test]
fn a_name_too_long_for_the_header_is_whole_in_version_2() {
    let read = decode(&bytes(TRANSFORM_V2)).expect("well formed");
    assert_eq!(read.device_name, "NeedleTipToTrackerBa");
    assert_eq!(read.full_device_name(), "NeedleTipToTrackerBase");
}

#[test]
fn requests_equal_those_of_the_reference_library() {
    let stream = ToolStream { name: "QTDATA", period_ms: 0 };
    for (sent, hex) in [(stream.start(), STT_QTDATA_V1), (stream.stop(), STP_QTDATA_V1)] {
        let reference = bytes(hex);
        assert_eq!((&sent[..14], &sent[42..]), (&reference[..14], &reference[42..]));
    }
}

#[test]
fn a_status_request_equals_that_of_the_reference_library() {
    assert_eq!(get_status(), bytes(GET_STATUS_V2));
    assert_eq!(
        decode(&get_status()),
        Ok(Message::new("", None, Body::Other("GET_STATUS".to_owned())))
    );
}

#[test]
fn a_damaged_body_loses_the_framing_for_good() {
    let mut stream = bytes(TRANSFORM_V1);
    stream[100] ^= 1;
    stream.extend(bytes(TRANSFORM_V1));
    let mut decoder = StreamDecoder::default();
    decoder.push(&stream);
    let first = decoder.poll();
    let error = first.clone().expect_err("damaged");
    assert!(error.loses_framing && error.to_string().contains(": CRC "), "{error}");
    decoder.push(&bytes(TRANSFORM_V1));
    assert_eq!(decoder.poll(), first);
}

#[test]
fn a_sender_without_checksums_is_told_to_compute_them() {
    let mut sent = bytes(TRANSFORM_V1);
    sent[50..58].fill(0);
    let error = decode(&sent).expect_err("a CRC of 0");
    assert!(error.loses_framing);
    assert_eq!(
        error.to_string(),
        "openigtlink: TRANSFORM \"NeedleToTracker\": CRC 0: the sender computes no checksum; the bench needs one \
         (CRC-64 ECMA-182)"
    );
    // Of an empty body it is the checksum.
    let empty = encode(&Message::new("Tracker", None, Body::TrackingData(Vec::new())));
    assert_eq!(empty[50..58], [0; 8]);
    assert!(decode(&empty).is_ok());
}

#[test]
fn a_message_of_wrong_length_is_refused_and_the_next_is_read() {
    // 47 of the 48 bytes of a TRANSFORM, with a correct checksum, as a faulty script would send them.
    let (hex, next) = &frozen()[6];
    let good = bytes(hex);
    let body = &good[HEADER_LEN..HEADER_LEN + 47];
    let mut stream = good[..HEADER_LEN].to_vec();
    stream[42..50].copy_from_slice(&47u64.to_be_bytes());
    stream[50..58].copy_from_slice(&crc64(body).to_be_bytes());
    stream.extend_from_slice(body);
    stream.extend_from_slice(&good);
    let mut decoder = StreamDecoder::default();
    decoder.push(&stream);
    let error = decoder.poll().expect_err("one float short");
    assert!(!error.loses_framing);
    assert_eq!(
        error.to_string(),
        "openigtlink: TRANSFORM \"NeedleToTracker\": content of 47 bytes (48 expected)"
    );
    assert_eq!(decoder.poll().as_ref(), Ok(&Some(next.clone())));
}

#[test]
fn lengths_that_a_peer_states_are_bounded() {
    let with_size = |hex: &str, size: u64| {
        let mut stream = bytes(hex);
        stream[42..50].copy_from_slice(&size.to_be_bytes());
        let mut decoder = StreamDecoder::default();
        decoder.push(&stream);
        decoder.poll()
    };
    for size in [BODY_LIMIT + 1, u64::MAX] {
        let error = with_size(TRANSFORM_V1, size).expect_err("too large");
        let text = format!("body of {size} bytes (limit {BODY_LIMIT})");
        assert!(error.to_string().ends_with(&text), "{error}");
    }
    assert_eq!(with_size(TRANSFORM_V1, BODY_LIMIT), Ok(None));
    // A type that is not read, such as an image, may be larger: it is skipped as it comes, and none of it is kept.
    let mut decoder = StreamDecoder::default();
    let mut image = bytes(STRING_V1);
    image[42..50].copy_from_slice(&SKIPPED_BODY_LIMIT.to_be_bytes());
    decoder.push(&image);
    for _ in 0..100 {
        assert_eq!(decoder.poll(), Ok(None));
        assert_eq!(decoder.unread().len(), 0);
        decoder.push(&[0; 4096]);
    }
    assert_eq!(with_size(STRING_V1, SKIPPED_BODY_LIMIT), Ok(None));
    let error = with_size(STRING_V1, SKIPPED_BODY_LIMIT + 1).expect_err("too large");
    assert!(error.to_string().ends_with(&format!("(limit {SKIPPED_BODY_LIMIT})")), "{error}");
}

#[test]
fn a_stream_that_ends_within_a_message_is_reported_as_cut_off() {
    for (hex, _) in frozen() {
        let whole = bytes(hex);
        for cut in 0..=whole.len() {
            let mut decoder = StreamDecoder::default();
            decoder.push(&whole[..cut]);
            let message = decoder.poll().expect("nothing wrong yet");
            assert_eq!(message.is_some(), cut == whole.len());
            let need = if cut < HEADER_LEN { HEADER_LEN } else { whole.len() } as u64;
            let expected = (cut != 0 && cut != whole.len()).then(|| {
                format!("openigtlink: {cut} bytes of a message of {need}; it was cut off")
            });
            assert_eq!(decoder.finish().err().map(|error| error.to_string()), expected);
        }
    }
}

/// Polls until nothing is left; returns the messages and errors in order.
fn drain(decoder: &mut StreamDecoder) -> Vec<Result<Message, DecodeError>> {
    let mut out = Vec::new();
    loop {
        match decoder.poll() {
            Ok(None) => return out,
            Ok(Some(message)) => out.push(Ok(message)),
            Err(error) => {
                let lost = error.loses_framing;
                out.push(Err(error));
                if lost {
                    return out;
                }
            }
        }
    }
}

fn all_frozen() -> Vec<u8> {
    frozen().iter().flat_map(|(hex, _)| bytes(hex)).collect()
}

proptest! {
    #[test]
    fn any_split_gives_the_same_messages(mut cuts in prop::collection::vec(any::<Index>(), 0..40)) {
        let stream = all_frozen();
        cuts.sort_by_key(|cut| cut.index(stream.len()));
        let mut decoder = StreamDecoder::default();
        let (mut messages, mut from) = (Vec::new(), 0);
        for to in cuts.iter().map(|cut| cut.index(stream.len())).chain([stream.len()]) {
            decoder.push(&stream[from..to]);
            prop_assert!(decoder.unread().len() <= stream.len(), "more bytes are kept than were sent");
            messages.extend(drain(&mut decoder));
            from = to;
        }
        let expected: Vec<_> = frozen().into_iter().map(|(_, message)| Ok(message)).collect();
        prop_assert_eq!(messages, expected);
        prop_assert_eq!(decoder.finish(), Ok(()));
    }

    #[test]
    fn damage_never_panics_and_never_invents_a_message(
        damage in prop::collection::vec((any::<Index>(), any::<u8>()), 1..12),
        repair_crc: bool,
        which: Index,
    ) {
        let (hex, original) = &frozen()[which.index(frozen().len())];
        let mut message = bytes(hex);
        for (at, byte) in &damage {
            let at = at.index(message.len());
            message[at] = *byte;
        }
        let intact = message == bytes(hex);
        if repair_crc {
            // With a correct checksum the content is decoded too.
            let crc = crc64(&message[HEADER_LEN..]);
            message[50..58].copy_from_slice(&crc.to_be_bytes());
        }
        let body_intact = message[HEADER_LEN..] == bytes(hex)[HEADER_LEN..];
        let mut decoder = StreamDecoder::default();
        decoder.push(&message);
        for read in drain(&mut decoder).into_iter().flatten() {
            // If the type is damaged, the body is skipped.
            let is_read = !matches!(read.body, Body::Other(_));
            prop_assert!(!is_read || repair_crc || body_intact, "a damaged body was accepted");
            prop_assert!(!intact || &read == original);
        }
    }

    #[test]
    fn an_encoded_message_is_decoded_to_the_same_message(
        name in "[A-Za-z]{0,20}",
        unix_ns in 1..i64::from(u32::MAX) * 1_000_000_000,
        elements: [f32; 12],
        quaternion: [f32; 4],
        tools in 0..5usize,
    ) {
        let finite = |v: f32| if v.is_nan() { 0.0 } else { v };
        let bodies = [
            Body::Transform(elements.map(finite)),
            Body::Position {
                position_mm: [elements[0], elements[1], elements[2]].map(finite),
                quaternion: Quaternion::Full(quaternion.map(finite)),
            },
            Body::TrackingData(vec![
                Tool { name: "Tip".to_owned(), kind: 9, pose: elements.map(finite) };
                tools
            ]),
        ];
        for body in bodies {
            let sent = Message::new(&name, IgtlStamp::from_unix_ns(unix_ns), body);
            prop_assert_eq!(decode(&encode(&sent)), Ok(sent));
        }
    }
}
