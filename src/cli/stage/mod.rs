//! `needle-bench stage`: what the stage does without a needle to steer.

mod distance;
mod operate;
mod status;

pub(super) use self::operate::perform;
pub(super) use self::status::talk;

use self::distance::{Distance, Speed};
use super::Failure;
use super::about::About;
use super::output::tell;
use super::realtime::RealTimeArguments;
use super::runs::{RUNS, last_run_on_a_bus};
use super::sources::{Configured, load, rehearsed};
use super::stop::stop;
use crate::archive::Manifest;
use crate::config::{CanInterface, Config};
use crate::operation::{AnswerSettings, Goal, Move, Operation as Task, OperationConfig};
use crate::session::Done;
use crate::stage::{Axis, StageConfig, Zero};
use crate::tracker::{Gate, Registration};
use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{Args, Parser, Subcommand};
use nalgebra::Vector3;
use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(flatten)]
    named: Named,
    /// Move the emulated stage of bench-config/virtual.toml, in memory and in virtual time.
    #[arg(long = "virtual", global = true)]
    emulated: bool,
    /// Rehearse this very configuration on emulated drives and an emulated tracker, in virtual time;
    /// no CAN interface and no connection is opened.
    #[arg(long, global = true, conflicts_with = "emulated")]
    rehearse: bool,
    /// One JSON object on stdout.
    #[arg(long, global = true)]
    pub(super) json: bool,
    /// Show warnings and faults only.
    #[arg(long, short, global = true)]
    quiet: bool,
    #[command(flatten)]
    realtime: RealTimeArguments,
    #[command(subcommand)]
    operation: Operation,
}

/// The stage, named before or after the operation. `global = true` would not do: of options on both
/// sides clap drops those before.
#[derive(Debug, Args)]
pub(super) struct Named {
    /// Configuration, which names the bus and the drives.
    #[arg(long)]
    config: Option<PathBuf>,
    /// Set a key of the configuration.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

impl Named {
    /// What this names and then `after`, in the order of the command line.
    fn and<'a>(
        &'a self,
        after: &'a Configured,
    ) -> Result<(Option<&'a Path>, Vec<String>), Failure> {
        if let (Some(config), Some(again)) = (&self.config, after.path()) {
            return Err(wrong(format!(
                "--config is given twice, {} and {}: nothing was done, give one",
                config.display(),
                again.display()
            )));
        }
        Ok((self.config.as_deref().or(after.path()), [&self.set[..], &after.set].concat()))
    }
}

/// What every operation that leaves a record is told besides.
#[derive(Debug, Args)]
pub(super) struct Common {
    #[command(flatten)]
    about: About,
    #[command(flatten)]
    configured: Configured,
}

