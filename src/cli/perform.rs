//! Runs a session and records it: an insertion, or an operation of the stage.

use super::arguments::{About, RealTimeArguments};
use super::console::Console;
use super::ending::possible_withdrawal;
use super::mask::{mask_reader, no_warning};
use super::operator::Terminal;
use super::output::print_stderr;
use super::records::describe;
use super::stage::Motion;
use super::tracker::{load_replay, open_tracker, source_label};
use super::{Failure, Result, io_runtime};
use crate::archive::{Manifest, RunOutcome, sha256_hex};
use crate::config::{
    CanInterface, Config, ConfigError, GoalKind, Listen, OnFailure, TrackerSource,
};
use crate::emulator::VirtualStage;
use crate::emulator::fault::Fault;
use crate::operation::RunConfig;
use crate::runtime::{
    Clock, DriveOutcome, EmulationReport, Interrupt, Moment, Operator, Pace, RealTime, RunReport,
    Sink, TipSource, complete_record, run_live, run_virtual,
};
use crate::session::AxisMove;
use crate::telemetry::{Backpressure, Recorder, Scene, TelemetryError, check_room, utc_text};
use crate::transport::can::CanBus;
use crate::transport::link::Link;
use crate::transport::socketcan::{SocketCan, has_device};
use crate::transport::udp::UdpBus;
use crate::units::Time;
use clap::Args;
use serde_json::{Value, json};
use std::net::{SocketAddr, TcpListener};
use std::path::Path;
use std::time::SystemTime;
use tokio::runtime::Runtime;

/// The default address of `--live`, where viewers look for a run.
const LIVE_ADDRESS: &str = "127.0.0.1:9876";

/// A session to run, and what its record says about it.
pub(super) struct Job<'a> {
    pub(super) config: &'a Config,
    pub(super) run_config: RunConfig,
    /// The motion of the stage that is recorded; `None` for an insertion.
    pub(super) motion: Option<&'a Motion>,
    pub(super) options: Options,
}

/// How a session is run, shown and described.
#[derive(Debug, Clone, Default, Args)]
pub(super) struct Options {
    #[command(flatten)]
    pub(super) realtime: RealTimeArguments,
    #[command(flatten)]
    pub(super) about: About,
    /// Serve the run to rerun viewers as it goes; without an address at 127.0.0.1:9876.
    #[arg(long, value_name = "ADDRESS:PORT", num_args = 0..=1, require_equals = true,
          default_missing_value = LIVE_ADDRESS)]
    pub(super) live: Option<SocketAddr>,
    /// Show the run on the whole terminal; its keys hold, resume, step, change the speed and stop. An
    /// emulated run then takes as long as a real one.
    #[arg(long, conflicts_with = "quiet")]
    pub(super) console: bool,
    /// Show warnings and faults only.
    #[arg(long, short)]
    pub(super) quiet: bool,
    /// Runs an emulated stage in real time, so that an operator can practise.
    #[arg(skip)]
    pub(super) paced: bool,
}

/// A session that was run.
pub(super) struct Performed {
    pub(super) report: RunReport,
    /// How far the axes of an operation went.
    pub(super) done: Vec<AxisMove>,
    /// The operator has asked for the withdrawal of the needle.
    pub(super) wants_withdrawal: bool,
}

impl Options {
    /// The options for the withdrawal after a run on the console. Viewers keep showing the run.
    pub(super) fn of_withdrawal(&self) -> Self {
        Options { live: None, console: false, ..self.clone() }
    }
}

