//! `needle-bench stage`: reads and moves the stage without a needle to steer.

mod distance;
mod motion;
mod status;

pub(super) use self::motion::perform;
pub(super) use self::status::{drive_json, read_status};

use self::distance::Distance;
use super::arguments::{About, Configured, RealTimeArguments};
use super::output::print_stderr;
use super::records::last_run_on_a_bus;
use super::stop::stop;
use super::{Failure, Result};
use crate::config::{CanInterface, Config};
use crate::operation::{HandednessSettings, Move, MoveGoal, Operation, RunConfig};
use crate::session::AxisMove;
use crate::stage::{Axis, Reference, StageConfig};
use crate::tracker::{Gate, Registration};
use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{Args, Parser, Subcommand};
use nalgebra::Vector3;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub(super) struct Arguments {
    #[command(flatten)]
    before: StageArguments,
    /// Move the emulated stage of bench-config/virtual.toml, in memory and in virtual time.
    #[arg(long = "virtual", global = true)]
    emulated: bool,
    /// Rehearse this very configuration on emulated drives and an emulated tracker, in virtual time;
    /// no CAN interface and no connection is opened.
    #[arg(long, global = true, conflicts_with = "emulated")]
    rehearse: bool,
    /// One JSON object on stdout.
    #[arg(long, global = true)]
    json: bool,
    /// Show warnings and faults only.
    #[arg(long, short, global = true)]
    quiet: bool,
    #[command(flatten)]
    realtime: RealTimeArguments,
    #[command(subcommand)]
    command: StageCommand,
}

/// The stage, if it is named before the operation. `global = true` would not do: if an option is given on both
/// sides of the operation, clap drops the one before it.
#[derive(Debug, Args)]
pub(super) struct StageArguments {
    /// Configuration, which names the bus and the drives.
    #[arg(long)]
    config: Option<PathBuf>,
    /// Set a key of the configuration.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

impl StageArguments {
    /// Joins these arguments and those `after` the operation, in the order of the command line.
    fn joined(&self, after: &Configured) -> Result<Configured> {
        if let (Some(config), Some(again)) = (&self.config, after.path()) {
            return Err(Failure::configuration(format_args!(
                "--config is given twice, {} and {}: nothing was done, give one",
                config.display(),
                again.display()
            )));
        }
        let path = self.config.as_deref().or(after.path());
        Ok(Configured::new(path, [&self.set[..], &after.set].concat()))
    }
}

#[derive(Debug, Subcommand)]
enum StageCommand {
    /// Read identity, state, position and error history of both drives; nothing is written.
    Status {
        /// Read again each second, until Ctrl-C.
        #[arg(long)]
        watch: bool,
        #[command(flatten)]
        configured: Configured,
    },
    #[command(flatten)]
    Motion(Motion),
    /// Reset both drives' faults and clear their error history, once the cause is gone. Nothing gets power.
    Reset(Configured),
    /// Stop both axes at once, whichever program moves them, and take power off.
    Stop(Configured),
}

/// The arguments of every motion.
#[derive(Debug, Args)]
pub(super) struct Common {
    #[command(flatten)]
    about: About,
    #[command(flatten)]
    configured: Configured,
}

/// An operation that moves the stage and leaves a record.
#[derive(Debug, Parser)]
pub(super) enum Motion {
    /// Home the axes by their drives (CiA 402 mode 6). Take the needle off first: the axis moves.
    Home {
        /// Home this axis only, instead of every axis with a [homing] section.
        #[arg(long, value_parser = axis())]
        axis: Option<Axis>,
        /// Also an axis that is homed already and stands away from home: that home is lost.
        #[arg(long)]
        again: bool,
        #[command(flatten)]
        common: Common,
    },
    /// Move one axis by a distance or to a position, the other held.
    Jog {
        /// Which axis.
        #[arg(long, value_parser = axis())]
        axis: Axis,
        /// How far, with its unit: 2mm, -0.5mm, 10deg.
        #[arg(long, value_parser = Distance::parse, allow_hyphen_values = true,
              required_unless_present = "to", conflicts_with = "to")]
        by: Option<Distance>,
        /// The position to go to: 12mm, 90deg. It counts from stage.AXIS.zero, a position of the drive in
        /// counts. Refused with zero = "start": 0 is then where each command begins; give --by.
        #[arg(long, value_parser = Distance::parse, allow_hyphen_values = true)]
        to: Option<Distance>,
        /// How fast, instead of at its jog speed: 0.5mm/s, 20deg/s.
        #[arg(long, value_parser = Distance::parse_speed, allow_hyphen_values = true)]
        speed: Option<Distance>,
        #[command(flatten)]
        common: Common,
    },
    /// Pull the needle straight back along its path; the base is not turned.
    Withdraw {
        /// Distance to withdraw, instead of to depth 0: 20mm.
        #[arg(long, value_parser = Distance::parse, allow_hyphen_values = true)]
        by: Option<Distance>,
        /// Although the drive has lost its home, by a restart for example. The limits then count from where the
        /// axis stands: nothing but the distance keeps it from the end of its travel.
        #[arg(long, requires = "by")]
        unhomed: bool,
        /// How fast, instead of at its withdraw speed: 0.5mm/s.
        #[arg(long, value_parser = Distance::parse_speed, allow_hyphen_values = true)]
        speed: Option<Distance>,
        #[command(flatten)]
        common: Common,
    },
    /// Hold both axes and stop the bench's heartbeat, to prove that both drives notice and stop. SYNC and
    /// set-points go on. Some drives are in fault afterwards.
    Prove {
        /// Turn the base in air instead, by 45 degrees twice and back, and check that the tracked sensor
        /// turns the same way. The sensor must sit off the needle's axis.
        #[arg(long)]
        handedness: bool,
        #[command(flatten)]
        common: Common,
    },
}

