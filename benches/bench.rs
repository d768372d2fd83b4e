//! Times the work of the bench at each millimetre, frame and message, and a whole run.
//!
//! `cargo bench --profile dev` prints the quantiles of single steps, then criterion's figures. (Without the profile,
//! cargo builds all dependencies again, as for a release.)

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use nalgebra::Vector3;

use needle_bench::canopen::sdo::{SdoClient, SdoRequest};
use needle_bench::canopen::{NodeId, ObjectAddress};
use needle_bench::config::{Config, Source};
use needle_bench::emulator::drive::{Drive, DriveConfig};
use needle_bench::emulator::{StageOutput, VirtualStage, WhiteNoise};
use needle_bench::geometry::{FixedAngles, Pose};
use needle_bench::needle::{Increment, Needle, TipPosition};
use needle_bench::runtime::Study;
use needle_bench::session::{
    Input, Machine, Output, PlaneOutOfReach, Pursuit, Session, SessionConfig, Steering, StepRecord,
};
use needle_bench::study::{insert, trial_seed};
use needle_bench::tracker::openigtlink::{Body, Message, Quaternion, Tool, encode, tool_kind};
use needle_bench::tracker::{Event, Protocol, Reader, Sample, Validity};
use needle_bench::units::Time;
use std::hint::black_box;
use std::ops::ControlFlow;
use std::time::{Duration, Instant};

/// Increments per millimetre at 2 mm/s and a SYNC period of 10 ms.
const INCREMENTS_PER_MM: u32 = 50;

/// Each observer with the default law, and each other law with the default observer.
const STEERINGS: [(&str, &str); 4] = [
    ("observer", "invariant"),
    ("observer", "coupled"),
    ("observer", "finite-difference"),
    ("control", "feedback-linearization"),
];

fn session(part: &str, kind: &str) -> SessionConfig {
    let sets = [format!("{part}.kind=\"{kind}\""), "observer.shadows=[]".to_owned()];
    let config = Config::from_sources(&[], &sets).expect("the defaults");
    config.session().expect("valid")
}

/// A needle that is steered one millimetre at a time.
struct Insertion {
    steering: Steering,
    needle: Needle,
    tip: Pose,
    rotation_rad_per_mm: f64,
}

impl Insertion {
    fn new(session: &SessionConfig, roll: f64) -> Self {
        let angles = FixedAngles { yaw: 0.1, pitch: 0.1, roll };
        let tip = Pose { rotation: angles.to_rotation(), translation: Vector3::new(5.0, 0.0, 0.0) };
        let steering = Steering::new(session);
        Insertion { steering, needle: session.needle, tip, rotation_rad_per_mm: 0.0 }
    }

    /// Inserts one millimetre. Returns the time that the step's work took: predicting along the stage's path,
    /// correcting, deciding.
    fn insert_mm(&mut self, noise: Vector3<f64>) -> Duration {
        let part = 1.0 / f64::from(INCREMENTS_PER_MM);
        let increment = Increment::new(part, self.rotation_rad_per_mm * part).expect("finite");
        for _ in 0..INCREMENTS_PER_MM {
            self.tip = self.needle.step(&self.tip, increment);
        }
        let tip_meas = TipPosition::new(self.tip.translation + noise).expect("finite");
        let begun = Instant::now();
        for _ in 0..INCREMENTS_PER_MM {
            self.steering.predict(increment);
        }
        self.steering.correct(&tip_meas, 1, 0.025);
        let decision = black_box(self.steering.decide(&[increment], false));
        let took = begun.elapsed();
        self.rotation_rad_per_mm = decision.rotation_cmd_rad_per_mm.unwrap_or(0.0);
        took
    }
}

/// Quantiles of the time of a step over whole insertions, from start rolls all around the circle.
fn steps(_: &mut Criterion) {
    for (part, kind) in STEERINGS {
        let session = session(part, kind);
        let ns: Vec<u128> = (0..40u32)
            .flat_map(|start| {
                let mut insertion = Insertion::new(&session, 0.157 * f64::from(start));
                let noise = WhiteNoise::Uniform(1.0);
                (0..300).map(move |mm| insertion.insert_mm(noise.draw(start.into(), mm)).as_nanos())
            })
            .collect();
        print_quantiles(kind, ns);
    }
}

