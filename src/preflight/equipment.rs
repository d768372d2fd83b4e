//! Judges the present state of the bus, the drives, the tracker and the disk.

use super::Check;
use super::Verdict::{Fail, Warn};
use super::listening::{POSITIONS_MIN, TrackerReport};
use crate::config::{CanInterface, Config};
use crate::math;
use crate::session::PlaneOutOfReach;
use crate::stage::{Axis, AxisConfig, AxisLimits, AxisStatus, Reference, may_have_power};
use crate::tracker::{StampPolicy, Workspace};
use crate::units::IN_METRES;
use nalgebra::Vector3;
use std::f64::consts::TAU;

/// Bits on the wire in one SYNC period: SYNC, two set-points, two answers, and a share of heartbeats.
const CYCLE_BITS: f64 = 600.0;
/// Largest load of a bus that does not delay set-points.
const LOAD_MAX: f64 = 0.5;
/// A rotation should begin at least this far from its limits, rad, or a quarter of its range: the control law turns it.
const ROTATION_ROOM_RAD: f64 = TAU;
/// Error counter at which a node reports "error warning" (ISO 11898-1).
const ERRORS_WARN: u16 = 96;
/// Largest ratio of the noise that is measured in a short rest to the configured noise.
const NOISE_MAX: f64 = 1.5;
/// Smallest such ratio: wider gates find a jump late.
const NOISE_MIN: f64 = 0.1;
/// Largest depth that should be inserted without a tip position, mm.
const BLIND_MAX_MM: f64 = 5.0;
/// Largest difference between the clocks of two machines, s.
const SKEW_MAX_S: f64 = 1.0;
/// Angles of the tip's heading to the configured start heading, degrees: the check warns, and fails …
const HEADING_DEG: [f64; 2] = [15.0, 30.0];
/// … above them, and above this many standard deviations of the configured heading.
const HEADING_SDS: f64 = 3.0;
/// By how many seconds stamps may advance in a second.
const STAMP_PACE: std::ops::Range<f64> = 0.5..2.0;
/// Fewest positions while the needle advances by `tracker.hold_after_mm`.
const POSITIONS_PER_HOLD: f64 = 2.0;

/// What the operating system reports about a CAN interface; `None` for what it does not report.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct BusFacts {
    /// True if the interface is up.
    pub is_up: bool,
    /// State of the controller, in words.
    pub state: Option<String>,
    /// True if the controller may send: it is neither bus-off nor error passive.
    pub may_send: bool,
    /// Bit rate, bit/s.
    pub bit_rate: Option<u32>,
    /// Time after which the interface restarts after a bus-off, ms; 0 is never.
    pub restart_ms: Option<u32>,
    /// Error counters: sending, receiving.
    pub errors: Option<[u16; 2]>,
}

