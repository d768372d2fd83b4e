//! The tip's pose on the sensor, from a recording in which only the base turns. The sensor then
//! moves on a circle about the needle's axis.

use super::{check_distances, mean, principal_axes};
use crate::geometry::{FixedAngles, Pose};
use crate::math;
use crate::table::Table;
use crate::units::IN_METRES;
use nalgebra::{Matrix2, Matrix3, Rotation3, SMatrix, SVector, Vector2, Vector3};
use std::f64::consts::{PI, TAU};

/// Columns of a recorded turn, without those of the orientation.
pub const TURN_COLUMNS: [&str; 4] = ["rotation_rad", "x_mm", "y_mm", "z_mm"];

/// A circle in space has six unknowns; two more points show whether it fits.
const POINTS_MIN: usize = 8;
/// Less than half a circle does not determine its centre.
const ARC_MIN_RAD: f64 = PI;
/// A radius under this many times the RMS distance from the circle may be only noise.
const RADIUS_PER_RMS_MIN: f64 = 3.0;
/// A smaller radius, mm, is no offset: no tracker resolves it.
const RADIUS_MIN_MM: f64 = 0.02;
/// From this radius on, mm, it may be the offset of a sensor in metres.
const RADIUS_IN_METRES_MIN_MM: f64 = 1e-4;
/// The least length of the mean of unit vectors that should all be equal: 0.9 is a spread of 26°,
/// which leaves room for the shaft's torsion.
const COHERENCE_MIN: f64 = 0.9;
/// Without the sensor's roll, its z axis is assumed along the needle; it may be off by at most this, deg.
const TILT_MAX_DEG: f64 = 30.0;

/// One position while the base turns.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TurnSample {
    /// Measured base rotation, right-handed about the insertion, rad.
    pub rotation_meas_rad: f64,
    /// `p_TS`: the sensor in the tracker's frame, mm.
    pub position_meas_mm: Vector3<f64>,
    /// `R_TS`, if the tracker gives it.
    pub orientation_meas: Option<Rotation3<f64>>,
}

impl TurnSample {
    /// Reads samples from CSV text with the columns `rotation_rad,x_mm,y_mm,z_mm` and, all four or
    /// none, `qw,qx,qy,qz`, in any order.
    ///
    /// # Errors
    /// A missing column, a field that is not a finite number, or a quaternion that cannot be normalised,
    /// with its line.
    pub fn parse(csv: &str) -> Result<Vec<Self>, String> {
        let table = Table::parse(csv);
        let rows = table.numbers(TURN_COLUMNS)?.into_iter().zip(table.rotations()?);
        let samples = rows.map(|([rotation_meas_rad, x, y, z], orientation_meas)| TurnSample {
            rotation_meas_rad,
            position_meas_mm: Vector3::new(x, y, z),
            orientation_meas,
        });
        Ok(samples.collect())
    }
}

/// The needle's axis, from the circle of the turning sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TipFit {
    /// Number of positions.
    pub points: usize,
    /// Distance of the sensor from the needle's axis, mm.
    pub radius_mm: f64,
    /// RMS distance of the positions from the circle, mm.
    pub rms_mm: f64,
    /// The part of a turn that the positions cover, rad.
    pub arc_rad: f64,
    /// A point of the axis in the tracker's frame: the circle's centre, mm.
    pub centre_mm: Vector3<f64>,
    /// Standard error of the centre in its least certain direction, mm, if the noise is independent.
    pub centre_sd_mm: f64,
    /// Standard error of the direction in its least certain direction, rad, if the noise is independent.
    pub axis_sd_rad: f64,
    /// The needle's direction in the tracker's frame, a unit vector. The base turns right-handed about
    /// it.
    pub axis: Vector3<f64>,
    /// The same axis in the sensor's frame; `None` if the sensor's orientation does not turn with the
    /// needle.
    pub mount: Option<SensorMount>,
}

/// The mount of the sensor in the needle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SensorMount {
    /// From the sensor to the nearest point of the axis, in the sensor's frame, mm.
    pub to_axis_mm: Vector3<f64>,
    /// The needle's direction in the sensor's frame, a unit vector.
    pub axis: Vector3<f64>,
}

