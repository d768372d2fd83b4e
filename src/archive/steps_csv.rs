//! `steps.csv`: one row a step, in the plane frame.

use crate::emulator::Truth;
use crate::geometry::{FixedAngles, Pose, coordinates};
use crate::plan::Path;
use crate::session::{Approach, StepRecord};
use crate::units::Time;
use nalgebra::Vector3;
use std::fmt;

/// A row of `steps.csv`.
///
/// Its text has no newline. Numbers are printed with the fewest digits that read back as the same `f64`.
/// Unknown values are empty. NaN and infinity, which should not occur, are printed as `NaN`, `inf`, `-inf`.
pub struct StepRow<'a> {
    step: &'a StepRecord,
    approach: Option<&'a Approach>,
    estimate: Option<[f64; 6]>,
    sd: Option<[f64; 6]>,
    truth: Option<[f64; 6]>,
    target_true: Option<Vector3<f64>>,
}

impl<'a> StepRow<'a> {
    /// The row of `step`, with the truth in an emulated run.
    pub fn new(step: &'a StepRecord, truth: Option<&Truth>) -> Self {
        StepRow {
            step,
            approach: step.decision.approach.as_ref(),
            estimate: step.decision.estimate.map(|e| coordinates(&e.x_pb)),
            sd: step.decision.estimate.and_then(|e| e.sd),
            truth: truth.map(|t| coordinates(&t.x_pb)),
            target_true: truth.and_then(|t| t.target_mm),
        }
    }
}

/// A column: its name, and its value in a row; `None` if it is unknown.
pub type StepColumn = (&'static str, fn(&StepRow<'_>) -> Option<f64>);

/// Columns of whole numbers.
const COUNTS: [&str; 2] = ["step", "tip_positions"];

/// The columns of `steps.csv`. Scripts rely on them: add columns at the end, and never rename or move one.
/// A column that is added here appears in `run.rrd` too, with angles in degrees.
pub const STEP_COLUMNS: [StepColumn; 39] = [
    ("step", |c| Some(c.step.step.into())),
    // The quotient is the f64 nearest to the decimal number; a product with 1e-9 may not be.
    ("time_s", |c| Some(c.step.time.as_nanos() as f64 / 1e9)),
    ("insertion_mm", |c| Some(c.step.insertion_meas_mm)),
    ("rotation_rad", |c| Some(c.step.rotation_meas_rad)),
    ("rotation_cmd_rad_per_mm", |c| c.step.decision.rotation_cmd_rad_per_mm),
    ("x_meas_mm", |c| c.step.tip_meas_mm.map(|p| p.x)),
    ("y_meas_mm", |c| c.step.tip_meas_mm.map(|p| p.y)),
    ("z_meas_mm", |c| c.step.tip_meas_mm.map(|p| p.z)),
    ("x_est_mm", |c| c.estimate.map(|e| e[0])),
    ("y_est_mm", |c| c.estimate.map(|e| e[1])),
    ("z_est_mm", |c| c.estimate.map(|e| e[2])),
    ("yaw_est_rad", |c| c.estimate.map(|e| e[3])),
    ("pitch_est_rad", |c| c.estimate.map(|e| e[4])),
    ("roll_est_rad", |c| c.estimate.map(|e| e[5])),
    ("x_sd_mm", |c| c.sd.map(|sd| sd[0])),
    ("y_sd_mm", |c| c.sd.map(|sd| sd[1])),
    ("z_sd_mm", |c| c.sd.map(|sd| sd[2])),
    ("yaw_sd_rad", |c| c.sd.map(|sd| sd[3])),
    ("pitch_sd_rad", |c| c.sd.map(|sd| sd[4])),
    ("roll_sd_rad", |c| c.sd.map(|sd| sd[5])),
    ("x_true_mm", |c| c.truth.map(|t| t[0])),
    ("y_true_mm", |c| c.truth.map(|t| t[1])),
    ("z_true_mm", |c| c.truth.map(|t| t[2])),
    ("yaw_true_rad", |c| c.truth.map(|t| t[3])),
    ("pitch_true_rad", |c| c.truth.map(|t| t[4])),
    ("roll_true_rad", |c| c.truth.map(|t| t[5])),
    ("tip_positions", |c| Some(c.step.tip_positions.into())),
    ("target_distance_mm", |c| c.approach.map(|a| a.distance_mm)),
    ("target_error_pred_mm", |c| c.approach.map(|a| a.error_mm)),
    ("path_left_mm", |c| c.approach.and_then(|a| a.path.as_ref()).map(Path::length_mm)),
    ("target_x_mm", |c| c.approach.map(|a| a.target_mm.x)),
    ("target_y_mm", |c| c.approach.map(|a| a.target_mm.y)),
    ("target_z_mm", |c| c.approach.map(|a| a.target_mm.z)),
    ("target_x_true_mm", |c| c.target_true.map(|p| p.x)),
    ("target_y_true_mm", |c| c.target_true.map(|p| p.y)),
    ("target_z_true_mm", |c| c.target_true.map(|p| p.z)),
    ("tip_meas_insertion_mm", |c| c.step.tip_meas_insertion_mm),
    ("target_error_pred_sd_mm", |c| c.approach?.error_sd_mm),
    ("curvature_est_per_mm", |c| Some(c.step.decision.estimate?.belief?.curvature_per_mm)),
];

