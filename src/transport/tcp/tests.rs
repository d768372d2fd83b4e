//! Links and servers against each other and against bare sockets, on the loopback. The timeouts here only end a
//! test that hangs.

use super::*;
use crate::tracker::openigtlink::{
    Body, Message, Quaternion, Status, Tool, ToolStream, encode, get_status, tool_kind,
};
use crate::tracker::{Event, Protocol};
use crate::transport::link::{Link, LinkSettings};
use crate::units::Time;
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use std::net::SocketAddr;
use std::process::Command;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::time::timeout;

const HANGING: Duration = Duration::from_secs(20);
const NOW: Time = Time::from_nanos(42);

fn clock() -> Time {
    NOW
}

fn quick() -> LinkSettings {
    LinkSettings { retry_first: Duration::from_millis(1), ..LinkSettings::default() }
}

fn position(tool: &str, x_mm: f32) -> Message {
    let position_mm = [x_mm, 0.0, 0.0];
    Message::new(tool, None, Body::Position { position_mm, quaternion: Quaternion::Absent })
}

async fn next(link: &mut Link) -> Event {
    timeout(HANGING, link.next()).await.expect("an event").expect("the link runs")
}

/// Takes events until `wanted` returns a value.
async fn until<T>(link: &mut Link, wanted: impl Fn(&Event) -> Option<T>) -> T {
    loop {
        if let Some(found) = wanted(&next(link).await) {
            return found;
        }
    }
}

fn disconnected(event: &Event) -> Option<String> {
    match event {
        Event::Disconnected { reason } => Some(reason.clone()),
        _ => None,
    }
}

/// A link connected to a peer on a bare socket.
async fn bare_peer(settings: LinkSettings) -> (Link, TcpStream, SocketAddr) {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("loopback");
    let address = listener.local_addr().expect("bound");
    let link = Link::connect(&address.to_string(), settings, clock);
    let (stream, _) = listener.accept().await.expect("the link connects");
    (link, stream, address)
}

async fn clients(server: &TransformServer, wanted: usize) {
    let wait = async {
        while server.clients() != wanted {
            tokio::task::yield_now().await;
        }
    };
    timeout(HANGING, wait).await.expect("clients come and go");
}

#[tokio::test]
async fn a_served_position_arrives_with_its_tool_and_time() {
    let server = TransformServer::bind("127.0.0.1:0").await.expect("loopback");
    let mut link = Link::connect(&server.local_addr().to_string(), quick(), clock);
    clients(&server, 1).await;
    assert_eq!(server.send(&position("Needle", 1.5)), 1);
    let peer = server.local_addr().to_string();
    assert_eq!(next(&mut link).await, Event::Connected { peer });
    let (tool, message_type) = ("Needle".to_owned(), "POSITION".to_owned());
    assert_eq!(next(&mut link).await, Event::SawTool { tool, message_type });
    match next(&mut link).await {
        Event::Sample(sample) => {
            assert_eq!((sample.position_mm.x, sample.receive_time), (1.5, NOW));
        }
        other => panic!("{other:?}"),
    }
    assert_eq!(link.dropped(), 0);
}

#[tokio::test]
async fn every_client_is_served_and_one_that_falls_behind_is_dropped() {
    let server = TransformServer::bind("127.0.0.1:0").await.expect("loopback");
    let address = server.local_addr().to_string();
    let mut links =
        [Link::connect(&address, quick(), clock), Link::connect(&address, quick(), clock)];
    clients(&server, 2).await;
    server.send(&position("Needle", 1.0));
    for link in &mut links {
        until(link, |event| matches!(event, Event::Sample(_)).then_some(())).await;
    }
    // The only runtime thread runs this loop, so nothing is sent meanwhile and every client falls behind.
    for _ in 0..=TransformServer::BACKLOG {
        server.send(&position("Needle", 2.0));
    }
    for link in &mut links {
        until(link, disconnected).await;
        until(link, |event| matches!(event, Event::Connected { .. }).then_some(())).await;
    }
    drop(links);
    clients(&server, 0).await;
    assert_eq!(server.send(&position("Needle", 3.0)), 0);
}

#[tokio::test]
async fn the_link_reconnects_to_a_server_that_comes_back() {
    let server = TransformServer::bind("127.0.0.1:0").await.expect("loopback");
    let address = server.local_addr().to_string();
    let mut link = Link::connect(&address, quick(), clock);
    clients(&server, 1).await;
    drop(server);
    let reason = until(&mut link, disconnected).await;
    assert!(reason.starts_with(&format!("tracker: {address} closed the connection")), "{reason}");
    let reason = until(&mut link, |event| match event {
        Event::Unreachable { reason } => Some(reason.clone()),
        _ => None,
    });
    let reason = reason.await;
    assert!(
        reason.starts_with(&format!("tracker: cannot connect to {address}: Connection refused")),
        "{reason}"
    );
    let _server = TransformServer::bind(&address).await.expect("the port is free again");
    until(&mut link, |event| matches!(event, Event::Connected { .. }).then_some(())).await;
}

