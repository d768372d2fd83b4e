//! Quick stop, halt, faults and everything else that stops an axis.

use super::*;

#[test]
fn each_quick_stop_option_brakes_and_ends_as_605a_says() {
    // 0x6085 is 100,000 counts/s²: from 10,000 counts/s 500 counts and 0.1 s.
    // 0x6084 is 10,000 counts/s²: 5000 counts and 1 s.
    let rows = [
        (0, 0.0, DriveState::SwitchOnDisabled),
        (1, 5000.0, DriveState::SwitchOnDisabled),
        (2, 500.0, DriveState::SwitchOnDisabled),
        (5, 5000.0, DriveState::QuickStopActive),
        (6, 500.0, DriveState::QuickStopActive),
    ];
    for (option, distance, end) in rows {
        let mut bench = moving();
        bench.write(object::QUICK_STOP_OPTION, &[option, 0]);
        bench.pass(PERIOD);
        bench.cycle(0x02, 500);
        if distance > 0.0 {
            assert_eq!(bench.state(), DriveState::QuickStopActive);
        }
        bench.pass(Duration::from_millis(1000));
        assert_eq!((bench.position(), bench.state()), (400.0 + distance, end), "605A {option}");
        let counts = bench.drive.position_counts_at(bench.now) as i64;
        bench.cycle(0x0f, counts);
        let resumed = end == DriveState::QuickStopActive;
        assert_eq!(bench.state() == DriveState::OperationEnabled, resumed, "transition 16");
    }
}

/// CiA 402-2, transition 16: only with options 5 to 8 of 0x605A.
#[test]
fn a_quick_stop_that_ends_without_power_cannot_be_left() {
    for option in [1, 2, 5, 6] {
        let mut bench = moving();
        bench.write(object::QUICK_STOP_OPTION, &[option, 0]);
        bench.write(object::CONTROLWORD, &[0x02, 0]);
        assert_eq!(bench.state(), DriveState::QuickStopActive);
        bench.write(object::CONTROLWORD, &[0x0f, 0]);
        let resumed = bench.state() == DriveState::OperationEnabled;
        assert_eq!(resumed, option >= 5, "605A {option}");
    }
}

#[test]
fn halt_brakes_and_holds_while_enabled() {
    let mut bench = moving();
    bench.pass(PERIOD);
    bench.cycle(0x10f, 500);
    for _ in 0..100 {
        bench.cycle(0x10f, 500);
    }
    assert_eq!((bench.position(), bench.state()), (5400.0, DriveState::OperationEnabled));
    assert!(bench.sample.unwrap().0.has(Statusword::TARGET_REACHED));
    bench.cycle(0x0f, 5410);
    assert_eq!(bench.position(), 5410.0);
}

#[test]
fn an_axis_that_loses_power_stands_at_once() {
    for (controlword, state) in [
        (0x00, DriveState::SwitchOnDisabled),
        (0x06, DriveState::ReadyToSwitchOn),
        (0x07, DriveState::SwitchedOn),
    ] {
        let mut bench = moving();
        bench.pass(PERIOD);
        bench.cycle(controlword, 500);
        bench.cycle(controlword, 600);
        assert_eq!((bench.state(), bench.position()), (state, 400.0));
    }
}

#[test]
fn a_fault_is_reset_by_a_rising_edge_only() {
    let mut bench = Bench::enabled_at(0);
    bench.cycle(0x8f, 1_000_000);
    assert_eq!(bench.state(), DriveState::Fault);
    bench.cycle(0x80, 0);
    assert_eq!(bench.state(), DriveState::Fault, "bit 7 was high before");
    bench.cycle(0x00, 0);
    bench.cycle(0x80, 0);
    assert_eq!(bench.state(), DriveState::SwitchOnDisabled);
    assert_eq!(bench.emergencies.last().unwrap(), "085#0000000000000000");
    assert_eq!(bench.read(object::ERROR_CODE), [0, 0]);
    bench.enable();
}

#[test]
fn a_reset_of_communication_leaves_a_fault_in_the_error_register() {
    let mut bench = Bench::enabled_at(0);
    bench.cycle(0x0f, 1_000_000);
    bench.nmt(NmtCommand::ResetCommunication);
    let register = ObjectAddress::new(0x1001, 0);
    assert_eq!((bench.state(), bench.read(register)), (DriveState::Fault, vec![0x21]));
    bench.write(object::CONTROLWORD, &[0x80, 0]);
    assert_eq!((bench.state(), bench.read(register)), (DriveState::SwitchOnDisabled, vec![0]));
}

#[test]
fn a_lost_heartbeat_stops_the_axis_as_6007_says() {
    for (option, end) in [
        (0, DriveState::OperationEnabled),
        (1, DriveState::Fault),
        (2, DriveState::SwitchOnDisabled),
        (3, DriveState::SwitchOnDisabled),
    ] {
        let mut bench = moving();
        bench.write(object::ABORT_CONNECTION_OPTION, &[option, 0]);
        bench.write(ObjectAddress::new(0x1016, 1), &[25, 0, 127, 0]);
        let heartbeat = heartbeat_frame(MASTER, NmtState::Operational);
        bench.give(heartbeat);
        let mut target = 400;
        while bench.emergencies.is_empty() {
            bench.pass(PERIOD);
            target += 100;
            bench.command(0x0f, target);
            bench.give(sync_frame());
            assert!(target <= 700, "the loss is noticed within 30 ms");
        }
        assert_eq!(bench.emergencies, ["085#3081117F00000000"]);
        bench.pass(Duration::from_secs(2));
        let stopped = bench.position();
        assert!(stopped < 7000.0, "6007 {option}: braked by {stopped}");
        bench.cycle(0x0f, 8000);
        assert_eq!((bench.position(), bench.state()), (stopped, end), "6007 {option}");
        assert_eq!(bench.drive.nmt_state(), NmtState::PreOperational);

        bench.nmt(NmtCommand::StartRemoteNode);
        bench.cycle(0x00, 0);
        bench.cycle(0x80, 0);
        let reset = bench.state() != DriveState::Fault;
        assert_eq!(reset, option != 1, "no reset while the master is missing");
        bench.give(heartbeat);
        bench.cycle(0x00, 0);
        bench.cycle(0x80, 0);
        assert_eq!(bench.state(), DriveState::SwitchOnDisabled);
        assert_eq!(bench.emergencies.last().unwrap(), "085#0000000000000000");
    }
}

#[test]
fn leaving_operational_stops_the_axis() {
    for command in [
        NmtCommand::StopRemoteNode,
        NmtCommand::EnterPreOperational,
        NmtCommand::ResetCommunication,
        NmtCommand::ResetNode,
    ] {
        let mut bench = moving();
        bench.nmt(command);
        assert_ne!(bench.state(), DriveState::OperationEnabled, "{command:?}");
        bench.pass(Duration::from_secs(1));
        let stopped = bench.position();
        assert!(stopped <= 800.0, "{command:?}: {stopped}");
        bench.cycle(0x0f, 900);
        assert_eq!(bench.position(), stopped);
    }
}
