//! Switches, the safety input, a blocked axis, drive faults, and the models of drives.

use super::*;
use crate::emulator::drive::objects::MAX_ACCELERATION;

fn at_switch(model: Model) -> Bench {
    let switches = Switches { positive_counts: Some(250), ..Switches::default() };
    let mut bench = Bench::new(DriveConfig { switches, model, ..config() });
    bench.map_cyclic();
    bench.enable();
    for target in [100, 200, 300] {
        bench.cycle(0x0f, target);
    }
    bench
}

/// From 10,000 counts/s by 100,000 counts/s²: 500 counts past the switch.
#[test]
fn a_limit_switch_brakes_the_axis_from_where_it_closes() {
    for (model, end, emergencies) in [
        (Model::Generic, DriveState::SwitchOnDisabled, vec![]),
        (Model::Epos4, DriveState::Fault, vec!["085#07FF010000000000"]),
    ] {
        let mut bench = at_switch(model);
        bench.pass(Duration::from_secs(1));
        assert_eq!((bench.position(), bench.state()), (750.0, end), "{model:?}");
        assert_eq!(bench.emergencies, emergencies);
        assert_eq!(bench.read(object::DIGITAL_INPUTS), [2, 0, 0, 0]);
    }
}

#[test]
fn an_axis_may_move_off_a_limit_switch_and_not_further_onto_it() {
    let mut bench = at_switch(Model::Generic);
    bench.pass(Duration::from_secs(1));
    bench.enable();
    for target in [700, 600, 500] {
        bench.cycle(0x0f, target);
    }
    assert_eq!((bench.position(), bench.state()), (500.0, DriveState::OperationEnabled));
    bench.cycle(0x0f, 510);
    assert_ne!(bench.state(), DriveState::OperationEnabled, "further onto the switch");
}

#[test]
fn an_open_safety_input_removes_the_torque() {
    let mut bench = moving();
    bench.drive.apply_fault(bench.now, &Fault::of(FaultKind::EmergencyStop), true);
    bench.take();
    bench.pass(PERIOD);
    assert_eq!((bench.state(), bench.position()), (DriveState::Fault, 300.0));
    assert_eq!(bench.emergencies, ["085#0090010000000000"]);
    assert_eq!(bench.read(object::DIGITAL_INPUTS), [8, 0, 0, 0]);
    bench.cycle(0x00, 300);
    bench.cycle(0x80, 300);
    assert_eq!(bench.state(), DriveState::Fault, "no reset while the input is open");
    bench.drive.apply_fault(bench.now, &Fault::of(FaultKind::EmergencyStop), false);
    bench.enable();
}

/// The default window is 2000 counts: at 10,000 counts/s, 0.2 s.
#[test]
fn a_blocked_axis_falls_behind_and_faults() {
    let mut bench = moving();
    bench.drive.apply_fault(bench.now, &Fault::of(FaultKind::Stall), true);
    let mut target = 400;
    while bench.state() == DriveState::OperationEnabled {
        bench.pass(PERIOD);
        target += 100;
        bench.command(0x0f, target);
        bench.give(sync_frame());
        assert_eq!(bench.position(), 300.0);
    }
    assert_eq!(target, 2400, "2100 counts behind");
    assert_eq!(bench.emergencies, ["085#1186210000000000"]);
}

/// 0x6066 is the time beyond the window, without a break.
#[test]
fn a_blocked_axis_faults_after_the_time_of_6066() {
    let mut bench = moving();
    bench.write(object::FOLLOWING_ERROR_TIMEOUT, &25u16.to_le_bytes());
    bench.drive.apply_fault(bench.now, &Fault::of(FaultKind::Stall), true);
    let mut target = 400;
    while bench.state() == DriveState::OperationEnabled {
        bench.pass(PERIOD);
        target += 100;
        bench.command(0x0f, target);
        bench.give(sync_frame());
    }
    assert_eq!(target, 2700, "three periods later than without 0x6066");
}

/// After a reset and with a far target, the axis is beyond its window for less than 25 ms.
#[test]
fn a_fault_restarts_the_time_of_6066() {
    let mut bench = moving();
    bench.write(object::FOLLOWING_ERROR_TIMEOUT, &25u16.to_le_bytes());
    bench.drive.apply_fault(bench.now, &Fault::of(FaultKind::Stall), true);
    while bench.state() == DriveState::OperationEnabled {
        bench.cycle(0x0f, 3000);
    }
    bench.drive.apply_fault(bench.now, &Fault::of(FaultKind::Stall), false);
    for controlword in [0x00, 0x80, 0x06, 0x07, 0x0f, 0x0f, 0x0f, 0x0f, 0x0f] {
        bench.cycle(controlword, 10_300);
    }
    assert_eq!((bench.state(), bench.position()), (DriveState::OperationEnabled, 10_300.0));
}

