//! `[stage]`: the two drives, and the settings of the stage's master.

use std::time::Duration;

use super::can::CanConfig;
use super::error::ConfigError;
use crate::keys::{section, within};
use crate::stage;
use crate::stage::{Axis, AxisConfig};

section! {
    /// `[stage]`: the two drives.
    pub struct StageConfig {
        /// True for a real stage: it refuses buses made for tests, and its drives' node, identity, scale
        /// and limits have no defaults. False is for "memory", "udp" and interfaces named vcan... or
        /// vxcan... alone.
        hardware: bool = false;
        /// Reset a drive that is found in fault, once, instead of refusing to start.
        fault_reset_on_start: bool = false;
        /// Longest wait for both drives to be enabled, brakes included, s.
        enable_timeout as "enable_timeout_s": Duration [within(0.1, 60.0)] = 3.0;
        /// Of that, the longest wait for each step up to "switched on", charging included, s. A drive
        /// that takes longer is held, for example by its safety input, and the start is given up.
        state_transition_timeout as "let_on_s": Duration [within(0.05, 60.0)] = 0.5;
        /// Longest wait for both axes to stand after a stop, s.
        stop_timeout as "stop_timeout_s": Duration [within(0.1, 60.0)] = 2.0;
        /// The axis that pushes the needle.
        insertion: AxisConfig;
        /// The axis that turns the needle about its shaft.
        rotation: AxisConfig, table(AxisConfig::keys_of::<{ Axis::Rotation as usize }>());
    }
}

impl StageConfig {
    /// The settings of the stage's master, in mm, rad and counts.
    ///
    /// # Errors
    /// None for a configuration that was read; a program may have put in what no drive can do.
    pub fn to_stage(&self, can: &CanConfig) -> Result<stage::StageConfig, ConfigError> {
        let config = self.to_unchecked_stage(can);
        config.validate().map_err(ConfigError::of)?;
        Ok(config)
    }

    /// The same, with whatever the stage cannot work with: a stop is sent all the same.
    pub(super) fn to_unchecked_stage(&self, can: &CanConfig) -> stage::StageConfig {
        let millis = |ms: u16| Duration::from_millis(ms.into());
        stage::StageConfig {
            sync_period: millis(can.sync_ms),
            bench_node: can.bench_node,
            heartbeat_ms: can.heartbeat_ms,
            heartbeat_timeout_ms: can.heartbeat_timeout_ms,
            sdo_timeout: millis(can.sdo_timeout_ms),
            sdo_attempts: can.sdo_attempts.into(),
            boot_timeout: can.boot_timeout,
            boot_attempts: can.boot_attempts.into(),
            enable_timeout: self.enable_timeout,
            state_transition_timeout: self.state_transition_timeout,
            stop_timeout: self.stop_timeout,
            missed_feedback_max: can.missed_feedback_max.into(),
            fault_reset_on_start: self.fault_reset_on_start,
            listen_first: millis(can.heartbeat_timeout_ms),
            insertion: self.insertion.clone(),
            rotation: self.rotation.clone(),
        }
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
