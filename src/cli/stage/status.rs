//! `status`: what the drives say of themselves.

use super::super::output::{say, tell};
use super::super::{ENVIRONMENT_FAILED, Failure};
use super::operate::in_unit;
use super::talk;
use crate::config::Config;
use crate::stage::{Axis, AxisStatus, StageConfig, StatusReader};
use crate::units::Time;
use serde_json::{Map, Value, json};
use std::process::ExitCode;

pub(super) fn status(
    config: &Config,
    stage: &StageConfig,
    as_json: bool,
) -> Result<ExitCode, Failure> {
    let mut reader = StatusReader::new(stage, Time::ZERO);
    talk(config, &mut reader)?;
    let statuses = Axis::BOTH.map(|axis| (axis, reader.status(axis)));
    let troubles: Vec<&String> =
        statuses.iter().filter_map(|(_, status)| status.as_ref().err()).collect();
    if as_json {
        let mut object = Map::new();
        for (axis, status) in &statuses {
            let value = status.as_ref().map_or(Value::Null, |status| to_json(*axis, status));
            object.insert(axis.to_string(), value);
        }
        if !troubles.is_empty() {
            let texts: Vec<&str> = troubles.iter().map(|trouble| trouble.as_str()).collect();
            object.insert("error".to_owned(), json!(texts.join("; ")));
        }
        say(Value::Object(object))?;
    } else {
        for (axis, status) in &statuses {
            if let Ok(status) = status {
                say(line(*axis, status))?;
            }
        }
    }
    for trouble in &troubles {
        tell(format_args!("error: {trouble}"));
    }
    let answered = troubles.is_empty();
    Ok(if answered { ExitCode::SUCCESS } else { ExitCode::from(ENVIRONMENT_FAILED) })
}

fn to_json(axis: Axis, status: &AxisStatus) -> Value {
    let position = status.position.map(|position| in_unit(axis, position).0);
    let unit = in_unit(axis, 0.0).1;
    let input = |bit: u32| status.digital_inputs.map(|inputs| inputs >> bit & 1 != 0);
    let mut object = json!({
        "node": status.node.get(),
        "vendor_id": status.identity.vendor,
        "product_code": status.identity.product,
        "revision": status.identity.revision,
        "serial": status.identity.serial,
        "state": status.statusword.state().map(|state| state.to_string()),
        "statusword": status.statusword.0,
        "mode": status.mode.map(|mode| mode.to_string()),
        "homed": status.homed,
        "position_counts": status.position_counts,
        "error_code": status.error_code.map(|code| code.0),
        "error_name": status.error_code.map(|code| code.to_string()),
        "negative_limit": input(0),
        "positive_limit": input(1),
        "home_switch": input(2),
        "nmt_state": status.nmt_state.map(|state| state.to_string()),
    });
    if let Some(object) = object.as_object_mut() {
        object.insert(format!("position_{unit}"), json!(position));
    }
    object
}

/// One line for the terminal.
fn line(axis: Axis, status: &AxisStatus) -> String {
    let AxisStatus { node, identity, statusword, .. } = status;
    let mut parts = vec![format!("{axis:<11} node {node}, {identity}; {statusword}")];
    parts.extend(status.mode.map(|mode| mode.to_string()));
    parts.extend(status.homed.map(|homed| if homed { "homed" } else { "not homed" }.to_owned()));
    parts.extend(status.position_counts.map(|counts| match status.position {
        Some(position) => {
            let (position, unit) = in_unit(axis, position);
            format!("at {position:.3} {unit} ({counts} counts)")
        }
        None => format!("at {counts} counts"),
    }));
    let switches = [(0, "negative limit"), (1, "positive limit"), (2, "home switch")];
    let closed = |bit: u32| status.digital_inputs.is_some_and(|inputs| inputs >> bit & 1 != 0);
    let names = switches.iter().filter(|(bit, _)| closed(*bit));
    parts.extend(names.map(|(_, name)| format!("{name} closed")));
    parts.extend(status.error_code.map(|code| format!("error {code}")));
    parts.join(", ")
}
