//! Quick stop and the orderly end, until both axes stand without power.

use super::*;
use crate::canopen::cia402::DriveState;
use crate::canopen::nmt::NmtState;
use std::f64::consts::TAU;

#[test]
fn quick_stop_brakes_under_power_until_both_axes_stand() {
    let mut bench = Bench::ready();
    let before = bench.drive_on(50);
    bench.stage.quick_stop(bench.now);
    bench.sent.clear();
    assert!(bench.until_stopped(), "standstill is reported");
    // The drive brakes from 46 counts a SYNC by 1 count a SYNC.
    let travel =
        bench.insertion.counts - 1000 - (before.measured.insertion_mm * 4646.0).round() as i32;
    assert!((1000..=46 * 49 / 2).contains(&travel), "{travel} counts");
    assert!(bench.insertion.coasted_from <= 3, "power stays on until standstill");
    assert_eq!(bench.insertion.state, DriveState::SwitchOnDisabled);
    assert_eq!(bench.insertion.nmt, NmtState::PreOperational);
}

/// The controlwords of the RPDO1 that were sent to the insertion drive.
fn rpdos(bench: &Bench) -> Vec<u8> {
    let rpdo = |(_, frame): &(Time, Frame)| match (frame.cob_id(), frame.data()) {
        (Some(0x201), [controlword, ..]) => Some(*controlword),
        _ => None,
    };
    bench.sent.iter().filter_map(rpdo).collect()
}

/// The drive would take it at the next SYNC, and leave Quick Stop Active for Operation Enabled (CiA 402, transition
/// 16).
#[test]
fn a_set_point_that_was_sent_ahead_is_replaced_as_a_stop_begins() {
    let mut bench = Bench::ready();
    bench.drive_on(20);
    bench.command(0.21, 0.21).expect("within limits");
    bench.settle();
    bench.sent.clear();
    bench.stage.quick_stop(bench.now);
    bench.settle();
    assert_eq!(rpdos(&bench), [0x02], "at once");
    assert_eq!(bench.insertion.state, DriveState::QuickStopActive, "by SDO");
    // It may be lost, so it is sent again with the SYNC.
    bench.run_for(Duration::from_millis(15));
    assert_eq!(rpdos(&bench)[..2], [0x02, 0x02]);
    assert_eq!(bench.insertion.state, DriveState::QuickStopActive);
    assert!(!bench.has_sent("000#8001"));
}

/// Something on the bus holds frames back. What it passes on enables the drive again, each time.
#[test]
fn a_drive_that_late_set_points_enable_again_is_stopped_by_sdo_alone() {
    let mut bench = Bench::ready();
    bench.drive_on(20);
    bench.insertion.stale_rpdo = Some((0x0f, bench.insertion.counts));
    bench.stage.quick_stop(bench.now);
    let (begun, mut enabled_ms) = (bench.now, Vec::new());
    while !bench.events.iter().any(|event| matches!(event, StageEvent::Stopped { .. })) {
        bench.step();
        if bench.insertion.nmt == NmtState::PreOperational {
            // Some drives report that they have left Operational.
            bench.receive(bench.insertion.emergency(0x8100));
        }
        if bench.insertion.state == DriveState::OperationEnabled {
            enabled_ms.push(bench.now.since(begun).as_millis());
        }
    }
    assert!(enabled_ms.iter().all(|ms| *ms < 20), "{enabled_ms:?}");
    assert!(!enabled_ms.is_empty());
    assert_eq!(bench.fault(), None, "it was stopped without a fault");
    assert_eq!(bench.stage.counters().feedback_missed, 0);
    let told = |event: &&StageEvent| matches!(event, StageEvent::StopNotObeyed(Axis::Insertion, _));
    assert_eq!(bench.events.iter().filter(told).count(), 1, "told once");
    assert!(bench.events.contains(&StageEvent::Stopped { standing: true, off: true }));
}

