//! Runs at 1 mm/s and 10 ms SYNC through a relay between bench and drives, which changes what the
//! drives say and what they are told: tests/peers/can_relay.py, for whoever wants to try more.
#![cfg(target_os = "linux")]

use crate::support::peers::peer;
use crate::support::programs::{Ended, Scratch, beside_others};
use crate::support::udp_stage::Stage;
use std::net::SocketAddrV4;

/// A run through the relay, and what the relay saw.
struct Relayed {
    bench: Ended,
    relay: Vec<Seen>,
    /// Where the insertion drive stands in the end, mm.
    stands_at_mm: f64,
}

/// A line of the relay's.
#[derive(Debug, Clone)]
struct Seen {
    time_s: f64,
    depth_mm: f64,
    what: String,
}

/// Runs 6 mm with `rules` and with `settings`; none without the peer.
fn run(test: &str, rules: &[&str], settings: &[&str]) -> Option<Relayed> {
    run_on(&[], test, rules, settings)
}

/// The same on a virtual stage with these arguments.
fn run_on(stage: &[&str], test: &str, rules: &[&str], settings: &[&str]) -> Option<Relayed> {
    let _machine = beside_others();
    let stage = Stage::start(stage);
    // The group is this process's own, and so is the next port of it.
    let bench_side = SocketAddrV4::new(*stage.group.ip(), stage.group.port() + 1);
    let (bench_side, drives_side) = (bench_side.to_string(), stage.group.to_string());
    let mut arguments = vec!["--bench", &bench_side, "--drives", &drives_side];
    rules.iter().for_each(|rule| arguments.extend(["--rule", rule]));
    let mut relay = peer("can_relay.py", &arguments)?;
    relay.wait_for("relaying");
    let scratch = Scratch::new(test);
    let bus = format!("can.interface=\"udp:{bench_side}\"");
    let own = [
        "insertion={ depth_mm = 6, plane_out_of_reach = \"insert\" }",
        "insertion.speed_mm_per_s=1",
        &bus,
    ];
    let bench = scratch.bench(&["--json"], &stage.settings(&[&own[..], settings].concat())).end();
    relay.signal("INT");
    let relay = relay.end();
    relay.assert_status(0);
    println!("{}{}{}", relay.stdout, bench.stderr, bench.stdout);
    let seen = |line: &str| {
        let mut words = line.splitn(5, ' ');
        let time_s = words.next()?.parse().ok()?;
        let depth_mm = words.nth(1)?.parse().ok()?;
        Some(Seen { time_s, depth_mm, what: words.nth(1)?.to_owned() })
    };
    let relay = relay.stdout.lines().filter_map(seen).collect();
    Some(Relayed { bench, relay, stands_at_mm: stage.assert_it_stands() })
}

impl Relayed {
    #[track_caller]
    fn first(&self, what: &str) -> &Seen {
        let found = self.relay.iter().find(|seen| seen.what.contains(what));
        found.unwrap_or_else(|| panic!("{what}: not among {:?}", self.relay))
    }

    /// It was stopped for `reason`, and the insertion was told to by SDO soon after the relay did
    /// `what`, and to stand.
    #[track_caller]
    fn was_stopped(&self, what: &str, reason: &str) {
        self.bench.assert_status(1);
        assert_eq!(self.bench.json()["stop_reason"], reason);
        let (struck, stop) = (self.first(what), self.first("controlword 0x0002 by SDO"));
        let after_ms = (stop.time_s - struck.time_s) * 1e3;
        let until_mm = stop.depth_mm - struck.depth_mm;
        let then_mm = self.stands_at_mm - stop.depth_mm;
        println!("{after_ms:.1} ms, {until_mm:.3} mm until, {then_mm:.3} mm then");
        // A busy machine may hold the bench up, and its SYNCs with it: the axes do not go on then.
        assert!((0.0..500.0).contains(&after_ms) && until_mm < 0.05, "{after_ms} {until_mm}");
        assert!((0.0..0.1).contains(&then_mm), "{then_mm}");
    }
}