#[test]
fn an_axis_in_its_fault_reaction_that_loses_its_torque_stands_at_once() {
    for lost in [FaultKind::EmergencyStop, FaultKind::NoVoltage] {
        let mut bench = moving();
        let fault = Fault { code: Some(0x4210), ..Fault::of(FaultKind::DriveFault) };
        bench.drive.apply_fault(bench.now, &fault, true);
        bench.pass(PERIOD);
        assert_eq!(bench.state(), DriveState::FaultReactionActive);
        let stood = bench.position();
        bench.drive.apply_fault(bench.now, &Fault::of(lost), true);
        assert_eq!(bench.state(), DriveState::Fault);
        bench.pass(Duration::from_secs(1));
        assert_eq!(bench.position(), stood);
    }
}

#[test]
fn an_axis_that_is_released_in_time_catches_up() {
    let mut bench = moving();
    bench.drive.apply_fault(bench.now, &Fault::of(FaultKind::Stall), true);
    bench.pass(PERIOD);
    bench.cycle(0x0f, 500);
    assert_eq!(bench.read(object::FOLLOWING_ERROR_ACTUAL), 200i32.to_le_bytes());
    bench.drive.apply_fault(bench.now, &Fault::of(FaultKind::Stall), false);
    bench.cycle(0x0f, 600);
    assert_eq!((bench.position(), bench.state()), (600.0, DriveState::OperationEnabled));
}

#[test]
fn a_drive_fault_sends_an_emergency_with_its_error_register() {
    for (code, emergency) in [
        (0x8611, "085#1186210000000000"),
        (0x4210, "085#1042090000000000"),
        (0x2310, "085#1023030000000000"),
        (0xff01, "085#01FF810000000000"),
    ] {
        let mut bench = moving();
        bench.drive.apply_fault(
            bench.now,
            &Fault { code: Some(code), ..Fault::of(FaultKind::DriveFault) },
            true,
        );
        bench.take();
        assert_eq!(bench.emergencies, [emergency]);
        assert_eq!(bench.read(object::ERROR_CODE), code.to_le_bytes());
        bench.pass(Duration::from_secs(1));
        assert_eq!(bench.state(), DriveState::Fault);
    }
}

/// From standstill with 1,000,000 counts/s²: 100 counts in the first 10 ms, 200 in the next.
#[test]
fn acceleration_is_limited() {
    let mut bench = Bench::enabled_at(0);
    bench.write(MAX_ACCELERATION, &1_000_000u32.to_le_bytes());
    let mut positions = vec![];
    for _ in 0..3 {
        bench.cycle(0x0f, 1500);
        positions.push(bench.position());
    }
    assert_eq!(positions, [100.0, 300.0, 600.0]);
    assert_eq!(bench.state(), DriveState::OperationEnabled);
    for _ in 0..100 {
        bench.cycle(0x0f, 1500);
    }
    assert_eq!(bench.position(), 1500.0, "it comes to rest on its target");
}

#[test]
fn an_epos4_lacks_five_objects_and_the_event_timer() {
    let absent = [0x1006, 0x1007, 0x1019, 0x6091, 0x6092].map(|index| ObjectAddress::new(index, 0));
    let event_timer = ObjectAddress::new(0x1800, 5);
    let mut generic = Bench::new(config());
    let mut epos4 = Bench::new(DriveConfig { model: Model::Epos4, ..config() });
    let aborted = |code| Err(SdoError::Aborted(code));
    for object in absent {
        generic.read(object);
        assert_eq!(epos4.sdo(SdoRequest::Upload(object)), aborted(AbortCode::NO_SUCH_OBJECT));
    }
    generic.read(event_timer);
    assert_eq!(epos4.sdo(SdoRequest::Upload(event_timer)), aborted(AbortCode::NO_SUCH_SUBINDEX));
    assert_eq!(epos4.read(ObjectAddress::new(0x1800, 0)), [3]);
    assert_eq!(epos4.read(ObjectAddress::new(0x1017, 0)), [0, 0], "no heartbeat unless asked");
}

#[test]
fn a_restart_sends_boot_up_and_resets_the_objects() {
    let mut bench = moving();
    bench.drive.apply_fault(bench.now, &Fault::of(FaultKind::Restart), true);
    assert_eq!(bench.take(), ["705#00"]);
    assert_eq!(bench.state(), DriveState::SwitchOnDisabled);
    assert_eq!(bench.read(object::INTERPOLATION_PERIOD_VALUE), [1]);
    let stopped = bench.position();
    bench.cycle(0x0f, 500);
    assert_eq!(bench.position(), stopped);
}
