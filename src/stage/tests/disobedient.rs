//! Drives that do not obey, or report that they will not.

use super::*;
use crate::canopen::cia402::{DriveState, Statusword};

/// Controlwords that were sent to the insertion drive by SDO, with the time since the first.
fn by_sdo(bench: &Bench) -> Vec<(Duration, u8)> {
    let mut first = None;
    let controlword = |(time, frame): &(Time, Frame)| match (frame.cob_id(), frame.data()) {
        (Some(0x601), [_, 0x40, 0x60, 0, word, ..]) => {
            Some((time.since(*first.get_or_insert(*time)), *word))
        }
        _ => None,
    };
    bench.sent.iter().filter_map(controlword).collect()
}

#[test]
fn a_drive_that_keeps_its_power_at_the_end_is_a_fault() {
    let mut bench = Bench::ready();
    bench.drive_on(20);
    bench.insertion.ignores_rpdo = true;
    bench.sent.clear();
    bench.stage.disable(bench.now);
    assert_eq!(
        bench.until_fault(),
        "insertion: the drive still has power 2000 ms after shutdown (statusword 0x0237 operation \
         enabled); if it does not stop now, press the emergency stop"
    );
    bench.until_stopped();
    assert_eq!(bench.insertion.state, DriveState::SwitchOnDisabled, "by SDO");
    assert_eq!(bench.insertion.value(0x1016, 1), 0);
    assert_eq!(bench.rotation.state, DriveState::SwitchOnDisabled);
}

/// The stage sends quick stop again after the second TPDO1 that shows that it is not obeyed, with the node out of
/// Operational, and then every 100 ms; after the timeout Disable Voltage. The drive goes on to monitor the bench's
/// heartbeat, which may still stop it.
#[test]
fn a_drive_that_ignores_commands_gets_them_again_and_keeps_its_watchdog() {
    let mut bench = Bench::ready();
    bench.drive_on(20);
    (bench.insertion.ignores_rpdo, bench.insertion.ignores_sdo) = (true, true);
    bench.sent.clear();
    bench.stage.disable(bench.now);
    bench.until_fault();
    let end = bench.run_until(|event| matches!(event, StageEvent::Stopped { .. }));
    assert_eq!(end, StageEvent::Stopped { standing: false, off: false });
    let words = by_sdo(&bench);
    let sent_ms = |word: u8| -> Vec<u128> {
        words.iter().filter(|(_, other)| *other == word).map(|(at, _)| at.as_millis()).collect()
    };
    let every_100_ms = |from: u128| (0..20).map(move |n| from + n * 100);
    let quick_stops = [0, 10].into_iter().chain(every_100_ms(0).skip(1)).collect::<Vec<_>>();
    assert_eq!(sent_ms(0x02), quick_stops);
    assert_eq!(sent_ms(0x00), every_100_ms(2000).collect::<Vec<_>>());
    assert_ne!(bench.insertion.value(0x1016, 1), 0);
    assert_eq!(bench.rotation.value(0x1016, 1), 0);
}

#[test]
fn an_axis_that_is_not_seen_to_stand_at_the_end_is_a_fault() {
    let mut bench = Bench::ready();
    bench.drive_on(20);
    bench.stage.disable(bench.now);
    for n in 0..300 {
        // Back and forth by 0.1 mm, within the following-error window.
        bench.insertion.counts += if n % 2 == 0 { 465 } else { -465 };
        bench.run_for(Duration::from_millis(10));
    }
    assert_eq!(
        bench.until_fault(),
        "insertion: not seen to stand 2000 ms after its last target (statusword 0x0237 operation \
         enabled); if it does not stop now, press the emergency stop"
    );
    bench.until_stopped();
    assert_eq!(bench.insertion.state, DriveState::SwitchOnDisabled);
}

#[test]
fn a_quick_stop_that_was_not_obeyed_is_sent_again() {
    let mut bench = Bench::ready();
    bench.drive_on(20);
    (bench.insertion.ignores_rpdo, bench.insertion.ignores_sdo) = (true, true);
    bench.sent.clear();
    bench.stage.quick_stop(bench.now);
    bench.run_for(Duration::from_millis(50));
    bench.insertion.ignores_sdo = false;
    assert!(bench.until_stopped(), "standstill is reported");
    let words: Vec<(u128, u8)> = by_sdo(&bench).iter().map(|(t, w)| (t.as_millis(), *w)).collect();
    assert_eq!(words[..3], [(0, 0x02), (20, 0x02), (100, 0x02)]);
    assert_eq!((words[3].1, words.len()), (0x00, 4));
}

/// The fault when an enabled drive clears `bits` that it has set so far.
fn fault_of_cleared(bits: u16) -> String {
    let mut bench = Bench::new(config());
    bench.rotation.extra_bits = bits;
    bench.until_feedback();
    bench.drive_on(10);
    bench.rotation.extra_bits = 0;
    bench.rotation.clear_bits = bits;
    bench.until_fault()
}

