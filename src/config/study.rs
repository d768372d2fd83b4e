//! `[study]`: from where the trials of a study are drawn.

use super::pose::{POSITION, TIP_PITCH};
use super::{Config, ObserverKind};
use crate::emulator::counted;
use crate::geometry::TURN;
use crate::keys::{Field, Key, section, within};
use crate::needle::{HALF_WIDTH, HALF_WIDTH_PER_MM, OFFSET};
use crate::study::Prior;
use nalgebra::{Vector3, Vector4};

/// The coordinates of the draws of a trial are numbered from here, apart from its noise.
const DRAWS: u64 = 0x5354_5544_5900_0000;
/// Variance, mm², of a position about which nothing is known: observers are not told where they
/// start, but measure it.
const POSITION_UNKNOWN_MM2: f64 = 1e6;

section! {
    /// `[study]`: each a lowest and a highest value, drawn evenly between them; left out, it is as in
    /// `[emulator]`.
    pub struct StudyConfig {
        /// Start of the tip, plane frame, mm.
        x_mm: Option<[f64; 2]> [POSITION] = [-8.0, 8.0];
        /// As `x_mm`.
        y_mm: Option<[f64; 2]> [POSITION] = [0.0, 0.0];
        /// As `x_mm`.
        z_mm: Option<[f64; 2]> [POSITION] = [0.0, 0.0];
        /// Start of the tip, plane frame, degrees.
        yaw_deg: Option<[f64; 2]> [TURN] = [-17.0, 17.0];
        /// As `yaw_deg`.
        pitch_deg: Option<[f64; 2]> [TIP_PITCH] = [-11.5, 11.5];
        /// As `yaw_deg`.
        roll_deg: Option<[f64; 2]> [TURN] = [-180.0, 180.0];
        /// Of the emulated needle's curvature, relative to `[emulator]`.
        curvature_error: Option<[f64; 2]> [within(-0.9, 9.0)] = [0.0, 0.0];
        /// Of the emulated needle's torsion, degrees.
        torsion_half_width_deg: Option<[f64; 2]> [HALF_WIDTH];
        /// Of the emulated needle's torsion, degrees per mm.
        torsion_half_width_deg_per_mm: Option<[f64; 2]> [HALF_WIDTH_PER_MM];
        /// Of the emulated needle's torsion, degrees.
        torsion_offset_deg: Option<[f64; 2]> [OFFSET];
    }
}

impl Config {
    /// The configuration of the trial with this seed: the emulated tip's start, the needle and its
    /// torsion drawn from `[study]`, and the seed of the noise.
    pub fn drawn(&self, seed: u64) -> Config {
        let mut written = self.written.clone();
        let emulator = &mut written["emulator"];
        // Each has a number of its own, so that a range more changes none of the others.
        for (number, key) in (DRAWS..).zip(StudyConfig::KEYS) {
            let Some([low, high]) = self.range(key) else { continue };
            let fraction = (counted(seed, number) >> 11) as f64 / (1u64 << 53) as f64;
            let drawn = low + (high - low) * fraction;
            match (key.name, key.name.strip_prefix("torsion_"), emulator.as_table_mut()) {
                ("curvature_error", _, Some(arc)) => {
                    let curvature_per_mm = self.emulator.arc.curvature_per_mm() * (1.0 + drawn);
                    arc.remove("radius_mm");
                    arc.insert("curvature_per_mm".to_owned(), curvature_per_mm.into());
                }
                (_, Some(name), _) => emulator["torsion"][name] = drawn.into(),
                (name, ..) => emulator["start"][name] = drawn.into(),
            }
        }
        emulator["seed"] = i64::try_from(seed).unwrap_or(i64::MAX).into();
        Config::of(written)
    }

    /// What is given at this `key` of `[study]`, in its unit.
    pub(super) fn range(&self, key: &Key) -> Option<[f64; 2]> {
        self.at(&format!("study.{}", key.name)).map(|range| Field::take(Some(range)))
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
        let sd = observer.start_sd;
        let (angles_told_rad2, curvature_told) = match self.observer.kind {
            ObserverKind::Invariant => {
                (Vector3::new(sd.yaw, sd.pitch, sd.roll).map(|sd| sd * sd), observer.curvature_sd)
            }
            // The others are told nothing of it.
            _ => (Vector3::zeros(), 0.0),
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
