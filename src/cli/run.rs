//! `needle-bench run`: one insertion.

use super::about::About;
use super::ending::{ending, outcome_name, plane_missed_by_mm, record_error, status};
use super::operator::Terminal;
use super::output::{say, tell};
use super::realtime::RealTimeArguments;
use super::recording::complete;
use super::sources::load_with_warnings;
use super::stage::Operation;
use super::tracker::{described, open_tracker, replay};
use super::{Failure, io_runtime};
use crate::archive::{Manifest, sha256_hex};
use crate::config::{CanInterface, Config, ConfigError, Listen, OnFailure, SEED_MAX};
use crate::emulator::VirtualStage;
use crate::emulator::fault::Fault;
use crate::runtime::{
    Clock, DriveEnd, Emulated, Interrupt, Moment, OnRecordFailure, RunReport, Sink, Tips,
    gates_to_json, run_live, run_virtual,
};
use crate::session::{Outcome, Session};
use crate::telemetry::{Backpressure, Recorder, Scene, check_room, utc_text};
use crate::transport::can::CanBus;
use crate::transport::socketcan::SocketCan;
use crate::transport::udp::UdpBus;
use crate::units::Time;
use clap::Args;
use serde_json::{Value, json};
use std::fmt::Display;
use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::SystemTime;

/// Where viewers look for a run, without being told.
const LIVE_ADDRESS: &str = "127.0.0.1:9876";

#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Configuration; without one, the virtual stage of bench-config/virtual.toml.
    config: Option<PathBuf>,
    /// Set a key of the configuration, for example 'insertion.depth_mm=200'.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Draw the emulated start and needle from [study] by this seed, and the noise: the trial of a
    /// study that has this seed. (The noise alone: --set emulator.seed=SEED.)
    #[arg(long, value_parser = seed, allow_negative_numbers = true)]
    seed: Option<u64>,
    #[command(flatten)]
    realtime: RealTimeArguments,
    #[command(flatten)]
    about: About,
    /// Serve the run to rerun viewers as it goes; without an address at 127.0.0.1:9876.
    #[arg(long, value_name = "ADDRESS:PORT", num_args = 0..=1, require_equals = true,
          default_missing_value = LIVE_ADDRESS)]
    live: Option<SocketAddr>,
    /// One JSON object on stdout.
    #[arg(long)]
    pub(super) json: bool,
    /// Show warnings and faults only.
    #[arg(long, short)]
    quiet: bool,
}

/// A seed of the command line.
pub(super) fn seed(text: &str) -> Result<u64, String> {
    let seed = text.parse().ok().filter(|seed| *seed <= SEED_MAX);
    seed.ok_or_else(|| format!("a whole number from 0 to {SEED_MAX}"))
}

pub(super) fn run(arguments: &Arguments) -> Result<ExitCode, Failure> {
    let (mut config, warnings) =
        load_with_warnings(arguments.config.as_deref(), None, &arguments.set)?;
    for warning in warnings {
        tell(format_args!("warning: {warning}"));
    }
    if let Some(seed) = arguments.seed {
        if config.can.interface != CanInterface::Memory {
            return Err(Failure::Configuration(format!(
                "--seed draws an emulated needle, but can.interface is \"{}\": its needle is where \
                 it is",
                config.can.interface
            )));
        }
        config = config.drawn(seed);
    }
    let mut terminal = Terminal::new(arguments.quiet);
    let told = (&arguments.about, arguments.live);
    let report = insert(&config, arguments.realtime, told, &mut terminal);
    let report = report.map(|report| complete(report, &config, &mut terminal));
    terminal.finish();
    let report = report?;
    if arguments.json {
        say(to_json(&report))?;
    } else {
        say(summary(&config, &report))?;
    }
    Ok(ExitCode::from(status(&config, &report)))
}

