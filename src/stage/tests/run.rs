//! The run: timing, feedback, what stops it and how.

use super::*;
use crate::canopen::cia402::DriveState;
use crate::canopen::cob;
use crate::canopen::nmt::{NmtState, heartbeat_frame};

#[test]
fn set_points_go_to_both_axes_before_one_sync_and_come_back_measured() {
    let mut bench = Bench::ready();
    bench.sent.clear();
    bench.command(0.05, 0.1).expect("within limits");
    let feedback = bench.until_feedback();
    let frames: Vec<String> = bench.sent.iter().map(|(_, frame)| frame.to_string()).collect();
    // 1000 + 232 = 0x4D0 counts; -20 + 1206 = 0x4A2 counts.
    assert_eq!(frames[..3], ["201#0F00D0040000", "202#0F00A2040000", "080#"]);
    assert_eq!((feedback.measured.insertion_mm, feedback.measured.rotation_rad), (0.0, 0.0));
    assert!((feedback.commanded.insertion_mm - 0.05).abs() < 0.5 / f64::from(COUNTS_PER_MM));

    let next = bench.until_feedback();
    assert_eq!(next.sync, feedback.sync + 1);
    assert_eq!(next.time.since(feedback.time), Duration::from_millis(10));
    assert_eq!(next.measured.insertion_mm, next.commanded.insertion_mm, "it is there, and held");
    assert_eq!(next.measured.rotation_rad, next.commanded.rotation_rad);
}

/// It hears no PDO any more, but SDOs.
#[test]
fn a_drive_that_left_operational_loses_its_power_too() {
    let mut bench = Bench::ready();
    bench.drive_on(5);
    bench.rotation.nmt = NmtState::PreOperational;
    bench.until_fault();
    bench.until_stopped();
    assert_eq!(bench.rotation.state, DriveState::SwitchOnDisabled);
}

/// Five SYNCs of a quick cycle are no time: an axis at 0.4 mm/s moves 2 µm in them.
#[test]
fn a_slow_axis_of_a_quick_cycle_does_not_stand() {
    let mut config = config();
    config.bus.sync_ms = 1;
    let mut bench = Bench::new(config);
    bench.run_until(|event| matches!(event, StageEvent::Feedback(_)));
    bench.stage.disable(bench.now);
    let begun = bench.now;
    bench.run_until(|event| *event == StageEvent::Progress(Progress::Disabling));
    assert!(bench.now.since(begun) >= Duration::from_millis(50));
}

#[test]
fn a_limit_inside_a_drive_is_told_once() {
    let mut bench = Bench::ready();
    bench.rotation.extra_bits = 1 << 11;
    bench.run_for(Duration::from_millis(100));
    let told = StageEvent::InternalLimit(Axis::Rotation);
    assert_eq!(bench.events.iter().filter(|event| **event == told).count(), 1);
}

#[test]
fn a_later_command_replaces_an_earlier_one() {
    let mut bench = Bench::ready();
    bench.command(0.05, 0.0).expect("within limits");
    bench.command(-0.02, 0.0).expect("checked from what was sent, not from what was replaced");
    let feedback = bench.until_feedback();
    assert!((feedback.commanded.insertion_mm + 0.02).abs() < 1e-3);
}

/// The frames that `bench` sends from now to its next SYNC, with their times.
fn until_sync(bench: &mut Bench) -> Vec<(Time, String)> {
    let begun = bench.sent.len();
    while bench.sent.last().is_none_or(|(_, frame)| frame.cob_id() != Some(cob::SYNC)) {
        bench.step();
    }
    bench.sent[begun..].iter().map(|(time, frame)| (*time, frame.to_string())).collect()
}