#[test]
fn a_drive_that_no_longer_obeys_or_follows_stops_the_run() {
    assert_eq!(
        fault_of_cleared(Statusword::REMOTE),
        "rotation: the drive no longer obeys the bus (statusword 0x0037 operation enabled, bit 9 \
         clear): it will ignore a stop; press the emergency stop"
    );
    assert_eq!(
        fault_of_cleared(Statusword::VOLTAGE_ENABLED),
        "rotation: the drive has lost its supply (statusword 0x0227 operation enabled, bit 4 \
         clear), is an emergency stop pressed, or a fuse blown?"
    );
    assert_eq!(
        fault_of_cleared(Statusword::FOLLOWS_COMMAND),
        "rotation: the drive ignores its targets (statusword 0x0237 operation enabled, bit 12 \
         clear), does an input or another tool hold it?"
    );
}

/// Such a drive would ignore a stop, so it gets no power, or loses it at once.
#[test]
fn a_drive_that_stops_obeying_during_enabling_is_a_fault() {
    use DriveState as S;
    for state in [S::ReadyToSwitchOn, S::SwitchedOn, S::OperationEnabled] {
        let mut bench = Bench::new(config());
        bench.rotation.extra_bits = Statusword::REMOTE;
        bench.insertion.brake_cycles = 20;
        while bench.rotation.state != state {
            bench.step();
        }
        (bench.rotation.extra_bits, bench.rotation.clear_bits) = (0, Statusword::REMOTE);
        let fault = bench.until_fault();
        assert!(fault.contains("the drive no longer obeys the bus"), "{state:?}: {fault}");
        assert!(!bench.events.contains(&StageEvent::Ready), "{state:?}");
    }
}

#[test]
fn an_internal_limit_that_holds_a_drive_for_a_while_is_no_fault() {
    let mut bench = Bench::new(config());
    bench.rotation.extra_bits = Statusword::FOLLOWS_COMMAND;
    bench.until_feedback();
    bench.rotation.extra_bits = Statusword::INTERNAL_LIMIT;
    bench.run_for(Duration::from_millis(100));
    bench.rotation.extra_bits = Statusword::FOLLOWS_COMMAND;
    bench.run_for(Duration::from_millis(100));
    assert!(bench.events.contains(&StageEvent::InternalLimit(Axis::Rotation)));
    assert_eq!(bench.fault(), None);
}

/// The stage cannot notice the loss of a bit that the drive never sets. It reports that once.
#[test]
fn a_status_bit_that_a_drive_never_sets_is_reported_and_no_fault() {
    let mut bench = Bench::new(config());
    bench.insertion.clear_bits = Statusword::REMOTE | Statusword::VOLTAGE_ENABLED;
    bench.rotation.extra_bits = Statusword::FOLLOWS_COMMAND;
    bench.run_for(Duration::from_secs(2));
    let not_shown = |event: &StageEvent| match event {
        StageEvent::NotShown(axis, flag) => Some((*axis, *flag)),
        StageEvent::Fault(fault) => panic!("{fault}"),
        _ => None,
    };
    let told: Vec<_> = bench.events.iter().filter_map(not_shown).collect();
    let flags = [DriveFlag::Remote, DriveFlag::Voltage, DriveFlag::FollowsCommand];
    assert_eq!(told, flags.map(|flag| (Axis::Insertion, flag)));
}

#[test]
fn repeated_warnings_are_reported_ever_more_rarely_and_no_fault() {
    let mut bench = Bench::ready();
    for _ in 0..9 {
        bench.rotation.extra_bits = Statusword::WARNING;
        bench.run_for(Duration::from_millis(50));
        bench.rotation.extra_bits = 0;
        bench.run_for(Duration::from_millis(50));
    }
    let count = |event: &StageEvent| match event {
        StageEvent::Warns { axis: Axis::Rotation, count, .. } => Some(*count),
        StageEvent::Fault(fault) => panic!("{fault}"),
        _ => None,
    };
    let told: Vec<u64> = bench.events.iter().filter_map(count).collect();
    assert_eq!(told, [1, 2, 4, 8]);
}

#[test]
fn an_undefined_statusword_is_a_fault() {
    let mut bench = Bench::ready();
    bench.drive_on(10);
    // Bits 6, 5, 3, 2, 1 and 0 match no state.
    (bench.rotation.extra_bits, bench.rotation.clear_bits) = (0x0040, 0x0005);
    assert_eq!(
        bench.until_fault(),
        "rotation: drive left operation enabled (statusword 0x0272 undefined drive state), was an \
         enable or limit switch opened?"
    );
}

/// Some drives read their encoder again when they are enabled.
#[test]
fn a_position_jump_at_enabling_is_a_fault_and_moves_nothing() {
    let mut bench = Bench::new(config());
    bench.insertion.brake_cycles = 5;
    while bench.insertion.state != DriveState::OperationEnabled {
        bench.step();
    }
    bench.insertion.counts += COUNTS_PER_MM;
    let fault = bench.until_fault();
    assert!(fault.starts_with("insertion: following error of -1.000 mm (limit 0."), "{fault}");
    let target = |(_, frame): &(Time, Frame)| match (frame.cob_id(), frame.data()) {
        (Some(0x201), [_, _, target @ ..]) => target.try_into().ok().map(i32::from_le_bytes),
        _ => None,
    };
    let targets = bench.sent.iter().filter_map(target).collect::<Vec<_>>();
    assert!(!targets.is_empty() && targets.iter().all(|at| *at == 1000), "{targets:?}");
}
