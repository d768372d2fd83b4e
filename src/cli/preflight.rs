//! Finds what the preflight judges: looks at the bus, the drives, the tracker, earlier runs, the disk.
//! Nothing is written and nothing moves.

use super::output::{print_stderr, print_stdout};
use super::records::earlier_run;
use super::stage::read_status;
use super::tracker::Listener;
use super::{ENVIRONMENT_FAILED, Failure, STOPPED};
use crate::archive::{Manifest, RunOutcome};
use crate::config::{CanInterface, Config, TrackerSource};
use crate::preflight::{
    BusFacts, Check, Listening, TrackerReport, Verdict, bus, calibrations, changes, disk, drive,
    plane, proof, start_roll, to_text, tracker, worst,
};
use crate::runtime::Interrupt;
use crate::stage::{Axis, AxisStatus};
use crate::telemetry::free_mb;
use nix::errno::Errno;
use nix::net::if_::if_nametoindex;
use nix::poll::{PollFd, PollFlags, poll};
use nix::sys::termios::{FlushArg, tcflush};
use serde_json::json;
use socketcan::nl::{CanInterface as Interface, CanState};
use std::io::{IsTerminal, Write as _};
use std::os::fd::AsFd as _;
use std::path::Path;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// How long `run` listens to the tracker.
const LISTEN: Duration = Duration::from_secs(2);
/// How often its question looks for a signal.
const ASK_EVERY_MS: u8 = 50;

/// The list, and what was found for it.
pub(super) struct Preflight {
    pub(super) checks: Vec<Check>,
    /// Of each drive on a bus.
    pub(super) drives: Vec<(Axis, AxisStatus)>,
    /// Of a tracker that can be listened to.
    pub(super) tracker: Option<TrackerReport>,
}

impl Preflight {
    /// Inspects everything that `config` names, and listens to its tracker for the time `listen`. `config` may be the
    /// rehearsal of `rig`: bus, drives and tracker are the emulated ones, calibrations and earlier runs
    /// those of the rig.
    pub(super) fn inspect(config: &Config, rig: &Config, listen: Duration) -> Self {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let now_unix_us = i64::try_from(now.as_micros()).unwrap_or(i64::MAX);
        let mut checks = bus(config, facts(config));
        let mut drives = Vec::new();
        if !rig.is_emulated() {
            match read_status(config) {
                Ok(reader) => {
                    for axis in Axis::BOTH {
                        let status = reader.status(axis);
                        drives.extend(status.clone().ok().map(|status| (axis, status)));
                        checks.extend(drive(config, axis, status));
                    }
                }
                Err(failure) => {
                    let drives = Check::new("drives", "no bus", "both answer");
                    checks.push(drives.unless(false, Verdict::Fail, failure.to_string()));
                }
            }
            let is_proof = |name: &str| name.starts_with("stage.") || name.starts_with("can.");
            let is_prove = |run: &Manifest| {
                let is_completed = run.outcome == Some(RunOutcome::Completed);
                is_completed && run.operation.as_deref() == Some("prove")
            };
            checks.push(proof(rig, earlier_run(rig, is_prove, is_proof).as_ref(), now_unix_us));
        }
        let heard = listen_to_tracker(config, listen);
        checks.extend(match &heard {
            Ok(Some(report)) => tracker(config, report),
            Ok(None) if config.tip_source() == TrackerSource::Emulated => {
                vec![Check::unlimited("tracker", "emulated: not listened to")]
            }
            Ok(None) => {
                let next = "watch it on its own: needle-bench tracker watch";
                let check = Check::unlimited("tracker", "standard input: not listened to");
                vec![check.unless(false, Verdict::Warn, next)]
            }
            Err(failure) => {
                let next = "see tracker.address and tracker.mode";
                let check = Check::new("tracker", failure.to_string(), "a connection");
                vec![check.unless(false, Verdict::Fail, next)]
            }
        });
        let report = heard.ok().flatten();
        checks.extend(calibrations(rig, now_unix_us));
        checks.extend(start_roll(rig));
        checks.extend(report.as_ref().and_then(|report| plane(config, report)));
        let dir = Path::new(&config.record.dir);
        let free_mb = free_mb(dir).map_err(|error| format!("{}: {error}", dir.display()));
        checks.push(disk(config, free_mb));
        if !rig.is_emulated() {
            let counts = |key: &str| !key.starts_with("emulator.") && !key.starts_with("record.");
            let last = earlier_run(rig, |run| run.operation.is_none(), counts);
            checks.push(changes(last.as_ref(), now_unix_us));
        }
        Preflight { checks, drives, tracker: report }
    }

    /// What the checks that failed found, a line each.
    pub(super) fn troubles(&self) -> Vec<String> {
        let failed = self.checks.iter().filter(|check| check.verdict == Verdict::Fail);
        failed
            .map(|Check { name, found, next_step, .. }| {
                let next = next_step.as_deref().unwrap_or_default();
                format!("{name}: {found}; {next}")
            })
            .collect()
    }
}