fn print_quantiles(name: &str, mut ns: Vec<u128>) {
    ns.sort_unstable();
    let quantile = |per_cent: usize| ns[(ns.len() - 1) * per_cent / 100];
    println!(
        "step, {name}: p50 {} ns, p99 {} ns, max {} ns",
        quantile(50),
        quantile(99),
        quantile(100)
    );
}

/// Quantiles of the time of a step on the way to targets among five spheres, and of the time that its plan takes. A
/// step has twenty corrections, the plan, and the emulated needle.
fn steps_to_targets(_: &mut Criterion) {
    time_steps_to_targets("in the plane", "goal.in_plane=true");
    time_steps_to_targets("in space", "goal.in_plane=false");
}

fn time_steps_to_targets(name: &str, set: &str) {
    let text = include_str!("../bench-config/target-study.toml");
    let sets =
        ["study.obstacles=5", "study.target_share=[0,0.6]", "goal.curvature_margin=0.1", set];
    let sources = [Source { name: "target-study.toml", text }];
    let config = Config::from_sources(&sources, &sets.map(str::to_owned)).expect("valid");
    let mut session = config.session_without_goal().expect("valid");
    session.insertion.plane_out_of_reach = PlaneOutOfReach::Insert;
    session.shadows.clear();
    let stage = |seed| {
        let drawn = config.drawn(seed).and_then(|drawn| drawn.virtual_stage());
        drawn.map_err(|error| error.to_string())
    };
    let (tool, prior) = (&config.tracker.tool, config.prior());
    let study = Study { session, tool, prior, stage: &stage, goal: &|_| Ok(Ok(None)) };
    let timetable = study.timetable(0).expect("an insertion");
    let (mut ns, mut plan_ns) = (Vec::new(), Vec::new());
    for seed in (0..1000).map(|trial| trial_seed(1, trial)) {
        let drawn = config.drawn(seed).expect("room");
        let goal = drawn.to_goal(&|_, _, _| Err(String::new())).expect("no masks");
        let Ok(goal) = goal else { continue };
        let session = SessionConfig { goal, ..study.session.clone() };
        let mut pursuit = session.goal.clone().map(|goal| Pursuit::new(goal, &session));
        let stage = drawn.virtual_stage().expect("valid");
        let mut last = Instant::now();
        // Each step is planned once more, to take the time of the plan alone.
        let take = |step: &StepRecord, _: &_| {
            ns.push(last.elapsed().as_nanos());
            let begun = Instant::now();
            if let (Some(pursuit), Some(estimate)) = (&mut pursuit, &step.decision.estimate) {
                let step_mm = session.insertion.step_mm;
                let _ = black_box(pursuit.step(estimate, step.insertion_meas_mm, step_mm));
                plan_ns.push(begun.elapsed().as_nanos());
            }
            last = Instant::now();
        };
        insert(&session, &stage, &timetable, take);
    }
    print_quantiles(&format!("to a target among five spheres, {name}"), ns);
    print_quantiles(&format!("its plan, {name}"), plan_ns);
}

/// Measures the time that each law takes for one command.
fn commands(c: &mut Criterion) {
    let mut group = c.benchmark_group("command");
    for kind in ["nested-saturation", "feedback-linearization"] {
        let session = session("control", kind);
        let mut insertion = Insertion::new(&session, 0.0);
        for mm in 0..100 {
            insertion.insert_mm(WhiteNoise::Uniform(0.1).draw(1, mm));
        }
        let estimate = insertion.steering.decide(&[], true).estimate.expect("an estimate");
        let mut law = session.control.build(session.needle);
        group.bench_function(kind, |b| b.iter(|| law.command(black_box(&estimate), 1.0)));
    }
    group.finish();
}