/// Runs the insertion that `config` describes, where `realtime` says so in real time, and served to
/// viewers at `live`. Everything that can be refused is refused before the run folder is made and
/// before anything moves.
fn insert(
    config: &Config,
    realtime: RealTimeArguments,
    (about, live): (&About, Option<SocketAddr>),
    terminal: &mut Terminal,
) -> Result<RunReport, Failure> {
    let wrong = |error: &dyn Display| Failure::Configuration(error.to_string());
    let settings = config.session().map_err(|error| wrong(&error))?;
    settings.check().map_err(|error| wrong(&error))?;
    live.map_or(Ok(()), is_free)?;
    let runtime = io_runtime()?;
    let interrupt = Interrupt::listen(&runtime).map_err(Failure::environment)?;
    if config.can.interface == CanInterface::Memory {
        realtime.refuse_virtual_time()?;
        let stage = config.virtual_stage().map_err(|error| wrong(&error))?;
        let stage = VirtualStage::new(stage, Time::ZERO);
        let tips = match replay(&config.tracker, Time::ZERO)? {
            Some(replay) => Tips::Recorded(replay),
            None => Tips::Emulated { tool: config.tracker.tool.clone() },
        };
        let mut recorder = record(config, None, about, SystemTime::now(), Backpressure::Block)?;
        if let Err(failure) = serve(&mut recorder, live, config) {
            recorder.discard();
            return Err(failure);
        }
        let sink = Sink::new(recorder, on_record_failure(config), terminal);
        let mut session = Session::new(settings, Time::ZERO).map_err(|error| wrong(&error))?;
        return Ok(run_virtual(&mut session, stage, Some(tips), sink, &interrupt));
    }
    realtime.try_out()?;
    let mut bus = open_stage_bus(config)?;
    let clock = Clock::start();
    let mut tracker = open_tracker(config, &runtime, clock)?;
    let mut recorder = record(config, None, about, clock.origin_utc(), Backpressure::DropAndCount)?;
    let ready = serve(&mut recorder, live, config).and_then(|()| realtime.enter());
    let realtime = match ready {
        Ok(realtime) => realtime,
        Err(failure) => {
            recorder.discard();
            return Err(failure);
        }
    };
    let sink = Sink::new(recorder, on_record_failure(config), terminal);
    // Last, since the session's deadlines begin to run.
    let mut session = Session::new(settings, clock.now()).map_err(|error| wrong(&error))?;
    let (bus, tips) = (bus.as_mut(), Some(&mut tracker));
    let report = run_live(&mut session, bus, tips, clock, realtime, sink, &interrupt);
    drop(tracker);
    runtime.shutdown_background();
    Ok(report)
}

/// The bus of `config`, on which the bench hears what `can.listen` says and every frame that it sends
/// must be seen to leave.
pub(super) fn open_stage_bus(config: &Config) -> Result<Box<dyn CanBus>, Failure> {
    let CanInterface::Socket(name) = &config.can.interface else {
        return open_bus(&config.can.interface);
    };
    let mut bus = SocketCan::open(name).map_err(Failure::environment)?;
    // As many as may go unanswered, and the one under way.
    let syncs_max = usize::from(config.can.missed_feedback_max) + 1;
    bus.confirm_sending(syncs_max).map_err(Failure::environment)?;
    if config.can.listen == Listen::Stage {
        let (insertion, rotation) = (&config.stage.insertion.drive, &config.stage.rotation.drive);
        let nodes = [config.can.bench_node, insertion.node, rotation.node];
        bus.listen_to(&nodes).map_err(Failure::environment)?;
    }
    Ok(Box::new(bus))
}

/// The bus that `interface` names.
pub(super) fn open_bus(interface: &CanInterface) -> Result<Box<dyn CanBus>, Failure> {
    match interface {
        CanInterface::Socket(name) => {
            let bus = SocketCan::open(name).map_err(Failure::environment)?;
            Ok(Box::new(bus))
        }
        CanInterface::Udp(group) => {
            let bus = UdpBus::join(*group).map_err(Failure::environment)?;
            Ok(Box::new(bus))
        }
        CanInterface::Memory => Err(Failure::Configuration(format!(
            "can.interface = \"{interface}\" has no bus to open; name a CAN interface such as \
             \"can0\""
        ))),
    }
}

