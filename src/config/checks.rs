//! Checks for contradictions between keys, each of which is valid by itself.

use super::axis_checks;
use super::goal;
use super::needle;
use super::reader::{REGISTRATION, Reader};
use super::registration::GivenRegistration;
use super::study::StudyConfig;
use super::tracker::{STANDARD_INPUT, TrackerRequest, TrackerSource};
use super::warnings::section_name;
use super::{CanInterface, Config};
use crate::emulator::fault::Fault;
use crate::keys::{Key, expanded};
use crate::needle::TorsionConfig;
use crate::session::rotation_peak;
use nalgebra::Vector3;

pub(super) const ROTATION_ACCELERATION_MAX: &str = "stage.rotation.acceleration_max_deg_per_s2";

/// Reports every contradiction in `config`.
pub(super) fn check(config: &Config, reader: &mut Reader) {
    check_limits(config, reader);
    check_step(config, reader);
    goal::check(config, reader);
    check_rotation(config, reader);
    check_torsion("needle", config.needle.torsion, reader);
    check_torsion("emulator", config.emulator.torsion, reader);
    check_study(config, reader);
    check_noise(config, reader);
    axis_checks::check(config, reader);
    check_bus(config, reader);
    check_registration(config, reader);
    check_tracker(config, reader);
    check_source(config, reader);
    check_faults(config, reader);
}

/// Numbers that limit other numbers. The declarations say which key is the upper limit of which; the other
/// limits are here.
fn check_limits(config: &Config, reader: &mut Reader) {
    let limited = std::mem::take(&mut reader.limited);
    let mut limit = |key: &str, allowed: &str, other: &str, is_wrong: fn(f64, f64) -> bool| {
        let [value, limit] = [key, other].map(|key| config.number(key));
        reader.refuse_if(&[key, other], is_wrong(value, limit), || {
            format!("{key} is {value}, allowed: {allowed} {other}, which is {limit}")
        });
    };
    for (key, other) in limited {
        limit(&key, "up to", other, |value, max| value > max);
    }
    let step = "insertion.step_mm";
    limit("insertion.arrival_mm", "up to half of", step, |arrival, step| arrival > 0.5 * step);
    let baseline = "observer.finite_difference.baseline_mm";
    limit(baseline, "at least", step, |baseline, step| baseline < step);
    let [timeout, period] = ["can.heartbeat_timeout_ms", "can.heartbeat_ms"];
    limit(timeout, "at least twice", period, |timeout, period| timeout < 2.0 * period);
}

/// At most one step is taken per SYNC period.
fn check_step(config: &Config, reader: &mut Reader) {
    let keys = ["insertion.step_mm", "insertion.speed_mm_per_s", "can.sync_ms"];
    let [step, speed, sync_ms] = keys.map(|key| config.number(key));
    let per_sync = speed * sync_ms / 1e3;
    let [step_key, speed_key, sync_key] = keys;
    reader.refuse_if(&keys, per_sync > step, || {
        format!(
            "{step_key} is {step}, allowed: at least what {speed_key} = {speed} moves in {sync_key} = \
             {sync_ms}, which is {per_sync}"
        )
    });
}

/// The axis can follow the fastest rotation that the control law may command, and its reversal.
fn check_rotation(config: &Config, reader: &mut Reader) {
    let section = section_name(&config.control.kind.to_string());
    let key = &*format!("control.{section}.rotation_max_deg_per_mm");
    let (per_mm, speed) = (config.number(key), config.insertion.speed_mm_per_s);
    let (speed_key, sync_key) = ("insertion.speed_mm_per_s", "can.sync_ms");
    let max_key = "stage.rotation.speed_max_deg_per_s";
    let (deg_per_s, max) = (per_mm * speed, config.number(max_key));
    reader.refuse_if(&[key, speed_key, max_key], deg_per_s > max, || {
        format!(
            "{key} is {per_mm}: at {speed} mm/s that is {deg_per_s} deg/s, over {max_key} = {max}; turn \
             by {:.4} deg/mm or insert at {:.4} mm/s",
            rounded_down(max / speed, 4),
            rounded_down(max / per_mm, 4),
        )
    });
    let (max_key, max) = (ROTATION_ACCELERATION_MAX, config.number(ROTATION_ACCELERATION_MAX));
    let peak = rotation_peak(per_mm, speed, config.can.bus.sync_period());
    reader.refuse_if(&[key, speed_key, sync_key, max_key], peak > max, || {
        format!(
            "{key} is {per_mm}: reversed at {speed} mm/s, that is {peak:.0} deg/s², over \
             {max_key} = {max}; turn or insert more slowly"
        )
    });
}

