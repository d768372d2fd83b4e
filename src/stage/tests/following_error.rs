//! How far an axis may be from its target.

use super::*;

#[test]
fn an_axis_far_from_its_target_stops_the_run() {
    // The axis is ahead by 1 mm. The limit is the travel in 30 ms and 2 SYNC periods at 10 mm/s.
    let mut bench = Bench::ready();
    bench.drive_on(10);
    report_counts(&mut bench, 10, 1000 + 5111);
    assert_eq!(
        bench.until_fault(),
        "insertion: following error of -1.000 mm (limit 0.500); is the axis blocked, or the \
         encoder lost?"
    );
}

/// Replaces the TPDO1 of the insertion drive after the next SYNC by one with the position `counts`.
fn report_counts(bench: &mut Bench, sync_ms: u16, counts: i32) {
    bench.insertion.tpdos_lost = 1;
    bench.run_for(Duration::from_millis(sync_ms.into()));
    let [p0, p1, p2, p3] = counts.to_le_bytes();
    bench.receive(Frame::new(0x181, &[0x37, 0x02, p0, p1, p2, p3]));
}

/// The fault, if any, when a depth is reported `off_mm` from its target. The axis may move at 10 mm/s.
fn fault_of_a_depth_off(sync_ms: u16, window_mm: Option<f64>, off_mm: f64) -> Option<String> {
    let mut config = config();
    config.bus.sync_ms = sync_ms;
    config.insertion.following_error_max = window_mm;
    let mut bench = Bench::new(config);
    bench.until_feedback();
    report_counts(&mut bench, sync_ms, 1000 + (off_mm * f64::from(COUNTS_PER_MM)).round() as i32);
    bench.fault().map(str::to_owned)
}

#[test]
fn the_following_error_limit_is_the_window_plus_two_sync_periods() {
    for (sync_ms, window_mm, limit_mm) in [
        (1, None, 0.32),
        (10, None, 0.5),
        (100, None, 2.3),
        (1, Some(0.2), 0.22),
        (10, Some(1.0), 1.2),
        (100, Some(0.2), 2.2),
    ] {
        let fault = |off_mm| fault_of_a_depth_off(sync_ms, window_mm, off_mm);
        assert_eq!(fault(limit_mm - 0.01), None, "{sync_ms} ms");
        assert_eq!(fault(0.01 - limit_mm), None, "{sync_ms} ms");
        let too_far = fault(limit_mm + 0.01).expect("too far");
        assert!(too_far.contains(&format!("(limit {limit_mm:.3})")), "{too_far}");
        assert!(fault(-limit_mm - 0.01).is_some());
    }
}

#[test]
fn a_narrow_window_and_a_long_sync_period_let_the_axis_run_at_its_highest_speed() {
    let mut config = config();
    config.bus.sync_ms = 100;
    config.insertion.following_error_max = Some(0.2);
    let mut bench = Bench::new(config);
    bench.until_feedback();
    for step in 1..=20 {
        bench.command(f64::from(step) * 0.999, 0.0).expect("within limits");
        bench.until_feedback();
    }
    assert_eq!(bench.fault(), None);
}
