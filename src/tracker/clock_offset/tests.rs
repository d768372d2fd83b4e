//! The offset of a sender's clock: learnt, set, late, and overtaken stamps.

use super::*;

const MS: i64 = 1_000_000;

fn update(offset: &mut ClockOffset, receive_ms: i64, source_ms: i64) -> Result<i64, String> {
    let offset_ns = offset.update(Time::from_nanos(receive_ms * MS), source_ms * MS);
    offset_ns.map(|ns| ns / MS).map_err(|refusal| refusal.to_string())
}

/// The clock is still being learnt.
fn is_learning(dated: &Result<i64, String>) -> bool {
    matches!(dated, Err(why) if why.contains("is still being learnt"))
}

/// Samples every 25 ms, delivered at once, of a sender whose clock is ahead by `ahead_ms`.
fn listen(offset: &mut ClockOffset, from_ms: i64, ahead_ms: i64) -> Vec<Result<i64, String>> {
    let times = (0..12).map(|n| from_ms + 25 * n);
    times.map(|ms| update(offset, ms, ms + ahead_ms)).collect()
}

#[test]
fn an_offset_is_known_after_a_while() {
    let mut offset = ClockOffset::default();
    let learnt = listen(&mut offset, 0, 500);
    assert!(learnt[..8].iter().all(is_learning));
    assert_eq!(learnt[8..], vec![Ok(-500); 4], "200 ms later");
}

/// A server that kept two seconds of measurements and sends them all when it is called.
#[test]
fn a_backlog_is_not_taken_for_fresh() {
    let mut offset = ClockOffset::default();
    for n in 0..80 {
        let dated = update(&mut offset, 0, -2000 + 25 * n);
        assert!(is_learning(&dated), "{n}: {dated:?}");
    }
    assert_eq!(listen(&mut offset, 25, 0).last(), Some(&Ok(0)));
}

/// A server that sends its last pose when it is called, however old.
#[test]
fn a_stale_first_sample_is_not_taken_for_fresh() {
    let mut offset = ClockOffset::default();
    assert!(update(&mut offset, 0, -3000).is_err());
    let learnt = listen(&mut offset, 25, 0);
    assert_eq!(learnt.iter().find(|dated| dated.is_ok()), Some(&Ok(0)));
}

#[test]
fn a_stamp_ahead_is_put_aside_also_while_learning() {
    let mut offset = ClockOffset::default();
    assert!(update(&mut offset, 0, 10_000).is_err());
    assert_eq!(listen(&mut offset, 25, 0).last(), Some(&Ok(0)));
    let ahead = "stamp: 10.000 s ahead of the sender's clock so far; was it set?";
    assert_eq!(update(&mut offset, 400, 10_400), Err(ahead.to_owned()));
    assert_eq!(update(&mut offset, 425, 425), Ok(0));
}

#[test]
fn a_clock_that_was_set_ahead_is_followed_after_a_while() {
    let mut offset = ClockOffset::default();
    listen(&mut offset, 0, 0);
    let after = listen(&mut offset, 300, 10_000);
    let is_ahead =
        |dated: &Result<_, String>| matches!(dated, Err(why) if why.contains(" s ahead of "));
    assert!(after[..8].iter().all(is_ahead));
    assert_eq!(after[8..], vec![Ok(-10_000); 4]);
}

/// The offset is learnt after 200 ms, and reported. Until then no sample is dated.
#[test]
fn a_clock_that_was_set_back_is_followed_after_a_while() {
    for by_ms in [50, 100, 300, 450] {
        let mut offset = ClockOffset::default();
        listen(&mut offset, 0, 0);
        let after = listen(&mut offset, 300, -by_ms);
        assert!(after[..8].iter().all(Result::is_err), "{by_ms}: {after:?}");
        assert_eq!(after[8..], vec![Ok(by_ms); 4]);
        let told = offset.news().unwrap();
        let by_s = by_ms as f64 * 1e-3;
        assert_eq!(
            told,
            format!("the sender's clock was set back by {by_s:.3} s; its offset was learnt again")
        );
        assert_eq!(offset.news(), None);
    }
}

/// By little more than a period: only the stamp that goes back is refused, and those after it are
/// dated by the old offset until the new one is learnt.
#[test]
fn a_clock_that_was_set_back_a_little_is_learnt_while_the_old_offset_dates() {
    for by_ms in [26, 30, 39] {
        let mut offset = ClockOffset::default();
        listen(&mut offset, 0, 0);
        let after = listen(&mut offset, 300, -by_ms);
        assert!(after[0].is_err(), "{by_ms}: {after:?}");
        assert_eq!(after[1..8], vec![Ok(0); 7], "{by_ms}");
        assert_eq!(after[8..], vec![Ok(by_ms); 4], "{by_ms}");
        assert!(offset.news().unwrap().contains(&format!(" set back by 0.0{by_ms} s; ")));
    }
}

/// In a stream that is steadily 15 ms late a stamp is overtaken and goes back by 3 ms: the offset after it is as
/// before it.
#[test]
fn a_stamp_that_was_overtaken_is_no_clock_that_was_set() {
    let mut offset = ClockOffset::default();
    listen(&mut offset, 0, 0);
    for n in 30..130 {
        let delay_ms = if n == 60 { 28 } else { 15 };
        let dated = update(&mut offset, 10 * n + 15, 10 * n + 15 - delay_ms);
        assert!(dated == Ok(0) || n == 60, "{n}: {dated:?}");
    }
    assert_eq!(offset.news(), None);
}

