//! The figures of one run.

use super::statistics::rms;
use crate::emulator::Truth;
use crate::geometry::coordinates;
use crate::session::{SampleRecord, StepRecord};
use crate::stage::Feedback;
use crate::units::{Time, wrap_angle};
use derive_more::Display;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// A tip within this distance of the plane counts as in the plane, mm.
pub const OFF_PLANE_LIMIT_MM: f64 = 1.0;

/// Estimated minus true tip: mm and degrees.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, Display)]
#[display(
    "x {x_mm:.3} y {y_mm:.3} z {z_mm:.3} mm, yaw {yaw_deg:.2} pitch {pitch_deg:.2} roll {roll_deg:.2} deg"
)]
pub struct TipError {
    /// x, mm.
    pub x_mm: f64,
    /// y, mm.
    pub y_mm: f64,
    /// z, mm.
    pub z_mm: f64,
    /// Yaw, deg.
    pub yaw_deg: f64,
    /// Pitch, deg.
    pub pitch_deg: f64,
    /// Roll, deg.
    pub roll_deg: f64,
}

impl TipError {
    /// The coordinates, named with their units, in the order of [`TipError::coordinates`].
    pub const COORDINATES: [&str; 6] = ["x_mm", "y_mm", "z_mm", "yaw_deg", "pitch_deg", "roll_deg"];

    /// The error of a step's estimate; `None` without an estimate.
    pub fn of(step: &StepRecord, truth: &Truth) -> Option<Self> {
        let estimate = coordinates(&step.decision.estimate.as_ref()?.x_pb);
        Some(TipError::between(estimate, coordinates(&truth.x_pb)))
    }

    /// The error of an estimate, both as x, y, z in mm and yaw, pitch, roll in rad.
    pub fn between(est: [f64; 6], truth: [f64; 6]) -> Self {
        TipError::from(std::array::from_fn(|i| match i {
            0..3 => est[i] - truth[i],
            _ => wrap_angle(est[i] - truth[i]).to_degrees(),
        }))
    }

    /// x, y, z in mm and yaw, pitch, roll in deg.
    pub fn coordinates(&self) -> [f64; 6] {
        [self.x_mm, self.y_mm, self.z_mm, self.yaw_deg, self.pitch_deg, self.roll_deg]
    }

    /// A `statistic`, such as the RMS, of each coordinate over all `errors`; `None` if it is `None` for any.
    pub fn by_coordinate(
        errors: &[TipError],
        statistic: impl Fn(Vec<f64>) -> Option<f64>,
    ) -> Option<Self> {
        let mut all = [0.0; 6];
        for (i, value) in all.iter_mut().enumerate() {
            *value = statistic(errors.iter().map(|error| error.coordinates()[i]).collect())?;
        }
        Some(TipError::from(all))
    }
}

/// x, y, z in mm and yaw, pitch, roll in deg.
impl From<[f64; 6]> for TipError {
    fn from([x_mm, y_mm, z_mm, yaw_deg, pitch_deg, roll_deg]: [f64; 6]) -> Self {
        TipError { x_mm, y_mm, z_mm, yaw_deg, pitch_deg, roll_deg }
    }
}

/// Values, each with its depth, mm.
pub(super) type ByDepth<T> = Vec<(f64, T)>;

/// The values in the last third of `insertion_mm`.
pub(super) fn last_third<T: Copy>(
    values: &ByDepth<T>,
    insertion_mm: f64,
) -> impl Iterator<Item = T> {
    let from_mm = insertion_mm * 2.0 / 3.0;
    values.iter().filter(move |(depth_mm, _)| *depth_mm > from_mm).map(|(_, value)| *value)
}

/// The figures of a run, collected step by step.
#[derive(Debug, Clone, Default)]
pub struct RunFigures {
    /// x (true if known, else estimated) and the estimate's error.
    steps: ByDepth<(Option<f64>, Option<TipError>)>,
    /// Estimated x, mm, at steps with an estimate.
    estimated: ByDepth<f64>,
    /// Estimated curvature, per mm, at the last step whose estimate has one.
    curvature_per_mm: Option<f64>,
    saturated: usize,
    /// The figures that are updated at every record; [`report`](Self::report) adds those that need all steps.
    so_far: FigureReport,
    /// Acquisition time of the newest accepted position.
    tip_seen: Option<Time>,
    /// Times and depths of the stage, from the last one before `tip_seen`.
    path: VecDeque<(Time, f64)>,
}

/// Updates `greatest`, the largest magnitude so far, with `value`.
fn update_max(greatest: &mut Option<f64>, value: f64) {
    if value.is_finite() {
        *greatest = Some(greatest.unwrap_or(0.0).max(value.abs()));
    }
}

