//! A recorded insertion: what stage and tracker measured, and where the tip was.

use crate::geometry::so3;
use crate::table::Table;
use crate::units::wrap_angle;
use derive_more::Display;
use nalgebra::{Rotation3, Vector3};

/// The columns that a recording must have, in any order.
const REQUIRED: [&str; 5] = ["insertion_mm", "rotation_rad", "x_mm", "y_mm", "z_mm"];

/// Two orientations that differ by less than this count as the same, rad.
const SAME_MAX_RAD: f64 = 1e-3;
/// Once the base has turned by this much, rad, the orientations show whether they turn with it: no needle bends by
/// half of this angle, and no shaft twists by half of it.
const TURNED_RAD: f64 = 2.5;
/// Orientations turn with the base if they do so by at least this share of it, ...
const FOLLOWED_SHARE: f64 = 0.3;
/// ... and by at most this: no shaft turns the tip more than the base, and the noise of a small turn is averaged.
const FOLLOWED_MAX: f64 = 1.8;
/// ... and after a smaller turn by at least this, rad: a bend of 30 deg about a sensor tilted by 10 deg looks like a
/// roll of 5 deg.
const FOLLOWED_MIN_RAD: f64 = 0.12;

/// Largest change of the depth, mm, and of the base's rotation, rad, from one row to the next: more than the largest
/// `insertion.step_mm`, and less than a turn, so that an angle that wraps around is detected.
const STEP_MAX_MM: f64 = 12.0;
const TURN_MAX_RAD: f64 = 6.0;

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

/// The relation of a recording's orientations to the base's rotation about the needle's axis.
#[derive(Debug, Clone, Copy, PartialEq, Display)]
pub enum RecordedRoll {
    /// They do: they contain the roll.
    #[display("the orientations turn with the base")]
    Turns,
    /// They do not: they contain only the heading, or never change.
    #[display("the orientations do not turn with the base")]
    DoesNotTurn,
    /// The base turned by too little to show it.
    #[display(
        "the base turned by only {:.0} deg, so the orientations do not show whether they turn with it",
        base_rad.to_degrees()
    )]
    Unknown {
        /// The largest turn of the base from its start, rad.
        base_rad: f64,
    },
    /// They turn, but not as the base does.
    #[display(
        "the orientations turn by {share:.1} times the base; is rotation_rad in rad, and its sign right?"
    )]
    Otherwise {
        /// Turn of the orientations over that of the base, by least squares.
        share: f64,
    },
}

/// A recorded insertion.
#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    /// The rows, in the order recorded; at least one.
    pub rows: Vec<RecordedRow>,
}

/// Checks that the depth and rotation of each row are near those of the row before: one wrong value would also change
/// the rows after it.
///
/// # Errors
/// The first row that is not; the text names its line.
fn check_steps(rows: &[RecordedRow]) -> Result<(), String> {
    for (last, row) in rows.iter().zip(&rows[1..]) {
        for (name, step, max, hint) in [
            (
                "insertion_mm",
                row.insertion_meas_mm - last.insertion_meas_mm,
                STEP_MAX_MM,
                "is a digit wrong, or are rows missing?",
            ),
            (
                "rotation_rad",
                row.rotation_meas_rad - last.rotation_meas_rad,
                TURN_MAX_RAD,
                "does it start again after a turn? It must count on",
            ),
        ] {
            if step.abs() > max {
                let by = match step.abs() < 1e6 {
                    true => format!("{step:.2}"),
                    false => format!("{step:e}"),
                };
                return Err(format!(
                    "line {}: {name} changes by {by} from the row before (limit {max}): {hint}",
                    row.line
                ));
            }
        }
    }
    Ok(())
}