/// Checks the bus of `config` by the `facts` of the system; `Ok(None)` if the interface does not exist.
pub fn bus(config: &Config, facts: Result<Option<BusFacts>, String>) -> Vec<Check> {
    const UP: &str = "up, error active";
    const BRING_UP: &str = "bitrate 1000000 restart-ms 0";
    const CABLE: &str = "check cable, termination and the bit rate of both drives";
    let CanInterface::Socket(name) = config.bus() else {
        return vec![Check::unlimited("bus", format!("{}: not a CAN interface", config.bus()))];
    };
    let virtual_kind = ["vcan", "vxcan"].into_iter().find(|kind| name.starts_with(kind));
    let inspect = format!("inspect it yourself: ip -details -statistics link show {name}");
    let set = |what: &str| {
        format!("sudo ip link set {name} down; sudo ip link set {name} up type can {what}")
    };
    let BusFacts { is_up, state, may_send, bit_rate, restart_ms, errors } = match facts {
        Ok(Some(facts)) => facts,
        Ok(None) => {
            let next = match virtual_kind {
                Some(kind) => {
                    format!("sudo ip link add dev {name} type {kind}; sudo ip link set {name} up")
                }
                None => format!(
                    "plug the adapter in, then sudo ip link set {name} up type can {BRING_UP}"
                ),
            };
            let check = Check::new("bus", format!("no interface {name}"), UP);
            return vec![check.with(Fail, next)];
        }
        Err(error) => {
            let check = Check::new("bus", format!("{name}: {error}"), UP);
            return vec![check.with(Warn, inspect)];
        }
    };
    let state = state.map(|state| format!(", {state}")).unwrap_or_default();
    let found = format!("{name} {}{state}", if is_up { "up" } else { "down" });
    let next = match (virtual_kind, bit_rate) {
        (Some(_), _) => format!("sudo ip link set {name} up"),
        (None, Some(rate)) => set(&format!("bitrate {rate} restart-ms 0")),
        (None, None) => set(BRING_UP),
    };
    let bus = Check::new("bus", found, UP).unless(is_up && may_send, Fail, next);

    // A virtual interface has neither bit rate nor counters.
    let figure = |name: &str, found: Option<String>, limit: &str| {
        let is_complete = found.is_some() || !config.stage.hardware;
        let found = found.unwrap_or_else(|| "not reported by the interface".to_owned());
        Check::new(name, found, limit).unless(is_complete, Warn, &inspect)
    };
    let load_of =
        |rate: u32| CYCLE_BITS * 1e3 / f64::from(config.can.bus.sync_ms) / f64::from(rate);
    let found = bit_rate.map(|rate| {
        let (kbit_per_s, load) = (f64::from(rate) * 1e-3, load_of(rate) * 1e2);
        format!("{kbit_per_s} kbit/s, {load:.0}% load by SYNC")
    });
    let is_light = bit_rate.is_none_or(|rate| load_of(rate) <= LOAD_MAX);
    let rate = figure("bus bit rate", found, &format!("load up to {:.0}%", LOAD_MAX * 1e2));
    let rate = rate.unless(is_light, Warn, "raise can.sync_ms");
    let is_possible = bit_rate.is_none_or(|rate| load_of(rate) < 1.0);
    let rate = rate.unless(is_possible, Fail, "raise can.sync_ms, or the bit rate");

    let found = restart_ms.map(|ms| format!("{ms} ms"));
    let restart = figure("bus restart-ms", found, "0: a bus-off is final");
    let restart = restart.unless(restart_ms.is_none_or(|ms| ms == 0), Fail, set("restart-ms 0"));

    let found = errors.map(|[sent, received]| format!("{sent} sending, {received} receiving"));
    let is_quiet = errors.is_none_or(|counts| counts.iter().all(|count| *count < ERRORS_WARN));
    let counters = figure("bus error counters", found, &format!("under {ERRORS_WARN}"));
    vec![bus, rate, restart, counters.unless(is_quiet, Warn, CABLE)]
}

