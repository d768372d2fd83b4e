//! The bus, the drives, the tracker, the disk: as they are now.

use super::listening::{POSITIONS_MIN, TrackerReport};
use super::{Check, Verdict};
use crate::canopen::cia402::DriveState;
use crate::config::{CanInterface, Config};
use crate::math;
use crate::session::PlaneOutOfReach;
use crate::stage::{Axis, AxisLimits, AxisStatus, Reference, Zero};
use crate::tracker::{StampPolicy, Workspace};
use nalgebra::Vector3;

/// Bits on the wire in one SYNC period: SYNC, two set-points, two answers, and a share of heartbeats.
const CYCLE_BITS: f64 = 600.0;
/// A bus with more load than this delays set-points.
const LOAD_MAX: f64 = 0.5;
/// From this error counter on a node warns (ISO 11898-1).
const ERRORS_WARN: u16 = 96;
/// The noise of a short rest may be this much over what is configured.
const NOISE_MAX: f64 = 1.5;
/// Clocks of two machines are set nearer to each other than this, s.
const SKEW_MAX_S: f64 = 1.0;
/// Positions within the way that is inserted before a hold.
const POSITIONS_PER_HOLD: f64 = 2.0;

/// What the operating system knows of a CAN interface; `None` for what it does not say.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct BusFacts {
    /// The interface is up.
    pub is_up: bool,
    /// State of the controller, in words.
    pub state: Option<String>,
    /// The controller may send: it is neither off nor passive.
    pub may_send: bool,
    /// Bit rate, bit/s.
    pub bit_rate: Option<u32>,
    /// Time after which the interface restarts after a bus-off, ms; 0 is never.
    pub restart_ms: Option<u32>,
    /// Error counters: sending, receiving.
    pub errors: Option<[u16; 2]>,
}

/// The bus of `config`, of which the system says `facts`; `None` of an interface that does not exist.
pub fn bus(config: &Config, facts: Result<Option<BusFacts>, String>) -> Vec<Check> {
    let CanInterface::Socket(name) = config.bus() else {
        return vec![Check::unlimited("bus", format!("{}: not a CAN interface", config.bus()))];
    };
    const UP: &str = "up, error active";
    const BRING_UP: &str = "bitrate 1000000 restart-ms 0";
    let look = format!("look at it yourself: ip -details -statistics link show {name}");
    let BusFacts { is_up, state, may_send, bit_rate, restart_ms, errors } = match facts {
        Ok(Some(facts)) => facts,
        Ok(None) => {
            let next = match name.starts_with("vcan") {
                true => {
                    format!("sudo ip link add dev {name} type vcan; sudo ip link set {name} up")
                }
                false => format!(
                    "plug the adapter in, then sudo ip link set {name} up type can {BRING_UP}"
                ),
            };
            let check = Check::new("bus", format!("no interface {name}"), UP);
            return vec![check.unless(false, Verdict::Fail, next)];
        }
        Err(error) => {
            let check = Check::new("bus", format!("{name}: {error}"), UP);
            return vec![check.unless(false, Verdict::Warn, look)];
        }
    };
    // A virtual interface has neither.
    let unknown = || "the interface does not say".to_owned();
    let is_told = |is_known: bool| is_known || !config.stage.hardware;
    let up = if is_up { "up" } else { "down" };
    let state = state.map(|state| format!(", {state}")).unwrap_or_default();
    let counters = errors.map(|[sent, received]| format!("{sent} sending, {received} receiving"));
    let load =
        bit_rate.map(|rate| CYCLE_BITS * 1e3 / f64::from(config.can.sync_ms) / f64::from(rate));
    let rate = bit_rate.zip(load).map(|(rate, load)| {
        format!("{} kbit/s, {:.0}% load by SYNC", f64::from(rate) * 1e-3, load * 1e2)
    });
    let set = |what: &str| {
        format!("sudo ip link set {name} down; sudo ip link set {name} up type can {what}")
    };
    vec![
        Check::new("bus", format!("{name} {up}{state}"), UP).unless(
            is_up && may_send,
            Verdict::Fail,
            set(BRING_UP),
        ),
        Check::new(
            "bus bit rate",
            rate.unwrap_or_else(unknown),
            format!("load up to {:.0}%", LOAD_MAX * 1e2),
        )
        .unless(is_told(bit_rate.is_some()), Verdict::Warn, &look)
        .unless(
            load.is_none_or(|load| load <= LOAD_MAX),
            Verdict::Warn,
            "raise can.sync_ms",
        ),
        Check::new(
            "bus restart-ms",
            restart_ms.map_or_else(unknown, |ms| format!("{ms} ms")),
            "0: a bus-off is final",
        )
        .unless(is_told(restart_ms.is_some()), Verdict::Warn, &look)
        .unless(restart_ms.is_none_or(|ms| ms == 0), Verdict::Fail, set("restart-ms 0")),
        Check::new(
            "bus error counters",
            counters.unwrap_or_else(unknown),
            format!("under {ERRORS_WARN}"),
        )
        .unless(is_told(errors.is_some()), Verdict::Warn, &look)
        .unless(
            errors.is_none_or(|errors| errors.iter().all(|count| *count < ERRORS_WARN)),
            Verdict::Warn,
            "check cable, termination and the bit rate of both drives",
        ),
    ]
}

