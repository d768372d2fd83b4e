//! From the bring-up to power: what is waited for, and what ends it.

use super::*;
use crate::canopen::cia402::DriveState;
use crate::canopen::cob;
use crate::canopen::nmt::{NmtState, heartbeat_frame};

/// Without leave the drives stay without power, watched, for as long as it takes.
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
    assert!(bench.stage.command(SetPoint { insertion_mm: 0.0, rotation_rad: 0.0 }).is_err());
    bench.stage.permit_power(true);
    bench.run_until(|event| *event == StageEvent::Ready);
}

/// A fault that comes while power is awaited ends it, and is not reset.
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

/// A drive that never answers a SYNC gets no power to wait for.
#[test]
fn a_drive_that_never_answers_a_sync_is_a_fault() {
    let mut bench = Bench::new(config());
    bench.stage.permit_power(false);
    bench.rotation.tpdos_lost = u32::MAX;
    let said = bench.until_fault();
    assert!(
        said.starts_with("rotation: not in operation enabled within 3000 ms (no TPDO1 was heard)"),
        "{said}"
    );
}

/// An emergency stop that is pressed, or a safety input that is open: letting it go must not be
/// what begins the motion.
#[test]
fn a_drive_that_refuses_to_switch_on_is_a_fault_at_once() {
    let said = "insertion: the drive refused to switch on (statusword 0x0250 switch on disabled); \
                check safety input";
    let mut bench = Bench::new(config());
    bench.insertion.safety_open = true;
    bench.run_until(|event| *event == StageEvent::Progress(Progress::Enabling));
    let begun = bench.now;
    assert!(bench.until_fault().starts_with(said));
    assert!(bench.now.since(begun) < Duration::from_millis(600));

    let mut bench = Bench::new(config());
    bench.insertion.charge_cycles = 20;
    bench.run_until(|event| *event == StageEvent::Progress(Progress::Enabling));
    bench.run_for(Duration::from_millis(50));
    assert_eq!(bench.insertion.state, DriveState::ReadyToSwitchOn);
    bench.insertion.safety_open = true;
    bench.run_for(Duration::from_millis(20));
    bench.insertion.safety_open = false;
    assert!(bench.until_fault().starts_with(said));
    assert!(!bench.events.contains(&StageEvent::Ready));
}

/// Nothing but the bench may give it power.
#[test]
fn a_drive_enabled_by_something_else_while_power_is_awaited_is_a_fault() {
    for state in [DriveState::SwitchedOn, DriveState::OperationEnabled, DriveState::QuickStopActive]
    {
        let mut bench = Bench::new(config());
        bench.stage.permit_power(false);
        bench.run_until(|event| matches!(event, StageEvent::Located(_)));
        bench.insertion.state = state;
        (bench.insertion.ignores_rpdo, bench.insertion.ignores_sdo) = (true, true);
        let said = bench.until_fault();
        let named = said.starts_with("insertion: the drive has power before the bench gave it");
        assert!(named, "{said}");
    }
}

#[test]
fn a_drive_that_cannot_be_enabled_is_named() {
    let mut bench = Bench::new(config());
    bench.rotation.brake_cycles = u32::MAX;
    let text = bench.until_fault();
    assert!(text.starts_with("rotation: not in operation enabled within 3000 ms"), "{text}");
    bench.until_stopped();
    assert_ne!(bench.insertion.state, DriveState::OperationEnabled);
}

/// The drive is heard before anything may move, and not only after its heartbeat is overdue.
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

/// The heartbeat of an earlier run may still say that the node is Operational.
#[test]
fn a_heartbeat_from_before_the_bring_up_does_not_count() {
    let mut bench = Bench::new(config());
    bench.rotation.heartbeat_off = true;
    bench.now = bench.now + Duration::from_millis(200);
    bench.receive(heartbeat_frame(bench.rotation.node, NmtState::Operational));
    let said = bench.until_fault();
    assert!(said.starts_with("rotation: no heartbeat for 300 ms"), "{said}");
    assert!(!bench.events.contains(&StageEvent::Ready));
}

#[test]
fn a_node_that_ignores_the_start_command_is_named_by_its_state() {
    let mut bench = Bench::new(config());
    bench.rotation.tpdos_lost = u32::MAX;
    bench.rotation.heartbeat_off = true;
    bench.run_until(|event| *event == StageEvent::Progress(Progress::Standby));
    while !bench.events.iter().any(|event| matches!(event, StageEvent::Fault(_))) {
        bench.receive(heartbeat_frame(bench.rotation.node, NmtState::PreOperational));
        bench.run_for(Duration::from_millis(100));
    }
    let said = bench.until_fault();
    let expected =
        "rotation: NMT state pre-operational instead of operational 3000 ms after the start";
    assert!(said.starts_with(expected), "{said}");
}

/// Both drives are enabled then, and neither is named for that.
#[test]
fn a_node_whose_heartbeat_does_not_say_operational_is_a_fault() {
    for (heard, said) in [
        (None, "rotation: enabled, but no heartbeat within 3000 ms, is can.heartbeat_ms longer?"),
        (
            Some(NmtState::PreOperational),
            "rotation: NMT state pre-operational instead of operational 3000 ms after the start command, \
             is there another master?",
        ),
    ] {
        let mut config = config();
        config.bus.heartbeat_timeout_ms = 60_000;
        let mut bench = Bench::new(config);
        bench.rotation.heartbeat_off = true;
        bench.run_until(|event| *event == StageEvent::Progress(Progress::Enabling));
        if let Some(state) = heard {
            bench.receive(heartbeat_frame(bench.rotation.node, state));
        }
        assert_eq!(bench.until_fault(), said);
        assert!(!bench.events.contains(&StageEvent::Ready));
    }
}

/// The last heartbeat comes after the answers to the last SYNC in time.
#[test]
fn drives_enabled_just_as_the_timeout_ends_are_a_fault_that_says_so() {
    let mut config = config();
    config.bus.heartbeat_timeout_ms = 60_000;
    let mut bench = Bench::new(config);
    bench.rotation.heartbeat_off = true;
    bench.run_until(|event| *event == StageEvent::Progress(Progress::Enabling));
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
