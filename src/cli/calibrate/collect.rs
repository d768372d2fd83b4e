//! Fiducials touched one after the other: the tool rests on a point, the operator types where that is.

use crate::calibration::{FiducialPair, RegistrationFit};
use crate::cli::Failure;
use crate::cli::output::{tell, write_new};
use crate::cli::sources::Configured;
use crate::cli::tracker::{Listener, listen};
use crate::tracker::{Event, Gate};
use nalgebra::Vector3;
use std::fs::OpenOptions;
use std::io::{Write as _, stdin};
use std::path::Path;
use std::sync::mpsc::{Receiver, TryRecvError, channel};
use std::thread;
use std::time::Duration;

const HEADER: &str = "x_tracker_mm,y_tracker_mm,z_tracker_mm,x_bench_mm,y_bench_mm,z_bench_mm\n";
/// A point is the mean of what comes in this time; fewer positions are none.
const REST: Duration = Duration::from_secs(1);
const POSITIONS_MIN: usize = 5;
/// A tool that rests scatters by no more than so many times the configured noise.
const STILL_SDS: f64 = 2.0;
/// How often a line of the operator is looked for.
const LOOK: Duration = Duration::from_millis(20);
/// Residuals are shown, not judged, while points are missing.
const ANY_RMS_MM: f64 = 1e4;

/// Collects points of the tracker that `configured` names into the new file `path`.
pub(super) fn collect(path: &Path, configured: &Configured) -> Result<(), Failure> {
    let mut listener = listen(configured, false)?;
    if listener.config.tracker.is_standard_input() {
        let why = "--collect reads the operator's lines from standard input, not the tracker's";
        return Err(Failure::Configuration(why.to_owned()));
    }
    write_new(path, HEADER)?;
    let failed = |error| Failure::Environment(format!("{}: {error}", path.display()));
    let mut file = OpenOptions::new().append(true).open(path).map_err(failed)?;
    let lines = lines();
    let mut text = HEADER.to_owned();
    let mut number = 1;
    loop {
        tell(format_args!(
            "point {number}: touch it, hold still, and type its place on the bench as x y z in mm; an \
             empty line ends"
        ));
        let Some(line) = next_line(&lines, &mut listener) else { break };
        if line.trim().is_empty() {
            break;
        }
        let Some(bench_mm) = place(&line) else {
            tell(format_args!("not three numbers: {line}"));
            continue;
        };
        match at_rest(&mut listener) {
            Err(why) => tell(format_args!("not taken: {why}")),
            Ok(tracker_mm) => {
                let [x, y, z]: [f64; 3] = tracker_mm.into();
                let [u, v, w] = bench_mm;
                let row = format!("{x},{y},{z},{u},{v},{w}\n");
                file.write_all(row.as_bytes()).and_then(|()| file.flush()).map_err(failed)?;
                text.push_str(&row);
                tell(format_args!("taken: {x:.2}, {y:.2}, {z:.2} mm; {}", residuals(&text)));
                number += 1;
            }
        }
    }
    if number > 1 {
        return Ok(());
    }
    std::fs::remove_file(path).map_err(failed)?;
    Err(Failure::Configuration("no point was taken, and no file is left".to_owned()))
}

/// The operator's lines, read by a thread so that Ctrl-C and the tracker are not kept waiting.
fn lines() -> Receiver<String> {
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

/// The next line; `None` at the end of the input and at Ctrl-C. Positions meanwhile are let go.
fn next_line(lines: &Receiver<String>, listener: &mut Listener) -> Option<String> {
    loop {
        match lines.try_recv() {
            Ok(line) => return Some(line),
            Err(TryRecvError::Disconnected) => return None,
            Err(TryRecvError::Empty) if listener.is_over() => return None,
            Err(TryRecvError::Empty) => {
                let until = listener.now() + LOOK;
                while listener.next(until).is_some() {}
            }
        }
    }
}

/// Three numbers, with spaces or commas between them.
fn place(line: &str) -> Option<[f64; 3]> {
    let numbers: Option<Vec<f64>> = line
        .split(|c: char| c.is_whitespace() || c == ',')
        .filter(|part| !part.is_empty())
        .map(|part| part.parse().ok().filter(|number: &f64| number.is_finite()))
        .collect();
    numbers?.try_into().ok()
}

/// The mean position while the tool rests.
fn at_rest(listener: &mut Listener) -> Result<Vector3<f64>, String> {
    let until = listener.now() + REST;
    let mut positions = Vec::new();
    while let Some(event) = listener.next(until) {
        if let Event::Sample(sample) = event
            && Gate::is_measurement(&sample)
        {
            positions.push(sample.position_mm);
        }
    }
    if positions.len() < POSITIONS_MIN {
        return Err(listener.missing());
    }
    let count = positions.len() as f64;
    let mean = positions.iter().sum::<Vector3<f64>>() / count;
    let square_mm2 = positions.iter().map(|position| (position - mean).norm_squared()).sum::<f64>();
    let sd_mm = (square_mm2 / (3.0 * count)).sqrt();
    let limit_mm = STILL_SDS * listener.config.tracker.to_track().noise_sd_mm;
    match sd_mm <= limit_mm {
        true => Ok(mean),
        false => Err(format!(
            "the tool scattered by {sd_mm:.2} mm (limit {limit_mm:.2}, from tracker.gates.noise_sd_mm): \
             hold it still, or measure the noise"
        )),
    }
}

/// How well the points of `text` fit, once there are enough.
fn residuals(text: &str) -> String {
    let pairs = FiducialPair::parse(text).map_err(|error| error.to_string());
    match pairs.and_then(|pairs| RegistrationFit::of(&pairs, ANY_RMS_MM).map_err(|e| e.to_string()))
    {
        Ok(fit) => format!(
            "{} points fit by {:.2} mm RMS, the worst is point {} by {:.2} mm",
            fit.points, fit.rms_mm, fit.worst_point, fit.worst_mm
        ),
        Err(why) => why,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_is_three_numbers() {
        assert_eq!(place(" 1 -2.5,3\n"), Some([1.0, -2.5, 3.0]));
        for wrong in ["1 2", "1 2 3 4", "a b c", "1 2 NaN", "1;2;3"] {
            assert_eq!(place(wrong), None, "{wrong}");
        }
    }
}
