//! An observer over a recorded insertion, scored against the recorded tip.

use super::recording::Recording;
use super::statistics::{quantile, rms};
use crate::geometry::{Pose, so3};
use crate::needle::{Increment, NeedleError, TipPosition};
use crate::observer::Observer;
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use serde::Serialize;
use thiserror::Error;

/// Why a recording was not evaluated.
#[derive(Debug, Clone, PartialEq, Error)]
#[error("line {line}: {source}")]
pub struct EvaluationError {
    /// Line of the row in the file, from 1.
    pub line: usize,
    /// What is wrong with it.
    pub source: NeedleError,
}

/// How the tip frame B sits in the sensor frame S: `R_SB`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mount {
    r_sb: Rotation3<f64>,
}

/// Why a mount was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum MountError {
    /// The travel direction has no length.
    #[error("the direction of travel in the sensor frame is zero")]
    NoTravel,
    /// The bend axis has no length across the direction of travel.
    #[error("the bend axis in the sensor frame is zero or along the direction of travel")]
    NoBend,
}

impl Mount {
    /// The mount from two vectors in the sensor frame, of any length: where the tip travels
    /// (B's z axis), and the axis about which the path of the unturned needle bends (B's x axis,
    /// made orthogonal to travel).
    ///
    /// # Errors
    /// [`MountError`] where the two do not span a plane.
    pub fn new(travel: Vector3<f64>, bend_axis: Vector3<f64>) -> Result<Self, MountError> {
        let z = travel.try_normalize(1e-9).ok_or(MountError::NoTravel)?;
        let x =
            (bend_axis - z * bend_axis.dot(&z)).try_normalize(1e-9).ok_or(MountError::NoBend)?;
        let columns = Matrix3::from_columns(&[x, z.cross(&x), z]);
        Ok(Mount { r_sb: Rotation3::from_matrix_unchecked(columns) })
    }
}

/// How one observer did on one recording.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Score {
    /// Length of the insertion, mm.
    pub insertion_mm: f64,
    /// Steps scored.
    pub steps: usize,
    /// RMS of the estimated minus the recorded roll, deg; `None` without recorded orientation or
    /// without an estimate.
    pub roll_rms_deg: Option<f64>,
    /// RMS distance of the predicted from the recorded position, mm: as estimated at the row before
    /// that row's own position corrected it.
    pub position_rms_mm: Option<f64>,
}

/// How one observer did on all recordings.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Evaluation {
    /// Median and 90% quantile of the recordings' roll RMS, deg.
    pub roll_rms_deg: Quantiles,
    /// Median of the recordings' position RMS, mm.
    pub position_rms_mm: Option<f64>,
}

/// Median and 90% quantile.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Quantiles {
    /// Median.
    pub median: Option<f64>,
    /// 90% quantile.
    pub p90: Option<f64>,
}

impl Evaluation {
    /// The figures over all recordings.
    pub fn of<'a>(scores: impl IntoIterator<Item = &'a Score>) -> Self {
        let (rolls, positions): (Vec<_>, Vec<_>) =
            scores.into_iter().map(|score| (score.roll_rms_deg, score.position_rms_mm)).unzip();
        let rolls: Vec<f64> = rolls.into_iter().flatten().collect();
        let positions: Vec<f64> = positions.into_iter().flatten().collect();
        Evaluation {
            roll_rms_deg: Quantiles { median: quantile(&rolls, 0.5), p90: quantile(&rolls, 0.9) },
            position_rms_mm: quantile(&positions, 0.5),
        }
    }
}