/// The drive of `axis`, as it describes itself.
pub fn drive(config: &Config, axis: Axis, status: Result<AxisStatus, String>) -> Vec<Check> {
    let name = format!("{axis} drive");
    let status = match status {
        Ok(status) => status,
        Err(trouble) => {
            let can = &config.can;
            let limit = format!("{} requests of {} ms", can.sdo_attempts, can.sdo_timeout_ms);
            let next = "is it powered, and are node and bit rate right?";
            return vec![Check::new(name, trouble, limit).unless(false, Verdict::Fail, next)];
        }
    };
    const GIVEN: [&str; 2] = ["device type (0x1000)", "position (0x6064)"];
    let is_given = [status.device_type.is_some(), status.position_counts.is_some()];
    let lacks: Vec<&str> =
        GIVEN.iter().zip(is_given).filter(|(_, given)| !given).map(|(what, _)| *what).collect();
    if !lacks.is_empty() {
        let found = format!("node {} does not give its {}", status.node, lacks.join(" and "));
        let next = "is it a CiA 402 drive?";
        return vec![Check::new(name, found, GIVEN.join(", ")).unless(false, Verdict::Fail, next)];
    }
    let Ok(stage) = config.stage.to_stage(&config.can) else { return Vec::new() };
    let drive = stage.axis(axis);
    let identity = status.identity;
    let id = |expected: Option<u32>| expected.map_or("any".to_owned(), |id| format!("{id:#010X}"));
    let expected = format!("vendor {}, product {}", id(drive.vendor), id(drive.product));
    let is_other = |expected: Option<u32>, found: u32| expected.is_some_and(|one| one != found);
    let is_right =
        !is_other(drive.vendor, identity.vendor) && !is_other(drive.product, identity.product);
    let state = status.statusword.state();
    let is_faulty = matches!(state, Some(DriveState::Fault | DriveState::FaultReactionActive));
    let errors: Vec<String> =
        status.error_code.iter().chain(&status.error_history).map(ToString::to_string).collect();
    let mut checks = vec![
        Check::new(
            &name,
            format!("node {}, {identity}; {}", status.node, status.statusword),
            format!("{expected}; no fault, no power"),
        )
        .unless(
            drive.vendor.is_some() && drive.product.is_some(),
            Verdict::Warn,
            format!("write vendor_id and product_code into [stage.{axis}]"),
        )
        .unless(
            state != Some(DriveState::OperationEnabled),
            Verdict::Warn,
            "it has power: is another program moving it? needle-bench stop takes power off",
        )
        .unless(
            !is_faulty || config.stage.fault_reset_on_start,
            Verdict::Fail,
            "find the cause, then needle-bench stage reset",
        )
        .unless(
            is_right,
            Verdict::Fail,
            format!("not the drive of [stage.{axis}]: is node right?"),
        ),
        Check::new(
            format!("{axis} error history"),
            match errors.is_empty() {
                true => "0 errors".to_owned(),
                false => errors.join(", "),
            },
            "0 errors",
        )
        .unless(
            errors.is_empty(),
            Verdict::Warn,
            "needle-bench stage reset clears it once it is understood",
        ),
    ];
    if drive.reference == Reference::Homing {
        let homed = match status.homed {
            Some(true) => "homed",
            Some(false) => "not homed",
            None => "the drive says it in homing mode alone, where the run asks it",
        };
        checks.push(Check::new(format!("{axis} homing"), homed, "homed").unless(
            status.homed != Some(false),
            Verdict::Fail,
            format!("needle-bench stage home --axis {axis}"),
        ));
    }
    let way = if axis == Axis::Insertion { config.insertion.depth_mm } else { 0.0 };
    if let Some(position) = status.position.filter(|_| !drive.wraps && drive.zero != Zero::Here) {
        checks.push(room(axis, position, way, &drive.limits));
    }
    checks
}

