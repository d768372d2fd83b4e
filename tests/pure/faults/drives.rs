//! Faults of the drives.

use crate::support::bench::{Bench, configured, is_frame};
use crate::support::program::{Scratch, needle_bench};
use crate::support::stop::{Stop, documented, stopped};
use needle_bench::canopen::cia402::{DriveState, Statusword};
use needle_bench::canopen::emcy::{Emcy, EmcyCode};
use needle_bench::canopen::{Frame, NodeId};
use needle_bench::emulator::fault::{Fault, FaultKind};
use serde_json::{Value, json};
use std::fs;
use std::time::Duration;

const TPDOS: [u16; 2] = [0x181, 0x182];

/// Switches the supply of these drives' power stages.
fn set_voltage(bench: &mut Bench, drives: &[usize], on: bool) {
    bench.stage.handle_timeout(bench.now);
    for drive in drives {
        bench.stage.change_drive(*drive, bench.now, &Fault::of(FaultKind::NoVoltage), !on);
    }
}

#[test]
fn one_lost_tpdo_is_tolerated() {
    let mut bench = Bench::new(configured(&["insertion.depth_mm=30"]));
    bench.run_to_mm(10.0);
    let mut lost = 0;
    bench.lose(move |input| {
        let now = is_frame(input, &TPDOS[..1]) && lost == 0;
        lost += i32::from(now);
        now
    });
    bench.run_to_end();
    assert!(bench.completed(), "{}", bench.reason());
    let (end_mm, _) = bench.stage.position_true(bench.now);
    assert!((end_mm - 30.0).abs() < 1e-3, "{end_mm}");
}

#[test]
fn tpdos_of_one_drive_lost() {
    for (cob_id, axis) in [(TPDOS[0], "insertion"), (TPDOS[1], "rotation")] {
        let stops = stopped(&[], |bench| bench.lose(move |input| is_frame(input, &[cob_id])));
        let reason = format!(
            "stage: {axis}: no TPDO1 for 2 SYNCs in a row, check bus load, cable and the drive"
        );
        match axis {
            "insertion" => documented(&stops, "tpdos_of_one_drive_lost", 30.0, &reason),
            _ => assert!(stops.iter().all(|stop| stop.bench.reason() == reason)),
        }
    }
}

/// The axis stands while its target goes on, and catches up if the set-points arrive again in time.
#[test]
fn set_points_lost_to_one_drive() {
    let lost_for = |time: Duration| {
        let mut bench = Bench::new(configured(&["insertion.depth_mm=30"]));
        bench.run_to_mm(10.0);
        bench.lose_to_drives(|frame| frame.cob_id() == Some(0x201));
        bench.run_for(time);
        bench.lose_to_drives(|_| false);
        bench.run_to_end();
        bench
    };
    let bench = lost_for(Duration::from_millis(200));
    assert!(bench.completed(), "{}", bench.reason());
    let bench = lost_for(Duration::from_secs(1));
    let expected = "stage: insertion: following error of 0.5";
    assert!(bench.reason().starts_with(expected), "{}", bench.reason());
}

#[test]
fn tpdos_of_both_drives_lost() {
    let stops = stopped(&[], |bench| bench.lose(|input| is_frame(input, &TPDOS)));
    let reason =
        "stage: insertion: no TPDO1 for 2 SYNCs in a row, check bus load, cable and the drive";
    documented(&stops, "tpdos_of_both_drives_lost", 30.0, reason);
}

#[test]
fn an_emergency_message() {
    let stops = stopped(&[], |bench| {
        let code = EmcyCode(0x4210);
        let emcy = Emcy { code, register: 0x09, manufacturer: [0; 5] };
        bench.inject(emcy.to_frame(NodeId::new(2).expect("a node")));
    });
    documented(
        &stops,
        "an_emergency_message",
        0.0,
        "stage: rotation: emergency 0x4210 device over-temperature (register 0x09)",
    );
}