/// Rounded down to this many decimals, so that a value that a message suggests is allowed.
pub(super) fn rounded_down(value: f64, digits: i32) -> f64 {
    let per_one = 10f64.powi(digits);
    (value * per_one).floor() / per_one
}

fn check_torsion(section: &str, torsion: TorsionConfig, reader: &mut Reader) {
    let keys = TorsionConfig::KEYS.iter().map(|key| format!("{section}.torsion.{}", key.name));
    let keys: Vec<String> = keys.collect();
    let keys: Vec<&str> = keys.iter().map(String::as_str).collect();
    reader.check_result(&keys, needle::torsion(torsion, section));
}

/// Each range has its lower end first, and no trial draws a torsion offset outside its torsion band.
fn check_study(config: &Config, reader: &mut Reader) {
    for key in StudyConfig::KEYS {
        let Some([low, high]) = config.range(key) else { continue };
        let key = format!("study.{}", key.name);
        reader.refuse_if(&[&key], low > high, || {
            format!("{key} is [{low}, {high}], allowed: the lower number first")
        });
    }
    let study = &config.study;
    let [moves, tool] = ["study.target_move_mm", "goal.tool"];
    let drift = "emulator.target_drift_mm_per_mm";
    let is_drifting = config.emulator.target_drift_mm_per_mm != Vector3::zeros();
    for (key, is_moving) in [(moves, study.target_move_mm.is_some()), (drift, is_drifting)] {
        reader.refuse_if(&[key, tool], is_moving && config.goal.tool.is_none(), || {
            format!("{key} has no effect without {tool}: name the tool that is the target")
        });
    }
    let least_mm = match study.target_depth_mm {
        Some([low, _]) => low,
        None => config.goal.position_mm.map_or(f64::INFINITY, |target_mm| target_mm.norm()),
    };
    let [_, move_mm] = study.target_move_mm.unwrap_or_default();
    reader.refuse_if(&[moves, "study.target_depth_mm", "goal.position_mm"], move_mm > least_mm, || {
        format!(
            "{moves} reaches {move_mm}, allowed: up to the least distance of the target from the start, \
             {least_mm} mm; it would move faster than the needle"
        )
    });
    let or_emulated = |drawn: Option<[f64; 2]>, key: &str| {
        drawn.unwrap_or_else(|| [config.number(&format!("emulator.torsion.{key}")); 2])
    };
    let (offset, half_width) = (study.torsion_offset_deg, study.torsion_half_width_deg);
    let is_torsion_drawn = offset.is_some() || half_width.is_some();
    let [low, high] = or_emulated(offset, "offset_deg");
    let [half_width, _] = or_emulated(half_width, "half_width_deg");
    let offset = low.abs().max(high.abs());
    let is_outside =
        is_torsion_drawn && config.emulator.torsion.creep_mm == 0.0 && offset > half_width;
    let [key, band] = ["study.torsion_offset_deg", "study.torsion_half_width_deg"];
    reader.refuse_if(&[key, band], is_outside, || {
        format!(
            "{key} reaches {offset}, allowed without emulator.torsion.creep_mm: up to the least of \
             {band}, which is {half_width}: the tip would start outside its own band"
        )
    });
}

