//! Insertions of known needles are simulated, and their parameters are found from them.

use super::*;
use crate::geometry::{FixedAngles, Pose, so3};
use crate::needle::{Increment, Needle, Play, Torsion, TorsionConfig};
use nalgebra::Rotation3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

const NOISE: PathNoise = PathNoise {
    spacing_mm: 0.5,
    position_sd_mm: 0.02,
    position_noise_mm: 1e-3,
    axial_noise_mm: 1e-3,
    heading_noise_rad: 1e-4,
};

/// The sensor on the needle: `R_SB`.
fn mount() -> Rotation3<f64> {
    FixedAngles { yaw: 0.05, pitch: -0.08, roll: 0.7 }.to_rotation()
}

fn needle() -> Needle {
    Needle::new(0.011).unwrap().with_tip_ahead(6.5).unwrap()
}

/// Four insertions of 50 mm. The base turns back and forth at 0.5 and 0.4 rad/mm.
fn recorded(config: TorsionConfig, sd_mm: f64) -> Vec<Vec<PosedRow>> {
    let torsion = Torsion::new(config).unwrap();
    let mut rng = Pcg64::seed_from_u64(7);
    let mut insertion = |n: u32| {
        let mut play = Play::default();
        let mut tip = Pose::identity();
        let (mut base_rad, mut rows) = (1.0, Vec::new());
        for k in 0..1000u32 {
            let off = Vector3::from_fn(|_, _| sd_mm * 12f64.sqrt() * (rng.random::<f64>() - 0.5));
            rows.push(PosedRow {
                line: k as usize + 2,
                insertion_mm: 0.05 * f64::from(k),
                rotation_rad: base_rad,
                position_mm: mount() * tip.translation + off,
                orientation: mount() * tip.rotation * mount().inverse(),
            });
            let forth = (k / (140 + 20 * n)).is_multiple_of(2);
            let turn_rad = if forth { 0.025 } else { -0.02 };
            base_rad += turn_rad;
            for part in play.advance(&torsion, Increment::new(0.05, turn_rad).unwrap()) {
                tip = needle().step(&tip, part);
            }
        }
        rows
    };
    (0..4).map(&mut insertion).collect()
}

const CREEPING: TorsionConfig = TorsionConfig {
    half_width_rad: 0.0,
    half_width_rad_per_mm: 0.0,
    offset_rad: 0.5,
    creep_mm: 0.75,
    creep_mm_per_mm: 0.006,
};

/// The names of the insertions: a.csv, b.csv, ...
fn name(index: usize) -> String {
    ["a.csv", "b.csv", "c.csv"].get(index).map_or_else(String::new, |&name| name.to_owned())
}

#[test]
fn the_parameters_of_a_known_needle_are_found() {
    let fit = NeedleFit::of(&recorded(CREEPING, 0.01), name, &NOISE).unwrap();
    let axis = mount() * Vector3::z();
    assert!((fit.axis - axis).norm() < 1e-3, "{fit:?}");
    let bend = fit.bend;
    assert!((bend.curvature_per_mm - 0.011).abs() < 2e-4, "{bend:?}");
    assert!((bend.tip_ahead_mm - 6.5).abs() < 0.3, "{bend:?}");
    assert!((bend.bend_axis - mount() * Vector3::x()).norm() < 0.02, "{bend:?}");
    assert!(bend.curvature_sd_per_mm < 3e-4 && bend.tip_ahead_sd_mm < 0.5, "{bend:?}");
    let TorsionConfig { half_width_rad, offset_rad, creep_mm, creep_mm_per_mm, .. } =
        fit.torsion.torsion;
    assert_eq!(half_width_rad, 0.0, "{:?}", fit.torsion);
    assert!((offset_rad - 0.5).abs() < 0.02, "{:?}", fit.torsion);
    assert!((creep_mm - 0.75).abs() < 0.05, "{:?}", fit.torsion);
    assert!((creep_mm_per_mm - 0.006).abs() < 2e-3, "{:?}", fit.torsion);
}