/// Checks the drive of `axis` by the status that it reports.
pub fn drive(config: &Config, axis: Axis, status: Result<AxisStatus, String>) -> Vec<Check> {
    const POWERED: &str =
        "it has power: is another program moving it? Stop it: needle-bench stop CONFIG";
    const HISTORY: &str = "needle-bench stage reset CONFIG clears it once it is understood";
    let name = format!("{axis} drive");
    let status = match status {
        Ok(status) => status,
        Err(trouble) => {
            let can = &config.can;
            let limit =
                format!("{} requests of {} ms", can.bus.sdo_attempts, can.bus.sdo_timeout_ms);
            let next = "is it powered, and are node and bit rate right?";
            return vec![Check::new(name, trouble, limit).with(Fail, next)];
        }
    };
    let required = [
        ("device type (0x1000)", status.device_type.is_some()),
        ("position (0x6064)", status.position_counts.is_some()),
    ];
    let missing = required.iter().filter(|(_, is_present)| !is_present).map(|(object, _)| *object);
    let missing = missing.collect::<Vec<_>>().join(" and ");
    if !missing.is_empty() {
        let found = format!("node {} does not give its {missing}", status.node);
        let check = Check::new(name, found, required.map(|(object, _)| object).join(", "));
        return vec![check.with(Fail, "is it a CiA 402 drive?")];
    }
    let drive = config.stage.axis(axis);
    let AxisStatus { node, identity, statusword, extra_answers, .. } = status;
    let is_healthy = !statusword.is_fault() || config.stage.power.fault_reset_on_start;
    let is_named = drive.vendor_id.is_some() && drive.product_code.is_some();
    let is_right = drive.vendor_id.is_none_or(|vendor| vendor == identity.vendor)
        && drive.product_code.is_none_or(|product| product == identity.product)
        && drive.serial.is_none_or(|serial| Some(serial) == identity.serial);
    let types =
        Axis::BOTH.map(|axis| config.stage.axis(axis)).map(|of| (of.vendor_id, of.product_code));
    let may_be_exchanged = config.stage.hardware && drive.serial.is_none() && types[0] == types[1];
    let alike = format!(
        "both drives are of one type: write serial into [stage.{axis}], or exchanged ones go unnoticed"
    );
    let id = |expected: Option<u32>| expected.map_or("any".to_owned(), |id| format!("{id:#010X}"));
    let (vendor, product) = (id(drive.vendor_id), id(drive.product_code));
    let serial = drive.serial.map(|serial| format!(", serial {serial:#010X}")).unwrap_or_default();
    let limit = format!("vendor {vendor}, product {product}{serial}; no fault, no power");
    let write = format!("write vendor_id and product_code into [stage.{axis}]");
    let other = format!("not the drive of [stage.{axis}]: is node right?");
    let reset = "find the cause, then needle-bench stage reset CONFIG";
    let mut found = format!("node {node}, {identity}; {statusword}");
    if extra_answers > 0 {
        found += &format!("; {extra_answers} answers more than requests");
    }
    let twin = format!("two drives have node number {node}: give one of them another");
    let mut checks = vec![
        Check::new(&name, found, limit)
            .unless(!may_be_exchanged, Warn, alike)
            .unless(is_named, Warn, write)
            .unless(!may_have_power(statusword.state()), Warn, POWERED)
            .unless(is_healthy, Fail, reset)
            .unless(is_right, Fail, other)
            .unless(extra_answers == 0, Fail, twin),
    ];
    let errors: Vec<String> =
        status.error_code.iter().chain(&status.error_history).map(ToString::to_string).collect();
    let found = if errors.is_empty() { "0 errors".to_owned() } else { errors.join(", ") };
    let history = Check::new(format!("{axis} error history"), found, "0 errors");
    checks.push(history.unless(errors.is_empty(), Warn, HISTORY));
    if drive.reference == Reference::Homing {
        let found = match status.homed {
            Some(true) => "homed",
            Some(false) => "not homed",
            None => "reported in homing mode only, where the run asks for it",
        };
        let next = format!("needle-bench stage home CONFIG --axis {axis}");
        let homing = Check::new(format!("{axis} homing"), found, "homed");
        checks.push(homing.unless(status.homed != Some(false), Fail, next));
    }
    let travel = if axis == Axis::Insertion { config.insertion.depth_mm } else { 0.0 };
    if let Some(position) = status.position.filter(|_| !drive.wraps && drive.zero.is_some()) {
        checks.push(room(axis, position, travel, drive));
    }
    checks
}

/// Checks that an axis at `position` can travel by `travel` within its limits; mm or rad.
fn room(axis: Axis, position: f64, travel: f64, drive: &AxisConfig) -> Check {
    let AxisLimits { min, max, .. } = drive.limits;
    let scale = drive.scale(axis, 0);
    let goal = position + travel;
    let found = match travel == 0.0 {
        true => format!("at {}", axis.shown(position)),
        false => format!("from {} to {}", axis.shown(position), axis.shown(goal)),
    };
    let limit = format!("{} to {}", axis.shown(min), axis.shown(max));
    let next = "withdraw, lower insertion.depth_mm, or set the limits of this axis";
    let check = Check::new(format!("{axis} room"), found, limit);
    let is_allowed = |at| drive.limits.check_counts(axis, at, &scale).is_ok();
    let is_inside = is_allowed(position) && is_allowed(goal);
    let room = (max - position).min(position - min);
    let has_room = axis == Axis::Insertion || room >= ROTATION_ROOM_RAD.min(0.25 * (max - min));
    let middle = axis.in_unit(0.5 * (min + max)).0;
    let back = format!(
        "with the needle out: needle-bench stage jog CONFIG --axis rotation --to {middle:.0}deg"
    );
    check.unless(has_room, Warn, back).unless(is_inside, Fail, next)
}

