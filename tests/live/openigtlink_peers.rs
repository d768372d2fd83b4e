//! The tracker link against the example programs of the reference library, from Debian's package
//! `openigtlink-examples`: servers of every message type that carries positions, and a client that prints what the
//! bench's server sends.

use crate::support::needed::skip;
use crate::support::programs::{Program, beside_others, free_address};
use needle_bench::tracker::openigtlink::{
    Body, IgtlStamp, Message, Quaternion, Status, Tool, ToolStream, tool_kind,
};
use needle_bench::tracker::{Event, Sample, Validity};
use needle_bench::transport::link::{Link, LinkSettings};
use needle_bench::transport::tcp::TransformServer;
use needle_bench::units::Time;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};
use tokio::runtime::Runtime;
use tokio::time::timeout;

const HANGING: Duration = Duration::from_secs(60);

/// Starts an example program; `None` without the folder of the programs.
fn peer(program: &str, args: &[&str]) -> Option<Program> {
    let Some(folder) = std::env::var_os("NEEDLE_PEERS_OPENIGTLINK") else {
        let remedy = "set NEEDLE_PEERS_OPENIGTLINK to the folder that tests/run.sh builds them in";
        skip("OpenIGTLink examples", remedy);
        return None;
    };
    Some(Program::start(Command::new(Path::new(&folder).join(program)).args(args)))
}

fn runtime() -> Runtime {
    tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap()
}

/// The first `wanted` samples and statuses of the server `program`.
fn served(
    program: &str,
    more_args: &[&str],
    request: Option<ToolStream>,
    wanted: usize,
) -> Option<Vec<Event>> {
    // The programs cannot print a port that the system chose.
    let address = free_address();
    let port = address.port().to_string();
    let _server = peer(program, &[&[&port[..]], more_args].concat())?;
    let settings = LinkSettings { request, ..LinkSettings::default() };
    let start = Instant::now();
    let runtime = runtime();
    let _in_runtime = runtime.enter();
    let clock = move || Time::ZERO + start.elapsed();
    let mut link = Link::connect(&address.to_string(), settings, clock);
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

/// All servers send points of the circle 50 (cos φ, sin φ, cos φ) mm.
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
        // The server sends a quaternion of length 0.88, which the reader normalizes.
        assert!(sample.orientation.is_some());
    }
    for pair in samples.windows(2) {
        let step_rad = (pair[0].position_mm.xy()).angle(&pair[1].position_mm.xy());
        assert!((step_rad - 0.2).abs() < 1e-4, "not the next point: {step_rad} rad");
    }
}

/// These servers send nothing before a request.
#[test]
fn a_requested_stream_arrives() {
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
fn the_receiving_client_prints_every_message_that_the_bench_serves() {
    let _machine = beside_others();
    let runtime = runtime();
    let server = runtime.block_on(TransformServer::bind("127.0.0.1:0")).expect("loopback");
    let port = server.local_addr().port().to_string();
    let Some(mut client) = peer("ReceiveClient", &["127.0.0.1", &port]) else { return };
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

    // The client prints no message whose checksum is wrong.
    client.wait_for(" Status    : ");
    let printed = client.said();
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