impl TipFit {
    /// Fits a circle to the positions, with its axis right-handed with the base. The sensor's angle
    /// may differ from the base's, since the shaft twists.
    ///
    /// # Errors
    /// Fewer than eight positions, more than `rms_max_mm` RMS off a circle, under half a turn, a
    /// radius within the noise or under 0.02 mm, or a sensor that does not follow the base.
    pub fn of(samples: &[TurnSample], rms_max_mm: f64) -> Result<Self, String> {
        let points = samples.len();
        if points < POINTS_MIN {
            return refused(format!(
                "{points} positions, at least {POINTS_MIN} needed; record a whole turn"
            ));
        }
        let positions_mm: Vec<Vector3<f64>> =
            samples.iter().map(|sample| sample.position_meas_mm).collect();
        check_distances("tip: position", "tracker", &positions_mm)?;
        let rotations = samples.iter().map(|sample| sample.rotation_meas_rad);
        let turn_rad = rotations.clone().fold(f64::NEG_INFINITY, f64::max)
            - rotations.fold(f64::INFINITY, f64::min);
        let Some(mut circle) = Circle::fit(&positions_mm) else {
            return refused(format!(
                "the {points} positions are all the same, or on one line: is the tracker's value frozen, did the \
                 base turn, or is the sensor on the needle's axis?"
            ));
        };
        let (radius_mm, rms_mm) = (circle.radius_mm, circle.rms_mm());
        if rms_mm > rms_max_mm || rms_max_mm.is_nan() {
            return refused(format!(
                "{points} positions, {rms_mm:.2} mm RMS off a circle (limit {rms_max_mm:.2}, --rms-max-mm), {:.2} mm \
                 of it out of its plane; turn only the base, in air, with the insertion axis at rest",
                circle.out_of_plane_rms_mm
            ));
        }
        let angles = circle.angles(&positions_mm);
        let arc_rad = arc_of(&angles);
        if arc_rad < ARC_MIN_RAD || turn_rad < ARC_MIN_RAD {
            return refused(format!(
                "the positions cover {:.0} deg of a circle and the base turned {:.0} deg (at least \
                 {:.0} needed); turn the base a whole turn",
                arc_rad.to_degrees(),
                turn_rad.to_degrees(),
                ARC_MIN_RAD.to_degrees()
            ));
        }
        if radius_mm < RADIUS_PER_RMS_MIN * rms_mm {
            return refused(format!(
                "the circle's radius is {radius_mm:.3} mm, and the positions scatter {rms_mm:.3} mm RMS about \
                 it (limit: a third of the radius): no offset from the needle's axis can be seen; leave \
                 tracker.tip_offset_mm at zero"
            ));
        }
        if radius_mm < RADIUS_MIN_MM {
            let hint = match radius_mm >= RADIUS_IN_METRES_MIN_MM {
                true => format!("{IN_METRES}; for a sensor on the axis"),
                false => "no offset from the needle's axis can be seen;".to_owned(),
            };
            return refused(format!(
                "the circle's radius is {radius_mm:.5} mm (at least {RADIUS_MIN_MM} needed): {hint} leave \
                 tracker.tip_offset_mm at zero"
            ));
        }
        // The angle increases with the base's rotation if the normal points along the insertion, and
        // decreases if it points the other way.
        let coherence_with = |sign: f64| {
            let differences =
                angles.iter().zip(samples).map(|(a, sample)| a - sign * sample.rotation_meas_rad);
            let sum: Vector2<f64> =
                differences.map(|d| Vector2::new(math::cos(d), math::sin(d))).sum();
            sum.norm() / points as f64
        };
        let (along, against) = (coherence_with(1.0), coherence_with(-1.0));
        if against > along {
            circle.normal = -circle.normal;
        }
        let coherence = along.max(against);
        if coherence < COHERENCE_MIN || coherence.is_nan() {
            return refused(format!(
                "the sensor does not follow the base: their angles agree to {coherence:.2} (at least \
                 {COHERENCE_MIN:.2}, 1 is exact); is rotation_rad in rad, and is the needle in air?"
            ));
        }
        let (centre_sd_mm, axis_sd_rad) = circle.standard_errors(&angles);
        let mount = SensorMount::of(samples, &circle);
        if let Some(SensorMount { axis, .. }) = mount
            && axis.z < 0.0
        {
            return refused(format!(
                "the needle's axis is {:.0} deg from the sensor's own z axis (limit 90): is \
                 stage.rotation.sign right, or is the sensor mounted backwards?",
                axis.angle(&Vector3::z()).to_degrees()
            ));
        }
        if let Some(tilt_rad) = tilt(samples, &circle).filter(|_| mount.is_none())
            && tilt_rad.to_degrees() > TILT_MAX_DEG
        {
            return refused(format!(
                "the sensor's z axis is {:.0} deg from the needle's (limit {TILT_MAX_DEG:.0} without the sensor's \
                 roll): is stage.rotation.sign right, or is the sensor mounted backwards or across?",
                tilt_rad.to_degrees()
            ));
        }
        Ok(TipFit {
            points,
            radius_mm,
            rms_mm,
            arc_rad,
            centre_mm: circle.centre_mm,
            centre_sd_mm,
            axis_sd_rad,
            axis: circle.normal,
            mount,
        })
    }

