//! Tests of a sender's clock offset: learning it, clocks that are set, late and overtaken stamps.

use super::*;

const MS: i64 = 1_000_000;

fn update(offset: &mut ClockOffset, receive_ms: i64, source_ms: i64) -> Result<i64, String> {
    let offset_ns = offset.update(Time::from_nanos(receive_ms * MS), source_ms * MS);
    offset_ns.map(|ns| ns / MS).map_err(|refusal| refusal.to_string())
}

/// True if `dated` was refused because the offset is still being learnt.
fn is_learning(dated: &Result<i64, String>) -> bool {
    matches!(dated, Err(why) if why.contains("is still being learnt"))
}

/// Twelve samples, one every 25 ms, delivered at once, from a sender whose clock is ahead by `ahead_ms`.
fn listen(offset: &mut ClockOffset, from_ms: i64, ahead_ms: i64) -> Vec<Result<i64, String>> {
    let times = (0..12).map(|n| from_ms + 25 * n);
    times.map(|ms| update(offset, ms, ms + ahead_ms)).collect()
}

/// After 5 s of positions that are delivered at once, of which the first no longer count.
fn known() -> ClockOffset {
    let mut offset = ClockOffset::default();
    for n in 0..200 {
        let dated = update(&mut offset, 25 * n, 25 * n);
        assert!(dated == Ok(0) || is_learning(&dated), "{n}: {dated:?}");
    }
    offset
}

#[test]
fn an_offset_is_learnt_within_200_ms() {
    let mut offset = ClockOffset::default();
    let learnt = listen(&mut offset, 0, 500);
    assert!(learnt[..8].iter().all(is_learning));
    assert_eq!(learnt[8..], vec![Ok(-500); 4], "200 ms later");
}

/// Stamps that are stuck, that alternate, and of a clock that runs backward.
#[test]
fn stamps_that_are_no_clock_are_named_while_learning() {
    type StampMs = fn(i64) -> i64;
    let cases: [(StampMs, &str); 3] = [
        (|_| 7000, "duplicate: sent twice (stamp 7000000000 ns)"),
        (|n| 7000 - 25 * n, "stamp: went back by 0.025 s; was the sender's clock set?"),
        (|n| 7000 + 100 * (n % 2), "stamp: went back by 0.100 s; was the sender's clock set?"),
    ];
    for (stamp_ms, expected) in cases {
        let mut offset = ClockOffset::default();
        let dated: Vec<_> =
            (0..200).map(|n| update(&mut offset, 25 * n, stamp_ms(n)).unwrap_err()).collect();
        assert!(dated[0].contains("is still being learnt, from 1 samples"), "{}", dated[0]);
        assert_eq!(dated[2], expected);
        let advice = "; no offset was learnt: set tracker.stamp = \"receive\"";
        assert!(dated[118].strip_suffix(advice).is_none(), "{}", dated[118]);
        assert_eq!(dated[198], format!("{expected}{advice}"));
        assert!(dated[198].chars().count() < 200, "{}", dated[198]);
    }
}

/// A server that kept two seconds of measurements sends them all at the connection.
#[test]
fn a_backlog_sent_at_connection_is_not_dated_as_fresh() {
    let mut offset = ClockOffset::default();
    for n in 0..80 {
        let dated = update(&mut offset, 0, -2000 + 25 * n);
        assert!(is_learning(&dated), "{n}: {dated:?}");
    }
    assert_eq!(listen(&mut offset, 25, 0).last(), Some(&Ok(0)));
}

/// A server sends its last pose at the connection, however old the pose is.
#[test]
fn a_stale_first_sample_is_not_dated_as_fresh() {
    let mut offset = ClockOffset::default();
    assert!(is_learning(&update(&mut offset, 0, -3000)));
    let learnt = listen(&mut offset, 25, 0);
    assert_eq!(learnt.iter().find(|dated| dated.is_ok()), Some(&Ok(0)));
}

#[test]
fn a_stamp_far_ahead_is_refused_also_while_learning() {
    let mut offset = ClockOffset::default();
    assert!(is_learning(&update(&mut offset, 0, 10_000)));
    assert_eq!(listen(&mut offset, 25, 0).last(), Some(&Ok(0)));
    let ahead = "stamp: 10.000 s ahead of the sender's clock so far; was it set?";
    assert_eq!(update(&mut offset, 400, 10_400), Err(ahead.to_owned()));
    assert_eq!(update(&mut offset, 425, 425), Ok(0));
}

#[test]
fn a_clock_that_was_set_ahead_is_followed_after_200_ms() {
    let mut offset = ClockOffset::default();
    listen(&mut offset, 0, 0);
    let after = listen(&mut offset, 300, 10_000);
    let is_ahead =
        |dated: &Result<_, String>| matches!(dated, Err(why) if why.contains(" s ahead of "));
    assert!(after[..8].iter().all(is_ahead));
    assert_eq!(after[8..], vec![Ok(-10_000); 4]);
}