impl Motion {
    /// The motion that the words of `line` name, as on the command line of `stage`.
    pub(super) fn of(line: &str) -> Result<Self, clap::Error> {
        Motion::try_parse_from(["stage"].into_iter().chain(line.split_whitespace()))
    }

    fn common(&self) -> &Common {
        match self {
            Motion::Home { common, .. }
            | Motion::Jog { common, .. }
            | Motion::Withdraw { common, .. }
            | Motion::Prove { common, .. } => common,
        }
    }

    /// The motion's name in the record.
    pub(super) fn name(&self) -> &'static str {
        match self {
            Motion::Home { .. } => "home",
            Motion::Jog { .. } => "jog",
            Motion::Withdraw { .. } => "withdraw",
            Motion::Prove { handedness: false, .. } => "prove",
            Motion::Prove { handedness: true, .. } => "prove-handedness",
        }
    }

    /// The options of its command line that say what to do, for the record.
    pub(super) fn arguments(&self) -> Vec<String> {
        let (axis, by, to, speed) = match self {
            Motion::Home { axis, .. } => (*axis, None, None, None),
            Motion::Jog { axis, by, to, speed, .. } => (Some(*axis), *by, *to, *speed),
            Motion::Withdraw { by, speed, .. } => (None, *by, None, *speed),
            Motion::Prove { .. } => (None, None, None, None),
        };
        let options = [
            ("--axis", axis.map(|axis| axis.to_string())),
            ("--by", by.map(|by| by.to_string())),
            ("--to", to.map(|to| to.to_string())),
            ("--speed", speed.map(|speed| format!("{speed}/s"))),
        ];
        let given = options.into_iter().filter_map(|(name, value)| Some([name.to_owned(), value?]));
        let flag = match self {
            Motion::Home { again: true, .. } => Some("--again"),
            Motion::Withdraw { unhomed: true, .. } => Some("--unhomed"),
            Motion::Prove { handedness: true, .. } => Some("--handedness"),
            _ => None,
        };
        given.flatten().chain(flag.map(str::to_owned)).collect()
    }

    /// The options of the `stage withdraw` that finishes this withdrawal after it went as far as `done`. `None` if it
    /// has not begun, since it may have been refused, if nothing remains, if the limit `min_mm` would refuse the
    /// remainder, and for another motion.
    fn remaining(&self, done: &[AxisMove], min_mm: f64) -> Option<String> {
        let Motion::Withdraw { by, unhomed, .. } = self else { return None };
        let (from_mm, to_mm) = done.iter().find_map(|done| Some((done.from?, done.to)))?;
        let Some(by_mm) = by.and_then(|by| by.along(Axis::Insertion).ok()) else {
            return Some(String::new());
        };
        // Rounded down to a tenth: rounded up, the remainder might pass the limit.
        let remaining_mm = (10.0 * (by_mm - (from_mm - to_mm)) + 1e-6).floor() / 10.0;
        let flag = if *unhomed { " --unhomed" } else { "" };
        (remaining_mm >= 0.05 && (*unhomed || from_mm - by_mm >= min_mm))
            .then(|| format!(" --by {remaining_mm:.1}mm{flag}"))
    }

    /// The configuration key that an emulated stage also needs for this motion to have an effect.
    fn emulator_key(&self, config: &Config) -> Option<String> {
        let emulator = &config.emulator;
        let is_needle_out = emulator.rehearse && emulator.insertion_start_mm == 0.0;
        match self {
            // As after power-on.
            Motion::Home { .. } if is_needle_out && emulator.rotation_start_deg == 0.0 => {
                Some("emulator.homed=false".to_owned())
            }
            Motion::Prove { handedness: true, .. } => sensor_off_axis(config),
            Motion::Withdraw { .. } if is_needle_out => {
                Some(format!("emulator.insertion_start_mm={:?}", config.insertion.depth_mm))
            }
            _ => None,
        }
    }

    /// The operation that this motion asks of the stage of `config`.
    pub(super) fn plan(&self, config: &Config) -> Result<RunConfig> {
        let mut stage = config.to_stage()?;
        let operation = match self {
            Motion::Home { axis: Some(axis), .. } if stage.axis(*axis).homing.is_none() => {
                return Err(Failure::configuration(format_args!(
                    "stage: {axis}: no homing is configured (stage.{axis}.homing)"
                )));
            }
            Motion::Home { axis, again, .. } => match Operation::home(&stage, *axis, *again) {
                Operation::Home { axes, .. } if axes.all(|chosen| !chosen) => {
                    return Err(Failure::configuration(
                        "no axis can be homed: neither [stage.insertion.homing] nor \
                         [stage.rotation.homing] is configured",
                    ));
                }
                homing => homing,
            },
            Motion::Jog { axis, by, to, speed, .. } => jog_goal(&stage, *axis, *by, *to)
                .and_then(|goal| with_speed(jog_move(config, *axis, goal), *speed, &stage))
                .map(Operation::Move)
                .map_err(Failure::configuration)?,
            Motion::Withdraw { by, unhomed, speed, .. } => {
                let withdrawal = withdrawal_move(config, *by)
                    .and_then(|withdrawal| with_speed(withdrawal, *speed, &stage))
                    .map_err(Failure::configuration)?;
                if let (true, MoveGoal::By(mm)) = (unhomed, withdrawal.goal) {
                    let axis = &mut stage.insertion;
                    if axis.reference != Reference::Homing {
                        return Err(Failure::configuration(
                            "--unhomed: the insertion axis needs no homing (stage.insertion.reference): leave it out",
                        ));
                    }
                    (axis.zero, axis.limits.min) = (None, mm);
                }
                Operation::Move(withdrawal)
            }
            Motion::Prove { handedness: false, .. } => Operation::Prove,
            Motion::Prove { handedness: true, .. } => {
                let gate = config.tracker.to_gate()?;
                // The sensor's own position: the tip is on the axis.
                let registration = Registration::new(*gate.registration.x_wt());
                let turn = MoveGoal::By(HANDEDNESS_TURN_DEG.to_radians());
                Operation::Handedness(Box::new(HandednessSettings {
                    gate: Gate { registration, workspace: None, ..gate },
                    axis: config.plane.rotation * Vector3::z(),
                    turn: jog_move(config, Axis::Rotation, turn),
                }))
            }
        };
        Ok(RunConfig::Operation(Box::new(stage), operation))
    }
}

