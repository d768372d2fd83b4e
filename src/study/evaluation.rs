//! Runs an observer over a recorded insertion and scores it against the recorded tip.

use super::recording::{RecordedRoll, RecordedRow, Recording};
use super::statistics::{quantile, rms};
use crate::geometry::{Pose, so3};
use crate::math;
use crate::needle::{Increment, TipPosition, too_large};
use crate::observer::{Observer, Whiteness};
use crate::session::Samples;
use nalgebra::{Rotation3, UnitQuaternion};
use serde::Serialize;

/// How far ahead predictions are scored, mm.
const AHEAD_MM: f64 = 5.0;
/// No prediction is scored against a position farther ahead than this, mm.
const AHEAD_MAX_MM: f64 = 6.0;

/// The score of one observer on one recording.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecordingScore {
    /// Length of the insertion, mm.
    pub insertion_mm: f64,
    /// Steps scored.
    pub steps: usize,
    /// RMS of estimated minus recorded roll, deg; `None` without recorded orientations that turn with the base
    /// ([`Recording::roll`]), or without an estimate.
    pub roll_rms_deg: Option<f64>,
    /// The same for an observer that does not know the roll at the start; `None` for observers that
    /// must know it.
    pub roll_unknown_rms_deg: Option<f64>,
    /// RMS distance of the predicted from the recorded position, mm. The prediction is the estimate
    /// before the correction by that position.
    pub position_rms_mm: Option<f64>,
    /// RMS distance of the position predicted 5 mm ahead, with the base's actual rotation, from the
    /// recorded position, mm.
    pub prediction_5mm_rms_mm: Option<f64>,
    /// Where and why a run would have stopped because the observer diverged; `None` if it did not.
    pub diverged: Option<String>,
}

/// The scores of one observer over all recordings.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Evaluation {
    /// Median and 90% quantile of the recordings' roll RMS, deg.
    pub roll_rms_deg: Quantiles,
    /// The same with the roll at the start unknown.
    pub roll_unknown_rms_deg: Quantiles,
    /// Median of the recordings' position RMS, mm.
    pub position_rms_mm: Option<f64>,
    /// Number of recordings that it is the median of.
    pub position_insertions: usize,
    /// Median of the recordings' RMS of the position predicted 5 mm ahead, mm.
    pub prediction_5mm_rms_mm: Option<f64>,
    /// Number of recordings that it is the median of.
    pub prediction_5mm_insertions: usize,
}

/// Median and 90% quantile over the recordings that have the value.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Quantiles {
    /// Median.
    pub median: Option<f64>,
    /// 90% quantile.
    pub p90: Option<f64>,
    /// Number of recordings that have the value.
    pub insertions: usize,
}

impl Evaluation {
    /// The figures over all recordings.
    pub fn of<'a>(scores: impl Iterator<Item = &'a RecordingScore> + Clone) -> Self {
        let values = |of: fn(&RecordingScore) -> Option<f64>| -> Vec<f64> {
            scores.clone().filter_map(of).collect()
        };
        let quantiles = |of| {
            let values = values(of);
            Quantiles {
                median: quantile(&values, 0.5),
                p90: quantile(&values, 0.9),
                insertions: values.len(),
            }
        };
        let position = quantiles(|score| score.position_rms_mm);
        let prediction = quantiles(|score| score.prediction_5mm_rms_mm);
        Evaluation {
            roll_rms_deg: quantiles(|score| score.roll_rms_deg),
            roll_unknown_rms_deg: quantiles(|score| score.roll_unknown_rms_deg),
            position_rms_mm: position.median,
            position_insertions: position.insertions,
            prediction_5mm_rms_mm: prediction.median,
            prediction_5mm_insertions: prediction.insertions,
        }
    }
}

/// The settings with which recordings are evaluated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scoring {
    /// `R_SB`, the orientation of the tip frame B in the sensor frame S.
    pub r_sb: Rotation3<f64>,
    /// Depth between two steps, mm.
    pub step_mm: f64,
    /// Which positions correct the observer.
    pub samples: Samples,
    /// Configured standard deviation of each coordinate of a position, mm.
    pub position_sd_mm: f64,
    /// Depth from which errors count, mm.
    pub score_after_mm: f64,
}

/// A row as the observer sees it, in its plane frame.
struct Step {
    /// The measured increment since the row before.
    increment: Increment,
    /// Largest depth so far, from the first row, mm.
    depth_mm: f64,
    tip_meas: TipPosition,
    /// `R_PB`, for scoring.
    rotation_true: Option<Rotation3<f64>>,
}

