//! A recorded insertion: what stage and tracker measured, and where the tip was.

use crate::geometry::so3;
use crate::table::{Table, TableError};
use crate::units::wrap_angle;
use nalgebra::{Rotation3, Vector3};

/// The columns that a recording must have, in any order.
const REQUIRED: [&str; 5] = ["insertion_mm", "rotation_rad", "x_mm", "y_mm", "z_mm"];

/// Two orientations that differ by less are the same, rad.
const SAME_MAX_RAD: f64 = 1e-3;
/// Once the base has turned by this much, rad, the orientations show whether they turn with it: no needle bends by
/// half of this, and no shaft holds back half of it.
const TURNED_RAD: f64 = 2.5;

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
    /// Recorded sensor orientation. Scoring takes it for the truth; `calibrate needle` fits it.
    pub sensor_orientation: Option<Rotation3<f64>>,
}

/// A recorded insertion.
#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    /// The rows, in the order recorded; at least one.
    pub rows: Vec<RecordedRow>,
}

impl Recording {
    /// Reads a recording from CSV text with the columns `insertion_mm,rotation_rad,x_mm,y_mm,z_mm`
    /// and, all four or none, `qw,qx,qy,qz`, in any order.
    ///
    /// # Errors
    /// [`TableError`], with the line.
    pub fn parse(csv: &str) -> Result<Self, TableError> {
        let table = Table::parse(csv);
        let numbers = table.numbers(REQUIRED)?;
        let rows = table.rows().iter().zip(numbers).zip(table.rotations()?);
        let rows: Vec<RecordedRow> = rows
            .map(|((row, [insertion_mm, rotation_rad, x, y, z]), sensor_orientation)| RecordedRow {
                line: row.line,
                insertion_meas_mm: insertion_mm,
                rotation_meas_rad: rotation_rad,
                position_meas_mm: Vector3::new(x, y, z),
                sensor_orientation,
            })
            .collect();
        match rows.is_empty() {
            true => Err(TableError("no rows below the header".to_owned())),
            false => Ok(Recording { rows }),
        }
    }

    /// True if the orientations contain no roll. A sensor with five degrees of freedom measures only the heading,
    /// so its orientations do not turn with the base about the needle's axis. A tracker without orientations may
    /// send the same one in every row.
    pub fn lacks_roll(&self) -> bool {
        let first = &self.rows[0];
        let axis = self.axis();
        let (mut is_fixed, mut roll_rad, mut largest_rad, mut base_rad) =
            (true, 0.0, 0.0f64, 0.0f64);
        for (last, row) in self.rows.iter().zip(&self.rows[1..]) {
            let (Some(start), Some(before), Some(now)) =
                (first.sensor_orientation, last.sensor_orientation, row.sensor_orientation)
            else {
                return false;
            };
            is_fixed &= start.angle_to(&now) < SAME_MAX_RAD;
            // A change of heading is no roll, however large the needle's bend makes it.
            roll_rad += so3::log(&(before.inverse() * now)).dot(&axis);
            largest_rad = largest_rad.max(wrap_angle(roll_rad).abs());
            let turn_rad = row.rotation_meas_rad - first.rotation_meas_rad;
            base_rad = base_rad.max(wrap_angle(turn_rad).abs());
        }
        let is_without = base_rad > TURNED_RAD && largest_rad < 0.5 * TURNED_RAD;
        self.rows.len() > 1 && (is_fixed || is_without)
    }

    /// The needle's axis in the sensor's frame: the mean direction of its motion there; zero if it does not move.
    fn axis(&self) -> Vector3<f64> {
        let steps = self.rows.iter().zip(&self.rows[1..]);
        let steps = steps.filter_map(|(last, row)| {
            let way_mm = row.position_meas_mm - last.position_meas_mm;
            Some(last.sensor_orientation?.inverse() * way_mm)
        });
        steps.sum::<Vector3<f64>>().try_normalize(f64::MIN_POSITIVE).unwrap_or_default()
    }

    /// True if `other` has the same rows; their line numbers may differ.
    pub fn is_same(&self, other: &Recording) -> bool {
        let is_same =
            |(a, b): (&RecordedRow, &RecordedRow)| RecordedRow { line: b.line, ..*a } == *b;
        self.rows.len() == other.rows.len() && self.rows.iter().zip(&other.rows).all(is_same)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: &str = "insertion_mm,rotation_rad,x_mm,y_mm,z_mm";

    #[test]
    fn reads_with_and_without_orientation() {
        let plain = Recording::parse(&format!("{HEADER}\n1,0.5,1,2,3\n\n")).unwrap();
        assert_eq!(plain.rows.len(), 1);
        assert_eq!(plain.rows[0].sensor_orientation, None);
        assert_eq!(Recording::parse(&format!("\u{feff}{HEADER}\n1,0.5,1,2,3\n")).unwrap(), plain);
        let posed =
            Recording::parse(&format!("qw,qx,qy,qz,{HEADER}\n2,0,0,0,1,0.5,1,2,3")).unwrap();
        assert_eq!(posed.rows[0].sensor_orientation, Some(Rotation3::identity()));
        assert_eq!(posed.rows[0].position_meas_mm, Vector3::new(1.0, 2.0, 3.0));
    }

    /// The base turns by 20 degrees a mm, and the sensor by `turns` times that; the needle bends to one side.
    #[test]
    fn orientations_that_do_not_turn_with_the_base_lack_roll() {
        let recording = |depth_mm: u32, turns: f64| {
            let row = |mm: u32| {
                let (mm, bend_rad) = (f64::from(mm), f64::from(mm) / 122.0);
                let roll = Rotation3::from_axis_angle(&Vector3::z_axis(), turns * 0.35 * mm);
                let bend = Rotation3::from_axis_angle(&Vector3::x_axis(), bend_rad);
                let (sin, cos) = bend_rad.sin_cos();
                RecordedRow {
                    line: 1,
                    insertion_meas_mm: mm,
                    rotation_meas_rad: 0.35 * mm,
                    position_meas_mm: 122.0 * Vector3::new(0.0, cos - 1.0, sin),
                    sensor_orientation: Some(bend * roll),
                }
            };
            Recording { rows: (0..depth_mm).map(row).collect() }
        };
        for depth_mm in [100, 250] {
            assert!(recording(depth_mm, 0.0).lacks_roll(), "{depth_mm} mm");
            assert!(!recording(depth_mm, 1.0).lacks_roll(), "{depth_mm} mm");
        }
        // The base has turned by too little to see it.
        assert!(!recording(7, 0.0).lacks_roll());
        // The sensor lacks half a radian of the turn.
        assert!(!recording(10, 0.85).lacks_roll());
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
            "line 2: 4 fields where the header has 5"
        );
        let empty = TableError("no rows below the header".to_owned());
        assert_eq!(Recording::parse(HEADER), Err(empty));
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
