//! Contradictions within `[stage]`: settings of an axis, its drive and its operations.

use super::Config;
use super::checks::ROTATION_ACCELERATION_MAX;
use super::reader::Reader;
use crate::session::PROFILE_PEAK;
use crate::stage::{Axis, AxisConfig, Reference};

/// Objects that a drive of the bench must have, and why. Of the others that the bring-up writes, a
/// drive may lack:
///
/// - 605A: by CiA 402 it then brakes on its quick-stop ramp, as by 2
/// - 6065 and 6066: the bench compares target and position itself
/// - 60C2: it takes the period from SYNC, and what it makes of that shows as a following error
/// - 6099 and 609A: it homes at a speed of its own, as without the keys
/// - 6502: the mode that it takes is read back (6061)
/// - 1029: by CiA 301 it then goes to Pre-operational, as by 0
///
/// The bring-up never insists on 1005, 1018:3, 1018:4, 605E, and PDOs beyond the first.
const NEEDED: [(&[u16], &str); 7] = [
    (&[0x1000, 0x1018], "by it the bench knows the drive"),
    (
        &[0x1016, 0x1017, 0x6007],
        "it stops the axis when the bench falls silent, or the bench when the drive does",
    ),
    (
        &[0x1400, 0x1600, 0x1800, 0x1A00],
        "without it set-points and positions are not where the bench takes them to be",
    ),
    (&[0x6040, 0x6041, 0x6060, 0x6061, 0x6064, 0x607A], "no drive is moved or watched without it"),
    (&[0x6085], "a braking that is configured must hold; a drive without it is not to be told one"),
    (&[0x6098, 0x607C], "the drive would home in a way, or to a place, that is not configured"),
    (&[SOFTWARE_LIMITS], "the drive keeps its limits itself, unless wraps is true"),
];
/// The drive's own position limits.
const SOFTWARE_LIMITS: u16 = 0x607D;

/// By what a real drive brakes on quick stop, on its own faults and when the bench dies.
const STOPPING: [(&str, &[i16], &str); 4] = [
    (
        "abort_connection_option",
        &[1, 2, 3],
        "1 (fault), 2 (no power) or 3 (quick stop): by anything else the axis may go on when the bench \
         dies (6007)",
    ),
    (
        "communication_error_behaviour",
        &[0, 2],
        "0 (Pre-operational) or 2 (Stopped): by anything else the node goes on when the bench dies \
         (1029:1)",
    ),
    (
        "quick_stop_option",
        &[1, 2, 3, 5, 6, 7],
        "1 to 3, or 5 to 7 to stay in quick stop: 0 coasts, and others are reserved or of the maker's \
         own (605A)",
    ),
    (
        "fault_reaction_option",
        &[1, 2, 3],
        "1 to 3: 0 coasts, and others are reserved or of the maker's own (605E)",
    ),
];

/// Notes every contradiction.
pub(super) fn check(config: &Config, reader: &mut Reader) {
    axis(config, Axis::Insertion, &config.stage.insertion, reader);
    axis(config, Axis::Rotation, &config.stage.rotation, reader);
    accelerations(config, reader);
}