#[test]
fn a_drive_without_power() {
    let stops = stopped(&[], |bench| set_voltage(bench, &[0], false));
    for stop in &stops {
        let [insertion, _] = stop.bench.stage.drives();
        assert_eq!(insertion.state(), DriveState::Fault);
    }
    documented(
        &stops,
        "a_drive_without_power",
        0.0,
        "stage: insertion: emergency 0x3220 DC link undervoltage (register 0x05)",
    );
}

#[test]
fn an_emergency_stop() {
    let stops = stopped(&[], |bench| set_voltage(bench, &[0, 1], false));
    documented(
        &stops,
        "an_emergency_stop",
        0.0,
        "stage: insertion: emergency 0x3220 DC link undervoltage (register 0x05)",
    );
}

#[test]
fn an_emergency_stop_that_is_released_moves_nothing() {
    let [stop, _] = stopped(&[], |bench| {
        set_voltage(bench, &[0, 1], false);
        bench.run_for(Duration::from_millis(20));
        set_voltage(bench, &[0, 1], true);
    });
    assert!(stop.travel()[1].0 < 1e-3, "it moved: {:?}", stop.travel());
}

#[test]
fn a_drive_that_restarts() {
    // As after a brown-out: the drive resets without a command on the bus.
    let stops = stopped(&[], |bench| {
        bench.stage.handle_frame(bench.now, &Frame::new(0x000, &[0x81, 1]));
    });
    documented(
        &stops,
        "a_drive_that_restarts",
        0.0,
        "stage: insertion: boot-up message in mid-run, the drive restarted; is its supply stable?",
    );
}

#[test]
fn a_heartbeat_lost() {
    let stops = stopped(&[], |bench| bench.lose(|input| is_frame(input, &[0x702])));
    documented(
        &stops,
        "a_heartbeat_lost",
        100.0,
        "stage: rotation: no heartbeat for 100 ms, is the drive powered and on the bus?",
    );
}

#[test]
fn an_nmt_command_of_another_master() {
    // Enter Pre-operational, to all nodes.
    let stops = stopped(&[], |bench| bench.inject(Frame::new(0x000, &[0x80, 0])));
    let reason = "stage: another master on the bus: an NMT command (000#8000); stop it, or give it \
                  other nodes: two masters cannot share an axis";
    documented(&stops, "an_nmt_command_of_another_master", 0.0, reason);
}

#[test]
fn nodes_that_leave_operational() {
    let stops = stopped(&[], |bench| {
        bench.stage.handle_frame(bench.now, &Frame::new(0x000, &[0x80, 0]));
    });
    let reason = stops[0].bench.reason();
    documented(&stops, "nodes_that_leave_operational", 30.0, &reason);
}

#[test]
fn a_frozen_position() {
    let stops = stopped(&[], |bench| {
        let mut first = None;
        bench.change_depth(move |counts| *first.get_or_insert(counts));
    });
    documented(
        &stops,
        "a_frozen_position",
        260.0,
        "stage: insertion: following error of 0.520 mm (limit 0.500); is the axis blocked, or the \
         encoder lost?",
    );
}

#[test]
fn a_position_that_jumps() {
    let stops = stopped(&[], |bench| {
        let mut jumps = 1;
        bench.change_depth(move |counts| {
            jumps -= 1;
            if jumps == 0 { counts + 46_460 } else { counts }
        });
    });
    for stop in &stops {
        let deepest = stop.bench.steps().map(|step| step.insertion_meas_mm).fold(0.0, f64::max);
        assert!(deepest < 10.2, "a step at the wrong depth: {deepest}");
    }
    let reason = stops[0].bench.reason();
    assert!(reason.ends_with("(limit 0.500); is the axis blocked, or the encoder lost?"));
    documented(&stops, "a_position_that_jumps", 10.0, &reason);
}

#[test]
fn a_depth_that_is_never_quite_reached() {
    let mut bench = Bench::new(configured(&["insertion.depth_mm=30"]));
    bench.run_to_mm(10.0);
    bench.change_depth(|counts| counts - 400);
    bench.run_to_mm(29.9999);
    let stop = Stop::of(bench, |_| ());
    documented(
        &[stop],
        "a_depth_that_is_never_quite_reached",
        2010.0,
        "insertion: stands at 29.9139 mm, 0.0861 mm from the 30.000 mm commanded (limit 0.050), \
         for 2.0 s; does the drive hold its target?",
    );
}

