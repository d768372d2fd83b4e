//! A viewer that connects and then reads nothing.

use crate::support::programs::LONG;
use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::thread;
use std::time::{Duration, Instant};

/// Connects as a viewer: HTTP/2 preface, settings, and a request for the messages of the run. After that it reads
/// and answers nothing.
pub(crate) fn frozen_viewer(address: SocketAddr) -> TcpStream {
    let deadline = Instant::now() + LONG;
    let mut viewer = loop {
        match TcpStream::connect(address) {
            Ok(viewer) => break viewer,
            Err(error) if Instant::now() > deadline => panic!("{address}: {error}"),
            Err(_) => thread::sleep(Duration::from_millis(1)),
        }
    };
    viewer.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n").unwrap();
    viewer.write_all(&[0, 0, 0, 4, 0, 0, 0, 0, 0]).unwrap();
    let mut settings = [0; 9];
    viewer.read_exact(&mut settings).unwrap();
    // The server's SETTINGS: it has accepted a viewer.
    assert_eq!(settings[3], 4);
    viewer.write_all(&request()).unwrap();
    viewer
}

/// HEADERS of a gRPC call without Huffman coding (RFC 7541, 6.2.2), and DATA with an empty message.
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
