use super::*;
use crate::emulator::{CorrelatedNoise, TrackerModel, WhiteNoise};
use std::time::Duration;

/// Half of the variance of ±1 mm is correlated over 0.2 s.
const HALF_COLOURED: (WhiteNoise, Option<CorrelatedNoise>) =
    (WhiteNoise::Uniform(0.707), Some(CorrelatedNoise { sd_mm: 0.408, time_s: 0.2 }));
const NEAR: (WhiteNoise, Option<CorrelatedNoise>) = (WhiteNoise::Gaussian(0.026), None);

/// `count` samples of an emulated tracker at rest, 40 a second, each received 5 to 10 ms after it was
/// measured; `offset_mm` is added at each time, s.
fn rest(
    (noise, correlated): (WhiteNoise, Option<CorrelatedNoise>),
    seed: u64,
    count: u64,
    offset_mm: impl Fn(f64) -> Vector3<f64>,
) -> Vec<RestSample> {
    let period = Duration::from_millis(25);
    let latency = Duration::ZERO;
    let model = TrackerModel { noise, correlated, seed, period, latency, repeats: 0 };
    (0..count)
        .map(|k| {
            let time_s = 0.025 * k as f64;
            let late_s = 0.005 + 0.001 * (k % 6) as f64;
            let stamp_ns = 1_700_000_000_000_000_000 + (time_s * 1e9) as i64;
            RestSample {
                receive_time: Time::from_secs_f64(time_s + late_s),
                source_unix_ns: Some(stamp_ns),
                position_mm: Some(
                    Vector3::new(50.0, -20.0, 80.0) + model.noise_mm(k) + offset_mm(time_s),
                ),
            }
        })
        .collect()
}

fn still(_: f64) -> Vector3<f64> {
    Vector3::zeros()
}

fn refusal(samples: &[RestSample]) -> String {
    let text = TrackerFit::of(samples).expect_err("refused");
    assert!(text.chars().count() <= 200, "{text}");
    text
}

#[test]
fn a_coordinate_that_never_changes_is_refused() {
    let mut samples = rest(NEAR, 1, 1200, still);
    for sample in &mut samples {
        sample.position_mm = sample.position_mm.map(|mm| Vector3::new(mm.x, 0.0, mm.z));
    }
    assert_eq!(
        refusal(&samples),
        "y of the tracker is 0.00 mm to the bit in 100 different positions: has it two dimensions, or its \
         transform a row of zeros?"
    );
}

fn off(measured: Measured, truth: f64) -> f64 {
    (measured.value - truth) / measured.error
}

/// The true values lie within the stated errors, and these are not too large either.
#[test]
fn coloured_noise_is_recovered_within_the_stated_errors() {
    let white = 0.707 / 3f64.sqrt();
    let truths = [0.408f64.hypot(white), white, 0.408, 0.2];
    let parts = |noise: &NoiseFit| {
        [noise.sd_mm, noise.white_sd_mm, noise.correlated_sd_mm, noise.correlation_time_s]
    };
    let seeds = 16;
    let (mut squares, mut axis_squares) = ([0.0; 4], [0.0; 4]);
    for seed in 0..seeds {
        let fit = TrackerFit::of(&rest(HALF_COLOURED, seed, 2400, still)).unwrap();
        for (k, truth) in truths.iter().enumerate() {
            let z = off(parts(&fit.together)[k], *truth);
            assert!(z.abs() < 4.5, "seed {seed}: {:?}, not {truth}", parts(&fit.together)[k]);
            squares[k] += z * z / seeds as f64;
            for axis in &fit.axes {
                axis_squares[k] += off(parts(&axis.noise)[k], *truth).powi(2) / (3 * seeds) as f64;
            }
        }
    }
    for square in squares.iter().chain(&axis_squares) {
        assert!((0.2..2.5).contains(square), "{squares:?} {axis_squares:?}");
    }
}

