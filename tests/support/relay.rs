//! Runs at 1 mm/s and 10 ms SYNC through tests/peers/can_relay.py, a relay between bench and drives that changes
//! frames on their way.

use super::peers::peer;
use super::programs::{Ended, Scratch};
use super::udp_stage::Stage;
use std::net::SocketAddrV4;

/// The two buses that the relay stands between.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Buses {
    Udp,
    /// The bench on vcan0, the drives on vcan1.
    Vcan,
}

impl Buses {
    /// Travel of a needle at 1 mm/s during a stall of the machine, mm: an emulated one stalls for half a second.
    fn stall_travel_mm(self) -> f64 {
        match self {
            Buses::Udp => 0.0,
            Buses::Vcan => 0.5,
        }
    }
}

/// In an emulated machine on a slow host the relay passes on answers of the drives after more than 300 ms, and a SYNC
/// every 10 ms is too much for it. A statusword comes up to 30 ms later so; the bounds on what follows stay as they
/// are at 10 ms. The same runs over UDP have the limits of the others.
const PATIENCE_ON_VCAN: [&str; 3] =
    ["can.sync_ms=40", "can.missed_feedback_max=50", "can.sdo_timeout_ms=1000"];

/// A run through the relay.
struct Relayed {
    buses: Buses,
    bench: Ended,
    /// What the relay printed.
    relay: Vec<Seen>,
    /// Position of the insertion drive at the end, mm.
    stands_at_mm: f64,
}

/// A line that the relay printed.
#[derive(Debug, Clone)]
struct Seen {
    time_s: f64,
    depth_mm: f64,
    what: String,
}

/// Runs 3 mm with these rules of the relay and settings of the bench; `None` without the peer.
fn run(buses: Buses, test: &str, rules: &[&str], settings: &[&str]) -> Option<Relayed> {
    run_on(buses, &[], test, rules, settings)
}

/// As [`run`], on a virtual stage with these arguments.
fn run_on(
    buses: Buses,
    stage: &[&str],
    test: &str,
    rules: &[&str],
    settings: &[&str],
) -> Option<Relayed> {
    let (stage, bench_side, drives_side) = match buses {
        Buses::Udp => {
            let stage = Stage::start(stage);
            // No other test uses the group, so the next port is free too.
            let bench_side = SocketAddrV4::new(*stage.group.ip(), stage.group.port() + 1);
            let drives_side = format!("udp:{}", stage.group);
            (stage, format!("udp:{bench_side}"), drives_side)
        }
        Buses::Vcan => (Stage::start_on("vcan1", stage), "vcan0".to_owned(), "vcan1".to_owned()),
    };
    let mut arguments = vec!["--bench", &bench_side, "--drives", &drives_side];
    rules.iter().for_each(|rule| arguments.extend(["--rule", rule]));
    let mut relay = peer("can_relay.py", &arguments)?;
    relay.wait_for("relaying");
    let scratch = Scratch::new(test);
    let bus = format!("can.interface=\"{bench_side}\"");
    let own = [
        "insertion={ depth_mm = 3, plane_out_of_reach = \"insert\" }",
        "insertion.speed_mm_per_s=1",
        // An emulated machine may be held up for longer than a second.
        "tracker.hold_after_s=2",
        "can.heartbeat_timeout_ms=2000",
        &bus,
    ];
    let patience = match buses {
        Buses::Udp => &[][..],
        Buses::Vcan => &PATIENCE_ON_VCAN[..],
    };
    let settings = [&own[..], patience, settings].concat();
    let bench = scratch.bench(&["--json"], &stage.settings(&settings)).end();
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
    Some(Relayed { buses, bench, relay, stands_at_mm: stage.assert_it_stands() })
}

impl Relayed {
    #[track_caller]
    fn first(&self, what: &str) -> &Seen {
        let found = self.relay.iter().find(|seen| seen.what.contains(what));
        found.unwrap_or_else(|| panic!("{what}: not among {:?}", self.relay))
    }

    /// Asserts that the run was stopped for `reason`: soon after the relay did `what`, the bench sent a quick stop
    /// to the insertion drive by SDO, and the drive stood soon after that.
    #[track_caller]
    fn assert_stopped(&self, what: &str, reason: &str) {
        self.bench.assert_status(1);
        assert_eq!(self.bench.json()["stop_reason"], reason);
        let (fault, stop) = (self.first(what), self.first("controlword 0x0002 by SDO"));
        let after_ms = (stop.time_s - fault.time_s) * 1e3;
        let until_mm = stop.depth_mm - fault.depth_mm;
        let then_mm = self.stands_at_mm - stop.depth_mm;
        println!("{after_ms:.1} ms, {until_mm:.3} mm until, {then_mm:.3} mm then");
        // A busy machine stalls the bench and its SYNCs; without SYNC the axes do not move on.
        let late_max_ms = match self.buses {
            Buses::Udp => 500.0,
            Buses::Vcan => 3000.0,
        };
        let until_max_mm = 0.05 + self.buses.stall_travel_mm();
        assert!(
            (0.0..late_max_ms).contains(&after_ms) && until_mm < until_max_mm,
            "stopped after {after_ms} ms and {until_mm} mm"
        );
        self.assert_stood_after(stop);
    }

