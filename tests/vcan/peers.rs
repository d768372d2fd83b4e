//! Third-party programs on real SocketCAN: python-canopen against the virtual stage's drives, pyigtl between
//! tracker and bench, and candump, cangen and canplayer of can-utils.

use std::fs;
use std::process::Command;
use std::time::{Duration, Instant};

use crate::support::drives::assert_the_drives_stand;
use crate::support::programs::{self, LONG, Program, Scratch, stage};
use crate::support::{peers, python_drives, vcan};
use needle_bench::canopen::{CanId, Frame};
use needle_bench::transport::can::{BusEvent, CanBus};
use needle_bench::transport::socketcan::SocketCan;

#[test]
fn python_canopen_drives_resets_and_homes_a_drive() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let _stage = stage(&[]);
    let arguments = ["--interface", "socketcan", "--channel", "vcan0", "--node", "1"];
    let master = peers::peer("canopen_enable.py", &arguments).expect("NEEDLE_PEERS_PYTHON").end();
    println!("{}", master.stdout);
    master.assert_status(0);
    assert!(master.stdout.contains("\nOPERATION ENABLED: statusword 0x"), "{}", master.stdout);
    assert!(master.stdout.contains("moved +400 counts"), "{}", master.stdout);
    assert!(master.stdout.contains("\nOPERATION ENABLED after the reset: "), "{}", master.stdout);
    assert!(master.stdout.contains("\nhomed: "), "{}", master.stdout);
    assert_eq!(master.last_line(), "done");
    assert_the_drives_stand(&[]);
}

#[test]
fn the_bench_moves_drives_of_python_canopen() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    python_drives::are_moved_by_the_bench("socketcan", "vcan0", "vcan0");
}

/// cangen sends some 600 frames a second of a foreign node.
#[test]
fn a_run_completes_under_a_flood_of_cangen() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let _stage = stage(&[]);
    let flood = ["vcan0", "-g", "1.5", "-I", "5A5", "-L", "8", "-D", "i"];
    for (listen, is_heard) in [("all", true), ("stage", false)] {
        let cangen = Program::start(Command::new("cangen").args(flood));
        let scratch = Scratch::new("flooded");
        let listen = format!("can.listen=\"{listen}\"");
        let settings = [
            "insertion={ depth_mm = 5, plane_out_of_reach = \"insert\" }",
            "can.heartbeat_timeout_ms=2000",
            &listen,
        ];
        let bench = scratch.bench(&["--json"], &settings).end();
        cangen.signal("INT");
        cangen.end();
        bench.assert_status(0);
        assert_eq!(bench.json()["outcome"], "completed");
        let log = programs::read(&scratch.run_dir().join("can.log"));
        let foreign = log.lines().filter(|line| line.contains(" 5A5#")).count();
        println!("{listen}: {foreign} frames of the flood are in the record");
        println!("{}", programs::manifest(&scratch.run_dir())["timing"]);
        if is_heard {
            assert!(bench.stderr.contains("a flood on the bus: "), "{}", bench.stderr);
            assert!(foreign > 500, "{foreign}");
        } else {
            assert_eq!(foreign, 0);
        }
    }
    assert_the_drives_stand(&[]);
}

/// candump on vcan0.
struct Candump(Program);

impl Candump {
    /// Starts candump and waits until it listens.
    fn start() -> Self {
        let mut command = Command::new("candump");
        // A large receive buffer, and a report of what it dropped.
        let candump = Program::start(command.args(["-L", "-d", "-r", "4000000", "vcan0"]));
        let mut bus = SocketCan::open("vcan0").unwrap();
        let call = Frame::from_parts(CanId::Extended(0x1FFF_FFFF), false, &[]).unwrap();
        let end = Instant::now() + LONG;
        while !candump.said().contains("1FFFFFFF#") {
            assert!(Instant::now() < end, "candump hears nothing: {}", candump.said());
            bus.send(&call).unwrap();
            std::thread::sleep(Duration::from_millis(10));
        }
        Candump(candump)
    }