#[tokio::test]
async fn a_connection_of_another_protocol_is_dropped_with_the_reason() {
    let (mut link, mut peer, address) = bare_peer(quick()).await;
    let page = [b'x'; 100];
    peer.write_all(&page).await.expect("sent");
    assert_eq!(
        until(&mut link, disconnected).await,
        format!(
            "tracker: {address} dropped: openigtlink: header version 30840 (1 or 2 expected); is \
             that port an OpenIGTLink server?"
        )
    );
}

#[tokio::test]
async fn a_malformed_message_is_reported_and_the_next_is_read() {
    let (mut link, mut peer, _) = bare_peer(quick()).await;
    let mut wrong = encode(&position("Needle", 1.0));
    wrong[2..14].copy_from_slice(b"TRANSFORM\0\0\0"); // 12 bytes where 48 are due
    peer.write_all(&wrong).await.expect("sent");
    peer.write_all(&encode(&position("Needle", 2.0))).await.expect("sent");
    let problem = until(&mut link, |event| match event {
        Event::Malformed(error) => Some(error.to_string()),
        _ => None,
    });
    assert_eq!(
        problem.await,
        "openigtlink: TRANSFORM \"Needle\": content of 12 bytes (48 expected)"
    );
    let x_mm = until(&mut link, |event| match event {
        Event::Sample(sample) => Some(sample.position_mm.x),
        _ => None,
    });
    assert_eq!(x_mm.await, 2.0);
}

#[tokio::test]
async fn a_status_is_passed_on_and_a_message_cut_off_is_reported() {
    let (mut link, mut peer, address) = bare_peer(quick()).await;
    let status = Status {
        code: Status::OK,
        subcode: 0,
        error_name: String::new(),
        message: "tracking".to_owned(),
    };
    let message = encode(&Message::new("Server", None, Body::Status(status.clone())));
    peer.write_all(&message).await.expect("sent");
    peer.write_all(&message[..70]).await.expect("sent");
    drop(peer);
    let got = until(&mut link, |event| match event {
        Event::Status { device, status } => Some((device.clone(), status.clone())),
        _ => None,
    });
    assert_eq!(got.await, ("Server".to_owned(), status));
    assert_eq!(
        until(&mut link, disconnected).await,
        format!(
            "tracker: {address} closed the connection: openigtlink: 70 bytes of a message of {}; \
             it was cut off",
            message.len()
        )
    );
}

#[tokio::test]
async fn samples_that_overflow_the_queue_are_dropped_and_counted() {
    let settings = LinkSettings { queue: 8, ..quick() };
    let (mut link, mut peer, _) = bare_peer(settings).await;
    for x_mm in 0..100u8 {
        peer.write_all(&encode(&position("Needle", f32::from(x_mm)))).await.expect("sent");
    }
    // Of the eight places, two hold the connection and the tool's name.
    let wait = async {
        while link.dropped() < 94 {
            tokio::task::yield_now().await;
        }
    };
    timeout(HANGING, wait).await.expect("the reader goes on");
    drop(peer);
    let mut samples = 0;
    while disconnected(&next(&mut link).await).is_none() {
        samples += 1;
    }
    assert_eq!((samples, link.dropped()), (8, 94));
}

#[tokio::test]
async fn the_link_reconnects_to_a_silent_server() {
    let settings = LinkSettings { silence_limit: Duration::from_millis(20), ..quick() };
    let (mut link, _silent, address) = bare_peer(settings).await;
    assert_eq!(
        until(&mut link, disconnected).await,
        format!("tracker: nothing from {address} for 20ms; reconnecting")
    );
}

