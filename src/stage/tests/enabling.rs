//! From the bring-up to power: what the stage waits for, and what stops it.

use super::*;
use crate::canopen::cia402::DriveState;
use crate::canopen::cob;
use crate::canopen::nmt::{NmtState, heartbeat_frame};

/// Until then the drives stay supervised and without power.
#[test]
fn power_waits_until_it_is_permitted() {
    let mut bench = Bench::new(config());
    bench.stage.permit_power(false);
    bench.run_until(|event| matches!(event, StageEvent::Located(_)));
    bench.sent.clear();
    bench.run_for(Duration::from_secs(10));
    let syncs = bench.sent.iter().filter(|(_, frame)| frame.cob_id() == Some(cob::SYNC)).count();
    assert_eq!(syncs, 1000);
    for drive in [&bench.insertion, &bench.rotation] {
        assert_eq!(drive.state, DriveState::SwitchOnDisabled);
    }
    assert!(bench.command(0.0, 0.0).is_err());
    bench.stage.permit_power(true);
    bench.until_ready();
}

#[test]
fn a_fault_while_power_is_awaited_stops_the_stage_and_is_not_reset() {
    let awaiting = || {
        let mut bench = Bench::new(resetting_config());
        bench.stage.permit_power(false);
        bench.run_until(|event| matches!(event, StageEvent::Located(_)));
        bench.run_for(Duration::from_secs(1));
        bench
    };
    let mut bench = awaiting();
    bench.rotation.off = true;
    assert!(bench.until_fault().starts_with("rotation: no TPDO1 for 2 SYNCs in a row"));
    let mut bench = awaiting();
    bench.rotation.state = DriveState::Fault;
    assert!(bench.until_fault().starts_with("rotation: drive in fault"));
    bench.stage.permit_power(true);
    bench.run_for(Duration::from_secs(5));
    assert_eq!((bench.rotation.resets, bench.insertion.state), (0, DriveState::SwitchOnDisabled));
}

/// Power is not permitted yet, but the stage does not wait for such a drive.
#[test]
fn a_drive_that_never_answers_a_sync_is_a_fault() {
    let mut bench = Bench::new(config());
    bench.stage.permit_power(false);
    bench.rotation.tpdos_lost = u32::MAX;
    let fault = bench.until_fault();
    assert!(
        fault.starts_with("rotation: not in operation enabled within 3000 ms (no TPDO1 was heard)"),
        "{fault}"
    );
}

/// The emergency stop may be pressed, or a safety input open. Releasing it must not start the motion.
#[test]
fn a_drive_that_refuses_to_switch_on_is_a_fault_at_once() {
    let refused = "insertion: the drive refused to switch on (statusword 0x0250 switch on disabled); \
                check safety input";
    let mut bench = Bench::new(config());
    bench.insertion.safety_open = true;
    bench.until_progress(StageProgress::Enabling);
    let begun = bench.now;
    assert!(bench.until_fault().starts_with(refused));
    assert!(bench.now.since(begun) < Duration::from_millis(600));

    let mut bench = Bench::new(config());
    bench.insertion.charge_cycles = 20;
    bench.until_progress(StageProgress::Enabling);
    bench.run_for(Duration::from_millis(50));
    assert_eq!(bench.insertion.state, DriveState::ReadyToSwitchOn);
    bench.insertion.safety_open = true;
    bench.run_for(Duration::from_millis(20));
    bench.insertion.safety_open = false;
    assert!(bench.until_fault().starts_with(refused));
    assert!(!bench.events.contains(&StageEvent::Ready));
}

#[test]
fn a_drive_enabled_by_something_else_while_power_is_awaited_is_a_fault() {
    for state in [DriveState::SwitchedOn, DriveState::OperationEnabled, DriveState::QuickStopActive]
    {
        let mut bench = Bench::new(config());
        bench.stage.permit_power(false);
        bench.run_until(|event| matches!(event, StageEvent::Located(_)));
        bench.insertion.state = state;
        (bench.insertion.ignores_rpdo, bench.insertion.ignores_sdo) = (true, true);
        let fault = bench.until_fault();
        let expected = "insertion: the drive has power before the bench gave it";
        assert!(fault.starts_with(expected), "{fault}");
    }
}