impl Job<'_> {
    /// Runs the session to its end. Everything that can be refused is refused before the run folder is
    /// made and before anything moves.
    pub(super) fn perform(self) -> Result<Performed> {
        let runtime = io_runtime()?;
        let interrupt = Interrupt::listen()?;
        let run_and_complete = |operator: &mut (dyn Operator + Send)| {
            let run = || self.run(operator, &runtime, &interrupt);
            let mut performed = self.options.realtime.run_isolated(run)?;
            complete_record(&mut performed.report, describe(self.config.clone()), operator);
            Ok(performed)
        };
        let performed = if self.options.console {
            let mut console = Console::open(self.config, interrupt.clone())?;
            let performed: Result<Performed> = run_and_complete(&mut console);
            let withdrawal = performed.as_ref().ok().map(|performed| {
                let possible = possible_withdrawal(self.config, &performed.report);
                possible.map(|withdrawal| withdrawal.to_string())
            });
            let wants_withdrawal = console.finish(withdrawal);
            performed.map(|performed| Performed { wants_withdrawal, ..performed })
        } else {
            let quiet = self.options.quiet;
            let mut terminal = Terminal::new(quiet, self.motion.is_none() && !quiet);
            let performed = run_and_complete(&mut terminal);
            terminal.finish();
            performed
        };
        // Last, because the runtime listens for signals until here.
        runtime.shutdown_background();
        performed
    }

    fn run(
        &self,
        operator: &mut dyn Operator,
        runtime: &Runtime,
        interrupt: &Interrupt,
    ) -> Result<Performed> {
        let config = self.config;
        // A withdrawal from tissue goes on, whatever happens to its record.
        let goes_on = match config.record.on_failure {
            _ if self.is_withdrawal() => Some("the withdrawal goes on"),
            OnFailure::GoOn => Some("the run goes on (record.on_failure)"),
            OnFailure::Stop => None,
        };
        let Options { realtime, live, paced, .. } = self.options;
        live.map_or(Ok(()), check_live_address)?;
        let mut session;
        let report = if config.is_emulated() {
            realtime.refuse_if_given("a run with can.interface = \"memory\" is in virtual time")?;
            let stage = VirtualStage::new(config.virtual_stage()?, Time::ZERO);
            let tips = match self.receives_tracker() {
                false => None,
                true => Some(match load_replay(&config.tracker, Time::ZERO)? {
                    Some(replay) => TipSource::Recorded(replay),
                    None => TipSource::Emulated {
                        tool: config.tracker.tool.clone(),
                        target: config.goal.tool.clone(),
                    },
                }),
            };
            let (recorder, _) = self.start_recording(SystemTime::now())?;
            let sink = Sink::new(recorder, goes_on, operator, interrupt);
            session = self.run_config.clone().begin(Time::ZERO);
            run_virtual(&mut session, stage, tips, paced.then(Pace::begin), sink)
        } else {
            realtime.check_permission()?;
            let mut bus = open_stage_bus(config)?;
            let clock = Clock::start();
            let mut tracker = self.open_tracker(runtime, clock)?;
            let (recorder, realtime) = self.start_recording(clock.origin_utc())?;
            let sink = Sink::new(recorder, goes_on, operator, interrupt);
            // Last, because the session's deadlines start to run here.
            session = self.run_config.clone().begin(clock.now());
            run_live(&mut session, bus.as_mut(), tracker.as_mut(), clock, realtime, sink)
        };
        Ok(Performed { report, done: session.moves().to_vec(), wants_withdrawal: false })
    }

    fn needs_tracker(&self) -> bool {
        match &self.run_config {
            RunConfig::Insertion(_) => true,
            RunConfig::Operation(_, operation) => operation.needs_tracker(),
        }
    }

    /// True if the session receives the tracker's stream. An operation that does not need the tracker still
    /// receives a live stream, for the record.
    fn receives_tracker(&self) -> bool {
        let tracker = &self.config.tracker;
        self.needs_tracker() || (tracker.file.is_none() && !tracker.is_standard_input())
    }

    /// The stream of the tracker's tool and, if the target is tracked, of the target's, if the session receives
    /// one.
    fn open_tracker(&self, runtime: &Runtime, clock: Clock) -> Result<Option<Link>> {
        let is_emulated = self.config.tip_source() == TrackerSource::Emulated;
        if !self.receives_tracker() || (is_emulated && !self.needs_tracker()) {
            return Ok(None);
        }
        let tools = [Some(&self.config.tracker.tool), self.config.goal.tool.as_ref()];
        let tools = tools.into_iter().flatten().cloned().collect();
        match open_tracker(self.config, tools, runtime, clock) {
            Err(failure) if !self.needs_tracker() => {
                print_stderr(format_args!("warning: {failure}; the tracker is not recorded"));
                Ok(None)
            }
            opened => opened.map(Some),
        }
    }

    fn is_withdrawal(&self) -> bool {
        matches!(self.motion, Some(Motion::Withdraw { .. }))
    }

    /// Creates the run folder if the disk has room, serves the run to viewers, and gives this thread its
    /// real-time priority. Only a withdrawal goes on without a recorder.
    fn start_recording(
        &self,
        started_utc: SystemTime,
    ) -> Result<(Result<Recorder, TelemetryError>, Option<RealTime>)> {
        let mut recorder = if self.is_withdrawal() {
            self.record_if_possible(started_utc)
        } else {
            self.check_record_dir()?;
            Ok(self.create_recorder(started_utc)?)
        };
        let served = recorder.as_mut().map_or(Ok(()), |recorder| self.serve(recorder));
        match served.and_then(|()| self.options.realtime.enter()) {
            Ok(realtime) => Ok((recorder, realtime)),
            Err(failure) => {
                if let Ok(recorder) = recorder {
                    recorder.discard();
                }
                Err(failure)
            }
        }
    }

    /// Checks the folder and creates the recorder as for any run, but only warns where that is refused.
    fn record_if_possible(&self, started_utc: SystemTime) -> Result<Recorder, TelemetryError> {
        let checked = self.check_record_dir();
        match self.create_recorder(started_utc) {
            Ok(recorder) => {
                if let Err(failure) = checked {
                    print_stderr(format_args!("warning: {failure}; the withdrawal goes on"));
                }
                Ok(recorder)
            }
            Err(failure) => {
                let failure = checked.err().unwrap_or(failure);
                print_stderr(format_args!("warning: {failure}; the withdrawal is not recorded"));
                Err(TelemetryError::Recording(failure.to_string()))
            }
        }
    }

    /// Checks that `record.dir` can be a folder, and that its disk has room.
    fn check_record_dir(&self) -> Result<()> {
        let dir = Path::new(&self.config.record.dir);
        if dir.is_file() {
            return Err(Failure::environment(format_args!(
                "record.dir {}: is a file, not a folder; name a folder, as in --set record.dir=runs",
                dir.display()
            )));
        }
        check_room(dir, self.config.record.free_mb_min).map_err(Failure::environment)
    }

    fn create_recorder(&self, started_utc: SystemTime) -> Result<Recorder> {
        let manifest = self.manifest(started_utc)?;
        let config_toml = self.config.to_toml().map_err(Failure::environment)?;
        let dir = Path::new(&self.config.record.dir);
        // Waiting is harmless in virtual time.
        let backpressure = match self.config.is_emulated() {
            true => Backpressure::Block,
            false => Backpressure::DropAndCount,
        };
        Recorder::create(dir, manifest, config_toml, backpressure).map_err(Failure::environment)
    }

    fn manifest(&self, started_utc: SystemTime) -> Result<Manifest> {
        let Job { config, motion, options: Options { about, .. }, .. } = self;
        let calibration = config.calibration_toml().map_err(Failure::environment)?;
        let rehearsal = config.emulator.rehearse.then(|| config.can.interface.to_string());
        let parts = [
            Some(&*config.name),
            motion.map(Motion::name),
            rehearsal.as_ref().map(|_| "rehearsal"),
        ];
        let name = parts.into_iter().flatten().collect::<Vec<_>>().join("-");
        Ok(Manifest {
            operation: motion.map(|motion| motion.name().to_owned()),
            arguments: motion.map(Motion::arguments).unwrap_or_default(),
            calibration_sha256: Some(sha256_hex(calibration.as_bytes())),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            git: option_env!("NEEDLE_BENCH_GIT").map(str::to_owned),
            rehearsal,
            bus: config.bus().to_string(),
            tracker: source_label(config),
            seed: config.is_emulated().then_some(config.emulator.seed),
            operator: about.operator.clone().or_else(|| config.record.operator.clone()),
            phantom: about.phantom.clone().or_else(|| config.record.phantom.clone()),
            note: about.note.clone(),
            ..Manifest::new(&name, utc_text(started_utc))
        })
    }

    /// Serves the run to viewers if an address is given, and prints the command that shows it.
    fn serve(&self, recorder: &mut Recorder) -> Result<()> {
        let Some(address) = self.options.live else { return Ok(()) };
        recorder
            .serve(address, &scene(self.config, self.motion.is_some())?)
            .map_err(Failure::environment)?;
        print_stderr(format_args!("live        rerun rerun+http://{address}/proxy"));
        Ok(())
    }
}