/// A parser of an axis's name, for clap.
fn axis() -> impl TypedValueParser<Value = Axis> {
    PossibleValuesParser::new(["insertion", "rotation"]).map(|name| match name.as_str() {
        "rotation" => Axis::Rotation,
        _ => Axis::Insertion,
    })
}

pub(super) fn stage(arguments: &Arguments) -> Result<()> {
    let Arguments { emulated, rehearse, json, realtime, ref command, .. } = *arguments;
    let configured = match command {
        StageCommand::Motion(motion) => &motion.common().configured,
        StageCommand::Status { configured, .. }
        | StageCommand::Reset(configured)
        | StageCommand::Stop(configured) => configured,
    };
    let configured = arguments.before.joined(configured)?;
    if let StageCommand::Stop(_) = command {
        if !emulated && !rehearse {
            return stop(&configured, json);
        }
        let flag = if rehearse { "--rehearse" } else { "--virtual" };
        return Err(Failure::configuration(format_args!(
            "{flag}: the emulated stage does not move by itself: there is nothing to stop"
        )));
    }
    if !matches!(command, StageCommand::Motion(_)) {
        realtime.refuse_if_given("`stage status` and `reset` have no SYNC thread")?;
    }
    let configured = configured.rehearsed(rehearse);
    let emulator_key = |config: &Config| match command {
        StageCommand::Motion(motion) => motion.emulator_key(config),
        _ => None,
    };
    let (config, configured) = load_stage(configured, emulated || rehearse, emulator_key)?;
    match command {
        StageCommand::Motion(motion) => {
            // Without checksums: a withdrawal does not wait for a mask to be read.
            let config = configured.completed(&config, |_| None);
            motion::operate(&config, configured.whole_path(), motion, arguments)
        }
        StageCommand::Reset(_) => status::reset(&config, json),
        StageCommand::Status { watch: true, .. } => status::watch(&config, json),
        _ => status::status(&config, json),
    }
}

