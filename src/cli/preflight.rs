//! Inspects what the preflight judges: the bus, the drives, the tracker, earlier runs and the disk. Nothing moves,
//! and nothing is written but an empty file in the record's folder, which is removed at once.

use super::output::{print_stderr, print_stdout};
use super::records::earlier_run;
use super::stage::read_status;
use super::tracker::Listener;
use super::{ENVIRONMENT_FAILED, Failure, Result, STOPPED};
use crate::archive::{Manifest, RunOutcome};
use crate::config::{CanInterface, Config, TrackerSource};
use crate::preflight::{
    BusFacts, Check, Listening, TrackerReport, Verdict, bus, calibrations, changes, disk, drive,
    plane, proof, start_roll, to_text, tracker,
};
use crate::runtime::Interrupt;
use crate::stage::{Axis, AxisStatus};
use crate::telemetry::{free_mb, try_to_write};
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
/// Interval at which the question of `run` checks for a signal.
const SIGNAL_POLL_MS: u8 = 50;

/// The names of the two proofs in their records.
const PROVE: &str = "prove";
const PROVE_HANDEDNESS: &str = "prove-handedness";

/// True if this operation proves something that `key` of the configuration changes.
fn concerns(operation: &str, key: &str) -> bool {
    let is_one_of = |starts: [&str; 2]| starts.iter().any(|start| key.starts_with(start));
    is_one_of(["stage.", "can."])
        || operation == PROVE_HANDEDNESS && is_one_of(["tracker.registration", "tracker.tip_"])
}

/// The checks, and what was found for them.
pub(super) struct Preflight {
    pub(super) checks: Vec<Check>,
    /// The status of each drive that answered; empty for an emulated stage.
    pub(super) drives: Vec<(Axis, AxisStatus)>,
    /// The report on the tracker, if it can be listened to without a run.
    pub(super) tracker: Option<TrackerReport>,
}

impl Preflight {
    /// Inspects everything that `config` names, and listens to its tracker for the time `listen`. `config` may be
    /// the rehearsal of `rig`: then bus, drives and tracker are the emulated ones, but calibrations and earlier
    /// runs are those of the rig.
    pub(super) fn inspect(config: &Config, rig: &Config, listen: Duration) -> Self {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let now_unix_us = i64::try_from(now.as_micros()).unwrap_or(i64::MAX);
        let mut checks = bus(config, bus_facts(config));
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
                Err(failure) => checks.push(
                    Check::new("drives", "no bus", "both answer")
                        .with(Verdict::Fail, failure.to_string()),
                ),
            }
            for operation in [PROVE, PROVE_HANDEDNESS] {
                let is_completed_proof = |run: &Manifest| {
                    let is_completed = run.outcome == Some(RunOutcome::Completed);
                    is_completed && run.operation.as_deref() == Some(operation)
                };
                let last_proof =
                    earlier_run(rig, is_completed_proof, |key| concerns(operation, key));
                let is_of_handedness = operation == PROVE_HANDEDNESS;
                checks.push(proof(rig, is_of_handedness, last_proof.as_ref(), now_unix_us));
            }
        }
        let listened = listen_to_tracker(config, listen);
        checks.extend(match &listened {
            Ok(Some(report)) => tracker(config, report),
            Ok(None) if config.tip_source() == TrackerSource::Emulated => {
                vec![Check::unlimited("tracker", "emulated: not listened to")]
            }
            Ok(None) => {
                let next = "watch it on its own: needle-bench tracker watch CONFIG";
                let check = Check::unlimited("tracker", "standard input: not listened to");
                vec![check.with(Verdict::Warn, next)]
            }
            Err(failure) => {
                let next = "see tracker.address and tracker.mode";
                let check = Check::new("tracker", failure.to_string(), "a connection");
                vec![check.with(Verdict::Fail, next)]
            }
        });
        let report = listened.ok().flatten();
        checks.extend(calibrations(rig, now_unix_us));
        checks.extend(start_roll(rig));
        checks.extend(report.as_ref().and_then(|report| plane(config, report)));
        let dir = Path::new(&config.record.dir);
        let free_mb = try_to_write(dir).and_then(|()| free_mb(dir));
        let free_mb = free_mb.map_err(|error| format!("{}: {error}", dir.display()));
        checks.push(disk(config, free_mb));
        if !rig.is_emulated() {
            let is_insertion = |run: &Manifest| run.operation.is_none();
            let concerns_rig =
                |key: &str| !key.starts_with("emulator.") && !key.starts_with("record.");
            let last_insertion = earlier_run(rig, is_insertion, concerns_rig);
            checks.push(changes(last_insertion.as_ref(), now_unix_us));
        }
        Preflight { checks, drives, tracker: report }
    }
}

/// What the failed checks found and what to do next, a line each.
pub(super) fn troubles(checks: &[Check]) -> Vec<String> {
    let failed = checks.iter().filter(|check| check.verdict == Verdict::Fail);
    let line = |Check { name, found, next_step, .. }: &Check| {
        format!("{name}: {found}; {}", next_step.as_deref().unwrap_or_default())
    };
    failed.map(line).collect()
}

