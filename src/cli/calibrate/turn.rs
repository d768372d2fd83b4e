//! The base turned once in air and back, by jogs of the stage; their records hold the sensor's circle.

use crate::cli::Failure;
use crate::cli::ending::status;
use crate::cli::insertions::{Followed, follow, position_at};
use crate::cli::output::{tell, write_new};
use crate::cli::sources::{Configured, load, rehearsed};
use crate::cli::stage::{is_meant, perform, sensor_off_axis};
use crate::tracker::Gate;
use std::path::Path;

const COLUMNS: &str = "rotation_rad,x_mm,y_mm,z_mm";
const ORIENTATION: &str = ",qw,qx,qy,qz";
/// Of a row with an orientation.
const CELLS: usize = 8;
/// A whole turn, and back: no cable is left wound up, and what lags one way leads the other.
const TURNS: [&str; 2] = ["360deg", "-360deg"];
/// Rows of a turn are this far apart at least: a rest gives one.
const ROWS_APART_DEG: f64 = 0.5;

/// Turns the base of the stage that `configured` names and writes the sensor's positions into the new
/// file `path`; returns their configured noise, mm. After a turn that did not complete nothing is written,
/// and its exit status is returned.
pub(super) fn turn(
    path: &Path,
    configured: &Configured,
    rehearse: bool,
) -> Result<Result<f64, u8>, Failure> {
    if path.exists() {
        return Err(Failure::in_file(path, "exists, and is not overwritten; name another file"));
    }
    let mut sets = rehearsed(&configured.set, rehearse);
    let mut config = load(configured.path(), None, &sets)?;
    is_meant(config.bus(), rehearse)?;
    if let Some(key) = sensor_off_axis(&config) {
        tell(format_args!("emulated    {key}"));
        sets.push(key);
        config = load(configured.path(), None, &sets)?;
    }
    let (mut rows, mut has_orientation) = (Vec::new(), true);
    for by in TURNS {
        let (report, summary) =
            perform(&config, &["jog", "--axis", "rotation", "--by", by], false)?;
        tell(summary);
        let status = status(&config, &report);
        if status != 0 {
            return Ok(Err(status));
        }
        for row in rows_of(follow(&report.run_dir)?) {
            has_orientation &= row.len() == CELLS;
            rows.push(row);
        }
    }
    let cells = if has_orientation { CELLS } else { 4 };
    let mut text = format!("{COLUMNS}{}\n", if has_orientation { ORIENTATION } else { "" });
    for row in rows {
        let row: Vec<String> = row.iter().take(cells).map(f64::to_string).collect();
        text += &format!("{}\n", row.join(","));
    }
    write_new(path, &text)?;
    Ok(Ok(config.tracker.to_track().noise_sd_mm))
}

/// The base's rotation, the sensor's position and, where the tracker gives it, its orientation. That the
/// rotation is taken without the tracker's stamps does no harm: the fit needs its sense alone.
fn rows_of(turn: Followed) -> Vec<Vec<f64>> {
    let Followed { config, stage, samples, .. } = turn;
    let mut rows: Vec<Vec<f64>> = Vec::new();
    for sample in samples.into_iter().map(|sample| sample.received) {
        let acquired = sample.receive_time - config.tracker.latency;
        let Some(at) = position_at(&stage, acquired).filter(|_| Gate::is_measurement(&sample))
        else {
            continue;
        };
        let rotation_rad = at.rotation_rad;
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