#[test]
fn set_points_leave_at_once_and_the_sync_leaves_alone() {
    let mut bench = Bench::ready();
    bench.sent.clear();
    let commanded = bench.now;
    bench.command(0.05, 0.1).expect("within limits");
    let sent = until_sync(&mut bench);
    let [insertion, rotation, sync] = sent.as_slice() else { panic!("{sent:?}") };
    assert_eq!([&insertion.1, &rotation.1], ["201#0F00D0040000", "202#0F00A2040000"]);
    assert_eq!([insertion.0, rotation.0], [commanded; 2]);
    assert_eq!(sync, &(commanded + Duration::from_millis(10), "080#".to_owned()));
    // Without a new one they are held, and that is sent with the SYNC.
    bench.sent.clear();
    let sent = until_sync(&mut bench);
    let frames: Vec<&str> = sent.iter().map(|(_, frame)| frame.as_str()).collect();
    assert_eq!(frames, ["201#0F00D0040000", "202#0F00A2040000", "080#"]);
    assert!(sent.iter().all(|(time, _)| *time == sync.0 + Duration::from_millis(10)));
}

/// The drives have the next targets already when the stop comes.
#[test]
fn a_stop_replaces_targets_that_were_sent_ahead_of_the_sync() {
    for quick in [false, true] {
        let mut bench = Bench::ready();
        bench.sent.clear();
        bench.command(0.05, 0.1).expect("within limits");
        match quick {
            true => bench.stage.quick_stop(bench.now),
            false => bench.stage.disable(bench.now),
        }
        let sent = until_sync(&mut bench);
        let last = |id: &str| sent.iter().rfind(|(_, frame)| frame.starts_with(id)).unwrap();
        let controlword = if quick { "0200" } else { "0F00" };
        // Where the axes stood: 1000 = 0x3E8 and -20 counts.
        assert_eq!(last("201#").1, format!("201#{controlword}E8030000"));
        assert_eq!(last("202#").1, format!("202#{controlword}ECFFFFFF"));
        bench.until_stopped();
        assert_eq!((bench.insertion.counts, bench.rotation.counts), (1000, -20));
    }
}

#[test]
fn a_late_bench_skips_whole_periods_and_never_bursts() {
    let mut bench = Bench::ready();
    let due = bench.stage.sync.deadline;
    bench.sent.clear();
    bench.now = due + Duration::from_millis(35);
    bench.stage.handle_timeout(bench.now);
    bench.settle();
    let syncs = |bench: &Bench| {
        let is_sync = |(_, f): &&(Time, Frame)| f.cob_id() == Some(cob::SYNC);
        bench.sent.iter().filter(is_sync).map(|(time, _)| *time).collect::<Vec<_>>()
    };
    assert_eq!(syncs(&bench).len(), 1);
    assert!(bench.events.contains(&StageEvent::SyncSkipped(3)));
    assert_eq!(bench.stage.counters().syncs_skipped, 3);
    bench.run_for(Duration::from_millis(5));
    assert_eq!(syncs(&bench)[1], due + Duration::from_millis(40), "the beat is absolute");
}

#[test]
fn one_lost_position_is_tolerated_and_the_second_stops_both_axes() {
    let mut bench = Bench::ready();
    for missed in 1..=3 {
        bench.rotation.tpdos_lost = 1;
        bench.run_for(Duration::from_millis(50));
        assert_eq!(bench.stage.counters().feedback_missed, missed);
    }
    assert!(!bench.events.iter().any(|event| matches!(event, StageEvent::Fault(_))));

    bench.rotation.tpdos_lost = 2;
    assert_eq!(
        bench.until_fault().to_string(),
        "rotation: no TPDO1 for 2 SYNCs in a row, check bus load, cable and the drive"
    );
    assert!(bench.until_stopped());
    assert_eq!(bench.insertion.state, DriveState::SwitchOnDisabled);
    assert_eq!(bench.rotation.nmt, NmtState::PreOperational);
}