/// The rows of `recording` in the plane frame P, which is the tip frame at the first row.
///
/// # Errors
/// A row has a number far beyond any needle; the text names its line.
fn steps(recording: &Recording, r_sb: &Rotation3<f64>) -> Result<Vec<Step>, String> {
    let first = &recording.rows[0];
    let has_roll = recording.roll() == Some(RecordedRoll::Turns);
    // R_PS0: the sensor's first orientation in the plane frame is the inverse of the mount.
    let r_ps = r_sb.inverse() * first.sensor_orientation.unwrap_or_default().inverse();
    let (mut depth_mm, mut rotation_rad) = (0.0, first.rotation_meas_rad);
    let step = |row: &RecordedRow| {
        let refused = |error: String| format!("line {}: {error}", row.line);
        // Insertion never decreases: if the encoder steps back, no tissue is cut.
        let deeper_mm = (row.insertion_meas_mm - first.insertion_meas_mm - depth_mm).max(0.0);
        let turn_rad = row.rotation_meas_rad - rotation_rad;
        let increment = Increment::new(deeper_mm, turn_rad).map_err(refused)?;
        (depth_mm, rotation_rad) = (depth_mm + deeper_mm, row.rotation_meas_rad);
        let position_mm = r_ps * (row.position_meas_mm - first.position_meas_mm);
        let tip_meas = TipPosition::new(position_mm).ok_or_else(|| {
            let way = "way from the first position in mm";
            refused(too_large(way, position_mm.amax()))
        })?;
        let rotation_true = row.sensor_orientation.filter(|_| has_roll);
        let rotation_true = rotation_true.map(|rotation| r_ps * rotation * r_sb);
        Ok(Step { increment, depth_mm, tip_meas, rotation_true })
    };
    recording.rows.iter().map(step).collect()
}

/// The prediction of `observer` at step `at` for the tip [`AHEAD_MM`] deeper, minus the recorded
/// position there, mm; `None` if no position was recorded from there to [`AHEAD_MAX_MM`] deeper.
fn prediction_error_mm(observer: &dyn Observer, steps: &[Step], at: usize) -> Option<f64> {
    let (passed, ahead) = steps.split_at(at + 1);
    let ahead_mm = |step: &Step| step.depth_mm - passed[at].depth_mm;
    let there = ahead.iter().position(|step| ahead_mm(step) >= AHEAD_MM)?;
    if ahead_mm(&ahead[there]) > AHEAD_MAX_MM {
        return None;
    }
    let way: Vec<Increment> = ahead[..=there].iter().map(|step| step.increment).collect();
    let predicted = observer.estimate_after(&way)?;
    Some((predicted.x_pb.translation - ahead[there].tip_meas.mm()).norm())
}

/// Runs `observer` over `recording`: it predicts with the measured increment of every row, and corrects at every row
/// or once per step ([`Scoring::samples`]). Each step that is deep enough is scored: the position before the
/// correction by the recorded position, and the roll after it.
///
/// The observer's plane frame P is the tip frame at the first row, so a start with all angles zero
/// is correct. The observer gets depth, base rotation and position, never the recorded orientation.
/// The roll error is the rotation about the tip's axis between estimate and record.
///
/// # Errors
/// A row's increment or position is far beyond any needle, or the recording ends before errors count.
pub fn evaluate(
    observer: &mut dyn Observer,
    recording: &Recording,
    scoring: &Scoring,
) -> Result<RecordingScore, String> {
    let steps = steps(recording, &scoring.r_sb)?;
    let depth_mm = steps.last().map_or(0.0, |step| step.depth_mm);
    if depth_mm < scoring.score_after_mm {
        return Err(format!(
            "the insertion is {depth_mm:.1} mm deep, and errors count from {} mm on \
             (evaluation.score_after_mm): record a deeper one, or score from less",
            scoring.score_after_mm
        ));
    }
    let (mut next_mm, mut scored) = (0.0, 0);
    let mut whiteness = Whiteness::new(scoring.position_sd_mm);
    let mut diverged = None;
    let (mut rolls, mut positions, mut predictions) = (Vec::new(), Vec::new(), Vec::new());
    for (at, step) in steps.iter().enumerate() {
        observer.predict(step.increment);
        let is_due = step.depth_mm >= next_mm;
        if !is_due && scoring.samples == Samples::OnePerStep {
            continue;
        }
        let predicted = observer.estimate();
        let independent = match scoring.samples {
            Samples::All => 1.0 / whiteness.inflation(f64::INFINITY),
            Samples::OnePerStep => 1.0,
        };
        observer.correct(&step.tip_meas, independent);
        if let Some(predicted) = &predicted {
            let innovation_mm = step.tip_meas.mm() - predicted.x_pb.translation;
            whiteness.take(innovation_mm, f64::INFINITY);
        }
        diverged = diverged.or_else(|| {
            let divergence = observer.check().err()?;
            Some(format!("at {:.1} mm: {divergence}", step.depth_mm))
        });
        if !is_due {
            continue;
        }
        // A gap counts as one step, however many steps it spans.
        next_mm += (((step.depth_mm - next_mm) / scoring.step_mm).floor() + 1.0) * scoring.step_mm;
        if step.depth_mm < scoring.score_after_mm {
            continue;
        }
        let estimate = observer.estimate();
        scored += usize::from(estimate.is_some());
        if let Some(predicted) = predicted {
            positions.push((predicted.x_pb.translation - step.tip_meas.mm()).norm());
        }
        predictions.extend(prediction_error_mm(observer, &steps, at));
        if let (Some(estimate), Some(rotation_true)) = (estimate, &step.rotation_true) {
            rolls.push(turn_about_axis(rotation_true, &estimate.x_pb));
        }
    }
    Ok(RecordingScore {
        insertion_mm: depth_mm,
        steps: scored,
        roll_rms_deg: rms(rolls).map(f64::to_degrees),
        roll_unknown_rms_deg: None,
        position_rms_mm: rms(positions),
        prediction_5mm_rms_mm: rms(predictions),
        diverged,
    })
}