/// The first line of `steps.csv`, without its newline.
pub fn steps_csv_header() -> String {
    STEP_COLUMNS.map(|(name, _)| name).join(",")
}

impl fmt::Display for StepRow<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        STEP_COLUMNS.iter().enumerate().try_for_each(|(n, (name, value))| {
            let comma = if n == 0 { "" } else { "," };
            match value(self) {
                Some(count) if COUNTS.contains(name) => write!(f, "{comma}{count}"),
                // Adding zero turns the −0 of an angle into 0.
                Some(number) => write!(f, "{comma}{:?}", number + 0.0),
                None => f.write_str(comma),
            }
        })
    }
}

/// The columns of a recorded `steps.csv`, to find values in its rows. Rows stay text, so that a replay can
/// compare them exactly.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RecordedColumns(pub Vec<String>);

impl RecordedColumns {
    /// The columns that the file's first line names.
    pub fn of(header: &str) -> Self {
        RecordedColumns(header.split(',').map(str::to_owned).collect())
    }

    /// The value of `column` in `row`; `None` if there is none or it is not a number.
    pub fn value(&self, row: &str, column: &str) -> Option<f64> {
        let position = self.0.iter().position(|name| name == column)?;
        row.split(',').nth(position)?.parse().ok()
    }

    /// The time of the step in `row`.
    pub fn time(&self, row: &str) -> Option<Time> {
        let time_s = self.value(row, "time_s")?;
        Some(Time::from_nanos((time_s * 1e9).round() as i64))
    }

    /// The truth in `row`; `None` if it is not recorded.
    pub fn truth(&self, row: &str) -> Option<Truth> {
        let value = |name: &str| self.value(row, name);
        let (yaw, pitch, roll) =
            (value("yaw_true_rad")?, value("pitch_true_rad")?, value("roll_true_rad")?);
        let translation =
            Vector3::new(value("x_true_mm")?, value("y_true_mm")?, value("z_true_mm")?);
        let rotation = FixedAngles { yaw, pitch, roll }.to_rotation();
        let target = ["x", "y", "z"].map(|axis| value(&format!("target_{axis}_true_mm")));
        let target_mm = match target {
            [Some(x), Some(y), Some(z)] => Some(Vector3::new(x, y, z)),
            _ => None,
        };
        Some(Truth { x_pb: Pose { rotation, translation }, target_mm })
    }
}

