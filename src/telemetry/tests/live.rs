//! The live view, and viewers that do what they like.

use super::*;
use std::io::{Read as _, Write as _};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::time::Instant;

/// An address nobody listens at.
fn free() -> SocketAddr {
    TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap().local_addr().unwrap()
}

/// A viewer by its first words: HTTP/2, settings, and a request for the messages of the run.
/// From then on it reads nothing and answers nothing.
fn frozen_viewer(address: SocketAddr) -> TcpStream {
    let deadline = Instant::now() + Duration::from_secs(30);
    let mut viewer = loop {
        match TcpStream::connect(address) {
            Ok(viewer) => break viewer,
            Err(error) if Instant::now() > deadline => panic!("{address}: {error}"),
            Err(_) => std::thread::yield_now(),
        }
    };
    viewer.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n").unwrap();
    viewer.write_all(&[0, 0, 0, 4, 0, 0, 0, 0, 0]).unwrap();
    let mut settings = [0; 9];
    viewer.read_exact(&mut settings).unwrap();
    // The server's SETTINGS: it listens, and knows us for a viewer.
    assert_eq!(settings[3], 4);
    viewer.write_all(&request()).unwrap();
    viewer
}

/// HEADERS of a gRPC call without Huffman coding (RFC 7541, 6.2.2), and an empty message.
fn request() -> Vec<u8> {
    let mut block = Vec::new();
    for (name, value) in [
        (":method", "POST"),
        (":scheme", "http"),
        (":path", "/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages"),
        (":authority", "localhost"),
        ("content-type", "application/grpc"),
        ("te", "trailers"),
    ] {
        block.push(0);
        for text in [name, value] {
            block.push(text.len() as u8);
            block.extend(text.as_bytes());
        }
    }
    let frame = |kind: u8, flags: u8, payload: &[u8]| {
        let [_, a, b, c] = (payload.len() as u32).to_be_bytes();
        [&[a, b, c, kind, flags, 0, 0, 0, 1], payload].concat()
    };
    [frame(1, 4, &block), frame(0, 1, &[0; 5])].concat()
}

#[test]
fn a_frozen_viewer_is_nothing_to_the_record() {
    let scratch = Scratch::new("live");
    let address = free();
    let mut recorder = Recorder::create(&scratch.0, run_info(), Backpressure::Block).unwrap();
    recorder.serve(address).unwrap();
    let _viewer = frozen_viewer(address);
    let entries = synthetic::run(30, 20);
    for entry in entries.clone() {
        recorder.record(entry);
    }
    assert!(recorder.news().is_none());
    let finished = recorder.finish(&Outcome::Completed, Summary::default()).unwrap();
    assert_eq!(finished.faults, Vec::<String>::new());
    assert_eq!((finished.dropped.text_files, finished.dropped.recording), (0, 0));
    let alone = record(&scratch.0.join("alone"), entries);
    assert_eq!(finished.counts, alone.counts);
    let steps = |finished: &Finished| fs::read(finished.run_dir.join("steps.csv")).unwrap();
    assert_eq!(steps(&finished), steps(&alone));
}

#[test]
fn a_port_that_is_taken_is_refused_before_the_run() {
    let scratch = Scratch::new("live-taken");
    let taken = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let address = taken.local_addr().unwrap();
    let mut recorder = Recorder::create(&scratch.0, run_info(), Backpressure::Block).unwrap();
    let error = recorder.serve(address).unwrap_err().to_string();
    assert!(error.starts_with(&format!("--live: {address}: ")), "{error}");
}