#[test]
fn a_drive_that_cannot_be_enabled_is_named() {
    let mut bench = Bench::new(config());
    bench.rotation.brake_cycles = u32::MAX;
    let fault = bench.until_fault();
    assert!(fault.starts_with("rotation: not in operation enabled within 3000 ms"), "{fault}");
    bench.until_stopped();
    assert_ne!(bench.insertion.state, DriveState::OperationEnabled);
}

/// A heartbeat must arrive before anything may move. It is not enough that none is overdue yet.
#[test]
fn without_a_heartbeat_the_stage_is_never_ready() {
    let mut bench = Bench::new(config());
    bench.rotation.heartbeat_off = true;
    assert_eq!(
        bench.until_fault(),
        "rotation: no heartbeat for 300 ms, is the drive powered and on the bus?"
    );
    assert!(!bench.events.contains(&StageEvent::Ready));
}

/// A heartbeat from an earlier run may still say operational.
#[test]
fn a_heartbeat_from_before_the_bring_up_does_not_count() {
    let mut bench = Bench::new(config());
    bench.rotation.heartbeat_off = true;
    bench.now = bench.now + Duration::from_millis(200);
    bench.receive(heartbeat_frame(bench.rotation.node, NmtState::Operational));
    let fault = bench.until_fault();
    assert!(fault.starts_with("rotation: no heartbeat for 300 ms"), "{fault}");
    assert!(!bench.events.contains(&StageEvent::Ready));
}

#[test]
fn a_node_that_ignores_the_start_command_is_named_by_its_state() {
    let mut bench = Bench::new(config());
    bench.rotation.tpdos_lost = u32::MAX;
    bench.rotation.heartbeat_off = true;
    bench.run_until(|event| *event == StageEvent::Progress(StageProgress::Standby));
    while !bench.events.iter().any(|event| matches!(event, StageEvent::Fault(_))) {
        bench.receive(heartbeat_frame(bench.rotation.node, NmtState::PreOperational));
        bench.run_for(Duration::from_millis(100));
    }
    let said = bench.until_fault();
    let expected =
        "rotation: NMT state pre-operational instead of operational 3000 ms after the start";
    assert!(said.starts_with(expected), "{said}");
}

/// Both drives are enabled, so the fault does not blame the enabling.
#[test]
fn a_node_whose_heartbeat_does_not_say_operational_is_a_fault() {
    for (heard, fault) in [
        (None, "rotation: enabled, but no heartbeat within 3000 ms, is can.heartbeat_ms longer?"),
        (
            Some(NmtState::PreOperational),
            "rotation: NMT state pre-operational instead of operational 3000 ms after the start command, \
             is there another master, or an error in its error register (0x1001)?",
        ),
    ] {
        let mut config = config();
        config.bus.heartbeat_timeout_ms = 60_000;
        let mut bench = Bench::new(config);
        bench.rotation.heartbeat_off = true;
        bench.until_progress(StageProgress::Enabling);
        if let Some(state) = heard {
            bench.receive(heartbeat_frame(bench.rotation.node, state));
        }
        assert_eq!(bench.until_fault(), fault);
        assert!(!bench.events.contains(&StageEvent::Ready));
    }
}

/// The last heartbeat arrives within the timeout, but after the last SYNC within it.
#[test]
fn drives_enabled_just_as_the_timeout_ends_are_a_fault_that_says_so() {
    let mut config = config();
    config.bus.heartbeat_timeout_ms = 60_000;
    let mut bench = Bench::new(config);
    bench.rotation.heartbeat_off = true;
    bench.until_progress(StageProgress::Enabling);
    let late = bench.now + Duration::from_millis(2_999);
    while bench.stage.deadline() < late {
        bench.step();
    }
    bench.receive(heartbeat_frame(bench.rotation.node, NmtState::Operational));
    assert_eq!(
        bench.until_fault(),
        "both drives were enabled only as 3000 ms ended; raise stage.enable_timeout_s"
    );
}