/// A run of `depth_mm` whose insertion drive once reports a position with bit 3 of this byte wrong, at `at_s`.
fn wrong_once(scratch: &Scratch, depth_mm: u32, at_s: f64, byte: u8, sets: &[&str]) -> Value {
    let insertion =
        format!("insertion={{ depth_mm = {depth_mm}, plane_out_of_reach = \"insert\" }}");
    let fault = format!(
        "emulator.fault=[{{ kind = \"corrupt\", at_s = {at_s}, frames = \"pdo\", axis = \"insertion\", \
         byte = {byte}, mask = 8, count = 1 }}]"
    );
    let mut arguments = vec!["run", "--json", "--set", &insertion, "--set", &fault];
    sets.iter().for_each(|set| arguments.extend(["--set", set]));
    needle_bench(scratch, &arguments).json()
}

/// As it begins, by 1.7 µm, and shortly before its end, by 0.44 mm.
#[test]
fn one_wrong_depth_neither_blocks_nor_ends_an_insertion() {
    let scratch = Scratch::new();
    for (at_s, byte) in [(0.165, 2), (1.625, 3), (1.655, 3)] {
        let run = wrong_once(&scratch, 3, at_s, byte, &[]);
        let depth_mm = run["insertion_mm"].as_f64().expect("a number");
        assert_eq!((&run["outcome"], &run["steps"]), (&json!("completed"), &json!(4)), "{run}");
        assert!((depth_mm - 3.0).abs() < 0.01, "{run}");
    }
}

#[test]
fn a_wrong_depth_as_the_insertion_begins_stops_it() {
    let run = wrong_once(&Scratch::new(), 3, 0.165, 3, &[]);
    let reason = run["stop_reason"].as_str().expect("stopped");
    assert!(
        reason.starts_with("insertion: stands at -0.4408 mm, 0.4408 mm from the 0.000"),
        "{run}"
    );
    assert_eq!(run["steps"], 0, "{run}");
}

/// The tip falls silent, after 120 positions. A wrong depth shortly before is not taken for a depth at which the tip
/// was seen.
#[test]
fn one_wrong_depth_hides_no_blind_insertion() {
    let scratch = Scratch::new();
    let seen = wrong_once(&scratch, 8, 100.0, 3, &[]);
    let run_dir = scratch.path().join(seen["run_dir"].as_str().expect("recorded"));
    let samples = fs::read_to_string(run_dir.join("tracker.ndjson")).expect("recorded");
    let first: Vec<&str> = samples.lines().take(120).collect();
    let file = scratch.write("silent.ndjson", &(first.join("\n") + "\n"));
    let file = format!("tracker.file=\"{}\"", file.display());
    let registration = "tracker.registration={ x_mm = 0.0, y_mm = 0.0, z_mm = 0.0, yaw_deg = 0.0, \
                        pitch_deg = 0.0, roll_deg = 0.0 }";
    let sets = ["tracker.source=ndjson", &file, "tracker.hold_after_s=2", registration];
    let [without, with] = [100.0, 2.965].map(|at_s| {
        let run = wrong_once(&scratch, 8, at_s, 3, &sets);
        let reason = run["stop_reason"].as_str().expect("stopped");
        assert!(reason.contains("to brake (limit 1.00)"), "{run}");
        run["insertion_mm"].as_f64().expect("a number")
    });
    assert!(with - without < 0.1, "{without} {with}");
}

/// The path begins at the estimate, which does not believe such a depth.
#[test]
fn one_wrong_depth_at_the_last_plan_moves_no_end() {
    let scratch = Scratch::new();
    let goal = "goal={ kind = \"target\", position_mm = [0, 0, 60] }";
    let law = "control.kind=nested-saturation";
    let [without, with] = [100.0, 30.285].map(|at_s| {
        let run = wrong_once(&scratch, 70, at_s, 3, &[goal, law]);
        assert_eq!(run["outcome"], "completed", "{run}");
        run["insertion_mm"].as_f64().expect("a number")
    });
    assert!((with - without).abs() < 0.1, "{without} {with}");
}

