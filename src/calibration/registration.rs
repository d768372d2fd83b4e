//! The tracker's pose on the bench from fiducials: points measured in both frames.

use super::{check_distances, cross_covariance, mean, principal_axes};
use crate::geometry::Pose;
use crate::keys::{Rule, section, within};
use crate::table::Table;
use crate::units::IN_METRES;
use nalgebra::{Matrix3, Rotation3, Vector3};
use std::cmp::Ordering;
use std::f64::consts::PI;

/// Columns of a file of fiducial pairs: each point in the tracker's frame and in the bench frame.
pub const FIDUCIAL_COLUMNS: [&str; 6] =
    ["x_tracker_mm", "y_tracker_mm", "z_tracker_mm", "x_bench_mm", "y_bench_mm", "z_bench_mm"];

/// Fiducials narrower than this, mm, or than this share of their length, count as a line. The turn
/// about a line is unknown.
const BREADTH_MIN_MM: f64 = 1.0;
const BREADTH_PER_LENGTH_MIN: f64 = 0.02;
/// They must also be wider than this many times the error of locating one, or that error alone would
/// look like breadth.
const BREADTH_PER_ERROR_MIN: f64 = 3.0;
/// Two sets that differ in size by more than this factor are not in the same unit.
const SCALE_MAX: f64 = 2.0;
/// Points in both frames that lie closer together than this, mm RMS along their longest axis, are not in mm: no tool
/// touches them apart.
const LENGTH_MIN_MM: f64 = 1.0;

const COORDINATE: Rule = within(-5000.0, 5000.0);

section! {
    /// A point in both frames.
    #[derive(Copy)]
    pub struct FiducialPair {
        /// In the tracker's frame, mm.
        tracker_mm: Vector3<f64> [COORDINATE];
        /// In the bench's frame, mm.
        bench_mm: Vector3<f64> [COORDINATE];
    }
}

impl FiducialPair {
    /// Reads pairs from CSV text with the columns [`FIDUCIAL_COLUMNS`], in any order.
    ///
    /// # Errors
    /// A missing column, or a field that is not a finite number, with its line.
    pub fn parse(csv: &str) -> Result<Vec<Self>, String> {
        let rows = Table::parse(csv).numbers(FIDUCIAL_COLUMNS)?.into_iter();
        let pairs = rows.map(|[tx, ty, tz, wx, wy, wz]| FiducialPair {
            tracker_mm: Vector3::new(tx, ty, tz),
            bench_mm: Vector3::new(wx, wy, wz),
        });
        Ok(pairs.collect())
    }
}

/// A registration by least squares, and its quality. Points are numbered from 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RegistrationFit {
    /// `X_WT`: the tracker's pose on the bench.
    pub x_wt: Pose,
    /// Number of fiducials.
    pub points: usize,
    /// Root mean square of the remaining distances between the pairs (FRE), mm.
    pub rms_mm: f64,
    /// The fiducial with the largest remaining distance.
    pub worst_point: usize,
    /// That residual distance, mm.
    pub worst_mm: f64,
    /// RMS extent of the fiducials along their principal axes, largest first, mm.
    pub spread_mm: [f64; 3],
    /// Scale of the tracker's distances to the bench's, where it differs significantly from 1.
    pub scale: Option<f64>,
    /// Centroid of the fiducials on the bench, mm.
    centre_bench: Vector3<f64>,
    /// Principal axes on the bench, in the order of `spread_mm`.
    axes: Matrix3<f64>,
}

/// A scale counts as wrong if it differs from 1 by more than this many of its standard errors.
const SCALE_SDS: f64 = 5.0;
/// A smaller error of the scale is not reported: over 250 mm it moves a point by 0.5 mm at most.
const SCALE_ERROR_MIN: f64 = 0.002;
const FLAT: &str = "the points lie in a plane, and so cannot show a mirrored axis of the tracker: touch one off it";
const SCATTERED: &str =
    "measure that one again, and check that both frames have the points in the same order";

/// With more points than this, no other order is searched for: so many are hardly symmetric by chance.
const ORDER_POINTS_MAX: usize = 12;
/// No more partial orders are tried than this. Points that all lie close together have billions.
const ORDER_TRIES_MAX: usize = 100_000;
/// In another order, the distance of two points on the bench may differ from the tracker's by this, mm.
const ORDER_DISTANCE_MM: f64 = 3.0;
/// An order that turns the frame by less than this is the same one, with two close points exchanged.
const TURNED_MIN_RAD: f64 = 2.0 * PI / 180.0;

/// The orders of the bench's points in which they are as far apart as in the tracker's frame, by backtracking: the
/// tracker's point k goes with the bench's point `order[k]`.
struct Orders<'a> {
    pairs: &'a [FiducialPair],
    order: Vec<usize>,
    /// The first of the bench's points to try next.
    next: usize,
    tries: usize,
}