/// Runs `observer` over `recording`: carried on with every row's measured increments, corrected
/// once every `step_mm`, scored at each correction deeper than `score_after_mm`: the position before
/// the correction, since it is corrected with the very position it is compared with, the roll after.
///
/// The observer's plane frame P is the tip frame at the first row, so that a start with all
/// angles zero is right; it gets depth, base rotation and position, never the recorded
/// orientation. Roll error is the turn about the tip's axis between estimate and record.
///
/// # Errors
/// [`EvaluationError`] where a row's increment or position is beyond anything a needle does.
pub fn evaluate(
    observer: &mut dyn Observer,
    recording: &Recording,
    mount: &Mount,
    step_mm: f64,
    score_after_mm: f64,
) -> Result<Score, EvaluationError> {
    let r_bs = mount.r_sb.inverse();
    let first = &recording.rows[0];
    // R_PS0: the sensor's first orientation, seen from the plane frame, is the mount's inverse.
    let r_ps = r_bs * first.rotation_true.unwrap_or_default().inverse();
    let (mut cut_mm, mut rotation_rad) = (first.insertion_meas_mm, first.rotation_meas_rad);
    let mut next_mm = cut_mm;
    let (mut steps, mut rolls, mut positions) = (0, Vec::new(), Vec::new());
    for row in &recording.rows {
        let refused = |source| EvaluationError { line: row.line, source };
        // Insertion never counts backwards: an encoder that steps back has cut no tissue.
        let deeper_mm = (row.insertion_meas_mm - cut_mm).max(0.0);
        let turn_rad = row.rotation_meas_rad - rotation_rad;
        observer.predict(Increment::new(deeper_mm, turn_rad).map_err(refused)?);
        (cut_mm, rotation_rad) = (cut_mm + deeper_mm, row.rotation_meas_rad);
        if cut_mm < next_mm {
            continue;
        }
        // One correction after a gap, however many steps it spans.
        next_mm += (((cut_mm - next_mm) / step_mm).floor() + 1.0) * step_mm;
        let position_mm = r_ps * (row.position_meas_mm - first.position_meas_mm);
        let tip_meas = TipPosition::new(position_mm).ok_or_else(|| {
            refused(NeedleError::TooLarge {
                quantity: "way from the first position in mm",
                value: position_mm.amax(),
                limit: TipPosition::COORDINATE_MAX_MM,
            })
        })?;
        let predicted = observer.estimate();
        observer.correct(&tip_meas);
        let estimate = observer.estimate();
        if cut_mm - first.insertion_meas_mm < score_after_mm {
            continue;
        }
        steps += usize::from(estimate.is_some());
        if let Some(predicted) = predicted {
            positions.push((predicted.x_pb.translation - position_mm).norm());
        }
        if let (Some(estimate), Some(rotation_true)) = (estimate, row.rotation_true) {
            rolls.push(turn_about_axis(&(r_ps * rotation_true * mount.r_sb), &estimate.x_pb));
        }
    }
    Ok(Score {
        insertion_mm: cut_mm - first.insertion_meas_mm,
        steps,
        roll_rms_deg: rms(rolls).map(f64::to_degrees),
        position_rms_mm: rms(positions),
    })
}