/// The way that an axis at `position` has left, in mm or rad.
fn room(axis: Axis, position: f64, way: f64, limits: &AxisLimits) -> Check {
    let (unit, scale) = match axis {
        Axis::Insertion => ("mm", 1.0),
        Axis::Rotation => ("deg", 1f64.to_degrees()),
    };
    let AxisLimits { min, max, .. } = *limits;
    let goal = position + way;
    let found = match way == 0.0 {
        true => format!("at {:.3} {unit}", position * scale),
        false => format!("from {:.3} to {:.3} {unit}", position * scale, goal * scale),
    };
    let limit = format!("{:.3} to {:.3} {unit}", min * scale, max * scale);
    Check::new(format!("{axis} room"), found, limit).unless(
        position >= min && goal <= max,
        Verdict::Fail,
        "withdraw, insert less deep, or set the limits of this axis",
    )
}

/// What came of the tracker, listened to with the tool at rest.
pub fn tracker(config: &Config, report: &TrackerReport) -> Vec<Check> {
    let tool = &config.tracker.tool;
    let TrackerReport { accepted, refused, rate_hz, .. } = report;
    let heard = Check::new(
        "tracker",
        format!("\"{tool}\", {accepted} accepted, {refused} refused"),
        "at least 1 accepted, of 1 tool",
    );
    if let Some(trouble) = &report.trouble {
        return vec![heard.unless(false, Verdict::Fail, trouble)];
    }
    let hold = &config.tracker.hold;
    let rate_min_hz = (POSITIONS_PER_HOLD * config.insertion.speed_mm_per_s / hold.after_mm)
        .max(hold.after.as_secs_f64().recip());
    let noise_mm = config.tracker.to_track().noise_sd_mm;
    let is_within = |value: Option<f64>, limit: f64| value.is_none_or(|value| value.abs() <= limit);
    let noise = report.noise_sd_mm;
    let is_stamped = config.tracker.stamp != StampPolicy::Receive;
    vec![
        heard
            .unless(
                !report.has_two_tools,
                Verdict::Fail,
                "two tools of this name take turns: rename one, or unplug it",
            )
            .unless(*accepted > 0, Verdict::Fail, "every position was outside tracker.workspace"),
        Check::new(
            "tracker rate",
            format!("{rate_hz:.1} Hz"),
            format!("at least {rate_min_hz:.1}"),
        )
        .unless(
            *rate_hz >= rate_min_hz,
            Verdict::Warn,
            "insert slower, or raise the tracker's rate",
        ),
        Check::new(
            "tracker noise at rest",
            noise.map_or_else(|| "not measured".to_owned(), |mm| format!("{mm:.3} mm")),
            format!("up to {:.3}, {NOISE_MAX} of tracker.gates.noise_sd_mm", NOISE_MAX * noise_mm),
        )
        .unless(
            noise.is_some(),
            Verdict::Warn,
            format!("listen for at least {POSITIONS_MIN} positions: check --connect --listen 10"),
        )
        .unless(
            is_within(noise, NOISE_MAX * noise_mm),
            Verdict::Warn,
            "measure it: needle-bench tracker rest",
        ),
        Check::new(
            "tracker stamps",
            match report.stamp_skew_s {
                Some(skew_s) => format!("{skew_s:+.3} s from this machine's clock"),
                None if is_stamped => "none came: skew not measured".to_owned(),
                None => "none, and none is used".to_owned(),
            },
            format!("within {SKEW_MAX_S} s"),
        )
        .unless(
            report.stamp_skew_s.is_some() || !is_stamped,
            Verdict::Warn,
            "let the source send stamps, or set tracker.stamp = \"receive\"",
        )
        .unless(
            is_within(report.stamp_skew_s, SKEW_MAX_S),
            Verdict::Warn,
            "set both clocks by NTP, or set tracker.stamp = \"receive\"",
        ),
        workspace(config, report),
    ]
}

