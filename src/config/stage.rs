//! `[stage]`: the two drives, and the settings of the stage's master.

use super::can::CanConfig;
use super::error::ConfigError;
use crate::keys::section;
use crate::stage::{self, Axis, AxisConfig, PowerConfig};

section! {
    /// `[stage]`: the two drives.
    pub struct StageSection {
        /// True for a real stage: it refuses buses made for tests, and its drives' node, identity, scale
        /// and limits have no defaults. False is for "memory", "udp" and interfaces named vcan... or
        /// vxcan... alone.
        hardware: bool = false;
        /// Timeouts of power on and stop.
        power: PowerConfig, flat;
        /// The axis that pushes the needle.
        insertion: AxisConfig;
        /// The axis that turns the needle about its shaft.
        rotation: AxisConfig, table(AxisConfig::keys_of::<{ Axis::Rotation as usize }>());
    }
}

impl StageSection {
    /// The settings of an axis.
    pub fn axis(&self, axis: Axis) -> &AxisConfig {
        match axis {
            Axis::Insertion => &self.insertion,
            Axis::Rotation => &self.rotation,
        }
    }

    /// The settings of the stage's master, in mm, rad and counts.
    ///
    /// # Errors
    /// The stage refuses the settings, for example a following-error window of less than a count.
    pub fn to_stage(&self, can: &CanConfig) -> Result<stage::StageConfig, ConfigError> {
        let config = self.to_unchecked_stage(can);
        config.validate().map_err(ConfigError::of)?;
        Ok(config)
    }

    /// Those settings unchecked, for a stop, which must be sent even if a run would be refused.
    pub(super) fn to_unchecked_stage(&self, can: &CanConfig) -> stage::StageConfig {
        stage::StageConfig {
            bus: can.bus,
            power: self.power,
            listen_first: can.bus.heartbeat_timeout(),
            insertion: self.insertion.clone(),
            rotation: self.rotation.clone(),
        }
    }
}
