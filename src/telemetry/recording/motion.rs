//! The tables of the stage: positions at every SYNC (`stage`), speeds and lags ten times a second (`motion`), and
//! the limits once a second (`limits`). A lag is the following error: commanded minus measured position.

use super::{Logged, log_row};
use crate::stage::Feedback;
use crate::telemetry::Scene;
use crate::units::Time;
use rerun::RecordingStream;
use std::time::Duration;

/// The interval of a row: each speed is the mean over it, each lag the largest in magnitude.
const MOTION_INTERVAL: Duration = Duration::from_millis(100);
/// Limits do not change. They are logged repeatedly only so that the viewer draws them as lines.
const LIMITS_INTERVAL: Duration = Duration::from_secs(1);

/// Logs records of the stage as rows.
pub(super) struct Motion {
    limits: Vec<(&'static str, f64)>,
    limits_due: Time,
    window: Option<Window>,
}

/// The interval since the last row of `motion`.
#[derive(Debug, Clone, Copy)]
struct Window {
    begin: Time,
    positions: [f64; 4],
    /// The lags largest in magnitude so far: mm (insertion), degrees (rotation).
    worst_lags: [f64; 2],
}

/// The positions of `stage`, mm and degrees: those of the insertion, commanded and measured, then those of
/// the rotation.
fn positions(stage: &Feedback) -> [f64; 4] {
    let Feedback { commanded, measured, .. } = stage;
    let rotation = [commanded.rotation_rad, measured.rotation_rad].map(f64::to_degrees);
    [commanded.insertion_mm, measured.insertion_mm, rotation[0], rotation[1]]
}

impl Motion {
    pub(super) fn new(scene: &Scene) -> Self {
        Motion { limits: limits(scene), limits_due: Time::ZERO, window: None }
    }

    pub(super) fn log(&mut self, stream: &RecordingStream, stage: &Feedback) -> Logged {
        let columns =
            ["insertion_cmd_mm", "insertion_meas_mm", "rotation_cmd_deg", "rotation_meas_deg"];
        let positions = positions(stage);
        log_row(stream, "stage", columns.into_iter().zip(positions))?;
        if stage.time >= self.limits_due {
            log_row(stream, "limits", self.limits.iter().copied())?;
            self.limits_due = stage.time + LIMITS_INTERVAL;
        }
        let lags = [positions[0] - positions[1], positions[2] - positions[3]];
        let new_window = Window { begin: stage.time, positions, worst_lags: lags };
        let mut window = self.window.unwrap_or(new_window);
        for (worst, lag) in window.worst_lags.iter_mut().zip(lags) {
            if lag.abs() > worst.abs() {
                *worst = lag;
            }
        }
        if stage.time >= window.begin + MOTION_INTERVAL {
            let interval_s = stage.time.seconds_after(window.begin);
            let moved = positions.into_iter().zip(window.positions);
            let speeds = moved.map(|(to, from)| (to - from) / interval_s);
            let columns = [
                "insertion_speed_cmd_mm_per_s",
                "insertion_speed_meas_mm_per_s",
                "rotation_speed_cmd_deg_per_s",
                "rotation_speed_meas_deg_per_s",
                "insertion_lag_mm",
                "rotation_lag_deg",
            ];
            log_row(stream, "motion", columns.into_iter().zip(speeds.chain(window.worst_lags)))?;
            window = new_window;
        }
        self.window = Some(window);
        Ok(())
    }

    /// Logs the limits once more at the end of the run, so that their lines reach it.
    pub(super) fn end(&self, stream: &RecordingStream) -> Logged {
        match self.window {
            Some(_) => log_row(stream, "limits", self.limits.iter().copied()),
            None => Ok(()),
        }
    }
}

/// The columns of `limits` with their values.
fn limits(scene: &Scene) -> Vec<(&'static str, f64)> {
    let (insertion, rotation) = (&scene.stage.insertion, &scene.stage.rotation);
    let rotation_speed_max = rotation.limits.speed_max.to_degrees();
    let sync_period = scene.stage.bus.sync_period();
    let insertion_lag_max = insertion.following_error_limit(sync_period);
    let rotation_lag_max = rotation.following_error_limit(sync_period).to_degrees();
    let rotation_cmd_max = scene.rotation_max_rad_per_mm.to_degrees();
    vec![
        ("insertion_min_mm", insertion.limits.min),
        ("insertion_max_mm", insertion.limits.max),
        ("rotation_min_deg", rotation.limits.min.to_degrees()),
        ("rotation_max_deg", rotation.limits.max.to_degrees()),
        ("insertion_speed_max_mm_per_s", insertion.limits.speed_max),
        ("rotation_speed_min_deg_per_s", -rotation_speed_max),
        ("rotation_speed_max_deg_per_s", rotation_speed_max),
        ("insertion_lag_min_mm", -insertion_lag_max),
        ("insertion_lag_max_mm", insertion_lag_max),
        ("rotation_lag_min_deg", -rotation_lag_max),
        ("rotation_lag_max_deg", rotation_lag_max),
        ("rotation_cmd_min_deg_per_mm", -rotation_cmd_max),
        ("rotation_cmd_max_deg_per_mm", rotation_cmd_max),
        ("tip_meas_age_max_ms", scene.tip_meas_age_max_s * 1e3),
    ]
}
