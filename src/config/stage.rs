//! `[stage]`: the two axes, and what the stage's master is told of them.

use std::time::Duration;

use serde::Serialize;

use super::can::CanConfig;
use super::drive::DriveConfig;
use super::error::ConfigError;
use super::homing::{InsertionHomingConfig, RotationHomingConfig};
use super::rule::Range;
use super::section::Section;
use crate::stage;
use crate::stage::{AxisLimits, CountsRatio, HeartbeatConfig};

/// `[stage]`: the two drives.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StageConfig {
    /// True for a real stage.
    pub hardware: bool,
    /// Resets a drive that is found in fault, once, instead of refusing to start.
    pub fault_reset_on_start: bool,
    /// For both drives to be enabled, brakes included, s.
    pub enable_timeout_s: f64,
    /// For a drive to take each step before that, s: one that does not is held by something that
    /// must not let it go in the middle of a start.
    pub let_on_s: f64,
    /// For both axes to stand after a stop, s.
    pub stop_timeout_s: f64,
    /// `[stage.insertion]`.
    pub insertion: InsertionAxisConfig,
    /// `[stage.rotation]`.
    pub rotation: RotationAxisConfig,
}

impl StageConfig {
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        StageConfig {
            hardware: s.boolean("hardware"),
            fault_reset_on_start: s.boolean("fault_reset_on_start"),
            enable_timeout_s: s.number("enable_timeout_s", Range::within(0.1, 60.0)),
            let_on_s: s.number("let_on_s", Range::within(0.05, 60.0)),
            stop_timeout_s: s.number("stop_timeout_s", Range::within(0.1, 60.0)),
            insertion: s.section("insertion", InsertionAxisConfig::read),
            rotation: s.section("rotation", RotationAxisConfig::read),
        }
    }

    /// What the stage's master is told, in mm, rad and counts.
    ///
    /// # Errors
    /// None for a configuration that was read; a program may have put in what no drive can do.
    pub fn to_stage(&self, can: &CanConfig) -> Result<stage::StageConfig, ConfigError> {
        let millis = |ms: u16| Duration::from_millis(ms.into());
        let config = stage::StageConfig {
            sync_period: millis(can.sync_ms),
            bench_node: can.bench_node,
            heartbeat: HeartbeatConfig {
                producer_period: millis(can.heartbeat_ms),
                consumer_time: millis(can.heartbeat_timeout_ms),
            },
            sdo_timeout: millis(can.sdo_timeout_ms),
            sdo_attempts: can.sdo_attempts.into(),
            boot_timeout: seconds(can.boot_timeout_s),
            boot_attempts: can.boot_attempts.into(),
            enable_timeout: seconds(self.enable_timeout_s),
            let_on: seconds(self.let_on_s),
            stop_timeout: seconds(self.stop_timeout_s),
            missed_feedback_max: can.missed_feedback_max.into(),
            fault_reset_on_start: self.fault_reset_on_start,
            listen_first: millis(can.heartbeat_timeout_ms),
            insertion: self.insertion.to_axis()?,
            rotation: self.rotation.to_axis()?,
        };
        config.validate().map_err(ConfigError::of)?;
        Ok(config)
    }
}

/// `seconds` of a configuration; zero for what is none.
fn seconds(seconds: f64) -> Duration {
    Duration::try_from_secs_f64(seconds).unwrap_or_default()
}

