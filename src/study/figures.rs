//! The figures of one run.

use super::statistics::rms;
use crate::emulator::Truth;
use crate::geometry::FixedAngles;
use crate::session::{StageRecord, StepRecord};
use crate::units::wrap_angle;
use serde::Serialize;

/// Estimated minus true tip: mm and degrees.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
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
    /// The error of a step's estimate; `None` without one.
    pub fn of(step: &StepRecord, truth: &Truth) -> Option<Self> {
        let estimate = step.estimate.as_ref()?;
        let position = estimate.x_pb.translation - truth.x_pb().translation;
        let (ours, theirs) =
            (estimate.angles(), FixedAngles::from_rotation(&truth.x_pb().rotation));
        Some(TipError {
            x_mm: position.x,
            y_mm: position.y,
            z_mm: position.z,
            yaw_deg: wrap_angle(ours.yaw - theirs.yaw).to_degrees(),
            pitch_deg: wrap_angle(ours.pitch - theirs.pitch).to_degrees(),
            roll_deg: wrap_angle(ours.roll - theirs.roll).to_degrees(),
        })
    }

    fn rms(errors: &[TipError]) -> Option<TipError> {
        TipError::by_coordinate(|i| rms(errors.iter().map(|error| error.coordinates()[i])))
    }

    /// x, y, z in mm and yaw, pitch, roll in deg.
    pub fn coordinates(&self) -> [f64; 6] {
        [self.x_mm, self.y_mm, self.z_mm, self.yaw_deg, self.pitch_deg, self.roll_deg]
    }

    /// What `of` says of each coordinate, numbered as [`TipError::coordinates`] lists them; `None`
    /// where it says nothing of one.
    pub fn by_coordinate(of: impl Fn(usize) -> Option<f64>) -> Option<Self> {
        Some(TipError {
            x_mm: of(0)?,
            y_mm: of(1)?,
            z_mm: of(2)?,
            yaw_deg: of(3)?,
            pitch_deg: of(4)?,
            roll_deg: of(5)?,
        })
    }
}

/// What a run comes to, gathered step by step.
#[derive(Debug, Clone, Default)]
pub struct RunFigures {
    /// Depth, x (true where known, else estimated), error.
    steps: Vec<(f64, Option<f64>, Option<TipError>)>,
    saturated: usize,
    /// Measured depth of the stage, mm.
    insertion_mm: f64,
}

impl RunFigures {
    /// Takes one step.
    pub fn take(&mut self, step: &StepRecord, truth: Option<&Truth>) {
        let x_est_mm = step.estimate.as_ref().map(|estimate| estimate.x_pb.translation.x);
        let x_mm = truth.map(|truth| truth.x_pb().translation.x).or(x_est_mm);
        let error = truth.and_then(|truth| TipError::of(step, truth));
        self.steps.push((step.insertion_meas_mm, x_mm, error));
        self.saturated += usize::from(step.command_saturated);
        self.insertion_mm = step.insertion_meas_mm;
    }

    /// Takes the stage's position at a SYNC.
    pub fn follow(&mut self, stage: &StageRecord) {
        self.insertion_mm = stage.insertion_meas_mm;
    }

    /// Measured depth at the end, mm, between the steps as well.
    pub fn insertion_mm(&self) -> f64 {
        self.insertion_mm
    }

    /// Steps taken.
    pub fn steps(&self) -> usize {
        self.steps.len()
    }

    /// Steps at which the controller asked for more than its limits let through.
    pub fn saturated(&self) -> usize {
        self.saturated
    }

    fn last_third(&self) -> impl Iterator<Item = &(f64, Option<f64>, Option<TipError>)> {
        let from_mm = self.insertion_mm() * 2.0 / 3.0;
        self.steps.iter().filter(move |&&(depth, ..)| depth > from_mm)
    }

    /// RMS distance from the plane over the last third of the depth, mm.
    pub fn off_plane_rms_mm(&self) -> Option<f64> {
        rms(self.last_third().filter_map(|&(_, x_mm, _)| x_mm))
    }

    /// Depth after which the distance from the plane stays within 1 mm; `None` where it does not.
    pub fn settling_mm(&self) -> Option<f64> {
        let outside = self.steps.iter().rposition(|&(_, x, _)| x.is_none_or(|x| x.abs() > 1.0));
        match outside {
            None => self.steps.first().map(|&(depth, ..)| depth),
            Some(last) => self.steps.get(last + 1).map(|&(depth, ..)| depth),
        }
    }

    /// RMS of the estimate's errors over the last third; `None` without truth.
    pub fn estimate_rms(&self) -> Option<TipError> {
        let errors: Vec<TipError> = self.last_third().filter_map(|&(.., error)| error).collect();
        TipError::rms(&errors)
    }

    /// The estimate's error at the last step; `None` without truth.
    pub fn final_error(&self) -> Option<TipError> {
        self.steps.last().and_then(|&(.., error)| error)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
    use crate::observer::Estimate;
    use crate::units::Time;
    use nalgebra::Vector3;

    fn step(depth: f64, x: f64) -> StepRecord {
        let x_pb = Pose { translation: Vector3::new(x, 0.0, depth), ..Pose::identity() };
        StepRecord {
            step: 0,
            time: Time::ZERO,
            insertion_meas_mm: depth,
            rotation_meas_rad: 0.0,
            rotation_cmd_rad_per_mm: None,
            command_saturated: false,
            tip_meas_mm: None,
            tip_meas_insertion_mm: None,
            tip_meas_age_s: None,
            innovation_mm: None,
            estimate: Some(Estimate::of_pose(x_pb)),
            shadows: Vec::new(),
        }
    }

    #[test]
    fn the_last_third_is_scored_and_settling_is_the_last_way_in() {
        let mut figures = RunFigures::default();
        let xs = [5.0, 0.5, 2.0, 0.9, 0.3, 0.3, 0.3, 0.4, 0.4, 0.4];
        for (n, x) in xs.into_iter().enumerate() {
            figures.take(&step(n as f64, x), None);
        }
        assert_eq!(figures.settling_mm(), Some(3.0));
        let expected = ((0.4f64.powi(2) * 3.0) / 3.0).sqrt();
        assert!((figures.off_plane_rms_mm().unwrap() - expected).abs() < 1e-12);
        assert_eq!(figures.estimate_rms(), None);
        figures.take(&step(10.0, 3.0), None);
        assert_eq!(figures.settling_mm(), None);
    }

    #[test]
    fn errors_are_estimate_minus_truth() {
        let truth =
            Truth::new(Pose { translation: Vector3::new(1.0, 0.0, 2.0), ..Pose::identity() });
        let error = TipError::of(&step(2.0, 1.5), &truth).unwrap();
        assert_eq!((error.x_mm, error.z_mm, error.roll_deg), (0.5, 0.0, 0.0));
    }
}
