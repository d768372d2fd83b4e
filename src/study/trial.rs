//! One emulated insertion without drives, bus or clock. A study makes thousands of them.

use super::base_path::BasePath;
use super::timetable::{SampleDue, Timetable};
use crate::emulator::{TargetModel, Tissue, Truth, VirtualStageConfig};
use crate::needle::TipPosition;
use crate::session::{
    Decision, MovingMean, Outcome, SessionConfig, Steering, StepRecord, TargetTool,
};
use crate::stage::{Axis, AxisConfig};
use crate::units::Time;
use nalgebra::Vector3;

/// Inserts the needle of `stage` as a session with the configuration `session` would, and passes
/// each step with its truth to `take`.
///
/// The tissue, the noise of each position, the observers and the law are those of a whole session,
/// called at the depths of `timetable`. The trial leaves out what does not change their results:
/// the drives (their motion is taken as commanded; in a whole session it differs by at most an
/// encoder count), the bus, the stamps, and the tracker's gates, which refuse one position in a
/// thousand under white noise.
pub fn insert(
    session: &SessionConfig,
    stage: &VirtualStageConfig,
    timetable: &Timetable,
    mut take: impl FnMut(&StepRecord, &Truth),
) -> Outcome {
    let mut steering = Steering::new(session);
    let mut needle = EmulatedNeedle::new(stage);
    let (mut observed_mm, mut watched_mm) = (0.0, 0.0);
    let interval_s = stage.tracker.interval().as_secs_f64();
    let target_tool = session.goal.as_ref().and_then(|goal| goal.tool.as_ref());
    let mut corrected: Option<u64> = None;
    for (step, due) in timetable.steps.iter().enumerate() {
        needle.insert_to(due.insertion_mm);
        let (mut measured, mut innovation_mm, mut tip_positions) = (None, None, 0);
        for sample in &due.samples {
            let Some(tip_meas) = needle.measure(sample) else { continue };
            let path = needle.base.between(observed_mm, sample.insertion_meas_mm);
            path.into_iter().for_each(|increment| steering.predict(increment));
            let (positions, newest) = (sample.positions(), *sample.numbers.end());
            let since = corrected
                .replace(newest)
                .map_or(f64::INFINITY, |last| (newest - last) as f64 * interval_s);
            let spacing_s = if positions > 1 { interval_s } else { since };
            innovation_mm = steering.correct(&tip_meas, positions, spacing_s);
            observed_mm = observed_mm.max(sample.insertion_meas_mm);
            tip_positions += positions;
            measured = Some((sample.insertion_meas_mm, tip_meas));
        }
        if let Some(mean) = due.mean.as_ref().filter(|_| !steering.handedness().is_decided())
            && let Some(tip_meas) = needle.measure(mean)
        {
            let watch = steering.handedness();
            let path = needle.base.between(watched_mm, mean.insertion_meas_mm);
            path.into_iter().for_each(|increment| watch.predict(increment));
            watched_mm = watched_mm.max(mean.insertion_meas_mm);
            steering.correct_handedness(&tip_meas, mean.positions(), interval_s);
        }
        if let Some(tool) = target_tool {
            needle.track_target(tool, &due.samples);
        }
        needle.tracked_target_mm().into_iter().for_each(|target_mm| steering.set_target(target_mm));
        let is_last = step + 1 == timetable.steps.len();
        let ahead = needle.base.between(observed_mm, due.insertion_mm);
        let decision = steering.decide(&ahead, is_last);
        let command = decision.rotation_cmd_rad_per_mm;
        let refused = decision.refused.clone();
        let path = decision.approach.as_ref().and_then(|approach| approach.path.as_ref());
        let end_mm = path.map(|path| due.insertion_mm + path.length_mm());
        let record = StepRecord {
            tip_positions,
            tip_meas_mm: measured.map(|(_, tip_meas)| tip_meas.mm()),
            tip_meas_insertion_mm: measured.map(|(insertion_meas_mm, _)| insertion_meas_mm),
            innovation_mm,
            ..step_record(step, due.insertion_mm, &needle.base, decision)
        };
        take(&record, &needle.truth(due.insertion_mm));
        if let Some(error) = refused {
            // The needle goes on while it brakes, possibly nearer to an obstacle.
            if session.goal.is_some() {
                let stopped_mm = due.insertion_mm + session.insertion.stopping_mm(&session.stage);
                needle.insert_to(stopped_mm);
                let last = step_record(step + 1, stopped_mm, &needle.base, Decision::default());
                take(&last, &needle.truth(stopped_mm));
            }
            return Outcome::Stopped(error.to_string());
        }
        if let Some(rate_rad_per_mm) = command {
            needle.base.set_rate(due.command_mm, rate_rad_per_mm);
            needle.insert_to(due.command_mm);
        }
        let rotation_rad = needle.base.rotation_at(due.command_mm);
        let AxisConfig { limits, quick_stop_deceleration, .. } = &session.stage.rotation;
        let speed = command.unwrap_or(0.0) * session.insertion.speed_mm_per_s;
        let braking_rad =
            quick_stop_deceleration.map_or(0.0, |by| speed * speed.abs() / (2.0 * by));
        if let Err(error) = limits.check_range(Axis::Rotation, rotation_rad + braking_rad) {
            return Outcome::Stopped(format!("stage: {error}"));
        }
        if command.is_none() {
            break;
        }
        let next_mm = timetable.steps.get(step + 1).map(|next| next.insertion_mm);
        if let Some(end_mm) = end_mm.filter(|end_mm| next_mm.is_some_and(|next| *end_mm < next)) {
            needle.insert_to(end_mm);
            let decision = steering.decide(&needle.base.between(observed_mm, end_mm), true);
            let last = step_record(step + 1, end_mm, &needle.base, decision);
            take(&last, &needle.truth(end_mm));
            break;
        }
    }
    Outcome::Completed
}

