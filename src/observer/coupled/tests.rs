//! Tests of the coupled observer: every start, and agreement with the paper's gains.

use super::bank::CoupledBank;
use super::{Coupled, CoupledConfig, Gains};
use crate::geometry::{FixedAngles, Pose};
use crate::needle::{Increment, Needle, Reduced, TipPosition};
use crate::observer::Observer;
use nalgebra::Vector3;
use proptest::prelude::*;
use std::f64::consts::PI;

fn needle() -> Needle {
    Needle::new(1.0 / 122.0).unwrap()
}

/// The start is known within these angles, the positions within 0.1 mm.
fn config(start_sd: FixedAngles) -> CoupledConfig {
    CoupledConfig {
        gains: Gains::Fading,
        memory_mm: 20.0,
        start: FixedAngles::default(),
        start_sd,
        position_sd_mm: 0.1,
        reduced_poles_per_mm: [0.05; 3],
        fibre_poles_per_mm: [0.05; 2],
    }
}

fn bank(roll_sd: f64) -> CoupledBank {
    CoupledBank::new(needle(), config(FixedAngles { yaw: 0.2, pitch: 0.15, roll: roll_sd }))
}

/// Inserts `steps` mm from `tip` and measures each position with `offset` added. The base turns back and forth by
/// up to `turn_rad_per_mm`.
fn follow(
    observer: &mut dyn Observer,
    mut tip: Pose,
    steps: u32,
    turn_rad_per_mm: f64,
    offset: impl Fn(f64) -> Vector3<f64>,
) -> Pose {
    for n in (0..=steps).map(f64::from) {
        if n > 0.0 {
            let step = Increment::new(1.0, turn_rad_per_mm * (0.07 * n).sin()).unwrap();
            tip = needle().step(&tip, step);
            observer.predict(step);
        }
        observer.correct(&TipPosition::new(tip.translation + offset(n)).unwrap(), 1.0);
    }
    tip
}

/// Deterministic noise of 0.1 mm: three incommensurate sines.
fn noise(n: f64) -> Vector3<f64> {
    Vector3::new((1.7 * n).sin(), (2.3 * n + 1.0).sin(), (3.1 * n + 2.0).sin()) * 0.14
}

/// In a stepwise insertion also the first one is a mean.
#[test]
fn the_first_position_counts_as_many() {
    for (independent, sd_mm) in [(25.0, 0.02), (1.0, 0.1), (0.5, 0.1)] {
        let mut observer = bank(PI);
        observer.correct(&TipPosition::new(Vector3::zeros()).unwrap(), independent);
        let sd = observer.estimate_after(&[]).unwrap().sd.unwrap();
        assert!((sd[0] - sd_mm).abs() < 1e-9, "{sd:?}");
    }
}

#[test]
fn finds_the_pose_from_every_roll() {
    for roll in (0..12).map(|k| f64::from(k) * PI / 6.0 + 0.1) {
        let start = Pose {
            rotation: FixedAngles { yaw: 0.2, pitch: -0.15, roll }.to_rotation(),
            translation: Vector3::new(5.0, -3.0, 1.0),
        };
        let mut observer = bank(PI);
        let early = follow(&mut observer, start, 3, 0.3, noise);
        assert!(!observer.estimate().unwrap().is_roll_known(), "{early:?}");
        let mut observer = bank(PI);
        let tip = follow(&mut observer, start, 150, 0.3, noise);
        let estimate = observer.estimate().unwrap();
        let error = (estimate.x_pb.inverse() * tip).log();
        assert!(error.v.norm() < 0.1 && error.w.norm() < 0.08, "roll {roll}: {error:?}");
        let copies = observer.bank.len();
        // A few challengers may be left.
        assert!(estimate.is_roll_known() && copies <= 4, "roll {roll}: {copies} copies");
    }
}

/// After a half turn that the observer does not see, its copies have the wrong roll.
#[test]
fn a_wrong_last_copy_is_displaced_by_its_challengers() {
    for roll in [0.0, PI / 3.0, PI / 2.0] {
        let start = Pose {
            rotation: FixedAngles { roll, ..FixedAngles::default() }.to_rotation(),
            translation: Vector3::zeros(),
        };
        let mut observer = bank(PI);
        let mut tip = follow(&mut observer, start, 100, 0.3, noise);
        tip.rotation *= FixedAngles { roll: PI, ..FixedAngles::default() }.to_rotation();
        let tip = follow(&mut observer, tip, 150, 0.3, noise);
        let error = (observer.estimate().unwrap().x_pb.inverse() * tip).log();
        assert!(error.v.norm() < 0.1 && error.w.norm() < 0.08, "roll {roll}: {error:?}");
    }
}

/// The reduced state of one copy follows from x alone.
#[test]
fn y_and_z_do_not_correct_the_reduced_state() {
    let start = Pose {
        rotation: FixedAngles { yaw: 0.2, pitch: 0.1, roll: 0.2 }.to_rotation(),
        translation: Vector3::new(3.0, 0.0, 0.0),
    };
    let reduced = |aside: f64| {
        let mut observer = bank(0.3);
        let offset = |n: f64| Vector3::new(noise(n).x, aside * (0.3 * n).sin(), aside * n.cos());
        follow(&mut observer, start, 80, 0.3, offset);
        let (reduced, fibre) = Reduced::split(&observer.estimate().unwrap().x_pb);
        (Vector3::new(reduced.x_mm, reduced.pitch_rad, reduced.roll_rad), fibre.yaw_rad)
    };
    let ((exact, yaw), (off, yaw_off)) = (reduced(0.0), reduced(2.0));
    assert!((exact - off).norm() < 1e-9, "{exact} {off}");
    assert!((yaw - yaw_off).abs() > 1e-3, "{yaw} {yaw_off}");
}

/// The reference is the paper's observer in the plane, with its poles at the rate of the memory. The poles of the
/// fading gains have the same modulus but are not all real, so the gains differ by up to 8%.
#[test]
fn the_fading_gains_settle_to_the_placed_ones() {
    let change = |observer: &mut dyn Observer| {
        let tip = follow(observer, Pose::identity(), 200, 0.0, |_| Vector3::zeros());
        let off = Vector3::new(0.1, 0.0, 0.0);
        let step = Increment::new(1.0, 0.0).unwrap();
        observer.predict(step);
        let tip = needle().step(&tip, step).translation;
        observer.correct(&TipPosition::new(tip + off).unwrap(), 1.0);
        let (Reduced { x_mm, pitch_rad, roll_rad }, _) =
            Reduced::split(&observer.estimate().unwrap().x_pb);
        Vector3::new(x_mm, pitch_rad, roll_rad)
    };
    let fading = change(&mut bank(0.3));
    let placed = change(&mut Coupled::new(needle(), config(FixedAngles::default())));
    for (fading, placed) in fading.iter().zip(&placed) {
        assert!((fading / placed - 1.0).abs() < 0.1, "{fading} {placed}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]
    #[test]
    fn stays_finite(steps in prop::collection::vec((0.0..3.0f64, -7.0..7.0f64, prop::array::uniform3(-1e6..1e6f64)), 1..60)) {
        let mut observer = bank(PI);
        for (insertion, rotation, position) in steps {
            observer.predict(Increment::new(insertion, rotation).unwrap());
            observer.correct(&TipPosition::new(Vector3::from(position)).unwrap(), 1.0);
            prop_assert!(observer.estimate().unwrap().x_pb.is_finite());
        }
    }
}
