//! The tables of a run, a row at a time. An entity is a table:
//! - `stage`: the positions at every SYNC;
//! - `motion`: speeds and lags, ten times a second. A lag is the following error: commanded minus measured position;
//! - `limits`: the limits, with every row of `motion`;
//! - `samples` and `sample_rates`: delays of the tracker's samples, and how many were accepted and refused;
//! - `steps`: state, bounds, errors, command and measurement at each step;
//! - `shadows/NAME`: the estimates of an observer that runs alongside.

use super::states::{Meaning, States};
use super::{Logged, log_row};
use crate::archive::{STEP_COLUMNS, StepRow, is_truth_column};
use crate::emulator::Truth;
use crate::geometry::coordinates;
use crate::observer::Estimate;
use crate::plan::Path;
use crate::session::{SampleRecord, StepRecord};
use crate::stage::Feedback;
use crate::telemetry::Scene;
use crate::tracker::GateName;
use crate::units::{Time, wrap_angle};
use rerun::{RecordingStream, TextLog};
use std::time::Duration;

/// The interval of a row: each speed is the mean over it, each lag the largest in magnitude.
const MOTION_INTERVAL: Duration = Duration::from_millis(100);

/// Logs records of the stage as rows.
pub(super) struct Motion {
    /// The columns of `limits`. They do not change, and are logged repeatedly only so that the viewer draws
    /// them as lines.
    limits: Vec<(&'static str, f64)>,
    window: Option<Window>,
}

/// The interval since the last row of `motion`.
#[derive(Debug, Clone, Copy)]
struct Window {
    begin: Time,
    positions: [f64; 4],
    /// The lags largest in magnitude so far: mm (insertion), rad (rotation).
    worst_lags: [f64; 2],
}

impl Motion {
    pub(super) fn new(scene: &Scene) -> Self {
        let (insertion, rotation) = (&scene.stage.insertion, &scene.stage.rotation);
        let [insertion_lag_max, rotation_lag_max] = [insertion, rotation]
            .map(|axis| axis.following_error_limit(scene.stage.bus.sync_period()));
        let limits = vec![
            ("insertion_min_mm", insertion.limits.min),
            ("insertion_max_mm", insertion.limits.max),
            ("rotation_min_rad", rotation.limits.min),
            ("rotation_max_rad", rotation.limits.max),
            ("insertion_speed_max_mm_per_s", insertion.limits.speed_max),
            ("rotation_speed_min_rad_per_s", -rotation.limits.speed_max),
            ("rotation_speed_max_rad_per_s", rotation.limits.speed_max),
            ("insertion_lag_min_mm", -insertion_lag_max),
            ("insertion_lag_max_mm", insertion_lag_max),
            ("rotation_lag_min_rad", -rotation_lag_max),
            ("rotation_lag_max_rad", rotation_lag_max),
            ("rotation_cmd_min_rad_per_mm", -scene.rotation_max_rad_per_mm),
            ("rotation_cmd_max_rad_per_mm", scene.rotation_max_rad_per_mm),
            ("tip_meas_age_max_ms", scene.tip_meas_age_max_s * 1e3),
        ];
        Motion { limits, window: None }
    }

