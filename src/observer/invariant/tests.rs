//! Tests of the invariant observer: emulated needles, and the same needle in another frame.

use super::*;
use crate::geometry::{FixedAngles, Pose, Twist};
use crate::needle::{Play, TorsionConfig};
use nalgebra::{Matrix3, Matrix6, SVector, Vector3, Vector6};
use proptest::prelude::*;
use std::f64::consts::PI;

fn config() -> InvariantConfig {
    InvariantConfig {
        start: FixedAngles::default(),
        start_sd: FixedAngles { yaw: 0.2, pitch: 0.15, roll: PI },
        position_sd_mm: 0.1,
        registration_sd_mm: 0.0,
        search_share: 0.02,
        curvature_sd: 0.0,
        torsion_offset_sd: 0.33,
        torsion_offset_sd_rad: 0.1,
        torsion_search_rad_per_mm: 0.0,
        innovation_max: 3.0,
        innovation_bias_max: 40.0,
        noise: NoiseConfig {
            position_mm: 0.0,
            axial_mm: 0.0,
            heading_rad: 0.0,
            roll_rad: 0.0,
            curvature: 0.0,
            torsion_edge_rad: 0.0,
        },
    }
}

fn needle() -> Needle {
    Needle::new(1.0 / 122.0).unwrap()
}

fn torsion(config: TorsionConfig) -> Torsion {
    Torsion::new(config).unwrap()
}

/// Deterministic noise: three incommensurate sines.
fn noise(step: u32) -> Vector3<f64> {
    let n = f64::from(step);
    Vector3::new((1.7 * n).sin(), (2.3 * n + 1.0).sin(), (3.1 * n + 2.0).sin()) * 0.1
}

/// A base that turns back and forth, rad/mm.
fn turning(step: u32) -> f64 {
    0.3 * (f64::from(step) * 0.07).sin()
}

/// Follows an emulated needle for `steps` mm, with increments `parts` to the mm.
fn follow(
    observer: &mut Invariant,
    true_needle: Needle,
    shaft: &Torsion,
    start: Pose,
    steps: u32,
    parts: u32,
) -> Pose {
    let (mut tip, mut play) = (start, Play::default());
    for step in 0..=steps {
        if step > 0 {
            for _ in 0..parts {
                let part = f64::from(parts).recip();
                let base = Increment::new(part, part * turning(step)).unwrap();
                for increment in play.advance(shaft, base) {
                    tip = true_needle.step(&tip, increment);
                }
                observer.predict(base);
            }
        }
        observer.correct(&TipPosition::new(tip.translation + noise(step)).unwrap(), 1.0);
    }
    tip
}

/// The error of the estimated position, mm, and of the orientation, rad.
fn apart(estimate: &Estimate, tip: &Pose) -> (f64, f64) {
    let error = (estimate.x_pb.inverse() * *tip).log();
    (error.v.norm(), error.w.norm())
}

/// The observer does not know the roll at the start.
#[test]
fn finds_the_pose_from_every_roll() {
    for k in 0..12 {
        let roll = f64::from(k) * PI / 6.0 + 0.1;
        let start = Pose {
            rotation: FixedAngles { yaw: 0.2, pitch: -0.15, roll }.to_rotation(),
            translation: Vector3::new(5.0, -3.0, 1.0),
        };
        let rigid = Torsion::default();
        let mut observer = Invariant::new(needle(), rigid, config());
        let tip = follow(&mut observer, needle(), &rigid, start, 150, 1);
        let estimate = observer.estimate().unwrap();
        let (mm, rad) = apart(&estimate, &tip);
        assert!(mm < 0.1 && rad < 0.02 && observer.bank.len() <= 3, "roll {roll}: {mm} {rad}");
        assert!(estimate.is_roll_known() && observer.check().is_ok());
    }
}