    /// `X_SB`, the tip's pose in the sensor's frame, with the tip `along_mm` farther along the
    /// needle than the sensor. The rotation shows neither this distance nor the bevel's roll, which
    /// is set to zero. Without a mount the tip is assumed on the sensor's z axis.
    pub fn x_sb(&self, along_mm: f64) -> Pose {
        let (to_axis_mm, axis) = self
            .mount
            .map_or((Vector3::zeros(), Vector3::z()), |mount| (mount.to_axis_mm, mount.axis));
        // Rx(yaw) Ry(pitch) z = (sin pitch, −sin yaw cos pitch, cos yaw cos pitch).
        let angles = FixedAngles {
            yaw: math::atan2(-axis.y, axis.z),
            pitch: math::asin(axis.x.clamp(-1.0, 1.0)),
            roll: 0.0,
        };
        Pose { rotation: angles.to_rotation(), translation: to_axis_mm + axis * along_mm }
    }
}

/// The mean angle between the sensor's z axis and the needle's axis, rad; `None` unless every sample has an
/// orientation.
fn tilt(samples: &[TurnSample], circle: &Circle) -> Option<f64> {
    let along = samples
        .iter()
        .map(|sample| Some((sample.orientation_meas? * Vector3::z()).dot(&circle.normal)));
    let sum: f64 = along.sum::<Option<f64>>()?;
    Some(math::acos((sum / samples.len() as f64).clamp(-1.0, 1.0)))
}

fn refused<T>(reason: String) -> Result<T, String> {
    Err(format!("tip: {reason}"))
}

impl SensorMount {
    /// The axis in the sensor frame; `None` unless every sample has an orientation and all agree on
    /// the side of the axis. A sensor with five degrees of freedom does not measure its own roll,
    /// so its samples disagree.
    fn of(samples: &[TurnSample], circle: &Circle) -> Option<Self> {
        let (mut to_axis, mut axis) = (Vector3::zeros(), Vector3::zeros());
        for sample in samples {
            let to_sensor = sample.orientation_meas?.inverse();
            to_axis += to_sensor * (circle.centre_mm - sample.position_meas_mm);
            axis += to_sensor * circle.normal;
        }
        let n = samples.len() as f64;
        let axis_length = axis.norm() / n;
        let axis = axis.try_normalize(f64::MIN_POSITIVE)?;
        let to_axis_mm = to_axis / n;
        let across_mm = to_axis_mm - axis * axis.dot(&to_axis_mm);
        let is_seen = across_mm.norm() >= COHERENCE_MIN * circle.radius_mm;
        (axis_length >= COHERENCE_MIN && is_seen)
            .then_some(SensorMount { to_axis_mm: across_mm, axis })
    }
}

/// Gauss-Newton steps: a few suffice after the algebraic fit, and more cost nothing.
const STEPS: usize = 20;

/// A circle in space.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Circle {
    centre_mm: Vector3<f64>,
    /// Unit vector.
    normal: Vector3<f64>,
    radius_mm: f64,
    /// RMS distance of the points from the circle within its plane, mm.
    in_plane_rms_mm: f64,
    /// RMS distance of the points from its plane, mm.
    out_of_plane_rms_mm: f64,
}

impl Circle {
    /// Standard errors of a fit to points at `angles`: of the centre, mm, and of the normal, rad, each in
    /// the direction in which it is largest. The distances from the circle in its plane determine centre
    /// and radius, those from the plane its place and tilt.
    fn standard_errors(&self, angles: &[f64]) -> (f64, f64) {
        let rows =
            || angles.iter().map(|&angle| Vector3::new(math::cos(angle), math::sin(angle), 1.0));
        let normal: Matrix3<f64> = rows().map(|row| row * row.transpose()).sum();
        let variance_factor = normal.try_inverse().map_or(f64::INFINITY, |inverse| {
            let directions: Matrix2<f64> = inverse.fixed_view::<2, 2>(0, 0).into();
            directions.symmetric_eigenvalues().max().max(0.0)
        });
        let points = angles.len() as f64;
        let sd = |rms_mm: f64| rms_mm * (variance_factor * points / (points - 3.0)).sqrt();
        (sd(self.in_plane_rms_mm), sd(self.out_of_plane_rms_mm) / self.radius_mm)
    }