/// Loads the configuration of a stage to move, with the `emulator_key` that an emulated stage also needs. Refuses
/// the emulated stage in memory unless it is asked for.
pub(super) fn load_stage(
    mut configured: Configured,
    emulated: bool,
    emulator_key: impl Fn(&Config) -> Option<String>,
) -> Result<(Config, Configured)> {
    let mut config = configured.load(None)?;
    match (config.bus(), emulated) {
        // An operator who forgot to name the rig must not take the emulated stage for the rig.
        (CanInterface::Memory, false) => {
            let (what, next) = match configured.path() {
                None => {
                    ("no stage is named".to_owned(), "give its configuration, --config my-rig.toml")
                }
                Some(path) => (
                    format!("{}: can.interface is \"memory\", not a rig's", path.display()),
                    "name the rig's interface",
                ),
            };
            return Err(Failure::configuration(format_args!(
                "{what}: {next}, or rehearse on the emulated stage with --rehearse{}",
                last_run_on_a_bus("")
            )));
        }
        (CanInterface::Memory, true) | (_, false) => {}
        (interface, true) => {
            return Err(Failure::configuration(format_args!(
                "--virtual moves the emulated stage in memory, but can.interface is \"{interface}\": \
                 leave one of the two out, or rehearse this rig on the emulated stage with --rehearse"
            )));
        }
    }
    if let Some(key) = emulator_key(&config) {
        print_stderr(format_args!("emulated    {key}"));
        configured.set.push(key);
        config = configured.load(None)?;
    }
    Ok((config, configured))
}