/// At 2 ms two SYNCs are less than a drive may take.
#[test]
fn a_drive_has_20_ms_to_obey() {
    let mut config = config();
    config.bus.sync_ms = 2;
    let mut bench = Bench::new(config);
    bench.until_feedback();
    for drive in [&mut bench.insertion, &mut bench.rotation] {
        (drive.ignores_rpdo, drive.ignores_sdo) = (true, true);
    }
    bench.stage.quick_stop(bench.now);
    bench.run_for(Duration::from_millis(16));
    (bench.insertion.ignores_rpdo, bench.insertion.ignores_sdo) = (false, false);
    bench.until_stopped();
    let told = |axis| {
        let is_told =
            |event: &StageEvent| matches!(event, StageEvent::StopNotObeyed(of, _) if *of == axis);
        bench.events.iter().any(is_told)
    };
    assert_eq!(Axis::BOTH.map(told), [false, true]);
}

/// The positions of both axes freeze while they move, and the stage is stopped at once.
#[test]
fn a_frozen_position_is_no_standstill_while_the_axis_may_brake() {
    let mut config = config();
    // 1 count a SYNC each SYNC, by which the drives brake.
    config.insertion.quick_stop_deceleration = Some(1e4 / f64::from(COUNTS_PER_MM));
    config.rotation.quick_stop_deceleration = Some(1e4 * TAU / f64::from(COUNTS_PER_TURN));
    config.power.stop_timeout = Duration::from_secs(60);
    let mut bench = Bench::new(config);
    bench.until_feedback();
    bench.drive_on(50);
    for drive in [&mut bench.insertion, &mut bench.rotation] {
        drive.frozen_at = Some(drive.counts);
    }
    bench.stage.quick_stop(bench.now);
    let begun = bench.now;
    assert!(bench.until_stopped());
    assert_eq!((bench.insertion.coasted_from, bench.rotation.coasted_from), (0, 0));
    assert!(bench.now.since(begun) < Duration::from_millis(1400), "the rotation brakes for 1.2 s");
}

/// It obeyed Switch On, and said before that it was Ready To Switch On.
#[test]
fn a_drive_that_falls_silent_as_it_switches_on_is_not_taken_to_be_off() {
    let mut bench = Bench::new(config());
    while bench.rotation.state != DriveState::SwitchedOn {
        bench.step();
    }
    bench.rotation.off = true;
    let stopped = bench.run_until(|event| matches!(event, StageEvent::Stopped { .. }));
    assert!(matches!(stopped, StageEvent::Stopped { off: false, .. }), "{stopped:?}");
    assert_eq!(bench.rotation.state, DriveState::SwitchedOn);
    assert!(
        bench.sent.iter().filter(|(_, frame)| frame.to_string() == "602#2B40600000000000").count()
            > 10
    );
    assert!(!bench.has_sent("602#2316100100000000"), "it still monitors the bench");
}

#[test]
fn an_orderly_end_holds_until_standstill_then_shuts_down() {
    let mut bench = Bench::ready();
    let before = bench.drive_on(20);
    bench.stage.disable(bench.now);
    assert!(bench.until_stopped());
    assert_eq!(bench.fault(), None);
    assert_eq!(bench.insertion.state, DriveState::ReadyToSwitchOn);
    assert_eq!(bench.insertion.value(0x1016, 1), 0, "the drive no longer monitors the bench");
    let held = 1000 + (before.commanded.insertion_mm * f64::from(COUNTS_PER_MM)).round() as i32;
    assert_eq!(bench.insertion.counts, held);
    assert!(!bench.has_sent("201#02"), "no quick stop");
}

#[test]
fn a_fault_during_the_orderly_end_makes_it_a_quick_stop() {
    let mut bench = Bench::ready();
    bench.stage.disable(bench.now);
    bench.receive(bench.rotation.emergency(0x8611));
    assert!(bench.until_fault().starts_with("rotation: emergency 0x8611"));
    bench.until_stopped();
    assert!(bench.has_sent("201#0200"));
}