impl<'a> Orders<'a> {
    fn new(pairs: &'a [FiducialPair]) -> Self {
        Orders { pairs, order: Vec::new(), next: 0, tries: 0 }
    }

    /// True if the bench's point `n` may come next.
    fn fits(&self, n: usize) -> bool {
        let of = self.pairs[self.order.len()].tracker_mm;
        !self.order.contains(&n)
            && self.order.iter().zip(self.pairs).all(|(&other, pair)| {
                let bench_mm = (self.pairs[n].bench_mm - self.pairs[other].bench_mm).norm();
                ((of - pair.tracker_mm).norm() - bench_mm).abs() <= ORDER_DISTANCE_MM
            })
    }
}

impl Iterator for Orders<'_> {
    type Item = Vec<usize>;

    fn next(&mut self) -> Option<Vec<usize>> {
        let count = self.pairs.len();
        while self.tries < ORDER_TRIES_MAX {
            self.tries += 1;
            let fitting = (self.order.len() < count)
                .then(|| (self.next..count).find(|&n| self.fits(n)))
                .flatten();
            match fitting {
                Some(n) => {
                    self.order.push(n);
                    self.next = 0;
                    if self.order.len() == count {
                        return Some(self.order.clone());
                    }
                }
                None => self.next = self.order.pop()? + 1,
            }
        }
        None
    }
}

impl RegistrationFit {
    /// The rigid motion with the smallest sum of squared distances `|p_W − X_WT p_T|²` (Umeyama
    /// 1991 Eq. 40 without scale; Kabsch 1978). It is computed by the singular value decomposition
    /// of the pairs' covariance; the sign of the direction with the smallest value is chosen so
    /// that the result is a rotation. For a coplanar set that value is zero, and without the choice
    /// half of the sets would give a reflection.
    ///
    /// # Errors
    /// Fewer than three points, positions beyond 5 m, the same position twice, sets whose sizes differ by more
    /// than a factor of 2, points on a line, or more than `rms_max_mm` RMS.
    pub fn of(pairs: &[FiducialPair], rms_max_mm: f64) -> Result<Self, String> {
        let points = pairs.len();
        if points < 3 {
            return refused(format!(
                "too few points, {points} of at least 3; touch more fiducials"
            ));
        }
        let tracker_mm: Vec<Vector3<f64>> = pairs.iter().map(|pair| pair.tracker_mm).collect();
        let bench_mm: Vec<Vector3<f64>> = pairs.iter().map(|pair| pair.bench_mm).collect();
        check_positions("tracker", &tracker_mm)?;
        check_positions("bench", &bench_mm)?;
        let (centre_tracker, centre_bench) = (mean(&tracker_mm), mean(&bench_mm));
        let tracker_mm: Vec<_> = tracker_mm.iter().map(|p| p - centre_tracker).collect();
        let bench_mm: Vec<_> = bench_mm.iter().map(|p| p - centre_bench).collect();
        let (rotation, reflection) = nearest_rotation(&cross_covariance(&bench_mm, &tracker_mm));
        let x_wt = Pose { rotation, translation: centre_bench - rotation * centre_tracker };

        let residual_mm = |p: &FiducialPair| (p.bench_mm - x_wt.transform(&p.tracker_mm)).norm();
        let residuals_mm: Vec<f64> = pairs.iter().map(residual_mm).collect();
        let squares = residuals_mm.iter().map(|mm| mm * mm).sum::<f64>();
        let rms_mm = (squares / points as f64).sqrt();
        let worst = (1..).zip(residuals_mm).min_by(|a, b| b.1.total_cmp(&a.1));
        let (worst_point, worst_mm) = worst.unwrap_or_default();
        let (spread_tracker_mm, _) = principal_axes(&tracker_mm);
        let (spread_mm, axes) = principal_axes(&bench_mm);

        let size_mm = |spread_mm: [f64; 3]| Vector3::from(spread_mm).norm();
        let ratio = size_mm(spread_tracker_mm) / size_mm(spread_mm);
        if !(1.0 / SCALE_MAX..=SCALE_MAX).contains(&ratio) {
            let hint = match ratio {
                _ if is_thousandfold(1.0 / ratio) => IN_METRES,
                _ if is_thousandfold(ratio) => {
                    "the bench's points look like metres; give both in mm"
                }
                _ => "give both in mm",
            };
            return refused(format!(
                "the tracker's points are {ratio:.4} times as far apart as the bench's; {hint}"
            ));
        }
        if spread_mm[0] < LENGTH_MIN_MM && spread_tracker_mm[0] < LENGTH_MIN_MM {
            return refused(format!(
                "the points are {:.3} mm RMS apart (at least {LENGTH_MIN_MM} needed): {IN_METRES}",
                spread_mm[0]
            ));
        }
        let turned_mm: Vec<_> = tracker_mm.iter().map(|p| rotation * p).collect();
        let scale = wrong_scale(&turned_mm, &bench_mm);
        let breadth_mm = spread_tracker_mm[1].min(spread_mm[1]);
        let check_breadth = |limit_mm: f64| match breadth_mm >= limit_mm {
            true => Ok(()),
            false => refused(format!(
                "{points} points lie {breadth_mm:.2} mm RMS off a line (at least {limit_mm:.2} \
                 needed for their length and error): the turn about it is unknown; add points to \
                 its sides"
            )),
        };
        check_breadth(BREADTH_MIN_MM.max(BREADTH_PER_LENGTH_MIN * spread_mm[0]))?;
        if rms_mm > rms_max_mm || rms_max_mm.is_nan() {
            let mirrored_rms_mm = reflection.map(|reflection| {
                let off_mm2 =
                    |(b, t): (&Vector3<f64>, &Vector3<f64>)| (b - reflection * t).norm_squared();
                let squares = bench_mm.iter().zip(&tracker_mm).map(off_mm2).sum::<f64>();
                (squares / points as f64).sqrt()
            });
            let hint = match (mirrored_rms_mm, scale) {
                (Some(mm), _) if mm <= rms_max_mm => format!(
                    "a mirrored frame, or two exchanged axes, fits to {mm:.2} mm: check the tracker's axes"
                ),
                (_, Some(scale)) => scale_remark(scale),
                (_, None) => SCATTERED.to_owned(),
            };
            return refused(format!(
                "{points} points, {rms_mm:.2} mm RMS (limit {rms_max_mm:.2}); worst is point \
                 {worst_point}, {worst_mm:.1} mm; {hint}"
            ));
        }
        let fit = RegistrationFit {
            x_wt,
            points,
            rms_mm,
            worst_point,
            worst_mm,
            spread_mm,
            scale,
            centre_bench,
            axes,
        };
        check_breadth(BREADTH_PER_ERROR_MIN * fit.localisation_error_mm())?;
        Ok(fit)
    }

