//! The rolls and the covariance with which an observer starts at the first measured position.

use super::mixture::WEIGHT_MIN;
use crate::geometry::FixedAngles;
use crate::math;
use crate::units::wrap_angle;
use nalgebra::Matrix6;
use std::f64::consts::TAU;

/// A roll with a larger standard deviation than this at the start needs several hypotheses.
const ONE_ROLL_SD_RAD: f64 = TAU / 16.0;

/// True if one hypothesis is enough for a roll with this standard deviation.
pub(super) fn is_one_roll(sd_rad: f64) -> bool {
    sd_rad <= ONE_ROLL_SD_RAD
}

/// Rolls at the start: value, standard deviation, share. If one is not enough, there are `count` around the circle,
/// and their standard deviation is half their spacing. Rolls that would be dropped at once are left out.
pub(super) fn rolls(start_rad: f64, sd_rad: f64, count: u32) -> Vec<(f64, f64, f64)> {
    if is_one_roll(sd_rad) {
        return vec![(start_rad, sd_rad, 1.0)];
    }
    let spacing_rad = TAU / f64::from(count);
    let unknown = sd_rad > 0.25 * TAU;
    (0..count)
        .map(|k| wrap_angle(f64::from(k) * spacing_rad))
        .map(|off| {
            let share = if unknown { 1.0 } else { math::exp(-0.5 * (off / sd_rad).powi(2)) };
            (start_rad + off, 0.5 * spacing_rad, share)
        })
        .filter(|&(_, _, share)| share > WEIGHT_MIN)
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
    // Yaw turns about the x axis of a tip without pitch and roll, pitch about the y axis of one without roll. At
    // another pitch a part of yaw is roll.
    let (sin, cos) = math::sin_cos(angles.roll);
    let (sin_pitch, cos_pitch) = math::sin_cos(angles.pitch);
    let [across, along] = [sd.yaw * cos_pitch, sd.yaw * sin_pitch];
    let (yaw, pitch) = (across.powi(2), sd.pitch.powi(2));
    p[(3, 3)] = cos * cos * yaw + sin * sin * pitch;
    p[(4, 4)] = sin * sin * yaw + cos * cos * pitch;
    p[(3, 4)] = sin * cos * (pitch - yaw);
    p[(3, 5)] = cos * across * along;
    p[(4, 5)] = -sin * across * along;
    p[(5, 5)] = sd.roll * sd.roll + along * along;
    p.fill_lower_triangle_with_upper_triangle();
    p
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
    use nalgebra::Matrix3;

    /// The reference is the turn of the tip by a small change of each angle.
    #[test]
    fn the_start_covariance_is_that_of_the_angles_at_every_pitch() {
        let sd = FixedAngles { yaw: 0.1, pitch: 0.2, roll: 0.3 };
        for (pitch, roll) in [(0.0, 0.0), (0.6, 0.0), (-1.2, 2.0), (0.4, -0.7)] {
            let start = FixedAngles { yaw: 0.5, pitch, roll };
            let pose =
                |angles: FixedAngles| Pose { rotation: angles.to_rotation(), ..Pose::identity() };
            let turn = |changed| (pose(start).inverse() * pose(changed)).log().w / 1e-6;
            let turns = Matrix3::from_columns(&[
                turn(FixedAngles { yaw: start.yaw + 1e-6, ..start }) * sd.yaw,
                turn(FixedAngles { pitch: pitch + 1e-6, ..start }) * sd.pitch,
                turn(FixedAngles { roll: roll + 1e-6, ..start }) * sd.roll,
            ]);
            let covariance = covariance(&start, &sd, 1.0);
            let off = covariance.fixed_view::<3, 3>(3, 3) - turns * turns.transpose();
            assert!(off.norm() < 1e-6, "{start:?}: {off}");
        }
    }
}
