//! Tests of the track.

use super::*;
use proptest::prelude::*;

fn settings() -> TrackSettings {
    TrackSettings {
        kind: TrackerKind::Electromagnetic,
        noise_sd_mm: 0.6,
        tip_speed_max_mm_per_s: 10.0,
        step_sds: 6.0,
        innovation_chi2: 16.3,
        model_sd_mm: 1.0,
        model_sd_per_mm: 0.2,
        lost_after: 5,
        found_after: 3,
        coast_after_periods: 2.0,
        correlated: None,
    }
}

/// The n-th position of a needle that moves along z by 0.05 mm every 25 ms; it is off by `x_mm`.
fn fix(n: i32, x_mm: f64) -> Fix {
    let at = Time::from_secs_f64(0.025 * f64::from(n));
    let depth_mm = 0.05 * f64::from(n);
    Fix {
        receive_time: at,
        acquisition_time: at,
        position_mm: Vector3::new(x_mm, 0.0, depth_mm),
        insertion_mm: Some(depth_mm),
    }
}

fn standing(n: i32, x_mm: f64) -> Fix {
    Fix { insertion_mm: None, position_mm: Vector3::x() * x_mm, ..fix(n, x_mm) }
}

/// The model's prediction for `fix`: a tip on the axis.
fn model(fix: &Fix) -> Prediction {
    let position_mm = Vector3::z() * fix.insertion_mm.unwrap_or(0.0);
    Prediction {
        position_mm,
        heading: Vector3::zeros(),
        covariance_mm2: None,
        since_correction_mm: 0.5,
    }
}

/// The gate that refused.
fn gate(judged: Result<(), Refusal>) -> Option<GateName> {
    judged.err().map(|refusal| refusal.gate)
}

/// Judges the n-th position, which is off by `x_mm`.
fn judge(track: &mut Track, n: i32, x_mm: f64) -> Result<(), Refusal> {
    let fix = fix(n, x_mm);
    track.judge(fix, Some(&model(&fix)))
}

#[test]
fn a_repeated_frame_does_not_recover_a_lost_track() {
    let mut track = Track::new(TrackSettings { kind: TrackerKind::Imaging, ..settings() });
    for n in 0..3 {
        assert_eq!(track.seek(standing(n, 0.1 * f64::from(n))), Ok(()));
    }
    let missing = Refusal::new(GateName::Status, "tool missing");
    (0..5).for_each(|_| track.note_refusal(&missing));
    assert!(!track.is_established());
    assert_eq!(gate(track.seek(standing(3, 0.1 * 2.0))), Some(GateName::Repeat));
    assert!(!track.is_established());
}

#[test]
fn a_position_repeated_before_the_insertion_is_accepted_when_it_begins() {
    let mut track = Track::new(settings());
    (0..4).for_each(|n| assert_eq!(track.seek(standing(n, 0.0)), Ok(())));
    let begun = Fix { insertion_mm: Some(50.0), ..standing(4, 0.0) };
    assert_eq!(track.judge(begun, None), Ok(()));
    let moved = Fix { insertion_mm: Some(50.5), ..standing(5, 0.0) };
    assert_eq!(gate(track.judge(moved, None)), Some(GateName::Repeat));
}

/// A track that was found at standstill and has accepted each position up to the 9th.
fn followed(settings: TrackSettings) -> Track {
    let mut track = Track::new(settings);
    for n in -2..=0 {
        assert_eq!(track.state(fix(n, 0.0).receive_time), TrackState::Waiting);
        assert_eq!(track.seek(standing(n, 0.1 * f64::from(n))), Ok(()));
    }
    (1..10).for_each(|n| assert_eq!(judge(&mut track, n, 0.0), Ok(())));
    assert_eq!(track.state(fix(9, 0.0).receive_time), TrackState::Tracking);
    track
}

#[test]
fn a_tip_is_found_by_positions_that_agree() {
    let mut track = Track::new(settings());
    assert_eq!(track.seek(standing(0, 30.0)), Ok(()));
    let step = track.seek(standing(1, 0.0)).expect_err("30 mm off");
    assert_eq!(
        step.to_string(),
        "step: 30.0 mm in 0.025 s since the last tip (limit 3.8); is it another tool?"
    );
    assert_eq!(track.seek(standing(2, 0.1)), Ok(()));
    assert!(!track.is_established());
    assert_eq!(track.seek(standing(3, 0.0)), Ok(()));
    assert!(track.is_established());
    assert_eq!(gate(track.seek(standing(4, 30.0))), Some(GateName::Step));
    assert!(!track.is_established(), "the wrong position may be the one before");
}

