//! Another master, and other senders.

use super::*;
use crate::canopen::cia402::DriveState;
use crate::canopen::nmt::{NmtState, heartbeat_frame};

/// The stage only listens at first. A read by another node is no reason to stop.
#[test]
fn another_master_heard_before_the_start_is_a_fault_and_nothing_is_sent() {
    for frame in [
        Frame::new(0x080, &[]),
        Frame::new(0x202, &[0x0F, 0, 1, 0, 0, 0]),
        heartbeat_frame(node(127), NmtState::Operational),
        Frame::new(0x601, &[0x2B, 0x40, 0x60, 0, 0x0F, 0, 0, 0]),
    ] {
        let mut bench = Bench::new(config());
        bench.receive(Frame::new(0x601, &[0x40, 0x41, 0x60, 0, 0, 0, 0, 0]));
        bench.receive(frame);
        let fault = bench.until_fault();
        let named = fault.starts_with("another master on the bus: ");
        assert!(named && fault.contains(&format!("({frame})")), "{fault}");
        assert!(!bench.until_stopped());
        bench.run_for(Duration::from_secs(1));
        assert_eq!(bench.sent, []);
    }
}

#[test]
fn nothing_is_sent_while_the_stage_listens_for_another_master() {
    let mut bench = Bench::new(config());
    let begun = bench.now;
    bench.until_ready();
    let first = bench.sent.first().expect("frames of the bring-up").0;
    assert_eq!(first.since(begun), config().listen_first);
}

#[test]
fn another_master_stops_a_stage_at_its_first_frame() {
    let frames = [
        (Frame::new(0x201, &[0x0F, 0, 0, 0x25, 0, 0]), "RPDO1 of a drive (201#0F0000250000)"),
        (Frame::new(0x080, &[]), "SYNC (080#)"),
        (Frame::new(0x000, &[0x80, 1]), "an NMT command (000#8001)"),
        (
            Frame::new(0x601, &[0x23, 0x16, 0x10, 1, 0, 0, 0, 0]),
            "a write to a drive's object dictionary (601#2316100100000000)",
        ),
        (Frame::new(0x77F, &[5]), "a heartbeat of the bench's own node number (77F#05)"),
    ];
    for (frame, named) in frames {
        let mut bench = Bench::ready();
        bench.drive_on(5);
        bench.receive(frame);
        let fault = bench.until_fault();
        assert!(
            fault.starts_with(&format!("another master on the bus: {named}; stop it")),
            "{fault}"
        );
        assert!(bench.until_stopped());
    }
}

/// In Stopped a node takes neither PDO nor SDO, so a quick stop by SDO alone would be lost.
#[test]
fn drives_that_another_master_sends_to_nmt_stopped_are_stopped() {
    let mut bench = Bench::ready();
    bench.drive_on(5);
    for drive in [&mut bench.insertion, &mut bench.rotation] {
        drive.nmt = NmtState::Stopped;
    }
    bench.receive(Frame::new(0x000, &[2, 0]));
    assert!(bench.until_fault().contains("an NMT command (000#0200)"));
    let heartbeat = Duration::from_millis(110);
    bench.run_for(heartbeat);
    for drive in [&bench.insertion, &bench.rotation] {
        assert_eq!(drive.state, DriveState::QuickStopActive);
    }
    assert!(bench.until_stopped());
    for drive in [&bench.insertion, &bench.rotation] {
        assert_eq!(drive.state, DriveState::SwitchOnDisabled);
        assert_eq!(drive.nmt, NmtState::PreOperational);
    }
}

/// The answer of the other sender may come first and is then used once; two SYNCs show that there are two.
#[test]
fn two_senders_of_one_tpdo1_are_a_fault_after_two_syncs() {
    let mut bench = Bench::ready();
    for _ in 0..2 {
        bench.until_feedback();
        bench.receive(Frame::new(0x181, &[0x37, 0x12, 1, 0, 0, 0]));
    }
    let fault = bench.until_fault();
    assert!(fault.starts_with("insertion: two TPDO1 that differ after each of 2 SYNCs"), "{fault}");
}