impl Recording {
    /// Reads a recording from CSV text with the columns `insertion_mm,rotation_rad,x_mm,y_mm,z_mm`
    /// and, all four or none, `qw,qx,qy,qz`, in any order.
    ///
    /// # Errors
    /// Those of [`Table`], a row that is far from the one before, both with the line, or a file without rows.
    pub fn parse(csv: &str) -> Result<Self, String> {
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
            true => Err("no rows below the header".to_owned()),
            false => check_steps(&rows).map(|()| Recording { rows }),
        }
    }

    /// Whether the orientations contain the roll; `None` if a row has no orientation, or there is only one. A sensor
    /// with five degrees of freedom measures only the heading, so its orientations do not turn with the base about
    /// the needle's axis. A tracker without orientations may send the same one in every row.
    ///
    /// The share is the slope of the sensor's roll over the base's turn, by least squares over all rows: it averages
    /// the noise, and a shaft that twists makes it smaller than 1.
    pub fn roll(&self) -> Option<RecordedRoll> {
        let first = &self.rows[0];
        let first_orientation = first.sensor_orientation.filter(|_| self.rows.len() > 1)?;
        let axis = self.axis();
        let (mut is_fixed, mut turn_rad, mut roll_rad) = (true, 0.0, 0.0);
        let (mut turns_rad, mut rolls_rad) = (vec![0.0], vec![0.0]);
        for (last, row) in self.rows.iter().zip(&self.rows[1..]) {
            let (before, now) = (last.sensor_orientation?, row.sensor_orientation?);
            is_fixed &= first_orientation.angle_to(&now) < SAME_MAX_RAD;
            // A change of heading is not a roll, however much the needle bends.
            roll_rad += so3::log(&(before.inverse() * now)).dot(&axis);
            rolls_rad.push(roll_rad);
            turn_rad += wrap_angle(row.rotation_meas_rad - last.rotation_meas_rad);
            turns_rad.push(turn_rad);
        }
        let largest =
            |angles: &[f64]| angles.iter().map(|a| wrap_angle(*a).abs()).fold(0.0, f64::max);
        let (base_rad, largest_rad) = (largest(&turns_rad), largest(&rolls_rad));
        let share = slope(&turns_rad, &rolls_rad);
        Some(match base_rad > TURNED_RAD {
            _ if is_fixed => RecordedRoll::DoesNotTurn,
            true if largest_rad < 0.5 * TURNED_RAD => RecordedRoll::DoesNotTurn,
            true if !(FOLLOWED_SHARE..=FOLLOWED_MAX).contains(&share) => {
                RecordedRoll::Otherwise { share }
            }
            true => RecordedRoll::Turns,
            false if share.abs() < FOLLOWED_SHARE || share.abs() * base_rad < FOLLOWED_MIN_RAD => {
                RecordedRoll::Unknown { base_rad }
            }
            false if !(0.0..=FOLLOWED_MAX).contains(&share) => RecordedRoll::Otherwise { share },
            false => RecordedRoll::Turns,
        })
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

/// The slope of `y` over `x` by least squares; 0 if `x` is constant.
fn slope(x: &[f64], y: &[f64]) -> f64 {
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let (mean_x, mean_y) = (mean(x), mean(y));
    let (mut square, mut product) = (0.0, 0.0);
    for (x, y) in x.iter().zip(y) {
        square += (x - mean_x).powi(2);
        product += (x - mean_x) * (y - mean_y);
    }
    if square > 0.0 { product / square } else { 0.0 }
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

    /// A needle that bends to one side, over `depth_mm`. `turned` gives the base's turn and the sensor's, rad, at a
    /// depth in mm. The sensor is tilted by `tilt_rad`.
    fn bent(depth_mm: u32, tilt_rad: f64, turned: impl Fn(f64) -> [f64; 2]) -> Recording {
        let row = |mm: u32| {
            let (mm, bend_rad) = (f64::from(mm), f64::from(mm) / 122.0);
            let [base_rad, sensor_rad] = turned(mm);
            let roll = Rotation3::from_axis_angle(&Vector3::z_axis(), sensor_rad);
            let bend = Rotation3::from_axis_angle(&Vector3::x_axis(), bend_rad);
            let tilt = Rotation3::from_axis_angle(&Vector3::y_axis(), tilt_rad);
            let (sin, cos) = bend_rad.sin_cos();
            RecordedRow {
                line: 1,
                insertion_meas_mm: mm,
                rotation_meas_rad: base_rad,
                position_meas_mm: 122.0 * Vector3::new(0.0, cos - 1.0, sin),
                sensor_orientation: Some(bend * roll * tilt),
            }
        };
        Recording { rows: (0..depth_mm).map(row).collect() }
    }

    /// The base turns by 20 degrees a mm, and the sensor by `turns` times that.
    #[test]
    fn orientations_that_do_not_turn_with_the_base_lack_roll() {
        let roll = |depth_mm: u32, turns: f64| {
            bent(depth_mm, 0.0, |mm| [0.35 * mm, turns * 0.35 * mm]).roll().unwrap()
        };
        for depth_mm in [100, 250] {
            assert_eq!(roll(depth_mm, 0.0), RecordedRoll::DoesNotTurn, "{depth_mm} mm");
            assert_eq!(roll(depth_mm, 1.0), RecordedRoll::Turns, "{depth_mm} mm");
        }
        // The sensor lacks half a radian of the turn.
        assert_eq!(roll(10, 0.85), RecordedRoll::Turns);
    }

    #[test]
    fn a_row_far_from_the_one_before_is_refused() {
        let rows = |depth_mm: f64, rotation_rad: f64| {
            let text = format!(
                "insertion_mm,rotation_rad,x_mm,y_mm,z_mm\n0,0,0,0,0\n1,0.5,0,0,1\n{depth_mm},{rotation_rad},0,0,2\n"
            );
            Recording::parse(&text).map(drop)
        };
        assert_eq!(rows(2.0, 1.0), Ok(()));
        assert_eq!(rows(6.0, -5.4), Ok(()));
        let spike = "line 4: insertion_mm changes by 19.00 from the row before (limit 12): is a digit wrong, or are rows \
                     missing?";
        assert_eq!(rows(20.0, 1.0), Err(spike.to_owned()));
        let turned = "line 4: rotation_rad changes by 6.28 from the row before (limit 6): does it start again after a \
                      turn? It must count on";
        assert_eq!(rows(2.0, 6.783), Err(turned.to_owned()));
        assert_eq!(rows(2.0, -5.783), Err(turned.replace("6.28", "-6.28")));
    }

    /// The base turns by 48 degrees and back, in 60 mm.
    #[test]
    fn after_a_small_turn_only_orientations_that_follow_it_have_roll() {
        let base_rad = |mm: f64| 0.84 * (mm * 0.1).sin();
        let unknown = |recording: Recording| match recording.roll() {
            Some(RecordedRoll::Unknown { base_rad }) => (base_rad - 0.84).abs() < 0.01,
            _ => false,
        };
        for tilt_rad in [0.0, 0.17, -0.17] {
            assert!(unknown(bent(60, tilt_rad, |mm| [base_rad(mm), 0.0])), "{tilt_rad}");
            // The bend grows with the base's turn.
            assert!(unknown(bent(60, tilt_rad, |mm| [0.84 * mm / 59.0, 0.0])), "{tilt_rad}");
            let rigid = bent(60, tilt_rad, |mm| [base_rad(mm), base_rad(mm)]);
            assert_eq!(rigid.roll(), Some(RecordedRoll::Turns), "{tilt_rad}");
            // The shaft holds back 10 degrees.
            let twisted = bent(60, tilt_rad, |mm| {
                let back_rad = 0.17 * (mm * 0.1).cos().signum();
                [base_rad(mm), if mm > 0.0 { base_rad(mm) - back_rad } else { 0.0 }]
            });
            assert_eq!(twisted.roll(), Some(RecordedRoll::Turns), "{tilt_rad}");
        }
        let still = bent(60, 0.1, |_| [0.0, 0.0]).roll();
        assert_eq!(still, Some(RecordedRoll::Unknown { base_rad: 0.0 }));
        let text = RecordedRoll::Unknown { base_rad: 0.84 }.to_string();
        assert_eq!(
            text,
            "the base turned by only 48 deg, so the orientations do not show whether they turn with it"
        );
    }

    #[test]
    fn refuses_by_line_and_column() {
        let message = |csv: &str| Recording::parse(csv).unwrap_err();
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
        assert_eq!(message(HEADER), "no rows below the header");
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