#[test]
fn the_band_of_a_known_needle_is_found() {
    let banded = TorsionConfig {
        half_width_rad: 0.3,
        half_width_rad_per_mm: 0.004,
        offset_rad: 0.1,
        creep_mm: 0.3,
        creep_mm_per_mm: 0.0,
    };
    let found = NeedleFit::of(&recorded(banded, 0.01), name, &NOISE).unwrap().torsion;
    let TorsionConfig { half_width_rad, half_width_rad_per_mm, offset_rad, creep_mm, .. } =
        found.torsion;
    assert!((half_width_rad - 0.3).abs() < 0.01, "{found:?}");
    assert!((half_width_rad_per_mm - 0.004).abs() < 5e-4, "{found:?}");
    assert!((offset_rad - 0.1).abs() < 0.01, "{found:?}");
    assert!((creep_mm - 0.3).abs() < 0.05, "{found:?}");
    assert!(found.roll_rms_rad < 0.01, "{found:?}");
}

#[test]
fn insertions_that_determine_no_needle_are_refused() {
    let mut rows = recorded(CREEPING, 0.0);
    let message = |rows: &[Vec<PosedRow>]| NeedleFit::of(rows, name, &NOISE).unwrap_err();
    assert_eq!(
        message(&rows[..2]),
        "needle: 2 insertions, at least 3 needed: their scatter gives the standard errors"
    );
    rows[1].truncate(100);
    assert_eq!(message(&rows), "needle: b.csv is 5.0 mm deep, at least 20 needed; leave it out");
    let mut shallow = recorded(CREEPING, 0.0);
    shallow.iter_mut().for_each(|rows| rows.truncate(60));
    assert_eq!(
        message(&shallow),
        "needle: no insertion goes on for 1 mm below 3 mm; is insertion_mm in mm?"
    );
    let mut huge = recorded(CREEPING, 0.0);
    huge[0][5].rotation_rad = 1e300;
    assert!(
        message(&huge).contains("needle: a.csv, line 7: rotation increment"),
        "{}",
        message(&huge)
    );
    let mut degrees = recorded(CREEPING, 0.0);
    degrees.iter_mut().flatten().for_each(|row| row.rotation_rad = row.rotation_rad.to_degrees());
    assert!(message(&degrees).contains("is rotation_rad in rad"), "{}", message(&degrees));
    let mut mirrored = recorded(CREEPING, 0.0);
    mirrored.iter_mut().flatten().for_each(|row| row.rotation_rad = -row.rotation_rad);
    assert!(message(&mirrored).contains("rotation_rad in rad"), "{}", message(&mirrored));
    for rows in &mut rows {
        for row in rows {
            row.orientation = Rotation3::identity();
        }
    }
    assert!(message(&rows).contains("turn the base both ways"), "{}", message(&rows));
}

/// As from a source that names its axes otherwise for positions than for orientations.
#[test]
fn positions_with_exchanged_or_mirrored_axes_are_refused() {
    let exchanged = |p: Vector3<f64>| Vector3::new(p.y, p.x, p.z);
    let mirrored = |p: Vector3<f64>| Vector3::new(-p.x, p.y, p.z);
    for change in [exchanged, mirrored] as [fn(Vector3<f64>) -> Vector3<f64>; 2] {
        // Across the shaft, and across the sensor, which is off the shaft by 5 deg.
        for r in [mount(), Rotation3::identity()] {
            let mut insertions = recorded(CREEPING, 0.01);
            for row in insertions.iter_mut().flatten() {
                row.position_mm = r * change(r.inverse() * row.position_mm);
            }
            let error = NeedleFit::of(&insertions, name, &NOISE).unwrap_err();
            assert!(error.contains("is no axis mirrored or exchanged"), "{error}");
        }
    }
}

