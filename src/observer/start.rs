//! What an observer with a covariance believes at the first measured position.

use crate::geometry::FixedAngles;
use crate::math;
use crate::units::wrap_angle;
use nalgebra::Matrix6;
use std::f64::consts::TAU;

/// Number and spacing of the hypotheses for an unknown roll. Their standard deviation is half the
/// spacing.
const ROLLS: u32 = 8;
const ROLL_SPACING_RAD: f64 = TAU / ROLLS as f64;
/// A roll with a larger standard deviation than this at the start needs several hypotheses.
const ONE_ROLL_SD_RAD: f64 = 0.5 * ROLL_SPACING_RAD;

/// Rolls at the start: value, standard deviation, share. Rolls with a smaller share than
/// `share_min` are left out.
pub(super) fn rolls(start_rad: f64, sd_rad: f64, share_min: f64) -> Vec<(f64, f64, f64)> {
    if sd_rad <= ONE_ROLL_SD_RAD {
        return vec![(start_rad, sd_rad, 1.0)];
    }
    let unknown = sd_rad > 0.25 * TAU;
    (0..ROLLS)
        .map(|k| wrap_angle(f64::from(k) * ROLL_SPACING_RAD))
        .map(|off| {
            let share = if unknown { 1.0 } else { math::exp(-0.5 * (off / sd_rad).powi(2)) };
            (start_rad + off, ONE_ROLL_SD_RAD, share)
        })
        .filter(|&(_, _, share)| share > share_min)
        .collect()
}

/// Covariance of the left-invariant error at the first position, which has this standard deviation,
/// for a start at `angles` with the standard deviations `sd`.
pub(super) fn covariance(
    angles: &FixedAngles,
    sd: &FixedAngles,
    position_sd_mm: f64,
) -> Matrix6<f64> {
    let mut p = Matrix6::zeros();
    (0..3).for_each(|i| p[(i, i)] = position_sd_mm.powi(2));
    // As at pitch 0: yaw and pitch turn about the x and y axes of a tip without roll. At another pitch a turn by
    // yaw is smaller about x, and a part of it is roll; both are left out.
    let (sin, cos) = math::sin_cos(angles.roll);
    let (yaw, pitch) = (sd.yaw.powi(2), sd.pitch.powi(2));
    p[(3, 3)] = cos * cos * yaw + sin * sin * pitch;
    p[(4, 4)] = sin * sin * yaw + cos * cos * pitch;
    p[(3, 4)] = sin * cos * (pitch - yaw);
    p[(4, 3)] = p[(3, 4)];
    p[(5, 5)] = sd.roll * sd.roll;
    p
}