#[derive(Debug, Subcommand)]
pub(super) enum Operation {
    /// Read identity, state, position and error history of both drives; nothing is written.
    #[command(after_help = "Examples:\n  needle-bench stage status my-rig.toml --watch")]
    Status {
        /// Read again each second, until Ctrl-C.
        #[arg(long)]
        watch: bool,
        #[command(flatten)]
        configured: Configured,
    },
    /// Home the axes by their drives (CiA 402 mode 6). Take the needle off first: the axis moves.
    #[command(
        after_help = "Examples:\n  needle-bench stage home my-rig.toml\n  needle-bench stage home my-rig.toml --axis rotation"
    )]
    Home {
        /// Home this axis only, instead of every axis with a [homing] section.
        #[arg(long, value_parser = axis())]
        axis: Option<Axis>,
        #[command(flatten)]
        common: Common,
    },
    /// Move one axis by a distance or to a position, the other held.
    #[command(
        after_help = "Examples:\n  needle-bench stage jog my-rig.toml --axis insertion --by 2mm\n  needle-bench stage jog my-rig.toml --axis rotation --to 90deg --speed 10deg/s"
    )]
    Jog {
        /// Which axis.
        #[arg(long, value_parser = axis())]
        axis: Axis,
        /// How far, with its unit: 2mm, -0.5mm, 10deg.
        #[arg(
            long,
            allow_hyphen_values = true,
            required_unless_present = "to",
            conflicts_with = "to"
        )]
        by: Option<Distance>,
        /// The position to go to: 12mm, 90deg. It counts from stage.AXIS.zero, a position of the drive in
        /// counts. Refused with zero = "start": 0 is then where each command begins; give --by.
        #[arg(long, allow_hyphen_values = true)]
        to: Option<Distance>,
        /// How fast, instead of at its jog speed: 0.5mm/s, 20deg/s.
        #[arg(long, allow_hyphen_values = true)]
        speed: Option<Speed>,
        #[command(flatten)]
        common: Common,
    },
    /// Pull the needle straight back along its path; the base is not turned.
    #[command(
        after_help = "Examples:\n  needle-bench stage withdraw my-rig.toml\n  needle-bench stage withdraw my-rig.toml --by 20mm"
    )]
    Withdraw {
        /// Distance to withdraw, instead of to depth 0: 20mm.
        #[arg(long, allow_hyphen_values = true)]
        by: Option<Distance>,
        /// How fast, instead of at its withdraw speed: 0.5mm/s.
        #[arg(long, allow_hyphen_values = true)]
        speed: Option<Speed>,
        #[command(flatten)]
        common: Common,
    },
    /// Hold both axes and stop sending, as if the bench had died, to prove that both drives notice. Some
    /// drives are in fault afterwards.
    #[command(
        after_help = "Examples:\n  needle-bench stage prove my-rig.toml\n  needle-bench stage prove my-rig.toml --handedness"
    )]
    Prove {
        /// Turn the base in air instead, by 45 degrees twice and back, and check that the tracked sensor
        /// turns the same way. The sensor must sit off the needle's axis.
        #[arg(long)]
        handedness: bool,
        #[command(flatten)]
        common: Common,
    },
    /// Reset both drives' faults and clear their error history, once the cause is gone. Nothing gets power.
    #[command(after_help = "Examples:\n  needle-bench stage reset my-rig.toml")]
    Reset(Configured),
    /// Stop both axes at once, whoever moves them, and take power off.
    #[command(after_help = "Examples:\n  needle-bench stage stop my-rig.toml")]
    Stop(Configured),
}

impl Operation {
    /// The operation that `words` name, as on the command line of `stage`.
    fn of(words: &[&str]) -> Result<Self, clap::Error> {
        let words = ["stage"].iter().chain(words);
        Recorded::try_parse_from(words).map(|recorded| recorded.operation)
    }

    /// The stage that its arguments name, and all of them for an operation that leaves a record.
    fn common(&self) -> (&Configured, Option<&Common>) {
        match self {
            Operation::Status { configured: named, .. }
            | Operation::Reset(named)
            | Operation::Stop(named) => (named, None),
            Operation::Home { common, .. }
            | Operation::Jog { common, .. }
            | Operation::Withdraw { common, .. }
            | Operation::Prove { common, .. } => (&common.configured, Some(common)),
        }
    }

