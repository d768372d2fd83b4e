//! The tables of the steps: state, bounds, errors, command and measurement (`steps`), and the estimates of the
//! observers that run alongside (`shadows/NAME`).

use super::{Logged, log_row};
use crate::archive::{STEP_COLUMNS, StepRow, is_truth_column};
use crate::emulator::Truth;
use crate::geometry::coordinates;
use crate::observer::Estimate;
use crate::session::StepRecord;
use crate::units::wrap_angle;
use rerun::RecordingStream;

/// The six coordinates, each with its unit.
const COORDINATES: [(&str, &str); 6] =
    [("x", "mm"), ("y", "mm"), ("z", "mm"), ("yaw", "rad"), ("pitch", "rad"), ("roll", "rad")];
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
const OMITTED_COLUMNS: [&str; 4] = ["step", "time_s", "insertion_mm", "rotation_rad"];

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
        let of = |estimate: &Option<Estimate>| {
            estimate.as_ref().map_or(UNKNOWN, |estimate| coordinates(&estimate.x_pb))
        };
        let mut estimate = of(&step.decision.estimate);
        let mut truth = known_truth.map_or(UNKNOWN, |t| coordinates(&t.x_pb));
        self.unwrap_roll(&mut estimate);
        self.unwrap_roll(&mut truth);
        let has_truth = known_truth.is_some();
        // Estimate minus truth, mm and rad, angles in (−π, π].
        let errors = |estimate: [f64; 6]| {
            (0..6).filter(move |_| has_truth).map(move |n| {
                let difference = estimate[n] - truth[n];
                (column(n, "error"), if n < 3 { difference } else { wrap_angle(difference) })
            })
        };
        for (name, shadow) in &step.decision.shadows {
            let mut shadow = of(shadow);
            shadow[ROLL] = nearest_turn(shadow[ROLL], self.last_roll_rad);
            let row = (0..6).map(|n| (column(n, "est"), shadow[n])).chain(errors(shadow));
            log_row(stream, &format!("shadows/{name}"), row)?;
        }
        let cells = StepRow::new(step, known_truth);
        let recorded = STEP_COLUMNS.iter().filter(|(name, _)| {
            !OMITTED_COLUMNS.contains(name) && (has_truth || !is_truth_column(name))
        });
        let recorded = recorded.map(|(name, value)| {
            let value = match *name {
                "roll_est_rad" => estimate[ROLL],
                "roll_true_rad" => truth[ROLL],
                _ => value(&cells).unwrap_or(f64::NAN),
            };
            ((*name).to_owned(), value)
        });
        let sd = step.decision.estimate.and_then(|e| e.sd).unwrap_or(UNKNOWN);
        let bounds = REDUCED.into_iter().flat_map(|n| {
            let half = 2.0 * sd[n];
            [(column(n, "low"), estimate[n] - half), (column(n, "high"), estimate[n] + half)]
        });
        let innovation = step.innovation_mm.map_or([f64::NAN; 3], Into::into);
        let innovation = (0..3).map(|n| (column(n, "innovation"), innovation[n]));
        let age_ms = step.tip_meas_age_s.map_or(f64::NAN, |age_s| age_s * 1e3);
        let age = [("tip_meas_age_ms".to_owned(), age_ms)];
        let row = recorded.chain(bounds).chain(innovation).chain(age).chain(errors(estimate));
        log_row(stream, "steps", row.chain(target_band(step).into_iter().flatten()))
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

/// The predicted error at the target minus and plus two standard deviations, mm.
fn target_band(step: &StepRecord) -> Option<[(String, f64); 2]> {
    let approach = step.decision.approach.as_ref()?;
    let sd_mm = approach.error_sd_mm?;
    let [low_mm, high_mm] = [-2.0, 2.0].map(|sds| (approach.error_mm + sds * sd_mm).max(0.0));
    Some([("target_error_low_mm".to_owned(), low_mm), ("target_error_high_mm".to_owned(), high_mm)])
}

/// `angle_rad` plus or minus whole turns, within half a turn of `reference_rad`.
fn nearest_turn(angle_rad: f64, reference_rad: f64) -> f64 {
    reference_rad + wrap_angle(angle_rad - reference_rad)
}