    /// Ends candump; returns all frames since its start, as `id#data`.
    fn end(self) -> Vec<String> {
        self.0.signal("INT");
        let ended = self.0.end();
        assert!(!ended.stderr.contains("DROP"), "{}", ended.stderr);
        let frames = ended.stdout.lines().filter_map(|line| line.split(' ').nth(2));
        frames.filter(|frame| !frame.starts_with("1FFFFFFF")).map(str::to_owned).collect()
    }
}

#[test]
fn a_run_steers_by_positions_that_pyigtl_relays_and_candump_agrees_with_its_record() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let scratch = Scratch::new("relayed");
    let candump = Candump::start();
    let _stage = stage(&[]);
    let relay = peers::serving_peer("pyigtl_relay.py", &[]);
    let (relay, port) = relay.expect("NEEDLE_PEERS_PYTHON");
    let tracker = format!("tracker.address=\"127.0.0.1:{port}\"");
    let settings = [
        &tracker,
        "tracker.stamp=\"source\"",
        "insertion={ depth_mm = 20, plane_out_of_reach = \"insert\" }",
        // The relay is slow: Python in a virtual machine on a busy host.
        "tracker.hold_after_mm=11",
    ];
    let bench = scratch.bench(&["--json"], &settings).end();
    let on_the_wire = candump.end();

    bench.assert_status(0);
    assert_eq!(bench.json()["outcome"], "completed");
    let run_dir = scratch.run_dir();
    let steps = programs::csv(&run_dir.join("steps.csv"));
    assert_eq!(steps.len(), 21);
    let manifest = programs::manifest(&run_dir);
    assert_eq!(manifest["dropped"]["text_files"], 0);
    let measured = steps.iter().filter(|step| !step["x_meas_mm"].is_empty()).count();
    assert!(measured > 15, "{measured} of 21 steps have a position");
    let relay = relay.end();
    println!("relay: {}", relay.last_line());
    relay.assert_status(0);

    // The same frames, in the same order for each direction.
    let log = programs::read(&run_dir.join("can.log"));
    let of = |direction: &str| -> Vec<&str> {
        log.lines()
            .filter(|line| line.ends_with(direction))
            .filter_map(|line| line.split(' ').nth(2))
            .collect()
    };
    let (sent, received) = (of(" T"), of(" R"));
    let by_the_bench = |frame: &&str| {
        let id = frame.split('#').next().unwrap_or("");
        ["000", "080", "201", "202", "601", "602", "77F"].contains(&id)
    };
    let (wire_sent, wire_received): (Vec<&str>, Vec<&str>) =
        on_the_wire.iter().map(String::as_str).partition(by_the_bench);
    println!("{} frames sent, {} received", sent.len(), received.len());
    assert!(sent.len() > 1000 && received.len() > 1000);
    assert!(wire_sent == sent, "{}", difference(&wire_sent, &sent));
    // The drives sent before the bench listened, and send on after its end.
    let all_heard = wire_received.windows(received.len()).any(|window| window == received);
    assert!(all_heard, "the record lacks frames of the drives that candump received");

    // canplayer replays the record.
    let beginning: Vec<&str> = log.lines().take(200).collect();
    let part = scratch.path("beginning.log");
    fs::write(&part, beginning.join("\n") + "\n").unwrap();
    let mut vcan1 = SocketCan::open("vcan1").unwrap();
    let arguments = ["-t", "-I", part.to_str().unwrap(), "vcan1=vcan0"];
    Program::start(Command::new("canplayer").args(arguments)).end().assert_status(0);
    for line in beginning {
        let Some(BusEvent::Frame(frame)) = vcan1.receive(LONG).unwrap() else {
            panic!("not replayed: {line}");
        };
        assert_eq!(line.split(' ').nth(2), Some(frame.to_string().as_str()));
    }
}

/// The first frame in which wire and record differ.
fn difference(wire: &[&str], record: &[&str]) -> String {
    let n = wire.iter().zip(record).take_while(|(a, b)| a == b).count();
    format!("frame {n}: candump has {:?}, can.log {:?}", wire.get(n), record.get(n))
}
