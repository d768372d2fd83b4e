//! The recordings that a calibration makes for itself. For a registration the operator rests the tool on each
//! fiducial and types its bench coordinates. For the tip the stage turns the base once in air and back, by two
//! jogs; their records hold the sensor's circle.

use crate::calibration::registration::FIDUCIAL_COLUMNS;
use crate::calibration::tip::TURN_COLUMNS;
use crate::calibration::{FiducialPair, RegistrationFit};
use crate::cli::arguments::Configured;
use crate::cli::calibrate::tracker::QUATERNION;
use crate::cli::ending::status;
use crate::cli::output::{print_stderr, refuse_unwritable, write_new};
use crate::cli::perform::Options;
use crate::cli::records::{RunMeasurements, position_at, read_run};
use crate::cli::stage::{load_stage, perform, sensor_off_axis};
use crate::cli::tracker::{Listener, listen};
use crate::cli::{Failure, Result, STOPPED, finish_with};
use crate::config::Config;
use crate::geometry::Pose;
use crate::session::MovingMean;
use crate::tracker::{Event, Registration};
use nalgebra::Vector3;
use std::fs::OpenOptions;
use std::io::{Write as _, stdin};
use std::path::Path;
use std::sync::mpsc::{Receiver, TryRecvError, channel};
use std::thread;
use std::time::Duration;

/// Time at rest over which the positions of a point are averaged.
const REST: Duration = Duration::from_secs(1);
/// Fewest positions that give a point.
const POSITIONS_MIN: usize = 5;
/// Timeout of a point while the tool does not rest.
const WAIT_MAX: Duration = Duration::from_secs(10);
/// Largest scatter of a tool at rest, in units of the configured noise.
const STILL_SDS: f64 = 2.0;
/// Interval at which the operator's next line is checked for.
const LINE_POLL: Duration = Duration::from_millis(20);
/// RMS limit while points are missing: residuals are then shown, not judged.
const ANY_RMS_MM: f64 = 1e4;

/// Collects points of the tracker that `configured` names into the new file `path`.
pub(super) fn collect_fiducials(path: &Path, configured: &Configured) -> Result<()> {
    let mut listener = listen(configured, false)?;
    if listener.config.tracker.is_standard_input() {
        let why = "--collect reads the operator's lines from standard input, not the tracker's";
        return Err(Failure::configuration(why));
    }
    let header = FIDUCIAL_COLUMNS.join(",") + "\n";
    write_new(path, &header)?;
    let failed = |error| Failure::io(path, error);
    let mut file = OpenOptions::new().append(true).open(path).map_err(failed)?;
    let lines = read_lines();
    let mut text = header.clone();
    loop {
        let number = text.lines().count();
        print_stderr(format_args!(
            "point {number}: touch it, hold still, and type its bench coordinates as x y z in mm; an \
             empty line ends, `undo` removes the last point"
        ));
        let Some(line) = next_line(&lines, &mut listener) else { break };
        if line.trim().is_empty() {
            break;
        }
        if line.trim() == "undo" {
            text = text.split_inclusive('\n').take((number - 1).max(1)).collect();
            // The file is in append mode: the next point follows the rows that remain.
            file.set_len(text.len() as u64).map_err(failed)?;
            continue;
        }
        let Some(bench_mm) = parse_position(&line) else {
            print_stderr(format_args!("not three numbers: {line}"));
            continue;
        };
        match position_at_rest(&mut listener) {
            Err(why) => print_stderr(format_args!("not taken: {why}")),
            Ok(tracker_mm) => {
                let [x, y, z]: [f64; 3] = tracker_mm.into();
                let [u, v, w] = bench_mm;
                let row = format!("{x},{y},{z},{u},{v},{w}\n");
                file.write_all(row.as_bytes()).and_then(|()| file.flush()).map_err(failed)?;
                text.push_str(&row);
                print_stderr(format_args!(
                    "taken: {x:.2}, {y:.2}, {z:.2} mm; {}",
                    residuals(&text)
                ));
            }
        }
    }
    if text != header && listener.is_over() {
        let (points, file) = (text.lines().count() - 1, path.display());
        let message = format!(
            "interrupted, or the tracker's stream has ended; {points} points are in {file}: needle-bench calibrate \
             registration {file} uses them"
        );
        return Err(Failure { message: Some(message), status: STOPPED });
    }
    if text != header {
        return Ok(());
    }
    std::fs::remove_file(path).map_err(failed)?;
    Err(Failure::configuration("no point was taken, and no file is left"))
}