/// The chuck slips: the tip's roll changes by an angle that no encoder measures.
#[test]
fn a_roll_that_changes_unnoticed_is_found_again() {
    let rigid = Torsion::default();
    for roll in [0.0, 0.6, -0.5 * PI, PI] {
        let mut observer = Invariant::new(needle(), rigid, config());
        let tip = follow(&mut observer, needle(), &rigid, Pose::identity(), 60, 1);
        assert_eq!(observer.take_warning(), None);
        let slip = Pose::exp(&Twist { v: Vector3::zeros(), w: Vector3::new(0.0, 0.0, roll) });
        let tip = follow(&mut observer, needle(), &rigid, tip * slip, 100, 1);
        let (mm, rad) = apart(&observer.estimate().unwrap(), &tip);
        assert!(mm < 0.15 && rad < 0.03, "roll {roll}: {mm} {rad}");
        let warning = observer.take_warning();
        assert_eq!(warning.is_some(), roll != 0.0, "roll {roll}: {warning:?}");
        assert!(warning.is_none_or(|text| format!("observer: {text}").len() < 200));
        assert_eq!(observer.take_warning(), None, "each is taken once");
    }
}

/// No hypothesis gains weight, and the position is known as before, but for the same in all directions across.
#[test]
fn a_restart_changes_roll_heading_and_curvature_alone() {
    let rigid = Torsion::default();
    let mut observer = Invariant::new(needle(), rigid, config());
    follow(&mut observer, needle(), &rigid, Pose::identity(), 60, 1);
    let restarted = bank::restarted(&observer.bank, &needle());
    assert_eq!(restarted.len(), 8 * observer.bank.len());
    let (before, after) = (mixture::log_weight(&observer.bank), mixture::log_weight(&restarted));
    assert!((before - after).abs() < 1e-12, "{before} {after}");
    let kept = &observer.bank[0];
    for h in &restarted[..8] {
        assert!((h.x_pb.translation - kept.x_pb.translation).norm() < 1e-12);
        let heading = |h: &Hypothesis| h.x_pb.rotation * Vector3::z();
        assert!((heading(h) - heading(kept)).norm() < 1e-12);
        let [position, before] = [h, kept].map(|h| {
            let r = h.x_pb.rotation.matrix();
            r * h.covariance.position() * r.transpose()
        });
        let across = Matrix3::identity() - heading(kept) * heading(kept).transpose();
        let added = position - before - across * 0.01;
        assert!(added.norm() < 1e-4, "{added}");
    }
}

/// A needle that bends eight times as much as told. Each restart is soon contradicted.
#[test]
fn restarts_are_at_least_10_mm_apart() {
    let mut observer = Invariant::new(needle(), Torsion::default(), config());
    let bent = needle().with_share_of_curvature(8.0);
    let (mut tip, mut restarted) = (Pose::identity(), Vec::new());
    for step in 0..800 {
        observer.correct(&TipPosition::new(tip.translation + noise(step)).unwrap(), 1.0);
        restarted.extend(observer.take_warning().map(|_| step));
        let increment = Increment::new(0.1, 0.0).unwrap();
        observer.predict(increment);
        tip = bent.step(&tip, increment);
    }
    let least = restarted.windows(2).map(|pair| pair[1] - pair[0]).min();
    assert!(restarted[0] >= 150 && (100..110).contains(&least.unwrap()), "{restarted:?}");
}

/// The handedness watch compares models by such observers.
#[test]
fn an_observer_of_the_watch_never_restarts() {
    let mut observer = Invariant::new(needle(), Torsion::default(), config());
    for mm in 0..60 {
        let across_mm = if mm < 30 { 0.0 } else { 0.3 };
        let position = TipPosition::new(Vector3::new(across_mm, 0.0, f64::from(mm))).unwrap();
        observer.correct_with(&position, 0.01);
        observer.predict(Increment::new(1.0, 2.0).unwrap());
    }
    assert_eq!(observer.take_warning(), None);
}

/// Softer tissue from 60 mm on.
#[test]
fn a_curvature_that_changes_is_found_again() {
    let rigid = Torsion::default();
    let mut observer = Invariant::new(needle(), rigid, config());
    let tip = follow(&mut observer, needle(), &rigid, Pose::identity(), 60, 1);
    let softer = needle().with_share_of_curvature(0.3);
    let tip = follow(&mut observer, softer, &rigid, tip, 100, 1);
    let estimate = observer.estimate().unwrap();
    let (mm, rad) = apart(&estimate, &tip);
    let share = estimate.belief.unwrap().curvature_per_mm / needle().curvature_per_mm();
    assert!(mm < 0.15 && rad < 0.05 && (share - 0.3).abs() < 0.06, "{mm} {rad} {share}");
}