/// `[stage.insertion]`: the axis that pushes the needle.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct InsertionAxisConfig {
    /// What both drives have.
    #[serde(flatten)]
    pub drive: DriveConfig,
    /// Scale.
    pub counts_per_mm: CountsPerMm,
    /// Soft limit, mm from the depth where the run starts.
    pub min_mm: f64,
    /// Soft limit, mm from the depth where the run starts.
    pub max_mm: f64,
    /// mm/s.
    pub speed_max_mm_per_s: f64,
    /// mm/s².
    #[serde(skip_serializing_if = "Option::is_none")]
    pub acceleration_max_mm_per_s2: Option<f64>,
    /// The drive's following-error window (6065), mm: kept by the drive, and by the bench.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub following_error_mm: Option<f64>,
    /// How hard the drive brakes on a quick stop (6085), mm/s².
    #[serde(skip_serializing_if = "Option::is_none")]
    pub quick_stop_deceleration_mm_per_s2: Option<f64>,
    /// Of `stage jog`, mm/s.
    pub jog_speed_mm_per_s: f64,
    /// Of `stage jog` and `stage withdraw`, mm/s².
    pub jog_acceleration_mm_per_s2: f64,
    /// Of `stage withdraw`, mm/s.
    pub withdraw_speed_mm_per_s: f64,
    /// `[stage.insertion.homing]`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub homing: Option<InsertionHomingConfig>,
}

/// A scale as a ratio of integers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct CountsPerMm {
    /// So many counts …
    pub counts: u32,
    /// … for so many mm.
    pub mm: u32,
}

impl InsertionAxisConfig {
    fn read(s: &mut Section<'_>) -> Self {
        InsertionAxisConfig {
            drive: DriveConfig::read(s),
            counts_per_mm: s.section("counts_per_mm", |s| CountsPerMm {
                counts: s.integer("counts", 1, u32::MAX),
                mm: s.integer("mm", 1, u32::MAX),
            }),
            min_mm: s.number("min_mm", Range::within(-1000.0, 0.0)),
            max_mm: s.number("max_mm", Range::over(0.0, 1000.0)),
            speed_max_mm_per_s: s.number("speed_max_mm_per_s", Range::over(0.0, 100.0)),
            acceleration_max_mm_per_s2: s
                .optional_number("acceleration_max_mm_per_s2", Range::over(0.0, 1e4)),
            following_error_mm: s.optional_number("following_error_mm", Range::over(0.0, 100.0)),
            quick_stop_deceleration_mm_per_s2: s
                .optional_number("quick_stop_deceleration_mm_per_s2", Range::over(0.0, 1e4)),
            jog_speed_mm_per_s: s.number("jog_speed_mm_per_s", Range::over(0.0, 100.0)),
            jog_acceleration_mm_per_s2: s
                .number("jog_acceleration_mm_per_s2", Range::over(0.0, 1e4)),
            withdraw_speed_mm_per_s: s.number("withdraw_speed_mm_per_s", Range::over(0.0, 100.0)),
            homing: s.optional_section("homing", InsertionHomingConfig::read),
        }
    }
}

impl InsertionAxisConfig {
    fn to_axis(&self) -> Result<stage::AxisConfig, ConfigError> {
        let CountsPerMm { counts, mm } = self.counts_per_mm;
        let ratio = CountsRatio::new(counts, mm)
            .ok_or_else(|| ConfigError::of("stage.insertion.counts_per_mm has a zero"))?;
        let limits = AxisLimits {
            min: self.min_mm,
            max: self.max_mm,
            speed_max: self.speed_max_mm_per_s,
            acceleration_max: self.acceleration_max_mm_per_s2,
        };
        Ok(stage::AxisConfig {
            following_error_max: self.following_error_mm,
            quick_stop_deceleration: self.quick_stop_deceleration_mm_per_s2,
            homing: self.homing.as_ref().map(InsertionHomingConfig::to_stage),
            ..self.drive.to_axis(ratio, limits)?
        })
    }
}

/// `[stage.rotation]`: the axis that turns the needle about its shaft.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RotationAxisConfig {
    /// What both drives have.
    #[serde(flatten)]
    pub drive: DriveConfig,
    /// Scale.
    pub counts_per_turn: CountsPerTurn,
    /// Soft limit, degrees from the angle where the run starts.
    pub min_deg: f64,
    /// Soft limit, degrees from the angle where the run starts.
    pub max_deg: f64,
    /// degrees/s.
    pub speed_max_deg_per_s: f64,
    /// degrees/s².
    #[serde(skip_serializing_if = "Option::is_none")]
    pub acceleration_max_deg_per_s2: Option<f64>,
    /// The drive's following-error window (6065), degrees: kept by the drive, and by the bench.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub following_error_deg: Option<f64>,
    /// How hard the drive brakes on a quick stop (6085), degrees/s².
    #[serde(skip_serializing_if = "Option::is_none")]
    pub quick_stop_deceleration_deg_per_s2: Option<f64>,
    /// Of `stage jog`, degrees/s.
    pub jog_speed_deg_per_s: f64,
    /// Of `stage jog`, degrees/s².
    pub jog_acceleration_deg_per_s2: f64,
    /// `[stage.rotation.homing]`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub homing: Option<RotationHomingConfig>,
}