/// A first-order filter leaves no white noise.
#[test]
fn a_filtered_stream_is_remarked_on() {
    let filtered = (WhiteNoise::None, Some(CorrelatedNoise { sd_mm: 0.07, time_s: 0.25 }));
    let remark = TrackerFit::of(&rest(filtered, 1, 2400, still)).unwrap().remark().unwrap();
    assert!(remark.contains("looks filtered") && remark.contains("by about 0.2"), "{remark}");
    assert!(remark.chars().count() <= 190, "{remark}");
    for noise in [HALF_COLOURED, NEAR] {
        assert_eq!(TrackerFit::of(&rest(noise, 1, 2400, still)).unwrap().remark(), None);
    }
}

/// By chance one of twelve may.
#[test]
fn white_noise_shows_no_correlation() {
    let fits = (0..12).map(|seed| TrackerFit::of(&rest(NEAR, seed, 1200, still)).unwrap());
    let fits: Vec<TrackerFit> = fits.collect();
    let coloured = fits.iter().filter(|fit| fit.together.correlated_sd_mm.value > 0.0).count();
    assert!(coloured <= 1, "{coloured}");
    for fit in fits.iter().filter(|fit| fit.together.correlated_sd_mm.value == 0.0) {
        assert!(off(fit.together.white_sd_mm, 0.026).abs() < 4.5, "{fit:?}");
        assert_eq!(fit.together.correlation_time_s, Measured::default());
    }
}

#[test]
fn a_longer_correlation_is_recovered() {
    let noise = (WhiteNoise::Gaussian(0.1), Some(CorrelatedNoise { sd_mm: 0.3, time_s: 1.5 }));
    let fit = TrackerFit::of(&rest(noise, 3, 8000, still)).unwrap();
    assert!(off(fit.together.correlation_time_s, 1.5).abs() < 4.0, "{fit:?}");
    assert!(off(fit.together.correlated_sd_mm, 0.3).abs() < 4.0, "{fit:?}");
    assert!(off(fit.together.white_sd_mm, 0.1).abs() < 4.0, "{fit:?}");
}

#[test]
fn the_drift_is_recovered() {
    let drift_mm_per_min = Vector3::new(0.1, -0.2, 0.05);
    for noise in [NEAR, HALF_COLOURED] {
        let drifts = |time_s: f64| drift_mm_per_min * (time_s / 60.0);
        let fit = TrackerFit::of(&rest(noise, 5, 2400, drifts)).unwrap();
        for (axis, truth) in fit.axes.iter().zip(&drift_mm_per_min) {
            assert!(off(axis.drift_mm_per_min, *truth).abs() < 4.0, "{axis:?}, not {truth}");
        }
    }
}

#[test]
fn outliers_dropouts_and_repeats_are_counted() {
    let mut samples = rest(NEAR, 7, 1200, still);
    for k in [100, 500, 900] {
        samples[k].position_mm = samples[k].position_mm.map(|p_mm| p_mm + Vector3::x() * 12.0);
    }
    samples[300].position_mm = None;
    samples[301].position_mm = None;
    samples[400].position_mm = samples[399].position_mm;
    samples.drain(700..710);
    let fit = TrackerFit::of(&samples).unwrap();
    assert_eq!((fit.outliers, fit.invalid, fit.repeats), (3, 2, 1));
    assert_eq!((fit.dropouts, fit.dated_by), (10, DatedBy::Stamp));
    assert!((fit.rate_hz.value - 40.0).abs() < 0.6, "{:?}", fit.rate_hz);
    let jitter = fit.latency_jitter_ms.unwrap();
    assert!((jitter.value - 1.708).abs() < 0.02 && jitter.error < 0.05, "{jitter:?}");
    assert!((fit.latency_p99_ms.unwrap() - 5.0).abs() < 1e-3);
    assert!((fit.together.sd_mm.value - 0.026).abs() < 0.001);

    let unstamped = |sample: &RestSample| RestSample { source_unix_ns: None, ..*sample };
    let fit = TrackerFit::of(&samples.iter().map(unstamped).collect::<Vec<_>>()).unwrap();
    assert_eq!((fit.latency_jitter_ms, fit.latency_p99_ms), (None, None));
    assert_eq!((fit.dropouts, fit.dated_by), (10, DatedBy::Receipt));
    assert!((fit.rate_hz.value - 40.0).abs() < 0.6, "the rate by the times of receipt");
}