/// The figures of a run as written into its manifest; unknown ones are null.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct FigureReport {
    /// Measured depth at the end, mm.
    pub insertion_mm: f64,
    /// Steps taken.
    pub steps: usize,
    /// Steps at which the controller asked for more than its limits allow.
    pub steps_saturated: Option<usize>,
    /// RMS distance from the plane over the last third of the depth, mm: the true one if known,
    /// else the estimated one.
    pub off_plane_rms_mm: Option<f64>,
    /// Depth after which the distance from the plane stays within 1 mm.
    pub settling_mm: Option<f64>,
    /// RMS of the estimate's errors over the last third, if the truth is known.
    pub estimate_rms: Option<TipError>,
    /// The estimate's error at the last step, if the truth is known.
    pub final_error: Option<TipError>,
    /// The largest difference between target and position of the insertion axis at a SYNC, mm, including
    /// the stop.
    pub following_error_mm_max: Option<f64>,
    /// The same for the rotation axis, deg.
    pub following_error_deg_max: Option<f64>,
    /// The largest age of a position that a step took, s.
    pub tip_age_s_max: Option<f64>,
    /// The largest depth inserted since a position that a step took was acquired, mm.
    pub tip_lag_mm_max: Option<f64>,
    /// The largest age of the newest accepted position at a SYNC, s, including holds and the stop.
    pub blind_s_max: Option<f64>,
    /// The largest depth inserted since the newest accepted position was acquired, mm.
    pub blind_mm_max: Option<f64>,
    /// True distance of the tip from the target at the last step, mm; if the truth is known.
    pub target_error_mm: Option<f64>,
    /// Estimated distance of the tip from the target at the last step, mm.
    pub target_error_est_mm: Option<f64>,
    /// The least distance of the tip from an obstacle, mm, as estimated; null without obstacles.
    pub clearance_mm_min: Option<f64>,
}

/// How a run to a target ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Display, Serialize)]
#[display(rename_all = "snake_case")]
#[serde(rename_all = "snake_case")]
pub enum PlanStatus {
    /// The run completed, and the estimated tip is within the tolerance.
    Arrived,
    /// The run completed, but the estimated tip is not within the tolerance.
    Missed,
    /// The run was stopped before its end.
    Lost,
}

impl FigureReport {
    /// Distance of the tip from the target at the last step, mm: the true one if known, else the
    /// estimated one; `None` without a target.
    pub fn target_error(&self) -> Option<f64> {
        self.target_error_mm.or(self.target_error_est_mm)
    }

    /// How the run to a target ended, by the estimate; `None` if it completed without one.
    pub fn plan_status(&self, is_completed: bool, tolerance_mm: f64) -> Option<PlanStatus> {
        match (is_completed, self.target_error_est_mm) {
            (false, _) => Some(PlanStatus::Lost),
            (true, None) => None,
            (true, Some(error_mm)) if error_mm <= tolerance_mm => Some(PlanStatus::Arrived),
            (true, Some(_)) => Some(PlanStatus::Missed),
        }
    }
}

impl RunFigures {
    /// Adds one step.
    pub fn take_step(&mut self, step: &StepRecord, truth: Option<&Truth>) {
        let x_est_mm = step.decision.estimate.as_ref().map(|estimate| estimate.x_pb.translation.x);
        self.estimated.extend(x_est_mm.map(|x_mm| (step.insertion_meas_mm, x_mm)));
        let belief = step.decision.estimate.as_ref().and_then(|estimate| estimate.belief);
        self.curvature_per_mm =
            belief.map(|belief| belief.curvature_per_mm).or(self.curvature_per_mm);
        let x_mm = truth.map(|truth| truth.x_pb.translation.x).or(x_est_mm);
        let error = truth.and_then(|truth| TipError::of(step, truth));
        self.take_scored(step.insertion_meas_mm, x_mm, error);
        self.saturated += usize::from(step.decision.command_saturated);
        if let Some(age_s) = step.tip_meas_age_s {
            update_max(&mut self.so_far.tip_age_s_max, age_s);
        }
        if let Some(approach) = &step.decision.approach {
            let true_mm = |truth: &Truth| {
                let target_mm = truth.target_mm.unwrap_or(approach.target_mm);
                (truth.x_pb.translation - target_mm).norm()
            };
            self.so_far.target_error_mm = truth.map(true_mm);
            self.so_far.target_error_est_mm = Some(approach.distance_mm);
            let least_mm = self.so_far.clearance_mm_min.unwrap_or(f64::INFINITY);
            let least_mm = least_mm.min(approach.clearance_mm);
            self.so_far.clearance_mm_min = Some(least_mm).filter(|mm| mm.is_finite());
        }
        if let Some(at_mm) = step.tip_meas_insertion_mm {
            update_max(&mut self.so_far.tip_lag_mm_max, step.insertion_meas_mm - at_mm);
        }
    }

