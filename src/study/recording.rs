//! A recorded insertion: depth, rotation and positions, with the orientation for scoring.

use nalgebra::{Quaternion, Rotation3, UnitQuaternion, Vector3};
use thiserror::Error;

/// Columns a recording must have, in any order.
const REQUIRED: [&str; 5] = ["insertion_mm", "rotation_rad", "x_mm", "y_mm", "z_mm"];
/// Columns of the recorded orientation: all four or none.
const ORIENTATION: [&str; 4] = ["qw", "qx", "qy", "qz"];

/// One row of a recording, in the recording's own frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RecordedRow {
    /// Its line in the file, from 1.
    pub line: usize,
    /// Measured depth, mm.
    pub insertion_meas_mm: f64,
    /// Measured base rotation, rad.
    pub rotation_meas_rad: f64,
    /// Measured sensor position, mm.
    pub position_meas_mm: Vector3<f64>,
    /// Recorded sensor orientation: truth, for scoring only.
    pub rotation_true: Option<Rotation3<f64>>,
}

/// A recorded insertion.
#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    /// The rows, in the order recorded.
    pub rows: Vec<RecordedRow>,
}

/// Why a recording was refused.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum RecordingError {
    /// The header lacks a column.
    #[error(
        "no column \"{0}\"; a recording has insertion_mm,rotation_rad,x_mm,y_mm,z_mm and may have qw,qx,qy,qz"
    )]
    Column(&'static str),
    /// A field is missing, not a number, or not finite.
    #[error("line {line}: {column} is \"{field}\", expected a finite number")]
    Field {
        /// Line in the file, from 1.
        line: usize,
        /// The column.
        column: &'static str,
        /// The field's text.
        field: String,
    },
    /// A quaternion is zero, or too large to have a direction.
    #[error("line {line}: qw,qx,qy,qz have the norm {norm}: no orientation")]
    NoOrientation {
        /// Line in the file, from 1.
        line: usize,
        /// The quaternion's norm.
        norm: f64,
    },
    /// There are no rows.
    #[error("no rows below the header")]
    Empty,
}

impl Recording {
    /// Reads a recording from CSV text with a header line, with or without a byte order mark.
    ///
    /// # Errors
    /// [`RecordingError`], with the line.
    pub fn parse(csv: &str) -> Result<Self, RecordingError> {
        let mut lines = csv.trim_start_matches('\u{feff}').lines().enumerate();
        let header: Vec<&str> =
            lines.next().map_or("", |(_, line)| line).split(',').map(str::trim).collect();
        let column = |name: &'static str| header.iter().position(|&field| field == name);
        let mut required = [0; 5];
        for (at, name) in required.iter_mut().zip(REQUIRED) {
            *at = column(name).ok_or(RecordingError::Column(name))?;
        }
        let mut orientation = None;
        if ORIENTATION.iter().any(|name| column(name).is_some()) {
            let mut at = [0; 4];
            for (at, name) in at.iter_mut().zip(ORIENTATION) {
                *at = column(name).ok_or(RecordingError::Column(name))?;
            }
            orientation = Some(at);
        }
        let rows = lines
            .filter(|(_, line)| !line.trim().is_empty())
            .map(|(number, line)| {
                let fields: Vec<&str> = line.split(',').map(str::trim).collect();
                parse_row(number + 1, &fields, &required, orientation.as_ref())
            })
            .collect::<Result<Vec<_>, _>>()?;
        if rows.is_empty() { Err(RecordingError::Empty) } else { Ok(Recording { rows }) }
    }
}

fn parse_row(
    line: usize,
    fields: &[&str],
    required: &[usize; 5],
    orientation: Option<&[usize; 4]>,
) -> Result<RecordedRow, RecordingError> {
    let number = |at: usize, column: &'static str| {
        let field = fields.get(at).copied().unwrap_or_default();
        let value = field.parse().ok().filter(|value: &f64| value.is_finite());
        value.ok_or_else(|| RecordingError::Field { line, column, field: field.to_owned() })
    };
    let mut values = [0.0; 5];
    for ((value, &at), name) in values.iter_mut().zip(required).zip(REQUIRED) {
        *value = number(at, name)?;
    }
    let rotation_true = match orientation {
        None => None,
        Some(at) => {
            let mut q = [0.0; 4];
            for ((value, &at), name) in q.iter_mut().zip(at).zip(ORIENTATION) {
                *value = number(at, name)?;
            }
            let quaternion = Quaternion::new(q[0], q[1], q[2], q[3]);
            let norm = quaternion.norm();
            if !(norm.is_finite() && norm > 1e-6) {
                return Err(RecordingError::NoOrientation { line, norm });
            }
            Some(UnitQuaternion::new_normalize(quaternion).to_rotation_matrix())
        }
    };
    Ok(RecordedRow {
        line,
        insertion_meas_mm: values[0],
        rotation_meas_rad: values[1],
        position_meas_mm: Vector3::new(values[2], values[3], values[4]),
        rotation_true,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: &str = "insertion_mm,rotation_rad,x_mm,y_mm,z_mm";

    #[test]
    fn reads_with_and_without_orientation() {
        let plain = Recording::parse(&format!("{HEADER}\n1,0.5,1,2,3\n\n")).unwrap();
        assert_eq!(plain.rows.len(), 1);
        assert_eq!(plain.rows[0].rotation_true, None);
        assert_eq!(Recording::parse(&format!("\u{feff}{HEADER}\n1,0.5,1,2,3\n")).unwrap(), plain);
        let posed =
            Recording::parse(&format!("qw,qx,qy,qz,{HEADER}\n2,0,0,0,1,0.5,1,2,3")).unwrap();
        assert_eq!(posed.rows[0].rotation_true, Some(Rotation3::identity()));
        assert_eq!(posed.rows[0].position_meas_mm, Vector3::new(1.0, 2.0, 3.0));
    }

    #[test]
    fn refuses_by_line_and_column() {
        let message = |csv: &str| Recording::parse(csv).unwrap_err().to_string();
        assert!(message("insertion_mm,x_mm\n").contains("no column \"rotation_rad\""));
        assert!(message(&format!("{HEADER},qw\n")).contains("no column \"qx\""));
        assert_eq!(
            message(&format!("{HEADER}\n0,0,0,0,0\n1,NaN,0,0,0\n")),
            "line 3: rotation_rad is \"NaN\", expected a finite number"
        );
        assert_eq!(
            message(&format!("{HEADER}\n0,0,0,0\n")),
            "line 2: z_mm is \"\", expected a finite number"
        );
        assert_eq!(Recording::parse(HEADER), Err(RecordingError::Empty));
        assert_eq!(
            message(&format!("{HEADER},qw,qx,qy,qz\n0,0,0,0,0,0,0,0,0\n")),
            "line 2: qw,qx,qy,qz have the norm 0: no orientation"
        );
        assert_eq!(
            message(&format!("{HEADER},qw,qx,qy,qz\n0,0,0,0,0,1e308,0,0,0\n")),
            "line 2: qw,qx,qy,qz have the norm inf: no orientation"
        );
    }
}
