//! What the bench does at every millimetre, every frame and every message, and a whole run.
//!
//! `cargo bench --profile dev` prints criterion's figures, and before them the quantiles of single
//! steps. (Without the profile, all dependencies are built anew as for a release.)

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use nalgebra::Vector3;
use needle_bench::canopen::node::Identity;
use needle_bench::canopen::sdo::{SdoClient, SdoRequest};
use needle_bench::canopen::{NodeId, ObjectAddress};
use needle_bench::config::Config;
use needle_bench::control::Controller;
use needle_bench::control::{FeedbackLinearization, FeedbackLinearizationConfig};
use needle_bench::emulator::drive::{Drive, DriveConfig};
use needle_bench::emulator::{StageOutput, VirtualStage};
use needle_bench::geometry::{FixedAngles, Pose};
use needle_bench::needle::{Increment, Needle, TipPosition};
use needle_bench::observer::{Coupled, CoupledConfig, FiniteDifference, Observer};
use needle_bench::session::{Input, Output, Session};
use needle_bench::tracker::openigtlink::{
    Body, Message, Quaternion, Tool, ToolKind, Version, encode,
};
use needle_bench::tracker::{Event, Protocol, Reader, Sample, Validity};
use needle_bench::units::Time;
use std::hint::black_box;
use std::time::{Duration, Instant};

/// Increments of one millimetre at 2 mm/s and 10 ms SYNC.
const INCREMENTS_PER_MM: u32 = 50;

fn needle() -> Needle {
    Needle::new(1.0 / 122.0).expect("a curvature")
}

fn coupled() -> Coupled {
    let config = CoupledConfig {
        reduced_poles_per_mm: [0.07; 3],
        fibre_poles_per_mm: [0.07; 2],
        start: FixedAngles::default(),
    };
    Coupled::new(needle(), config).expect("a configuration")
}

fn law() -> FeedbackLinearization {
    let config = FeedbackLinearizationConfig {
        poles_per_mm: [0.05; 3],
        roll_demand_max_rad: 1.0,
        rotation_max_rad_per_mm: 0.35,
    };
    FeedbackLinearization::new(needle(), config)
}

/// One millimetre of an observer: carried along the stage's path, then corrected.
fn millimetre(observer: &mut dyn Observer, tip: &mut Pose) {
    let increment = Increment::new(1.0 / f64::from(INCREMENTS_PER_MM), 1e-4).expect("finite");
    for _ in 0..INCREMENTS_PER_MM {
        *tip = needle().step(tip, increment);
        observer.predict(increment);
    }
    observer.correct(&TipPosition::new(tip.translation).expect("finite"));
}

fn quantiles(name: &str, mut step: impl FnMut()) {
    let mut ns: Vec<u128> = (0..20_000)
        .map(|_| {
            let begun = Instant::now();
            step();
            begun.elapsed().as_nanos()
        })
        .collect();
    ns.sort_unstable();
    println!("{name}: p50 {} ns, p99 {} ns", ns[ns.len() / 2], ns[ns.len() * 99 / 100]);
}

fn steps(c: &mut Criterion) {
    let start = Vector3::new(5.0, 0.0, 0.0);
    let (mut observer, mut tip) = (coupled(), Pose::identity());
    observer.correct(&TipPosition::new(start).expect("finite"));
    quantiles("coupled observer, 1 mm of 50 increments", || millimetre(&mut observer, &mut tip));
    let (mut control, estimate) = (law(), observer.estimate().expect("an estimate"));
    quantiles("feedback linearisation, one command", || {
        let _ = black_box(control.command(black_box(&estimate), 1.0));
    });

    let mut group = c.benchmark_group("step");
    let (mut observer, mut tip) = (coupled(), Pose::identity());
    observer.correct(&TipPosition::new(start).expect("finite"));
    group.bench_function("coupled", |b| b.iter(|| millimetre(&mut observer, &mut tip)));
    let (mut observer, mut tip) = (FiniteDifference::new(needle(), 10.0), Pose::identity());
    group.bench_function("finite-difference", |b| b.iter(|| millimetre(&mut observer, &mut tip)));
    group.bench_function("feedback-linearization", |b| {
        b.iter(|| black_box(control.command(black_box(&estimate), 1.0)))
    });
    group.finish();
}