    /// Adds a step from a row of `steps.csv`: its depth, its distance from the plane (true if
    /// known, else estimated), and the estimate's error.
    pub fn take_scored(&mut self, insertion_mm: f64, x_mm: Option<f64>, error: Option<TipError>) {
        self.steps.push((insertion_mm, (x_mm, error)));
        self.so_far.insertion_mm = insertion_mm;
    }

    /// Adds a sample of the tracker.
    pub fn take_sample(&mut self, sample: &SampleRecord) {
        self.tip_seen = self.tip_seen.max(sample.acquisition_time);
    }

    /// Adds the stage's position at a SYNC.
    pub fn take_feedback(&mut self, stage: &Feedback) {
        let figures = &mut self.so_far;
        figures.insertion_mm = stage.measured.insertion_mm;
        if let Some(seen) = self.tip_seen {
            self.path.push_back((stage.time, stage.measured.insertion_mm));
            while self.path.get(1).is_some_and(|(time, _)| *time <= seen) {
                self.path.pop_front();
            }
            update_max(&mut figures.blind_s_max, stage.time.seconds_after(seen).max(0.0));
            let seen_at_mm = self.path.front().map_or(f64::NAN, |(_, depth_mm)| *depth_mm);
            update_max(&mut figures.blind_mm_max, stage.measured.insertion_mm - seen_at_mm);
        }
        let behind_mm = stage.commanded.insertion_mm - stage.measured.insertion_mm;
        update_max(&mut figures.following_error_mm_max, behind_mm);
        let behind_rad = stage.commanded.rotation_rad - stage.measured.rotation_rad;
        update_max(&mut figures.following_error_deg_max, behind_rad.to_degrees());
    }

    /// All figures so far.
    pub fn report(&self) -> FigureReport {
        let steps = || last_third(&self.steps, self.so_far.insertion_mm);
        let errors: Vec<TipError> = steps().filter_map(|(_, error)| error).collect();
        FigureReport {
            steps: self.steps.len(),
            steps_saturated: Some(self.saturated),
            off_plane_rms_mm: rms(steps().filter_map(|(x_mm, _)| x_mm)),
            settling_mm: self.settling_mm(),
            estimate_rms: TipError::by_coordinate(&errors, rms),
            final_error: self.steps.last().and_then(|(_, (_, error))| *error),
            ..self.so_far.clone()
        }
    }

    /// The estimated RMS distance from the plane over the last third of the depth, mm, if it is over 1 mm. `None` if it
    /// is not, without an estimate, or with a target.
    pub fn plane_missed_by_mm(&self) -> Option<f64> {
        if self.so_far.target_error_est_mm.is_some() {
            return None;
        }
        let missed_by_mm = rms(last_third(&self.estimated, self.so_far.insertion_mm));
        missed_by_mm.filter(|rms_mm| *rms_mm > OFF_PLANE_LIMIT_MM)
    }

    /// The needle's curvature, per mm, as estimated at the end; `None` if the observer has no belief.
    pub fn curvature_per_mm(&self) -> Option<f64> {
        self.curvature_per_mm
    }

    /// True if the insertion made steps, but had an estimate at none of them, so that nothing steered it.
    pub fn is_unsteered(&self) -> bool {
        !self.steps.is_empty() && self.estimated.is_empty()
    }

