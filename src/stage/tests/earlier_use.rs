//! Bring-up of drives that keep what an earlier use has left in them, or that have a value of their own.

use super::bring_up::fault_of;
use super::*;
use crate::canopen::ObjectAddress;
use crate::canopen::sdo::AbortCode;

/// The drive adds 0x60B0 to each target.
#[test]
fn a_position_offset_from_an_earlier_use_does_not_move_the_axis() {
    let mut bench = Bench::new(config());
    bench.rotation.set(0x60b0, 0, 500_i32);
    bench.rotation.set(0x60b1, 0, -3_i32);
    bench.rotation.set(0x60b2, 0, 7_i16);
    bench.until_ready();
    bench.run_for(Duration::from_millis(200));
    let offsets = [0x60b0, 0x60b1, 0x60b2].map(|index| bench.rotation.value(index, 0));
    assert_eq!((bench.rotation.counts, offsets), (-20, [0; 3]));
}

/// Its RPDO5 would go on writing what an earlier use mapped to it.
#[test]
fn a_drive_with_eight_pdos_has_only_the_first_of_them_on() {
    let mut bench = Bench::new(config());
    for (index, cob_id) in [(0x1400, 0x0000_0581_u32), (0x1800, 0x4000_0481)] {
        (1..8)
            .for_each(|offset| bench.insertion.set(index + offset, 1, cob_id + u32::from(offset)));
    }
    bench.until_ready();
    for index in [0x1400, 0x1800] {
        let on = (0..8).filter(|offset| bench.insertion.value(index + offset, 1) >> 31 == 0);
        assert_eq!(on.collect::<Vec<_>>(), [0]);
    }
}

/// A modulo axis of an earlier use: a reading would stand for several positions.
#[test]
fn a_drive_whose_position_wraps_within_its_travel_gets_no_power() {
    let with_range = |wraps: bool, range: [i32; 2]| {
        let mut config = config();
        config.insertion.wraps = wraps;
        let mut bench = Bench::new(config);
        (1..).zip(range).for_each(|(sub, counts)| bench.insertion.set(0x607b, sub, counts));
        bench
    };
    for (wraps, range) in
        [(false, [0, 75_759]), (false, [5, 0]), (true, [-1_000_000_000, 1_000_000_000])]
    {
        let fault = with_range(wraps, range).until_fault();
        let [low, high] = range;
        let expected = format!("0x607B:01: the drive's position wraps at {low} and {high} counts");
        assert!(fault.contains(&expected), "{fault}");
    }
    for (wraps, range) in [
        (false, [0, 0]),
        (true, [0, 0]),
        (true, [i32::MIN, i32::MAX]),
        (false, [-1_000_000_000, 1_000_000_000]),
    ] {
        with_range(wraps, range).until_ready();
    }
}

/// A drive may have a fixed value of an object, and refuse every write to it.
#[test]
fn a_refused_value_that_the_drive_has_already_is_accepted() {
    let exponent = ObjectAddress::new(0x60c2, 2);
    let with = |value: i8| {
        let mut bench = Bench::new(config());
        bench.insertion.set(0x60c2, 2, value);
        bench.insertion.read_only = Some(exponent);
        bench
    };
    with(-3).until_ready();
    let fault = with(-4).until_fault();
    let expected = "0x60C2:02: writing 0xFD was refused with SDO abort 0x06010002 attempt to write a \
                    read-only object; the drive has 0xFC";
    assert!(fault.contains(expected), "{fault}");
}

/// CiA leaves it to the manufacturer whether a drive has it, and when it may be read.
#[test]
fn a_drive_that_does_not_give_its_position_offset_is_brought_up() {
    let object = ObjectAddress::new(0x60b0, 0);
    let mut bench = Bench::new(config());
    bench.insertion.objects.remove(&object);
    bench.rotation.refused = Some((object, AbortCode::UNSUPPORTED_ACCESS));
    bench.until_ready();
}

#[test]
fn a_drive_that_keeps_its_position_offset_or_is_silent_about_it_gets_no_power() {
    let object = ObjectAddress::new(0x60b0, 0);
    let fault = fault_of(config(), |bench| {
        bench.insertion.set(0x60b0, 0, 500_i32);
        bench.insertion.forgets = Some(object);
    });
    assert!(fault.contains("0x60B0:00: expected 0x00000000, received 0x000001F4"), "{fault}");
    let fault = fault_of(config(), |bench| bench.insertion.mute = Some((object, u32::MAX)));
    assert!(fault.contains("0x60B0:00: no SDO reply within 150 ms"), "{fault}");
}