/// Until the new offset is learnt, no sample is dated. Then it is reported.
#[test]
fn a_clock_that_was_set_back_is_followed_after_200_ms() {
    for by_ms in [50, 100, 300, 450] {
        let mut offset = ClockOffset::default();
        listen(&mut offset, 0, 0);
        let after = listen(&mut offset, 300, -by_ms);
        assert!(after[..8].iter().all(Result::is_err), "{by_ms}: {after:?}");
        assert_eq!(after[8..], vec![Ok(by_ms); 4]);
        let by_s = by_ms as f64 * 1e-3;
        let set_back =
            format!("the sender's clock was set back by {by_s:.3} s; its offset was learnt again");
        assert_eq!(offset.news(), Some(set_back));
        assert_eq!(offset.news(), None);
    }
}

/// The clock goes back by little more than a period, so only one stamp goes back and is refused.
#[test]
fn the_old_offset_dates_a_clock_that_was_set_back_by_little_until_it_is_learnt() {
    for by_ms in [26, 30, 39] {
        let mut offset = ClockOffset::default();
        listen(&mut offset, 0, 0);
        let after = listen(&mut offset, 300, -by_ms);
        let back = matches!(&after[0], Err(why) if why.contains(" went back by "));
        assert!(back, "{by_ms}: {after:?}");
        assert_eq!(after[1..8], vec![Ok(0); 7], "{by_ms}");
        assert_eq!(after[8..], vec![Ok(by_ms); 4], "{by_ms}");
        assert!(offset.news().unwrap().contains(&format!(" set back by 0.0{by_ms} s; ")));
    }
}

/// In a stream that is steadily 15 ms late, one stamp is overtaken and goes back by 3 ms. The offset is the same
/// before and after it.
#[test]
fn an_overtaken_stamp_is_not_taken_for_a_clock_set_back() {
    let mut offset = ClockOffset::default();
    listen(&mut offset, 0, 0);
    for n in 30..130 {
        let delay_ms = if n == 60 { 28 } else { 15 };
        let dated = update(&mut offset, 10 * n + 15, 10 * n + 15 - delay_ms);
        assert!(dated == Ok(0) || n == 60, "{n}: {dated:?}");
    }
    assert_eq!(offset.news(), None);
}

/// No stamp goes back, so it may also be a delay.
#[test]
fn a_clock_set_back_by_less_than_a_period_gives_a_warning() {
    let mut offset = known();
    let mut reported = Vec::new();
    for n in 200..448 {
        assert_eq!(update(&mut offset, 25 * n, 25 * n - 15), Ok(0), "{n}");
        reported.extend(offset.news().map(|text| (25 * (n - 200), text)));
    }
    let (at_ms, text) = &reported[0];
    assert!(
        reported.len() == 1 && text.contains(" come 0.015 s later than before: "),
        "{reported:?}"
    );
    assert_eq!(*at_ms, 5000);
}

/// A small delay that lasts must not hide a large one.
#[test]
fn a_delay_that_grows_is_reported_again() {
    let mut offset = known();
    let mut reported = Vec::new();
    for n in 200..788 {
        let late_ms = if n < 488 { 15 } else { 300 };
        assert_eq!(update(&mut offset, 25 * n + late_ms, 25 * n), Ok(0), "{n}");
        reported.extend(offset.news().map(|text| (25 * n, text)));
    }
    let late_s = |text: &str| text.split(' ').nth(5).map(str::to_owned);
    let lateness: Vec<_> = reported.iter().map(|(at_ms, text)| (*at_ms, late_s(text))).collect();
    assert_eq!(lateness, [(10_000, Some("0.015".to_owned())), (13_200, Some("0.300".to_owned()))]);
}

/// The first stamps are ahead by 0.2 s, and right after 1 s, as PLUS's filter makes them. None of them goes back.
#[test]
fn stamps_that_are_wrong_at_first_are_forgotten_after_4_s() {
    let mut offset = ClockOffset::default();
    let mut reported = Vec::new();
    for n in 0..2000 {
        let ms = 25 * n;
        let dated = update(&mut offset, ms, ms + (200 - ms / 5).max(0));
        let expected_ms = if ms < 4000 { -200 } else { 0 };
        assert!(dated == Ok(expected_ms) || is_learning(&dated) && ms < 200, "{ms}: {dated:?}");
        reported.extend(offset.news().map(|text| (ms, text)));
    }
    let last = reported.pop().expect("reported");
    let text = "by their stamps, positions have come 0.200 s later for 2 s or more; this is now taken for the \
                sender's clock: they are dated 0.200 s later";
    assert_eq!(last, (4000, text.to_owned()));
    assert!(reported.len() == 1 && reported[0].1.contains(" later than before: "), "{reported:?}");
}