/// A server such as PLUS sends nothing while its tool is out of view, and answers GET_STATUS.
#[tokio::test]
async fn a_silent_server_that_answers_a_status_request_keeps_its_connection() {
    let settings = LinkSettings { silence_limit: Duration::from_secs(1), ..quick() };
    let (mut link, mut peer, address) = bare_peer(settings).await;
    let ok = |message: &str| {
        let (error_name, message) = (String::new(), message.to_owned());
        let status = Status { code: Status::OK, subcode: 0, error_name, message };
        encode(&Message::new("Server", None, Body::Status(status)))
    };
    let ask = get_status();
    for _ in 0..2 {
        assert_eq!(received(&mut peer, ask.len()).await, ask);
        peer.write_all(&ok("")).await.expect("sent");
    }
    // Neither an answer with a text nor a status that comes unasked is an answer only.
    assert_eq!(received(&mut peer, ask.len()).await, ask);
    peer.write_all(&[ok("tracking"), ok("")].concat()).await.expect("sent");
    assert_eq!(next(&mut link).await, Event::Connected { peer: address.to_string() });
    assert!(matches!(next(&mut link).await, Event::SawTool { .. }));
    for text in ["tracking", ""] {
        match next(&mut link).await {
            Event::Status { status, .. } => assert_eq!(status.message, text),
            other => panic!("{other:?}"),
        }
    }
    // The server does not answer again.
    assert_eq!(received(&mut peer, ask.len()).await, ask);
    let silent = format!("tracker: nothing from {address} for 1s; reconnecting");
    assert_eq!(until(&mut link, disconnected).await, silent);
}

/// A peer that closes with unread requests resets the connection.
#[tokio::test]
async fn a_reset_by_the_peer_ends_the_connection_like_its_close() {
    let (mut link, mut peer, address) = bare_peer(quick()).await;
    peer.write_all(&encode(&position("Needle", 1.0))).await.expect("sent");
    // Wait for the request, without reading it.
    let unread = get_status().len();
    let mut bytes = vec![0; unread];
    while timeout(HANGING, peer.peek(&mut bytes)).await.expect("in time").expect("bytes") < unread {
    }
    drop(peer);
    assert_eq!(until(&mut link, tool_of_sample).await, "Needle");
    let reason = until(&mut link, disconnected).await;
    assert_eq!(reason, format!("tracker: {address} closed the connection"));
}

/// The next `len` bytes that a peer receives.
async fn received(peer: &mut TcpStream, len: usize) -> Vec<u8> {
    let mut bytes = vec![0; len];
    timeout(HANGING, peer.read_exact(&mut bytes)).await.expect("in time").expect("as many bytes");
    bytes
}

#[tokio::test]
async fn a_stream_is_requested_at_the_start_and_stopped_at_the_end() {
    for name in ["TDATA", "QTDATA"] {
        let request = ToolStream { name, period_ms: 25 };
        let settings = LinkSettings { request: Some(request), ..quick() };
        let (mut link, mut peer, _) = bare_peer(settings).await;
        let (start, ask) = (request.start(), get_status());
        assert_eq!(received(&mut peer, start.len()).await, start);
        assert_eq!(received(&mut peer, ask.len()).await, ask);
        let tool = Tool { name: "Needle".to_owned(), kind: tool_kind::SIX_D, pose: [0.5; 12] };
        let tools = Message::new("Tracker", None, Body::TrackingData(vec![tool]));
        peer.write_all(&encode(&tools)).await.expect("sent");
        assert_eq!(until(&mut link, tool_of_sample).await, "Needle");
        drop(link);
        let stop = request.stop();
        assert_eq!(received(&mut peer, stop.len()).await, stop);
    }
}

#[tokio::test]
async fn lines_of_json_are_read_from_a_server_and_from_a_client() {
    let settings = LinkSettings { protocol: Protocol::Ndjson, ..quick() };
    let line = |tool: &str| format!("{{\"tool\":\"{tool}\",\"position_tracker_mm\":[1,2,3]}}\n");
    let (mut link, mut server, address) = bare_peer(settings.clone()).await;
    server.write_all(line("Server").as_bytes()).await.expect("sent");
    server.write_all(b"{\"tool\":").await.expect("sent");
    drop(server);
    assert_eq!(until(&mut link, tool_of_sample).await, "Server");
    assert_eq!(
        until(&mut link, disconnected).await,
        format!("tracker: {address} closed the connection")
    );
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("loopback");
    let address = listener.local_addr().expect("bound");
    let mut link = Link::listen(listener, settings, clock);
    let mut client = TcpStream::connect(address).await.expect("listening");
    client.write_all(format!("nonsense\n{}", line("Client")).as_bytes()).await.expect("sent");
    let problem = until(&mut link, |event| match event {
        Event::Malformed(error) => Some(error.to_string()),
        _ => None,
    });
    assert_eq!(problem.await, "ndjson: line 1: expected ident (column 2)");
    assert_eq!(until(&mut link, tool_of_sample).await, "Client");
}

async fn push(address: &str, message: &Message) -> TcpStream {
    let mut client = TcpStream::connect(address).await.expect("listening");
    client.write_all(&encode(message)).await.expect("sent");
    client
}

