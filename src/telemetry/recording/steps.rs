//! The tables of the steps: state, bounds, errors, command and measurement.

use super::table::Table;
use crate::archive::{STEP_COLUMNS, StepCells, StepColumn, coordinates, is_of_truth};
use crate::emulator::Truth;
use crate::observer::Estimate;
use crate::session::StepRecord;
use crate::telemetry::Scene;
use crate::units::wrap_angle;
use rerun::{RecordingStream, RecordingStreamResult};
use std::collections::BTreeMap;

/// The table of the steps.
pub(super) const STEPS: &str = "steps";
/// The tables of the observers that run alongside, by name.
pub(super) const SHADOWS: &str = "shadows";

/// Names of the six coordinates, with the unit in which a reader sees them.
pub(super) const COORDINATES: [(&str, &str); 6] =
    [("x", "mm"), ("y", "mm"), ("z", "mm"), ("yaw", "deg"), ("pitch", "deg"), ("roll", "deg")];
/// The coordinates that tell how far the tip is from the plane and where it turns.
pub(super) const REDUCED: [usize; 3] = [0, 4, 5];
const ROLL: usize = 5;
const UNKNOWN: [f64; 6] = [f64::NAN; 6];

/// The column of coordinate `n` with this provenance: `x_est_mm`.
pub(super) fn column(n: usize, provenance: &str) -> String {
    let (name, unit) = COORDINATES[n];
    format!("{name}_{provenance}_{unit}")
}

fn columns(of: impl IntoIterator<Item = usize>, provenance: &str) -> Vec<String> {
    of.into_iter().map(|n| column(n, provenance)).collect()
}

/// The columns of `steps.csv` that the table has, too: not where and when the step was, and the truth
/// where there is one.
fn recorded(truth: bool) -> impl Iterator<Item = &'static StepColumn> {
    let elsewhere = ["step", "time_s", "insertion_mm", "rotation_rad"];
    let columns = STEP_COLUMNS.iter().filter(move |(name, _)| !elsewhere.contains(name));
    columns.filter(move |(name, _)| truth || !is_of_truth(name))
}

/// The name of a column of `steps.csv` here: angles are in degrees.
fn shown_name(name: &str) -> String {
    name.replace("_rad", "_deg")
}

/// Logs records of steps as rows.
pub(super) struct Steps {
    table: Table,
    shadows: BTreeMap<String, Table>,
    truth: bool,
    roll_shown_rad: f64,
}

impl Steps {
    pub(super) fn new(scene: &Scene) -> Self {
        let truth = |provenance| if scene.truth { columns(0..6, provenance) } else { Vec::new() };
        let names = [
            recorded(scene.truth).map(|(name, _)| shown_name(name)).collect(),
            columns(REDUCED, "low"),
            columns(REDUCED, "high"),
            columns(0..3, "innovation"),
            vec!["tip_meas_age_ms".to_owned()],
            truth("error"),
        ];
        let shadow = |name: &String| {
            let names = [columns(0..6, "est"), truth("error")].concat();
            (name.clone(), Table::new(&format!("{SHADOWS}/{name}"), names))
        };
        Steps {
            table: Table::new(STEPS, names.concat()),
            shadows: scene.shadows.iter().map(shadow).collect(),
            truth: scene.truth,
            roll_shown_rad: 0.0,
        }
    }

    pub(super) fn log(
        &mut self,
        stream: &RecordingStream,
        step: &StepRecord,
        known_truth: Option<&Truth>,
    ) -> RecordingStreamResult<()> {
        let truth = known_truth.map_or(UNKNOWN, |t| coordinates(t.x_pb()));
        let error_of = |estimate: [f64; 6]| in_degrees(error(estimate, truth));
        let estimate = step.estimate.as_ref().map_or(UNKNOWN, coordinates_of);
        let errors = error_of(estimate);
        let mut estimate = estimate;
        self.unwrap_roll(&mut estimate);
        let mut truth_shown = truth;
        self.unwrap_roll(&mut truth_shown);
        for (name, shadow) in &step.shadows {
            if let Some(table) = self.shadows.get_mut(name) {
                let estimate = shadow.as_ref().map_or(UNKNOWN, coordinates_of);
                let mut shown = estimate;
                shown[ROLL] = near(shown[ROLL], self.roll_shown_rad);
                let mut row = in_degrees(shown).to_vec();
                if self.truth {
                    row.extend(error_of(estimate));
                }
                table.log(stream, &row)?;
            }
        }
        let sd = in_degrees(step.estimate.and_then(|e| e.sd).unwrap_or(UNKNOWN));
        let cells = StepCells::new(step, known_truth);
        let mut row = Vec::with_capacity(64);
        row.extend(recorded(self.truth).map(|(name, value)| match *name {
            "roll_est_rad" => estimate[ROLL].to_degrees(),
            "roll_true_rad" => truth_shown[ROLL].to_degrees(),
            name if name.contains("_rad") => value(&cells).value().to_degrees(),
            _ => value(&cells).value(),
        }));
        let estimate = in_degrees(estimate);
        row.extend(REDUCED.map(|n| estimate[n] - 2.0 * sd[n]));
        row.extend(REDUCED.map(|n| estimate[n] + 2.0 * sd[n]));
        row.extend(step.innovation_mm.map_or([f64::NAN; 3], Into::into));
        row.push(step.tip_meas_age_s.map_or(f64::NAN, |age_s| age_s * 1e3));
        if self.truth {
            row.extend(errors);
        }
        self.table.log(stream, &row)
    }

    /// Roll is shown without the jump at ±180°: the estimate goes on from where it was shown
    /// last, and the truth and the other observers stand beside it.
    fn unwrap_roll(&mut self, coordinates: &mut [f64; 6]) {
        let roll = &mut coordinates[ROLL];
        if roll.is_finite() {
            *roll = near(*roll, self.roll_shown_rad);
            self.roll_shown_rad = *roll;
        }
    }
}

/// The angle that is `angle_rad`, by whole turns as near to `shown_rad` as can be.
fn near(angle_rad: f64, shown_rad: f64) -> f64 {
    shown_rad + wrap_angle(angle_rad - shown_rad)
}

fn coordinates_of(estimate: &Estimate) -> [f64; 6] {
    coordinates(&estimate.x_pb)
}

/// Coordinates as a reader sees them: mm and degrees.
fn in_degrees(coordinates: [f64; 6]) -> [f64; 6] {
    std::array::from_fn(|n| if n < 3 { coordinates[n] } else { coordinates[n].to_degrees() })
}

/// Estimate minus truth, mm and rad, angles in (−π, π].
fn error(estimate: [f64; 6], truth: [f64; 6]) -> [f64; 6] {
    std::array::from_fn(|n| {
        let difference = estimate[n] - truth[n];
        if n < 3 || !difference.is_finite() { difference } else { wrap_angle(difference) }
    })
}
