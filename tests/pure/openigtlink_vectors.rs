//! The OpenIGTLink codec against messages made by others: the reference library's own fixtures,
//! and malformed messages, each with the error that it must give.
//!
//! The vectors are not part of the project. `$NEEDLE_DATA/openigtlink/vectors.txt` has one message a line:
//! `pos|neg name hex`.

use crate::support::needed::data;
use needle_bench::tracker::openigtlink::{
    Body, DecodeError, Message, Quaternion, StreamDecoder, encode, tool_kind,
};

struct Vector {
    positive: bool,
    name: String,
    bytes: Vec<u8>,
}

/// The vectors, or `None` without the folder of data.
fn vectors() -> Option<Vec<Vector>> {
    let text = std::fs::read_to_string(data("openigtlink/vectors.txt")?).expect("a text");
    let vector = |line: &str| {
        let mut fields = line.split_whitespace();
        let (kind, name, hex) = (fields.next()?, fields.next()?, fields.next()?);
        let bytes = (0..hex.len())
            .step_by(2)
            .map(|at| u8::from_str_radix(hex.get(at..at + 2)?, 16).ok())
            .collect::<Option<_>>()?;
        Some(Vector { positive: kind == "pos", name: name.to_owned(), bytes })
    };
    Some(text.lines().map(|line| vector(line).expect("pos|neg name hex")).collect())
}

/// Reads the message that `bytes` start with.
pub(crate) fn decode(bytes: &[u8]) -> Result<Message, DecodeError> {
    let mut decoder = StreamDecoder::default();
    decoder.push(bytes);
    match decoder.poll()? {
        Some(message) => Ok(message),
        None => Err(decoder.finish().expect_err("no whole message")),
    }
}

#[test]
fn fixtures_of_the_reference_library_are_read_and_written_the_same() {
    let Some(vectors) = vectors() else { return };
    let (mut seen, mut read) = (0, 0);
    for Vector { name, bytes, .. } in vectors.iter().filter(|vector| vector.positive) {
        seen += 1;
        let message = decode(bytes).unwrap_or_else(|error| panic!("{name}: {error}"));
        if matches!(message.body, Body::Other(_)) {
            continue;
        }
        read += 1;
        if !name.ends_with("Format2") {
            assert_eq!(&encode(&message), bytes, "{name}");
        }
        assert_eq!(message.device_name, "DeviceName");
        match (&message.body, name.trim_end_matches("Format2")) {
            (Body::Transform(m), "transform") => {
                assert!((m[0] + 0.954_892).abs() < 1e-6 && (m[9] - 46.0531).abs() < 1e-4);
            }
            (Body::Position { position_mm, quaternion: Quaternion::Full(_) }, "position") => {
                assert!((position_mm[0] - 46.0531).abs() < 1e-4);
            }
            (Body::TrackingData(tools), "tdata") => {
                assert_eq!(tools.len(), 3);
                for (i, tool) in tools.iter().enumerate() {
                    assert_eq!(
                        (tool.name.clone(), tool.kind),
                        (format!("Tracker{i}"), tool_kind::SIX_D)
                    );
                    assert!((tool.pose[0] + 0.954_892).abs() < 1e-6);
                    assert!((tool.pose[9] - 46.0531).abs() < 1e-4);
                }
            }
            (Body::Status(status), "status") => {
                assert_eq!((status.code, status.subcode), (15, 10));
                assert_eq!(status.error_name, "ACTUATOR_DISABLED");
                assert_eq!(status.message, "Actuator A is disabled.");
            }
            (body, _) => panic!("{name} read as {}", body.type_name()),
        }
        if name.ends_with("Format2") {
            assert_eq!(message.metadata("First patient age"), Some("22"));
            assert_eq!(message.metadata("Second patient age"), Some("25"));
        }
    }
    assert!(seen >= 24 && read >= 7, "{read} of {seen} fixtures");
}

#[test]
fn all_fixtures_in_one_stream_come_out_in_order() {
    let Some(vectors) = vectors() else { return };
    let fixtures: Vec<_> = vectors.iter().filter(|vector| vector.positive).collect();
    let stream: Vec<u8> = fixtures.iter().flat_map(|vector| vector.bytes.clone()).collect();
    let mut decoder = StreamDecoder::default();
    let mut messages = Vec::new();
    for chunk in stream.chunks(97) {
        decoder.push(chunk);
        while let Some(message) = decoder.poll().expect("well formed") {
            messages.push(message);
        }
    }
    let expected: Vec<_> =
        fixtures.iter().map(|vector| decode(&vector.bytes).expect("well formed")).collect();
    assert_eq!(messages, expected);
}

#[test]
fn malformed_messages_are_refused_with_the_right_error() {
    let Some(vectors) = vectors() else { return };
    let mut refused = 0;
    for Vector { name, bytes, .. } in vectors.iter().filter(|vector| !vector.positive) {
        // The decoder skips the content of the other types.
        let skipped = name.starts_with("content_")
            && !["content_transform", "content_position"].iter().any(|read| name.starts_with(read));
        let error = match decode(bytes) {
            Ok(message) if skipped => {
                assert!(matches!(message.body, Body::Other(_)), "{name}");
                continue;
            }
            Ok(_) => panic!("{name} was accepted"),
            Err(error) => error,
        };
        refused += 1;
        let text = error.to_string();
        let says = |word: &str| text.contains(word);
        let right = match () {
            () if says("it was cut off") || says(": body of ") => "[SHORT_BUFFER]",
            () if says(": CRC ") => "[CRC_MISMATCH]",
            () => "[MALFORMED]",
        };
        assert!(name.ends_with(right), "{name}: {error}");
    }
    assert!(refused >= 17, "{refused} refused");
}