/// The second drive may answer later than the first. Nothing is written to either, but power off.
#[test]
fn two_drives_of_one_node_number_are_a_fault_before_power() {
    for (delay_ms, later_ms, extra) in [(0, 0, 6), (1, 0, 6), (100, 0, 6), (2, 3, 5)] {
        let mut bench = Bench::new(config());
        bench.twin_later = Some(Duration::from_millis(later_ms));
        bench.sdo_delay = Duration::from_millis(delay_ms);
        assert_eq!(
            bench.until_fault(),
            format!(
                "node 1 (insertion): {extra} answers more than requests: two drives have this node \
                 number, give one of them another"
            )
        );
        assert!(!bench.until_stopped());
        let to_node = bench.sent.iter().filter(|(_, frame)| frame.cob_id() == Some(0x601));
        let written: Vec<String> = to_node
            .filter(|(_, frame)| frame.data()[0] >> 5 == 1)
            .map(|(_, frame)| frame.to_string())
            .collect();
        assert_eq!(written, ["601#2B40600000000000"], "Disable Voltage");
    }
}

/// A tool that reads the drive in the bring-up is answered too, and its answers look like those of a second drive.
#[test]
fn extra_answers_are_no_fault_while_another_client_asks_the_drive() {
    let mut bench = Bench::new(config());
    bench.twin_later = Some(Duration::ZERO);
    bench.sdo_delay = Duration::from_millis(1);
    bench.until_progress(StageProgress::BringUp(Axis::Insertion, "checking its identity"));
    bench.receive(Frame::new(0x601, &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0]));
    bench.until_ready();
    assert_eq!(bench.fault(), None);
}

#[test]
fn the_status_names_two_drives_of_one_node_number() {
    for (answers, extra) in [(1, 0), (2, 11)] {
        let mut reader = StatusReader::new(&config(), Time::ZERO);
        let mut drives = [TestDrive::new(node(1), 0), TestDrive::new(node(2), 0)];
        while let Some(frame) = reader.poll_transmit() {
            for drive in &mut drives {
                for answer in drive.handle_frame(Time::ZERO, &frame) {
                    (0..answers).for_each(|_| reader.handle_frame(Time::ZERO, &answer));
                }
            }
        }
        assert!(reader.is_over());
        for axis in Axis::BOTH {
            assert_eq!(reader.status(axis).map(|status| status.extra_answers), Ok(extra));
        }
    }
}

/// A bus repeats a frame after a lost acknowledgement.
#[test]
fn a_repeated_tpdo1_is_counted_and_no_fault() {
    let mut bench = Bench::ready();
    for _ in 0..20 {
        bench.until_feedback();
        let second = bench.insertion.last_tpdo.expect("it answered");
        bench.receive(second);
    }
    bench.run_for(Duration::from_millis(100));
    assert_eq!(bench.stage.counters().ignored[Ignored::Unexpected as usize], 20);
    assert_eq!(bench.fault(), None);
}

#[test]
fn a_flood_on_the_drives_own_identifiers_is_reported() {
    for flood in [
        Frame::new(0x581, &[0x4B, 0x41, 0x60, 0, 0x37, 2, 0, 0]),
        heartbeat_frame(node(1), NmtState::Operational),
        Frame::new(0x081, &[0; 8]),
    ] {
        let mut bench = Bench::ready();
        for _ in 0..20 {
            (0..10).for_each(|_| bench.receive(flood));
            bench.run_for(Duration::from_millis(10));
        }
        assert!(bench.events.iter().any(|event| matches!(event, StageEvent::Flood(_))), "{flood}");
        let emergencies = bench.events.iter().filter(|e| matches!(e, StageEvent::Emergency(..)));
        assert!(emergencies.count() < 20, "200 emergencies are not reported one by one");
    }
}
