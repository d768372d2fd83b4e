//! What a recorded run was, from its manifest and its configuration.

use super::perform::scene;
use super::plan::mask_reader;
use super::{Failure, stage};
use crate::archive::Manifest;
use crate::config::Config;
use crate::operation::Plan;
use crate::runtime::{Describe, RecordedRun};

/// What the recording of a run of `config` needs beside the record.
pub(super) fn describe(config: Config) -> Describe {
    Box::new(move |manifest| {
        let plan = recorded_plan(manifest, &config).map_err(|failure| match failure {
            Failure::Configuration(text) | Failure::Environment(text) => text,
        })?;
        Ok(RecordedRun { plan, scene: scene(&config)?, config_toml: config.to_toml()? })
    })
}

/// What the run of `manifest` was to do, as its configuration and arguments say.
pub(super) fn recorded_plan(manifest: &Manifest, config: &Config) -> Result<Plan, Failure> {
    match stage::recorded(manifest, config)? {
        Some(operation) => Ok(Plan::from(operation)),
        None => {
            let session = config.session_reading(&mask_reader(None));
            session.map(Plan::from).map_err(Failure::configuration)
        }
    }
}