/// The curvature would be off by up to a half, and its standard error would not show it.
#[test]
fn orientations_in_another_frame_than_the_positions_are_refused() {
    let turned = |turned_deg: [f64; 3]| {
        let turn = so3::exp(&Vector3::from(turned_deg.map(f64::to_radians)));
        let mut insertions = recorded(CREEPING, 0.01);
        for row in &mut insertions[2] {
            row.position_mm = turn * row.position_mm;
        }
        NeedleFit::of(&insertions, name, &NOISE).err()
    };
    assert_eq!(turned([0.0; 3]), None);
    assert_eq!(turned([4.0, 0.0, 0.0]), None);
    for (angle_deg, said_deg) in [(20.0, 17..=23), (45.0, 42..=48), (180.0, 155..=180)] {
        let error = turned([angle_deg, 0.0, 0.0]).unwrap();
        let found = said_deg.into_iter().any(|deg| {
            error.starts_with(&format!("needle: c.csv points {deg} deg off its path (limit 10): "))
        });
        assert!(found, "{error}");
    }
}

/// Each insertion has one residual from the mean.
#[test]
fn the_jackknife_covariance_of_a_mean_is_its_standard_error() {
    let values = [1.0, 2.0, 4.0, 9.0];
    let parts = values.map(|value| Part::<1> {
        hessian: SMatrix::identity(),
        gradient: SVector::<f64, 1>::new(value - 4.0),
    });
    let squares: f64 = parts.iter().map(|part| part.gradient.x * part.gradient.x).sum();
    let found = jackknife_covariance(&parts).unwrap();
    assert!((found.x - squares / (4.0 * 3.0)).abs() < 1e-12);
}

#[test]
fn parameters_that_cannot_be_separated_have_no_covariance() {
    let part = |corner: f64| Part::<2> {
        hessian: SMatrix::<f64, 2, 2>::new(1.0, corner, corner, corner),
        gradient: SVector::<f64, 2>::new(1.0, 1.0),
    };
    assert!(jackknife_covariance(&[0.9; 3].map(part)).is_some());
    assert_eq!(jackknife_covariance(&[1.0; 3].map(part)), None);
    assert_eq!(jackknife_covariance(&[0.0; 3].map(part)), None);
}

/// A line through three insertions, each measured at one depth with an error of 1. The farthest one pulls the slope
/// towards itself: its residual is smaller than its error.
#[test]
fn few_insertions_do_not_look_more_alike_than_they_are() {
    let depths = [1.0, 2.0, 6.0_f64];
    let squares: f64 = depths.iter().map(|depth| depth * depth).sum();
    let mut mean_variance = 0.0;
    for signs in 0..8_u8 {
        let errors = [0, 1, 2].map(|bit| if signs >> bit & 1 == 1 { 1.0 } else { -1.0 });
        let slope =
            depths.iter().zip(errors).map(|(depth, error)| depth * error).sum::<f64>() / squares;
        let parts = [0, 1, 2].map(|k| Part::<1> {
            hessian: SMatrix::<f64, 1, 1>::new(depths[k] * depths[k]),
            gradient: SVector::<f64, 1>::new(depths[k] * (errors[k] - slope * depths[k])),
        });
        mean_variance += jackknife_covariance(&parts).unwrap().x / 8.0;
    }
    assert!(mean_variance > 1.0 / squares, "{mean_variance} < {}", 1.0 / squares);
}

#[test]
fn a_fit_that_no_needle_has_is_refused() {
    let fit = NeedleFit::of(&recorded(CREEPING, 0.0), name, &NOISE).unwrap().torsion;
    assert_eq!(fit.fault(), None);
    let wide = TorsionConfig { half_width_rad: 111.5, ..CREEPING };
    let why = "the torsion fits with half_width_deg = 6388.5 (limits 0 to 720)";
    assert_eq!(TorsionFit { torsion: wide, ..fit }.fault().unwrap(), why);
    let nowhere = TorsionConfig { creep_mm: f64::NAN, ..CREEPING };
    assert!(TorsionFit { torsion: nowhere, ..fit }.fault().unwrap().contains("creep_mm = NaN"));
    assert!(TorsionFit { sd: nowhere, ..fit }.fault().unwrap().contains("standard errors"));
    let off = TorsionFit { roll_rms_rad: 0.8, ..fit }.fault();
    assert_eq!(off.unwrap(), "the tip's roll is 46 deg RMS off the fit (limit 45)");
}
