//! Contradictions between keys, each of which is right by itself. Where one key is the upper limit of
//! another, the declaration says so.

use super::axis_checks;
use super::goal;
use super::reader::{REGISTRATION, Reader};
use super::registration::GivenRegistration;
use super::study::StudyConfig;
use super::tracker::{STANDARD_INPUT, TrackerRequest, TrackerSource};
use super::{CanInterface, Config, GoalKind};
use crate::emulator::fault::Fault;
use crate::keys::{Key, expanded};
use crate::needle::{Torsion, TorsionConfig};
use crate::session::{InsertionConfig, rotation_peak};
use std::time::Duration;

pub(super) const ROTATION_ACCELERATION_MAX: &str = "stage.rotation.acceleration_max_deg_per_s2";

/// Notes every contradiction in `config`.
pub(super) fn check(config: &Config, reader: &mut Reader) {
    insertion(config, reader);
    goal::check(config, reader);
    rotation(config, reader);
    torsion("needle", config.needle.torsion, reader);
    torsion("emulator", config.emulator.torsion, reader);
    study(config, reader);
    noise(config, reader);
    axis_checks::check(config, reader);
    bus(config, reader);
    registration(config, reader);
    tracker(config, reader);
    source(config, reader);
    faults(config, reader);
}

fn insertion(config: &Config, reader: &mut Reader) {
    let InsertionConfig { step_mm: step, speed_mm_per_s: speed, arrival_mm, .. } = config.insertion;
    let [arrival_key, step_key] = ["insertion.arrival_mm", "insertion.step_mm"];
    reader.check(&[arrival_key, step_key], arrival_mm > 0.5 * step, || {
        format!("{arrival_key} is {arrival_mm}, allowed: up to half of {step_key}, which is {step}")
    });
    // A step is taken at a SYNC: at most one a period.
    let per_sync = speed * f64::from(config.can.bus.sync_ms) / 1e3;
    let [speed_key, sync_key] = ["insertion.speed_mm_per_s", "can.sync_ms"];
    reader.check(&[step_key, speed_key, sync_key], per_sync > step, || {
        format!(
            "{step_key} is {step}, allowed: at least what {speed_key} = {speed} moves in {sync_key} = \
             {}, which is {per_sync}",
            config.can.bus.sync_ms
        )
    });
    let baseline = config.observer.finite_difference.baseline_mm;
    let key = "observer.finite_difference.baseline_mm";
    reader.check(&[key, step_key], baseline < step, || {
        format!("{key} is {baseline}, allowed: at least {step_key}, which is {step}")
    });
}

/// The rotation that the law may ask for is within the limits of the axis, and so is its reversal.
fn rotation(config: &Config, reader: &mut Reader) {
    let (_, key) = config.control.rotation_max_rad_per_mm();
    let (per_mm, speed) = (config.number(key), config.insertion.speed_mm_per_s);
    let (speed_key, sync_key) = ("insertion.speed_mm_per_s", "can.sync_ms");
    let max_key = "stage.rotation.speed_max_deg_per_s";
    let (deg_per_s, max) = (per_mm * speed, config.number(max_key));
    reader.check(&[key, speed_key, max_key], deg_per_s > max, || {
        format!(
            "{key} is {per_mm}: at {speed} mm/s that is {deg_per_s} deg/s, over {max_key} = {max}; turn \
             by {:.4} deg/mm or insert at {:.4} mm/s",
            rounded_down(max / speed, 4),
            rounded_down(max / per_mm, 4),
        )
    });
    let (max_key, max) = (ROTATION_ACCELERATION_MAX, config.number(ROTATION_ACCELERATION_MAX));
    let peak = rotation_peak(per_mm, speed, Duration::from_millis(config.can.bus.sync_ms.into()));
    reader.check(&[key, speed_key, sync_key, max_key], peak > max, || {
        format!(
            "{key} is {per_mm}: reversed from one SYNC to the next at {speed} mm/s, that is {peak:.0} \
             deg/s², over {max_key} = {max}; turn or insert more slowly, or raise the limit"
        )
    });
}