#[test]
fn spikes_of_one_or_two_positions_are_refused_and_the_track_stays() {
    let mut track = followed(settings());
    assert_eq!(gate(judge(&mut track, 10, 12.0)), Some(GateName::Step));
    assert_eq!(judge(&mut track, 11, 0.0), Ok(()));
    for n in [12, 13] {
        assert_eq!(gate(judge(&mut track, n, 18.0)), Some(GateName::Step));
    }
    assert_eq!(judge(&mut track, 14, 0.0), Ok(()));
    assert!(track.is_established());
}

/// The bench never follows a jump, however long it lasts.
#[test]
fn only_positions_that_agree_with_the_model_recover_a_lost_track() {
    let mut track = followed(settings());
    for n in 10..15 {
        assert!(track.is_established());
        assert!(judge(&mut track, n, 12.0).is_err());
    }
    assert_eq!(track.state(fix(15, 0.0).receive_time), TrackState::Lost);
    for n in 15..200 {
        let refusal = judge(&mut track, n, 12.0).unwrap_err();
        assert_eq!((refusal.gate, refusal.effect), (GateName::Innovation, Effect::Counts));
    }
    for (n, agreeing) in [(200, 1), (201, 2)] {
        let text = format!("lost: agrees with the model, {agreeing} of 3 needed in a row");
        assert_eq!(judge(&mut track, n, 0.1).unwrap_err().to_string(), text);
    }
    assert_eq!(judge(&mut track, 202, 0.0), Ok(()));
    assert_eq!(track.state(fix(202, 0.0).receive_time), TrackState::Tracking);
}

/// Positions that the gates refuse one by one contradict the model in their mean too.
#[test]
fn the_mean_of_refused_positions_shows_a_jump() {
    let mut track = followed(settings());
    for n in 10..40 {
        let refusal = judge(&mut track, n, 7.0).unwrap_err();
        if refusal.effect == Effect::Loses {
            assert!(refusal.why.starts_with("the mean of 8 is "), "{refusal}");
            assert!(n < 18, "not before position {n}");
            return;
        }
    }
    panic!("no jump was reported");
}

/// Whichever test of the mean is the first to fail.
#[test]
fn a_tip_behind_the_model_is_distinguished_from_one_beside_it() {
    let lost = |off_mm: Vector3<f64>| {
        let mut track = followed(settings());
        let refusals = (10..40).filter_map(|n| {
            let fix = fix(n, 0.0);
            let prediction = Prediction { heading: Vector3::z(), ..model(&fix) };
            let fix = Fix { position_mm: fix.position_mm + off_mm, ..fix };
            track.judge(fix, Some(&prediction)).err()
        });
        let mut losing = refusals.filter(|refusal| refusal.effect == Effect::Loses);
        losing.next().map(|refusal| refusal.is_behind)
    };
    let (x, z) = (Vector3::x(), Vector3::z());
    assert_eq!([-7.0 * z, x - 7.0 * z].map(lost), [Some(true); 2]);
    assert_eq!([7.0 * z, 7.0 * x, 7.0 * x - z].map(lost), [Some(false); 3]);
}

/// They belong to another tool: no jump of the noise's size is that far. They are refused one by one.
#[test]
fn positions_far_off_do_not_count_in_the_mean() {
    let mut track = followed(settings());
    for n in 10..40 {
        let refused = judge(&mut track, n, 30.0).expect_err("30 mm off");
        assert_ne!(refused.effect, Effect::Loses, "{refused}");
    }
}

/// At the start the model may be off by more than a jump, and its covariance says so.
#[test]
fn a_lost_track_is_recovered_within_the_uncertainty_of_the_model() {
    let mut track = followed(settings());
    (10..15).for_each(|n| drop(judge(&mut track, n, 30.0)));
    assert!(!track.is_established());
    for n in 15..18 {
        let fix = fix(n, 9.0);
        let unsure = Prediction { covariance_mm2: Some(Matrix3::identity() * 25.0), ..model(&fix) };
        let judged = track.judge(fix, Some(&unsure));
        assert_eq!(judged.is_ok(), n == 17, "{n}: {judged:?}");
    }
    assert!(track.is_established());
}

#[test]
fn without_a_model_a_lost_track_stays_lost() {
    let mut track = followed(settings());
    (10..15).for_each(|n| drop(judge(&mut track, n, 12.0)));
    assert_eq!(gate(track.judge(fix(15, 0.0), None)), Some(GateName::Lost));
}