/// Shows the checks before a run on hardware, and asks the operator. Returns the checks; there are none on the
/// virtual stage.
///
/// # Errors
/// The run is refused: by a failed check, by the operator, or because there is no terminal to ask at.
pub(super) fn before_run(config: &Config, yes: bool, as_json: bool) -> Result<Vec<Check>> {
    if !config.stage.hardware || config.is_emulated() {
        return Ok(Vec::new());
    }
    if !yes && !std::io::stdin().is_terminal() {
        return Err(Failure::configuration(
            "a run on hardware asks before it moves, and there is no terminal: read `needle-bench check \
             CONFIG --connect`, then give --yes",
        ));
    }
    // From here on Ctrl-C means no, during the checks as at the question; it does not kill the program.
    let interrupt = Interrupt::listen()?;
    let preflight = Preflight::inspect(config, config, LISTEN);
    print_stderr(to_text(&preflight.checks));
    let is_confirmed = || yes || ask(config, &interrupt);
    let refusal = why_refused(&preflight.checks, || interrupt.is_raised(), is_confirmed);
    let Some((reason, status)) = refusal else {
        return Ok(preflight.checks);
    };
    print_stderr(format_args!("stopped: {reason}; nothing has moved"));
    if as_json {
        print_stdout(json!({ "outcome": null, "error": reason, "preflight": preflight.checks }))?;
    }
    Err(Failure { message: None, status })
}

/// Why the run does not start, and the exit status for it; `None` if it starts. Calls `ask` only if no check
/// failed.
fn why_refused(
    checks: &[Check],
    is_interrupted: impl Fn() -> bool,
    ask: impl FnOnce() -> bool,
) -> Option<(String, u8)> {
    let stopped = |reason: &str| Some((reason.to_owned(), STOPPED));
    let failed = troubles(checks).len();
    if is_interrupted() {
        stopped("operator: interrupted")
    } else if failed > 0 {
        let reason = format!("preflight: {failed} of {} checks failed", checks.len());
        Some((reason, ENVIRONMENT_FAILED))
    } else if ask() {
        None
    } else {
        stopped(if is_interrupted() { "operator: interrupted" } else { "not confirmed" })
    }
}

/// Shows the checks of `rig` before its rehearsal `config`. A rehearsal moves nothing, so it runs even if
/// checks fail. A `quiet` rehearsal shows only the checks that did not pass.
pub(super) fn before_rehearsal(config: &Config, rig: &Config, quiet: bool) -> Vec<Check> {
    let checks = Preflight::inspect(config, rig, LISTEN).checks;
    let is_shown = |check: &&Check| !quiet || check.verdict != Verdict::Pass;
    let shown: Vec<Check> = checks.iter().filter(is_shown).cloned().collect();
    if !shown.is_empty() {
        print_stderr(to_text(&shown));
    }
    checks
}

/// Asks the operator whether to insert. Waits for a line or a signal; true only for a yes.
fn ask(config: &Config, interrupt: &Interrupt) -> bool {
    let insertion = &config.insertion;
    let stdin = std::io::stdin();
    // What was typed before the question is no answer to it.
    if tcflush(&stdin, FlushArg::TCIFLUSH).is_err() {
        return false;
    }
    eprint!("insert {} mm at {} mm/s? [y/N] ", insertion.depth_mm, insertion.speed_mm_per_s);
    let _ = std::io::stderr().flush();
    let is_answered = || {
        let mut line = [PollFd::new(stdin.as_fd(), PollFlags::POLLIN)];
        !matches!(poll(&mut line, SIGNAL_POLL_MS), Ok(0) | Err(Errno::EINTR))
    };
    while !is_answered() {
        if interrupt.is_raised() {
            return false;
        }
    }
    let mut answer = String::new();
    let read = std::io::stdin().read_line(&mut answer);
    read.is_ok() && matches!(answer.trim(), "y" | "Y" | "yes")
}

/// What the kernel reports about the CAN interface; `None` if there is no interface of this name.
fn bus_facts(config: &Config) -> Result<Option<BusFacts>, String> {
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

/// Listens to the tracker; `None` if it cannot be listened to without a run.
fn listen_to_tracker(config: &Config, listen: Duration) -> Result<Option<TrackerReport>> {
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
    Ok(Some(listening.report(since, now, || listener.explain_missing())))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::stage::Motion;

    #[test]
    fn a_proof_concerns_the_keys_that_could_make_it_wrong() {
        for (words, name) in [("prove", PROVE), ("prove --handedness", PROVE_HANDEDNESS)] {
            assert_eq!(Motion::of(words).unwrap().name(), name);
            assert!(concerns(name, "stage.rotation.sign") && concerns(name, "can.sync_ms"));
            assert!(!concerns(name, "insertion.depth_mm") && !concerns(name, "tracker.address"));
        }
        for key in ["tracker.registration.x_mm", "tracker.tip_offset_mm"] {
            assert!(concerns(PROVE_HANDEDNESS, key) && !concerns(PROVE, key), "{key}");
        }
    }

    /// Ctrl-C during the checks may be the reason why some of them failed.
    #[test]
    fn an_interrupted_preflight_is_a_stop_whatever_its_checks_found() {
        let failed = [Check::new("disk", "9 MB", "100 MB").with(Verdict::Fail, "make room")];
        let status_of = |checks: &[Check], is_interrupted: bool, answer: bool| {
            why_refused(checks, || is_interrupted, || answer).map(|(_, status)| status)
        };
        assert_eq!(status_of(&failed, true, true), Some(STOPPED));
        assert_eq!(status_of(&failed, false, true), Some(ENVIRONMENT_FAILED));
        assert_eq!(status_of(&[], true, true), Some(STOPPED));
        assert_eq!(status_of(&[], false, false), Some(STOPPED));
        assert_eq!(status_of(&[], false, true), None);
    }
}