/// It would become a target, and the axis would go there as soon as it has power.
#[test]
fn one_wrong_position_as_power_comes_on_moves_no_axis() {
    let (mut ready, mut faults) = (0, 0);
    for wrong_after in 0..12 {
        let mut bench = Bench::new(config());
        bench.until_progress(StageProgress::Enabling);
        bench.run_for(Duration::from_millis(10 * wrong_after));
        bench.rotation.frozen_at = Some(-20 + 2000);
        bench.run_for(Duration::from_millis(10));
        bench.rotation.frozen_at = None;
        // After the axis has its target the wrong position is a fault.
        bench.run_until(|event| matches!(event, StageEvent::Ready | StageEvent::Fault(_)));
        let enabling = bench.sent.iter().filter_map(|(_, frame)| match frame.data() {
            [0x0F, 0, target @ ..] if frame.cob_id() == Some(cob::rpdo1(bench.rotation.node)) => {
                Some(i32::from_le_bytes(target.try_into().expect("4 bytes")))
            }
            _ => None,
        });
        let targets: Vec<i32> = enabling.collect();
        assert!(targets.iter().all(|target| *target == -20), "{targets:?}");
        assert_eq!(bench.rotation.counts, -20, "{wrong_after}");
        match bench.fault() {
            None => ready += 1,
            Some(fault) => {
                assert!(fault.starts_with("rotation: the axis left its first target"), "{fault}");
                faults += 1;
            }
        }
    }
    assert!(ready > 0 && faults > 0, "{ready} {faults}");
}

#[test]
fn an_axis_whose_position_does_not_rest_gets_no_target() {
    let mut bench = Bench::new(config());
    bench.until_progress(StageProgress::Enabling);
    for n in 0..400 {
        bench.rotation.frozen_at = Some(-20 + 1500 * (n % 2));
        bench.run_for(Duration::from_millis(10));
    }
    let fault = bench.until_fault();
    assert!(fault.starts_with("rotation: its position still changed"), "{fault}");
    assert_eq!(bench.rotation.counts, -20);
}

/// Its brake is still closed, or nothing holds it yet. It would go back at once as the drive is enabled.
#[test]
fn an_axis_that_moves_while_its_drive_takes_long_to_enable_is_a_fault() {
    let mut bench = Bench::new(config());
    bench.rotation.brake_cycles = 50;
    bench.until_progress(StageProgress::Enabling);
    while !bench.has_sent("202#0F00") {
        bench.step();
    }
    bench.run_for(Duration::from_millis(100));
    bench.rotation.counts += 2000;
    let fault = bench.until_fault();
    assert!(fault.starts_with("rotation: the axis left its first target before"), "{fault}");
    bench.until_stopped();
    assert_eq!(bench.rotation.counts, 1980);
    assert!(!bench.events.contains(&StageEvent::Ready));
}

/// Something on the bus delays them from the start. They would be taken for answers to later SYNCs.
#[test]
fn answers_that_come_after_the_next_sync_is_due_get_no_power() {
    // More than 250 ms pass for an answer in time if the bench does not wait for longer than may be missed.
    for (late_ms, missed_max) in [(15, 1), (95, 1), (195, 1), (255, 30)] {
        let mut config = config();
        config.bus.missed_feedback_max = missed_max;
        let mut bench = Bench::new(config);
        bench.tpdo_delay = Duration::from_millis(late_ms);
        let fault = bench.until_fault();
        let expected =
            "in 3000 ms the drives did not both answer one SYNC before the next was due (10 ms): ";
        assert!(fault.starts_with(expected), "{late_ms} ms: {fault}");
        assert_eq!(bench.insertion.state, DriveState::SwitchOnDisabled);
    }
}

#[test]
fn a_drive_that_begins_to_answer_late_is_no_fault() {
    let mut bench = Bench::new(config());
    bench.rotation.tpdos_lost = 2;
    bench.tpdo_delay = Duration::from_millis(9);
    bench.until_ready();
    let syncs = bench.sent.iter().filter(|(_, frame)| frame.to_string() == "080#");
    let times: Vec<Time> = syncs.map(|(time, _)| *time).take(4).collect();
    let gaps: Vec<u128> = times.windows(2).map(|pair| pair[1].since(pair[0]).as_millis()).collect();
    assert_eq!(gaps, [250, 250, 10]);
}