/// Those of one axis. Numbers in messages are in the unit of their key.
fn axis(config: &Config, which: Axis, axis: &AxisConfig, reader: &mut Reader) {
    let [name, unit, scale, per] = [
        ["insertion", "mm", "counts_per_mm.counts", "counts_per_mm.mm"],
        ["rotation", "deg", "counts_per_turn.counts", "counts_per_turn.turns"],
    ][which as usize];
    let key = |key: &str| format!("stage.{name}.{key}");
    let hardware = config.stage.hardware;
    let [reference, homing, zero] = ["reference", "homing", "zero"].map(key);
    let [low, high] = ["min", "max"].map(|end| key(&format!("{end}_{unit}")));
    let [min, max] = [&low, &high].map(|key| config.number(key));

    let homed = axis.reference == Reference::Homing;
    reader.check(&[&reference, &homing], homed && axis.homing.is_none(), || {
        format!("{reference} is \"homing\", and there is no [{homing}] that says how")
    });
    reader.check(&[&zero, &reference], homed && axis.zero.is_none(), || {
        format!(
            "{zero} is \"start\", but {reference} is \"homing\": give the counts, 0 for the drive's \
             zero"
        )
    });
    // Limits of a real axis are what its screw, its needle or the sensor's cable bear. Counted from
    // where each command begins they would bear nothing: three jogs go three times as far.
    let drifts = hardware && axis.zero.is_none() && !axis.wraps;
    reader.check(&[&zero, &high, "stage.hardware"], drifts, || {
        format!(
            "{zero} is \"start\": its limits of {min} to {max} {unit} would count anew from each start; \
             give the counts at 0 {unit} (stage status), and {reference} = \"homing\" if power-off \
             loses them"
        )
    });
    // An axis that was homed stands at home, from which the drive's zero is a home offset (607C) away.
    let offset_key = key(&format!("homing.offset_{unit}"));
    let offset = config.number(&offset_key);
    let zero_counts = axis.zero.map_or(f64::NAN, f64::from);
    let counts_per_unit =
        config.number(&key(scale)) / config.number(&key(per)) / [1.0, 360.0][which as usize];
    let (sign_key, method_key) = (key("sign"), key("homing.method"));
    let sign = config.number(&sign_key);
    let home_at = |offset: f64| 0.0 - offset - sign * zero_counts / counts_per_unit;
    let home = home_at(offset);
    reader.check(&[&low, &high, &zero, &offset_key], home < min || home > max, || {
        format!(
            "{offset_key} is {offset}, which puts home at {home:.3} {unit} with {zero} = \
             {zero_counts}, allowed: {low} to {high}, which are {min} and {max}"
        )
    });
    // The needle's axis has its way on one side of its end switch, where home is.
    let home = if offset.is_nan() { home_at(0.0) } else { home_at(offset) };
    let method = axis.homing.filter(|_| which == Axis::Insertion).map_or(0, |homing| homing.method);
    let (toward, other) = match method {
        1 | 17 => (-sign, method + 1),
        2 | 18 => (sign, method - 1),
        _ => (0.0, 0),
    };
    let [beyond, before] =
        if toward > 0.0 { [max - home, home - min] } else { [home - min, max - home] };
    let keys = [&*method_key, &sign_key, &zero, &low, &high];
    reader.check(&keys, toward != 0.0 && beyond > before, || {
        let end = if toward > 0.0 { "deep" } else { "withdrawn" };
        format!(
            "{method_key} is {method}, which with sign = {sign} seeks the switch at the {end} end: home is \
             {home:.3} {unit}, the limits of {min} to {max} {unit} go {beyond:.1} {unit} beyond it; is it \
             {other}?"
        )
    });
    for (name, stopping, allowed) in STOPPING {
        let key = key(name);
        let value = config.number(&key);
        let stops = stopping.iter().any(|&option| f64::from(option) == value);
        reader.check(&["stage.hardware", &key], hardware && !stops, || {
            format!("{key} is {value}, allowed with stage.hardware = true: {allowed}")
        });
    }
    for (n, index) in axis.optional_objects.iter().enumerate() {
        let needed = NEEDED.iter().find(|(indexes, _)| indexes.contains(index));
        let needed = needed.filter(|_| *index != SOFTWARE_LIMITS || !axis.wraps);
        let key = key(&format!("optional_objects[{n}]"));
        reader.check(&[&key], needed.is_some(), || {
            let why = needed.map_or("", |(_, why)| why);
            format!("{key} is 0x{index:04X}, which is not optional: {why}")
        });
    }
    // The bench allows for what the target does in two SYNC periods beyond the drive's window: a drive
    // that waits no longer than these notices no later than the bench.
    let (timeout_key, sync_ms) = (key("following_error_timeout_ms"), config.can.bus.sync_ms);
    let timeout_ms = axis.following_error_timeout_ms.unwrap_or_default();
    reader.check(&["can.sync_ms", &timeout_key], timeout_ms > 2 * sync_ms, || {
        format!(
            "{timeout_key} is {timeout_ms}, allowed: up to twice can.sync_ms, which is {sync_ms}, so \
             that the drive notices no later than the bench"
        )
    });
    raw_sdos(axis, key, unit, reader);
}