    /// Asserts that the insertion drive stood soon after this was seen.
    #[track_caller]
    fn assert_stood_after(&self, seen: &Seen) {
        let then_mm = self.stands_at_mm - seen.depth_mm;
        assert!((-0.001..0.1 + self.buses.stall_travel_mm()).contains(&then_mm), "{then_mm} mm");
    }
}

/// The drive is in Fault when the bench finds it, and is reset before it is enabled. A later emergency is a new
/// fault.
pub(crate) fn a_new_emergency_of_a_drive_that_was_found_in_fault_stops_the_run(buses: Buses) {
    let rules = ["node=1 until=1sync set=0x0008 clear=0x0067", "node=1 from=2mm emcy=0x8611"];
    let settings = ["stage.fault_reset_on_start=true"];
    let Some(run) = run(buses, "relay-emcy", &rules, &settings) else { return };
    run.assert_stopped(
        "emergency 0x8611",
        "stage: insertion: emergency 0x8611 following error (register 0x21)",
    );
}

/// The stop reason has the code of the emergency message as it arrives; if the message is lost, the statusword.
pub(crate) fn a_drive_fault_stops_the_run_if_its_emergency_message_is_changed_or_lost(
    buses: Buses,
) {
    let fault = r#"emulator.fault=[{ at_mm = 2, kind = "drive-fault", axis = "insertion", code = 0x4210 }]"#;
    for (rule, seen, reason) in [
        ("node=1 edit=0x8611", "becomes", "stage: insertion: emergency 0x8611 following error"),
        ("node=1 drop=emcy", "lost", "stage: insertion: drive in fault (statusword 0x021"),
    ] {
        let Some(run) = run_on(buses, &["--set", fault], "relay-edit", &[rule], &[]) else {
            return;
        };
        run.bench.assert_status(1);
        let stop_reason = run.bench.json()["stop_reason"].as_str().unwrap().to_owned();
        assert!(stop_reason.starts_with(reason), "{stop_reason}");
        run.assert_stood_after(run.first(seen));
    }
}

pub(crate) fn a_drive_that_ignores_every_command_to_power_off_is_reported(buses: Buses) {
    let rules = ["node=1 from=2mm hold=0x000f"];
    let Some(run) = run(buses, "relay-hold", &rules, &[]) else { return };
    run.bench.assert_status(1);
    assert_eq!(
        run.bench.json()["stop_reason"],
        "stage: insertion: the drive still has power 2000 ms after shutdown (statusword 0x1237 \
         operation enabled); if it does not stop now, press the emergency stop"
    );
    let advice = "off: press the emergency stop, then look at the stage";
    assert!(run.bench.stderr.contains(advice), "{}", run.bench.stderr);
    assert!((run.stands_at_mm - 3.0).abs() < 0.01, "{}", run.stands_at_mm);
    let first = |what| run.first(what).time_s;
    let shutdown_s = first("controlword 0x0006 by RPDO lost");
    // Before the second quick stop its node leaves Operational. Then this drive stops by itself (6007).
    for (word, after_s, is_repeated) in [("0x0002", 2.0, false), ("0x0000", 2.25, true)] {
        let what = format!("controlword {word} by SDO lost");
        let times_s: Vec<f64> = run
            .relay
            .iter()
            .filter(|seen| seen.what.ends_with(&what))
            .map(|seen| seen.time_s)
            .collect();
        println!(
            "{what}: {} times from {:.2} s after shutdown",
            times_s.len(),
            times_s[0] - shutdown_s
        );
        let (late_max_s, least) = match buses {
            Buses::Udp => (0.2, 15),
            Buses::Vcan => (3.0, 10),
        };
        let least = if is_repeated { least } else { 1 };
        assert!((least..=20).contains(&times_s.len()), "{times_s:?}");
        let late_s = times_s[0] - shutdown_s - after_s;
        assert!((-0.2..late_max_s).contains(&late_s), "{times_s:?}");
    }
}

/// The bits are remote, voltage enabled, and drive follows command. On vcan, where a run takes long, only the
/// second is tested; there a scripted fault clears the first.
pub(crate) fn statusword_bit_9_4_or_12_cleared_stops_the_run(buses: Buses) {
    let bits = [
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
    ];
    let tested = match buses {
        Buses::Udp => 0..3,
        Buses::Vcan => 1..2,
    };
    for (bit, reason) in &bits[tested] {
        let rule = format!("node=1 from=2mm until=2.5mm clear={bit}");
        let Some(run) = run(buses, "relay-bit", &[&rule], &[]) else { return };
        run.assert_stopped("becomes", reason);
    }
}

/// The warning is bit 7 of the statusword.
pub(crate) fn a_run_completes_although_a_drive_warns(buses: Buses) {
    let rules = ["node=2 from=2mm until=2.5mm set=0x0080"];
    let Some(run) = run(buses, "relay-warning", &rules, &[]) else { return };
    run.bench.assert_status(0);
    let said = "rotation: the drive warns (statusword 0x12B7 operation enabled, bit 7), 1 so far";
    assert!(run.bench.stderr.contains(said), "{}", run.bench.stderr);
}
