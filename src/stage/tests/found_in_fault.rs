//! Drives that are in fault at the start, and which fault is reset.

use super::bring_up::fault_of;
use super::*;
use crate::canopen::ObjectAddress;
use crate::canopen::cia402::DriveState;
use crate::canopen::sdo::AbortCode;

#[test]
fn a_drive_found_in_fault_is_named_or_reset_as_configured() {
    let fault = fault_of(config(), |bench| bench.rotation.state = DriveState::Fault);
    assert_eq!(
        fault,
        "node 2 (rotation): drive found in fault (statusword 0x0218 fault, \
         0x603F 0x7320 position sensor, 0x1003:01 0x00007320); \
         clear its cause, then: needle-bench stage reset CONFIG"
    );
    let config = resetting_config();
    let mut bench = Bench::new(config);
    bench.rotation.state = DriveState::Fault;
    bench.until_ready();
    assert_eq!(bench.rotation.resets, 1);
}

#[test]
fn a_fault_that_a_reset_does_not_end_is_not_reset_again() {
    let mut bench = Bench::new(resetting_config());
    bench.rotation.state = DriveState::Fault;
    bench.rotation.keeps_its_fault = true;
    let fault = bench.until_fault();
    assert_eq!(fault, "rotation: drive in fault (statusword 0x0218 fault)");
    bench.run_for(Duration::from_secs(5));
    assert_eq!(bench.rotation.resets, 1);
}

/// A later fault has a cause in this run. If it ended by itself, the axes must not start to move.
#[test]
fn a_fault_that_comes_later_is_never_reset() {
    let enabling = StageEvent::Progress(StageProgress::Enabling);
    let configuring = StageEvent::Progress(StageProgress::BringUp(
        Axis::Rotation,
        "writing the configured objects",
    ));
    for begun in [configuring, enabling] {
        let mut bench = Bench::new(resetting_config());
        bench.run_until(|event| *event == begun);
        bench.rotation.state = DriveState::Fault;
        bench.receive(bench.rotation.emergency(0x9000));
        let fault = bench.until_fault();
        assert_eq!(fault, "rotation: emergency 0x9000 external error (register 0x21)");
        bench.run_for(Duration::from_secs(5));
        assert_eq!(bench.rotation.resets, 0);
        assert_ne!(bench.insertion.state, DriveState::OperationEnabled);
    }
}

/// A stage that is about to enable its drives. The rotation drive was found in fault and may be reset.
fn enabling_after_a_fault() -> Bench {
    let mut bench = Bench::new(resetting_config());
    bench.rotation.state = DriveState::Fault;
    bench.until_progress(StageProgress::Standby);
    bench
}

/// The found fault ends by itself before the reset.
#[test]
fn once_a_found_fault_has_ended_a_new_one_is_not_reset() {
    let mut bench = enabling_after_a_fault();
    bench.rotation.state = DriveState::SwitchOnDisabled;
    bench.until_ready();
    bench.drive_on(5);
    bench.receive(bench.rotation.emergency(0x7320));
    let fault = bench.until_fault();
    assert_eq!(fault, "rotation: emergency 0x7320 position sensor (register 0x21)");

    for state in [DriveState::Fault, DriveState::FaultReactionActive] {
        let mut bench = enabling_after_a_fault();
        bench.rotation.state = DriveState::SwitchOnDisabled;
        bench.insertion.charge_cycles = 20;
        bench.run_for(Duration::from_millis(25));
        bench.rotation.state = state;
        let fault = bench.until_fault();
        assert!(fault.starts_with("rotation: drive in fault (statusword 0x02"), "{fault}");
        bench.run_for(Duration::from_secs(5));
        assert_eq!(bench.rotation.resets, 0);
    }
}

/// 0x603F names the fault at the start. An emergency with another code is a new fault.
#[test]
fn only_the_emergency_of_the_found_fault_is_ignored() {
    let mut bench = enabling_after_a_fault();
    bench.receive(bench.rotation.emergency(0x7320));
    bench.until_ready();
    assert_eq!(bench.rotation.resets, 1);

    let mut bench = enabling_after_a_fault();
    bench.receive(bench.rotation.emergency(0x9000));
    let fault = bench.until_fault();
    assert_eq!(fault, "rotation: emergency 0x9000 external error (register 0x21)");
    bench.run_for(Duration::from_secs(5));
    assert_eq!(bench.rotation.resets, 0);

    let mut bench = Bench::new(resetting_config());
    bench.rotation.state = DriveState::Fault;
    bench.rotation.objects.remove(&ObjectAddress::new(0x603f, 0));
    bench.until_progress(StageProgress::Enabling);
    bench.receive(bench.rotation.emergency(0x7320));
    assert!(
        bench.until_fault().contains("emergency 0x7320"),
        "without 0x603F no emergency is ignored"
    );
}

#[test]
fn a_drive_found_in_fault_is_reset_when_power_is_permitted() {
    let mut bench = Bench::new(resetting_config());
    bench.stage.permit_power(false);
    bench.rotation.state = DriveState::Fault;
    bench.run_for(Duration::from_secs(5));
    assert_eq!(bench.rotation.resets, 0);
    bench.stage.permit_power(true);
    bench.until_ready();
    assert_eq!(bench.rotation.resets, 1);
}

/// A drive refuses to read an error history that is empty.
#[test]
fn a_fault_without_a_history_is_named() {
    let mut bench = Bench::new(config());
    bench.insertion.state = DriveState::Fault;
    bench.insertion.objects.remove(&ObjectAddress::new(0x1003, 1));
    let said = bench.until_fault();
    assert!(said.contains("drive found in fault") && said.contains("0x1003:01 empty"), "{said}");
}

/// Only a fault whose code is known may be reset without the operator.
#[test]
fn a_fault_whose_code_cannot_be_read_is_named_and_not_reset() {
    let object = ObjectAddress::new(0x603f, 0);
    let (refused, mute) = (Some((object, AbortCode::GENERAL)), Some((object, u32::MAX)));
    for (config, refused, mute, expected) in [
        (config(), refused, None, "0x603F absent"),
        (resetting_config(), refused, None, "0x603F:00: reading was refused with SDO abort"),
        (resetting_config(), None, mute, "0x603F:00: no SDO reply within 150 ms (attempt 3 of 3)"),
    ] {
        let mut bench = Bench::new(config);
        bench.insertion.state = DriveState::Fault;
        (bench.insertion.refused, bench.insertion.mute) = (refused, mute);
        let fault = bench.until_fault();
        assert!(fault.contains(expected), "{fault}");
        assert_eq!(bench.insertion.resets, 0);
    }
}