/// In a stepwise insertion also the first one is a mean.
#[test]
fn the_first_position_counts_as_many() {
    for (independent, sd_mm) in [(25.0, 0.02), (1.0, 0.1), (0.5, 0.1)] {
        let mut observer = Invariant::new(needle(), Torsion::default(), config());
        observer.correct(&TipPosition::new(Vector3::zeros()).unwrap(), independent);
        let sd = observer.estimate().unwrap().sd.unwrap();
        assert!((sd[0] - sd_mm).abs() < 1e-9, "{sd:?}");
    }
}

#[test]
fn reports_the_roll_as_unknown_at_first() {
    let rigid = Torsion::default();
    let mut observer = Invariant::new(needle(), rigid, config());
    follow(&mut observer, needle(), &rigid, Pose::identity(), 3, 1);
    let estimate = observer.estimate().unwrap();
    assert!(!estimate.is_roll_known() && estimate.belief.unwrap().roll_agreement < 0.5);
}

#[test]
fn the_division_of_the_path_makes_no_difference() {
    let shaft = torsion(TorsionConfig {
        half_width_rad: 0.3,
        half_width_rad_per_mm: 0.004,
        ..TorsionConfig::default()
    });
    let ends = [1, 7].map(|parts| {
        let mut observer = Invariant::new(needle(), shaft, config());
        follow(&mut observer, needle(), &shaft, Pose::identity(), 80, parts);
        observer.estimate().unwrap()
    });
    let (mm, rad) = apart(&ends[0], &ends[1].x_pb);
    assert!(mm < 0.02 && rad < 0.02, "{mm} {rad}");
}

/// Curvature, half-width, its growth and offset are found although they are configured wrongly.
#[test]
fn finds_parameters_that_are_configured_wrongly() {
    let configured = TorsionConfig {
        half_width_rad: 0.7,
        half_width_rad_per_mm: 0.006,
        ..TorsionConfig::default()
    };
    let actual = TorsionConfig {
        half_width_rad: 0.55,
        half_width_rad_per_mm: 0.0075,
        offset_rad: 0.3,
        ..TorsionConfig::default()
    };
    let config = InvariantConfig { curvature_sd: 0.17, ..config() };
    let mut observer = Invariant::new(needle(), torsion(configured), config);
    let true_needle = Needle::new(1.2 / 122.0).unwrap();
    let tip = follow(&mut observer, true_needle, &torsion(actual), Pose::identity(), 300, 1);
    let estimate = observer.estimate().unwrap();
    let belief = estimate.belief.unwrap();
    let (mm, rad) = apart(&estimate, &tip);
    assert!(mm < 0.1 && rad < 0.05, "{mm} {rad}");
    assert!((belief.curvature_per_mm * 122.0 - 1.2).abs() < 0.02, "{}", belief.curvature_per_mm);
    let band_rad = belief.shaft.slack_forward.mean_rad + belief.shaft.slack_backward.mean_rad;
    let band_true_rad = 2.0 * (0.55 + 0.0075 * 300.0);
    assert!((band_rad - band_true_rad).abs() < 0.1 * band_true_rad, "{band_rad}");
}

/// A shaft that creeps: the observer follows the tip and finds the offset.
#[test]
fn follows_a_viscous_shaft() {
    let configured = TorsionConfig {
        creep_mm: 0.8,
        creep_mm_per_mm: 0.006,
        offset_rad: 0.4,
        ..TorsionConfig::default()
    };
    let actual = TorsionConfig { offset_rad: 0.55, ..configured };
    let config = InvariantConfig {
        start_sd: FixedAngles { yaw: 0.05, pitch: 0.05, roll: 0.05 },
        torsion_offset_sd_rad: 0.15,
        ..config()
    };
    let mut observer = Invariant::new(needle(), torsion(configured), config);
    let tip = follow(&mut observer, needle(), &torsion(actual), Pose::identity(), 150, 5);
    let (mm, rad) = apart(&observer.estimate().unwrap(), &tip);
    assert!(mm < 0.1 && rad < 0.05, "{mm} {rad}");
}