/// A scale as a ratio of integers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct CountsPerTurn {
    /// So many counts …
    pub counts: u32,
    /// … for so many turns.
    pub turns: u32,
}

impl RotationAxisConfig {
    fn read(s: &mut Section<'_>) -> Self {
        RotationAxisConfig {
            drive: DriveConfig::read(s),
            counts_per_turn: s.section("counts_per_turn", |s| CountsPerTurn {
                counts: s.integer("counts", 1, u32::MAX),
                turns: s.integer("turns", 1, u32::MAX),
            }),
            min_deg: s.number("min_deg", Range::within(-360_000.0, 0.0)),
            max_deg: s.number("max_deg", Range::within(0.0, 360_000.0)),
            speed_max_deg_per_s: s.number("speed_max_deg_per_s", Range::over(0.0, 36_000.0)),
            acceleration_max_deg_per_s2: s
                .optional_number("acceleration_max_deg_per_s2", Range::over(0.0, 1e6)),
            following_error_deg: s.optional_number("following_error_deg", Range::over(0.0, 3600.0)),
            quick_stop_deceleration_deg_per_s2: s
                .optional_number("quick_stop_deceleration_deg_per_s2", Range::over(0.0, 1e6)),
            jog_speed_deg_per_s: s.number("jog_speed_deg_per_s", Range::over(0.0, 36_000.0)),
            jog_acceleration_deg_per_s2: s
                .number("jog_acceleration_deg_per_s2", Range::over(0.0, 1e6)),
            homing: s.optional_section("homing", RotationHomingConfig::read),
        }
    }
}

impl RotationAxisConfig {
    fn to_axis(&self) -> Result<stage::AxisConfig, ConfigError> {
        let CountsPerTurn { counts, turns } = self.counts_per_turn;
        let ratio = CountsRatio::new(counts, turns)
            .ok_or_else(|| ConfigError::of("stage.rotation.counts_per_turn has a zero"))?;
        let limits = AxisLimits {
            min: self.min_deg.to_radians(),
            max: self.max_deg.to_radians(),
            speed_max: self.speed_max_deg_per_s.to_radians(),
            acceleration_max: self.acceleration_max_deg_per_s2.map(f64::to_radians),
        };
        Ok(stage::AxisConfig {
            following_error_max: self.following_error_deg.map(f64::to_radians),
            quick_stop_deceleration: self.quick_stop_deceleration_deg_per_s2.map(f64::to_radians),
            homing: self.homing.as_ref().map(RotationHomingConfig::to_stage),
            ..self.drive.to_axis(ratio, limits)?
        })
    }
}

#[cfg(test)]
mod tests {
    use crate::config::{Config, Source};

    #[test]
    fn the_stage_keeps_the_following_error_windows_in_mm_and_rad() {
        let text = "[stage.insertion]\nfollowing_error_mm = 0.7\n\
                    [stage.rotation]\nfollowing_error_deg = 3.6\n";
        let windows = |text: &str| {
            let source = Source { name: "bench.toml", text };
            let config = Config::from_sources(&[source], &[]).expect("valid");
            let stage = config.stage.to_stage(&config.can).expect("a stage");
            [stage.insertion.following_error_max, stage.rotation.following_error_max]
        };
        assert_eq!(windows(text), [Some(0.7), Some(3.6f64.to_radians())]);
        assert_eq!(windows(""), [None, None]);
    }
}
