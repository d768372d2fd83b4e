//! Whole runs through the recorder.

use super::*;
use std::time::{Duration, UNIX_EPOCH};

pub(super) fn run_info() -> RunInfo {
    RunInfo {
        name: "virtual".to_owned(),
        started_utc: UNIX_EPOCH + Duration::from_secs(1_700_000_000),
        config_toml: "[insertion]\ndepth_mm = 150.0\n".to_owned(),
        version: "0.1.0".to_owned(),
        git: Some("abc1234".to_owned()),
        bus: "memory".to_owned(),
        tracker: "emulated".to_owned(),
        seed: Some(7),
        scene: Scene { x_wp: Pose::identity(), insertion_mm: 150.0, curvature_per_mm: 1.0 / 122.0 },
    }
}