/// Holding for one SYNC is no acceleration that was asked for: 10 mm/s² are 4.6 counts a SYNC, per
/// SYNC, and the axis is on its way at 46 counts a SYNC.
#[test]
fn one_lost_position_is_no_acceleration() {
    let mut config = config();
    config.insertion.limits.acceleration_max = Some(10.0);
    let mut bench = Bench::new(config);
    let feedback = bench.until_feedback();
    let (mut at, mut speed) = (feedback.commanded.insertion_mm, 0.0);
    for sync in 0..100 {
        if speed < 1.0 {
            speed += 0.1;
        }
        at += speed * 0.01;
        bench.command(at, 0.0).expect("within limits");
        bench.rotation.tpdos_lost = u32::from(sync == 50);
        let held = bench.until_feedback().commanded.insertion_mm;
        assert!((at - held).abs() < 1e-3, "{at} {held}");
    }
    assert_eq!(bench.stage.counters().feedback_missed, 1);
    // From a standstill it is one again.
    bench.run_for(Duration::from_millis(30));
    bench.until_feedback();
    let refused = bench.command(at + 0.01, 0.0).expect_err("refused");
    assert!(refused.to_string().contains("over the limit of 10.000 mm/s²"), "{refused}");
}

/// As many as may be lost.
#[test]
fn positions_that_may_be_lost_are_no_acceleration() {
    let mut config = config();
    config.insertion.limits.acceleration_max = Some(10.0);
    config.bus.missed_feedback_max = 3;
    let mut bench = Bench::new(config);
    let feedback = bench.until_feedback();
    let (mut at, mut speed) = (feedback.commanded.insertion_mm, 0.0);
    for sync in 0..60 {
        speed += if speed < 1.0 { 0.1 } else { 0.0 };
        at += speed * 0.01;
        bench.command(at, 0.0).expect("within limits");
        bench.rotation.tpdos_lost = if sync == 50 { 3 } else { 0 };
        bench.until_feedback();
    }
    assert_eq!(bench.stage.counters().feedback_missed, 3);
    bench.run_for(Duration::from_millis(50));
    bench.until_feedback();
    bench.command(at + 0.01, 0.0).expect_err("from a standstill");
}

#[test]
fn the_drive_that_is_silent_for_longer_is_named() {
    let mut bench = Bench::ready();
    bench.rotation.tpdos_lost = 2;
    bench.step();
    bench.insertion.tpdos_lost = 1;
    assert_eq!(
        bench.until_fault().to_string(),
        "rotation: no TPDO1 for 2 SYNCs in a row, check bus load, cable and the drive"
    );
}

#[test]
fn no_command_is_taken_on_old_positions() {
    let mut bench = Bench::ready();
    bench.rotation.tpdos_lost = 1;
    bench.step();
    let refused = bench.command(0.01, 0.0).expect_err("refused");
    assert!(refused.ends_with("have not arrived; older ones must not be used"), "{refused}");
    bench.until_feedback();
    bench.command(0.01, 0.0).expect("fresh again");
}

#[test]
fn a_refused_command_moves_neither_axis() {
    let mut bench = Bench::ready();
    let refused = bench.command(0.05, 5.0).expect_err("refused");
    assert_eq!(
        refused.to_string(),
        "rotation: a step of 286.479 deg in one SYNC is 28647.890 deg/s, over the limit of 1145.916 deg/s \
         (stage.rotation.speed_max_deg_per_s)"
    );
    let feedback = bench.until_feedback();
    assert_eq!((feedback.commanded.insertion_mm, feedback.commanded.rotation_rad), (0.0, 0.0));
    assert!(bench.command(f64::NAN, 0.0).is_err());
    assert!(bench.command(0.0, f64::INFINITY).is_err());
}

fn fault_in_mid_run(spoil: impl FnOnce(&mut Bench)) -> String {
    let mut bench = Bench::ready();
    bench.drive_on(10);
    spoil(&mut bench);
    let fault = bench.until_fault().to_string();
    assert!(bench.command(0.1, 0.1).is_err(), "it takes no command after a fault");
    bench.until_stopped();
    for drive in [&bench.insertion, &bench.rotation] {
        assert_ne!(drive.state, DriveState::OperationEnabled, "{fault}");
    }
    let faults = bench.events.iter().filter(|event| matches!(event, StageEvent::Fault(_))).count();
    assert_eq!(faults, 0, "the first fault is the reason");
    bench.sent.clear();
    bench.run_for(Duration::from_secs(1));
    let only_heartbeats = bench.sent.iter().all(|(_, f)| f.to_string() == "77F#05");
    assert!(only_heartbeats && bench.sent.len() >= 10, "{:?}", bench.sent);
    fault
}

