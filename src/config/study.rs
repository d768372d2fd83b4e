//! `[study]`: from where the trials of a study are drawn.

use serde::Serialize;

use super::pose::{PITCH, POSITION, TURN};
use super::rule::Range;
use super::section::Section;
use super::steering::{Arc, GROWTH, OFFSET, WIDTH};
use super::{Config, ObserverKind};
use crate::emulator::counted;
use crate::study::Prior;
use nalgebra::{Vector3, Vector4};

/// The coordinates of the draws of a trial are numbered from here, apart from its noise.
const DRAWS: u64 = 0x5354_5544_5900_0000;
/// Variance, mm², of a position about which nothing is known: observers are not told where they
/// start, but measure it.
const POSITION_UNKNOWN_MM2: f64 = 1e6;

/// `[study]`: each a lowest and a highest value, drawn evenly between them; as in `[emulator]`
/// where it is left out.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StudyConfig {
    /// Start of the tip, plane frame, mm.
    pub x_mm: Option<[f64; 2]>,
    /// As `x_mm`.
    pub y_mm: Option<[f64; 2]>,
    /// As `x_mm`.
    pub z_mm: Option<[f64; 2]>,
    /// Start of the tip, plane frame, degrees.
    pub yaw_deg: Option<[f64; 2]>,
    /// As `yaw_deg`.
    pub pitch_deg: Option<[f64; 2]>,
    /// As `yaw_deg`.
    pub roll_deg: Option<[f64; 2]>,
    /// Of the emulated needle's curvature, relative to `[emulator]`.
    pub curvature_error: Option<[f64; 2]>,
    /// Of the emulated needle's torsion, degrees.
    pub torsion_half_width_deg: Option<[f64; 2]>,
    /// Of the emulated needle's torsion, degrees per mm.
    pub torsion_half_width_deg_per_mm: Option<[f64; 2]>,
    /// Of the emulated needle's torsion, degrees.
    pub torsion_offset_deg: Option<[f64; 2]>,
}

impl StudyConfig {
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        StudyConfig {
            x_mm: s.optional_interval("x_mm", POSITION),
            y_mm: s.optional_interval("y_mm", POSITION),
            z_mm: s.optional_interval("z_mm", POSITION),
            yaw_deg: s.optional_interval("yaw_deg", TURN),
            pitch_deg: s.optional_interval("pitch_deg", PITCH),
            roll_deg: s.optional_interval("roll_deg", TURN),
            curvature_error: s.optional_interval("curvature_error", Range::within(-0.9, 9.0)),
            torsion_half_width_deg: s.optional_interval("torsion_half_width_deg", WIDTH),
            torsion_half_width_deg_per_mm: s
                .optional_interval("torsion_half_width_deg_per_mm", GROWTH),
            torsion_offset_deg: s.optional_interval("torsion_offset_deg", OFFSET),
        }
    }
}

impl Config {
    /// The configuration of the trial with this seed: the emulated tip's start, the needle and its
    /// torsion drawn from `[study]`, and the seed of the noise.
    pub fn drawn(&self, seed: u64) -> Config {
        let mut config = self.clone();
        let (study, emulator) = (&self.study, &mut config.emulator);
        emulator.seed = seed;
        let start = &mut emulator.start;
        let torsion = &mut emulator.torsion;
        let mut curvature_error = 0.0;
        let draws = [
            (&mut start.x_mm, study.x_mm),
            (&mut start.y_mm, study.y_mm),
            (&mut start.z_mm, study.z_mm),
            (&mut start.yaw_deg, study.yaw_deg),
            (&mut start.pitch_deg, study.pitch_deg),
            (&mut start.roll_deg, study.roll_deg),
            (&mut curvature_error, study.curvature_error),
            (&mut torsion.half_width_deg, study.torsion_half_width_deg),
            (&mut torsion.half_width_deg_per_mm, study.torsion_half_width_deg_per_mm),
            (&mut torsion.offset_deg, study.torsion_offset_deg),
        ];
        // Each has a number of its own, so that a range more changes none of the others.
        for (number, (value, range)) in (DRAWS..).zip(draws) {
            if let Some([low, high]) = range {
                let fraction = (counted(seed, number) >> 11) as f64 / (1u64 << 53) as f64;
                *value = low + (high - low) * fraction;
            }
        }
        if study.curvature_error.is_some() {
            let curvature_per_mm = emulator.arc.curvature_per_mm() * (1.0 + curvature_error);
            emulator.arc = Arc::Curvature { curvature_per_mm };
        }
        config
    }

    /// What is not known of a trial before it begins, for the information bound: what the study
    /// draws, and what the observer that steers is told it does not know, whichever is wider. No
    /// estimate can do better than what it starts from allows.
    pub fn prior(&self) -> Prior {
        let study = &self.study;
        let variance = |range: Option<[f64; 2]>| {
            range.map_or(0.0, |[low, high]| (high - low) * (high - low) / 12.0)
        };
        let deg2 = |range| variance(range) * 1f64.to_radians().powi(2);
        let curvature_per_mm = self.emulator.arc.curvature_per_mm();
        let observer = &self.observer.invariant;
        let (angles_told_rad2, curvature_told) = match self.observer.kind {
            ObserverKind::Invariant => {
                let sd = observer.start_sd.to_fixed_angles();
                (Vector3::new(sd.yaw, sd.pitch, sd.roll).map(|sd| sd * sd), observer.curvature_sd)
            }
            ObserverKind::Coupled | ObserverKind::FiniteDifference => (Vector3::zeros(), 0.0),
        };
        let angles_rad2 =
            Vector3::new(deg2(study.yaw_deg), deg2(study.pitch_deg), deg2(study.roll_deg));
        Prior {
            position_mm2: POSITION_UNKNOWN_MM2,
            angles_rad2: angles_rad2.sup(&angles_told_rad2),
            parameters: Vector4::new(
                variance(study.curvature_error).max(curvature_told.powi(2))
                    * curvature_per_mm.powi(2),
                deg2(study.torsion_half_width_deg),
                deg2(study.torsion_half_width_deg_per_mm),
                deg2(study.torsion_offset_deg),
            ),
        }
    }
}