    /// Its name in the record.
    pub(super) fn name(&self) -> &'static str {
        match self {
            Operation::Status { .. } => "status",
            Operation::Reset(_) => "reset",
            Operation::Stop(_) => "stop",
            Operation::Home { .. } => "home",
            Operation::Jog { .. } => "jog",
            Operation::Withdraw { .. } => "withdraw",
            Operation::Prove { handedness: false, .. } => "prove",
            Operation::Prove { handedness: true, .. } => "prove-handedness",
        }
    }

    /// What followed it on its command line, as far as it says what was to be done.
    pub(super) fn arguments(&self) -> Vec<String> {
        let (axis, by, to, speed) = match self {
            Operation::Home { axis, .. } => (*axis, None, None, None),
            Operation::Jog { axis, by, to, speed, .. } => (Some(*axis), *by, *to, *speed),
            Operation::Withdraw { by, speed, .. } => (None, *by, None, *speed),
            Operation::Prove { handedness: true, .. } => return vec!["--handedness".to_owned()],
            _ => (None, None, None, None),
        };
        let axis = axis.map(|axis| ["--axis".to_owned(), axis.to_string()]);
        let by = by.map(|by| ["--by".to_owned(), by.to_string()]);
        let to = to.map(|to| ["--to".to_owned(), to.to_string()]);
        let speed = speed.map(|speed| ["--speed".to_owned(), speed.to_string()]);
        [axis, by, to, speed].into_iter().flatten().flatten().collect()
    }

    /// The words after `stage withdraw` that finish a withdrawal which went as far as `done`. `None` where
    /// nothing is left to withdraw, and of another operation.
    fn rest(&self, done: &[Done]) -> Option<String> {
        let Operation::Withdraw { by, .. } = self else { return None };
        let Some(Distance::Mm(by_mm)) = by else { return Some(String::new()) };
        let moved_mm = done.iter().find_map(|done| Some(done.from? - done.to)).unwrap_or_default();
        let left_mm = by_mm - moved_mm;
        (left_mm >= 0.05).then(|| format!(" --by {left_mm:.1}mm"))
    }

    /// The key that an emulated stage needs besides, for this operation to show anything.
    fn emulated(&self, config: &Config) -> Option<String> {
        let emulator = &config.emulator;
        match self {
            Operation::Prove { handedness: true, .. } => sensor_off_axis(config),
            Operation::Withdraw { .. }
                if emulator.rehearse && emulator.insertion_start_mm == 0.0 =>
            {
                Some(format!("emulator.insertion_start_mm={:?}", config.insertion.depth_mm))
            }
            _ => None,
        }
    }

    /// What it is on the stage of `config`.
    pub(super) fn plan(&self, config: &Config) -> Result<OperationConfig, Failure> {
        let stage = config.stage.to_stage(&config.can).map_err(wrong)?;
        let operation = match self {
            Operation::Home { axis, .. } => home(&stage, *axis)?,
            Operation::Jog { axis, by, to, speed, .. } => {
                let goal = goal(&stage, *axis, *by, *to)?;
                Task::Move(at(way(config, *axis, goal), *speed, &stage)?)
            }
            Operation::Withdraw { by, speed, .. } => {
                Task::Move(at(withdraw(config, &stage, *by)?, *speed, &stage)?)
            }
            Operation::Prove { handedness: false, .. } => Task::Prove,
            Operation::Prove { handedness: true, .. } => answer(config)?,
            Operation::Status { .. } | Operation::Reset(_) | Operation::Stop(_) => {
                return Err(wrong(format!("stage {} leaves no record", self.name())));
            }
        };
        Ok(OperationConfig { stage, operation })
    }
}

/// An operation with its arguments.
#[derive(Debug, Parser)]
struct Recorded {
    #[command(subcommand)]
    operation: Operation,
}

/// The operation that `manifest` tells of, on the stage of `config`; `None` of an insertion.
pub(in crate::cli) fn recorded(
    manifest: &Manifest,
    config: &Config,
) -> Result<Option<OperationConfig>, Failure> {
    let Some(name) = &manifest.operation else { return Ok(None) };
    // `prove-handedness` is `prove --handedness`.
    let command = name.split('-').take(1);
    let arguments = manifest.arguments.iter().map(String::as_str);
    let words: Vec<&str> = command.chain(arguments).collect();
    let operation = Operation::of(&words).map_err(|_| {
        wrong(format!(
            "the record does not say what `stage {name}` was to do; replay it with the bench that \
             recorded it"
        ))
    })?;
    operation.plan(config).map(Some)
}

/// A parser of an axis's name, for clap.
fn axis() -> impl TypedValueParser<Value = Axis> {
    PossibleValuesParser::new(["insertion", "rotation"]).map(|name| match name.as_str() {
        "rotation" => Axis::Rotation,
        _ => Axis::Insertion,
    })
}