#[test]
fn whatever_a_drive_reports_stops_the_run_by_name() {
    assert_eq!(
        fault_in_mid_run(|bench| bench.receive(bench.rotation.emergency(0x8611))),
        "rotation: emergency 0x8611 following error (register 0x21)"
    );
    assert_eq!(
        fault_in_mid_run(|bench| bench.insertion.state = DriveState::Fault),
        "insertion: drive in fault (statusword 0x0218 fault)"
    );
    assert_eq!(
        fault_in_mid_run(|bench| bench.insertion.state = DriveState::SwitchedOn),
        "insertion: drive left operation enabled (statusword 0x0233 switched on), \
         was an enable or limit switch opened?"
    );
    let text = fault_in_mid_run(|bench| bench.rotation.extra_bits = 1 << 13);
    assert!(text.starts_with("rotation: following error reported by the drive"), "{text}");
}

#[test]
fn an_axis_far_from_its_target_stops_the_run() {
    // The axis is ahead by 1 mm; 2 SYNC periods and 30 ms at 10 mm/s are 0.5 mm.
    let mut bench = Bench::ready();
    bench.drive_on(10);
    let report = [0x37, 0x02].into_iter().chain((1000 + 5111_i32).to_le_bytes());
    bench.insertion.tpdos_lost = 1;
    bench.run_for(Duration::from_millis(10));
    bench.receive(Frame::new(0x181, &report.collect::<Vec<_>>()));
    assert_eq!(
        bench.until_fault().to_string(),
        "insertion: following error of -1.000 mm (limit 0.500); is the axis blocked, or the \
         encoder lost?"
    );
}

/// The fault of a depth reported `off_mm` from its target, at 10 mm/s at most, if it is one.
fn fault_of_a_depth_off(sync_ms: u16, window_mm: Option<f64>, off_mm: f64) -> Option<String> {
    let mut config = config();
    config.bus.sync_ms = sync_ms;
    config.insertion.following_error_max = window_mm;
    let mut bench = Bench::new(config);
    bench.until_feedback();
    bench.insertion.tpdos_lost = 1;
    bench.run_for(Duration::from_millis(sync_ms.into()));
    let counts = 1000 + (off_mm * f64::from(COUNTS_PER_MM)).round() as i32;
    let report = [0x37, 0x02].into_iter().chain(counts.to_le_bytes());
    bench.receive(Frame::new(0x181, &report.collect::<Vec<_>>()));
    bench.events.iter().find_map(|event| match event {
        StageEvent::Fault(fault) => Some(fault.clone()),
        _ => None,
    })
}

#[test]
fn how_far_an_axis_may_lag_is_a_matter_of_the_drive_and_not_of_the_sync_period() {
    for (sync_ms, window_mm, limit_mm) in [
        (1, None, 0.32),
        (10, None, 0.5),
        (100, None, 2.3),
        (1, Some(0.2), 0.22),
        (10, Some(1.0), 1.2),
        (100, Some(0.2), 2.2),
    ] {
        let fault = |off_mm| fault_of_a_depth_off(sync_ms, window_mm, off_mm);
        assert_eq!(fault(limit_mm - 0.01), None, "{sync_ms} ms");
        assert_eq!(fault(0.01 - limit_mm), None, "{sync_ms} ms");
        let too_far = fault(limit_mm + 0.01).expect("too far");
        assert!(too_far.contains(&format!("(limit {limit_mm:.3})")), "{too_far}");
        assert!(fault(-limit_mm - 0.01).is_some());
    }
}

