//! The tracker's protocols: any bytes, cut anywhere, cause no panic, and a message that is decoded encodes back to
//! itself.

use super::fuzz;
use crate::openigtlink_vectors::decode;
use needle_bench::tracker::openigtlink::{
    Body, HEADER_LEN, IgtlStamp, Message, Quaternion, Status, Tool, ToolStream, crc64, encode,
    tool_kind,
};
use needle_bench::tracker::{Event, Protocol, Reader, ndjson};
use needle_bench::units::Time;

fn corpus() -> Vec<Vec<u8>> {
    let turned = [0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 12.5, -3.25, 100.0];
    let tool = |name: &str| Tool { name: name.to_owned(), kind: tool_kind::SIX_D, pose: turned };
    let quaternion = Tool {
        name: "Ball".to_owned(),
        kind: tool_kind::THREE_D,
        pose: [1.0, 2.0, 3.0, 0.5, 0.5, 0.5, 0.5],
    };
    let position = |quaternion| Body::Position { position_mm: [1.0, 2.0, 3.0], quaternion };
    let status = Status {
        code: 13,
        subcode: -5,
        error_name: "NOT_READY".to_owned(),
        message: "warming up".to_owned(),
    };
    let bodies = [
        Body::Transform(turned),
        position(Quaternion::Absent),
        position(Quaternion::Imaginary([0.5; 3])),
        position(Quaternion::Full([0.5; 4])),
        Body::TrackingData(vec![tool("NeedleToTracker"), tool("ReferenceToTrackerBa")]),
        Body::QuaternionTrackingData(vec![quaternion]),
        Body::Status(status),
        Body::Other("GET_IMAGE".to_owned()),
    ];
    let stamp = IgtlStamp::from_unix_ns(1_700_000_000_500_000_000);
    let metadata = [
        ("TransformValid", "False"),
        ("ReferenceToTrackerBaseStatus", "OUT_OF_VIEW"),
        ("Ünïcode", "ünïcode"),
    ];
    let stream = ToolStream { name: "TDATA", period_ms: 25 };
    bodies
        .into_iter()
        .flat_map(|body| {
            let plain = encode(&Message::new("NeedleTipToTrackerBase", stamp, body));
            [version_2(&plain, &metadata), plain]
        })
        .chain([stream.start(), stream.stop()])
        .collect()
}

/// The message in version 2, with an extended header and this metadata.
fn version_2(plain: &[u8], metadata: &[(&str, &str)]) -> Vec<u8> {
    let (header, content) = plain.split_at(HEADER_LEN);
    let (mut index, mut text) = ((metadata.len() as u16).to_be_bytes().to_vec(), Vec::new());
    for (key, value) in metadata {
        index.extend_from_slice(&(key.len() as u16).to_be_bytes());
        index.extend_from_slice(&106_u16.to_be_bytes());
        index.extend_from_slice(&(value.len() as u32).to_be_bytes());
        text.extend_from_slice(key.as_bytes());
        text.extend_from_slice(value.as_bytes());
    }
    let extended = [
        &12_u16.to_be_bytes()[..],
        &(index.len() as u16).to_be_bytes(),
        &(text.len() as u32).to_be_bytes(),
        &7_u32.to_be_bytes(),
    ]
    .concat();
    let mut message = [header, &extended, content, &index, &text].concat();
    message[1] = 2;
    repair(&mut message);
    message
}

/// Corrects size and checksum in the header, so that the decoder reads the body.
fn repair(message: &mut [u8]) {
    let Some((header, body)) = message.split_at_mut_checked(HEADER_LEN) else { return };
    header[42..50].copy_from_slice(&(body.len() as u64).to_be_bytes());
    header[50..58].copy_from_slice(&crc64(body).to_be_bytes());
}

#[test]
fn a_decoded_message_encodes_back_to_itself() {
    fuzz(&corpus(), |input, mutator| {
        let mut input = input.to_vec();
        if mutator.below(2) == 0 {
            repair(&mut input);
        }
        if input.is_empty() {
            return;
        }
        let Ok(message) = decode(&input) else { return };
        // The decoder replaces bytes that are not UTF-8, and escapes others; both make the text longer.
        if format!("{message:?}").contains([char::REPLACEMENT_CHARACTER, '\\']) {
            return;
        }
        let message = Message { metadata: Vec::new(), ..message };
        let again = decode(&encode(&message)).expect("a message");
        assert_eq!(again.body.type_name(), message.body.type_name());
        assert_eq!(encode(&again), encode(&message));
    });
}

#[test]
fn a_stream_cut_anywhere_gives_the_same_events() {
    let stream = |messages: &[Vec<u8>]| messages.concat();
    let corpus: Vec<Vec<u8>> = corpus().chunks(4).map(stream).collect();
    fuzz(&corpus, |input, mutator| {
        let whole = events(Protocol::OpenIgtLink, &[input]);
        let cut = mutator.below(input.len() + 1);
        let (head, tail) = input.split_at(cut);
        assert_eq!(events(Protocol::OpenIgtLink, &[head, tail]), whole);
    });
}

#[test]
fn ndjson_cut_anywhere_gives_the_same_events() {
    let line = concat!(
        r#"{"receive_time_ns":1020000000,"source_unix_ns":1700000001000000000,"tool":"N","#,
        r#""position_tracker_mm":[0.1,"NaN",1e-7],"orientation_tracker_wxyz":[1.0,0.0,0.0,0.0],"#,
        r#""status":"OK","position_plane_mm":null,"acquisition_time_ns":null,"refused":null}"#,
        "\n"
    );
    let short = "{\"tool\":\"N\",\"position_tracker_mm\":[1,2,3]}\n";
    let corpus = [line.as_bytes().to_vec(), [line, short, short].concat().into_bytes()];
    fuzz(&corpus, |input, mutator| {
        let cut = mutator.below(input.len() + 1);
        let (head, tail) = input.split_at(cut);
        let whole = events(Protocol::Ndjson, &[input]);
        assert_eq!(events(Protocol::Ndjson, &[head, tail]), whole);
        if let Ok(text) = std::str::from_utf8(input)
            && let Ok(recording) = ndjson::recording(text)
        {
            assert!(recording.is_sorted_by_key(|(time, _)| *time));
        }
    });
}

/// The events of a connection that receives `chunks`, as text because a position may be NaN.
fn events(protocol: Protocol, chunks: &[&[u8]]) -> Vec<String> {
    let mut reader = Reader::new(protocol);
    let mut events = Vec::new();
    for chunk in chunks {
        reader.push(Time::ZERO, chunk);
        loop {
            match reader.poll() {
                Ok(None) => break,
                Ok(Some(event)) => {
                    if let Event::Sample(sample) = &event {
                        let norm = sample.orientation.map(|q| q.norm());
                        assert!(norm.is_none_or(|norm| (norm - 1.0).abs() < 1e-9), "{event:?}");
                    }
                    events.push(format!("{event:?}"));
                }
                Err(error) => {
                    events.push(error.to_string());
                    return events;
                }
            }
        }
    }
    events
}
