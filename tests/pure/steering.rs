//! Observer and control law alone, with many draws of the noise: the table of decision 7.
//!
//! `cargo test --test pure steering:: -- --nocapture` prints it.

use crate::support::program::{Scratch, needle_bench};
use nalgebra::Vector3;
use needle_bench::control::{Controller, FeedbackLinearization, FeedbackLinearizationConfig};
use needle_bench::geometry::{FixedAngles, Pose};
use needle_bench::needle::{Increment, Needle, TipPosition};
use needle_bench::observer::{Coupled, CoupledConfig, Gains, Observer};
use needle_bench::study::{quantile, rms};
use needle_bench::units::wrap_angle;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

const SEEDS: u64 = 400;

struct Insertion {
    /// True distance from the plane over the last third, RMS, mm.
    off_plane_mm: f64,
    /// Roll error over the last third, RMS, deg.
    roll_deg: f64,
    /// The largest of the six errors at the end, mm or rad.
    error_at_end: f64,
}

/// Inserts 300 mm, with a position each mm, uniform noise of `noise_mm` and all observer poles at `rate_per_mm`.
/// The observer does not know the angles at the start (yaw and pitch 5°, roll 30°); x is 5 mm there.
fn insert(seed: u64, noise_mm: f64, rate_per_mm: f64) -> Insertion {
    let needle = Needle::new(1.0 / 122.0).unwrap();
    let [yaw, pitch, roll] = [5.0, 5.0, 30f64].map(f64::to_radians);
    let mut tip = Pose {
        rotation: FixedAngles { yaw, pitch, roll }.to_rotation(),
        translation: Vector3::new(5.0, 0.0, 0.0),
    };
    let observer = CoupledConfig {
        gains: Gains::Placed,
        memory_mm: 20.0,
        start_sd: FixedAngles::default(),
        position_sd_mm: 0.577,
        reduced_poles_per_mm: [rate_per_mm; 3],
        fibre_poles_per_mm: [rate_per_mm; 2],
        start: FixedAngles::default(),
    };
    let law = FeedbackLinearizationConfig {
        poles_per_mm: [0.05; 3],
        roll_demand_max_rad: 60f64.to_radians(),
        caution: 0.5,
        rotation_max_rad_per_mm: 20f64.to_radians(),
    };
    let mut observer = Coupled::new(needle, observer);
    let mut law = FeedbackLinearization::new(needle, law);
    let mut rng = Pcg64::seed_from_u64(seed);
    let (mut off_plane, mut rolls, mut error_at_end) = (Vec::new(), Vec::new(), 0.0);
    for step in 0..=300 {
        let noise = Vector3::from_fn(|_, _| noise_mm * (2.0 * rng.random::<f64>() - 1.0));
        observer.correct(&TipPosition::new(tip.translation + noise).unwrap(), 1.0);
        let estimate = observer.estimate().unwrap();
        let (ours, theirs) = (
            FixedAngles::from_rotation(&estimate.x_pb.rotation),
            FixedAngles::from_rotation(&tip.rotation),
        );
        let roll = wrap_angle(ours.roll - theirs.roll);
        let angles = [wrap_angle(ours.yaw - theirs.yaw), ours.pitch - theirs.pitch, roll];
        error_at_end = (estimate.x_pb.translation - tip.translation)
            .iter()
            .chain(&angles)
            .fold(0.0, |most: f64, error| most.max(error.abs()));
        if step > 200 {
            off_plane.push(tip.translation.x);
            rolls.push(roll.to_degrees());
        }
        let command = law.command(&estimate, 1.0).unwrap();
        let increment = Increment::new(1.0, command.rotation_rad_per_mm).unwrap();
        tip = needle.step(&tip, increment);
        observer.predict(increment);
    }
    let (off_plane_mm, roll_deg) = (rms(off_plane).unwrap(), rms(rolls).unwrap());
    Insertion { off_plane_mm, roll_deg, error_at_end }
}

#[test]
fn every_noisy_insertion_settles_and_the_default_rate_is_accurate() {
    println!("rate, 1/mm | error without noise | off-plane RMS median / 95%, mm | roll RMS, deg");
    for rate in [0.05, 0.06, 0.07, 0.08, 0.10] {
        let exact = insert(0, 0.0, rate).error_at_end;
        let noisy: Vec<Insertion> = (0..SEEDS).map(|seed| insert(seed, 1.0, rate)).collect();
        let of = |pick: fn(&Insertion) -> f64, q| {
            quantile(&noisy.iter().map(pick).collect::<Vec<_>>(), q).unwrap()
        };
        let (median, p95) = (of(|i| i.off_plane_mm, 0.5), of(|i| i.off_plane_mm, 0.95));
        let roll_deg = of(|i| i.roll_deg, 0.5);
        println!("{rate:.2} | {exact:.1e} | {median:.2} / {p95:.2} | {roll_deg:.1}");
        assert!(noisy.iter().all(|insertion| insertion.off_plane_mm < 1.0), "rate {rate}");
        if rate == 0.07 {
            assert!(exact < 3e-7, "{exact}");
            assert!(median < 0.17 && p95 < 0.30 && roll_deg < 2.5, "{median} {p95} {roll_deg}");
        }
    }
}

/// A baseline that is longer than the insertion leaves nothing to compare.
#[test]
fn an_insertion_without_an_estimate_is_not_just_completed() {
    let scratch = Scratch::new();
    let sets = [
        "insertion.depth_mm=8",
        "insertion.plane_out_of_reach=insert",
        "observer.kind=finite-difference",
        "observer.finite_difference.baseline_mm=20",
    ];
    let sets = sets.iter().flat_map(|set| ["--set", set]);
    let run: Vec<&str> = ["run"].into_iter().chain(sets).collect();
    let said = needle_bench(&scratch, &run);
    assert_eq!(said.status, 0, "{}", said.stderr);
    let last = said.stdout.lines().last().unwrap_or_default();
    assert!(last.starts_with("completed, not steered: the observer had no estimate"), "{last}");
}
