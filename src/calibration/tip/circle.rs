//! Fits a circle to points in space.

use crate::calibration::principal::principal;
use crate::math;
use nalgebra::{Matrix3, Vector2, Vector3};
use std::f64::consts::TAU;

/// Gauss-Newton steps; from the algebraic fit a few are enough.
const STEPS: usize = 20;

/// A circle in space.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Circle {
    pub(super) centre_mm: Vector3<f64>,
    /// Unit vector.
    pub(super) normal: Vector3<f64>,
    pub(super) radius_mm: f64,
    /// RMS distance of the points from the circle within its plane, and from its plane, mm.
    pub(super) rms_mm: (f64, f64),
}

impl Circle {
    /// The least-squares circle within the least-squares plane of the points; `None` if the points
    /// are on a line.
    pub(super) fn fit(points_mm: &[Vector3<f64>]) -> Option<Circle> {
        let n = points_mm.len() as f64;
        let centroid_mm = points_mm.iter().sum::<Vector3<f64>>() / n;
        let centred: Vec<Vector3<f64>> = points_mm.iter().map(|p| p - centroid_mm).collect();
        let covariance = centred.iter().map(|d| d * d.transpose()).sum::<Matrix3<f64>>() / n;
        let (spread_mm, axes) = principal(covariance);
        let flat: Vec<Vector2<f64>> = centred.iter().map(|d| axes.tr_mul(d).xy()).collect();
        let centre_mm = refine(algebraic(&flat)?, &flat);
        let distances_mm: Vec<f64> = flat.iter().map(|p| (p - centre_mm).norm()).collect();
        let radius_mm = distances_mm.iter().sum::<f64>() / n;
        let squares = distances_mm.iter().map(|d| (d - radius_mm).powi(2)).sum::<f64>();
        Some(Circle {
            centre_mm: centroid_mm + axes * centre_mm.push(0.0),
            normal: axes.column(2).into(),
            radius_mm,
            rms_mm: ((squares / n).sqrt(), spread_mm[2]),
        })
    }

    /// RMS distance of the points from the circle, mm.
    pub(super) fn rms_mm(&self) -> f64 {
        math::hypot(self.rms_mm.0, self.rms_mm.1)
    }

    /// The angle of each point about the normal, from a direction of its own, rad.
    pub(super) fn angles(&self, points_mm: &[Vector3<f64>]) -> Vec<f64> {
        // Any direction that is not close to the normal.
        let aside = Vector3::ith(self.normal.iamin(), 1.0);
        let u = self.normal.cross(&aside).normalize();
        let v = self.normal.cross(&u);
        let radial = points_mm.iter().map(|p| p - self.centre_mm);
        radial.map(|d| math::atan2(d.dot(&v), d.dot(&u))).collect()
    }
}

/// The centre by the linear least squares of `|p|² − 2 c·p + k = 0` (Kåsa 1976).
fn algebraic(points_mm: &[Vector2<f64>]) -> Option<Vector2<f64>> {
    let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for p in points_mm {
        let row = Vector3::new(p.x, p.y, 1.0);
        normal += row * row.transpose();
        right += row * p.norm_squared();
    }
    let solution = normal.lu().solve(&right)?;
    let centre_mm = solution.xy() * 0.5;
    centre_mm.iter().all(|c| c.is_finite()).then_some(centre_mm)
}

/// The centre with the smallest sum of squared distances, by Gauss-Newton; the radius is the mean
/// distance. Noise biases algebraic fits inwards, and this fit much less.
fn refine(mut centre_mm: Vector2<f64>, points_mm: &[Vector2<f64>]) -> Vector2<f64> {
    let n = points_mm.len() as f64;
    for _ in 0..STEPS {
        let radial = points_mm.iter().map(|p| p - centre_mm);
        let towards: Vec<(Vector2<f64>, f64)> =
            radial.map(|d| (d / d.norm().max(f64::MIN_POSITIVE), d.norm())).collect();
        let mean = towards.iter().map(|(u, _)| u).sum::<Vector2<f64>>() / n;
        let radius_mm = towards.iter().map(|(_, d)| d).sum::<f64>() / n;
        let (mut normal, mut right) = (nalgebra::Matrix2::zeros(), Vector2::zeros());
        for (u, d) in &towards {
            let row = u - mean;
            normal += row * row.transpose();
            right += row * (d - radius_mm);
        }
        match normal.lu().solve(&right) {
            Some(step) if step.iter().all(|c| c.is_finite()) => centre_mm += step,
            _ => break,
        }
    }
    centre_mm
}

/// The part of a turn that `angles` cover: all except the widest gap between neighbours, rad.
pub(super) fn arc_rad(angles: &[f64]) -> f64 {
    let mut sorted: Vec<f64> = angles.iter().map(|angle| angle.rem_euclid(TAU)).collect();
    sorted.sort_by(f64::total_cmp);
    let ends = sorted.first().zip(sorted.last());
    let around = ends.map_or(TAU, |(first, last)| first + TAU - last);
    let gaps = sorted.windows(2).map(|pair| pair[1] - pair[0]);
    TAU - gaps.fold(around, f64::max)
}
