//! Frames from the bus during a run, and which of them stop the run.

use super::*;
use crate::canopen::cia402::DriveState;
use crate::canopen::nmt::{NmtState, heartbeat_frame};

#[test]
fn an_internal_limit_is_reported_once() {
    let mut bench = Bench::ready();
    bench.rotation.extra_bits = 1 << 11;
    bench.run_for(Duration::from_millis(100));
    let told = StageEvent::InternalLimit(Axis::Rotation);
    assert_eq!(bench.events.iter().filter(|event| **event == told).count(), 1);
}

#[test]
fn one_lost_tpdo1_is_tolerated_and_two_in_a_row_stop_both_axes() {
    let mut bench = Bench::ready();
    for missed in 1..=2 {
        bench.rotation.tpdos_lost = 1;
        bench.run_for(Duration::from_millis(50));
        assert_eq!(bench.stage.counters().feedback_missed, missed);
    }
    assert_eq!(bench.fault(), None);

    bench.rotation.tpdos_lost = 2;
    assert_eq!(
        bench.until_fault(),
        "rotation: no TPDO1 for 2 SYNCs in a row, check bus load, cable and the drive"
    );
    assert!(bench.until_stopped());
    assert_eq!(bench.insertion.state, DriveState::SwitchOnDisabled);
    assert_eq!(bench.rotation.nmt, NmtState::PreOperational);
}

/// A TPDO1 that is lost now and then is no fault.
#[test]
fn answers_that_are_lost_again_and_again_are_a_fault() {
    let mut bench = Bench::ready();
    let lose = |bench: &mut Bench| {
        bench.rotation.tpdos_lost = 1;
        bench.run_for(Duration::from_millis(50));
    };
    for _ in 0..3 {
        lose(&mut bench);
    }
    for _ in 0..5 {
        bench.run_for(Duration::from_secs(10));
        lose(&mut bench);
    }
    assert_eq!(bench.fault(), None);
    lose(&mut bench);
    assert_eq!(
        bench.until_fault(),
        "rotation: 4 TPDO1 are lost or late (limit 3): its positions may be 4 SYNCs old; check bus load, cable, and \
         what passes frames on"
    );
    assert!(bench.until_stopped());
}

/// A gateway whose queue grows: each answer comes, later and later.
#[test]
fn answers_that_come_ever_later_are_a_fault() {
    let mut bench = Bench::ready();
    for late_ms in [5, 15, 25, 35, 45] {
        assert_eq!(bench.fault(), None, "{late_ms} ms");
        bench.tpdo_delay = Duration::from_millis(late_ms);
        bench.run_for(Duration::from_millis(500));
    }
    let fault = bench.until_fault();
    assert!(fault.starts_with("insertion: 4 TPDO1 are lost or late (limit 3)"), "{fault}");
}

#[test]
fn the_fault_names_the_drive_that_is_silent_for_longer() {
    let mut bench = Bench::ready();
    bench.rotation.tpdos_lost = 2;
    bench.step();
    bench.insertion.tpdos_lost = 1;
    assert_eq!(
        bench.until_fault(),
        "rotation: no TPDO1 for 2 SYNCs in a row, check bus load, cable and the drive"
    );
}

#[test]
fn a_tpdo1_of_another_length_is_named() {
    let mut bench = Bench::ready();
    bench.rotation.tpdos_lost = 2;
    bench.receive(Frame::new(0x182, &[0; 8]));
    let said = bench.until_fault();
    let expected = "rotation: TPDO1 of 8 bytes after 2 SYNCs in a row, 6 are mapped; ";
    assert!(said.starts_with(expected), "{said}");

    // One long ago is no reason.
    let mut bench = Bench::ready();
    bench.receive(Frame::new(0x182, &[0; 8]));
    bench.run_for(Duration::from_millis(50));
    bench.rotation.tpdos_lost = 2;
    assert!(bench.until_fault().starts_with("rotation: no TPDO1 for 2 SYNCs in a row"));
}

/// The fault after `disturb` in mid-run. It is the only one; then the axes lose power and the SYNCs end.
fn fault_in_mid_run(disturb: impl FnOnce(&mut Bench)) -> String {
    let mut bench = Bench::ready();
    bench.drive_on(10);
    disturb(&mut bench);
    let fault = bench.until_fault();
    assert!(bench.command(0.1, 0.1).is_err(), "no command is accepted after a fault");
    bench.until_stopped();
    for drive in [&bench.insertion, &bench.rotation] {
        assert_ne!(drive.state, DriveState::OperationEnabled, "{fault}");
    }
    let faults = bench.events.iter().filter(|event| matches!(event, StageEvent::Fault(_))).count();
    assert_eq!(faults, 1, "only the first fault is reported");
    bench.sent.clear();
    bench.run_for(Duration::from_secs(1));
    let only_heartbeats = bench.sent.iter().all(|(_, f)| f.to_string() == "77F#05");
    assert!(only_heartbeats && bench.sent.len() >= 10, "{:?}", bench.sent);
    fault
}

#[test]
fn what_a_drive_reports_stops_the_run_with_its_reason() {
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
    let fault = fault_in_mid_run(|bench| bench.rotation.extra_bits = 1 << 13);
    assert!(fault.starts_with("rotation: following error reported by the drive"), "{fault}");
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
        "rotation: NMT state pre-operational instead of operational, is there another master, or an error in its error register (0x1001)?"
    );
}

#[test]
fn a_drive_that_restarts_is_reported_as_such_until_the_end() {
    let mut bench = Bench::ready();
    bench.receive(heartbeat_frame(bench.insertion.node, NmtState::BootUp));
    bench.until_stopped();
    let reports = bench.stage.drive_reports();
    assert!(reports.insertion.restarted && !reports.rotation.restarted);
}

#[test]
fn the_end_of_an_emergency_is_no_fault() {
    let mut bench = Bench::ready();
    bench.receive(bench.rotation.emergency(0x0000));
    bench.run_for(Duration::from_millis(100));
    assert!(bench.events.iter().any(|event| matches!(event, StageEvent::Emergency(..))));
    assert_eq!(bench.fault(), None);
}

#[test]
fn foreign_and_malformed_frames_are_counted_and_reported_ever_more_rarely() {
    let mut bench = Bench::ready();
    (bench.events, bench.seen) = (Vec::new(), 0);
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
    assert_eq!(bench.fault(), None);
}

#[test]
fn a_status_names_a_node_in_nmt_stopped() {
    let mut reader = StatusReader::new(&config(), Time::ZERO);
    while !reader.is_over() {
        let now = reader.deadline();
        reader.handle_frame(now, &heartbeat_frame(node(1), NmtState::Stopped));
        reader.handle_timeout(now);
    }
    let said = Axis::BOTH.map(|axis| reader.status(axis).unwrap_err());
    assert!(said[0].starts_with("insertion: the node is in NMT stopped, "), "{}", said[0]);
    assert!(said[1].starts_with("rotation: node 2 0x6041:00: no SDO reply"), "{}", said[1]);
}