/// Correlated noise needs both its standard deviation and its correlation time. If the correlation time is
/// longer than the run, the noise is a constant offset, which no observer can distinguish from the tip.
fn check_noise(config: &Config, reader: &mut Reader) {
    let time_s = config.tracker.noise.map_or(0.0, |noise| noise.correlation_time.as_secs_f64());
    let run_s = config.insertion.depth_mm / config.insertion.speed_mm_per_s;
    let key = "tracker.noise.correlation_time_s";
    let keys = [key, "insertion.depth_mm", "insertion.speed_mm_per_s"];
    reader.refuse_if(&keys, time_s > run_s, || {
        format!(
            "{key} is {time_s}, allowed: up to the {:.3} s of the insertion; noise that lasts longer \
             is an error of the registration, tracker.registration.sd_mm",
            rounded_down(run_s, 3)
        )
    });
    let noise = config.emulator.noise;
    let keys = ["emulator.noise.correlated_sd_mm", "emulator.noise.correlation_time_s"];
    let is_given = [noise.correlated_sd_mm.is_some(), noise.correlation_time.is_some()];
    for (given, other) in [(0, 1), (1, 0)] {
        reader.refuse_if(&keys, is_given[given] && !is_given[other], || {
            format!("{} is given without {}: give both", keys[given], keys[other])
        });
    }
}

fn check_bus(config: &Config, reader: &mut Reader) {
    let nodes = [
        ("can.bench_node", config.can.bus.bench_node),
        ("stage.insertion.node", config.stage.insertion.node),
        ("stage.rotation.node", config.stage.rotation.node),
    ];
    for [first, second] in [[0, 1], [0, 2], [1, 2]] {
        let ((first, node), (second, other)) = (nodes[first], nodes[second]);
        reader.refuse_if(&[first, second], node == other, || {
            format!("{second} is {other}, the same as {first}: each node needs its own number")
        });
    }

    let interface = &config.can.interface;
    let wrong_bus = config.stage.hardware && interface.is_for_tests();
    reader.refuse_if(&["stage.hardware", "can.interface"], wrong_bus, || {
        format!(
            "can.interface is \"{interface}\", a bus made for tests, but stage.hardware is true: \
             name the interface of the real stage, such as \"can0\""
        )
    });
    let unjudged = config.stage.hardware && !config.tracker.gates.stream;
    reader.refuse_if(&["stage.hardware", "tracker.gates.stream"], unjudged, || {
        "tracker.gates.stream is false, but stage.hardware is true: with a real needle a stream that \
         contradicts the insertion must end the run; set it to true"
            .to_owned()
    });
    let unprotected = !config.stage.hardware && !interface.is_virtual();
    reader.refuse_if(&["stage.hardware", "can.interface"], unprotected, || {
        format!(
            "can.interface is \"{interface}\", which may have real drives on it, but stage.hardware \
             is false: start from bench-config/rig-epos4.toml, or name \"vcan0\" or \"udp\" for \
             emulated drives"
        )
    });
}

fn check_tracker(config: &Config, reader: &mut Reader) {
    let interface = &config.can.interface;
    let source = config.tracker.source;
    let is_emulated = source == TrackerSource::Emulated;
    let is_in_memory = *interface == CanInterface::Memory;
    let keys = ["tracker.source", "can.interface"];
    reader.refuse_if(&keys, is_emulated && !is_in_memory, || {
        format!(
            "tracker.source is \"emulated\", allowed only with can.interface = \"memory\", which is \
             \"{interface}\": it sees the emulated needle alone. Set tracker.source = \"openigtlink\""
        )
    });
    let is_recorded = config.tracker.file.is_some() || source == TrackerSource::Csv;
    reader.refuse_if(&keys, is_in_memory && !is_emulated && !is_recorded, || {
        let recording = match source {
            TrackerSource::Ndjson => ", or a recording as tracker.file",
            _ => "",
        };
        format!(
            "tracker.source is \"{source}\", but can.interface = \"memory\" is the emulated stage, \
             which only its own tracker sees: name \"vcan0\" with vcan-stage on it{recording}"
        )
    });

    let keys = ["tracker.latency_ms", "tracker.hold_after_s"];
    let ([latency, after], [latency_ms, after_s]) = (keys, keys.map(|key| config.number(key)));
    reader.refuse_if(&keys, latency_ms * 1e-3 >= after_s, || {
        format!(
            "{latency} is {latency_ms}, allowed: under {after}, which is {after_s} s: no position would \
             be young enough to steer by"
        )
    });
    // The longest way without a position: latency, tracker period, two SYNCs until the hold begins, braking.
    let (speed, hold_mm) = (config.insertion.speed_mm_per_s, config.tracker.hold.after_mm);
    let braking = config.tracker.hold.braking_mm_per_s2;
    let is_seen_here = config.tip_source() == TrackerSource::Emulated;
    let period_s = if is_seen_here { config.emulator.tracker_rate_hz.recip() } else { 0.0 };
    let noticed_s = period_s + (latency_ms + 2.0 * f64::from(config.can.bus.sync_ms)) * 1e-3;
    let least_mm = speed * noticed_s + 0.5 * speed * speed / braking;
    let [key, brake] = ["tracker.hold_after_mm", "tracker.hold_braking_mm_per_s2"];
    let keys = [key, "insertion.speed_mm_per_s", brake, latency];
    reader.refuse_if(&keys, hold_mm <= least_mm, || {
        format!(
            "{key} is {hold_mm}, allowed: over the {:.3} mm to standstill from {speed} mm/s \
             with {brake} = {braking} and {latency} = {latency_ms}: insert slower or brake harder",
            (least_mm * 1e3).ceil() / 1e3
        )
    });

    let Some(workspace) = &config.tracker.workspace else { return };
    let [min_mm, max_mm] = [workspace.min_mm, workspace.max_mm].map(<[f64; 3]>::from);
    let is_empty = min_mm.iter().zip(max_mm).any(|(&min, max)| min >= max);
    reader.refuse_if(&["tracker.workspace.min_mm", "tracker.workspace.max_mm"], is_empty, || {
        format!(
            "tracker.workspace.min_mm is {min_mm:?}, allowed: each under that of \
             tracker.workspace.max_mm, which is {max_mm:?}"
        )
    });
}