#[test]
fn a_frozen_position_is_refused_once_the_needle_has_moved_and_loses_the_track() {
    let mut track = followed(settings());
    let frozen = |n| Fix { position_mm: fix(9, 0.0).position_mm, ..fix(n, 0.0) };
    for n in 10..15 {
        assert!(track.is_established());
        let (fix, times) = (frozen(n), n as u32 - 9);
        assert_eq!(track.judge(fix, Some(&model(&fix))), Err(Refusal::repeat(times)));
    }
    assert!(!track.is_established());
}

/// Without noise the tracker measures the same value of a standing needle.
#[test]
fn a_repeated_position_is_accepted_while_the_needle_stands() {
    let mut track = followed(settings());
    for n in 10..20 {
        let fix = Fix { insertion_mm: Some(0.451), ..fix(9, 0.0) };
        let later = Time::from_secs_f64(0.025 * f64::from(n));
        let fix = Fix { acquisition_time: later, receive_time: later, ..fix };
        assert_eq!(track.judge(fix, Some(&model(&fix))), Ok(()), "{n}");
    }
}

/// Four of five frames repeat the one before. They are not measurements, but not a fault either.
#[test]
fn repeated_frames_of_an_imaging_tracker_are_refused_and_the_track_stays() {
    let mut track = followed(TrackSettings { kind: TrackerKind::Imaging, ..settings() });
    let mut accepted = 0;
    for n in 10..110 {
        let frame = fix(n - n % 5, 0.0).position_mm;
        let fix = Fix { position_mm: frame, ..fix(n, 0.0) };
        match track.judge(fix, Some(&model(&fix))) {
            Ok(()) => accepted += 1,
            Err(refusal) => assert_eq!(refusal.gate, GateName::Repeat, "{refusal}"),
        }
        assert!(track.is_established());
    }
    assert_eq!(accepted, 20);
    assert_eq!(track.state(fix(110, 0.0).receive_time), TrackState::Tracking, "its own periods");
}

#[test]
fn a_silent_stream_is_coasting_after_two_periods() {
    let track = followed(settings());
    let state = |ms: i32| {
        track.state(fix(9, 0.0).receive_time + std::time::Duration::from_millis(ms as u64))
    };
    assert_eq!((state(50), state(51)), (TrackState::Tracking, TrackState::Coasting));
}

/// The observer is unsure along x only: 1.5 mm pass along x, but not along y.
#[test]
fn the_innovation_gate_is_as_wide_as_the_observers_covariance() {
    let fix = fix(1, 0.0);
    let judge = |offset_mm: Vector3<f64>| {
        let prediction = Prediction {
            position_mm: fix.position_mm + offset_mm,
            heading: Vector3::zeros(),
            covariance_mm2: Some(Matrix3::from_diagonal(&Vector3::new(4.0, 0.01, 0.01))),
            since_correction_mm: 0.0,
        };
        let mut track = Track::new(TrackSettings { noise_sd_mm: 0.3, ..settings() });
        track.judge(fix, Some(&prediction))
    };
    assert_eq!(judge(Vector3::x() * 1.5), Ok(()));
    let refused = judge(Vector3::y() * 1.5).expect_err("22.5 = 1.5² / 0.1");
    assert_eq!(
        refused.to_string(),
        "innovation: 1.5 mm off the model, chi2 22.5 (limit 16.3); a jump, or needle.radius_mm?"
    );
}

/// Positions that come every 25 ms.
#[test]
fn a_mean_of_correlated_noise_counts_for_fewer_positions() {
    let independent = |correlated: Option<(f64, u64)>| {
        let correlated = correlated.map(|(share, ms)| (share, Duration::from_millis(ms)));
        followed(TrackSettings { correlated, ..settings() }).independent(8)
    };
    assert_eq!(independent(None), 8.0);
    assert!((independent(Some((1.0, 1))) - 8.0).abs() < 1e-6, "as good as white");
    assert!((independent(Some((1.0, 1_000_000))) - 1.0).abs() < 1e-3, "as good as constant");
    let half = independent(Some((0.5, 200)));
    assert!((2.0..3.0).contains(&half), "{half}");
}

proptest! {
    /// A position that is not finite is never accepted.
    #[test]
    fn an_accepted_position_is_near_the_model(positions in prop::collection::vec((-30.0..30.0f64, any::<f64>(), any::<bool>()), 1..60)) {
        let mut track = followed(settings());
        for (n, (near, wild, is_wild)) in (10..).zip(positions) {
            let fix = fix(n, if is_wild { wild } else { near });
            if track.judge(fix, Some(&model(&fix))).is_ok() {
                prop_assert!(fix.position_mm.x.abs() <= 16.3f64.sqrt() * 1.18, "{}", fix.position_mm.x);
            }
        }
    }
}