/// A rotation has arrived at this distance from its goal.
const ROTATION_ARRIVAL_DEG: f64 = 0.1;

/// Turn of the base that shows the handedness of the tracked sensor, made twice.
const HANDEDNESS_TURN_DEG: f64 = 45.0;

/// Distance by which an emulated sensor on the axis is moved off it, to show its handedness.
const SENSOR_OFF_AXIS_MM: f64 = 5.0;

/// The configuration key that an emulated sensor on the axis needs to show how the base turns.
pub(super) fn sensor_off_axis(config: &Config) -> Option<String> {
    let is_on_axis = config.emulator.sensor.translation.xy().norm() == 0.0;
    (config.is_emulated() && is_on_axis)
        .then(|| format!("emulator.sensor.x_mm={SENSOR_OFF_AXIS_MM}"))
}

/// The goal of a jog.
fn jog_goal(
    stage: &StageConfig,
    axis: Axis,
    by: Option<Distance>,
    to: Option<Distance>,
) -> Result<MoveGoal, String> {
    match (by, to) {
        (Some(by), _) => by.nonzero_along(axis, stage.axis(axis).ratio).map(MoveGoal::By),
        (None, Some(to)) if stage.axis(axis).zero.is_some() => to.along(axis).map(MoveGoal::To),
        (None, Some(_)) => Err(format!(
            "--to: stage.{axis}.zero is \"start\": positions count from where each command begins, \
             so --to would mean --by; give --by, or set stage.{axis}.zero in counts of the drive"
        )),
        (None, None) => Err("give --by or --to".to_owned()),
    }
}

/// `jog` at `speed`, if one is given.
fn with_speed(jog: Move, speed: Option<Distance>, stage: &StageConfig) -> Result<Move, String> {
    let Some(asked) = speed else { return Ok(jog) };
    let speed = asked.along(jog.axis)?;
    let max = stage.axis(jog.axis).limits.speed_max;
    if speed > 0.0 && speed <= max {
        return Ok(Move { speed, ..jog });
    }
    let (max, unit) = jog.axis.in_unit(max);
    // Undo the rounding of the conversion to radians and back.
    let max = (max * 1e9).round() / 1e9;
    Err(format!("--speed is {asked}/s, allowed: over 0, up to {max}{unit}/s"))
}

/// A move of `axis` at its jog speed.
fn jog_move(config: &Config, axis: Axis, goal: MoveGoal) -> Move {
    let arrival = match axis {
        Axis::Insertion => config.insertion.arrival_mm,
        Axis::Rotation => ROTATION_ARRIVAL_DEG.to_radians(),
    };
    let section = config.stage.axis(axis);
    let (speed, acceleration) = (section.jog_speed, section.jog_acceleration);
    Move { axis, goal, speed, acceleration, arrival }
}

/// The move that withdraws the needle: by a distance, or to depth 0, which only an axis with a configured zero has.
fn withdrawal_move(config: &Config, by: Option<Distance>) -> Result<Move, String> {
    let insertion = &config.stage.insertion;
    let along = |by: Distance| by.nonzero_along(Axis::Insertion, insertion.ratio);
    let goal = match by.map(along).transpose()? {
        Some(mm) if mm > 0.0 => MoveGoal::By(-mm),
        Some(mm) => {
            let by = mm.abs();
            return Err(format!(
                "withdraw pulls back: --by {mm}mm is not over 0; give the distance alone, --by {by}mm"
            ));
        }
        None if insertion.zero.is_some() => MoveGoal::BackTo(0.0),
        None => {
            return Err(
                "stage.insertion.zero is \"start\": the bench does not know the depth where the \
                        needle went in; say how far to withdraw, --by 20mm"
                    .to_owned(),
            );
        }
    };
    let speed = insertion.withdraw_speed.unwrap_or(insertion.jog_speed);
    Ok(Move { speed, ..jog_move(config, Axis::Insertion, goal) })
}

#[cfg(test)]
mod tests;