/// Positions cannot distinguish a rigid shaft from one that twists a little. The search for a twist
/// raises the standard deviation of the roll, and the estimate stays as good.
#[test]
fn a_twist_too_small_to_detect_widens_the_standard_deviation() {
    let rigid = Torsion::default();
    let [rigid_sd, searching_sd] = [0.0, 0.01].map(|torsion_search_rad_per_mm| {
        let config = InvariantConfig { torsion_search_rad_per_mm, ..config() };
        let mut observer = Invariant::new(needle(), rigid, config);
        let tip = follow(&mut observer, needle(), &rigid, Pose::identity(), 150, 1);
        let estimate = observer.estimate().unwrap();
        let (_, error_rad) = apart(&estimate, &tip);
        assert!(error_rad < 0.01, "{error_rad}");
        estimate.sd.unwrap()[5]
    });
    assert!(searching_sd > 3.0 * rigid_sd, "{searching_sd} {rigid_sd}");
}

#[test]
fn averaging_does_not_reduce_the_registrations_error() {
    let rigid = Torsion::default();
    let config = InvariantConfig { registration_sd_mm: 0.4, ..config() };
    let mut observer = Invariant::new(needle(), rigid, config);
    follow(&mut observer, needle(), &rigid, Pose::identity(), 100, 1);
    let sd = observer.estimate().unwrap().sd.unwrap();
    assert!(sd[..3].iter().all(|sd| (0.4..0.45).contains(sd)), "{sd:?}");
}

