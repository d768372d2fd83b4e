//! One emulated insertion without drives, bytes or time. A study makes thousands of them.

use super::base_path::BasePath;
use super::timetable::{SampleDue, StepDue, Timetable};
use crate::emulator::{Tissue, Truth, VirtualStageConfig};
use crate::needle::TipPosition;
use crate::observer::ObserverError;
use crate::session::{Decision, Outcome, SessionConfig, Steering, StepRecord};
use crate::stage::{Axis, AxisLimits, LimitError};
use nalgebra::Vector3;
use std::ops::RangeInclusive;

/// Inserts the needle of `stage` as a session with the configuration `session` would, and passes
/// each step with its truth to `take`.
///
/// The tissue, the noise of each position, the observers and the law are those of a whole session,
/// called at the depths of `timetable`. The trial leaves out what does not change their results:
/// the drives (their motion is taken as commanded; in a whole session it differs by at most an
/// encoder count), the bus, the stamps, and the tracker's gates, which refuse one position in a
/// thousand under white noise.
///
/// # Errors
/// [`ObserverError`] if an observer refuses an input.
pub fn insert(
    session: &SessionConfig,
    stage: &VirtualStageConfig,
    timetable: &Timetable,
    mut take: impl FnMut(&StepRecord, &Truth),
) -> Result<Outcome, ObserverError> {
    let mut steering = Steering::new(session)?;
    let mut needle = EmulatedNeedle::new(stage);
    let (mut seen_mm, mut watched_mm) = (0.0, 0.0);
    let interval_s = stage.tracker.interval().as_secs_f64();
    let mut corrected: Option<u64> = None;
    for (step, due) in timetable.steps().iter().enumerate() {
        needle.insert_to(due.insertion_mm);
        let (mut measured, mut innovation_mm, mut tip_positions) = (None, None, 0);
        for sample in &due.samples {
            let SampleDue { numbers, insertion_true_mm, insertion_meas_mm } = sample;
            let Some(tip_meas) = needle.mean(stage, numbers, *insertion_true_mm) else { continue };
            let path = needle.base.between(seen_mm, *insertion_meas_mm);
            path.into_iter().for_each(|increment| steering.predict(increment));
            let positions = count(numbers);
            let last = corrected.replace(*numbers.end());
            let since =
                last.map_or(f64::INFINITY, |last| (numbers.end() - last) as f64 * interval_s);
            let spacing_s = if positions > 1 { interval_s } else { since };
            innovation_mm = steering.correct(&tip_meas, positions, spacing_s);
            seen_mm = seen_mm.max(*insertion_meas_mm);
            tip_positions += positions;
            measured = Some((*insertion_meas_mm, tip_meas));
        }
        if let Some(mean) = due.mean.as_ref().filter(|_| !steering.handedness().is_decided())
            && let Some(tip_meas) = needle.mean(stage, &mean.numbers, mean.insertion_true_mm)
        {
            let watch = steering.handedness();
            let path = needle.base.between(watched_mm, mean.insertion_meas_mm);
            path.into_iter().for_each(|increment| watch.predict(increment));
            watched_mm = watched_mm.max(mean.insertion_meas_mm);
            steering.watch(&tip_meas, count(&mean.numbers), interval_s);
        }
        let is_last = step + 1 == timetable.steps().len();
        let ahead = needle.base.between(seen_mm, due.insertion_mm);
        let decision = steering.decide(&ahead, is_last);
        let command = decision.rotation_cmd_rad_per_mm;
        let refused = decision.refused;
        let path = decision.approach.as_ref().and_then(|approach| approach.path.as_ref());
        let end_mm = path.map(|path| due.insertion_mm + path.length_mm());
        let record = StepRecord {
            tip_positions,
            tip_meas_mm: measured.map(|(_, tip_meas)| tip_meas.mm()),
            tip_meas_insertion_mm: measured.map(|(insertion_meas_mm, _)| insertion_meas_mm),
            innovation_mm,
            ..record(step, due, &needle.base, decision)
        };
        take(&record, &Truth::new(*needle.tissue.tip_true()));
        if let Some(error) = refused {
            return Ok(Outcome::Stopped(error.to_string()));
        }
        if let Some(rate_rad_per_mm) = command {
            needle.base.turn(due.command_mm, rate_rad_per_mm);
            needle.insert_to(due.command_mm);
        }
        let rotation_rad = needle.base.rotation_at(due.command_mm);
        if let Err(error) = within(&session.stage.rotation.limits, rotation_rad) {
            return Ok(Outcome::Stopped(format!("stage: {error}")));
        }
        if command.is_none() {
            break;
        }
        let next_mm = timetable.steps().get(step + 1).map(|next| next.insertion_mm);
        if let Some(end_mm) = end_mm.filter(|end_mm| next_mm.is_some_and(|next| *end_mm < next)) {
            let due = StepDue { insertion_mm: end_mm, command_mm: end_mm, ..StepDue::default() };
            needle.insert_to(end_mm);
            let decision = steering.decide(&needle.base.between(seen_mm, end_mm), true);
            take(
                &self::record(step + 1, &due, &needle.base, decision),
                &Truth::new(*needle.tissue.tip_true()),
            );
            break;
        }
    }
    Ok(Outcome::Completed)
}