    /// Remarks on what the residuals of the `pairs` may hide: points in a plane, a wrong scale, another order of the
    /// points that fits as well, to `rms_max_mm`.
    pub fn remarks(&self, pairs: &[FiducialPair], rms_max_mm: f64) -> Vec<String> {
        let mut remarks = Vec::new();
        let flat_max_mm =
            (BREADTH_PER_LENGTH_MIN * self.spread_mm[0]).max(self.localisation_error_mm());
        if self.spread_mm[2] < flat_max_mm {
            remarks.push(FLAT.to_owned());
        }
        remarks.extend(self.scale.map(scale_remark));
        remarks.extend(self.other_order(pairs, rms_max_mm));
        remarks
    }

    /// A remark on the first other order of the bench's points that fits to `rms_max_mm` and turns the frame: a wrong
    /// order of a symmetric layout fits as well as the right one.
    fn other_order(&self, pairs: &[FiducialPair], rms_max_mm: f64) -> Option<String> {
        if pairs.len() > ORDER_POINTS_MAX {
            return None;
        }
        let (order, fit, turned_rad) = Orders::new(pairs).find_map(|order| {
            let bench_mm = order.iter().map(|&n| pairs[n].bench_mm);
            let pairs = pairs.iter().zip(bench_mm);
            let pairs: Vec<_> =
                pairs.map(|(pair, bench_mm)| FiducialPair { bench_mm, ..*pair }).collect();
            let fit = Self::of(&pairs, rms_max_mm).ok()?;
            let turned_rad = fit.x_wt.rotation.angle_to(&self.x_wt.rotation);
            (turned_rad > TURNED_MIN_RAD).then_some((order, fit, turned_rad))
        })?;
        let order: Vec<String> = order.iter().map(|n| (n + 1).to_string()).collect();
        Some(format!(
            "the bench's points fit in the order {} as well ({:.2} mm RMS), turned by {:.0} deg: is the order right? \
             Touch one more that breaks the symmetry",
            order.join(","),
            fit.rms_mm,
            turned_rad.to_degrees()
        ))
    }

    /// The RMS error of locating one fiducial (FLE), mm, from the remaining distances:
    /// `FRE² = (1 − 2/N) FLE²` (Fitzpatrick, West and Maurer, IEEE Trans. Med.
    /// Imaging 17, 1998), errors being independent and the same in all directions.
    pub fn localisation_error_mm(&self) -> f64 {
        self.rms_mm / (1.0 - 2.0 / self.points as f64).sqrt()
    }