/// Checks the tracker by a report about the tool at rest.
pub fn tracker(config: &Config, report: &TrackerReport) -> Vec<Check> {
    let tool = &config.tracker.tool;
    let TrackerReport { accepted, refused, rate_hz, .. } = report;
    let found = format!("\"{tool}\", {accepted} accepted, {refused} refused");
    let stream = Check::new("tracker", found, "at least 1 accepted, of 1 tool");
    if let Some(trouble) = &report.trouble {
        return vec![stream.with(Fail, trouble)];
    }
    let two = "two tools of this name take turns: rename one, or unplug it";
    let stream = stream.unless(!report.has_two_tools, Fail, two);
    let constant = report.constant_coordinate.as_deref().unwrap_or_default();
    let stream = stream.unless(constant.is_empty(), Fail, constant);
    let stream = stream.unless(*accepted > 0, Fail, "every position was outside tracker.workspace");

    let hold = &config.tracker.hold;
    let rate_min_hz = (POSITIONS_PER_HOLD * config.insertion.speed_mm_per_s / hold.after_mm)
        .max(hold.after.as_secs_f64().recip());
    let limit = format!("at least {rate_min_hz:.1}");
    let rate = Check::new("tracker rate", format!("{rate_hz:.1} Hz"), limit);
    let faster = "lower insertion.speed_mm_per_s, or raise the tracker's rate";
    let rate = rate.unless(*rate_hz >= rate_min_hz, Warn, faster);

    let blind_mm = hold.after_mm.min(hold.after.as_secs_f64() * config.insertion.speed_mm_per_s);
    let blind = Check::new(
        "depth without a tip",
        format!("up to {blind_mm:.1} mm inserted"),
        format!("up to {BLIND_MAX_MM:.1} mm"),
    );
    let sooner = "lower tracker.hold_after_mm or tracker.hold_after_s";
    let blind = blind.unless(blind_mm <= BLIND_MAX_MM, Warn, sooner);

    let is_within = |value: Option<f64>, limit: f64| value.is_none_or(|value| value.abs() <= limit);
    let noise_mm = report.noise_sd_mm;
    let gate_mm = config.tracker.to_track().noise_sd_mm;
    let [noise_min_mm, noise_max_mm] = [NOISE_MIN, NOISE_MAX].map(|ratio| ratio * gate_mm);
    // A short rest shows little of the correlated noise.
    let noise_min_mm = if config.tracker.noise.is_some() { 0.0 } else { noise_min_mm };
    let found = noise_mm.map_or_else(|| "not measured".to_owned(), |mm| format!("{mm:.3} mm"));
    let limit = format!(
        "{noise_min_mm:.3} to {noise_max_mm:.3}, at most {NOISE_MAX} times tracker.gates.noise_sd_mm"
    );
    let longer = format!(
        "listen for at least {POSITIONS_MIN} positions: check CONFIG --connect --listen 10"
    );
    let measure = "measure it: needle-bench tracker rest CONFIG";
    let wide = format!("gates so wide find a jump late; {measure}");
    let noise = Check::new("tracker noise at rest", found, limit)
        .unless(noise_mm.is_some(), Warn, longer)
        .unless(is_within(noise_mm, noise_max_mm), Warn, measure)
        .unless(noise_mm.is_none_or(|mm| mm >= noise_min_mm), Warn, wide);

    let is_stamped = config.tracker.stamp != StampPolicy::Receive;
    let skew_s = report.stamp_skew_s;
    let found = match skew_s {
        Some(skew_s) => format!("{skew_s:+.3} s from this machine's clock"),
        None if is_stamped => "none came: skew not measured".to_owned(),
        None => "none, and none is used".to_owned(),
    };
    let send = "let the source send stamps, or set tracker.stamp = \"receive\"";
    let set = "set both clocks by NTP, or set tracker.stamp = \"receive\"";
    let stamps = Check::new("tracker stamps", found, format!("within {SKEW_MAX_S} s"))
        .unless(skew_s.is_some() || !is_stamped, Warn, send)
        .unless(is_within(skew_s, SKEW_MAX_S), Warn, set);
    let pace = report.stamp_pace.filter(|pace| is_stamped && !STAMP_PACE.contains(pace));
    let slow = format!(
        "they advance by {:.3} s in a second (allowed {:.1} to {:.1}): set tracker.stamp = \"receive\", or mend the \
         source's clock",
        pace.unwrap_or_default(),
        STAMP_PACE.start,
        STAMP_PACE.end
    );
    let coarse = "most differ by under 1 ms although positions arrive 5 ms or more apart (coarse resolution): set \
                  tracker.stamp = \"receive\"";
    let is_fine = !(is_stamped && report.has_coarse_stamps);
    let stamps = stamps.unless(is_fine, Warn, coarse).unless(pace.is_none(), Warn, slow);
    vec![stream, rate, blind, noise, stamps, workspace(config, report)]
}

