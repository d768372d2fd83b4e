//! Programs nobody here wrote, on real SocketCAN: python-canopen against the virtual stage's
//! drives, pyigtl between tracker and bench, can-utils over the record.
//! candump, cangen and canplayer are Debian's can-utils.

use std::fs;
use std::process::Command;
use std::time::{Duration, Instant};

use crate::support::drives::assert_the_drives_stand;
use crate::support::programs::{self, LONG, Program, Scratch, stage};
use crate::support::{peers, python_drives, vcan};
use needle_bench::canopen::{CanId, Frame};
use needle_bench::transport::can::{BusEvent, CanBus};
use needle_bench::transport::socketcan::SocketCan;

/// Where the tests on vcan are asked for, the peers have to be there.
fn peer(script: &str, arguments: &[&str]) -> Program {
    peers::peer(script, arguments).expect("NEEDLE_PEERS_PYTHON")
}

#[test]
fn python_canopen_drives_resets_and_homes_a_drive() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let _stage = stage(&[]);
    let arguments = ["--interface", "socketcan", "--channel", "vcan0", "--node", "1"];
    let master = peer("canopen_enable.py", &arguments).end();
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

/// Frames of a node that is none of ours, some 600 a second, as long as the run lasts.
#[test]
fn a_run_under_a_flood_of_cangen_is_a_run() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let _stage = stage(&[]);
    let flood = ["vcan0", "-g", "1.5", "-I", "5A5", "-L", "8", "-D", "i"];
    for (listen, is_heard) in [("all", true), ("stage", false)] {
        let cangen = Program::start(Command::new("cangen").args(flood));
        let scratch = Scratch::new("flooded");
        let listen = format!("can.listen=\"{listen}\"");
        let settings = ["insertion={ depth_mm = 5, plane_out_of_reach = \"insert\" }", &listen];
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

/// What is on the wire of vcan0, by candump's account.
struct Candump(Program);

impl Candump {
    /// Returns once it listens.
    fn start() -> Self {
        let mut command = Command::new("candump");
        // Room for what comes while it is not scheduled, and word of what did not find any.
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

    /// All frames since then, as `id#data`.
    fn end(self) -> Vec<String> {
        self.0.signal("INT");
        let ended = self.0.end();
        assert!(!ended.stderr.contains("DROP"), "{}", ended.stderr);
        let frames = ended.stdout.lines().filter_map(|line| line.split(' ').nth(2));
        frames.filter(|frame| !frame.starts_with("1FFFFFFF")).map(str::to_owned).collect()
    }
}

#[test]
fn a_run_steers_by_what_pyigtl_hands_on_and_candump_agrees_with_its_record() {
    let Some(_alone) = vcan::alone_on_it() else { return };
    let scratch = Scratch::new("relayed");
    let candump = Candump::start();
    let _stage = stage(&[]);
    let mut relay = peer("pyigtl_relay.py", &[]);
    relay.wait_for("listening ");
    let said = relay.said();
    let port = said.lines().find_map(|line| line.strip_prefix("listening ")).unwrap();
    let tracker = format!("tracker.address=\"127.0.0.1:{port}\"");
    let settings = [
        &tracker,
        "tracker.stamp=\"source\"",
        "insertion={ depth_mm = 20, plane_out_of_reach = \"insert\" }",
        // A relay in Python, in a machine that is emulated by a busy one.
        "tracker.hold_after_s=2",
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
    // The drives spoke before the bench listened, and go on when it is gone.
    let all_heard = wire_received.windows(received.len()).any(|window| window == received);
    assert!(all_heard, "the record does not hold what candump heard of the drives");

    // canplayer plays the record.
    let beginning: Vec<&str> = log.lines().take(200).collect();
    let part = scratch.path("beginning.log");
    fs::write(&part, beginning.join("\n") + "\n").unwrap();
    let mut vcan1 = SocketCan::open("vcan1").unwrap();
    let arguments = ["-t", "-I", part.to_str().unwrap(), "vcan1=vcan0"];
    Program::start(Command::new("canplayer").args(arguments)).end().assert_status(0);
    for line in beginning {
        let Some(BusEvent::Frame(frame)) = vcan1.receive(LONG).unwrap() else {
            panic!("not played: {line}");
        };
        assert_eq!(line.split(' ').nth(2), Some(frame.to_string().as_str()));
    }
}

/// Where two accounts part.
fn difference(wire: &[&str], record: &[&str]) -> String {
    let n = wire.iter().zip(record).take_while(|(a, b)| a == b).count();
    format!("frame {n}: candump has {:?}, can.log {:?}", wire.get(n), record.get(n))
}
