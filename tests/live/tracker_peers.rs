//! The tracker link and server against pyigtl, as server and as client.

use crate::support::peers::{peer, serving_peer};
use crate::support::programs::beside_others;
use needle_bench::tracker::openigtlink::{Body, IgtlStamp, Message};
use needle_bench::tracker::{Event, Sample};
use needle_bench::transport::link::{Link, LinkSettings};
use needle_bench::transport::tcp::TransformServer;
use needle_bench::units::Time;
use std::time::{Duration, Instant};
use tokio::net::TcpListener;
use tokio::runtime::Runtime;
use tokio::time::timeout;

const HANGING: Duration = Duration::from_secs(30);

fn runtime() -> Runtime {
    tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime")
}

fn clock() -> impl Fn() -> Time {
    let start = Instant::now();
    move || Time::ZERO + start.elapsed()
}

/// The next `count` samples of a link.
async fn samples(link: &mut Link, count: usize) -> Vec<Sample> {
    let mut samples = Vec::new();
    while samples.len() < count {
        match timeout(HANGING, link.next()).await.expect("samples").expect("the link runs") {
            Event::Sample(sample) => samples.push(sample),
            Event::Malformed(error) => panic!("{error}"),
            Event::Disconnected { reason } => panic!("{reason}"),
            _ => {}
        }
    }
    samples
}

#[test]
fn tip_positions_that_pyigtl_serves_arrive() {
    let _machine = beside_others();
    let args = ["--port", "0", "--device", "NeedleToTracker", "--rate", "100", "--duration", "60"];
    let Some((_server, port)) = serving_peer("pyigtl_server.py", &args) else { return };
    let samples = runtime().block_on(async {
        let address = format!("127.0.0.1:{port}");
        let mut link = Link::connect(&address, LinkSettings::default(), clock());
        samples(&mut link, 30).await
    });
    for sample in &samples {
        assert_eq!(sample.tool, "NeedleToTracker");
        // On the arc of radius 122 mm about (122, 0, 0), in single precision.
        let p_mm = sample.position_mm;
        assert!(((p_mm.x - 122.0).hypot(p_mm.z) - 122.0).abs() < 1e-4 && p_mm.y == 0.0, "{p_mm}");
        let r = sample.orientation.expect("a rotation").to_rotation_matrix();
        let angle_rad = r.matrix()[(0, 2)].atan2(r.matrix()[(2, 2)]);
        assert!((angle_rad - p_mm.z.atan2(122.0 - p_mm.x)).abs() < 1e-5);
    }
    for pair in samples.windows(2) {
        assert!(pair[0].source_unix_ns < pair[1].source_unix_ns, "stamps do not rise");
        assert!(pair[0].position_mm.z < pair[1].position_mm.z, "the needle stands");
        assert!(pair[0].receive_time <= pair[1].receive_time);
    }
}

#[test]
fn pyigtl_reads_what_the_bench_serves() {
    let _machine = beside_others();
    let runtime = runtime();
    let server = runtime.block_on(TransformServer::bind("127.0.0.1:0")).expect("loopback");
    let port = server.local_addr().port().to_string();
    let args = ["--port", &port, "--device", "NeedleToTracker", "--count", "5"];
    let Some(mut client) = peer("pyigtl_client.py", &args) else { return };

    // pyigtl keeps only the newest message, so messages are sent until it has five.
    let message = |sent: u32| {
        let x_mm = sent as f32;
        let turned = [0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, x_mm, -2.5, 100.25];
        let stamp = IgtlStamp::from_unix_ns(1_700_000_000_000_000_000 + i64::from(sent));
        Message::new("NeedleToTracker", stamp, Body::Transform(turned))
    };
    runtime.block_on(async {
        let mut period = tokio::time::interval(Duration::from_millis(10));
        let serve = async {
            for sent in 1.. {
                period.tick().await;
                server.send(&message(sent));
                if client.has_ended() {
                    return;
                }
            }
        };
        timeout(HANGING, serve).await.expect("the client has five messages");
    });
    let ended = client.end();
    ended.assert_status(0);
    assert_eq!(ended.stdout.lines().count(), 5, "{}", ended.stdout);
    let mut last_x_mm = 0.0;
    for line in ended.stdout.lines() {
        let json: serde_json::Value = serde_json::from_str(line).expect("JSON");
        assert_eq!(json["device"], "NeedleToTracker");
        let x_mm = json["position_mm"][0].as_f64().expect("a number");
        assert!(x_mm > last_x_mm, "{line}");
        last_x_mm = x_mm;
        assert_eq!(json["position_mm"][1], -2.5);
        assert_eq!(json["position_mm"][2], 100.25);
        assert_eq!(json["rotation"].to_string(), "[[0.0,-1.0,0.0],[1.0,0.0,0.0],[0.0,0.0,1.0]]");
        let stamp_s = json["timestamp_s"].as_f64().expect("a number");
        assert!((stamp_s - 1.7e9).abs() < 1e-3, "{line}");
    }
}

#[test]
fn positions_that_pyigtl_pushes_as_a_client_arrive() {
    let _machine = beside_others();
    let runtime = runtime();
    let _in_runtime = runtime.enter();
    let listener = runtime.block_on(TcpListener::bind("127.0.0.1:0")).expect("loopback");
    let port = listener.local_addr().expect("bound").port().to_string();
    let mut link = Link::listen(listener, LinkSettings::default(), clock());
    let args = ["--port", &port, "--device", "StylusToTracker"];
    let Some(_client) = peer("pyigtl_push.py", &args) else { return };
    for sample in runtime.block_on(samples(&mut link, 5)) {
        assert_eq!(sample.tool, "StylusToTracker");
        assert_eq!(sample.position_mm.as_slice(), [1.5, -2.5, 100.25]);
        assert!(sample.source_unix_ns.is_some());
    }
}