pub(super) fn stage(arguments: &Arguments) -> Result<ExitCode, Failure> {
    let (named, common) = arguments.operation.common();
    let (path, mut sets) = arguments.named.and(named)?;
    if let Operation::Stop(_) = arguments.operation {
        let emulated = match arguments.rehearse {
            true => Some("--rehearse"),
            false => arguments.emulated.then_some("--virtual"),
        };
        return match emulated {
            None => stop(path, &sets, arguments.json),
            Some(flag) => Err(wrong(format!(
                "{flag}: the emulated stage does not move by itself: there is nothing to stop"
            ))),
        };
    }
    if common.is_none() {
        arguments.realtime.refuse("`stage status` and `reset` have no SYNC thread")?;
    }
    sets = rehearsed(&sets, arguments.rehearse);
    let mut config = load(path, None, &sets)?;
    is_meant(config.bus(), arguments.emulated || arguments.rehearse)?;
    if let Some(key) = arguments.operation.emulated(&config) {
        tell(format_args!("emulated    {key}"));
        sets.push(key);
        config = load(path, None, &sets)?;
    }
    match common {
        Some(common) => {
            operate::operate(&config, path.filter(|_| sets.is_empty()), common, arguments)
        }
        None => match arguments.operation {
            Operation::Reset(_) => status::reset(&config, arguments.json),
            Operation::Status { watch: true, .. } => status::watch(&config, arguments.json),
            _ => status::status(&config, arguments.json),
        },
    }
}

/// The emulated stage in memory is moved where `--virtual` asks for it, and nowhere else: an operator
/// who forgot to name the rig must not take it for the rig.
pub(super) fn is_meant(interface: &CanInterface, emulated: bool) -> Result<(), Failure> {
    match (interface == &CanInterface::Memory, emulated) {
        (true, true) | (false, false) => Ok(()),
        (false, true) => Err(wrong(format!(
            "--virtual moves the emulated stage in memory, but can.interface is \"{interface}\": \
             leave one of the two out"
        ))),
        (true, false) => {
            let last = last_run_on_a_bus(Path::new(RUNS))
                .map(|config| format!("\nthe last run on a bus: --config {}", config.display()));
            Err(wrong(format!(
                "no stage is named: give its configuration, --config my-rig.toml, or rehearse on the \
                 emulated stage with --virtual{}",
                last.unwrap_or_default()
            )))
        }
    }
}

fn wrong(error: impl Display) -> Failure {
    Failure::Configuration(error.to_string())
}

fn home(stage: &StageConfig, only: Option<Axis>) -> Result<Task, Failure> {
    match Task::home(stage, only) {
        Task::Home(axes) if axes.all(|chosen| !chosen) => Err(wrong(
            "no axis can be homed: neither [stage.insertion.homing] nor [stage.rotation.homing] is \
             configured",
        )),
        homing => Ok(homing),
    }
}

/// Degrees from the goal that count as there: the rotation has no needle to place.
const ROTATION_ARRIVAL_DEG: f64 = 0.1;

/// Turn of the base by which a sensor shows its handedness, made twice.
const ANSWER_TURN_DEG: f64 = 45.0;

/// An emulated sensor that sits on the axis is moved so far off it, to show its handedness.
const SENSOR_OFF_AXIS_MM: f64 = 5.0;

/// The key that an emulated sensor needs to show how the base turns.
pub(super) fn sensor_off_axis(config: &Config) -> Option<String> {
    let is_on_axis = config.emulator.sensor.to_pose().translation.xy().norm() == 0.0;
    (config.is_emulated() && is_on_axis)
        .then(|| format!("emulator.sensor.x_mm={SENSOR_OFF_AXIS_MM}"))
}

fn answer(config: &Config) -> Result<Task, Failure> {
    let gate = config.tracker.to_gate().map_err(wrong)?;
    // Where the sensor is, not the tip: that is on the axis.
    let registration = Registration::new(*gate.registration.x_wt());
    Ok(Task::Answer(Box::new(AnswerSettings {
        gate: Gate { registration, workspace: None, ..gate },
        axis: config.plane.to_pose().rotation * Vector3::z(),
        turn: way(config, Axis::Rotation, Goal::By(ANSWER_TURN_DEG.to_radians())),
    })))
}