/// The rotation about the tip's axis from `truth` to `estimate`, rad: the twist of the swing-twist
/// decomposition.
fn turn_about_axis(truth: &Rotation3<f64>, estimate: &Pose) -> f64 {
    let difference = truth.inverse() * estimate.rotation;
    // The quaternion of the logarithm has a consistent sign at half a turn.
    let q = UnitQuaternion::from_scaled_axis(so3::log(&difference));
    2.0 * math::atan2(q.k, q.w)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::FixedAngles;
    use crate::needle::Needle;
    use crate::observer::{Coupled, CoupledConfig, Estimate, FiniteDifference, Gains};
    use crate::study::mount;
    use nalgebra::Vector3;

    fn scoring(r_sb: Rotation3<f64>, step_mm: f64, score_after_mm: f64) -> Scoring {
        Scoring { r_sb, step_mm, samples: Samples::OnePerStep, position_sd_mm: 1.0, score_after_mm }
    }

    /// A recording of a needle without torsion, with a tilted sensor, in a frame of its own.
    fn recording(r_sb: &Rotation3<f64>) -> Recording {
        let needle = Needle::new(0.0125).unwrap();
        let r_so = FixedAngles { yaw: 0.4, pitch: -0.3, roll: 1.0 }.to_rotation();
        let mut tip = Pose { rotation: r_so * r_sb, translation: Vector3::new(5.0, 6.0, 7.0) };
        let (mut rows, mut rotation) = (Vec::new(), 2.0);
        for n in 0..800u32 {
            rows.push(RecordedRow {
                line: n as usize + 2,
                insertion_meas_mm: 0.1 * f64::from(n),
                rotation_meas_rad: rotation,
                position_meas_mm: tip.translation,
                sensor_orientation: Some(tip.rotation * r_sb.inverse()),
            });
            let turn = 0.02 * (f64::from(n) * 0.01).sin();
            tip = needle.step(&tip, Increment::new(0.1, turn).unwrap());
            rotation += turn;
        }
        Recording { rows }
    }

    /// The recording of a perfect needle scores nearly zero, in any frame.
    #[test]
    fn a_needle_without_torsion_is_followed() {
        let r_sb = mount(Vector3::new(0.03, -0.09, 0.97), Vector3::new(1.0, -1.2, 0.0)).unwrap();
        let needle = Needle::new(0.0125).unwrap();
        let config = CoupledConfig {
            gains: Gains::Placed,
            memory_mm: 10.0,
            start_sd: FixedAngles::default(),
            reduced_poles_per_mm: [0.1; 3],
            fibre_poles_per_mm: [0.1; 2],
            start: FixedAngles::default(),
            position_sd_mm: 0.1,
        };
        let mut observers: [Box<dyn Observer>; 2] =
            [Box::new(Coupled::new(needle, config)), Box::new(FiniteDifference::new(needle, 2.0))];
        for observer in &mut observers {
            let score =
                evaluate(observer.as_mut(), &recording(&r_sb), &scoring(r_sb, 1.0, 8.0)).unwrap();
            assert!(
                score.steps > 60
                    && score.roll_rms_deg.unwrap() < 1.0
                    && score.position_rms_mm.unwrap() < 0.01
                    && score.prediction_5mm_rms_mm.unwrap() < 0.1,
                "{score:?}"
            );
        }
    }

    /// A tracker that measures positions only may send a constant orientation with them.
    #[test]
    fn orientations_that_never_change_are_not_scored() {
        let r_sb = mount(Vector3::z(), Vector3::x()).unwrap();
        let mut recording = recording(&r_sb);
        assert_eq!(recording.roll(), Some(RecordedRoll::Turns));
        for row in &mut recording.rows {
            row.sensor_orientation = Some(Rotation3::identity());
        }
        assert_eq!(recording.roll(), Some(RecordedRoll::DoesNotTurn));
        let mut observer = FiniteDifference::new(Needle::new(0.0125).unwrap(), 2.0);
        let score = evaluate(&mut observer, &recording, &scoring(r_sb, 1.0, 8.0)).unwrap();
        assert!(score.roll_rms_deg.is_none() && score.position_rms_mm.is_some(), "{score:?}");
        recording.rows.iter_mut().for_each(|row| row.sensor_orientation = None);
        assert_eq!(recording.roll(), None, "it has no orientations");
    }

    /// A base rotation of the wrong sign or unit: a roll scored against it would look like a bad observer.
    #[test]
    fn orientations_that_turn_otherwise_than_the_base_are_not_scored() {
        let r_sb = mount(Vector3::z(), Vector3::x()).unwrap();
        for (factor, share) in [
            (-1.0, -1.5..-0.5),
            (57.3, -0.2..0.2),
            (0.5, 1.8..2.5),
            (std::f64::consts::TAU.recip(), 5.0..7.0),
        ] {
            let mut recording = recording(&r_sb);
            recording.rows.iter_mut().for_each(|row| row.rotation_meas_rad *= factor);
            match recording.roll() {
                Some(RecordedRoll::Otherwise { share: found }) => {
                    assert!(share.contains(&found), "{found}");
                }
                found => panic!("{found:?}"),
            }
        }
    }

    /// An observer that counts its calls and always predicts the origin.
    struct Counter {
        corrections: usize,
    }

    impl Observer for Counter {
        fn predict(&mut self, _: Increment) {}

        fn correct(&mut self, _: &TipPosition, _: f64) {
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
            sensor_orientation: None,
        };
        Recording { rows: depths_mm.iter().enumerate().map(row).collect() }
    }

    #[test]
    fn one_correction_follows_a_gap() {
        let r_sb = mount(Vector3::z(), Vector3::x()).unwrap();
        let mut counter = Counter { corrections: 0 };
        let depths_mm = [0.0, 1.0, 2.0, 10.0, 10.2, 10.4, 11.0];
        let score =
            evaluate(&mut counter, &straight(&depths_mm), &scoring(r_sb, 1.0, 0.0)).unwrap();
        assert_eq!((counter.corrections, score.steps), (5, 5));
    }

    /// The counter predicts the origin, so its error is the depth itself.
    #[test]
    fn a_prediction_is_scored_5_to_6_mm_ahead() {
        let r_sb = mount(Vector3::z(), Vector3::x()).unwrap();
        let error_mm = |depths_mm: &[f64]| {
            let mut counter = Counter { corrections: 0 };
            let scoring = scoring(r_sb, 1.0, 0.0);
            let score = evaluate(&mut counter, &straight(depths_mm), &scoring).unwrap();
            score.prediction_5mm_rms_mm
        };
        assert_eq!(error_mm(&[0.0, 4.0, 5.5]), Some(5.5));
        assert_eq!(error_mm(&[0.0, 4.0, 8.0]), None, "8 mm ahead, and 4");
    }

    #[test]
    fn a_row_beyond_any_needle_is_refused_by_its_line() {
        let r_sb = mount(Vector3::z(), Vector3::x()).unwrap();
        let needle = Needle::new(0.0125).unwrap();
        let mut observer = FiniteDifference::new(needle, 2.0);
        let error =
            evaluate(&mut observer, &straight(&[0.0, 1.0, 1e308]), &scoring(r_sb, 1.0, 0.0))
                .unwrap_err();
        assert_eq!(
            error,
            "line 4: insertion increment in mm is 1e308, allowed is up to 1e6 in magnitude"
        );
    }

    #[test]
    fn a_roll_error_is_scored_with_its_size() {
        let truth = FixedAngles { yaw: 0.3, pitch: 1.2, roll: -2.0 }.to_rotation();
        for off in [0.5, -3.1, 3.0] {
            let estimate = Pose {
                rotation: truth * Rotation3::from_axis_angle(&Vector3::z_axis(), off),
                translation: Vector3::zeros(),
            };
            assert!((turn_about_axis(&truth, &estimate) - off).abs() < 1e-9);
        }
    }
}