/// The observer reports positions that no needle can make, and filters that have broken down.
#[test]
fn divergence_is_reported() {
    let rigid = Torsion::default();
    let mut observer = Invariant::new(needle(), rigid, config());
    follow(&mut observer, needle(), &rigid, Pose::identity(), 60, 1);
    assert!(observer.check().is_ok());
    for step in 0..40 {
        observer.predict(Increment::new(1.0, 0.0).unwrap());
        let off = Vector3::new(if step % 2 == 0 { 5.0 } else { -5.0 }, 0.0, 60.0 + f64::from(step));
        observer.correct(&TipPosition::new(off).unwrap(), 1.0);
    }
    let error = observer.check().unwrap_err();
    assert!(error.starts_with("the last 20 tip positions are "), "{error}");
    // With "observer: " before it an operator reads it at a glance.
    assert!(error.len() <= 190, "{} characters: {error}", error.len());

    let far = TipPosition::new(Vector3::repeat(TipPosition::COORDINATE_MAX_MM)).unwrap();
    let config = InvariantConfig { position_sd_mm: 1e-160, ..config() };
    let mut observer = Invariant::new(needle(), rigid, config);
    for sign in [1.0, -1.0, 1.0] {
        observer.correct(&TipPosition::new(far.mm() * sign).unwrap(), 1.0);
    }
    let error = observer.check().unwrap_err();
    assert!(error.starts_with("the estimate is no longer finite"), "{error}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    /// After a correction by δ the error η of the pose is J_r(δ) η, and so is it in the covariance.
    #[test]
    fn a_correction_moves_the_error_to_the_corrected_pose(
        delta in prop::array::uniform6(-0.05..0.05f64), eta in prop::array::uniform6(-1.0..1.0f64),
    ) {
        let twist = |v: [f64; 6]| Twist::from_vector(&Vector6::from_row_slice(&v));
        let (delta, small) = (twist(delta), eta.map(|component| 1e-6 * component));
        let sum = Twist { v: delta.v + twist(small).v, w: delta.w + twist(small).w };
        let expected = (Pose::exp(&delta).inverse() * Pose::exp(&sum)).log().to_vector() * 1e6;
        let moved = error_state::PoseMap::right_jacobian(&delta).times(&eta);
        let moved = Vector6::from_row_slice(&moved);
        prop_assert!((moved - expected).amax() < 1e-4, "{moved} {expected}");

        // P = η ηᵀ becomes J η (J η)ᵀ.
        let mut covariance = error_state::Covariance::zero(error_state::Extent::Banded);
        (0..6).for_each(|i| (i..6).for_each(|k| covariance.set(i, k, eta[i] * eta[k])));
        let pose = error_state::PoseMap::right_jacobian(&delta);
        covariance.propagate(&error_state::Transition { pose, ..error_state::Transition::none() });
        prop_assert!((covariance.pose() - moved * moved.transpose()).amax() < 1e-12);
    }

    /// Left invariance: a needle in another frame gets the same estimate in that frame.
    #[test]
    fn a_change_of_frame_changes_nothing(p in prop::array::uniform3(-50.0..50.0f64), yaw in -0.2..0.2f64, roll in -3.0..3.0f64) {
        let rigid = Torsion::default();
        let known = |angles: FixedAngles| InvariantConfig {
            start: angles,
            start_sd: FixedAngles { yaw: 0.1, pitch: 0.1, roll: 0.1 },
            ..config()
        };
        let g = Pose { rotation: FixedAngles { yaw, pitch: 0.0, roll: 0.0 }.to_rotation(), translation: Vector3::from(p) };
        let here_start = FixedAngles { yaw: 0.05, pitch: 0.0, roll };
        let mut here = Invariant::new(needle(), rigid, known(here_start));
        let there_start = FixedAngles { yaw: 0.05 + yaw, ..here_start };
        let mut there = Invariant::new(needle(), rigid, known(there_start));
        let mut tip = Pose { rotation: here_start.to_rotation(), translation: Vector3::zeros() };
        for step in 0..60 {
            let base = Increment::new(1.0, turning(step)).unwrap();
            if step > 0 {
                tip = needle().step(&tip, base);
                here.predict(base);
                there.predict(base);
            }
            let measured = tip.translation + noise(step);
            here.correct(&TipPosition::new(measured).unwrap(), 1.0);
            there.correct(&TipPosition::new(g.transform(&measured)).unwrap(), 1.0);
        }
        let (here, there) = (here.estimate().unwrap(), there.estimate().unwrap());
        let (mm, rad) = apart(&there, &(g * here.x_pb));
        prop_assert!(mm < 1e-9 && rad < 1e-9, "{mm} {rad}");
        let difference: Matrix6<f64> = here.belief.unwrap().covariance - there.belief.unwrap().covariance;
        prop_assert!(difference.amax() < 1e-9);
    }

    /// The covariance's transition is the derivative of the mean's, with respect to every state.
    #[test]
    fn the_transition_is_the_derivative_of_the_prediction(
        turn in 0.0..1.5f64, before in 0.1..1.0f64, nudged in 0..error_state::STATES,
    ) {
        let shaft = torsion(TorsionConfig {
            half_width_rad: 0.2,
            half_width_rad_per_mm: 0.003,
            creep_mm: 1.5,
            ..TorsionConfig::default()
        });
        let config = InvariantConfig {
            curvature_sd: 0.1,
            start_sd: FixedAngles { yaw: 0.1, pitch: 0.1, roll: 0.1 },
            ..config()
        };
        let tip_meas = TipPosition::new(Vector3::zeros()).unwrap();
        let bank = config.bank(&needle(), &shaft, &tip_meas);
        // No reversal, which would start another stroke and replace the anchor.
        let path = [before, turn].map(|turn| Increment::new(1.0, turn).unwrap());
        let moved = |nudge: f64| {
            let mut h = bank[0].clone();
            h.predict(path[0]);
            h.propagate_covariance(None);
            let mut delta: error_state::ErrorState = [0.0; error_state::STATES];
            delta[nudged] = nudge;
            h.apply(&delta);
            h.predict(path[1]);
            h
        };
        let h = 1e-6;
        let (low, high) = (moved(-h), moved(h));
        let difference = (low.x_pb.inverse() * high.x_pb).log().to_vector() / (2.0 * h);
        let mut columns = [[0.0; error_state::STATES]; error_state::STATES];
        (0..error_state::STATES).for_each(|i| columns[i][i] = 1.0);
        moved(0.0).transition().apply::<{ error_state::STATES }>(&mut columns);
        let column = SVector::<f64, 6>::from_fn(|i, _| columns[i][nudged]);
        prop_assert!((difference - column).amax() < 1e-3 * (1.0 + column.amax()), "{difference} {column}");
    }
}
