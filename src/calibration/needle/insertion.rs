//! A recorded insertion as the fits need it: depth, rotations of base and tip, positions.

use super::needle_error;
use crate::geometry::so3;
use crate::math;
use crate::needle::Increment;
use nalgebra::{Matrix2, Matrix3, Rotation3, Vector2, Vector3};

/// Shorter insertions are refused, mm.
const DEPTH_MIN_MM: f64 = 20.0;
/// Rotations are compared over this much depth, mm.
const SPACING_MM: f64 = 1.0;
/// Rotations above this depth, mm, do not count: so close to the surface the tissue does not yet hold the needle.
pub(super) const ENTRY_MM: f64 = 3.0;
/// The tip must turn back and forth by this much, RMS, rad/mm, to show its axis.
const TURN_MIN_RAD_PER_MM: f64 = 0.05;

/// The heading is compared with chords of this length, mm.
const CHORD_MM: f64 = 10.0;
/// The mean angle between heading and chord may be this large, deg: 59 insertions of a real needle have up to 3.6, and
/// orientations whose frame is turned by 15 deg have 12 to 15.
const HEADING_OFF_MAX_DEG: f64 = 10.0;

/// One row of an insertion recorded with orientations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PosedRow {
    /// Its line in the file, from 1.
    pub line: usize,
    /// Measured depth, mm.
    pub insertion_mm: f64,
    /// Measured base rotation, rad.
    pub rotation_rad: f64,
    /// Measured sensor position, mm, in any frame.
    pub position_mm: Vector3<f64>,
    /// Measured sensor orientation, in the same frame.
    pub orientation: Rotation3<f64>,
}

/// The shaft's axis in the sensor frame S: the one about which the tip rolls.
///
/// While the base turns by `w_z` a mm the sensor turns by `w = k + w_z (a_x, a_y, 1)`: k is the
/// bend, `(a_x, a_y, 1)` the axis. Least squares over all insertions.
pub(super) fn shaft_axis(insertions: &[Vec<PosedRow>]) -> Result<Vector3<f64>, String> {
    let (mut normal, mut sum_x, mut sum_y) = (Matrix2::zeros(), Vector2::zeros(), Vector2::zeros());
    for rows in insertions {
        let Some(first) = rows.first() else { continue };
        let mut last = first;
        for row in rows {
            let deeper_mm = row.insertion_mm - last.insertion_mm;
            if deeper_mm < SPACING_MM {
                continue;
            }
            if last.insertion_mm - first.insertion_mm > ENTRY_MM {
                let w = so3::log(&(last.orientation.inverse() * row.orientation)) / deeper_mm;
                let regressor = Vector2::new(1.0, w.z);
                normal += regressor * regressor.transpose();
                sum_x += regressor * w.x;
                sum_y += regressor * w.y;
            }
            last = row;
        }
    }
    let count = normal[(0, 0)];
    if count == 0.0 {
        return Err(needle_error(format!(
            "no insertion goes on for {SPACING_MM:.0} mm below {ENTRY_MM:.0} mm; is insertion_mm in mm?"
        )));
    }
    let variance = (normal[(1, 1)] - normal[(0, 1)].powi(2) / count) / count;
    let rms_rad_per_mm = variance.max(0.0).sqrt();
    let inverse = normal.try_inverse().filter(|_| rms_rad_per_mm >= TURN_MIN_RAD_PER_MM);
    let Some(inverse) = inverse else {
        return Err(needle_error(format!(
            "the tip turns back and forth by {rms_rad_per_mm:.3} rad/mm RMS, at least \
             {TURN_MIN_RAD_PER_MM} needed to find its axis; turn the base both ways while inserting"
        )));
    };
    Ok(Vector3::new((inverse * sum_x).y, (inverse * sum_y).y, 1.0).normalize())
}