/// By less than a period no stamp goes back: it may be a delay. The operator is warned.
#[test]
fn a_clock_that_was_set_back_by_less_than_a_period_is_warned_of() {
    let mut offset = ClockOffset::default();
    listen(&mut offset, 0, 0);
    let mut told = Vec::new();
    for n in 12..260 {
        assert_eq!(update(&mut offset, 25 * n, 25 * n - 15), Ok(0), "{n}");
        told.extend(offset.news().map(|text| (25 * (n - 12), text)));
    }
    let (at_ms, text) = &told[0];
    assert!(told.len() == 1 && text.contains(" come 0.015 s later than before: "), "{told:?}");
    assert_eq!(*at_ms, 5000);
}

/// A small delay that lasts hides no large one.
#[test]
fn a_delay_that_grows_is_told_again() {
    let mut offset = ClockOffset::default();
    listen(&mut offset, 0, 0);
    let mut told = Vec::new();
    for n in 12..600 {
        let late_ms = if n < 300 { 15 } else { 300 };
        assert_eq!(update(&mut offset, 25 * n + late_ms, 25 * n), Ok(0), "{n}");
        told.extend(offset.news().map(|text| (25 * n, text)));
    }
    let late_s = |text: &str| text.split(' ').nth(5).map(str::to_owned);
    let said: Vec<_> = told.iter().map(|(at_ms, text)| (*at_ms, late_s(text))).collect();
    assert_eq!(said, [(5300, Some("0.015".to_owned())), (8500, Some("0.300".to_owned()))]);
}

/// A network that delays each position by up to 60 ms, in order.
#[test]
fn a_network_that_jitters_is_no_clock_that_was_set() {
    let mut offset = ClockOffset::default();
    listen(&mut offset, 0, 0);
    let mut receive_ms = 300;
    for n in 12..4000_i64 {
        receive_ms = receive_ms.max(25 * n + (n * 7919) % 61);
        assert_eq!(update(&mut offset, receive_ms, 25 * n), Ok(0), "{n}");
        assert_eq!(offset.news(), None, "{n}");
    }
}

/// By then an insertion is held.
#[test]
fn another_clock_takes_a_second_to_be_followed() {
    let mut offset = ClockOffset::default();
    listen(&mut offset, 0, 0);
    let dated = (12..100).map(|n| 25 * n).find(|ms| update(&mut offset, *ms, ms - 9000).is_ok());
    assert_eq!(dated, Some(1300));
}

/// A queue delays what comes after it and keeps its order: dated by the old offset, too old
/// where it was the clock, never too young. It is told of once.
#[test]
fn what_may_have_waited_is_dated_as_delayed() {
    let mut offset = ClockOffset::default();
    listen(&mut offset, 0, 0);
    let mut told = Vec::new();
    for n in 12..200 {
        assert_eq!(update(&mut offset, 25 * n + 300, 25 * n), Ok(0), "{n}");
        told.extend(offset.news());
    }
    let late = "by their stamps, positions come 0.300 s later than before: ";
    assert!(told.len() == 1 && told[0].starts_with(late), "{told:?}");
}

/// One that was sent again, or overtaken, in a stream that is late: its stamp goes back, those
/// after it do not go on from there.
#[test]
fn one_stamp_that_goes_back_is_no_clock_that_was_set() {
    let mut offset = ClockOffset::default();
    listen(&mut offset, 0, 0);
    let back = "stamp: went back by 1.275 s; was the sender's clock set?";
    assert_eq!(update(&mut offset, 300, -1000), Err(back.to_owned()));
    assert_eq!(update(&mut offset, 325, 325), Ok(0));
    assert!(update(&mut offset, 350, -950).is_err());
    for n in 15..60 {
        assert_eq!(update(&mut offset, 25 * n + 60, 25 * n), Ok(0), "60 ms late");
    }
}

/// A server that sends its last second again, at its own rate, is no clock that was set, if it
/// catches up.
#[test]
fn a_backlog_sent_again_is_not_taken_for_fresh() {
    let mut offset = ClockOffset::default();
    listen(&mut offset, 0, 0);
    for n in 0..40 {
        assert!(update(&mut offset, 300 + 10 * n, -725 + 25 * n).is_err(), "{n}");
    }
    assert_eq!(update(&mut offset, 700, 700), Ok(0));
    assert_eq!(offset.news(), None);
}

/// The same stamp over and over is no clock that was set.
#[test]
fn a_stamp_that_is_stuck_ahead_is_never_followed() {
    let mut offset = ClockOffset::default();
    listen(&mut offset, 0, 0);
    for n in 0..40 {
        assert!(update(&mut offset, 300 + 25 * n, 10_000).is_err());
    }
}

#[test]
fn a_clock_that_runs_slow_is_followed() {
    // 1 ms in a second slow, for 10 minutes: with the first offset kept, 600 ms off.
    let mut offset = ClockOffset::default();
    let lag_ms = (0..600).filter_map(|s| {
        let offset_ms = update(&mut offset, s * 1000, s * 1000 - s).ok()?;
        Some(s - offset_ms)
    });
    assert_eq!(lag_ms.max(), Some(59));
}