    /// Standard deviation in the worst direction, mm, of a point at `p_w_mm` on the bench, due to the
    /// registration's error: the root of the largest eigenvalue of
    /// `FLE²/3N (I + Σ (e_k × d)(e_k × d)ᵀ/f_k²)`. d is the point from the fiducials' centroid, e_k their
    /// principal axis k, f_k their RMS distance from it. The trace is TRE² of Fitzpatrick, West and Maurer
    /// (1998).
    ///
    /// The residuals of few points show the error poorly: with ν = 3N − 6 degrees of freedom the factor √(ν/(ν − 2))
    /// gives the standard deviation of Student's t, √3 for three points.
    ///
    /// It is the same for all samples of a run; averaging does not reduce it.
    pub fn target_sd_mm(&self, p_w_mm: &Vector3<f64>) -> f64 {
        let along = self.axes.tr_mul(&(p_w_mm - self.centre_bench));
        let mut spread = Matrix3::identity();
        for (k, i, j) in [(0, 1, 2), (1, 0, 2), (2, 0, 1)] {
            let moved = Vector3::ith(k, 1.0).cross(&along);
            let distance2 = self.spread_mm[i].powi(2) + self.spread_mm[j].powi(2);
            spread += moved * moved.transpose() / distance2;
        }
        let variance = self.localisation_error_mm().powi(2) / (3 * self.points) as f64;
        let freedom = (3 * self.points - 6) as f64;
        (variance * freedom / (freedom - 2.0) * spread.symmetric_eigenvalues().max()).sqrt()
    }
}

fn scale_remark(scale: f64) -> String {
    format!(
        "the tracker has the points {scale:.3} times as far apart as the bench: is its scale right, and are \
         both in mm?"
    )
}

/// Scale of the tracker's distances to the bench's, `1/s` of the least squares of `bench = s tracker`, if s
/// differs from 1 by more than chance. The residuals give the standard error of s. Both sets have zero mean
/// and the same orientation.
fn wrong_scale(tracker_mm: &[Vector3<f64>], bench_mm: &[Vector3<f64>]) -> Option<f64> {
    let pairs = || tracker_mm.iter().zip(bench_mm);
    let square_mm2: f64 = tracker_mm.iter().map(Vector3::norm_squared).sum();
    let scale = pairs().map(|(t, b)| t.dot(b)).sum::<f64>() / square_mm2;
    let residual_mm2: f64 = pairs().map(|(t, b)| (b - t * scale).norm_squared()).sum();
    // A similarity has seven parameters. Fewer than five degrees of freedom do not show a standard error.
    let freedom = (3 * tracker_mm.len()).checked_sub(7).filter(|freedom| *freedom >= 5)?;
    let sd = (residual_mm2 / freedom as f64 / square_mm2).sqrt();
    ((scale - 1.0).abs() > (SCALE_SDS * sd).max(SCALE_ERROR_MIN)).then_some(scale.recip())
}

fn refused<T>(reason: String) -> Result<T, String> {
    Err(format!("registration: {reason}"))
}

/// Refuses positions farther away than any bench reaches, and two that are the same.
fn check_positions(frame: &str, positions_mm: &[Vector3<f64>]) -> Result<(), String> {
    check_distances("registration: point", frame, positions_mm)?;
    let mut numbered: Vec<([f64; 3], usize)> =
        positions_mm.iter().map(|position| (*position).into()).zip(1..).collect();
    // All are finite by now. Zeros of either sign are the same position.
    numbered.sort_by(|(a, _), (b, _)| a.partial_cmp(b).unwrap_or(Ordering::Equal));
    match numbered.windows(2).find(|pair| pair[0].0 == pair[1].0) {
        None => Ok(()),
        Some(pair) => refused(format!(
            "points {} and {} have the same {frame} position; remove the copy, or give the mean of \
             repeated measurements as one pair",
            pair[0].1, pair[1].1
        )),
    }
}

/// Whether `ratio` is that of metres to millimetres.
fn is_thousandfold(ratio: f64) -> bool {
    (1000.0 / SCALE_MAX..=1000.0 * SCALE_MAX).contains(&ratio)
}

/// The rotation R that maximises tr(Rᵀ M), and the reflection that does, if it fits better.
fn nearest_rotation(m: &Matrix3<f64>) -> (Rotation3<f64>, Option<Matrix3<f64>>) {
    // Singular values are sorted, the smallest last.
    let svd = m.svd(true, true);
    let (u, v_t) = (svd.u.unwrap_or_default(), svd.v_t.unwrap_or_default());
    let sign = (u * v_t).determinant().signum();
    let proper = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign));
    (Rotation3::from_matrix_unchecked(u * proper * v_t), (sign < 0.0).then(|| u * v_t))
}

#[cfg(test)]
mod tests;
