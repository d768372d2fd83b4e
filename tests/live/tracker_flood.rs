//! Runs whose tracker link is flooded: SYNC stays on time.
//!
//! A relay between the virtual stage's tracker and the bench adds messages to those of the tracker, over TCP or,
//! as NDJSON, into the bench's standard input.
#![cfg(target_os = "linux")]

use crate::support::peers::hold;
use crate::support::programs::{self, Ended, Program, Scratch, alone};
use crate::support::udp_stage::Stage;
use crate::udp_run::assert_no_set_point_after_the_gap;
use needle_bench::tracker::openigtlink::{Body, Message, Quaternion, Status, encode};
use needle_bench::tracker::{Event, Protocol, Reader};
use needle_bench::units::Time;
use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

/// Length of a message's header, and offset of the body's length in it, bytes.
const HEADER_LEN: usize = 58;
const BODY_LEN_AT: usize = 42;

/// What the relay adds: `messages`, `times` over at once, every `period`, for `duration`.
#[derive(Clone)]
struct Flood {
    messages: Vec<u8>,
    times: usize,
    period: Duration,
    duration: Duration,
    /// How often each message of the tracker is sent.
    repeats: usize,
}

impl Flood {
    fn of(messages: Vec<u8>, times: usize, period: Duration, duration: Duration) -> Self {
        Flood { messages, times, period, duration, repeats: 1 }
    }
}

/// Start of the flood after the connection: the insertion goes on by then, and for longer than any flood here.
const BEGINS_AFTER: Duration = Duration::from_millis(3000);

/// Relays the tracker at `from` to one client, whole message by whole message.
fn relay(from: SocketAddr, flood: Flood) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").expect("loopback");
    let address = listener.local_addr().expect("bound");
    thread::spawn(move || {
        let (bench, _) = listener.accept().expect("the bench connects");
        bench.set_nodelay(true).expect("a socket");
        // The relay ends with an error when either side closes.
        let _ = forward(from, bench, &flood, <[u8]>::to_vec);
    });
    address
}

/// Forwards what the tracker at `from` sends, whole message by whole message, each converted by `as_sent`.
fn forward(
    from: SocketAddr,
    mut bench: impl Write,
    flood: &Flood,
    as_sent: fn(&[u8]) -> Vec<u8>,
) -> io::Result<()> {
    let mut tracker = TcpStream::connect(from)?;
    tracker.set_read_timeout(Some(Duration::from_millis(1)))?;
    let burst = flood.messages.repeat(flood.times);
    let begun = Instant::now();
    let mut next = begun + BEGINS_AFTER;
    let mut held = Vec::new();
    let mut buffer = [0; 4096];
    loop {
        match tracker.read(&mut buffer) {
            Ok(0) => return Ok(()),
            Ok(len) => held.extend_from_slice(&buffer[..len]),
            Err(_) => {}
        }
        while let Some(len) = whole_message(&held) {
            bench.write_all(&as_sent(&held[..len]).repeat(flood.repeats))?;
            held.drain(..len);
        }
        if Instant::now() >= next && next < begun + BEGINS_AFTER + flood.duration {
            next += flood.period;
            bench.write_all(&burst)?;
        }
    }
}

/// The position in an OpenIGTLink `message` as a line of NDJSON; empty for any other message.
fn ndjson(message: &[u8]) -> Vec<u8> {
    let mut reader = Reader::new(Protocol::OpenIgtLink);
    reader.push(Time::ZERO, message);
    let events = std::iter::from_fn(|| reader.poll().expect("a whole message"));
    let lines = events.filter_map(|event| match event {
        Event::Sample(sample) => Some(line(&sample.tool, sample.position_mm.into())),
        _ => None,
    });
    lines.collect::<String>().into_bytes()
}

fn line(tool: &str, [x, y, z]: [f64; 3]) -> String {
    format!("{{\"tool\":\"{tool}\",\"position_tracker_mm\":[{x},{y},{z}]}}\n")
}

/// The length of the message at the start of `bytes`, once it is whole.
fn whole_message(bytes: &[u8]) -> Option<usize> {
    let body: [u8; 8] = bytes.get(BODY_LEN_AT..BODY_LEN_AT + 8)?.try_into().ok()?;
    let len = HEADER_LEN + usize::try_from(u64::from_be_bytes(body)).ok()?;
    (bytes.len() >= len).then_some(len)
}

fn position(tool: &str) -> Vec<u8> {
    let body = Body::Position { position_mm: [1.0, 2.0, 3.0], quaternion: Quaternion::Absent };
    encode(&Message::new(tool, None, body))
}