    /// The least-squares circle within the least-squares plane of the points; `None` if the points
    /// are on a line.
    fn fit(points_mm: &[Vector3<f64>]) -> Option<Circle> {
        let n = points_mm.len() as f64;
        let centroid_mm = mean(points_mm);
        let centred: Vec<Vector3<f64>> = points_mm.iter().map(|p| p - centroid_mm).collect();
        let (spread_mm, axes) = principal_axes(&centred);
        let flat: Vec<Vector2<f64>> = centred.iter().map(|d| axes.tr_mul(d).xy()).collect();
        let centre_mm = refine(algebraic(&flat)?, &flat);
        let distances_mm: Vec<f64> = flat.iter().map(|p| (p - centre_mm).norm()).collect();
        let radius_mm = distances_mm.iter().sum::<f64>() / n;
        let squares = distances_mm.iter().map(|d| (d - radius_mm).powi(2)).sum::<f64>();
        Some(Circle {
            centre_mm: centroid_mm + axes * centre_mm.push(0.0),
            normal: axes.column(2).into(),
            radius_mm,
            in_plane_rms_mm: (squares / n).sqrt(),
            out_of_plane_rms_mm: spread_mm[2],
        })
    }

    /// RMS distance of the points from the circle, mm.
    fn rms_mm(&self) -> f64 {
        math::hypot(self.in_plane_rms_mm, self.out_of_plane_rms_mm)
    }

    /// The angle of each point about the normal, from an arbitrary direction, rad.
    fn angles(&self, points_mm: &[Vector3<f64>]) -> Vec<f64> {
        // Any direction that is not close to the normal.
        let aside = Vector3::ith(self.normal.iamin(), 1.0);
        let u = self.normal.cross(&aside).normalize();
        let v = self.normal.cross(&u);
        let radial = points_mm.iter().map(|p| p - self.centre_mm);
        radial.map(|d| math::atan2(d.dot(&v), d.dot(&u))).collect()
    }
}

/// The least-squares solution of `row · x = value` for all rows; `None` if the rows do not determine it.
fn solve<const N: usize>(
    rows: impl Iterator<Item = (SVector<f64, N>, f64)>,
) -> Option<SVector<f64, N>> {
    let (mut normal, mut rhs) = (SMatrix::<f64, N, N>::zeros(), SVector::zeros());
    for (row, value) in rows {
        normal += row * row.transpose();
        rhs += row * value;
    }
    let solution = normal.try_inverse()? * rhs;
    solution.iter().all(|x| x.is_finite()).then_some(solution)
}

/// The centre by the linear least squares of `|p|² − 2 c·p + k = 0` (Kåsa 1976).
fn algebraic(points_mm: &[Vector2<f64>]) -> Option<Vector2<f64>> {
    let rows = points_mm.iter().map(|p| (Vector3::new(p.x, p.y, 1.0), p.norm_squared()));
    Some(solve(rows)?.xy() * 0.5)
}

/// The centre with the smallest sum of squared distances, by Gauss-Newton; the radius is the mean
/// distance. Noise biases algebraic fits inwards, and this fit much less.
fn refine(mut centre_mm: Vector2<f64>, points_mm: &[Vector2<f64>]) -> Vector2<f64> {
    let n = points_mm.len() as f64;
    for _ in 0..STEPS {
        let radial = points_mm.iter().map(|p| p - centre_mm);
        let directions: Vec<(Vector2<f64>, f64)> =
            radial.map(|d| (d / d.norm().max(f64::MIN_POSITIVE), d.norm())).collect();
        let mean = directions.iter().map(|(u, _)| u).sum::<Vector2<f64>>() / n;
        let radius_mm = directions.iter().map(|(_, d)| d).sum::<f64>() / n;
        let Some(step) = solve(directions.iter().map(|(u, d)| (u - mean, d - radius_mm))) else {
            break;
        };
        centre_mm += step;
    }
    centre_mm
}

/// The part of a turn that `angles` cover: all but the widest gap between neighbours, rad.
fn arc_of(angles: &[f64]) -> f64 {
    let mut sorted: Vec<f64> = angles.iter().map(|angle| angle.rem_euclid(TAU)).collect();
    sorted.sort_by(f64::total_cmp);
    let ends = sorted.first().zip(sorted.last());
    let around = ends.map_or(TAU, |(first, last)| first + TAU - last);
    let gaps = sorted.windows(2).map(|pair| pair[1] - pair[0]);
    TAU - gaps.fold(around, f64::max)
}

#[cfg(test)]
mod tests;