/// The scene that viewers show with the records of a run of `config`. For a motion of the stage, a goal that cannot be
/// read is no error.
pub(super) fn scene(config: &Config, is_motion: bool) -> Result<Scene, ConfigError> {
    let shadows = config.observer.observers().skip(1);
    Ok(Scene {
        x_wp: config.plane,
        insertion_mm: config.insertion.depth_mm,
        curvature_per_mm: config.needle.arc.curvature_per_mm(),
        goal: match config.goal.kind {
            GoalKind::Plane => None,
            GoalKind::Target if is_motion => config.to_plan(&mask_reader(None, no_warning)).ok(),
            GoalKind::Target => Some(config.to_plan(&mask_reader(None, no_warning))?),
        },
        truth: config.knows_truth(),
        shadows: shadows.map(|shadow| shadow.name().to_owned()).collect(),
        rotation_max_rad_per_mm: config.control.rotation_max_rad_per_mm(),
        tip_meas_age_max_s: config.tracker.hold.after.as_secs_f64(),
        stage: config.to_stage()?,
    })
}

/// Opens the bus of `config`. The bench receives only what `can.listen` selects, and each frame that it sends must
/// be confirmed on the bus.
pub(super) fn open_stage_bus(config: &Config) -> Result<Box<dyn CanBus>> {
    let CanInterface::Socket(name) = config.bus() else { return open_bus(config.bus()) };
    if !config.stage.hardware && has_device(name) {
        return Err(Failure::configuration(format_args!(
            "stage.hardware = false, but {name} has a device behind it: its drives can move; set \
             stage.hardware = true"
        )));
    }
    let mut bus = SocketCan::open(name)?;
    // As many SYNCs as may go unanswered, plus the current one.
    let syncs_max = usize::from(config.can.bus.missed_feedback_max) + 1;
    bus.confirm_sending(syncs_max)?;
    if config.can.listen == Listen::Stage {
        let (insertion, rotation) = (&config.stage.insertion, &config.stage.rotation);
        let nodes = [config.can.bus.bench_node, insertion.node, rotation.node];
        bus.listen_to(&nodes)?;
    }
    Ok(Box::new(bus))
}