/// A run of 7 mm at 1 mm/s with a flooded tracker.
fn flooded(name: &str, flood: Flood) -> (Ended, Scratch) {
    let _alone = alone();
    let scratch = Scratch::new(name);
    let stage = Stage::start(&[]);
    let address = format!("tracker.address=\"{}\"", relay(stage.tracker, flood));
    let bench = scratch.bench(&["--json"], &stage.settings(&[&SLOW[..], &[&address]].concat()));
    (timed(name, &scratch, bench.end()), scratch)
}

const SLOW: [&str; 2] =
    ["insertion={ depth_mm = 7, plane_out_of_reach = \"insert\" }", "insertion.speed_mm_per_s=1"];

/// Prints how late the SYNCs were.
fn timed(name: &str, scratch: &Scratch, bench: Ended) -> Ended {
    let timing = &programs::manifest(&scratch.run_dir())["timing"];
    let late_ms = |key: &str| timing[key].as_f64().unwrap_or(f64::NAN) * 1e-3;
    println!(
        "{name}: {} SYNCs late by {:.2} ms (median), {:.2} (99 %), {:.2} (at most), {} skipped; {}",
        timing["syncs"],
        late_ms("sync_late_us_p50"),
        late_ms("sync_late_us_p99"),
        late_ms("sync_late_us_max"),
        timing["syncs_skipped"],
        bench.json()["stop_reason"],
    );
    bench
}

/// Asserts that every run completes, that SYNC is on time in one of three runs, and that little of the flood
/// reaches the session. A busy machine delays SYNCs without any flood too, so on time means: fewer than one in
/// twenty is skipped, and none is late by 40 ms. When the bench still served the flood before its deadlines, SYNCs
/// were late by 56 to 85 ms.
#[track_caller]
fn assert_sync_on_time(run: impl Fn() -> (Ended, Scratch)) -> (Ended, Scratch) {
    let is_on_time = |(_, scratch): &(Ended, Scratch)| {
        let timing = &programs::manifest(&scratch.run_dir())["timing"];
        let count = |key: &str| timing[key].as_u64().unwrap();
        let late_ms = timing["sync_late_us_max"].as_f64().unwrap() * 1e-3;
        count("syncs_skipped") * 20 < count("syncs") && late_ms < 40.0
    };
    let runs = std::iter::repeat_with(|| {
        let run = run();
        run.0.assert_status(0);
        run
    });
    let (bench, scratch) =
        runs.take(3).find(is_on_time).expect("SYNC on time in one of three runs");
    let samples = programs::read(&scratch.run_dir().join("tracker.ndjson"));
    assert!(!samples.contains("StylusToTracker"), "another tool's samples reached the session");
    let inputs = programs::read(&scratch.run_dir().join("inputs.log"));
    let notices = inputs.lines().filter(|line| line.contains(" status ")).count();
    assert!(notices < 300, "{notices} statuses reached the session");
    (bench, scratch)
}

#[test]
fn bursts_of_another_tool_delay_no_sync() {
    let (period, duration) = (Duration::from_millis(700), Duration::from_secs(3));
    let flood = || Flood::of(position("StylusToTracker"), 60_000, period, duration);
    assert_sync_on_time(|| flooded("flood-bursts", flood()));
}

#[test]
fn a_flood_of_another_tool_that_lasts_delays_no_sync() {
    let (period, duration) = (Duration::from_millis(1), Duration::from_secs(2));
    let flood = || Flood::of(position("StylusToTracker"), 2000, period, duration);
    assert_sync_on_time(|| flooded("flood-lasting", flood()));
}

/// The positions come as NDJSON through a pipe, which blocks while the bench does not read.
#[test]
fn a_flood_on_standard_input_delays_no_sync() {
    let _alone = alone();
    let (period, duration) = (Duration::from_millis(1), Duration::from_secs(2));
    assert_sync_on_time(|| {
        let scratch = Scratch::new("flood-pipe");
        let stage = Stage::start(&[]);
        let (stdin, bench) = io::pipe().expect("a pipe");
        let messages = line("StylusToTracker", [1.0, 2.0, 3.0]).into_bytes();
        let (from, flood) = (stage.tracker, Flood::of(messages, 2000, period, duration));
        thread::spawn(move || forward(from, bench, &flood, ndjson));
        let from_there = ["tracker.source=\"ndjson\"", "tracker.address=\"-\""];
        let settings = stage.settings(&[SLOW, from_there].concat());
        let bench = Program::start_on(&mut scratch.command(&["--json"], &settings), stdin).end();
        (timed("flood-pipe", &scratch, bench), scratch)
    });
}