/// The operator's lines, read by a separate thread so that Ctrl-C and the tracker need not wait.
fn read_lines() -> Receiver<String> {
    let (send, lines) = channel();
    thread::spawn(move || {
        for line in stdin().lines().map_while(Result::ok) {
            if send.send(line).is_err() {
                break;
            }
        }
    });
    lines
}

/// The next line; `None` at the end of the input and at Ctrl-C. Drops the positions that come in the meantime.
fn next_line(lines: &Receiver<String>, listener: &mut Listener) -> Option<String> {
    loop {
        match lines.try_recv() {
            Ok(line) => return Some(line),
            Err(TryRecvError::Disconnected) => return None,
            Err(TryRecvError::Empty) if listener.is_over() => return None,
            Err(TryRecvError::Empty) => {
                let until = listener.now() + LINE_POLL;
                while listener.next(until).is_some() {}
            }
        }
    }
}

/// Parses three numbers, separated by spaces or commas.
fn parse_position(line: &str) -> Option<[f64; 3]> {
    let numbers: Option<Vec<f64>> = line
        .split(|c: char| c.is_whitespace() || c == ',')
        .filter(|part| !part.is_empty())
        .map(|part| part.parse().ok().filter(|number: &f64| number.is_finite()))
        .collect();
    numbers?.try_into().ok()
}

/// Waits until the tool has rested for a second; returns the mean position of the tip in that second, in the
/// tracker's frame. Tells the operator once if the tool moves.
fn position_at_rest(listener: &mut Listener) -> Result<Vector3<f64>, String> {
    let begun = listener.now();
    let limit_mm = STILL_SDS * listener.config.tracker.to_track().noise_sd_mm;
    let tip = Registration::new(Pose::identity()).with_tip(listener.config.tracker.x_sb());
    let gate = listener.config.tracker.to_unregistered_gate();
    let mut last_second = MovingMean::new(REST);
    let mut moved_mm = None;
    while let Some(event) = listener.next(begun + WAIT_MAX) {
        let Event::Sample(sample) = event else { continue };
        if gate.check_content(&sample).is_err() {
            continue;
        }
        let tip_mm = tip.tip_mm(&sample).map_err(|refusal| refusal.to_string())?;
        last_second.take(sample.receive_time, tip_mm);
        let waited = sample.receive_time.since(begun);
        let Some((mean_mm, sd_mm)) = mean_and_sd_mm(&last_second, waited) else { continue };
        if sd_mm <= limit_mm {
            return Ok(mean_mm);
        }
        if moved_mm.replace(sd_mm).is_none() {
            print_stderr("the tool moves: hold it still");
        }
    }
    Err(match moved_mm {
        _ if listener.is_over() => "interrupted, or the tracker's stream has ended".to_owned(),
        Some(sd_mm) => format!(
            "the tool scattered by {sd_mm:.2} mm for {} s (limit {limit_mm:.2}, from \
             tracker.gates.noise_sd_mm): hold it still, or measure the noise",
            WAIT_MAX.as_secs()
        ),
        None => listener.explain_missing(),
    })
}

/// Mean of the last second and standard deviation of a coordinate, mm, once there is a whole second with enough
/// positions.
fn mean_and_sd_mm(last_second: &MovingMean, waited: Duration) -> Option<(Vector3<f64>, f64)> {
    let is_enough = waited >= REST && last_second.count() >= POSITIONS_MIN;
    let (mean_mm, variance_mm2) = last_second.mean_and_variance().filter(|_| is_enough)?;
    Some((mean_mm, variance_mm2.sqrt()))
}

/// How well the points in `text` fit, if there are enough.
fn residuals(text: &str) -> String {
    let fit = FiducialPair::parse(text).and_then(|pairs| RegistrationFit::of(&pairs, ANY_RMS_MM));
    match fit {
        Ok(fit) => format!(
            "{} points fit by {:.2} mm RMS, the worst is point {} by {:.2} mm",
            fit.points, fit.rms_mm, fit.worst_point, fit.worst_mm
        ),
        Err(why) => why,
    }
}

/// A whole turn and back, so that no cable stays wound up and the lags of the two directions cancel.
const TURNS: [&str; 2] = ["360deg", "-360deg"];
/// Smallest rotation between two rows of a turn: a base at rest gives one row.
const ROWS_APART_DEG: f64 = 0.5;