/// It goes 1.8 mm past its last target, as it should: the tip there is no jump.
#[test]
fn the_way_of_a_quick_stop_refuses_no_tip() {
    let sets = [
        "insertion={ depth_mm = 100, speed_mm_per_s = 6 }",
        "stage.insertion.quick_stop_deceleration_mm_per_s2=10",
        "emulator.fault=[{ kind = \"drive-fault\", at_s = 3, axis = \"rotation\", code = 0x2310 }]",
    ];
    let sets = sets.iter().flat_map(|set| ["--set", *set]);
    let arguments: Vec<&str> = ["run", "--quiet"].into_iter().chain(sets).collect();
    let said = needle_bench(&Scratch::new(), &arguments);
    assert_eq!(said.status, 1, "{}", said.screen());
    assert!(said.stdout.contains(" accepted, 0 refused\n"), "{}", said.stdout);
}

/// Clears `bits` in the insertion drive's statusword: the run stops for `reason`.
fn without_bits(test: &str, bits: u16, reason: &str) {
    let stops = stopped(&[], |bench| bench.change_tpdo(move |word, counts| (word & !bits, counts)));
    documented(&stops, test, 10.0, &format!("stage: insertion: {reason}"));
}

#[test]
fn a_drive_that_no_longer_obeys_the_bus() {
    let reason = "the drive no longer obeys the bus (statusword 0x1037 operation enabled, bit 9 \
                  clear): it will ignore a stop; press the emergency stop";
    without_bits("a_drive_that_no_longer_obeys_the_bus", Statusword::REMOTE, reason);
}

#[test]
fn a_drive_that_reports_no_voltage() {
    let reason = "the drive has lost its supply (statusword 0x1227 operation enabled, bit 4 clear), is \
                  an emergency stop pressed, or a fuse blown?";
    without_bits("a_drive_that_reports_no_voltage", Statusword::VOLTAGE_ENABLED, reason);
}

#[test]
fn a_drive_that_ignores_its_targets() {
    let reason = "the drive ignores its targets (statusword 0x0237 operation enabled, bit 12 clear), \
                  does an input or another tool hold it?";
    without_bits("a_drive_that_ignores_its_targets", Statusword::FOLLOWS_COMMAND, reason);
}

#[test]
fn a_warning_of_a_drive_is_reported_and_tolerated() {
    let mut bench = Bench::new(configured(&["insertion.depth_mm=30"]));
    bench.run_to_mm(10.0);
    let mut answers = 0;
    bench.change_tpdo(move |word, counts| {
        answers += 1;
        (word | if answers % 100 < 50 { Statusword::WARNING } else { 0 }, counts)
    });
    bench.run_to_end();
    assert!(bench.completed(), "{}", bench.reason());
    let reported: Vec<&str> = bench.events().filter(|text| text.contains("warns")).collect();
    let counts = [1, 2, 4, 8].map(|count| {
        format!(
            "insertion: the drive warns (statusword 0x12B7 operation enabled, bit 7), {count} so far; \
             see its manual and its display for why"
        )
    });
    assert_eq!(reported, counts);
}

/// The insertion drive ignores the last controlwords: those by RPDO, or those by SDO too.
#[test]
fn a_drive_that_keeps_its_power_at_the_end() {
    for ignores_sdo in [false, true] {
        let mut bench = Bench::new(configured(&["insertion.depth_mm=10"]));
        bench.run_to_mm(9.0);
        bench.lose_to_drives(move |frame| match (frame.cob_id(), frame.data()) {
            (Some(0x201), [word, ..]) => *word != 0x0f,
            (Some(0x601), [_, 0x40, 0x60, ..]) => ignores_sdo,
            _ => false,
        });
        bench.run_to_end();
        assert_eq!(
            bench.reason(),
            "stage: insertion: the drive still has power 2000 ms after shutdown (statusword 0x1237 \
             operation enabled); if it does not stop now, press the emergency stop"
        );
        let left = "off: press the emergency stop, then look at the stage";
        assert_eq!(bench.events().any(|text| text.ends_with(left)), ignores_sdo);
        let by_sdo = |word: u8| {
            let is_of_word = |frame: &&Frame| {
                frame.cob_id() == Some(0x601) && frame.data()[..5] == [0x2b, 0x40, 0x60, 0, word]
            };
            bench.sent.iter().filter(is_of_word).count()
        };
        // The bring-up wrote one of them. Out of Operational, this drive leaves Operation Enabled by itself.
        let expected = if ignores_sdo { (2, 21) } else { (1, 2) };
        assert_eq!((by_sdo(0x02), by_sdo(0x00)), expected);
        // A drive that still has power keeps its heartbeat consumer (1016).
        let supervision_off = "601#2316100100000000";
        assert_eq!(bench.sent.iter().any(|f| f.to_string() == supervision_off), !ignores_sdo);
        let (end_mm, _) = bench.stage.position_true(bench.now);
        assert!((end_mm - 10.0).abs() < 1e-3, "{end_mm}");
    }
}