/// From 1 s on each position comes 0.6 s late: more than the first stamps of a filter are off.
#[test]
fn first_stamps_that_are_far_from_the_later_ones_count_for_half_a_minute() {
    let mut offset = ClockOffset::default();
    for n in 0..1600 {
        let ms = 25 * n;
        let receive_ms = if ms < 1000 { ms } else { ms + 600 };
        let dated = update(&mut offset, receive_ms, ms);
        let expected_ms = if receive_ms < 34_000 { 0 } else { 600 };
        assert!(dated == Ok(expected_ms) || is_learning(&dated) && ms < 200, "{ms}: {dated:?}");
    }
}

/// The delay grows by 10 ms a second from the first position on. Only what it was in the first 2 s counts as the
/// clock.
#[test]
fn a_delay_that_only_grows_is_reported_and_dated_as_delayed() {
    let mut offset = ClockOffset::default();
    let mut reported = Vec::new();
    for n in 0..1000 {
        let ms = 25 * n;
        let dated = update(&mut offset, ms + ms / 100, ms);
        assert!(matches!(dated, Ok(0..=20)) || is_learning(&dated) && ms < 200, "{ms}: {dated:?}");
        reported.extend(offset.news().map(|text| (ms, text)));
    }
    let [(first_ms, first), (again_ms, again)] = &reported[..] else { panic!("{reported:?}") };
    assert!(first.contains(" later than before: ") && again.contains(" later than before: "));
    assert!(*first_ms <= 9000 && *again_ms <= 9000, "{reported:?}");
}

/// The network delays each position by up to 60 ms and keeps their order.
#[test]
fn network_jitter_is_not_taken_for_a_clock_set_back() {
    let mut offset = ClockOffset::default();
    listen(&mut offset, 0, 0);
    let mut receive_ms = 300;
    for n in 12..4000_i64 {
        receive_ms = receive_ms.max(25 * n + (n * 7919) % 61);
        assert_eq!(update(&mut offset, receive_ms, 25 * n), Ok(0), "{n}");
        assert_eq!(offset.news(), None, "{n}");
    }
}

/// An insertion is held before that.
#[test]
fn a_clock_set_back_by_seconds_is_followed_after_1_s() {
    let mut offset = ClockOffset::default();
    listen(&mut offset, 0, 0);
    let dated = (12..100).map(|n| 25 * n).find(|ms| update(&mut offset, *ms, ms - 9000).is_ok());
    assert_eq!(dated, Some(1300));
}

/// The positions may have waited in a queue. If the clock was set back instead, they are dated too old, never
/// too young.
#[test]
fn a_lasting_delay_is_dated_by_the_old_offset_and_reported_once() {
    let mut offset = known();
    let mut reported = Vec::new();
    for n in 200..388 {
        assert_eq!(update(&mut offset, 25 * n + 300, 25 * n), Ok(0), "{n}");
        reported.extend(offset.news());
    }
    let late = "by their stamps, positions come 0.300 s later than before: ";
    assert!(reported.len() == 1 && reported[0].starts_with(late), "{reported:?}");
}

/// A sample was sent again, or overtaken: the stamps after it do not go on from its stamp.
#[test]
fn one_stamp_that_goes_back_is_not_taken_for_a_clock_set_back() {
    let mut offset = ClockOffset::default();
    listen(&mut offset, 0, 0);
    let back = "stamp: went back by 1.275 s; was the sender's clock set?";
    assert_eq!(update(&mut offset, 300, -1000), Err(back.to_owned()));
    assert_eq!(update(&mut offset, 325, 325), Ok(0));
    let again = update(&mut offset, 350, -950);
    assert!(again.is_err_and(|why| why.starts_with("stamp: went back by 1.275 s")));
    for n in 15..60 {
        assert_eq!(update(&mut offset, 25 * n + 60, 25 * n), Ok(0), "60 ms late");
    }
}

/// A server sends its last second of samples again, faster than it measured them, and catches up.
#[test]
fn a_backlog_sent_again_is_not_dated_as_fresh() {
    let mut offset = ClockOffset::default();
    listen(&mut offset, 0, 0);
    for n in 0..40 {
        assert!(update(&mut offset, 300 + 10 * n, -725 + 25 * n).is_err(), "{n}");
    }
    assert_eq!(update(&mut offset, 700, 700), Ok(0));
    assert_eq!(offset.news(), None);
}

/// The same stamp is sent over and over.
#[test]
fn a_stamp_that_is_stuck_ahead_is_never_followed() {
    let mut offset = ClockOffset::default();
    listen(&mut offset, 0, 0);
    for n in 0..40 {
        assert!(update(&mut offset, 300 + 25 * n, 10_000).is_err());
    }
    assert_eq!(update(&mut offset, 1300, 1300), Ok(0));
}

#[test]
fn a_clock_that_runs_slow_is_followed() {
    // It loses 1 ms per second for 10 minutes: the first offset would be 600 ms off at the end.
    let mut offset = ClockOffset::default();
    let lag_ms = (0..600).filter_map(|s| {
        let offset_ms = update(&mut offset, s * 1000, s * 1000 - s).ok()?;
        Some(s - offset_ms)
    });
    assert_eq!(lag_ms.max(), Some(59));
}