/// Turns the base of the stage that `configured` names and writes the sensor's positions into the new
/// file `path`; returns the text of the file and the configuration. Writes nothing after a turn that did not complete,
/// and nothing in a rehearsal, whose sensor is emulated.
pub(super) fn record_turn(
    path: &Path,
    configured: &Configured,
    rehearse: bool,
) -> Result<(String, Config)> {
    // A rehearsal does not write the file.
    refuse_unwritable(Some(path).filter(|_| !rehearse))?;
    let configured = configured.clone().rehearsed(rehearse);
    let (mut config, _) = load_stage(configured, rehearse, sensor_off_axis)?;
    let mut rows = Vec::new();
    for by in TURNS {
        let line = format!("jog --axis rotation --by {by}");
        let report = perform(&config, &line, Options::default())?;
        finish_with(status(&config, &report))?;
        if let Some(position) = report.stage_at_end.position {
            // The turn back has a new emulated stage: it starts where this one ended.
            config.emulator.rotation_start_deg = position.rotation_rad.to_degrees();
        }
        if let Some(run_dir) = &report.run_dir {
            rows.extend(rows_of(read_run(run_dir)?));
        }
    }
    let columns = [&TURN_COLUMNS[..], &QUATERNION].concat();
    let has_orientation = rows.iter().all(|row| row.len() == columns.len());
    let cells = if has_orientation { columns.len() } else { TURN_COLUMNS.len() };
    let mut text = columns[..cells].join(",") + "\n";
    for row in rows {
        let row: Vec<String> = row.iter().take(cells).map(f64::to_string).collect();
        text += &(row.join(",") + "\n");
    }
    if !rehearse {
        write_new(path, &text)?;
    }
    Ok((text, config))
}

/// Rows of the base's rotation, the sensor's position and, if the tracker gives it, its orientation. The rotation
/// is taken at the receipt less the latency, not at the tracker's stamp: the fit needs only its direction.
fn rows_of(turn: RunMeasurements) -> Vec<Vec<f64>> {
    let RunMeasurements { config, stage, samples, .. } = turn;
    let gate = config.tracker.to_unregistered_gate();
    let mut rows: Vec<Vec<f64>> = Vec::new();
    for sample in samples.into_iter().map(|sample| sample.received) {
        let acquired = sample.receive_time - config.tracker.latency;
        let Some(measured) =
            position_at(&stage, acquired).filter(|_| gate.check_content(&sample).is_ok())
        else {
            continue;
        };
        let rotation_rad = measured.rotation_rad;
        let is_near = |row: &Vec<f64>| (rotation_rad - row[0]).abs() < ROWS_APART_DEG.to_radians();
        if rows.last().is_some_and(is_near) {
            continue;
        }
        let position = sample.position_mm.iter().copied();
        let orientation = sample.orientation.iter().flat_map(|q| [q.w, q.i, q.j, q.k]);
        rows.push([rotation_rad].into_iter().chain(position).chain(orientation).collect());
    }
    rows
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::Time;

    #[test]
    fn a_position_is_three_numbers() {
        assert_eq!(parse_position(" 1 -2.5,3\n"), Some([1.0, -2.5, 3.0]));
        for wrong in ["1 2", "1 2 3 4", "a b c", "1 2 NaN", "1;2;3"] {
            assert_eq!(parse_position(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn a_point_is_the_mean_of_the_first_second_at_rest() {
        let mut last_second = MovingMean::new(REST);
        // The tip comes to rest after half a second. Positions are 0.05 mm to either side.
        let mut first_still = None;
        for k in 1..=80 {
            let now = Time::from_secs_f64(f64::from(k) * 0.025);
            let way_mm = f64::from((20 - k).max(0)) + if k % 2 == 0 { 0.05 } else { -0.05 };
            last_second.take(now, Vector3::new(7.0, way_mm, 0.0));
            match mean_and_sd_mm(&last_second, now.since(Time::ZERO)) {
                None => assert!(k < 40, "no mean after a whole second, at {k}"),
                Some(_) if k < 40 => panic!("a mean before a whole second, at {k}"),
                Some((mean_mm, sd_mm)) if sd_mm < 0.06 => {
                    first_still.get_or_insert((k, mean_mm));
                }
                Some(_) => {}
            }
        }
        let (k, mean_mm) = first_still.expect("it rests");
        assert!((60..=61).contains(&k), "a position on the way counts: {k}");
        assert!((mean_mm - Vector3::new(7.0, 0.0, 0.0)).norm() < 0.05, "{mean_mm}");
    }
}
