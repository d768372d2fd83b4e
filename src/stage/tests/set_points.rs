//! Set-points: when they are sent, and when they are refused.

use super::*;
use crate::canopen::cob;

#[test]
fn set_points_go_to_both_axes_before_one_sync_and_come_back_measured() {
    let mut bench = Bench::ready();
    bench.sent.clear();
    bench.command(0.05, 0.1).expect("within limits");
    let feedback = bench.until_feedback();
    let frames: Vec<String> = bench.sent.iter().map(|(_, frame)| frame.to_string()).collect();
    // 1000 + 232 = 0x4D0 counts; -20 + 1206 = 0x4A2 counts.
    assert_eq!(frames[..3], ["201#0F00D0040000", "202#0F00A2040000", "080#"]);
    assert_eq!((feedback.measured.insertion_mm, feedback.measured.rotation_rad), (0.0, 0.0));
    assert!((feedback.commanded.insertion_mm - 0.05).abs() < 0.5 / f64::from(COUNTS_PER_MM));

    let next = bench.until_feedback();
    assert_eq!(next.sync, feedback.sync + 1);
    assert_eq!(next.time.since(feedback.time), Duration::from_millis(10));
    assert_eq!(next.measured.insertion_mm, next.commanded.insertion_mm, "reached and held");
    assert_eq!(next.measured.rotation_rad, next.commanded.rotation_rad);
}

#[test]
fn a_later_command_replaces_an_earlier_one() {
    let mut bench = Bench::ready();
    bench.command(0.05, 0.0).expect("within limits");
    bench
        .command(-0.02, 0.0)
        .expect("its speed counts from the target in force, not from the replaced one");
    let feedback = bench.until_feedback();
    assert!((feedback.commanded.insertion_mm + 0.02).abs() < 1e-3);
}

/// The frames that `bench` sends from now to its next SYNC, with their times.
fn until_sync(bench: &mut Bench) -> Vec<(Time, String)> {
    let begun = bench.sent.len();
    while bench.sent.last().is_none_or(|(_, frame)| frame.cob_id() != Some(cob::SYNC)) {
        bench.step();
    }
    bench.sent[begun..].iter().map(|(time, frame)| (*time, frame.to_string())).collect()
}

#[test]
fn set_points_are_sent_at_once_and_held_ones_with_the_sync() {
    let mut bench = Bench::ready();
    bench.sent.clear();
    let commanded = bench.now;
    bench.command(0.05, 0.1).expect("within limits");
    let sent = until_sync(&mut bench);
    let [insertion, rotation, sync] = sent.as_slice() else { panic!("{sent:?}") };
    assert_eq!([&insertion.1, &rotation.1], ["201#0F00D0040000", "202#0F00A2040000"]);
    assert_eq!([insertion.0, rotation.0], [commanded; 2]);
    assert_eq!(sync, &(commanded + Duration::from_millis(10), "080#".to_owned()));
    // Without new ones the last are held, and these are sent with the SYNC.
    bench.sent.clear();
    let sent = until_sync(&mut bench);
    let frames: Vec<&str> = sent.iter().map(|(_, frame)| frame.as_str()).collect();
    assert_eq!(frames, ["201#0F00D0040000", "202#0F00A2040000", "080#"]);
    assert!(sent.iter().all(|(time, _)| *time == sync.0 + Duration::from_millis(10)));
}

#[test]
fn a_stop_replaces_targets_that_were_sent_ahead_of_the_sync() {
    for quick in [false, true] {
        let mut bench = Bench::ready();
        bench.sent.clear();
        bench.command(0.05, 0.1).expect("within limits");
        match quick {
            true => bench.stage.quick_stop(bench.now),
            false => bench.stage.disable(bench.now),
        }
        let sent = until_sync(&mut bench);
        let last = |id: &str| sent.iter().rfind(|(_, frame)| frame.starts_with(id)).unwrap();
        let controlword = if quick { "0200" } else { "0F00" };
        // Where the axes stood: 1000 = 0x3E8 and -20 counts.
        assert_eq!(last("201#").1, format!("201#{controlword}E8030000"));
        assert_eq!(last("202#").1, format!("202#{controlword}ECFFFFFF"));
        bench.until_stopped();
        assert_eq!((bench.insertion.counts, bench.rotation.counts), (1000, -20));
    }
}

#[test]
fn a_late_bench_skips_whole_periods_and_never_bursts() {
    let mut bench = Bench::ready();
    let due = bench.stage.sync.deadline;
    bench.sent.clear();
    bench.now = due + Duration::from_millis(35);
    bench.stage.handle_timeout(bench.now);
    bench.settle();
    let syncs = |bench: &Bench| {
        let is_sync = |(_, f): &&(Time, Frame)| f.cob_id() == Some(cob::SYNC);
        bench.sent.iter().filter(is_sync).map(|(time, _)| *time).collect::<Vec<_>>()
    };
    assert_eq!(syncs(&bench).len(), 1);
    assert!(bench.events.contains(&StageEvent::SyncSkipped { periods: 3, total: 3 }));
    let Counters { syncs_skipped, sync_late_max, .. } = bench.stage.counters();
    assert_eq!((syncs_skipped, sync_late_max), (3, Duration::from_millis(35)));
    bench.run_for(Duration::from_millis(5));
    assert_eq!(
        syncs(&bench)[1],
        due + Duration::from_millis(40),
        "a multiple of the period after the first"
    );
    // A total of 4 is a power of two. The last two skip more periods at once than any before.
    for (periods, total, is_reported) in [(1, 4, true), (1, 5, false), (4, 9, true), (5, 14, true)]
    {
        bench.events.clear();
        bench.now = bench.stage.sync.deadline + Duration::from_millis(10 * periods + 5);
        bench.stage.handle_timeout(bench.now);
        bench.settle();
        assert_eq!(bench.stage.counters().syncs_skipped, total);
        let event = StageEvent::SyncSkipped { periods, total };
        assert_eq!(bench.events.contains(&event), is_reported, "{total}");
    }
}