/// To so many digits, so that what a message advises is allowed.
pub(super) fn rounded_down(value: f64, digits: i32) -> f64 {
    let per_one = 10f64.powi(digits);
    (value * per_one).floor() / per_one
}

fn torsion(section: &str, torsion: TorsionConfig, reader: &mut Reader) {
    let keys =
        ["offset_deg", "half_width_deg", "half_width_deg_per_mm", "creep_mm", "creep_mm_per_mm"];
    let keys = keys.map(|key| format!("{section}.torsion.{key}"));
    if let Err(error) = Torsion::new(torsion) {
        let message = || format!("{section}.torsion: {error}");
        reader.check(&keys.each_ref().map(String::as_str), true, message);
    }
}

/// Each range has its lower end first, and no trial may draw an offset outside the band that it draws.
fn study(config: &Config, reader: &mut Reader) {
    for key in StudyConfig::KEYS {
        let Some([low, high]) = config.range(key) else { continue };
        let key = format!("study.{}", key.name);
        reader.check(&[&key], low > high, || {
            format!("{key} is [{low}, {high}], allowed: the lower number first")
        });
    }
    let study = &config.study;
    let is_drawn = study.target_depth_mm.is_some() || study.obstacles.unwrap_or_default() > 0;
    let [depth, obstacles, kind] = ["study.target_depth_mm", "study.obstacles", "goal.kind"];
    reader.check(&[depth, obstacles, kind], is_drawn && config.goal.kind == GoalKind::Plane, || {
        format!(
            "{depth} or {obstacles} is given, without effect since {kind} is \"plane\": set it to \"target\""
        )
    });
    let emulated = |key: &str| [config.number(&format!("emulator.torsion.{key}")); 2];
    let [low, high] = study.torsion_offset_deg.unwrap_or_else(|| emulated("offset_deg"));
    let [half_width, _] =
        study.torsion_half_width_deg.unwrap_or_else(|| emulated("half_width_deg"));
    let offset = low.abs().max(high.abs());
    let drawn = study.torsion_offset_deg.is_some() || study.torsion_half_width_deg.is_some();
    let outside = drawn && config.emulator.torsion.creep_mm == 0.0 && offset > half_width;
    let [key, band] = ["study.torsion_offset_deg", "study.torsion_half_width_deg"];
    reader.check(&[key, band], outside, || {
        format!(
            "{key} reaches {offset}, allowed without emulator.torsion.creep_mm: up to the least of \
             {band}, which is {half_width}: the tip would start outside its own band"
        )
    });
}

/// Correlated noise has a size and a time, or there is none. Over a correlation time that is longer
/// than the run the noise is an offset, which no observer can tell from the tip.
fn noise(config: &Config, reader: &mut Reader) {
    let time_s = config.tracker.noise.map_or(0.0, |noise| noise.correlation_time.as_secs_f64());
    let run_s = config.insertion.depth_mm / config.insertion.speed_mm_per_s;
    let told = "tracker.noise.correlation_time_s";
    let keys = [told, "insertion.depth_mm", "insertion.speed_mm_per_s"];
    reader.check(&keys, time_s > run_s, || {
        format!(
            "{told} is {time_s}, allowed: up to the {run_s:.3} s of the insertion; noise that lasts \
             longer is an error of the registration, tracker.registration.sd_mm"
        )
    });
    let noise = config.emulator.noise;
    let [sd, time] = ["emulator.noise.correlated_sd_mm", "emulator.noise.correlation_time_s"];
    let lacks_time = noise.correlated_sd_mm.is_some() && noise.correlation_time.is_none();
    let lacks_sd = noise.correlation_time.is_some() && noise.correlated_sd_mm.is_none();
    for (given, other, lacks) in [(sd, time, lacks_time), (time, sd, lacks_sd)] {
        reader.check(&[given, other], lacks, || {
            format!("{given} is given without {other}: give both")
        });
    }
}

