//! The tracker's connection against the reference library's own example programs, as Debian's
//! package `openigtlink-examples` has them: servers of every message type that carries positions,
//! and a client that prints what the bench's server sends.

use crate::support::needed::skip;
use crate::support::programs::beside_others;
use needle_bench::tracker::openigtlink::{
    Body, IgtlStamp, Message, Quaternion, Status, Tool, ToolStream, tool_kind,
};
use needle_bench::tracker::{Event, Sample, Validity};
use needle_bench::transport::link::{Link, LinkSettings};
use needle_bench::transport::tcp::TransformServer;
use needle_bench::units::Time;
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tokio::runtime::Runtime;
use tokio::time::timeout;

const HANGING: Duration = Duration::from_secs(60);

/// A program of the examples, ended with the test.
struct Peer(Child);

impl Peer {
    /// Starts it where its folder is named.
    fn start(program: &str, args: &[&str]) -> Option<Peer> {
        let Some(folder) = std::env::var_os("NEEDLE_PEERS_OPENIGTLINK") else {
            let remedy =
                "set NEEDLE_PEERS_OPENIGTLINK to the folder that tests/run.sh builds them in";
            skip("OpenIGTLink examples", remedy);
            return None;
        };
        let program = Path::new(&folder).join(program);
        let child = Command::new(&program)
            .args(args)
            .stderr(Stdio::piped())
            .spawn()
            .unwrap_or_else(|error| panic!("{}: {error}", program.display()));
        Some(Peer(child))
    }