/// Checks that the measured tip is in the workspace. Without a registration the tip's position on the bench is
/// unknown.
fn workspace(config: &Config, report: &TrackerReport) -> Check {
    let name = "tracker workspace";
    let limit = match &config.tracker.workspace {
        Some(Workspace { min_mm: low, max_mm: high }) => {
            let sides = [0, 1, 2].map(|n| format!("{:.1} to {:.1}", low[n], high[n]));
            format!("{} mm", sides.join(", "))
        }
        None => "tracker.workspace is not set".to_owned(),
    };
    let Some(tip_mm) = report.last_position_bench_mm.map(Vector3::from) else {
        let next = "bring the tool into the tracker's view";
        return Check::new(name, "no position", limit).with(Warn, next);
    };
    let is_registered = config.tracker.registration.is_some();
    let frame = if is_registered { "" } else { " in the tracker's frame" };
    let [x, y, z] = tip_mm.into();
    let check = Check::new(name, format!("tip at {x:.1}, {y:.1}, {z:.1} mm{frame}"), limit);
    let Some(workspace) = &config.tracker.workspace else {
        let next = "set tracker.workspace: positions outside it are refused";
        return check.unless(!config.stage.hardware, Warn, next);
    };
    let is_inside = !is_registered || workspace.outside(&tip_mm).is_none();
    let next = match report.is_in_metres {
        true => IN_METRES,
        false => "check the registration with a tool at a known place, then tracker.workspace",
    };
    let check = check.unless(is_registered, Warn, "not compared before there is a registration");
    check.unless(is_inside, Fail, next)
}

/// Checks that the tip's heading is as configured (`observer.start`), and that the tip can reach the plane or the
/// target from its last position on the bench. `None` without a registration, and for a target among masks, which
/// only a run reads.
pub fn plane(config: &Config, report: &TrackerReport) -> Option<Check> {
    let session = config.session().ok()?;
    let x_pw = session.x_wp.inverse();
    let tip_mm = x_pw.transform(&Vector3::from(report.last_position_bench_mm?));
    let start = config.observer.start.to_rotation() * Vector3::z();
    let turned_deg = report.last_heading_bench.map(|heading| {
        let heading = x_pw.rotation * Vector3::from(heading);
        math::atan2(start.cross(&heading).norm(), start.dot(&heading)).to_degrees()
    });
    let sd = session.observer.start_sd().map_or(config.observer.invariant.start_sd, |(sd, _)| sd);
    let [warn_deg, fail_deg] =
        HEADING_DEG.map(|deg| deg.max(HEADING_SDS * sd.yaw.max(sd.pitch).to_degrees()));
    let (mut found, mut limit) = (
        format!("tip {:+.2} mm off it", tip_mm.x),
        format!("within reach of {:.0} mm of depth", session.insertion.depth_mm),
    );
    if let Some(turned_deg) = turned_deg {
        found += &format!(", heading {turned_deg:.1} deg from observer.start");
        limit += &format!(", heading up to {warn_deg:.0} deg");
    }
    // Without an offset a run does not use orientations. An offset that was typed in may lack the sensor's tilt.
    let is_known = config.tracker.tip_offset_mm != [0.0; 3] && config.tracker.has_tilt();
    let verdict = match turned_deg {
        Some(turned_deg) if is_known && turned_deg > fail_deg => Fail,
        _ => Warn,
    };
    let next = "the sensor's orientation, tracker.tip_tilt (tip_file), the registration or observer.start is wrong";
    let is_start = turned_deg.is_none_or(|turned_deg| turned_deg <= warn_deg);
    let check = Check::new("plane", found, limit).unless(is_start, verdict, next);
    let runs_anyway = session.insertion.plane_out_of_reach == PlaneOutOfReach::Insert;
    Some(match session.check_reach(&tip_mm) {
        Ok(()) => check,
        Err(why) => check.with(if runs_anyway { Warn } else { Fail }, why),
    })
}

/// Checks the free space in `record.dir`, MB; `None` if the system does not report it, and an error if nothing can
/// be written there.
pub fn disk(config: &Config, free_mb: Result<Option<u64>, String>) -> Check {
    let free_mb_min = config.record.free_mb_min;
    let next = "make room, or set record.dir to another disk";
    let check = |found: String| Check::new("disk", found, format!("at least {free_mb_min} MB"));
    match free_mb {
        Ok(Some(free_mb)) => {
            let is_enough = free_mb >= u64::from(free_mb_min);
            check(format!("{free_mb} MB free")).unless(is_enough, Fail, next)
        }
        Ok(None) => {
            let found = "free space is not known".to_owned();
            check(found).with(Warn, "inspect it yourself: df")
        }
        Err(error) => check(error).with(Fail, next),
    }
}