/// Opens the bus that `interface` names.
pub(super) fn open_bus(interface: &CanInterface) -> Result<Box<dyn CanBus>> {
    match interface {
        CanInterface::Socket(name) => Ok(Box::new(SocketCan::open(name)?)),
        CanInterface::Udp(group) => Ok(Box::new(UdpBus::join(*group)?)),
        CanInterface::Memory => Err(Failure::configuration(format_args!(
            "can.interface = \"{interface}\" has no bus to open; name a CAN interface such as \
             \"can0\""
        ))),
    }
}

/// Checks that viewers can be served at `address`, before the run folder is created.
fn check_live_address(address: SocketAddr) -> Result<()> {
    if address.port() == 0 {
        return Err(Failure::configuration(format_args!(
            "--live: {address}: viewers must know the port; name one, as in --live={LIVE_ADDRESS}"
        )));
    }
    TcpListener::bind(address).map(drop).map_err(|error| {
        Failure::environment(format_args!(
            "--live: {address}: {error}; name another, as in --live=127.0.0.1:9877"
        ))
    })
}

/// The fields about the end of a session that are in the JSON of every session.
pub(super) fn end_json(report: &RunReport) -> Value {
    json!({
        "outcome": RunOutcome::from(&report.outcome),
        "stop_reason": report.outcome.stop_reason(),
        "duration_s": report.end.as_secs_f64(),
        "run_dir": report.run_dir.as_ref().map(|dir| dir.display().to_string()),
        "record_error": match &report.record {
            Ok(manifest) => manifest.faults.first().cloned(),
            Err(error) => Some(error.to_string()),
        },
        "emulated": report.emulated.as_ref().map(emulated_json),
    })
}

/// What is known only in an emulated run: its faults, and the true positions of its axes.
fn emulated_json(emulated: &EmulationReport) -> Value {
    let moment = |moment: &Moment| {
        json!({
            "time_s": moment.time.as_secs_f64(),
            "insertion_true_mm": moment.insertion_true_mm,
            "rotation_true_deg": moment.rotation_true_rad.to_degrees(),
        })
    };
    let fault = |(fault, struck): &(Fault, Moment)| json!({ "fault": fault.to_string(), "struck": moment(struck) });
    let drive = |drive: &DriveOutcome| {
        json!({
            "state": drive.state.to_string(),
            "left_operation": drive.left_operation_enabled.as_ref().map(moment),
        })
    };
    json!({
        "faults": emulated.faults.iter().map(fault).collect::<Vec<_>>(),
        "stopping": emulated.stopping.as_ref().map(moment),
        "drives": emulated.drives.each_ref().map(drive),
        "end": moment(&emulated.end),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Its record names the operator, and an emulated needle is withdrawn as slowly as a real one.
    #[test]
    fn a_withdrawal_after_a_run_keeps_its_operator_and_pace() {
        let operator = Some("Ann".to_owned());
        let about = About { operator: operator.clone(), ..About::default() };
        let live = "127.0.0.1:9876".parse().ok();
        let run = Options { about, live, console: true, paced: true, ..Options::default() };
        let after = run.of_withdrawal();
        assert_eq!(after.about.operator, operator);
        assert_eq!((after.live, after.console, after.paced), (None, false, true));
    }
}