/// Where the braking of a quick stop is not configured, its object may be written in the units that the
/// drive has of its own.
fn raw_sdos(axis: &AxisConfig, key: impl Fn(&str) -> String, unit: &str, reader: &mut Reader) {
    for (n, sdo) in axis.sdo.iter().enumerate() {
        let [index_key, value_key, bits_key] =
            ["index", "value", "bits"].map(|name| key(&format!("sdo[{n}].{name}")));
        let (low, high) = (-(1i64 << (sdo.bits.max(1) - 1)), (1i64 << sdo.bits) - 1);
        let (index, value) = (sdo.index, sdo.value);
        reader.check(&[&bits_key, &value_key], !(low..=high).contains(&value), || {
            format!("{value_key} is {value}, allowed: {low} to {high}")
        });
        let why = match (index, axis.quick_stop_deceleration) {
            (0x6085, Some(_)) => {
                Some(format!("quick_stop_deceleration_{unit}_per_s2 sets it: give one of the two"))
            }
            _ => reserved(index).map(str::to_owned),
        };
        reader.check(&[&index_key], why.is_some(), || {
            format!("{index_key} is 0x{index:04X}, not for raw SDOs: {}", why.unwrap_or_default())
        });
    }
}

/// Why an object is not for raw SDOs: it moves the axis, or the bench writes it by itself; with what
/// to set instead. `None` where it may be written.
fn reserved(index: u16) -> Option<&'static str> {
    Some(match index {
        0x1014 | 0x1015 => {
            "the bench needs every emergency message, under the drive's own identifier"
        }
        0x1016 | 0x1017 => "set can.heartbeat_ms and can.heartbeat_timeout_ms",
        0x1029 => "set communication_error_behaviour",
        0x1400..=0x1BFF => "the bench maps the PDOs it needs, and no others",
        0x6007 => "set abort_connection_option",
        0x6040 => "it is the controlword: the bench alone enables and stops the drive",
        0x605A => "set quick_stop_option",
        0x605E => "set fault_reaction_option",
        0x6060 => "the bench sets the mode that it moves the axis in",
        0x6065 => "set following_error_mm or following_error_deg",
        0x6066 => "set following_error_timeout_ms",
        0x607A | 0x60B0..=0x60B2 | 0x60FF | 0x6071 => "it moves the axis: `needle-bench stage jog`",
        0x607D => "set min_mm and max_mm, or min_deg and max_deg",
        0x60C2 => "set can.sync_ms",
        _ => return None,
    })
}

/// Commanded accelerations are under the limits of their axis: a run must not end by a limit that it was
/// bound to break.
fn accelerations(config: &Config, reader: &mut Reader) {
    let along = "stage.insertion.acceleration_max_mm_per_s2";
    for (key, max_key) in [
        ("insertion.acceleration_mm_per_s2", along),
        ("stage.insertion.jog_acceleration_mm_per_s2", along),
        ("stage.rotation.jog_acceleration_deg_per_s2", ROTATION_ACCELERATION_MAX),
    ] {
        let [acceleration, max] = [key, max_key].map(|key| config.number(key));
        reader.check(&[key, max_key], PROFILE_PEAK * acceleration > max, || {
            format!(
                "{key} is {acceleration}, allowed: up to {:.3}: the last set-point brakes {PROFILE_PEAK} \
                 times as hard, and {max_key} is {max}",
                max / PROFILE_PEAK
            )
        });
    }
}