#[test]
fn a_narrow_window_and_a_long_sync_period_let_the_axis_run_at_its_highest_speed() {
    let mut config = config();
    config.bus.sync_ms = 100;
    config.insertion.following_error_max = Some(0.2);
    let mut bench = Bench::new(config);
    bench.until_feedback();
    for step in 1..=20 {
        bench.command(f64::from(step) * 0.999, 0.0).expect("within limits");
        bench.until_feedback();
    }
    assert!(!bench.events.iter().any(|event| matches!(event, StageEvent::Fault(_))));
}

#[test]
fn a_drive_that_falls_silent_restarts_or_leaves_operational_stops_the_run() {
    assert_eq!(
        fault_in_mid_run(|bench| bench.insertion.heartbeat_off = true),
        "insertion: no heartbeat for 300 ms, is the drive powered and on the bus?"
    );
    assert_eq!(
        fault_in_mid_run(|bench| {
            bench.receive(heartbeat_frame(bench.insertion.node, NmtState::BootUp));
        }),
        "insertion: boot-up message in mid-run, the drive restarted; is its supply stable?"
    );
    assert_eq!(
        fault_in_mid_run(|bench| {
            bench.receive(heartbeat_frame(bench.rotation.node, NmtState::PreOperational));
        }),
        "rotation: NMT state pre-operational instead of operational, is there another master?"
    );
}

#[test]
fn a_drive_that_lost_power_does_not_keep_the_stage_from_ending() {
    let mut bench = Bench::ready();
    bench.rotation.off = true;
    bench.until_fault();
    let began = bench.now;
    assert!(!bench.until_stopped(), "its standstill was not seen");
    assert_ne!(bench.rotation.value(0x1016, 1), 0);
    assert!(bench.now.since(began) <= 2 * Duration::from_secs(2) + Duration::from_millis(20));
}

#[test]
fn the_end_of_an_emergency_is_no_fault() {
    let mut bench = Bench::ready();
    bench.receive(bench.rotation.emergency(0x0000));
    bench.run_for(Duration::from_millis(100));
    assert!(bench.events.iter().any(|event| matches!(event, StageEvent::Emergency(..))));
    assert!(!bench.events.iter().any(|event| matches!(event, StageEvent::Fault(_))));
}

#[test]
fn quick_stop_brakes_under_power_until_both_axes_stand() {
    let mut bench = Bench::ready();
    let before = bench.drive_on(50);
    bench.stage.quick_stop(bench.now);
    bench.sent.clear();
    assert!(bench.until_stopped(), "seen to stand");
    // From 46 counts a cycle, one less each cycle.
    let travel =
        bench.insertion.counts - 1000 - (before.measured.insertion_mm * 4646.0).round() as i32;
    assert!((1000..=46 * 49 / 2).contains(&travel), "{travel} counts");
    assert!(bench.insertion.coasted_from <= 3, "power stays on until it stands");
    assert_eq!(bench.insertion.state, DriveState::SwitchOnDisabled);
    assert_eq!(bench.insertion.nmt, NmtState::PreOperational);
}

#[test]
fn an_orderly_end_holds_until_standstill_then_shuts_down() {
    let mut bench = Bench::ready();
    let before = bench.drive_on(20);
    bench.stage.disable(bench.now);
    assert!(bench.until_stopped());
    assert!(!bench.events.iter().any(|event| matches!(event, StageEvent::Fault(_))));
    assert_eq!(bench.insertion.state, DriveState::ReadyToSwitchOn);
    assert_eq!(bench.insertion.value(0x1016, 1), 0, "it may live without the bench now");
    let held = 1000 + (before.commanded.insertion_mm * f64::from(COUNTS_PER_MM)).round() as i32;
    assert_eq!(bench.insertion.counts, held);
    let quick = bench.sent.iter().any(|(_, f)| f.cob_id() == Some(0x201) && f.data()[0] == 0x02);
    assert!(!quick);
}