/// The turn about the tip's own axis from `truth` to `estimate`, rad: the twist of swing and twist.
fn turn_about_axis(truth: &Rotation3<f64>, estimate: &Pose) -> f64 {
    let difference = truth.inverse() * estimate.rotation;
    // Through the logarithm's quaternion, which is sign-safe at half a turn.
    let q = UnitQuaternion::from_scaled_axis(so3::log(&difference));
    2.0 * q.k.atan2(q.w)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::FixedAngles;
    use crate::needle::Needle;
    use crate::observer::{Coupled, CoupledConfig, Estimate, FiniteDifference};
    use crate::study::RecordedRow;

    /// A recording of a torsion-free needle, its sensor mounted askew and in a frame of its own.
    fn recording(mount: &Mount) -> Recording {
        let needle = Needle::new(0.0125).unwrap();
        let r_so = FixedAngles { yaw: 0.4, pitch: -0.3, roll: 1.0 }.to_rotation();
        let mut tip =
            Pose { rotation: r_so * mount.r_sb, translation: Vector3::new(5.0, 6.0, 7.0) };
        let (mut rows, mut rotation) = (Vec::new(), 2.0);
        for n in 0..800u32 {
            rows.push(RecordedRow {
                line: n as usize + 2,
                insertion_meas_mm: 0.1 * f64::from(n),
                rotation_meas_rad: rotation,
                position_meas_mm: tip.translation,
                rotation_true: Some(tip.rotation * mount.r_sb.inverse()),
            });
            let turn = 0.02 * (f64::from(n) * 0.01).sin();
            tip = needle.step(&tip, Increment::new(0.1, turn).unwrap());
            rotation += turn;
        }
        Recording { rows }
    }

    /// What a perfect needle's recording is scored at: next to nothing, in any frame.
    #[test]
    fn a_needle_without_torsion_is_followed() {
        let mount =
            Mount::new(Vector3::new(0.03, -0.09, 0.97), Vector3::new(1.0, -1.2, 0.0)).unwrap();
        let needle = Needle::new(0.0125).unwrap();
        let config = CoupledConfig {
            reduced_poles_per_mm: [0.1; 3],
            fibre_poles_per_mm: [0.1; 2],
            start: FixedAngles::default(),
        };
        let mut observers: [Box<dyn Observer>; 2] = [
            Box::new(Coupled::new(needle, config).unwrap()),
            Box::new(FiniteDifference::new(needle, 2.0)),
        ];
        for observer in &mut observers {
            let score = evaluate(observer.as_mut(), &recording(&mount), &mount, 1.0, 8.0).unwrap();
            assert!(
                score.steps > 60
                    && score.roll_rms_deg.unwrap() < 1.0
                    && score.position_rms_mm.unwrap() < 0.01,
                "{score:?}"
            );
        }
    }

    /// An observer that only counts what it is asked to do, and predicts the origin for ever.
    struct Counter {
        corrections: usize,
    }

    impl Observer for Counter {
        fn predict(&mut self, _: Increment) {}

        fn correct(&mut self, _: &TipPosition) {
            self.corrections += 1;
        }

        fn estimate_after(&self, _: &[Increment]) -> Option<Estimate> {
            Some(Estimate::of_pose(Pose::identity()))
        }
    }

    fn straight(depths_mm: &[f64]) -> Recording {
        let row = |(n, &depth_mm): (usize, &f64)| RecordedRow {
            line: n + 2,
            insertion_meas_mm: depth_mm,
            rotation_meas_rad: 0.0,
            position_meas_mm: Vector3::z() * depth_mm,
            rotation_true: None,
        };
        Recording { rows: depths_mm.iter().enumerate().map(row).collect() }
    }

    #[test]
    fn one_correction_follows_a_gap() {
        let mount = Mount::new(Vector3::z(), Vector3::x()).unwrap();
        let mut counter = Counter { corrections: 0 };
        let depths_mm = [0.0, 1.0, 2.0, 10.0, 10.2, 10.4, 11.0];
        let score = evaluate(&mut counter, &straight(&depths_mm), &mount, 1.0, 0.0).unwrap();
        assert_eq!((counter.corrections, score.steps), (5, 5));
    }

    #[test]
    fn a_row_beyond_any_needle_is_refused_by_its_line() {
        let mount = Mount::new(Vector3::z(), Vector3::x()).unwrap();
        let needle = Needle::new(0.0125).unwrap();
        let mut observer = FiniteDifference::new(needle, 2.0);
        let error =
            evaluate(&mut observer, &straight(&[0.0, 1.0, 1e308]), &mount, 1.0, 0.0).unwrap_err();
        assert_eq!(
            error.to_string(),
            "line 4: insertion increment in mm is 1e308, allowed is up to 1e6 in magnitude"
        );
    }

    /// A wrong assumed roll shows in the score as just that.
    #[test]
    fn a_roll_that_is_off_is_scored_as_such() {
        let truth = FixedAngles { yaw: 0.3, pitch: 1.2, roll: -2.0 }.to_rotation();
        for off in [0.5, -3.1, 3.0] {
            let estimate = Pose {
                rotation: truth * Rotation3::from_axis_angle(&Vector3::z_axis(), off),
                translation: Vector3::zeros(),
            };
            assert!((turn_about_axis(&truth, &estimate) - off).abs() < 1e-9);
        }
    }

    #[test]
    fn a_mount_needs_two_directions() {
        assert_eq!(Mount::new(Vector3::zeros(), Vector3::x()), Err(MountError::NoTravel));
        assert_eq!(Mount::new(Vector3::z(), Vector3::z() * 2.0), Err(MountError::NoBend));
    }
}