/// By the stamps, the positions of the ten seconds after the one that is ahead would be older than it.
#[test]
fn one_stamp_ahead_costs_no_position() {
    let mut samples = rest(NEAR, 7, 1200, still);
    samples[300].source_unix_ns = samples[300].source_unix_ns.map(|ns| ns + 10_000_000_000);
    let fit = TrackerFit::of(&samples).unwrap();
    assert_eq!((fit.positions, fit.dropouts), (1200, 0));
    assert!((fit.duration_s - 30.0).abs() < 0.1, "{fit:?}");
}

/// Stamps in whole seconds, that stand still, in µs, of a clock that is set, or that one sample lacks.
#[test]
fn stamps_that_do_not_keep_time_date_no_position() {
    let in_seconds: fn(i64) -> Option<i64> = |ns| Some(ns / 1_000_000_000 * 1_000_000_000);
    let start = 1_700_000_000_000_000_000;
    let is_late = move |ns: i64| ns - start > 15_000_000_000;
    let cases: [&dyn Fn(i64) -> Option<i64>; 6] = [
        &in_seconds,
        &|_| Some(start),
        &|ns| Some(ns / 1000),
        &|ns| Some(if is_late(ns) { ns + 10_000_000_000 } else { ns }),
        &|ns| Some(if is_late(ns) { ns + 3_600_000_000_000 } else { ns }),
        &|ns| (ns - start != 10_000_000_000).then_some(ns),
    ];
    let received = |sample: &RestSample| RestSample { source_unix_ns: None, ..*sample };
    let samples = rest(HALF_COLOURED, 7, 1200, still);
    let expected = TrackerFit::of(&samples.iter().map(received).collect::<Vec<_>>()).unwrap();
    assert_eq!((expected.dropouts, expected.dated_by), (0, DatedBy::Receipt));
    for (k, stamp) in cases.into_iter().enumerate() {
        let mut samples = samples.clone();
        for sample in &mut samples {
            sample.source_unix_ns = sample.source_unix_ns.and_then(stamp);
        }
        assert_eq!(TrackerFit::of(&samples).unwrap(), expected, "case {k}");
    }
}

/// Delays that decay exponentially move the receipts by most of an interval; with 130 samples missing, and none.
#[test]
fn dropouts_are_told_from_delays() {
    for (mean_s, missing, least, most) in [
        (0.005, 0, 0, 2),
        (0.010, 0, 0, 4),
        (0.0, 130, 130, 130),
        (0.005, 130, 115, 135),
        (0.010, 130, 85, 140),
    ] {
        let mut samples = rest(NEAR, 7, 2400, still);
        let mut newest = Time::ZERO;
        for (k, sample) in (0u64..).zip(&mut samples) {
            // The golden ratio spreads the fractions evenly, and consecutive ones far apart.
            let share = (0.618_033_988_75 * (k * k) as f64).fract();
            let late_s = -mean_s * (1.0 - share).ln();
            newest = newest.max(Time::from_secs_f64(0.025 * k as f64 + late_s));
            (sample.receive_time, sample.source_unix_ns) = (newest, None);
        }
        let mut index = 0;
        samples.retain(|_| {
            index += 1;
            missing == 0 || index % 18 != 9 || index / 18 >= missing
        });
        assert_eq!(2400 - samples.len(), missing);
        let fit = TrackerFit::of(&samples).unwrap();
        println!("delayed by {mean_s} s, {missing} missing: {}", fit.dropouts);
        assert!((least..=most).contains(&fit.dropouts), "{mean_s} {missing}: {}", fit.dropouts);
    }
}

#[test]
fn samples_without_a_new_position_are_no_dropouts() {
    let stamped = rest(NEAR, 7, 1200, still);
    let received = |sample: &RestSample| RestSample { source_unix_ns: None, ..*sample };
    let unstamped: Vec<RestSample> = stamped.iter().map(received).collect();
    for samples in [stamped, unstamped] {
        let (mut invalid, mut repeated, mut coarse) =
            (samples.clone(), samples.clone(), samples.clone());
        for k in (10..1200).step_by(20) {
            invalid[k].position_mm = None;
            repeated[k].position_mm = samples[k - 1].position_mm;
        }
        for sample in &mut coarse {
            sample.position_mm =
                sample.position_mm.map(|p_mm| p_mm.map(|mm| (20.0 * mm).round() / 20.0));
        }
        for (samples, invalid, has_repeats) in
            [(invalid, 60, false), (repeated, 0, true), (coarse, 0, true)]
        {
            let fit = TrackerFit::of(&samples).unwrap();
            assert_eq!((fit.invalid, fit.repeats > 0), (invalid, has_repeats));
            assert_eq!(fit.dropouts, 0, "{fit:?}");
        }
    }
}