/// Shows the list before a run on hardware, and asks. Returns the list, which is empty on the virtual stage.
///
/// # Errors
/// The run is refused: by a row, by the operator, or because there is nobody to ask.
pub(super) fn before_run(config: &Config, yes: bool, as_json: bool) -> Result<Vec<Check>, Failure> {
    if !config.stage.hardware || config.is_emulated() {
        return Ok(Vec::new());
    }
    if !yes && !std::io::stdin().is_terminal() {
        return Err(Failure::configuration(
            "a run on hardware asks before it moves, and there is no terminal: read `needle-bench check \
             --connect`, then give --yes",
        ));
    }
    // From here on Ctrl-C is an answer, to the list as to the question.
    let interrupt = Interrupt::listen()?;
    let preflight = Preflight::inspect(config, config, LISTEN);
    print_stderr(to_text(&preflight.checks));
    let failed = preflight.troubles().len();
    let reason = match worst(&preflight.checks) {
        _ if interrupt.is_raised() => "operator: interrupted".to_owned(),
        Verdict::Fail => format!("preflight: {failed} of {} checks failed", preflight.checks.len()),
        _ if yes || is_confirmed(config, &interrupt) => return Ok(preflight.checks),
        _ => "not confirmed".to_owned(),
    };
    print_stderr(format_args!("stopped: {reason}; nothing has moved"));
    if as_json {
        print_stdout(json!({ "outcome": null, "error": reason, "preflight": preflight.checks }))?;
    }
    Err(Failure { message: None, status: if failed > 0 { ENVIRONMENT_FAILED } else { STOPPED } })
}

/// Shows the list of `rig` before its rehearsal `config`, which moves nothing and runs whatever the
/// list says. A `quiet` rehearsal shows only what did not pass.
pub(super) fn before_rehearsal(config: &Config, rig: &Config, quiet: bool) -> Vec<Check> {
    let checks = Preflight::inspect(config, rig, LISTEN).checks;
    let is_shown = |check: &&Check| !quiet || check.verdict != Verdict::Pass;
    let shown: Vec<Check> = checks.iter().filter(is_shown).cloned().collect();
    if !shown.is_empty() {
        print_stderr(to_text(&shown));
    }
    checks
}

/// Asks, until a line is given or a signal comes.
fn is_confirmed(config: &Config, interrupt: &Interrupt) -> bool {
    let insertion = &config.insertion;
    let stdin = std::io::stdin();
    // What was typed before the question is no answer to it.
    if tcflush(&stdin, FlushArg::TCIFLUSH).is_err() {
        return false;
    }
    eprint!("insert {} mm at {} mm/s? [y/N] ", insertion.depth_mm, insertion.speed_mm_per_s);
    let _ = std::io::stderr().flush();
    let is_given = || {
        let mut line = [PollFd::new(stdin.as_fd(), PollFlags::POLLIN)];
        !matches!(poll(&mut line, ASK_EVERY_MS), Ok(0) | Err(Errno::EINTR))
    };
    while !is_given() {
        if interrupt.is_raised() {
            return false;
        }
    }
    let mut answer = String::new();
    let read = std::io::stdin().read_line(&mut answer);
    read.is_ok() && matches!(answer.trim(), "y" | "Y" | "yes")
}

/// What the kernel says of the CAN interface; `None` where there is none of this name.
fn facts(config: &Config) -> Result<Option<BusFacts>, String> {
    let CanInterface::Socket(name) = config.bus() else { return Ok(Some(BusFacts::default())) };
    if if_nametoindex(name.as_str()) == Err(Errno::ENODEV) {
        return Ok(None);
    }
    let details = Interface::open(name).map_err(|error| error.to_string())?.details();
    let details = details.map_err(|error| error.to_string())?;
    let can = details.can;
    let state = can.state.map(|state| match state {
        CanState::ErrorActive => "error active",
        CanState::ErrorWarning => "error warning",
        CanState::ErrorPassive => "error passive",
        CanState::BusOff => "bus-off",
        CanState::Stopped => "stopped",
        CanState::Sleeping => "sleeping",
    });
    Ok(Some(BusFacts {
        is_up: details.is_up,
        state: state.map(str::to_owned),
        may_send: matches!(can.state, None | Some(CanState::ErrorActive | CanState::ErrorWarning)),
        bit_rate: can.bit_timing.map(|timing| timing.bitrate).filter(|rate| *rate > 0),
        restart_ms: can.restart_ms,
        errors: can.berr_counter.map(|counter| [counter.txerr, counter.rxerr]),
    }))
}

/// What came from the tracker; `None` where it cannot be listened to without a run.
fn listen_to_tracker(config: &Config, listen: Duration) -> Result<Option<TrackerReport>, Failure> {
    if config.tip_source() == TrackerSource::Emulated || config.tracker.is_standard_input() {
        return Ok(None);
    }
    let gate = config.tracker.to_gate();
    let gate = gate.unwrap_or_else(|_| config.tracker.to_unregistered_gate());
    let mut listener = Listener::open(config.clone(), false)?;
    let mut listening = Listening::new(gate, listener.origin_unix_ns());
    let since = listener.now();
    let until = since + listen;
    while let Some(event) = listener.next(until) {
        listening.take(&event);
    }
    let now = listener.now();
    Ok(Some(listening.report(since, now, || listener.missing())))
}