/// Trials of 300 mm of the default study, by the number of threads: inserted mm a second.
fn study(c: &mut Criterion) {
    let sets = ["insertion.depth_mm=300", "observer.shadows=[]"].map(str::to_owned);
    let config = Config::from_sources(&[], &sets).expect("the defaults");
    let stage = |seed| {
        config
            .drawn(seed)
            .and_then(|drawn| drawn.virtual_stage())
            .map_err(|error| error.to_string())
    };
    let session = config.session().expect("valid");
    let tool = &config.tracker.tool;
    let study =
        Study { session, tool, prior: config.prior(), stage: &stage, goal: &|_| Ok(Ok(None)) };
    let timetable = study.timetable(0).expect("an insertion");
    let seeds: Vec<u64> = (0..40).collect();
    let mut group = c.benchmark_group("study");
    group.sample_size(10).throughput(Throughput::Elements(300 * seeds.len() as u64));
    for threads in [1, 2] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        group.bench_function(format!("{threads} threads, mm"), |b| {
            b.iter(|| {
                pool.install(|| study.trials(&seeds, &timetable, &|| ControlFlow::Continue(())))
                    .expect("trials")
            });
        });
    }
    group.finish();
}

/// An SDO upload of the identity, between the bench's client and the emulated drive's server.
fn sdo(c: &mut Criterion) {
    let node = NodeId::new(1).expect("a node");
    let mut drive = Drive::new(DriveConfig::new(node, 1, 2));
    while drive.poll_transmit().is_some() {}
    let mut client = SdoClient::new(node, Duration::from_millis(150));
    let request = SdoRequest::Upload(ObjectAddress::new(0x1018, 1));
    c.bench_function("sdo/expedited upload", |b| {
        b.iter(|| {
            client.start(Time::ZERO, request);
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

/// Decodes the bytes of a tracker's connection into samples, a hundred messages a read.
fn decoder(c: &mut Criterion) {
    const MESSAGES: u64 = 100;
    let turned = [0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 2.0, 3.0];
    let transform = Message::new("NeedleToTracker", None, Body::Transform(turned));
    let quaternion = Quaternion::Full([0.5; 4]);
    let position = Body::Position { position_mm: [1.0, 2.0, 3.0], quaternion };
    let tool = |name: &str| Tool { name: name.to_owned(), kind: tool_kind::SIX_D, pose: turned };
    let tools = ["NeedleToTracker", "ProbeToTracker", "ReferenceToTracker"].map(tool);
    let line = concat!(
        r#"{"tool":"NeedleToTracker","position_tracker_mm":[12.53,-3.25,100.125],"#,
        r#""orientation_tracker_wxyz":[0.5,0.5,0.5,0.5],"source_unix_ns":1700000000500000000}"#,
        "\n"
    );
    let igtl = Protocol::OpenIgtLink;
    let streams = [
        ("transform", igtl, encode(&transform)),
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
    let mut session = Session::new(config.session().expect("valid"), Time::ZERO);
    let mut stage = VirtualStage::new(config.virtual_stage().expect("valid"), Time::ZERO);
    let (mut now, mut records) = (Time::ZERO, 0);
    while session.outcome().is_none() {
        let mut is_idle = false;
        while !is_idle {
            is_idle = true;
            while let Some(output) = session.poll() {
                is_idle = false;
                match output {
                    Output::Transmit { frame, .. } => stage.handle_frame(now, &frame),
                    Output::Record(_) => records += 1,
                }
            }
            while let Some(output) = stage.poll() {
                is_idle = false;
                session.handle(
                    now,
                    match output {
                        StageOutput::Frame(frame) => Input::Frame(frame),
                        StageOutput::FaultBegan(_) | StageOutput::Target(_) => continue,
                        StageOutput::Tip { tip, .. } => Input::Tracker(Event::Sample(Sample {
                            tool: config.tracker.tool.clone(),
                            receive_time: now,
                            source_unix_ns: None,
                            position_mm: tip.x_ts.translation,
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

criterion_group!(benches, steps, steps_to_targets, commands, sdo, decoder, study, run);
criterion_main!(benches);