/// The true needle of `stage` and its base.
struct EmulatedNeedle<'a> {
    stage: &'a VirtualStageConfig,
    tissue: Tissue,
    base: BasePath,
    /// The mean of the target's tracked positions; `None` before the first.
    target: Option<MovingMean>,
}

impl<'a> EmulatedNeedle<'a> {
    fn new(stage: &'a VirtualStageConfig) -> Self {
        let tissue = Tissue::new(stage.needle, stage.torsion, stage.start);
        EmulatedNeedle { stage, tissue, base: BasePath::new(), target: None }
    }

    fn insert_to(&mut self, insertion_mm: f64) {
        self.tissue.advance(insertion_mm, self.base.rotation_at(insertion_mm));
    }

    fn truth(&self, insertion_mm: f64) -> Truth {
        let target_mm = self.stage.target.map(|target| target.position_mm(insertion_mm));
        Truth { x_pb: *self.tissue.tip_true(), target_mm }
    }

    /// Tracks the target at the times of the tip's samples; before the insertion, for as long as its position is
    /// averaged.
    fn track_target(&mut self, tool: &TargetTool, samples: &[SampleDue]) {
        let (Some(target), Some(first)) = (self.stage.target, samples.first()) else { return };
        let model = TargetModel::tracker_model(self.stage.tracker);
        let interval_s = model.interval().as_secs_f64();
        let see = |mean: &mut MovingMean, number: u64, insertion_mm: f64| {
            let noise_mm = self.stage.x_tp.rotation.inverse() * model.noise_mm(number);
            let time = Time::from_secs_f64(number as f64 * interval_s);
            mean.take(time, target.position_mm(insertion_mm) + noise_mm);
        };
        let mean = self.target.get_or_insert_with(|| {
            let mut mean = MovingMean::new(tool.average);
            let before = (tool.average.as_secs_f64() / interval_s) as u64;
            let begun = *first.numbers.start();
            (begun.saturating_sub(before)..begun).for_each(|number| see(&mut mean, number, 0.0));
            mean
        });
        for sample in samples {
            let numbers = sample.numbers.clone();
            numbers.for_each(|number| see(mean, number, sample.insertion_true_mm));
        }
    }

    fn tracked_target_mm(&self) -> Option<Vector3<f64>> {
        self.target.as_ref()?.mean_mm()
    }

    /// The tracker's position, or mean of positions, in the plane frame.
    fn measure(&self, sample: &SampleDue) -> Option<TipPosition> {
        let tip_true = self.tissue.cut_at(sample.insertion_true_mm)?;
        let noise = sample.numbers.clone().map(|number| self.stage.tracker.noise_mm(number));
        let mean_mm = noise.sum::<Vector3<f64>>() / f64::from(sample.positions());
        TipPosition::new(tip_true.translation + self.stage.x_tp.rotation.inverse() * mean_mm)
    }
}

/// The record of a step as a session makes it, without the times, which a study does not have.
fn step_record(step: usize, insertion_mm: f64, base: &BasePath, decision: Decision) -> StepRecord {
    StepRecord {
        step: u32::try_from(step).unwrap_or(u32::MAX),
        insertion_meas_mm: insertion_mm,
        rotation_meas_rad: base.rotation_at(insertion_mm),
        decision,
        ..StepRecord::default()
    }
}