    /// Depth after which the distance from the plane stays within 1 mm; `None` if it does not stay.
    fn settling_mm(&self) -> Option<f64> {
        let is_outside = |x_mm: Option<f64>| x_mm.is_none_or(|x| x.abs() > OFF_PLANE_LIMIT_MM);
        let outside = self.steps.iter().rposition(|(_, (x_mm, _))| is_outside(*x_mm));
        let settled = self.steps.get(outside.map_or(0, |last| last + 1));
        settled.map(|(depth_mm, _)| *depth_mm)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
    use crate::observer::Estimate;
    use crate::session::Decision;
    use crate::stage::SetPoint;
    use crate::tracker::{GateName, Refusal, Sample};
    use nalgebra::Vector3;

    fn step(depth: f64, x: f64) -> StepRecord {
        let x_pb = Pose { translation: Vector3::new(x, 0.0, depth), ..Pose::identity() };
        StepRecord {
            insertion_meas_mm: depth,
            decision: Decision { estimate: Some(Estimate::of_pose(x_pb)), ..Decision::default() },
            ..StepRecord::default()
        }
    }

    #[test]
    fn the_last_third_is_scored_and_settling_is_the_last_entry() {
        let mut figures = RunFigures::default();
        let xs = [5.0, 0.5, 2.0, 0.9, 0.3, 0.3, 0.3, 0.4, 0.4, 0.4];
        for (n, x) in xs.into_iter().enumerate() {
            figures.take_step(&step(n as f64, x), None);
        }
        assert_eq!(figures.report().settling_mm, Some(3.0));
        assert!((figures.report().off_plane_rms_mm.unwrap() - 0.4).abs() < 1e-12);
        assert_eq!(figures.report().estimate_rms, None);
        assert_eq!(figures.plane_missed_by_mm(), None);
        figures.take_step(&step(10.0, 3.0), None);
        assert_eq!(figures.report().settling_mm, None);
    }

    /// The true tip is in the plane, the estimated one is not: a live run has only the estimate.
    #[test]
    fn the_miss_of_the_plane_is_that_of_the_estimate() {
        let mut figures = RunFigures::default();
        assert_eq!(figures.plane_missed_by_mm(), None);
        for n in 0..10 {
            figures.take_step(
                &step(f64::from(n), 2.5),
                Some(&Truth { x_pb: Pose::identity(), target_mm: None }),
            );
        }
        assert_eq!(figures.plane_missed_by_mm(), Some(2.5));
        assert_eq!(figures.report().off_plane_rms_mm, Some(0.0));
    }

    #[test]
    fn the_report_has_the_worst_of_each_figure_and_is_read_back() {
        let mut figures = RunFigures::default();
        let late = |age_s, at_mm| StepRecord {
            tip_meas_age_s: Some(age_s),
            tip_meas_insertion_mm: Some(at_mm),
            ..step(10.0, 0.1)
        };
        figures.take_step(&late(0.3, 9.5), None);
        figures.take_step(&late(0.1, 9.75), None);
        for (insertion_cmd_mm, rotation_cmd_rad) in [(9.5, 0.0), (10.25, -0.5), (f64::NAN, 0.0)] {
            figures.take_feedback(&Feedback {
                time: Time::ZERO,
                sync: 1,
                measured: SetPoint { insertion_mm: 10.0, rotation_rad: 0.0 },
                commanded: SetPoint {
                    insertion_mm: insertion_cmd_mm,
                    rotation_rad: rotation_cmd_rad,
                },
            });
        }
        let report = figures.report();
        assert_eq!(report.following_error_mm_max, Some(0.5));
        assert_eq!(report.following_error_deg_max, Some(0.5f64.to_degrees()));
        assert_eq!((report.tip_age_s_max, report.tip_lag_mm_max), (Some(0.3), Some(0.5)));
        let text = serde_json::to_string(&report).unwrap();
        assert_eq!(serde_json::from_str::<FigureReport>(&text).unwrap(), report);
    }

    /// At 1 mm/s, a position is accepted each 0.1 s until 1 s, and refused afterwards. The hold that stops the run at
    /// 1.4 s has no step, but it counts.
    #[test]
    fn depth_inserted_blind_counts_between_the_steps() {
        let mut figures = RunFigures::default();
        for n in 0..=14 {
            let time = Time::from_secs_f64(0.1 * f64::from(n));
            figures.take_sample(&SampleRecord {
                received: Sample { receive_time: time, ..Sample::valid("Tip", Vector3::zeros()) },
                position_plane_mm: None,
                acquisition_time: (n <= 10).then_some(time),
                refused: (n > 10).then(|| Refusal::new(GateName::Zero, "not seen")),
            });
            figures.take_feedback(&Feedback {
                time,
                sync: 1,
                measured: SetPoint { insertion_mm: 0.1 * f64::from(n), rotation_rad: 0.0 },
                commanded: SetPoint { insertion_mm: 0.0, rotation_rad: 0.0 },
            });
        }
        let FigureReport { blind_s_max, blind_mm_max, tip_age_s_max, .. } = figures.report();
        assert!((blind_s_max.unwrap() - 0.4).abs() < 1e-9, "{blind_s_max:?}");
        assert!((blind_mm_max.unwrap() - 0.4).abs() < 1e-9, "{blind_mm_max:?}");
        assert_eq!(tip_age_s_max, None);
    }

    #[test]
    fn errors_are_estimate_minus_truth() {
        let truth = Truth {
            x_pb: Pose { translation: Vector3::new(1.0, 0.0, 2.0), ..Pose::identity() },
            target_mm: None,
        };
        let error = TipError::of(&step(2.0, 1.5), &truth).unwrap();
        assert_eq!((error.x_mm, error.z_mm, error.roll_deg), (0.5, 0.0, 0.0));
    }
}
