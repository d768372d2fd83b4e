//! `home`, `jog`, `withdraw` and `prove`: a run without a needle's steering, and its record.

use super::super::about::About;
use super::super::ending::{ending, outcome_name, record_error, status};
use super::super::operator::Terminal;
use super::super::output::say;
use super::super::realtime::RealTimeArguments;
use super::super::recording::complete;
use super::super::run::{emulated_json, on_record_failure, open_stage_bus, record};
use super::super::tracker::open_tracker;
use super::super::{Failure, io_runtime};
use super::{Arguments, Operation, wrong};
use crate::config::{CanInterface, Config};
use crate::emulator::VirtualStage;
use crate::operation::OperationConfig;
use crate::runtime::{Clock, Interrupt, RunReport, Sink, Tips, run_live, run_virtual};
use crate::session::Done;
use crate::stage::Axis;
use crate::telemetry::Backpressure;
use crate::units::Time;
use serde_json::{Map, Value, json};
use std::process::ExitCode;
use std::time::SystemTime;

/// Does `operation`, and says what came of it.
pub(super) fn operate(
    config: &Config,
    operation: &Operation,
    about: &About,
    arguments: &Arguments,
) -> Result<ExitCode, Failure> {
    let plan = operation.plan(config)?;
    let mut terminal = Terminal::without_bar(arguments.quiet);
    let report = perform(config, plan, (operation, about), arguments.realtime, &mut terminal);
    let report = report.map(|(done, report)| (done, complete(report, config, &mut terminal)));
    terminal.finish();
    let (done, report) = report?;
    match arguments.json {
        true => say(to_json(operation.name(), &done, &report))?,
        false => say(summary(&done, &report))?,
    }
    Ok(ExitCode::from(status(config, &report)))
}

fn perform(
    config: &Config,
    settings: OperationConfig,
    (operation, about): (&Operation, &About),
    realtime: RealTimeArguments,
    terminal: &mut Terminal,
) -> Result<(Vec<Done>, RunReport), Failure> {
    let runtime = io_runtime()?;
    let interrupt = Interrupt::listen(&runtime).map_err(Failure::environment)?;
    if config.can.interface == CanInterface::Memory {
        realtime.refuse_virtual_time()?;
        let stage = VirtualStage::new(config.virtual_stage().map_err(wrong)?, Time::ZERO);
        let tool = config.tracker.tool.clone();
        let tips = settings.operation.has_tracker().then_some(Tips::Emulated { tool });
        let recorder =
            record(config, Some(operation), about, SystemTime::now(), Backpressure::Block)?;
        let sink = Sink::new(recorder, on_record_failure(config), terminal);
        let mut operation = settings.begin(Time::ZERO).map_err(wrong)?;
        let report = run_virtual(&mut operation, stage, tips, sink, &interrupt);
        return Ok((operation.done().to_vec(), report));
    }
    realtime.try_out()?;
    let mut bus = open_stage_bus(config)?;
    let clock = Clock::start();
    let mut tracker = match settings.operation.has_tracker() {
        true => Some(open_tracker(config, &runtime, clock)?),
        false => None,
    };
    let recorder =
        record(config, Some(operation), about, clock.origin_utc(), Backpressure::DropAndCount)?;
    let realtime = match realtime.enter() {
        Ok(realtime) => realtime,
        Err(failure) => {
            recorder.discard();
            return Err(failure);
        }
    };
    let sink = Sink::new(recorder, on_record_failure(config), terminal);
    // Last, since the operation's deadlines begin to run.
    let mut operation = settings.begin(clock.now()).map_err(wrong)?;
    let tracker = tracker.as_mut();
    let report = run_live(&mut operation, bus.as_mut(), tracker, clock, realtime, sink, &interrupt);
    runtime.shutdown_background();
    Ok((operation.done().to_vec(), report))
}

/// A position in the unit of the command line, with that unit.
pub(super) fn in_unit(axis: Axis, position: f64) -> (f64, &'static str) {
    match axis {
        Axis::Insertion => (position, "mm"),
        Axis::Rotation => (position.to_degrees(), "deg"),
    }
}

fn to_json(name: &str, done: &[Done], report: &RunReport) -> Value {
    let axis = |done: &Done| {
        let (to, unit) = in_unit(done.axis, done.to);
        let from = done.from.map(|from| in_unit(done.axis, from).0);
        let mut object = Map::from_iter([("axis".to_owned(), json!(done.axis.to_string()))]);
        object.insert(format!("from_{unit}"), json!(from));
        object.insert(format!("to_{unit}"), json!(to));
        Value::Object(object)
    };
    json!({
        "operation": name,
        "outcome": outcome_name(&report.outcome),
        "stop_reason": report.outcome.stop_reason(),
        "axes": done.iter().map(axis).collect::<Vec<_>>(),
        "duration_s": report.end.as_secs_f64(),
        "run_dir": report.run_dir.display().to_string(),
        "record_error": record_error(&report.record),
        "emulated": report.emulated.as_ref().map(emulated_json),
    })
}

/// The summary, the stop reason last.
fn summary(done: &[Done], report: &RunReport) -> String {
    let line = |done: &Done| {
        let (to, unit) = in_unit(done.axis, done.to);
        let axis = done.axis;
        match done.from.map(|from| in_unit(axis, from).0) {
            Some(from) => format!("{axis:<11} from {from:.3} to {to:.3} {unit}"),
            None => format!("{axis:<11} home, at {to:.3} {unit}"),
        }
    };
    let mut lines: Vec<String> = done.iter().map(line).collect();
    lines.extend(ending(report));
    lines.join("\n")
}
