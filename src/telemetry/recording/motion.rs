//! The tables of the stage: positions at every SYNC (`stage`), speeds and lags ten times a second (`motion`), and
//! the limits (`limits`). A lag is the following error: commanded minus measured position.

use super::{Logged, log_row};
use crate::stage::Feedback;
use crate::telemetry::Scene;
use crate::units::Time;
use rerun::RecordingStream;
use std::time::Duration;

/// The interval between two rows of `motion`: each speed is the mean over it, each lag the largest in magnitude.
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
