//! The tracker link against misbehaving servers. The link must deliver every position that was sent whole, report
//! what was wrong, and reconnect where it has to.
//!
//! The timeouts here only end a test that hangs.

use crate::support::programs::beside_others;
use needle_bench::tracker::Event;
use needle_bench::tracker::openigtlink::{Body, Message, Quaternion, Status, encode};
use needle_bench::transport::link::{Link, LinkSettings};
use needle_bench::units::Time;
use std::io::{self, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::thread;
use std::time::Duration;
use tokio::time::timeout;

const HANGING: Duration = Duration::from_secs(30);

fn position(x_mm: f32) -> Vec<u8> {
    let position_mm = [x_mm, 0.0, 0.0];
    let body = Body::Position { position_mm, quaternion: Quaternion::Absent };
    encode(&Message::new("Needle", None, body))
}

fn status_ok() -> Vec<u8> {
    let status =
        Status { code: Status::OK, subcode: 0, error_name: String::new(), message: String::new() };
    encode(&Message::new("Server", None, Body::Status(status)))
}

/// What a server does with a connection before it closes it.
type Treatment = fn(&mut TcpStream);

/// A server that treats its connections one after another in these ways.
fn server<const N: usize>(connections: [Treatment; N]) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").expect("loopback");
    let address = listener.local_addr().expect("bound");
    thread::spawn(move || {
        for treat in connections {
            let (mut stream, _) = listener.accept().expect("the link connects");
            stream.set_nodelay(true).expect("a socket");
            treat(&mut stream);
            // To close with unread requests would reset the connection, and lose what is still to be sent.
            let _ = stream.shutdown(Shutdown::Write);
            let _ = io::copy(&mut stream, &mut io::sink());
        }
    });
    address
}

fn send(stream: &mut TcpStream, bytes: &[u8]) {
    // The link may have closed the connection already, as it should.
    let _ = stream.write_all(bytes);
}

/// The events of the link up to the position at x = `last_mm`.
fn events_until(address: SocketAddr, last_mm: f64) -> Vec<Event> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let settings =
            LinkSettings { retry_first: Duration::from_millis(1), ..LinkSettings::default() };
        let mut link = Link::connect(&address.to_string(), settings, || Time::ZERO);
        let mut events = Vec::new();
        loop {
            let event =
                timeout(HANGING, link.next()).await.expect("in time").expect("the link runs");
            let last = matches!(&event, Event::Sample(sample) if sample.position_mm.x == last_mm);
            events.push(event);
            if last {
                return events;
            }
        }
    })
}

fn positions(events: &[Event]) -> Vec<f64> {
    let x_mm = |event: &Event| match event {
        Event::Sample(sample) => Some(sample.position_mm.x),
        _ => None,
    };
    events.iter().filter_map(x_mm).collect()
}

/// The reasons for which connections ended.
fn reasons(events: &[Event]) -> Vec<&str> {
    events
        .iter()
        .filter_map(|event| match event {
            Event::Disconnected { reason } => Some(reason.as_str()),
            _ => None,
        })
        .collect()
}

#[test]
fn messages_that_come_byte_by_byte_are_read() {
    let _machine = beside_others();
    let address = server([|stream: &mut TcpStream| {
        for byte in [position(1.0), status_ok(), position(2.0)].concat() {
            send(stream, &[byte]);
            thread::yield_now();
        }
    }]);
    assert_eq!(positions(&events_until(address, 2.0)), [1.0, 2.0]);
}

#[test]
fn a_message_cut_in_its_body_is_dropped_with_the_reason() {
    let _machine = beside_others();
    let cut = |stream: &mut TcpStream| {
        send(stream, &position(1.0));
        send(stream, &position(66.0)[..65]);
    };
    let whole = |stream: &mut TcpStream| send(stream, &position(2.0));
    let events = events_until(server([cut, whole]), 2.0);
    assert_eq!(positions(&events), [1.0, 2.0]);
    let reason = reasons(&events)[0];
    assert!(
        reason.ends_with("openigtlink: 65 bytes of a message of 70; it was cut off"),
        "{reason}"
    );
}

#[test]
fn a_header_that_announces_two_gigabytes_ends_the_connection() {
    let _machine = beside_others();
    let huge = |stream: &mut TcpStream| {
        let mut message = position(66.0);
        message[42..50].copy_from_slice(&(2u64 << 30).to_be_bytes());
        send(stream, &message);
    };
    let good = |stream: &mut TcpStream| send(stream, &position(1.0));
    let events = events_until(server([huge, good]), 1.0);
    assert_eq!(positions(&events), [1.0]);
    let reason = reasons(&events)[0];
    assert!(
        reason.ends_with(
            "openigtlink: POSITION \"Needle\": body of 2147483648 bytes (limit 1048576)"
        ),
        "{reason}"
    );
}

#[test]
fn statuses_before_a_position_keep_the_connection() {
    let _machine = beside_others();
    let address = server([|stream: &mut TcpStream| {
        (0..100).for_each(|_| send(stream, &status_ok()));
        send(stream, &position(1.0));
    }]);
    let events = events_until(address, 1.0);
    assert_eq!(positions(&events), [1.0]);
    let is_ok =
        |event: &&Event| matches!(event, Event::Status { status, .. } if status.code == Status::OK);
    // The first is taken for the answer to GET_STATUS.
    assert_eq!(events.iter().filter(is_ok).count(), 99);
    assert_eq!(reasons(&events), [] as [&str; 0], "the connection ended");
}

#[test]
fn garbage_ends_its_connection_and_the_next_connection_is_read() {
    let _machine = beside_others();
    let page = |stream: &mut TcpStream| send(stream, "HTTP/1.1 200 OK\r\n".repeat(8).as_bytes());
    let after_a_good_one = |stream: &mut TcpStream| {
        send(stream, &position(1.0));
        send(stream, &[0xA5; 4096]);
        send(stream, &position(66.0));
    };
    let flipped = |stream: &mut TcpStream| {
        let mut message = position(66.0);
        message[60] ^= 1;
        send(stream, &message);
    };
    let good = |stream: &mut TcpStream| send(stream, &position(2.0));
    let address = server([page, after_a_good_one, flipped, good]);
    let events = events_until(address, 2.0);
    assert_eq!(positions(&events), [1.0, 2.0]);
    let reasons = reasons(&events);
    assert_eq!(reasons.len(), 3);
    for (reason, part) in
        reasons.iter().zip(["header version 18516", "header version 42405", "CRC"])
    {
        assert!(reason.contains(part), "{reason}");
    }
}

#[test]
fn a_large_message_of_another_type_is_skipped() {
    let _machine = beside_others();
    let address = server([|stream: &mut TcpStream| {
        let mut image = encode(&Message::new("Probe", None, Body::Other("IMAGE".to_owned())));
        image[42..50].copy_from_slice(&(8u64 << 20).to_be_bytes());
        send(stream, &image);
        (0..128).for_each(|_| send(stream, &[7; 64 * 1024]));
        send(stream, &position(1.0));
    }]);
    assert_eq!(positions(&events_until(address, 1.0)), [1.0]);
}