fn bus(config: &Config, reader: &mut Reader) {
    let nodes = [
        ("can.bench_node", config.can.bus.bench_node),
        ("stage.insertion.node", config.stage.insertion.node),
        ("stage.rotation.node", config.stage.rotation.node),
    ];
    for (i, (first, node)) in nodes.iter().enumerate() {
        for (second, other) in &nodes[i + 1..] {
            reader.check(&[first, second], node == other, || {
                format!("{second} is {other}, the same as {first}: each node needs its own number")
            });
        }
    }

    let (period, timeout) = (config.can.bus.heartbeat_ms, config.can.bus.heartbeat_timeout_ms);
    let too_short = u32::from(timeout) < 2 * u32::from(period);
    reader.check(&["can.heartbeat_timeout_ms", "can.heartbeat_ms"], too_short, || {
        format!(
            "can.heartbeat_timeout_ms is {timeout}, allowed: at least twice can.heartbeat_ms, which \
             is {period}"
        )
    });

    let interface = &config.can.interface;
    let wrong_bus = config.stage.hardware && interface.is_for_tests();
    reader.check(&["stage.hardware", "can.interface"], wrong_bus, || {
        format!(
            "can.interface is \"{interface}\", a bus made for tests, but stage.hardware is true: \
             name the interface of the real stage, such as \"can0\""
        )
    });
    let unjudged = config.stage.hardware && !config.tracker.gates.stream;
    reader.check(&["stage.hardware", "tracker.gates.stream"], unjudged, || {
        "tracker.gates.stream is false, but stage.hardware is true: with a real needle a stream that \
         contradicts the insertion must end the run; set it to true"
            .to_owned()
    });
    let unprotected = !config.stage.hardware && !interface.is_virtual();
    reader.check(&["stage.hardware", "can.interface"], unprotected, || {
        format!(
            "can.interface is \"{interface}\", which may have real drives on it, but stage.hardware \
             is false: start from bench-config/rig-epos4.toml, or name \"vcan0\" or \"udp\" for \
             emulated drives"
        )
    });
}

fn tracker(config: &Config, reader: &mut Reader) {
    let interface = &config.can.interface;
    let source = config.tracker.source;
    let emulated = source == TrackerSource::Emulated;
    let apart = emulated && *interface != CanInterface::Memory;
    reader.check(&["tracker.source", "can.interface"], apart, || {
        format!(
            "tracker.source is \"emulated\", allowed only with can.interface = \"memory\", which is \
             \"{interface}\": it sees the emulated needle alone. Set tracker.source = \"openigtlink\""
        )
    });

    let recorded = config.tracker.file.is_some() || source == TrackerSource::Csv;
    let blind = !emulated && !recorded && *interface == CanInterface::Memory;
    let recording = match source {
        TrackerSource::Ndjson => ", or a recording as tracker.file",
        _ => "",
    };
    reader.check(&["tracker.source", "can.interface"], blind, || {
        format!(
            "tracker.source is \"{source}\", but can.interface = \"memory\" is the emulated stage, \
             which only its own tracker sees: name \"vcan0\" with vcan-stage on it{recording}"
        )
    });
    let latency_ms = config.number("tracker.latency_ms");
    let hold_after_s = config.tracker.hold.after.as_secs_f64();
    let [latency, after] = ["tracker.latency_ms", "tracker.hold_after_s"];
    reader.check(&[latency, after], latency_ms * 1e-3 >= hold_after_s, || {
        format!(
            "{latency} is {latency_ms}, allowed: under {after}, which is {hold_after_s} s: no position \
             would be young enough to steer by"
        )
    });

    // The longest way without a position: its latency, the tracker's period, two SYNCs until the hold begins,
    // and the braking.
    let (speed, hold_mm) = (config.insertion.speed_mm_per_s, config.tracker.hold.after_mm);
    let braking = config.tracker.hold.braking_mm_per_s2;
    let is_seen_here = config.tip_source() == TrackerSource::Emulated;
    let period_s = if is_seen_here { config.emulator.tracker_rate_hz.recip() } else { 0.0 };
    let noticed_s = period_s + (latency_ms + 2.0 * f64::from(config.can.bus.sync_ms)) * 1e-3;
    let least_mm = speed * noticed_s + 0.5 * speed * speed / braking;
    let [key, brake] = ["tracker.hold_after_mm", "tracker.hold_braking_mm_per_s2"];
    let keys = [key, "insertion.speed_mm_per_s", brake, latency];
    reader.check(&keys, hold_mm <= least_mm, || {
        format!(
            "{key} is {hold_mm}, allowed: over the {:.3} mm to standstill from {speed} mm/s \
             with {brake} = {braking} and {latency} = {latency_ms}: insert slower or brake harder",
            (least_mm * 1e3).ceil() / 1e3
        )
    });

    let Some(workspace) = &config.tracker.workspace else { return };
    let [min_mm, max_mm] = [workspace.min_mm, workspace.max_mm].map(<[f64; 3]>::from);
    let empty = min_mm.iter().zip(max_mm).any(|(&min, max)| min >= max);
    reader.check(&["tracker.workspace.min_mm", "tracker.workspace.max_mm"], empty, || {
        format!(
            "tracker.workspace.min_mm is {min_mm:?}, allowed: each under that of \
             tracker.workspace.max_mm, which is {max_mm:?}"
        )
    });
}