#[test]
fn a_flood_of_statuses_delays_no_sync() {
    let (code, subcode) = (Status::OK, 0);
    let status = Status { code, subcode, error_name: String::new(), message: "ok".to_owned() };
    let messages = encode(&Message::new("Server", None, Body::Status(status)));
    let (period, duration) = (Duration::from_millis(1), Duration::from_secs(2));
    let flood = || Flood::of(messages.clone(), 200, period, duration);
    assert_sync_on_time(|| flooded("flood-statuses", flood()));
}

/// Each position comes 125 times at once. Of the samples that wait, the control thread takes the newest 64.
#[test]
fn five_thousand_samples_a_second_of_the_needle_delay_no_sync() {
    let none = || Flood { repeats: 125, ..Flood::of(Vec::new(), 0, Duration::MAX, Duration::ZERO) };
    let run = assert_sync_on_time(|| flooded("flood-own", none()));
    let accepted = run.0.json()["tracker_samples"]["accepted"].as_u64().unwrap();
    assert!(accepted > 5000, "{accepted}");
    let events = programs::read(&run.1.run_dir().join("events.log"));
    // The first drop is reported, then each doubling.
    let reports = events.matches("samples dropped so far: they come faster").count();
    assert!((1..20).contains(&reports), "{reports} reports of dropped samples");
}

/// The control thread stalls for two seconds during the flood, as on a machine that has no time left for it. After
/// that it sends no set-point.
#[test]
fn a_stall_during_a_flood_stops_the_run_and_names_the_flood() {
    let _alone = alone();
    let scratch = Scratch::new("flood-named");
    let stage = Stage::start(&[]);
    let (period, duration) = (Duration::from_millis(1), Duration::from_secs(20));
    let flood = Flood::of(position("StylusToTracker"), 100, period, duration);
    let address = format!("tracker.address=\"{}\"", relay(stage.tracker, flood));
    let mut bench = scratch.bench(&[], &stage.settings(&[&SLOW[..], &[&address]].concat()));
    bench.wait_for("enabling both axes");
    thread::sleep(BEGINS_AFTER);
    let Some(holder) = hold(&bench, "needle-bench") else { return };
    thread::sleep(Duration::from_millis(2500));
    holder.signal("INT");
    holder.end().assert_status(0);
    let ended = bench.end();
    ended.assert_status(1);
    let reason = ended.last_line();
    assert!(reason.starts_with("stopped: bench: was held up for 2"), "{reason}");
    assert!(reason.contains("by a flood from the tracker? "), "{reason}\n{}", ended.stderr);
    stage.assert_it_stands();
    assert_no_set_point_after_the_gap(&scratch.run_dir());
}

/// The tool's name and the status text clear the screen and forge a line of the record.
#[test]
fn control_characters_of_a_peer_are_escaped_in_every_output() {
    const FORGED: &str = "x\x1b[2J\n  9.9 s";
    let (error_name, message) = ("\x1b[1m".to_owned(), format!("{FORGED}  session: \u{202e}done"));
    let status = Status { code: 1, subcode: 0, error_name, message };
    let status = encode(&Message::new("Server", None, Body::Status(status)));
    let messages = [position(FORGED), status].concat();
    let (period, duration) = (Duration::from_secs(1), Duration::from_millis(1500));
    let run = flooded("escapes", Flood::of(messages, 1, period, duration));
    run.0.assert_status(0);
    let dir = run.1.run_dir();
    let review = |arguments: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_needle-bench"));
        Program::start(command.arg("review").arg(&dir).args(arguments)).end()
    };
    let (text, json) = (review(&[]), review(&["--json"]));
    text.assert_status(0);
    json.json();
    let file = |name: &str| programs::read(&dir.join(name));
    let outputs = [
        &run.0.stderr,
        &file("events.log"),
        &file("inputs.log"),
        &file("report.html"),
        &text.stdout,
        &text.stderr,
        &json.stdout,
    ];
    for text in outputs {
        assert!(!text.contains(is_raw), "{text}");
        assert!(!text.lines().any(|line| line.starts_with("  9.9 s")), "{text}");
    }
    for text in [&run.0.stderr, &file("events.log")] {
        let name = r#""x\u{1b}[2J\n  9.9 s" is on the stream (POSITION)"#;
        let status = r"Server: status 1 \u{1b}[1m x\u{1b}[2J\n  9.9 s  session: \u{202e}done";
        assert!(text.contains(name) && text.contains(status), "{text}");
    }
}

fn is_raw(c: char) -> bool {
    c.is_control() && !"\n\t".contains(c) || ('\u{202A}'..='\u{202E}').contains(&c)
}