/// Whether viewers can be served at `address`: asked before there is a run folder.
fn is_free(address: SocketAddr) -> Result<(), Failure> {
    if address.port() == 0 {
        return Err(Failure::Configuration(format!(
            "--live: {address}: viewers have to know the port; name one, as in \
             --live={LIVE_ADDRESS}"
        )));
    }
    match TcpListener::bind(address) {
        Ok(_) => Ok(()),
        Err(error) => Err(Failure::Environment(format!(
            "--live: {address}: {error}; name another, as in --live=127.0.0.1:9877"
        ))),
    }
}

/// Serves the run to viewers at `address`, where there is one, and says how to look.
fn serve(
    recorder: &mut Recorder,
    address: Option<SocketAddr>,
    config: &Config,
) -> Result<(), Failure> {
    let Some(address) = address else { return Ok(()) };
    let scene = scene(config).map_err(|error| Failure::Configuration(error.to_string()))?;
    recorder.serve(address, scene).map_err(Failure::environment)?;
    tell(format_args!("live        rerun rerun+http://{address}/proxy"));
    Ok(())
}

/// What `config` wants of a run whose record fails.
pub(super) fn on_record_failure(config: &Config) -> OnRecordFailure {
    match config.record.on_failure {
        OnFailure::Stop => OnRecordFailure::Stop,
        OnFailure::GoOn => OnRecordFailure::GoOn,
    }
}

/// Makes the folder of a run, an insertion or the stage's `operation`, where there is room for one.
pub(super) fn record(
    config: &Config,
    operation: Option<&Operation>,
    about: &About,
    started_utc: SystemTime,
    backpressure: Backpressure,
) -> Result<Recorder, Failure> {
    let calibration = config.calibration_toml().map_err(Failure::environment)?;
    let name = &config.name;
    let name = operation.map_or(name.clone(), |operation| format!("{name}-{}", operation.name()));
    let emulated = config.can.interface == CanInterface::Memory;
    let manifest = Manifest {
        operation: operation.map(|operation| operation.name().to_owned()),
        arguments: operation.map(Operation::arguments).unwrap_or_default(),
        calibration_sha256: Some(sha256_hex(calibration.as_bytes())),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        git: option_env!("NEEDLE_BENCH_GIT").map(str::to_owned),
        bus: config.can.interface.to_string(),
        tracker: described(&config.tracker),
        seed: emulated.then_some(config.emulator.seed),
        operator: about.operator.clone().or_else(|| config.record.operator.clone()),
        phantom: about.phantom.clone().or_else(|| config.record.phantom.clone()),
        note: about.note.clone(),
        ..Manifest::new(&name, utc_text(started_utc))
    };
    let dir = Path::new(&config.record.dir);
    if dir.is_file() {
        return Err(Failure::Environment(format!(
            "record.dir {}: is a file, not a folder; name a folder, as in --set record.dir=runs",
            dir.display()
        )));
    }
    check_room(dir, config.record.free_mb_min).map_err(Failure::environment)?;
    let config_toml = config.to_toml().map_err(Failure::environment)?;
    Recorder::create(dir, manifest, config_toml, backpressure).map_err(Failure::environment)
}

/// What the viewer shows of a run of `config` besides its records.
pub(super) fn scene(config: &Config) -> Result<Scene, ConfigError> {
    Ok(Scene {
        x_wp: config.plane.to_pose(),
        insertion_mm: config.insertion.depth_mm,
        curvature_per_mm: config.needle.arc.curvature_per_mm(),
        truth: config.can.interface == CanInterface::Memory,
        shadows: config.observer.shadows_apart().iter().map(ToString::to_string).collect(),
        rotation_max_rad_per_mm: config.control.rotation_max_rad_per_mm().0,
        tip_meas_age_max_s: config.tracker.hold.after.as_secs_f64(),
        stage: config.stage.to_stage(&config.can)?,
    })
}

