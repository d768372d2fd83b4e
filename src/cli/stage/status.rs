//! `status` and `reset`: what the drives report about themselves.

use crate::cli::output::{has_no_reader, print_stderr, print_stdout, print_wrapped};
use crate::cli::perform::open_bus;
use crate::cli::{ENVIRONMENT_FAILED, Failure, Result, finish_with};
use crate::config::Config;
use crate::emulator::VirtualStage;
use crate::runtime::{Clock, Interrupt, talk_live, talk_virtual};
use crate::stage::{Axis, AxisStatus, Dialogue, Reset, StatusReader};
use crate::units::Time;
use serde_json::{Value, json};
use std::io::stdout;
use std::thread;
use std::time::{Duration, Instant};

/// Interval between two readings of `--watch`.
const WATCH_PERIOD: Duration = Duration::from_secs(1);
/// Meaning of the lowest bits of the digital inputs (CiA 402, 0x60FD).
const SWITCHES: [&str; 3] = ["negative_limit", "positive_limit", "home_switch"];
/// Interval at which `--watch` checks for Ctrl-C.
const SIGNAL_POLL: Duration = Duration::from_millis(50);

/// Runs `dialogue` with the drives of `config` to its end.
fn talk(config: &Config, dialogue: &mut dyn Dialogue) -> Result<()> {
    if config.is_emulated() {
        let mut stage = VirtualStage::new(config.virtual_stage()?, Time::ZERO);
        talk_virtual(dialogue, &mut stage);
        return Ok(());
    }
    let mut bus = open_bus(config.bus())?;
    let trouble = talk_live(dialogue, bus.as_mut(), Clock::start(), None);
    trouble.first.map_or(Ok(()), |error| Err(error.into()))
}

/// Resets the faults of both drives, then prints their status.
pub(super) fn reset(config: &Config, as_json: bool) -> Result<()> {
    let stage = config.to_stage()?;
    let mut reset = Reset::new(&stage, Time::ZERO);
    talk(config, &mut reset)?;
    let errors: Vec<String> =
        Axis::BOTH.into_iter().filter_map(|axis| reset.result(axis).err()).collect();
    match errors.is_empty() {
        true => status(config, as_json),
        false => Err(Failure::environment(errors.join("; "))),
    }
}

/// Prints the status each second, until Ctrl-C or until stdout is closed.
pub(super) fn watch(config: &Config, as_json: bool) -> Result<()> {
    let interrupt = Interrupt::listen()?;
    loop {
        let read = status(config, as_json);
        // A drive that does not answer now may answer the next time; a bus that cannot be opened ends the watch.
        if read.as_ref().is_err_and(|failure| failure.message.is_some()) || has_no_reader(&stdout())
        {
            return read;
        }
        let next = Instant::now() + WATCH_PERIOD;
        while Instant::now() < next {
            if interrupt.is_raised() {
                return read;
            }
            thread::sleep(SIGNAL_POLL);
        }
    }
}

/// Reads the status of both drives.
pub(in crate::cli) fn read_status(config: &Config) -> Result<StatusReader> {
    let stage = config.to_stage()?;
    let mut reader = StatusReader::new(&stage, Time::ZERO);
    talk(config, &mut reader)?;
    Ok(reader)
}

pub(super) fn status(config: &Config, as_json: bool) -> Result<()> {
    let reader = read_status(config)?;
    let (mut object, mut lines, mut errors) = (json!({}), Vec::new(), Vec::new());
    for axis in Axis::BOTH {
        let status = reader.status(axis).map_err(|error| errors.push(error)).ok();
        lines.extend(status.as_ref().map(|status| line(axis, status)));
        object[axis.to_string()] = json!(status.map(|status| drive_json(axis, &status)));
    }
    if !errors.is_empty() {
        object["error"] = json!(errors.join("; "));
    }
    match as_json {
        true => print_stdout(object)?,
        false => lines.iter().try_for_each(print_wrapped)?,
    }
    for error in &errors {
        print_stderr(format_args!("error: {error}"));
    }
    finish_with(if errors.is_empty() { 0 } else { ENVIRONMENT_FAILED })
}

/// A drive's status for programs.
pub(in crate::cli) fn drive_json(axis: Axis, status: &AxisStatus) -> Value {
    let position = status.position.map(|position| axis.in_unit(position).0);
    let unit = axis.unit();
    let mut object = json!({
        "axis": axis.to_string(),
        "node": status.node.get(),
        "device_type": status.device_type,
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
        "error_history": status.error_history.iter().map(ToString::to_string).collect::<Vec<_>>(),
        "nmt_state": status.nmt_state.map(|state| state.to_string()),
        "extra_answers": status.extra_answers,
    });
    object[format!("position_{unit}")] = json!(position);
    for (bit, name) in SWITCHES.into_iter().enumerate() {
        object[name] = json!(status.digital_inputs.map(|inputs| inputs >> bit & 1 != 0));
    }
    object
}

/// A drive's status in one line for the terminal.
fn line(axis: Axis, status: &AxisStatus) -> String {
    let AxisStatus { node, identity, statusword, .. } = status;
    let mut parts = vec![format!("{axis:<11} node {node}, {identity}; {statusword}")];
    parts.extend(status.mode.map(|mode| mode.to_string()));
    parts.extend(status.homed.map(|homed| if homed { "homed" } else { "not homed" }.to_owned()));
    parts.extend(status.position_counts.map(|counts| match status.position {
        Some(position) => {
            let (position, unit) = axis.in_unit(position);
            format!("at {position:.3} {unit} ({counts} counts)")
        }
        None => format!("at {counts} counts"),
    }));
    let inputs = status.digital_inputs.unwrap_or_default();
    let closed = SWITCHES.iter().enumerate().filter(|(bit, _)| inputs >> bit & 1 != 0);
    parts.extend(closed.map(|(_, name)| format!("{} closed", name.replace('_', " "))));
    parts.extend(status.error_code.map(|code| format!("error {code}")));
    let extra = status.extra_answers;
    parts.extend(
        (extra > 0).then(|| {
            format!("{extra} answers more than requests: two drives have this node number")
        }),
    );
    let history: Vec<String> = status.error_history.iter().map(ToString::to_string).collect();
    parts.extend((!history.is_empty()).then(|| format!("errors before: {}", history.join(", "))));
    parts.join(", ")
}