/// An SDO upload of the identity: the bench's client and the emulated drive's server.
fn sdo(c: &mut Criterion) {
    let node = NodeId::new(1).expect("a node");
    let identity = Identity { vendor: 1, product: 2, revision: 3, serial: 4 };
    let mut drive = Drive::new(DriveConfig::new(node, identity));
    while drive.poll_transmit().is_some() {}
    let mut client = SdoClient::new(node, Duration::from_millis(150));
    let request = SdoRequest::Upload(ObjectAddress::new(0x1018, 1));
    c.bench_function("sdo/expedited upload", |b| {
        b.iter(|| {
            client.start(Time::ZERO, request.clone()).expect("idle");
            while let Some(frame) = client.poll_transmit() {
                drive.handle_frame(Time::ZERO, &frame);
                while let Some(answer) = drive.poll_transmit() {
                    client.handle_frame(Time::ZERO, &answer);
                }
            }
            client.poll_result().expect("done").expect("uploaded")
        });
    });
}

/// From the bytes of a tracker's connection to samples, a hundred messages a read.
fn decoder(c: &mut Criterion) {
    const MESSAGES: u64 = 100;
    let turned = [0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 2.0, 3.0];
    let transform = Message::new("NeedleToTracker", None, Body::Transform(turned));
    let quaternion = Quaternion::Full([0.5; 4]);
    let position = Body::Position { position_mm: [1.0, 2.0, 3.0], quaternion };
    let tool = |name: &str| Tool { name: name.to_owned(), kind: ToolKind::SixD, pose: turned };
    let tools = ["NeedleToTracker", "ProbeToTracker", "ReferenceToTracker"].map(tool);
    let metadata = [("TransformValid", "True"), ("TransformStatus", "OK")];
    let with_metadata = Message {
        version: Version::V2 { message_id: 7 },
        metadata: metadata.map(|(key, value)| (key.to_owned(), value.to_owned())).to_vec(),
        ..transform.clone()
    };
    let line = concat!(
        r#"{"tool":"NeedleToTracker","position_tracker_mm":[12.53,-3.25,100.125],"#,
        r#""orientation_tracker_wxyz":[0.5,0.5,0.5,0.5],"source_unix_ns":1700000000500000000}"#,
        "\n"
    );
    let igtl = Protocol::OpenIgtLink;
    let streams = [
        ("transform", igtl, encode(&transform)),
        ("transform with metadata", igtl, encode(&with_metadata)),
        ("position", igtl, encode(&Message::new("NeedleToTracker", None, position))),
        ("tdata of 3", igtl, encode(&Message::new("T", None, Body::TrackingData(tools.into())))),
        ("ndjson", Protocol::Ndjson, line.as_bytes().to_vec()),
    ];
    let mut group = c.benchmark_group("decoder");
    for (name, protocol, message) in streams {
        let bytes = message.repeat(MESSAGES as usize);
        group.throughput(Throughput::ElementsAndBytes {
            elements: MESSAGES,
            bytes: bytes.len() as u64,
        });
        let mut reader = Reader::new(protocol);
        group.bench_function(name, |b| {
            b.iter(|| {
                reader.push(Time::ZERO, &bytes);
                while let Some(event) = reader.poll().expect("well-formed") {
                    black_box(event);
                }
            });
        });
    }
    group.finish();
}

/// Session, drives, needle and tracker over 50 mm in virtual time, without a record.
fn run(c: &mut Criterion) {
    let sets = ["insertion.depth_mm=50".to_owned()];
    let config = Config::from_sources(&[], &sets).expect("the defaults");
    let mut group = c.benchmark_group("run");
    group.sample_size(10);
    group.bench_function("50 mm", |b| b.iter(|| whole_run(&config)));
    group.finish();
}

fn whole_run(config: &Config) -> usize {
    let mut session = Session::new(config.session().expect("valid"), Time::ZERO).expect("valid");
    let mut stage = VirtualStage::new(config.virtual_stage().expect("valid"), Time::ZERO);
    let (mut now, mut records) = (Time::ZERO, 0);
    while session.outcome().is_none() {
        let mut quiet = false;
        while !quiet {
            quiet = true;
            while let Some(output) = session.poll() {
                quiet = false;
                match output {
                    Output::Transmit(frame) => stage.handle_frame(now, &frame),
                    Output::Record(_) => records += 1,
                }
            }
            while let Some(output) = stage.poll() {
                quiet = false;
                session.handle(
                    now,
                    match output {
                        StageOutput::Frame(frame) => Input::Frame(frame),
                        StageOutput::Tip { tip, .. } => Input::Tracker(Event::Sample(Sample {
                            tool: config.tracker.tool.clone(),
                            receive_time: now,
                            source_unix_ns: None,
                            position_mm: tip.x_tb.translation,
                            orientation: None,
                            validity: Validity::Valid,
                        })),
                    },
                );
            }
        }
        now = now.max(session.deadline().min(stage.deadline()));
        if stage.deadline() <= now {
            stage.handle_timeout(now);
        }
        if session.deadline() <= now {
            session.handle(now, Input::Tick);
        }
    }
    records
}

criterion_group!(benches, steps, sdo, decoder, run);
criterion_main!(benches);