/// Where a jog ends.
fn goal(
    stage: &StageConfig,
    axis: Axis,
    by: Option<Distance>,
    to: Option<Distance>,
) -> Result<Goal, Failure> {
    match (by, to) {
        (Some(by), _) => by.along(axis, stage.axis(axis).ratio).map(Goal::By).map_err(wrong),
        (None, Some(_)) if stage.axis(axis).zero == Zero::Here => Err(wrong(format!(
            "--to: stage.{axis}.zero is \"start\": positions count from where each command begins, \
             so --to would mean --by; give --by, or set stage.{axis}.zero in counts of the drive"
        ))),
        (None, Some(to)) => to.in_unit_of(axis).map(Goal::To).map_err(wrong),
        (None, None) => Err(wrong("give --by or --to")),
    }
}

/// `way` at the `speed` that is asked for.
fn at(way: Move, speed: Option<Speed>, stage: &StageConfig) -> Result<Move, Failure> {
    let max = stage.axis(way.axis).limits.speed_max;
    let speed = speed.map(|speed| speed.along(way.axis, max)).transpose().map_err(wrong)?;
    Ok(Move { speed: speed.unwrap_or(way.speed), ..way })
}

/// A move of `axis` at its jog speed.
fn way(config: &Config, axis: Axis, goal: Goal) -> Move {
    let (insertion, rotation) = (&config.stage.insertion, &config.stage.rotation);
    match axis {
        Axis::Insertion => Move {
            axis,
            goal,
            speed: insertion.jog_speed,
            acceleration: insertion.jog_acceleration,
            arrival: config.insertion.arrival_mm,
        },
        Axis::Rotation => Move {
            axis,
            goal,
            speed: rotation.jog_speed,
            acceleration: rotation.jog_acceleration,
            arrival: ROTATION_ARRIVAL_DEG.to_radians(),
        },
    }
}

/// To depth 0, which an axis has only where it does not read 0 wherever it stands.
fn withdraw(config: &Config, stage: &StageConfig, by: Option<Distance>) -> Result<Move, Failure> {
    let insertion = &config.stage.insertion;
    let along = |by: Distance| by.along(Axis::Insertion, stage.insertion.ratio);
    let goal = match by.map(along).transpose().map_err(wrong)? {
        Some(mm) if mm > 0.0 => Goal::By(-mm),
        Some(mm) => {
            let by = mm.abs();
            return Err(wrong(format!(
                "withdraw pulls back: --by {mm}mm is not over 0; give the distance alone, --by {by}mm"
            )));
        }
        None if insertion.zero.is_some() => Goal::BackTo(0.0),
        None => {
            return Err(wrong(
                "stage.insertion.zero is \"start\": the bench does not know the depth where the \
                 needle went in; say how far to withdraw, --by 20mm",
            ));
        }
    };
    let speed = insertion.withdraw_speed.unwrap_or(insertion.jog_speed);
    Ok(Move { speed, ..way(config, Axis::Insertion, goal) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rest_of_a_withdrawal_is_what_was_asked_for_and_not_done() {
        let rest = |words: &[&str], to: f64| {
            let done = Done { axis: Axis::Insertion, from: Some(30.0), to };
            Operation::of(words).unwrap().rest(&[done])
        };
        assert_eq!(rest(&["withdraw", "--by", "20mm"], 24.5).as_deref(), Some(" --by 14.5mm"));
        assert_eq!(rest(&["withdraw", "--by", "20mm"], 10.01), None);
        assert_eq!(rest(&["withdraw"], 24.5).as_deref(), Some(""), "to depth 0");
        assert_eq!(rest(&["jog", "--axis", "insertion", "--by=-20mm"], 24.5), None);
    }
}