/// While positions are missing the stage itself holds the axes. The limit of 10 mm/s² allows a change of
/// 4.6 counts a SYNC, and the axis moves at 46 counts a SYNC.
#[test]
fn lost_positions_do_not_count_as_acceleration() {
    for lost in [1_u8, 3] {
        let mut config = config();
        config.insertion.limits.acceleration_max = Some(10.0);
        config.bus.missed_feedback_max = lost;
        let mut bench = Bench::new(config);
        let feedback = bench.until_feedback();
        let (mut at, mut speed) = (feedback.commanded.insertion_mm, 0.0);
        for sync in 0..100 {
            speed += if speed < 1.0 { 0.1 } else { 0.0 };
            at += speed * 0.01;
            bench.command(at, 0.0).expect("within limits");
            bench.rotation.tpdos_lost = if sync == 50 { lost.into() } else { 0 };
            let held = bench.until_feedback().commanded.insertion_mm;
            assert!((at - held).abs() < 1e-3, "{at} {held}");
        }
        assert_eq!(bench.stage.counters().feedback_missed, u64::from(lost));
        // At standstill the limit applies again.
        bench.run_for(Duration::from_millis(50));
        bench.until_feedback();
        let refused = bench.command(at + 0.01, 0.0).expect_err("refused");
        assert!(refused.contains("over the limit of 10.000 mm/s²"), "{refused}");
    }
}

#[test]
fn no_command_is_taken_on_old_positions() {
    let mut bench = Bench::ready();
    bench.rotation.tpdos_lost = 1;
    bench.step();
    let refused = bench.command(0.01, 0.0).expect_err("refused");
    assert!(refused.ends_with("have not arrived; older ones must not be used"), "{refused}");
    bench.until_feedback();
    bench.command(0.01, 0.0).expect("positions of this SYNC");
}

#[test]
fn a_refused_command_moves_neither_axis() {
    let mut bench = Bench::ready();
    let refused = bench.command(0.05, 5.0).expect_err("refused");
    assert_eq!(
        refused,
        "rotation: a step of 286.479 deg in one SYNC is 28647.890 deg/s, over the limit of 1145.916 deg/s \
         (stage.rotation.speed_max_deg_per_s)"
    );
    let feedback = bench.until_feedback();
    assert_eq!((feedback.commanded.insertion_mm, feedback.commanded.rotation_rad), (0.0, 0.0));
    for (insertion_mm, rotation_rad) in [(f64::NAN, 0.0), (0.0, f64::INFINITY)] {
        let refused = bench.command(insertion_mm, rotation_rad).expect_err("refused");
        assert!(refused.ends_with("is not a finite number"), "{refused}");
    }
}

#[test]
fn a_wrapping_rotation_continues_past_32_bits() {
    let mut config = config();
    config.rotation.wraps = true;
    let mut bench = Bench::new(config);
    bench.rotation.counts = i32::MAX - 100;
    bench.until_feedback();
    bench.drive_on(10);
    let feedback = bench.until_feedback();
    assert!(bench.rotation.counts < 0, "the count wrapped");
    assert!(
        (feedback.measured.rotation_rad - 0.1).abs() < 1e-4,
        "{}",
        feedback.measured.rotation_rad
    );
}

/// An insertion whose counts fall with depth, and wrap at the end of 32 bits.
#[test]
fn a_reversed_axis_across_32_bits_is_refused_at_its_limits() {
    let mut config = config();
    config.insertion.sign = Sign::Negative;
    config.insertion.wraps = true;
    (config.insertion.limits.min, config.insertion.limits.max) = (-0.1, 0.3);
    let mut bench = Bench::new(config);
    bench.insertion.counts = i32::MIN + 100;
    bench.until_feedback();
    for at in [0.1, 0.2, 0.3] {
        bench.command(at, 0.0).expect("within limits");
        bench.until_feedback();
    }
    let refused = bench.command(0.301, 0.0).expect_err("refused");
    assert_eq!(
        refused,
        "insertion: 0.301 mm is over the limit of 0.300 mm (stage.insertion.max_mm)"
    );
    let feedback = bench.until_feedback();
    assert!(
        (feedback.measured.insertion_mm - 0.3).abs() < 1e-3,
        "{}",
        feedback.measured.insertion_mm
    );
    assert_eq!(
        bench.insertion.counts,
        i32::MAX - 1293,
        "it started 100 counts above the minimum and moved down by 1394"
    );
    for at in [0.2, 0.1, 0.0, -0.1] {
        bench.command(at, 0.0).expect("within limits");
        bench.until_feedback();
    }
    let refused = bench.command(-0.101, 0.0).expect_err("refused");
    assert_eq!(
        refused,
        "insertion: -0.101 mm is under the limit of -0.100 mm (stage.insertion.min_mm)"
    );
}
