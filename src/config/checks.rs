//! Checks for contradictions between keys, each of which is valid by itself.

use super::reader::{FIDUCIALS, REGISTRATION, Reader, contradictions};
use super::tracker::STANDARD_INPUT;
use super::warnings::section_name;
use super::{CanInterface, Config, StudyConfig, TrackerSource, axis_checks, goal, needle};
use crate::emulator::fault::Fault;
use crate::needle::TorsionConfig;
use crate::session::rotation_peak;

pub(super) const ROTATION_ACCELERATION_MAX: &str = "stage.rotation.acceleration_max_deg_per_s2";

/// Reports every contradiction in `config`.
pub(super) fn check(config: &Config, reader: &mut Reader) {
    check_limits(config, reader);
    check_step(config, reader);
    check_missed_feedback(config, reader);
    goal::check(config, reader);
    check_rotation(config, reader);
    check_torsion("needle", config.needle.torsion, reader);
    check_torsion("emulator", config.emulator.torsion, reader);
    check_study(config, reader);
    check_noise(config, reader);
    axis_checks::check(config, reader);
    check_bus(config, reader);
    check_tracker(config, reader);
    check_delays(config, reader);
    check_faults(config, reader);
}

/// Checks numbers that other keys limit. The upper limits come from the declarations of the keys; the other limits
/// are here.
fn check_limits(config: &Config, reader: &mut Reader) {
    let limited = std::mem::take(&mut reader.limited);
    let mut limit = |key: &str, allowed: &str, other: &str, is_wrong: fn(f64, f64) -> bool| {
        let [value, limit] = [key, other].map(|key| config.number(key));
        contradictions! { reader;
            [key, other] if is_wrong(value, limit) =>
                "{key} is {value}, allowed: {allowed} {other}, which is {limit}";
        }
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

/// Checks that a step lasts for two SYNC periods at least: with one, each turn comes a whole step late, and the law
/// may overshoot.
fn check_step(config: &Config, reader: &mut Reader) {
    let (step, speed) = (config.insertion.step_mm, config.insertion.speed_mm_per_s);
    let sync_ms = config.can.bus.sync_ms;
    let least = speed * 2.0 * f64::from(sync_ms) / 1e3;
    contradictions! { reader;
        ["insertion.step_mm", "insertion.speed_mm_per_s", "can.sync_ms"] if least > step =>
            "insertion.step_mm is {step}, allowed: at least what insertion.speed_mm_per_s = {speed} \
             moves in two periods of can.sync_ms = {sync_ms}, which is {least}";
    }
}

/// Checks that a real drive may leave SYNCs unanswered for no longer than the heartbeat timeout.
fn check_missed_feedback(config: &Config, reader: &mut Reader) {
    let [missed, period, timeout] =
        ["can.missed_feedback_max", "can.sync_ms", "can.heartbeat_timeout_ms"];
    let [missed_max, period_ms, timeout_ms] =
        [missed, period, timeout].map(|key| config.number(key));
    contradictions! { reader;
        [missed, period, timeout, "stage.hardware"]
            if config.stage.hardware && missed_max * period_ms > timeout_ms =>
            "{missed} is {missed_max}, allowed with stage.hardware: up to {}, as {timeout} is {timeout_ms} \
             and {period} {period_ms}",
            rounded_down(timeout_ms / period_ms, 0);
    }
}

/// Checks that the axis can follow the fastest rotation that the control law may command, and its reversal.
fn check_rotation(config: &Config, reader: &mut Reader) {
    let section = section_name(&config.control.kind.to_string());
    let key = &*format!("control.{section}.rotation_max_deg_per_mm");
    let (per_mm, speed) = (config.number(key), config.insertion.speed_mm_per_s);
    let (speed_key, max_key) = ("insertion.speed_mm_per_s", "stage.rotation.speed_max_deg_per_s");
    let (deg_per_s, max) = (per_mm * speed, config.number(max_key));
    contradictions! { reader;
        [key, speed_key, max_key] if deg_per_s > max =>
            "{key} is {per_mm}: at {speed} mm/s that is {deg_per_s} deg/s, over {max_key} = {max}; turn \
             by {:.4} deg/mm or insert at {:.4} mm/s",
            rounded_down(max / speed, 4), rounded_down(max / per_mm, 4);
    }
    let (max_key, max) = (ROTATION_ACCELERATION_MAX, config.number(ROTATION_ACCELERATION_MAX));
    let peak = rotation_peak(per_mm, speed, config.can.bus.sync_period());
    contradictions! { reader;
        [key, speed_key, "can.sync_ms", max_key] if peak > max =>
            "{key} is {per_mm}: reversed at {speed} mm/s, that is {peak:.0} deg/s², over \
             {max_key} = {max}; turn or insert more slowly";
    }
}

/// `value` rounded down to this many `digits` after the point, so that a value that a message suggests is allowed.
pub(super) fn rounded_down(value: f64, digits: i32) -> f64 {
    let per_one = 10f64.powi(digits);
    (value * per_one).floor() / per_one
}

fn check_torsion(section: &str, torsion: TorsionConfig, reader: &mut Reader) {
    let keys = TorsionConfig::KEYS.iter().map(|key| format!("{section}.torsion.{}", key.name));
    let keys: Vec<String> = keys.collect();
    let keys: Vec<&str> = keys.iter().map(String::as_str).collect();
    if let Err(error) = needle::torsion(torsion, section) {
        reader.refuse(&keys, error.to_string());
    }
}

/// Checks that each range has its lower end first, that drawn keys have an effect, that a target does not move faster
/// than the needle, and that no trial draws a torsion offset outside its torsion band.
fn check_study(config: &Config, reader: &mut Reader) {
    for key in StudyConfig::KEYS {
        let Some([low, high]) = config.range(key.name) else { continue };
        let key = &*format!("study.{}", key.name);
        contradictions! { reader;
            [key] if low > high => "{key} is [{low}, {high}], allowed: the lower number first";
        }
    }
    let study = &config.study;
    for key in ["study.target_move_mm", "emulator.target_drift_mm_per_mm"] {
        contradictions! { reader;
            [key, "goal.tool"] if config.is_changed(key) && config.goal.tool.is_none() =>
                "{key} has no effect without goal.tool: name the tool that is the target";
        }
    }
    let least_mm = match study.target_depth_mm {
        Some([low, _]) => low,
        None => config.goal.position_mm.map_or(f64::INFINITY, |target_mm| target_mm.norm()),
    };
    let [_, move_mm] = study.target_move_mm.unwrap_or_default();
    let or_emulated = |drawn: Option<[f64; 2]>, key: &str| {
        drawn.unwrap_or_else(|| [config.number(&format!("emulator.torsion.{key}")); 2])
    };
    let (offset, half_width) = (study.torsion_offset_deg, study.torsion_half_width_deg);
    let is_torsion_drawn = offset.is_some() || half_width.is_some();
    let [low, high] = or_emulated(offset, "offset_deg");
    let [half_width, _] = or_emulated(half_width, "half_width_deg");
    let offset = low.abs().max(high.abs());
    let TorsionConfig { creep_mm, creep_mm_per_mm, .. } = config.emulator.torsion;
    let has_creep = creep_mm != 0.0;
    let is_error_of_nothing = study.creep_error.is_some() && !has_creep && creep_mm_per_mm == 0.0;
    contradictions! { reader;
        ["study.creep_error", "emulator.torsion.creep_mm", "emulator.torsion.creep_mm_per_mm"]
            if is_error_of_nothing =>
            "study.creep_error has no effect: emulator.torsion.creep_mm and creep_mm_per_mm are 0";
        ["study.target_move_mm", "study.target_depth_mm", "goal.position_mm"] if move_mm > least_mm =>
            "study.target_move_mm reaches {move_mm}, allowed: up to the least distance of the target from \
             the start, {least_mm} mm; it would move faster than the needle";
        ["study.torsion_offset_deg", "study.torsion_half_width_deg"]
            if is_torsion_drawn && !has_creep && offset > half_width =>
            "study.torsion_offset_deg reaches {offset}, allowed without emulator.torsion.creep_mm: up to \
             the least of study.torsion_half_width_deg, which is {half_width}: the tip would start outside \
             its own band";
    }
}

/// Checks that correlated noise has both its standard deviation and its correlation time. If the correlation time
/// is longer than the run, the noise acts as a constant offset, which no observer can distinguish from the tip.
fn check_noise(config: &Config, reader: &mut Reader) {
    let time_s = config.tracker.noise.map_or(0.0, |noise| noise.correlation_time.as_secs_f64());
    let run_s = config.insertion.depth_mm / config.insertion.speed_mm_per_s;
    let key = "tracker.noise.correlation_time_s";
    contradictions! { reader;
        [key, "insertion.depth_mm", "insertion.speed_mm_per_s"] if time_s > run_s =>
            "{key} is {time_s}, allowed: up to the {:.3} s of the insertion; noise that lasts longer \
             is an error of the registration, tracker.registration.sd_mm",
            rounded_down(run_s, 3);
    }
    let [sd, time] = ["emulator.noise.correlated_sd_mm", "emulator.noise.correlation_time_s"];
    for (key, other) in [(sd, time), (time, sd)] {
        contradictions! { reader;
            [key, other] if config.is_changed(key) && !config.is_changed(other) =>
                "{key} is given without {other}: give both";
        }
    }
}

/// Checks that no two of the nodes at these `keys` have the same number.
pub(super) fn check_nodes(keys: &[&str], config: &Config, reader: &mut Reader) {
    for (n, second) in keys.iter().enumerate() {
        for first in &keys[..n] {
            let [node, other] = [first, second].map(|key| config.number(key));
            contradictions! { reader;
                [first, second] if node == other =>
                    "{second} is {other}, the same as {first}: each node needs its own number";
            }
        }
    }
}

fn check_bus(config: &Config, reader: &mut Reader) {
    check_nodes(&["can.bench_node", "stage.insertion.node", "stage.rotation.node"], config, reader);
    let (interface, hardware) = (&config.can.interface, config.stage.hardware);
    contradictions! { reader;
        ["stage.hardware", "can.interface"] if hardware && interface.is_for_tests() =>
            "can.interface is \"{interface}\", a bus made for tests, but stage.hardware is true: \
             name the interface of the real stage, such as \"can0\"";
        ["stage.hardware", "tracker.gates.stream"] if hardware && !config.tracker.gates.stream =>
            "tracker.gates.stream is false, but stage.hardware is true: with a real needle a stream that \
             contradicts the insertion must end the run; set it to true";
        ["stage.hardware", "can.interface"] if !hardware && !interface.is_virtual() =>
            "can.interface is \"{interface}\", which may have real drives on it, but stage.hardware \
             is false: start from bench-config/rig-epos4.toml, or name \"vcan0\" or \"udp\" for \
             emulated drives";
    }
}

/// Checks the source of tip positions, the keys that only some sources allow, and the registration.
fn check_tracker(config: &Config, reader: &mut Reader) {
    if let Err(error) = config.registration_sd_mm() {
        reader.refuse(&[FIDUCIALS, REGISTRATION], error.to_string());
    }
    let (tracker, interface) = (&config.tracker, &config.can.interface);
    let source = tracker.source;
    let is_in_memory = *interface == CanInterface::Memory;
    let [is_emulated, is_ndjson, is_csv] =
        [TrackerSource::Emulated, TrackerSource::Ndjson, TrackerSource::Csv].map(|it| it == source);
    let is_recorded = tracker.file.is_some();
    let file = tracker.file.as_deref().unwrap_or_default();
    let is_asked = config.is_changed("tracker.request");
    let or_recording = if is_ndjson { ", or a recording as tracker.file" } else { "" };
    contradictions! { reader;
        ["tracker.source", "can.interface"] if is_emulated && !is_in_memory =>
            "tracker.source is \"emulated\", allowed only with can.interface = \"memory\", which is \
             \"{interface}\": it sees the emulated needle alone. Set tracker.source = \"openigtlink\"";
        ["tracker.source", "can.interface"]
            if is_in_memory && !is_emulated && !is_recorded && !is_csv =>
            "tracker.source is \"{source}\", but can.interface = \"memory\" is the emulated stage, \
             which only its own tracker sees: name \"vcan0\" with vcan-stage on it{or_recording}";
        ["tracker.source", "tracker.file"] if is_csv && !is_recorded =>
            "tracker.source is \"csv\", and there is no tracker.file to read";
        ["tracker.file", "tracker.source"] if is_recorded && !is_ndjson && !is_csv =>
            "tracker.file is \"{file}\", allowed with tracker.source = \"ndjson\" or \"csv\", which is \
             \"{source}\"";
        ["tracker.address", "tracker.source"] if tracker.address == STANDARD_INPUT && !is_ndjson =>
            "tracker.address is \"-\", allowed with tracker.source = \"ndjson\", which is \"{source}\"";
        ["tracker.request", "tracker.source"] if is_asked && source != TrackerSource::OpenIgtLink =>
            "tracker.request is given, allowed with tracker.source = \"openigtlink\", which is \
             \"{source}\"";
        ["tracker.file", "stage.hardware"] if is_recorded && config.stage.hardware =>
            "tracker.file is \"{file}\", but stage.hardware is true: a recording does not see the needle \
             that would move";
    }
    if let Some(workspace) = &tracker.workspace {
        let [min_mm, max_mm] = [workspace.min_mm, workspace.max_mm].map(<[f64; 3]>::from);
        contradictions! { reader;
            ["tracker.workspace.min_mm", "tracker.workspace.max_mm"]
                if !goal::is_box(&workspace.min_mm, &workspace.max_mm) =>
                "tracker.workspace.min_mm is {min_mm:?}, allowed: each under that of \
                 tracker.workspace.max_mm, which is {max_mm:?}";
        }
    }
    let times = [
        ("tracker.csv.time", Some(&tracker.csv.time)),
        ("tracker.csv.stamp", tracker.csv.stamp.as_ref()),
    ];
    for (key, columns) in times {
        contradictions! { reader;
            [key] if columns.is_some_and(|columns| columns.named().next().is_none()) =>
                "{key} names no column, expected the name of one as s, ms, us or ns";
        }
    }
}

/// Checks that positions arrive soon enough to steer by, and that without one the needle can stop before
/// `tracker.hold_after_mm`.
fn check_delays(config: &Config, reader: &mut Reader) {
    let latency_ms = config.number("tracker.latency_ms");
    let after_s = config.number("tracker.hold_after_s");
    // The longest travel without a position: latency, tracker period, two SYNCs until the hold begins, braking.
    let (speed, hold) = (config.insertion.speed_mm_per_s, config.tracker.hold);
    let (hold_mm, braking) = (hold.after_mm, hold.braking_mm_per_s2);
    let is_seen_here = config.tip_source() == TrackerSource::Emulated;
    let period_s = if is_seen_here { config.emulator.tracker_rate_hz.recip() } else { 0.0 };
    let latency_max_ms = rounded_down((after_s - period_s) * 5e2, 1);
    let noticed_s = period_s + (latency_ms + 2.0 * f64::from(config.can.bus.sync_ms)) * 1e-3;
    let least_mm = speed * noticed_s + 0.5 * speed * speed / braking;
    let [key, brake] = ["tracker.hold_after_mm", "tracker.hold_braking_mm_per_s2"];
    contradictions! { reader;
        ["tracker.latency_ms", "tracker.hold_after_s"] if latency_ms > 0.0 && latency_ms >= latency_max_ms =>
            "tracker.latency_ms is {latency_ms}, allowed: under {latency_max_ms}, as tracker.hold_after_s is {after_s}: \
             until the first position of an insertion arrives, the one before grows two latencies old";
        [key, "insertion.speed_mm_per_s", brake, "tracker.latency_ms"] if hold_mm <= least_mm =>
            "{key} is {hold_mm}, allowed: over the {:.3} mm to standstill from {speed} mm/s with {brake} = \
             {braking} and tracker.latency_ms = {latency_ms}: insert slower or brake harder",
            (least_mm * 1e3).ceil() / 1e3;
    }
}

/// Checks that each fault has the keys that its kind needs, and no others.
fn check_faults(config: &Config, reader: &mut Reader) {
    for (i, fault) in config.emulator.fault.iter().enumerate() {
        let table = format!("emulator.fault[{i}]");
        let what = format!("a fault of kind \"{}\"", fault.kind);
        let others = &Fault::KEYS[1..];
        reader.check_own_keys(&table, &what, others, &fault.kind.keys(), fault.check().err());
    }
}