    pub(super) fn log(&mut self, stream: &RecordingStream, stage: &Feedback) -> Logged {
        let Feedback { time, commanded, measured, .. } = stage;
        let positions = [
            commanded.insertion_mm,
            measured.insertion_mm,
            commanded.rotation_rad,
            measured.rotation_rad,
        ];
        let columns =
            ["insertion_cmd_mm", "insertion_meas_mm", "rotation_cmd_rad", "rotation_meas_rad"];
        log_row(stream, "stage", columns.into_iter().zip(positions))?;
        let lags = [positions[0] - positions[1], positions[2] - positions[3]];
        let new_window = Window { begin: *time, positions, worst_lags: lags };
        let window = self.window.get_or_insert(new_window);
        for (worst, lag) in window.worst_lags.iter_mut().zip(lags) {
            if lag.abs() > worst.abs() {
                *worst = lag;
            }
        }
        if *time < window.begin + MOTION_INTERVAL {
            return Ok(());
        }
        let interval_s = time.seconds_after(window.begin);
        let moved = positions.into_iter().zip(window.positions);
        let speeds = moved.map(|(to, from)| (to - from) / interval_s);
        let columns = [
            "insertion_speed_cmd_mm_per_s",
            "insertion_speed_meas_mm_per_s",
            "rotation_speed_cmd_rad_per_s",
            "rotation_speed_meas_rad_per_s",
            "insertion_lag_mm",
            "rotation_lag_rad",
        ];
        log_row(stream, "motion", columns.into_iter().zip(speeds.chain(window.worst_lags)))?;
        *window = new_window;
        log_row(stream, "limits", self.limits.iter().copied())
    }
}

/// Rates are means over this interval.
const RATE_INTERVAL: Duration = Duration::from_millis(500);

/// Logs records of samples as rows, lines and states.
#[derive(Default)]
pub(super) struct Samples {
    window_begin: Option<Time>,
    accepted: u32,
    refused: u32,
    /// The gate that refused the last sample; the inner `None` if it was accepted.
    last_gate: Option<Option<GateName>>,
}

impl Samples {
    pub(super) fn log(
        &mut self,
        stream: &RecordingStream,
        sample: &SampleRecord,
        states: &mut States,
    ) -> Logged {
        if let Some(acquisition_time) = sample.acquisition_time {
            let delay_ms = sample.received.receive_time.seconds_after(acquisition_time) * 1e3;
            log_row(stream, "samples", [("delay_ms", delay_ms)])?;
        }
        let gate = sample.refused.as_ref().map(|refusal| refusal.gate);
        if gate == Some(GateName::Tool) {
            return Ok(());
        }
        log_refused(stream, sample)?;
        match gate {
            None => self.accepted += 1,
            Some(_) => self.refused += 1,
        }
        if self.last_gate.replace(gate) != Some(gate) {
            let (state, meaning) = match gate {
                None => ("accepted".to_owned(), Meaning::Good),
                Some(gate) => (format!("refused: {gate}"), Meaning::Fault),
            };
            states.log_lane(stream, "gate", &state, meaning)?;
        }
        let time = sample.received.receive_time;
        let begin = *self.window_begin.get_or_insert(time);
        if time < begin + RATE_INTERVAL {
            return Ok(());
        }
        let interval_s = time.seconds_after(begin);
        let rates = [("accepted_per_s", self.accepted), ("refused_per_s", self.refused)];
        let rates = rates.map(|(name, n)| (name, f64::from(n) / interval_s));
        (self.accepted, self.refused) = (0, 0);
        self.window_begin = Some(time);
        log_row(stream, "sample_rates", rates)
    }
}

/// Logs a line if the sample was refused.
pub(super) fn log_refused(stream: &RecordingStream, sample: &SampleRecord) -> Logged {
    let Some(reason) = &sample.refused else { return Ok(()) };
    let text = format!("sample of {:?} refused: {reason}", sample.received.tool);
    stream.log("events/samples", &TextLog::new(text).with_level("WARN"))
}

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
        let recorded = STEP_COLUMNS
            .iter()
            .filter(|(name, _)| !ELSEWHERE.contains(name) && (has_truth || !is_truth_column(name)));
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

/// The predicted error at the target minus and plus two standard deviations, mm. These combine that of the
/// position and that of the heading over the rest of the path, and ignore later corrections.
fn target_band(step: &StepRecord) -> Option<[(String, f64); 2]> {
    let approach = step.decision.approach.as_ref()?;
    let [x, y, z, yaw, pitch, _] = step.decision.estimate?.sd?;
    let left_mm = approach.path.as_ref().map_or(0.0, Path::length_mm);
    let sd_mm = x.max(y).max(z).hypot(yaw.max(pitch) * left_mm);
    let [low_mm, high_mm] = [-2.0, 2.0].map(|sds| (approach.error_mm + sds * sd_mm).max(0.0));
    Some([("target_error_low_mm".to_owned(), low_mm), ("target_error_high_mm".to_owned(), high_mm)])
}

/// `angle_rad` plus or minus whole turns, within half a turn of `reference_rad`.
fn nearest_turn(angle_rad: f64, reference_rad: f64) -> f64 {
    reference_rad + wrap_angle(angle_rad - reference_rad)
}