fn to_json(report: &RunReport) -> Value {
    let RunReport { outcome, figures, gates, run_dir, record, end, timing, emulated } = report;
    json!({
        "outcome": outcome_name(outcome),
        "stop_reason": outcome.stop_reason(),
        "insertion_mm": figures.insertion_mm(),
        "steps": figures.steps(),
        "steps_saturated": figures.saturated(),
        "duration_s": end.as_secs_f64(),
        "timing": timing,
        "tracker_samples": gates_to_json(gates),
        "off_plane_rms_mm": figures.off_plane_rms_mm(),
        "settling_mm": figures.settling_mm(),
        "plane_missed_by_mm": plane_missed_by_mm(report),
        "estimate_rms": figures.estimate_rms(),
        "final_error": figures.final_error(),
        "run_dir": run_dir.display().to_string(),
        "record_dropped": record.as_ref().ok().map(|finished| finished.dropped),
        "record_error": record_error(record),
        "emulated": emulated.as_ref().map(emulated_json),
    })
}

/// What only an emulated run knows: its faults, and the true way of its axes.
pub(super) fn emulated_json(emulated: &Emulated) -> Value {
    let moment = |moment: &Moment| {
        json!({
            "time_s": moment.time.as_secs_f64(),
            "insertion_true_mm": moment.insertion_true_mm,
            "rotation_true_deg": moment.rotation_true_rad.to_degrees(),
        })
    };
    let fault = |(fault, struck): &(Fault, Moment)| json!({ "fault": fault.to_string(), "struck": moment(struck) });
    let drive = |drive: &DriveEnd| {
        json!({
            "state": drive.state.to_string(),
            "left_operation": drive.left_operation.as_ref().map(moment),
        })
    };
    json!({
        "faults": emulated.faults.iter().map(fault).collect::<Vec<_>>(),
        "stopping": emulated.stopping.as_ref().map(moment),
        "drives": emulated.drives.each_ref().map(drive),
        "end": moment(&emulated.end),
    })
}

/// The summary: one screen, the stop reason last.
fn summary(config: &Config, report: &RunReport) -> String {
    let figures = &report.figures;
    let time =
        if config.can.interface == CanInterface::Memory { "virtual time" } else { "real time" };
    let mut lines = vec![format!(
        "inserted    {:.1} mm of {:.1} in {:.1} s of {time}, {} steps ({} saturated)",
        figures.insertion_mm(),
        config.insertion.depth_mm,
        report.end.as_secs_f64(),
        figures.steps(),
        figures.saturated()
    )];
    lines.push(format!("tracker     {}", report.gates));
    let third = match &report.outcome {
        Outcome::Completed => "the last third".to_owned(),
        Outcome::Stopped(_) => {
            format!("the last third of {:.1} mm, stopped", figures.insertion_mm())
        }
    };
    let known = if figures.final_error().is_some() { "true" } else { "estimated" };
    if let Some(off_plane_mm) = figures.off_plane_rms_mm() {
        let settled = figures.settling_mm().map_or("not within 1 mm at the end".to_owned(), |mm| {
            format!("within 1 mm from {mm:.0} mm on")
        });
        lines.push(format!(
            "off plane   {off_plane_mm:.3} mm RMS over {third} ({known}); {settled}"
        ));
    }
    if let Some(rms) = figures.estimate_rms() {
        lines.push(format!("estimate    {rms} RMS over {third}"));
    }
    if let Some(error) = figures.final_error() {
        lines.push(format!("at the end  {error}"));
    }
    lines.extend(report.timing.iter().map(|timing| format!("timing      {timing}")));
    lines.extend(ending(report));
    lines.join("\n")
}
