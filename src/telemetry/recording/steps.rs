//! The tables of the steps: state, bounds, errors, command and measurement (`steps`), and the estimates of the
//! observers that run alongside (`shadows/NAME`).

use super::{Logged, log_row};
use crate::archive::{STEP_COLUMNS, StepRow, is_truth_column};
use crate::emulator::Truth;
use crate::geometry::coordinates;
use crate::observer::Estimate;
use crate::plan::Path;
use crate::session::{Decision, StepRecord};
use crate::units::wrap_angle;
use rerun::RecordingStream;

/// The six coordinates, each with the unit in which it is shown.
const COORDINATES: [(&str, &str); 6] =
    [("x", "mm"), ("y", "mm"), ("z", "mm"), ("yaw", "deg"), ("pitch", "deg"), ("roll", "deg")];
/// Indices of the reduced coordinates x, pitch and roll: those that matter for the plane.
const REDUCED: [usize; 3] = [0, 4, ROLL];
const ROLL: usize = 5;
const UNKNOWN: [f64; 6] = [f64::NAN; 6];

/// The column of coordinate `n` with this provenance: `x_est_mm`.
fn column(n: usize, provenance: &str) -> String {
    let (name, unit) = COORDINATES[n];
    format!("{name}_{provenance}_{unit}")
}

/// Columns of `steps.csv` that are in other tables or time lines.
const ELSEWHERE: [&str; 4] = ["step", "time_s", "insertion_mm", "rotation_rad"];

/// Logs records of steps as rows.
#[derive(Default)]
pub(super) struct Steps {
    /// The last roll that was shown, without jumps at ±180°.
    last_roll_rad: f64,
}

impl Steps {
    pub(super) fn log(
        &mut self,
        stream: &RecordingStream,
        step: &StepRecord,
        known_truth: Option<&Truth>,
    ) -> Logged {
        let truth = known_truth.map_or(UNKNOWN, |t| coordinates(t.x_pb()));
        let has_truth = known_truth.is_some();
        let errors = |estimate: [f64; 6]| {
            let error = in_degrees(error(estimate, truth));
            (0..6).filter(move |_| has_truth).map(move |n| (column(n, "error"), error[n]))
        };
        let of = |estimate: &Option<Estimate>| {
            estimate.as_ref().map_or(UNKNOWN, |estimate| coordinates(&estimate.x_pb))
        };
        let estimate = of(&step.decision.estimate);
        let (mut shown, mut truth_shown) = (estimate, truth);
        self.unwrap_roll(&mut shown);
        self.unwrap_roll(&mut truth_shown);
        for (name, shadow) in &step.decision.shadows {
            let estimate = of(shadow);
            let mut shown = estimate;
            shown[ROLL] = nearest_turn(shown[ROLL], self.last_roll_rad);
            let shown = in_degrees(shown);
            let row = (0..6).map(|n| (column(n, "est"), shown[n])).chain(errors(estimate));
            log_row(stream, &format!("shadows/{name}"), row)?;
        }
        let cells = StepRow::new(step, known_truth);
        let recorded = STEP_COLUMNS
            .iter()
            .filter(|(name, _)| !ELSEWHERE.contains(name) && (has_truth || !is_truth_column(name)));
        let recorded = recorded.map(|(name, value)| {
            let value = value(&cells).unwrap_or(f64::NAN);
            let shown = match *name {
                "roll_est_rad" => shown[ROLL].to_degrees(),
                "roll_true_rad" => truth_shown[ROLL].to_degrees(),
                name if name.contains("_rad") => value.to_degrees(),
                _ => value,
            };
            (name.replace("_rad", "_deg"), shown)
        });
        let sd = in_degrees(step.decision.estimate.and_then(|e| e.sd).unwrap_or(UNKNOWN));
        let shown = in_degrees(shown);
        let bounds = REDUCED.into_iter().flat_map(|n| {
            let half = 2.0 * sd[n];
            [(column(n, "low"), shown[n] - half), (column(n, "high"), shown[n] + half)]
        });
        let innovation = step.innovation_mm.map_or([f64::NAN; 3], Into::into);
        let innovation = (0..3).map(|n| (column(n, "innovation"), innovation[n]));
        let age_ms = step.tip_meas_age_s.map_or(f64::NAN, |age_s| age_s * 1e3);
        let age = [("tip_meas_age_ms".to_owned(), age_ms)];
        let row = recorded.chain(bounds).chain(innovation).chain(age).chain(errors(estimate));
        log_row(stream, "steps", row.chain(target_band(step)))
    }

    /// Removes the jumps of the roll at ±180°: shifts it by whole turns to the value nearest to the last roll
    /// that was shown, and keeps it as the next reference.
    fn unwrap_roll(&mut self, coordinates: &mut [f64; 6]) {
        let roll = &mut coordinates[ROLL];
        if roll.is_finite() {
            *roll = nearest_turn(*roll, self.last_roll_rad);
            self.last_roll_rad = *roll;
        }
    }
}

/// The predicted error at the target minus and plus two standard deviations, mm. These combine that of the
/// position and that of the heading over the rest of the path, and ignore later corrections.
fn target_band(step: &StepRecord) -> Vec<(String, f64)> {
    let Decision { approach, estimate, .. } = &step.decision;
    let known = approach.as_ref().zip(estimate.and_then(|estimate| estimate.sd));
    let Some((approach, [x, y, z, yaw, pitch, _])) = known else { return Vec::new() };
    let left_mm = approach.path.as_ref().map_or(0.0, Path::length_mm);
    let sd_mm = x.max(y).max(z).hypot(yaw.max(pitch) * left_mm);
    let [low_mm, high_mm] = [-2.0, 2.0].map(|sds| (approach.error_mm + sds * sd_mm).max(0.0));
    vec![("target_error_low_mm".to_owned(), low_mm), ("target_error_high_mm".to_owned(), high_mm)]
}

/// `angle_rad` plus or minus whole turns, within half a turn of `reference_rad`.
fn nearest_turn(angle_rad: f64, reference_rad: f64) -> f64 {
    reference_rad + wrap_angle(angle_rad - reference_rad)
}

/// Coordinates in mm and degrees.
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