/// Found in Fault, which is gone before it is enabled: what it says later is of now.
#[test]
fn an_emergency_of_a_drive_that_was_found_in_fault() {
    let rules = ["node=1 until=1sync set=0x0008 clear=0x0067", "node=1 from=4mm emcy=0x8611"];
    let settings = ["stage.fault_reset_on_start=true"];
    let Some(run) = run("relay-emcy", &rules, &settings) else { return };
    run.was_stopped(
        "emergency 0x8611",
        "stage: insertion: emergency 0x8611 following error (register 0x21)",
    );
}

/// A drive faults by itself. Its emergency message says why; where that is lost, its statusword says that it did.
#[test]
fn an_emergency_message_that_is_changed_or_lost_on_the_way() {
    let fault = r#"emulator.fault=[{ at_mm = 4, kind = "drive-fault", axis = "insertion", code = 0x4210 }]"#;
    for (rule, struck, reason) in [
        ("node=1 edit=0x8611", "becomes", "stage: insertion: emergency 0x8611 following error"),
        ("node=1 drop=emcy", "lost", "stage: insertion: drive in fault (statusword 0x021F"),
    ] {
        let Some(run) = run_on(&["--set", fault], "relay-edit", &[rule], &[]) else { return };
        run.bench.assert_status(1);
        let stop_reason = run.bench.json()["stop_reason"].as_str().unwrap().to_owned();
        assert!(stop_reason.starts_with(reason), "{stop_reason}");
        let then_mm = run.stands_at_mm - run.first(struck).depth_mm;
        assert!((0.0..0.1).contains(&then_mm), "{then_mm}");
    }
}

#[test]
fn a_drive_that_takes_no_command_at_the_end() {
    let rules = ["node=1 from=4mm hold=0x000f"];
    let Some(run) = run("relay-hold", &rules, &[]) else { return };
    run.bench.assert_status(1);
    assert_eq!(
        run.bench.json()["stop_reason"],
        "stage: insertion: the drive still has power 2000 ms after shutdown (statusword 0x1237 \
         operation enabled); if it does not stop now, press the emergency stop"
    );
    let told = "off: press the emergency stop, then look at the stage";
    assert!(run.bench.stderr.contains(told), "{}", run.bench.stderr);
    assert!((run.stands_at_mm - 6.0).abs() < 0.01, "{}", run.stands_at_mm);
    let first = |what| run.first(what).time_s;
    let shutdown_s = first("controlword 0x0006 by RPDO lost");
    for (word, after_s) in [("0x0002", 2.0), ("0x0000", 4.0)] {
        let what = format!("controlword {word} by SDO lost");
        let told: Vec<f64> = run
            .relay
            .iter()
            .filter(|seen| seen.what.ends_with(&what))
            .map(|seen| seen.time_s)
            .collect();
        println!("{what}: {} times from {:.2} s after shutdown", told.len(), told[0] - shutdown_s);
        assert!((15..=20).contains(&told.len()), "{told:?}");
        assert!((told[0] - shutdown_s - after_s).abs() < 0.2, "{told:?}");
    }
}

#[test]
fn statuswords_of_a_drive_that_no_longer_obeys_or_follows() {
    for (bit, reason) in [
        (
            "0x0200",
            "stage: insertion: the drive no longer obeys the bus (statusword 0x1037 operation \
             enabled, bit 9 clear): it will ignore a stop; press the emergency stop",
        ),
        (
            "0x0010",
            "stage: insertion: the drive has lost its supply (statusword 0x1227 operation enabled, \
             bit 4 clear), is an emergency stop pressed, or a fuse blown?",
        ),
        (
            "0x1000",
            "stage: insertion: the drive ignores its targets (statusword 0x0237 operation enabled, \
             bit 12 clear), does an input or another tool hold it?",
        ),
    ] {
        let rule = format!("node=1 from=4mm until=4.5mm clear={bit}");
        let Some(run) = run("relay-bit", &[&rule], &[]) else { return };
        run.was_stopped("becomes", reason);
    }
}

#[test]
fn a_drive_that_warns_goes_on() {
    let rules = ["node=2 from=4mm until=4.5mm set=0x0080"];
    let Some(run) = run("relay-warning", &rules, &[]) else { return };
    run.bench.assert_status(0);
    let said = "rotation: the drive warns (statusword 0x12B7 operation enabled, bit 7), 1 so far";
    assert!(run.bench.stderr.contains(said), "{}", run.bench.stderr);
}