/// Fiducials determine a pose, and stand in place of one.
fn registration(config: &Config, reader: &mut Reader) {
    let key = "tracker.registration.fiducials";
    if reader.is_given(key) {
        let mut pose = expanded(GivenRegistration::KEYS, &[]).into_iter();
        let other = |key: &Key| reader.is_given(&format!("{REGISTRATION}.{}", key.name));
        if let Some(other) = pose.find(other) {
            let other = other.name;
            let message = format!("fiducials are given along with {other}: give one of the two");
            reader.refuse(REGISTRATION, key, &message);
        }
    }
    let unregistered = config.registration_sd_mm().err();
    reader.check(&[key, REGISTRATION], unregistered.is_some(), || {
        unregistered.map(|error| error.to_string()).unwrap_or_default()
    });
}

/// Keys that only some sources of tip positions take.
fn source(config: &Config, reader: &mut Reader) {
    let tracker = &config.tracker;
    let source = tracker.source;
    let [key, file, address, request] =
        ["tracker.source", "tracker.file", "tracker.address", "tracker.request"];
    reader.check(&[key, file], source == TrackerSource::Csv && tracker.file.is_none(), || {
        format!("{key} is \"{source}\", and there is no {file} to read")
    });
    let recording = tracker.file.as_deref().unwrap_or_default();
    let is_file = matches!(source, TrackerSource::Ndjson | TrackerSource::Csv);
    reader.check(&[file, key], tracker.file.is_some() && !is_file, || {
        format!("{file} is \"{recording}\", allowed with {key} = \"ndjson\" or \"csv\", which is \"{source}\"")
    });
    let hardware = tracker.file.is_some() && config.stage.hardware;
    reader.check(&[file, "stage.hardware"], hardware, || {
        format!(
            "{file} is \"{recording}\", but stage.hardware is true: a recording does not see the \
             needle that would move"
        )
    });
    let no_lines = tracker.address == STANDARD_INPUT && source != TrackerSource::Ndjson;
    reader.check(&[address, key], no_lines, || {
        format!("{address} is \"-\", allowed with {key} = \"ndjson\", which is \"{source}\"")
    });
    let asked = tracker.request != TrackerRequest::None && source != TrackerSource::OpenIgtLink;
    reader.check(&[request, key], asked, || {
        format!("{request} is given, allowed with {key} = \"openigtlink\", which is \"{source}\"")
    });
    let times = [
        ("tracker.csv.time", Some(&tracker.csv.time)),
        ("tracker.csv.stamp", tracker.csv.stamp.as_ref()),
    ];
    for (key, columns) in times {
        let is_empty = columns.is_some_and(|columns| columns.named().next().is_none());
        reader.check(&[key], is_empty, || {
            format!("{key} names no column, expected the name of one as s, ms, us or ns")
        });
    }
}

/// A kind of fault has keys of its own, and needs some of them.
fn faults(config: &Config, reader: &mut Reader) {
    for (i, fault) in config.emulator.fault.iter().enumerate() {
        let (at, what) =
            (format!("emulator.fault[{i}]"), format!("a fault of kind \"{}\"", fault.kind));
        let others = &Fault::KEYS[1..];
        reader.check_own_keys(&at, &what, others, &fault.kind.keys(), fault.check());
    }
}