/// The measured tip against the workspace. Without a registration its place on the bench is not known.
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
        return Check::new(name, "no position", limit).unless(false, Verdict::Warn, next);
    };
    let is_placed = config.tracker.registration.is_some();
    let frame = if is_placed { "" } else { " in the tracker's frame" };
    let [x, y, z] = tip_mm.into();
    let check = Check::new(name, format!("tip at {x:.1}, {y:.1}, {z:.1} mm{frame}"), limit);
    let Some(workspace) = &config.tracker.workspace else {
        let next = "set tracker.workspace: no position outside is believed";
        return check.unless(!config.stage.hardware, Verdict::Warn, next);
    };
    check.unless(is_placed, Verdict::Warn, "not compared before there is a registration").unless(
        !is_placed || workspace.check(&tip_mm).is_ok(),
        Verdict::Fail,
        "check the registration with a tool at a known place, then tracker.workspace",
    )
}

/// The tip's way into the plane or to the target, from the last position and heading on the bench; none
/// without a registration, and for a target among masks, which the run itself reads.
pub fn plane(config: &Config, report: &TrackerReport) -> Option<Check> {
    let session = config.session().ok()?;
    let x_pw = session.x_wp.inverse();
    let tip_mm = x_pw.transform(&Vector3::from(report.last_position_bench_mm?));
    let heading = report.last_heading_bench.map(|heading| x_pw.rotation * Vector3::from(heading));
    let heading = heading.map(|heading| {
        format!(", heading {:+.1} deg", math::asin(heading.x.clamp(-1.0, 1.0)).to_degrees())
    });
    let found = format!("tip {:+.2} mm off it{}", tip_mm.x, heading.unwrap_or_default());
    let reach = session.check_reach(&tip_mm);
    let limit = format!("what {:.0} mm of depth can mend", session.insertion.depth_mm);
    let check = Check::new("plane", found, limit);
    Some(match reach {
        Ok(()) => check,
        Err(why) if session.insertion.plane_out_of_reach == PlaneOutOfReach::Insert => {
            check.unless(false, Verdict::Warn, why)
        }
        Err(why) => check.unless(false, Verdict::Fail, why),
    })
}

/// Free space where runs are kept, MB; `None` where it is not known.
pub fn disk(config: &Config, free_mb: Result<Option<u64>, String>) -> Check {
    let least = config.record.free_mb_min;
    let next = "make room, or set record.dir to another disk";
    let limit = format!("at least {least} MB");
    let (found, is_enough) = match free_mb {
        Ok(Some(free_mb)) => (format!("{free_mb} MB free"), free_mb >= u64::from(least)),
        Ok(None) => {
            let check = Check::new("disk", "free space is not known", limit);
            return check.unless(false, Verdict::Warn, "look at it yourself: df");
        }
        Err(error) => (error, false),
    };
    Check::new("disk", found, limit).unless(is_enough, Verdict::Fail, next)
}