/// The motion since the row before, and the sensor's position after it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Step {
    /// Insertion and rotation of the base.
    pub(super) base: Increment,
    /// Rotation of the tip about the shaft's axis, rad.
    pub(super) tip_turn_rad: f64,
    /// Position in the shaft frame A of the first row, whose z axis is the shaft's axis, mm.
    pub(super) position_mm: Vector3<f64>,
}

/// An insertion in the shaft frame.
#[derive(Debug, Clone)]
pub(super) struct RecordedInsertion {
    pub(super) steps: Vec<Step>,
}

impl RecordedInsertion {
    /// The insertion `name` with these rows; `r_sa` is the shaft frame A in the sensor frame.
    pub(super) fn of(name: &str, rows: &[PosedRow], r_sa: &Rotation3<f64>) -> Result<Self, String> {
        let too_short = |depth_mm: f64| {
            needle_error(format!(
                "{name} is {depth_mm:.1} mm deep, at least {DEPTH_MIN_MM:.0} needed; \
                 leave it out"
            ))
        };
        let first = rows.first().ok_or_else(|| too_short(0.0))?;
        let (mut last, mut depth_mm) = (first, 0.0f64);
        let axis = r_sa * Vector3::z();
        let heading_off_deg = heading_off_rad(rows, &axis).to_degrees();
        if heading_off_deg > HEADING_OFF_MAX_DEG {
            return Err(needle_error(format!(
                "{name} points {heading_off_deg:.0} deg off its path (limit {HEADING_OFF_MAX_DEG:.0}): are orientations in \
                 the frame of the positions, is no axis mirrored or exchanged, and tracker.tip_offset_mm right?"
            )));
        }
        // R_AS of the first row times R_SO: from the recording's frame O to A.
        let r_ao = r_sa.inverse() * first.orientation.inverse();
        let mut steps = Vec::with_capacity(rows.len());
        for row in rows {
            // When an encoder steps back, no tissue is cut.
            let deeper_mm = (row.insertion_mm - first.insertion_mm - depth_mm).max(0.0);
            depth_mm += deeper_mm;
            let turn = so3::log(&(last.orientation.inverse() * row.orientation));
            steps.push(Step {
                base: Increment::new(deeper_mm, row.rotation_rad - last.rotation_rad)
                    .map_err(|error| needle_error(format!("{name}, line {}: {error}", row.line)))?,
                tip_turn_rad: turn.dot(&axis),
                position_mm: r_ao * (row.position_mm - first.position_mm),
            });
            last = row;
        }
        if depth_mm >= DEPTH_MIN_MM {
            Ok(RecordedInsertion { steps })
        } else {
            Err(too_short(depth_mm))
        }
    }
}

/// The angle between the shaft's heading and the chords of the path, rad, from the sum of their cross products: turns
/// and scatter of the tip cancel. Zero for an insertion shorter than a chord.
fn heading_off_rad(rows: &[PosedRow], axis: &Vector3<f64>) -> f64 {
    let (mut cross, mut dot, mut first) = (Vector3::zeros(), 0.0, 0);
    for (index, row) in rows.iter().enumerate() {
        if row.insertion_mm - rows[first].insertion_mm < CHORD_MM {
            continue;
        }
        let along: Vector3<f64> =
            rows[first..=index].iter().map(|row| row.orientation * axis).sum();
        let chord = row.position_mm - rows[first].position_mm;
        let (Some(along), Some(chord)) = (along.try_normalize(0.0), chord.try_normalize(0.0))
        else {
            continue;
        };
        cross += along.cross(&chord);
        dot += along.dot(&chord);
        first = index;
    }
    math::atan2(cross.norm(), dot)
}

/// `R_SA`: the frame with z along `axis` and x as close as possible to the sensor's x axis.
pub(super) fn shaft_frame(axis: &Vector3<f64>) -> Rotation3<f64> {
    let y = axis.cross(&Vector3::x()).normalize();
    Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[y.cross(axis), y, *axis]))
}