#[test]
fn a_fault_during_the_orderly_end_makes_it_a_quick_stop() {
    let mut bench = Bench::ready();
    bench.stage.disable(bench.now);
    bench.receive(bench.rotation.emergency(0x8611));
    assert!(bench.until_fault().starts_with("rotation: emergency 0x8611"));
    bench.until_stopped();
    assert!(bench.sent.iter().any(|(_, f)| f.to_string().starts_with("201#0200")));
}

#[test]
fn quick_stop_in_bring_up_ends_it() {
    let mut bench = Bench::new(config());
    bench.rotation.off = true;
    bench.run_for(Duration::from_millis(500));
    bench.stage.quick_stop(bench.now);
    assert!(!bench.until_stopped());
    assert!(bench.stage.bring_ups.all(Option::is_none));
}

#[test]
fn a_rotation_past_32_bits_goes_on() {
    let mut config = config();
    config.rotation.wraps = true;
    let mut bench = Bench::new(config);
    bench.rotation.counts = i32::MAX - 100;
    bench.until_feedback();
    bench.drive_on(10);
    let feedback = bench.until_feedback();
    assert!(bench.rotation.counts < 0, "it wrapped");
    assert!(
        (feedback.measured.rotation_rad - 0.1).abs() < 1e-4,
        "{}",
        feedback.measured.rotation_rad
    );
}

/// An insertion whose counts fall as it goes on, across the end of 32 bits where its drive wraps.
#[test]
fn a_reversed_axis_ends_at_its_own_limits() {
    let mut config = config();
    config.insertion.sign = Sign::Negative;
    config.insertion.wraps = true;
    (config.insertion.limits.min, config.insertion.limits.max) = (-0.1, 0.3);
    let mut bench = Bench::new(config);
    bench.insertion.counts = i32::MIN + 100;
    bench.until_feedback();
    for at in [0.1, 0.2, 0.3] {
        bench.command(at, 0.0).expect("within limits");
        bench.until_feedback();
    }
    let refused = bench.command(0.301, 0.0).expect_err("refused").to_string();
    assert_eq!(
        refused,
        "insertion: 0.301 mm is over the limit of 0.300 mm (stage.insertion.max_mm)"
    );
    let feedback = bench.until_feedback();
    assert!(
        (feedback.measured.insertion_mm - 0.3).abs() < 1e-3,
        "{}",
        feedback.measured.insertion_mm
    );
    assert_eq!(bench.insertion.counts, i32::MAX - 1293, "100 - 1394 counts from the end");
    for at in [0.2, 0.1, 0.0, -0.1] {
        bench.command(at, 0.0).expect("within limits");
        bench.until_feedback();
    }
    let refused = bench.command(-0.101, 0.0).expect_err("refused").to_string();
    assert_eq!(
        refused,
        "insertion: -0.101 mm is under the limit of -0.100 mm (stage.insertion.min_mm)"
    );
}

#[test]
fn foreign_and_malformed_frames_are_counted_and_told_ever_more_rarely() {
    let mut bench = Bench::ready();
    bench.events.clear();
    for _ in 0..9 {
        bench.receive(Frame::new(0x123, &[1, 2, 3]));
        bench.receive(Frame::new(0x181, &[0; 5]));
        bench.receive(Frame::new(0x701, &[]));
        bench.receive(Frame::new(0x182, &[0; 6]));
    }
    let count = |kind| bench.stage.counters().ignored[kind as usize];
    let counts = [Ignored::Foreign, Ignored::WrongLength, Ignored::Unexpected].map(count);
    assert_eq!(counts, [9, 18, 9]);
    let told = |kind| {
        let is_kind =
            |event: &&StageEvent| matches!(event, StageEvent::Ignored { why, .. } if *why == kind);
        bench.events.iter().filter(is_kind).count()
    };
    assert_eq!((told(Ignored::Foreign), told(Ignored::WrongLength)), (4, 5));
    assert!(!bench.events.iter().any(|event| matches!(event, StageEvent::Fault(_))));
}