    /// What it prints, up to and with a line that holds `last`.
    fn lines(&mut self, last: &str) -> Vec<String> {
        let stderr = self.0.stderr.take().expect("piped");
        let mut lines = Vec::new();
        for line in BufReader::new(stderr).lines() {
            lines.push(line.expect("text"));
            if lines.last().is_some_and(|line| line.contains(last)) {
                return lines;
            }
        }
        panic!("no line with {last:?} in {lines:#?}")
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn runtime() -> Runtime {
    tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap()
}

/// A port that nobody listens on: the programs cannot be asked for the one they chose.
fn free_port() -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").expect("loopback");
    listener.local_addr().expect("bound").port()
}

/// The events of the server `program` until `wanted` are samples or statuses.
fn served(
    program: &str,
    more_args: &[&str],
    request: Option<ToolStream>,
    wanted: usize,
) -> Option<Vec<Event>> {
    let port = free_port();
    let port_arg = port.to_string();
    let args = [&[&port_arg[..]], more_args].concat();
    let _server = Peer::start(program, &args)?;
    let settings = LinkSettings { request, ..LinkSettings::default() };
    let start = Instant::now();
    let runtime = runtime();
    let _in_runtime = runtime.enter();
    let clock = move || Time::ZERO + start.elapsed();
    let mut link = Link::connect(&format!("127.0.0.1:{port}"), settings, clock);
    let mut events = Vec::new();
    while events.len() < wanted {
        let event = runtime.block_on(async { timeout(HANGING, link.next()).await });
        match event.expect("in time").expect("the link runs") {
            event @ (Event::Sample(_) | Event::Status { .. }) => events.push(event),
            Event::Malformed(error) => panic!("{error}"),
            Event::Disconnected { reason } => panic!("{reason}"),
            _ => {}
        }
    }
    Some(events)
}

fn samples(events: Vec<Event>) -> Vec<Sample> {
    let sample = |event| match event {
        Event::Sample(sample) => sample,
        other => panic!("{other:?}"),
    };
    events.into_iter().map(sample).collect()
}

/// All of them send points of one circle, 50 (cos φ, sin φ, cos φ) mm.
fn assert_on_the_circle(sample: &Sample) {
    let p_mm = sample.position_mm;
    assert!((p_mm.x.hypot(p_mm.y) - 50.0).abs() < 1e-4 && p_mm.x == p_mm.z, "{p_mm}");
    assert_eq!(sample.validity, Validity::Valid);
}

#[test]
fn positions_of_the_tracker_server_arrive() {
    let _machine = beside_others();
    let Some(events) = served("TrackerServer2", &["200"], None, 30) else { return };
    let samples = samples(events);
    for sample in &samples {
        assert_eq!(sample.tool, "Tracker");
        assert_on_the_circle(sample);
        // Its quaternion is 0.88 long, which says nothing.
        assert!(sample.orientation.is_some());
    }
    for pair in samples.windows(2) {
        let step_rad = (pair[0].position_mm.xy()).angle(&pair[1].position_mm.xy());
        assert!((step_rad - 0.2).abs() < 1e-4, "each is the next: {step_rad}");
    }
}

/// These servers send nothing until they are asked to.
#[test]
fn a_stream_that_is_asked_for_arrives() {
    let _machine = beside_others();
    let streams = [("TrackingDataServer", "TDATA"), ("QuaternionTrackingDataServer", "QTDATA")];
    for (program, name) in streams {
        let request = ToolStream { name, period_ms: 5 };
        let Some(events) = served(program, &[], Some(request), 60) else { return };
        let samples = samples(events);
        for message in samples.chunks(3) {
            let names: Vec<&str> = message.iter().map(|sample| sample.tool.as_str()).collect();
            assert_eq!(names, ["Channel 0", "Channel 1", "Channel 2"], "{program}");
            message.iter().for_each(assert_on_the_circle);
        }
        let angle_rad = |sample: &Sample| sample.position_mm.y.atan2(sample.position_mm.x);
        let step_rad = angle_rad(&samples[4]) - angle_rad(&samples[1]);
        assert!((step_rad - 0.2).abs() < 1e-4, "{program}: channel 1 turns by {step_rad}");
    }
}

#[test]
fn statuses_of_the_status_server_arrive() {
    let _machine = beside_others();
    let Some(events) = served("StatusServer", &[], None, 2) else { return };
    for event in events {
        let Event::Status { device, status } = event else { panic!("{event:?}") };
        assert_eq!((device.as_str(), status.code, status.subcode), ("Device", 1, 128));
        assert_eq!(status.error_name, "OK!");
        assert_eq!(status.message, "This is a test to send status message.");
    }
}

#[test]
fn what_the_bench_serves_is_printed_by_the_receiving_client() {
    let _machine = beside_others();
    let runtime = runtime();
    let server = runtime.block_on(TransformServer::bind("127.0.0.1:0")).expect("loopback");
    let port = server.local_addr().port().to_string();
    let Some(mut client) = Peer::start("ReceiveClient", &["127.0.0.1", &port]) else { return };
    let wait = async {
        while server.clients() == 0 {
            tokio::task::yield_now().await;
        }
    };
    runtime.block_on(async { timeout(HANGING, wait).await }).expect("it connects");

    let turned = [0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 12.5, -3.25, 100.0];
    let tool = |name: &str| Tool { name: name.to_owned(), kind: tool_kind::SIX_D, pose: turned };
    let quaternion = Tool {
        name: "NeedleToTracker".to_owned(),
        kind: tool_kind::FIVE_D,
        pose: [1.5, 2.0, 3.0, 0.5, -0.5, 0.5, 0.5],
    };
    let status = Status {
        code: Status::OK,
        subcode: -7,
        error_name: "FINE".to_owned(),
        message: "tracking".to_owned(),
    };
    let position = Body::Position {
        position_mm: [1.5, 2.0, 3.0],
        quaternion: Quaternion::Full([0.5, -0.5, 0.5, 0.5]),
    };
    let bodies = [
        Body::Transform(turned),
        position,
        Body::TrackingData(vec![tool("NeedleToTracker"), tool("ReferenceToTrackerBase")]),
        Body::QuaternionTrackingData(vec![quaternion]),
        Body::Status(status),
    ];
    let stamp = IgtlStamp::from_unix_ns(1_700_000_000_250_000_000);
    for body in bodies {
        server.send(&Message::new("Needle", stamp, body));
    }

    // It checks the sums itself, and prints nothing of a message whose sum is wrong.
    let printed = client.lines(" Status    : ").join("\n");
    let expected = [
        "Time stamp: 1700000000.25",
        "Receiving TRANSFORM data type.",
        "position   = (1.5, 2, 3)\nquaternion = (0.5, -0.5, 0.5, 0.5)",
        " Name       : NeedleToTracker\n Type       : 2",
        " Name       : ReferenceToTrackerB\n",
        "Receiving QTDATA data type.",
        " Name       : NeedleToTracker\n Type       : 4",
        " SubCode   : -7\n Error Name: FINE\n Status    : tracking",
    ];
    for part in expected {
        assert!(printed.contains(part), "no {part:?} in\n{printed}");
    }
}