/// At rest a drive may stand off its target, by friction or by the backlash of its gear. The insertion begins with
/// the target that the drive holds, and depth counts from the measured position.
#[test]
fn a_drive_that_stands_off_its_target() {
    // 1 mm/s is 46.46 counts in 10 ms.
    let cases = [302, -302, 139, -139].map(|counts| [(counts, "1", 47), (counts, "2", 93)]);
    for (offset_counts, mm_per_s, step_counts) in cases.into_iter().flatten() {
        let speed = format!("insertion.speed_mm_per_s={mm_per_s}");
        let mut bench =
            Bench::new(configured(&["insertion.depth_mm=30", "insertion.arrival_mm=0.02", &speed]));
        bench.change_tpdo(move |word, counts| {
            let enabled = Statusword(word).state() == Some(DriveState::OperationEnabled);
            (word, counts - if enabled { offset_counts } else { 0 })
        });
        bench.run_to_end();
        assert!(bench.completed(), "{offset_counts} counts: {}", bench.reason());
        let (end_mm, _) = bench.stage.position_true(bench.now);
        assert!((end_mm - 30.0).abs() < 1e-3, "{offset_counts} counts: {end_mm} mm");
        let target = |frame: &Frame| match frame.data() {
            [0x0f, 0, target @ ..] if frame.cob_id() == Some(0x201) => {
                target.try_into().ok().map(i32::from_le_bytes)
            }
            _ => None,
        };
        let targets: Vec<i32> = bench.sent.iter().filter_map(target).collect();
        let steps = targets.windows(2).map(|pair| pair[1] - pair[0]);
        let (least, most) = steps.fold((0, 0), |(a, b), step| (a.min(step), b.max(step)));
        assert_eq!((least, most), (0, step_counts), "{offset_counts} counts at {mm_per_s} mm/s");
        let last = bench.steps().last().expect("steps");
        assert_eq!(last.step, 30);
        assert!((last.insertion_meas_mm - 30.0).abs() < 0.01, "{}", last.insertion_meas_mm);
        // The offset is no wrong reading: the tip is paired with depths without it. At the end the needle brakes.
        for step in bench.steps().skip(1) {
            let (Some(depth_mm), Some(age_s)) = (step.tip_meas_insertion_mm, step.tip_meas_age_s)
            else {
                continue;
            };
            let speed: f64 = mm_per_s.parse().expect("a number");
            let expected_mm = step.insertion_meas_mm - speed * age_s;
            assert!(
                (depth_mm - expected_mm).abs() < 0.013 || step.step == 30,
                "{depth_mm} {expected_mm}"
            );
        }
    }
}

/// By 20 counts at rest, as real drives are.
#[test]
fn a_depth_short_by_a_few_counts_is_accepted() {
    let mut bench = Bench::new(configured(&["insertion.depth_mm=30"]));
    bench.run_to_mm(10.0);
    bench.change_depth(|counts| counts - 20);
    bench.run_to_end();
    assert!(bench.completed(), "{}", bench.reason());
    let last = bench.steps().last().expect("steps");
    assert_eq!(last.step, 30);
    assert!((last.insertion_meas_mm - 30.0).abs() < 0.01);
}