/// True for a column of `steps.csv` that holds the truth of an emulated run.
pub fn is_truth_column(column: &str) -> bool {
    column.contains("_true_")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::observer::{Belief, Estimate, Shaft};
    use crate::session::Decision;
    use nalgebra::Rotation3;

    fn step() -> StepRecord {
        StepRecord {
            step: 7,
            time: Time::from_nanos(7_300_000_000),
            insertion_meas_mm: 7.001,
            rotation_meas_rad: -0.1,
            ..StepRecord::default()
        }
    }

    /// Do not edit: scripts outside read this header.
    #[test]
    fn header_is_frozen() {
        assert_eq!(
            steps_csv_header(),
            "step,time_s,insertion_mm,rotation_rad,rotation_cmd_rad_per_mm,x_meas_mm,y_meas_mm,z_meas_mm,x_est_mm,y_est_mm,z_est_mm,yaw_est_rad,pitch_est_rad,roll_est_rad,x_sd_mm,y_sd_mm,z_sd_mm,yaw_sd_rad,pitch_sd_rad,roll_sd_rad,x_true_mm,y_true_mm,z_true_mm,yaw_true_rad,pitch_true_rad,roll_true_rad,tip_positions,target_distance_mm,target_error_pred_mm,path_left_mm,target_x_mm,target_y_mm,target_z_mm,target_x_true_mm,target_y_true_mm,target_z_true_mm,tip_meas_insertion_mm,target_error_pred_sd_mm,curvature_est_per_mm"
        );
    }

    #[test]
    fn unknown_values_are_empty() {
        let row = StepRow::new(&step(), None).to_string();
        assert_eq!(row, format!("7,7.3,7.001,-0.1{},0{}", ",".repeat(22), ",".repeat(12)));
    }

    #[test]
    fn a_full_row_is_frozen() {
        let angles = FixedAngles { yaw: 0.0, pitch: 0.5, roll: 0.0 };
        let pose = |x: f64, rotation| Pose { rotation, translation: Vector3::new(x, -2.0, 1e-9) };
        let full = StepRecord {
            tip_positions: 1,
            tip_meas_insertion_mm: Some(6.75),
            tip_meas_mm: Some(Vector3::new(1.5, f64::NAN, f64::NEG_INFINITY)),
            decision: Decision {
                rotation_cmd_rad_per_mm: Some(0.1 + 0.2),
                estimate: Some(Estimate {
                    x_pb: pose(1.25, Rotation3::identity()),
                    sd: Some([0.5, 0.5, 0.5, 0.125, 0.125, 3.0]),
                    belief: Some(Belief::certain(0.0125, Shaft::RIGID)),
                }),
                approach: Some(Approach {
                    target_mm: Vector3::new(0.0, 8.0, 90.5),
                    distance_mm: 3.5,
                    clearance_mm: 2.0,
                    error_mm: 0.25,
                    error_sd_mm: Some(0.75),
                    path: None,
                }),
                ..Decision::default()
            },
            ..step()
        };
        let target_mm = Some(Vector3::new(0.0, 8.5, 90.5));
        let truth = Truth { x_pb: pose(1.0, angles.to_rotation()), target_mm };
        assert_eq!(
            StepRow::new(&full, Some(&truth)).to_string(),
            "7,7.3,7.001,-0.1,0.30000000000000004,1.5,NaN,-inf,1.25,-2.0,1e-9,0.0,0.0,0.0,\
             0.5,0.5,0.5,0.125,0.125,3.0,1.0,-2.0,1e-9,0.0,0.5,0.0,1,3.5,0.25,,0.0,8.0,90.5,0.0,8.5,90.5,6.75,0.75,0.0125"
        );
    }

    #[test]
    fn rows_are_read_back_with_their_truth() {
        let angles = FixedAngles { yaw: 0.25, pitch: 0.5, roll: -3.0 };
        let pose =
            Pose { rotation: angles.to_rotation(), translation: Vector3::new(1.0, 2.0, 3.0) };
        let truth = Truth { x_pb: pose, target_mm: Some(Vector3::new(0.0, 8.5, 90.5)) };
        let rows = [Some(&truth), None].map(|truth| StepRow::new(&step(), truth).to_string());
        let columns = RecordedColumns::of(&steps_csv_header());
        assert_eq!(columns.time(&rows[0]), Some(step().time));
        let read = columns.truth(&rows[0]).expect("a truth");
        assert!((read.x_pb.rotation.matrix() - pose.rotation.matrix()).norm() < 1e-14);
        assert_eq!(read.x_pb.translation, pose.translation);
        assert_eq!(read.target_mm, truth.target_mm);
        assert_eq!(columns.truth(&rows[1]), None);
        assert_eq!(columns.0.iter().filter(|column| is_truth_column(column)).count(), 9);
    }
}