#[test]
fn a_quick_stop_ends_the_bring_up() {
    let mut bench = Bench::new(config());
    bench.rotation.off = true;
    bench.run_for(Duration::from_millis(500));
    bench.stage.quick_stop(bench.now);
    assert!(!bench.until_stopped());
    assert!(bench.stage.bring_ups.all(Option::is_none));
}

/// Five SYNCs of 1 ms are too short: an axis at 0.4 mm/s moves 2 µm meanwhile.
#[test]
fn standstill_takes_50_ms_even_with_a_short_sync_period() {
    let mut config = config();
    config.bus.sync_ms = 1;
    let mut bench = Bench::new(config);
    bench.until_feedback();
    bench.stage.disable(bench.now);
    let begun = bench.now;
    bench.until_progress(StageProgress::Disabling);
    assert!(bench.now.since(begun) >= Duration::from_millis(50));
}

/// Outside NMT operational a drive ignores PDOs.
#[test]
fn a_drive_that_left_nmt_operational_loses_power_by_sdo() {
    let mut bench = Bench::ready();
    bench.drive_on(5);
    bench.rotation.nmt = NmtState::PreOperational;
    assert!(bench.until_fault().starts_with("rotation: no TPDO1 for 2 SYNCs in a row"));
    bench.until_stopped();
    assert_eq!(bench.rotation.state, DriveState::SwitchOnDisabled);
}

/// The drives obey, and answer SDO only after several SYNCs; or SYNC is so slow that few readings fit into the timeout.
#[test]
fn a_stop_by_sdo_is_confirmed_at_every_sync_period_and_delay_of_the_answers() {
    for (sync_ms, delay_ms) in
        [(10, 0), (10, 35), (10, 45), (10, 60), (10, 100), (1, 5), (1, 8), (5, 25), (100, 0)]
    {
        let mut config = config();
        config.bus.sync_ms = sync_ms;
        config.bus.heartbeat_timeout_ms = 300;
        let mut bench = Bench::new(config);
        bench.until_feedback();
        bench.sdo_delay = Duration::from_millis(delay_ms);
        bench.rotation.nmt = NmtState::PreOperational;
        bench.until_fault();
        let begun = bench.now;
        let context = format!("SYNC every {sync_ms} ms, answers after {delay_ms} ms");
        assert!(bench.until_stopped(), "{context}");
        assert!(bench.now.since(begun) < Duration::from_secs(2), "{context}");
        assert!(
            bench.has_sent("602#2316100100000000"),
            "{context}: its heartbeat consumer stays on"
        );
    }
}

#[test]
fn a_drive_without_supply_does_not_delay_the_end_beyond_its_timeouts() {
    let mut bench = Bench::ready();
    bench.rotation.off = true;
    assert!(bench.until_fault().starts_with("rotation: no TPDO1 for 2 SYNCs in a row"));
    let began = bench.now;
    assert!(!bench.until_stopped(), "its standstill is not reported");
    assert!(!bench.has_sent("602#2316100100000000"), "its heartbeat consumer stays on");
    assert!(bench.now.since(began) <= 2 * Duration::from_secs(2) + Duration::from_millis(20));
}

/// A position by SDO, also between TPDOs, counts for the time since the position before. Standstill of an axis of
/// 100 counts/mm takes 0.5 s.
#[test]
fn standstill_is_not_early_when_positions_come_by_pdo_and_by_sdo() {
    let mut config = config();
    config.insertion.ratio = CountsRatio::new(100, 1).expect("not zero");
    let mut bench = Bench::new(config);
    bench.until_feedback();
    bench.stage.quick_stop(bench.now);
    let begun = bench.now;
    while !bench.events.contains(&StageEvent::Progress(StageProgress::Disabling)) {
        // After each lost TPDO the stage reads the position by SDO.
        bench.insertion.tpdos_lost = u32::from(bench.stage.sync_count % 10 == 6);
        bench.step();
    }
    let stood = bench.now.since(begun);
    assert!((500..=530).contains(&stood.as_millis()), "{stood:?}");
}