fn tool_of_sample(event: &Event) -> Option<String> {
    match event {
        Event::Sample(sample) => Some(sample.tool.clone()),
        _ => None,
    }
}

#[tokio::test]
async fn a_client_that_pushes_is_read_and_a_second_is_refused() {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("loopback");
    let address = listener.local_addr().expect("bound").to_string();
    let mut link = Link::listen(listener, quick(), clock);
    let first = push(&address, &position("First", 1.0)).await;
    assert_eq!(until(&mut link, tool_of_sample).await, "First");
    let mut second = TcpStream::connect(&address).await.expect("listening");
    let closed = timeout(HANGING, second.read(&mut [0; 1])).await.expect("refused");
    assert!(matches!(closed, Ok(0) | Err(_)));
    let turned_away = |event: &Event| match event {
        Event::TurnedAway { reason } => Some(reason.clone()),
        _ => None,
    };
    let reason = until(&mut link, turned_away).await;
    assert!(reason.contains("turned away: 127.0.0.1:"), "{reason}");
    drop(first);
    until(&mut link, disconnected).await;
    let _third = push(&address, &position("Third", 1.0)).await;
    assert_eq!(until(&mut link, tool_of_sample).await, "Third");
}

#[tokio::test]
async fn a_silent_client_gives_way_to_the_next() {
    let settings = LinkSettings { silence_limit: Duration::ZERO, ..quick() };
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("loopback");
    let address = listener.local_addr().expect("bound").to_string();
    let mut link = Link::listen(listener, settings, clock);
    let _first = push(&address, &position("First", 1.0)).await;
    assert_eq!(until(&mut link, tool_of_sample).await, "First");
    let _second = push(&address, &position("Second", 1.0)).await;
    let reason = until(&mut link, disconnected).await;
    assert!(reason.contains("took its place"), "{reason}");
    assert_eq!(until(&mut link, tool_of_sample).await, "Second");
}

/// No file descriptor is free when the second client connects. The limit applies to the process, so this test runs
/// again in a process of its own.
#[test]
fn a_silent_client_gives_way_although_a_connection_was_not_accepted() {
    const OF_ITS_OWN: &str = "NEEDLE_TEST_PROCESS";
    if std::env::var_os(OF_ITS_OWN).is_some() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        return runtime.expect("a runtime").block_on(a_client_without_a_file_descriptor());
    }
    let name = "a_silent_client_gives_way_although_a_connection_was_not_accepted";
    let output = Command::new(std::env::current_exe().expect("a program"))
        .args(["--exact", &format!("transport::tcp::tests::{name}")])
        .env(OF_ITS_OWN, "1")
        .output()
        .expect("started");
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success() && said.contains("1 passed"), "{said}");
}

async fn a_client_without_a_file_descriptor() {
    let settings = LinkSettings { silence_limit: Duration::ZERO, ..quick() };
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("loopback");
    let address = listener.local_addr().expect("bound");
    let mut link = Link::listen(listener, settings, clock);
    let _first = push(&address.to_string(), &position("First", 1.0)).await;
    assert_eq!(until(&mut link, tool_of_sample).await, "First");
    let second = TcpSocket::new_v4().expect("a socket");
    let (soft, hard) = getrlimit(Resource::RLIMIT_NOFILE).expect("a limit");
    setrlimit(Resource::RLIMIT_NOFILE, 0, hard).expect("lowered");
    let mut second = second.connect(address).await.expect("listening");
    // Meanwhile the link's task tries to accept the connection, and fails.
    tokio::time::sleep(Duration::from_millis(20)).await;
    setrlimit(Resource::RLIMIT_NOFILE, soft, hard).expect("as before");
    second.write_all(&encode(&position("Second", 1.0))).await.expect("sent");
    let reason = until(&mut link, disconnected).await;
    assert!(reason.contains("took its place"), "{reason}");
    assert_eq!(until(&mut link, tool_of_sample).await, "Second");
}

#[tokio::test]
async fn dropping_a_link_or_server_closes_its_connections() {
    let (link, mut peer, _) = bare_peer(quick()).await;
    drop(link);
    let closed = timeout(HANGING, peer.read(&mut [0; 1])).await.expect("closed");
    assert!(matches!(closed, Ok(0) | Err(_)));

    let server = TransformServer::bind("127.0.0.1:0").await.expect("loopback");
    let mut client = TcpStream::connect(server.local_addr()).await.expect("listening");
    clients(&server, 1).await;
    drop(server);
    let closed = timeout(HANGING, client.read(&mut [0; 1])).await.expect("closed");
    assert!(matches!(closed, Ok(0) | Err(_)));
}
