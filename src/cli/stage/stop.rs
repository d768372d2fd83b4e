//! `stop`: quick stop of both drives, whoever moves them.

use super::super::output::{say, tell};
use super::super::{ENVIRONMENT_FAILED, Failure};
use super::talk;
use crate::config::Config;
use crate::stage::{Axis, Halt, StageConfig};
use crate::units::Time;
use serde_json::{Map, Value, json};
use std::process::ExitCode;

pub(super) fn stop(
    config: &Config,
    stage: &StageConfig,
    as_json: bool,
) -> Result<ExitCode, Failure> {
    let mut halt = Halt::new(stage, Time::ZERO);
    talk(config, &mut halt)?;
    let mut object = Map::new();
    let mut troubles = Vec::new();
    for axis in Axis::BOTH {
        let counts = match halt.result(axis) {
            Some(Ok(counts)) => Some(counts),
            Some(Err(trouble)) => {
                troubles.push(trouble);
                None
            }
            None => None,
        };
        if let (Some(counts), false) = (counts, as_json) {
            say(format_args!("{axis:<11} stands without power, at {counts} counts"))?;
        }
        let stands = counts.is_some();
        object.insert(axis.to_string(), json!({ "stands": stands, "position_counts": counts }));
    }
    for trouble in &troubles {
        tell(format_args!("error: {trouble}"));
    }
    if as_json {
        if !troubles.is_empty() {
            object.insert("error".to_owned(), json!(troubles.join("; ")));
        }
        say(Value::Object(object))?;
    }
    let stopped = troubles.is_empty();
    Ok(if stopped { ExitCode::SUCCESS } else { ExitCode::from(ENVIRONMENT_FAILED) })
}