/// Fiducials determine a pose, and cannot be given beside one.
fn check_registration(config: &Config, reader: &mut Reader) {
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
    reader.check_result(&[key, REGISTRATION], config.registration_sd_mm());
}

/// Keys that only some sources of tip positions allow.
fn check_source(config: &Config, reader: &mut Reader) {
    let tracker = &config.tracker;
    let source = tracker.source;
    let [key, file, address, request] =
        ["tracker.source", "tracker.file", "tracker.address", "tracker.request"];
    reader.refuse_if(&[key, file], source == TrackerSource::Csv && tracker.file.is_none(), || {
        format!("{key} is \"{source}\", and there is no {file} to read")
    });
    let recording = format!("\"{}\"", tracker.file.as_deref().unwrap_or_default());
    let is_file = matches!(source, TrackerSource::Ndjson | TrackerSource::Csv);
    let is_ndjson = source == TrackerSource::Ndjson;
    let is_openigtlink = source == TrackerSource::OpenIgtLink;
    let is_asked = tracker.request != TrackerRequest::None;
    let is_standard_input = tracker.address == STANDARD_INPUT;
    for (other, is_given, value, has_it, sources) in [
        (file, tracker.file.is_some(), &*recording, is_file, "\"ndjson\" or \"csv\""),
        (address, is_standard_input, "\"-\"", is_ndjson, "\"ndjson\""),
        (request, is_asked, "given", is_openigtlink, "\"openigtlink\""),
    ] {
        reader.refuse_if(&[other, key], is_given && !has_it, || {
            format!("{other} is {value}, allowed with {key} = {sources}, which is \"{source}\"")
        });
    }
    let is_real = tracker.file.is_some() && config.stage.hardware;
    reader.refuse_if(&[file, "stage.hardware"], is_real, || {
        format!(
            "{file} is {recording}, but stage.hardware is true: a recording does not see the needle \
             that would move"
        )
    });
    let times = [
        ("tracker.csv.time", Some(&tracker.csv.time)),
        ("tracker.csv.stamp", tracker.csv.stamp.as_ref()),
    ];
    for (key, columns) in times {
        let is_empty = columns.is_some_and(|columns| columns.named().next().is_none());
        reader.refuse_if(&[key], is_empty, || {
            format!("{key} names no column, expected the name of one as s, ms, us or ns")
        });
    }
}

/// Each kind of fault allows only some keys, and needs some of them.
fn check_faults(config: &Config, reader: &mut Reader) {
    for (i, fault) in config.emulator.fault.iter().enumerate() {
        let (table, what) =
            (format!("emulator.fault[{i}]"), format!("a fault of kind \"{}\"", fault.kind));
        let others = &Fault::KEYS[1..];
        reader.check_own_keys(&table, &what, others, &fault.kind.keys(), fault.check());
    }
}