fn count(numbers: &RangeInclusive<u64>) -> u32 {
    u32::try_from(numbers.end() - numbers.start() + 1).unwrap_or(u32::MAX)
}

/// The true needle and its base.
struct EmulatedNeedle {
    tissue: Tissue,
    base: BasePath,
}

impl EmulatedNeedle {
    fn new(stage: &VirtualStageConfig) -> Self {
        let tissue = Tissue::new(stage.needle, stage.torsion, stage.start);
        EmulatedNeedle { tissue, base: BasePath::new() }
    }

    fn insert_to(&mut self, insertion_mm: f64) {
        self.tissue.advance(insertion_mm, self.base.rotation_at(insertion_mm));
    }

    /// The mean of the positions with these numbers, as the tracker measures them at this depth, in
    /// the plane frame.
    fn mean(
        &self,
        stage: &VirtualStageConfig,
        numbers: &RangeInclusive<u64>,
        insertion_true_mm: f64,
    ) -> Option<TipPosition> {
        let tip_true = self.tissue.cut_at(insertion_true_mm)?;
        let tracker = &stage.tracker;
        let noise = numbers.clone().map(|number| tracker.noise_mm(number));
        let (count, sum) =
            noise.fold((0u32, Vector3::zeros()), |(count, sum), n| (count + 1, sum + n));
        let noise_mm = stage.x_tp.rotation.inverse() * (sum / f64::from(count));
        TipPosition::new(tip_true.translation + noise_mm)
    }
}

/// The record of a step as a session makes it; a study has no times.
fn record(step: usize, due: &StepDue, base: &BasePath, decision: Decision) -> StepRecord {
    let Decision {
        estimate, shadows, rotation_cmd_rad_per_mm, command_saturated, approach, ..
    } = decision;
    StepRecord {
        step: u32::try_from(step).unwrap_or(u32::MAX),
        insertion_meas_mm: due.insertion_mm,
        rotation_meas_rad: base.rotation_at(due.insertion_mm),
        rotation_cmd_rad_per_mm,
        command_saturated,
        estimate,
        shadows,
        approach,
        ..StepRecord::default()
    }
}

/// The stage's error for a rotation beyond its soft limits.
fn within(limits: &AxisLimits, rotation_rad: f64) -> Result<(), LimitError> {
    let (axis, target) = (Axis::Rotation, rotation_rad);
    if target > limits.max {
        return Err(LimitError::Over { axis, target, max: limits.max });
    }
    if target < limits.min {
        return Err(LimitError::Under { axis, target, min: limits.min });
    }
    Ok(())
}