/// Positions are received four at a time, without stamps, at once or this many ns apart.
#[test]
fn positions_that_are_received_in_bursts_are_no_dropouts() {
    for apart_ns in [0, 1_000, 50_000, 1_000_000] {
        let mut samples = rest(NEAR, 7, 1200, still);
        for (k, sample) in (0i64..).zip(&mut samples) {
            let time = Time::from_nanos(k / 4 * 100_000_000 + k % 4 * apart_ns);
            (sample.receive_time, sample.source_unix_ns) = (time, None);
        }
        let fit = TrackerFit::of(&samples).unwrap();
        assert_eq!((fit.positions, fit.dropouts), (1200, 0), "{apart_ns} ns apart");
        assert!((fit.rate_hz.value - 40.0).abs() < 0.2, "{:?}", fit.rate_hz);
        assert!((fit.together.sd_mm.value - 0.026).abs() < 0.001, "{fit:?}");
    }
}

#[test]
fn a_recording_that_moves_is_refused_with_number_and_limit() {
    type Moved<'a> = &'a dyn Fn(f64) -> Vector3<f64>;
    let cases: [(Moved<'_>, &str); 4] = [
        (&|time_s| Vector3::z() * 0.02 * time_s, "the sensor moves by 1.20 mm in 60 s (limit 0.5"),
        (
            &|time_s| Vector3::x() * if time_s > 40.0 { 2.0 } else { 0.0 },
            " of 2400 positions are over",
        ),
        (&|time_s| Vector3::y() * 3.0 * (1.5 * time_s).sin(), "the sensor swings by"),
        (&|time_s| Vector3::y() * (time_s / 60.0 - 0.5).powi(2) * 4.0, "the positions wander by"),
    ];
    for (moved, expected) in cases {
        let text = refusal(&rest(NEAR, 1, 2400, moved));
        assert!(text.contains(expected), "{text}");
        assert!(text.contains("(limit ") || text.contains(", limit "), "{text}");
    }
    let text = refusal(&rest(HALF_COLOURED, 1, 2400, |time_s| Vector3::z() * 0.05 * time_s));
    assert!(text.contains("the sensor moves by"), "{text}");
}

#[test]
fn a_recording_that_is_too_short_is_refused() {
    let text = refusal(&rest(NEAR, 1, 99, still));
    assert_eq!(text, "99 new positions in 2.5 s, at least 100 in 5 s are needed; record longer");
    assert!(refusal(&[]).starts_with("0 new positions in 0.0 s"));
    let mut frozen = rest(NEAR, 1, 400, still);
    for k in 1..400 {
        frozen[k].position_mm = frozen[0].position_mm;
    }
    let text = refusal(&frozen);
    assert!(text.starts_with("1 new positions in 0.0 s (399 repeats), at least 100"), "{text}");
    assert!(text.ends_with("; is the tool in view?"), "{text}");
    frozen[1].position_mm = None;
    let text = refusal(&frozen);
    assert!(text.contains("(398 repeats, 1 invalid)"), "{text}");
    frozen.iter_mut().for_each(|sample| sample.position_mm = None);
    let text = refusal(&frozen);
    assert!(text.starts_with("0 new positions in 0.0 s (400 invalid), at least 100"), "{text}");
    let metres = rest(NEAR, 1, 400, |_| Vector3::x() * 1e5);
    assert!(refusal(&metres).ends_with("give positions in mm"));
    // The correlation is over a fifth of the recording.
    let slow = (WhiteNoise::Gaussian(0.01), Some(CorrelatedNoise { sd_mm: 0.3, time_s: 6.0 }));
    assert!(refusal(&rest(slow, 2, 1200, still)).contains("or record longer"));
}
