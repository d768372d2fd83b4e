//! The scalar series of the steps: reduced state, errors, command and measurement.

use super::index::Moment;
use super::palette::{COMMANDED, COORDINATES, ESTIMATE, ESTIMATE_BOUND, MEASURED, TRUTH};
use super::plots::{Plot, Plots};
use crate::archive::coordinates;
use crate::emulator::Truth;
use crate::observer::Estimate;
use crate::session::StepRecord;
use crate::units::wrap_angle;
use rerun::{Color, RecordingStream, RecordingStreamResult};
use std::collections::BTreeMap;

/// Names of the six coordinates, with the unit in which a reader sees them.
const COORDINATE_NAMES: [(&str, &str); 6] =
    [("x", "mm"), ("y", "mm"), ("z", "mm"), ("yaw", "deg"), ("pitch", "deg"), ("roll", "deg")];
/// The coordinates that tell how far the tip is from the plane and where it turns.
const REDUCED: [usize; 3] = [0, 4, 5];
const ROLL: usize = 5;
const UNKNOWN: [f64; 6] = [f64::NAN; 6];

/// Turns records of steps into rows.
pub(super) struct Steps {
    reduced: Plots,
    errors: Plots,
    inputs: Plots,
    shadows: BTreeMap<String, Plots>,
    roll_shown_rad: f64,
}

impl Steps {
    pub(super) fn new() -> Self {
        Steps {
            reduced: Plots::new(REDUCED.into_iter().flat_map(reduced_plots)),
            errors: Plots::new(error_plots("error", "")),
            inputs: Plots::new(input_plots()),
            shadows: BTreeMap::new(),
            roll_shown_rad: 0.0,
        }
    }

    pub(super) fn push(&mut self, moment: Moment, step: &StepRecord, truth: Option<&Truth>) {
        let truth = truth.map(|t| coordinates(t.x_pb()));
        self.push_reduced(moment, step, truth);
        self.errors.push(moment, &error(step.estimate.as_ref(), truth));
        let innovation = step.innovation_mm.map_or([f64::NAN; 3], Into::into);
        self.inputs.push(
            moment,
            &[
                step.rotation_cmd_rad_per_mm.map_or(f64::NAN, f64::to_degrees),
                step.tip_meas_age_s.map_or(f64::NAN, |age_s| age_s * 1e3),
                innovation[0],
                innovation[1],
                innovation[2],
            ],
        );
        for (name, estimate) in &step.shadows {
            let plots =
                self.shadows.entry(name.clone()).or_insert_with(|| Plots::new(shadow_plots(name)));
            let state = shown(estimate.as_ref().map_or(UNKNOWN, |e| coordinates(&e.x_pb)));
            let error = error(estimate.as_ref(), truth);
            plots.push(moment, &[state, error].concat());
        }
    }

    /// Roll is shown without the jump at ±180°: the estimate goes on from where it was shown
    /// last, and the truth stands beside it.
    fn push_reduced(&mut self, moment: Moment, step: &StepRecord, truth: Option<[f64; 6]>) {
        let mut estimate = step.estimate.map_or(UNKNOWN, |e| coordinates(&e.x_pb));
        let mut truth = truth.unwrap_or(UNKNOWN);
        let sd = step.estimate.and_then(|e| e.sd).unwrap_or(UNKNOWN);
        for roll in [&mut estimate[ROLL], &mut truth[ROLL]] {
            if roll.is_finite() {
                *roll = self.roll_shown_rad + wrap_angle(*roll - self.roll_shown_rad);
                self.roll_shown_rad = *roll;
            }
        }
        let bound = |sign: f64| std::array::from_fn(|n| estimate[n] + sign * 2.0 * sd[n]);
        let (upper, lower) = (shown(bound(1.0)), shown(bound(-1.0)));
        let (estimate, truth) = (shown(estimate), shown(truth));
        let x_meas_mm = step.tip_meas_mm.map_or(f64::NAN, |p| p.x);
        let row: Vec<f64> = REDUCED
            .into_iter()
            .flat_map(|n| {
                let measured = if n == 0 { x_meas_mm } else { f64::NAN };
                [measured, upper[n], lower[n], truth[n], estimate[n]]
            })
            .collect();
        self.reduced.push(moment, &row);
    }

    pub(super) fn send(&mut self, stream: &RecordingStream) -> RecordingStreamResult<()> {
        self.reduced.send(stream)?;
        self.errors.send(stream)?;
        self.inputs.send(stream)?;
        self.shadows.values_mut().try_for_each(|plots| plots.send(stream))
    }
}

/// Coordinates as a reader sees them: mm and degrees.
fn shown(coordinates: [f64; 6]) -> [f64; 6] {
    std::array::from_fn(|n| if n < 3 { coordinates[n] } else { coordinates[n].to_degrees() })
}

/// Estimate minus truth, mm and degrees, angles in (−180, 180].
fn error(estimate: Option<&Estimate>, truth: Option<[f64; 6]>) -> [f64; 6] {
    let (Some(estimate), Some(truth)) = (estimate, truth) else { return UNKNOWN };
    let estimate = coordinates(&estimate.x_pb);
    shown(std::array::from_fn(|n| {
        let difference = estimate[n] - truth[n];
        if n < 3 { difference } else { wrap_angle(difference) }
    }))
}

fn reduced_plots(n: usize) -> [Plot; 5] {
    let (coordinate, unit) = COORDINATE_NAMES[n];
    let plot = |kind: &str, name: &'static str, colour: Color| {
        Plot::line(format!("state/{coordinate}_{unit}/{kind}"), name, colour)
    };
    [
        plot("measured", "measured", MEASURED).dots(),
        plot("estimate_plus_2_sd", "estimate ± 2 sd", ESTIMATE_BOUND).thin(),
        plot("estimate_minus_2_sd", "estimate ± 2 sd", ESTIMATE_BOUND).thin(),
        plot("true", "true", TRUTH),
        plot("estimate", "estimate", ESTIMATE),
    ]
}

fn error_plots(path: &str, prefix: &str) -> Vec<Plot> {
    let plot = |(n, (name, unit)): (usize, (&str, &str))| {
        let path = format!("{path}/{name}_{unit}");
        Plot::line(path, format!("{prefix}{name} error [{unit}]"), COORDINATES[n % 3])
    };
    COORDINATE_NAMES.into_iter().enumerate().map(plot).collect()
}

fn shadow_plots(observer: &str) -> Vec<Plot> {
    let state = COORDINATE_NAMES.into_iter().enumerate().map(|(n, (name, unit))| {
        let path = format!("shadow/{observer}/state/{name}_{unit}");
        Plot::line(path, format!("{observer}: {name} [{unit}]"), COORDINATES[n % 3])
    });
    let errors = error_plots(&format!("shadow/{observer}/error"), &format!("{observer}: "));
    state.chain(errors).collect()
}

fn input_plots() -> [Plot; 5] {
    let [x, y, z] = COORDINATES;
    [
        Plot::line("command/rotation_deg_per_mm", "rotation command [deg/mm]", COMMANDED),
        Plot::line("tracker/age_ms", "age of the measurement [ms]", MEASURED),
        Plot::line("tracker/innovation/x_mm", "x innovation [mm]", x),
        Plot::line("tracker/innovation/y_mm", "y innovation [mm]", y),
        Plot::line("tracker/innovation/z_mm", "z innovation [mm]", z),
    ]
}
