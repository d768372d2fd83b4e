//! The state of an insertion: which step is next, and where the set-point is.

use super::config::{InsertionConfig, InsertionMode, Samples};
use super::estimation::Measurement;
use super::profile::Profile;
use crate::needle::TipPosition;
use crate::stage::SetPoint;
use crate::units::Time;
use nalgebra::Vector3;
use std::time::Duration;

/// A step is due when the measured depth is within this distance of its depth, mm: encoder counts are discrete.
const DUE_TOLERANCE_MM: f64 = 1e-3;
/// Time after the last set-point from which a position within `insertion.arrival_mm` counts as arrived.
const ARRIVAL_PATIENCE: Duration = Duration::from_millis(300);
/// Time after the last set-point by which an axis must be within its arrival tolerance.
pub(crate) const ARRIVAL_TIMEOUT: Duration = Duration::from_secs(2);

/// The phase of a step of a stepwise insertion.
#[derive(Debug, Clone)]
enum StepPhase {
    Moving,
    Settling { since: Time },
    Sampling { from: Time, sum_mm: Vector3<f64>, count: u32 },
}

/// The state of an insertion. Depth and rotation count from where it started: measured ones from the
/// position measured there, set-points from the target held there. The two origins differ by the drive's
/// position error at rest, so that neither value jumps when the insertion begins.
#[derive(Debug, Clone)]
pub(crate) struct Insertion {
    config: InsertionConfig,
    origin_meas: SetPoint,
    origin_cmd: SetPoint,
    /// The commanded depth. A hold brakes it, and the rotation stops with it.
    pub(super) profile: Profile,
    /// Set-point at which the present rotation rate was commanded.
    anchor: SetPoint,
    rotation_cmd_rad_per_mm: f64,
    next_step: u32,
    last_step: u32,
    /// The configured depth. A target may end the insertion sooner, never deeper.
    depth_max_mm: f64,
    step_phase: StepPhase,
    /// How long the samples of the last step took; zero before that is known.
    sampling: Duration,
    /// The newest position, which the next step uses.
    newest: Option<Measurement>,
    /// The tip was seen since the insertion began.
    is_seen: bool,
    /// The time since which the set-points have stood at their end while the needle has not settled there.
    unsettled_since: Option<Time>,
    /// The time since which the needle has been within its tolerance of that end without a break.
    in_tolerance_since: Option<Time>,
}

/// A step that is due, with the measurement that it uses.
#[derive(Debug, Clone, Copy)]
pub(crate) struct DueStep {
    pub(crate) step: u32,
    pub(crate) measurement: Option<Measurement>,
    pub(crate) is_last: bool,
}

impl Insertion {
    /// An insertion that starts at the stage's `measured` position, where the stage is `held` at its target.
    pub(crate) fn new(config: InsertionConfig, measured: SetPoint, held: SetPoint) -> Self {
        Insertion {
            config,
            origin_meas: measured,
            origin_cmd: held,
            profile: Profile::new(config.speed_mm_per_s, config.acceleration_mm_per_s2),
            anchor: SetPoint { insertion_mm: 0.0, rotation_rad: 0.0 },
            rotation_cmd_rad_per_mm: 0.0,
            next_step: 0,
            last_step: last_step(&config),
            depth_max_mm: config.depth_mm,
            step_phase: StepPhase::Moving,
            sampling: Duration::ZERO,
            newest: None,
            is_seen: false,
            unsettled_since: None,
            in_tolerance_since: None,
        }
    }

    /// The stage's measured position, counted from where the insertion began.
    pub(crate) fn measured(&self, at: SetPoint) -> SetPoint {
        at - self.origin_meas
    }

    /// The stage's target, counted from where the insertion began.
    pub(crate) fn commanded(&self, at: SetPoint) -> SetPoint {
        at - self.origin_cmd
    }

    /// The deepest measured position of the stage that is believed while its target is `commanded`, mm.
    pub(crate) fn deepest_stage_mm(&self, commanded: SetPoint) -> f64 {
        let depth_mm = self.commanded(commanded).insertion_mm + self.config.arrival_mm;
        self.origin_meas.insertion_mm + depth_mm
    }

    /// Depth of step `step`, mm.
    fn step_depth_mm(&self, step: u32) -> f64 {
        (f64::from(step) * self.config.step_mm).min(self.config.depth_mm)
    }

    /// Takes a measurement that is paired with the stage's depth. Returns it if it must correct the observers
    /// at once.
    pub(crate) fn take_measurement(&mut self, measurement: Measurement) -> Option<Measurement> {
        self.is_seen = true;
        match (self.config.mode, &mut self.step_phase) {
            (InsertionMode::Continuous, _) if self.config.corrected_by == Samples::All => {
                return Some(measurement);
            }
            (InsertionMode::Continuous, _) => {
                if self.newest.is_none_or(|n| n.acquisition_time < measurement.acquisition_time) {
                    self.newest = Some(measurement);
                }
            }
            (InsertionMode::Stepwise, StepPhase::Sampling { from, sum_mm, count })
                if measurement.acquisition_time >= *from && *count < self.config.samples =>
            {
                *sum_mm += measurement.tip_meas.mm();
                *count += 1;
                self.newest = Some(measurement);
            }
            (InsertionMode::Stepwise, _) => {}
        }
        None
    }

    /// Depth that remains to be commanded, mm.
    pub(crate) fn remaining_mm(&self) -> f64 {
        self.config.depth_mm - self.profile.position_mm()
    }

    /// Inserts at this speed from now on, mm/s.
    ///
    /// # Errors
    /// If the speed is not within the limits. The configured speed is the highest, because the other settings
    /// were checked against it.
    pub(crate) fn set_speed(&mut self, speed_mm_per_s: f64) -> Result<(), String> {
        let max = self.config.speed_mm_per_s;
        if !(speed_mm_per_s > 0.0 && speed_mm_per_s <= max) {
            return Err(format!("allowed: over 0 and up to {max} mm/s (insertion.speed_mm_per_s)"));
        }
        self.profile.speed_max_mm_per_s = speed_mm_per_s;
        Ok(())
    }

    /// Remaining time at this speed, s. A stepwise insertion stands at each step, to settle and to take samples,
    /// and speeds up and brakes between two steps. The samples are assumed to take as long as those of the last
    /// step.
    pub(crate) fn remaining_s(&self) -> f64 {
        if self.config.mode == InsertionMode::Continuous {
            return self.remaining_mm() / self.profile.speed_max_mm_per_s;
        }
        let motions = f64::from(self.last_step.saturating_sub(self.next_step));
        let step_mm = self.step_depth_mm(self.next_step) - self.profile.position_mm();
        let motion_mm = (self.remaining_mm() - step_mm) / motions.max(1.0);
        let stops = f64::from((self.last_step + 1).saturating_sub(self.next_step));
        self.profile.motion_s(step_mm)
            + motions * self.profile.motion_s(motion_mm)
            + stops * (self.config.settle + self.sampling).as_secs_f64()
    }

    /// True when the needle stands where a hold has brought its set-points to rest.
    pub(crate) fn is_standing(&self, insertion_meas_mm: f64) -> bool {
        self.profile.is_at_rest() && self.off_mm(insertion_meas_mm) <= self.config.arrival_mm
    }

    /// True if the set-points have come to rest and the axis has had time to follow, in a hold that lasts for `held`.
    pub(crate) fn must_stand(&self, held: Duration) -> bool {
        self.profile.is_at_rest() && held >= ARRIVAL_TIMEOUT
    }

    /// How far the needle is off its set-point, in words; `None` if it stands there or its set-points still move.
    pub(crate) fn explain_miss(&self, insertion_meas_mm: f64) -> Option<String> {
        let is_off = self.profile.is_at_rest() && !self.is_standing(insertion_meas_mm);
        is_off.then(|| {
            let (off_mm, limit_mm) = (self.off_mm(insertion_meas_mm), self.config.arrival_mm);
            format!("the needle is {off_mm:.3} mm off its set-point (limit {limit_mm:.3}, insertion.arrival_mm)")
        })
    }

    fn off_mm(&self, insertion_meas_mm: f64) -> f64 {
        (self.profile.position_mm() - insertion_meas_mm).abs()
    }

    /// Checks that the needle arrives where its set-points end; otherwise the run would wait there forever. An error
    /// is the reason to stop the run.
    pub(crate) fn check_arrival(
        &mut self,
        time: Time,
        insertion_meas_mm: f64,
    ) -> Result<(), String> {
        let goal_mm = self.profile.goal_mm();
        let (tolerance_mm, settle) = match self.config.mode {
            // Step 0 needs the axis only near to where the insertion began.
            InsertionMode::Continuous if self.next_step == 0 => {
                (self.config.arrival_mm, Duration::ZERO)
            }
            InsertionMode::Continuous => (DUE_TOLERANCE_MM, Duration::ZERO),
            InsertionMode::Stepwise => (self.config.arrival_mm, self.config.settle),
        };
        let off_mm = (goal_mm - insertion_meas_mm).abs();
        let is_in_tolerance = off_mm <= tolerance_mm;
        self.in_tolerance_since = is_in_tolerance.then(|| self.in_tolerance_since.unwrap_or(time));
        // An axis that hunts about its target crosses it again and again, and does not arrive.
        let has_settled = self.in_tolerance_since.is_some_and(|since| time.since(since) >= settle);
        if self.profile.position_mm() < goal_mm || has_settled {
            self.unsettled_since = None;
            return Ok(());
        }
        let waited = time.since(*self.unsettled_since.get_or_insert(time));
        if is_in_tolerance || waited < ARRIVAL_TIMEOUT + settle {
            return Ok(());
        }
        Err(format!(
            "insertion: stands at {insertion_meas_mm:.4} mm, {off_mm:.4} mm from the {goal_mm:.3} \
             mm commanded (limit {:.3}), for {:.1} s; does the drive hold its target?",
            self.config.arrival_mm,
            waited.as_secs_f64()
        ))
    }

    /// Takes the step that is due at the measured depth, if one is due.
    pub(crate) fn take_due_step(&mut self, time: Time, insertion_meas_mm: f64) -> Option<DueStep> {
        let goal_mm = self.step_depth_mm(self.next_step);
        let measurement = match self.config.mode {
            InsertionMode::Continuous => {
                let is_due = match self.next_step {
                    // Step 0 is due at rest, once there is a measurement.
                    0 => self.is_seen && self.off_mm(insertion_meas_mm) <= self.config.arrival_mm,
                    // A depth beyond the set-point may be a wrong reading: it makes no step due.
                    _ => {
                        let depth_mm = insertion_meas_mm.min(self.profile.position_mm());
                        depth_mm >= goal_mm - DUE_TOLERANCE_MM
                            || self.has_nearly_arrived(time, insertion_meas_mm)
                    }
                };
                if !is_due {
                    return None;
                }
                self.newest.take()
            }
            InsertionMode::Stepwise => {
                Some(self.take_settled_sample(time, insertion_meas_mm, goal_mm)?)
            }
        };
        let step = self.next_step;
        self.next_step += 1;
        Some(DueStep { step, measurement, is_last: step >= self.last_step })
    }

    /// A measured depth of the stage, counted from where the insertion began, mm.
    pub(crate) fn depth_mm(&self, stage_insertion_meas_mm: f64) -> f64 {
        stage_insertion_meas_mm - self.origin_meas.insertion_mm
    }

    /// True when the set-points ended a while ago and the needle stands within `insertion.arrival_mm` of
    /// their end: a real drive may hold its target a few counts off.
    fn has_nearly_arrived(&self, time: Time, insertion_meas_mm: f64) -> bool {
        (self.profile.goal_mm() - insertion_meas_mm).abs() <= self.config.arrival_mm
            && self.unsettled_since.is_some_and(|since| time.since(since) >= ARRIVAL_PATIENCE)
    }

    /// The mean of the step's samples, once the needle has settled and the samples are complete.
    fn take_settled_sample(
        &mut self,
        time: Time,
        insertion_meas_mm: f64,
        goal_mm: f64,
    ) -> Option<Measurement> {
        let standing = self.profile.position_mm() == goal_mm
            && (insertion_meas_mm - goal_mm).abs() <= self.config.arrival_mm;
        match self.step_phase.clone() {
            // The needle has moved, so the samples are from different places.
            StepPhase::Settling { .. } | StepPhase::Sampling { .. } if !standing => {
                self.step_phase = StepPhase::Moving;
            }
            StepPhase::Moving if standing => self.step_phase = StepPhase::Settling { since: time },
            StepPhase::Settling { since } if time.since(since) >= self.config.settle => {
                self.step_phase =
                    StepPhase::Sampling { from: time, sum_mm: Vector3::zeros(), count: 0 };
            }
            StepPhase::Sampling { from, sum_mm, count } if count >= self.config.samples => {
                let newest = self.newest.take()?;
                let tip_meas = TipPosition::new(sum_mm / f64::from(count))?;
                self.step_phase = StepPhase::Moving;
                self.sampling = time.since(from);
                return Some(Measurement { tip_meas, positions: count, ..newest });
            }
            _ => {}
        }
        None
    }

    /// Sets the depth at which the insertion ends to `depth_mm`, or to the nearest depth at which the needle
    /// can still be stopped. Returns that depth, mm.
    pub(crate) fn end_at(&mut self, depth_mm: f64) -> f64 {
        self.config.depth_mm =
            depth_mm.max(self.profile.stopping_depth_mm()).min(self.depth_max_mm);
        self.last_step = last_step(&self.config);
        self.config.depth_mm
    }

    /// Ends the insertion where braking from now on ends, with no step before that depth. Returns it, mm.
    pub(crate) fn end_now(&mut self) -> f64 {
        let depth_mm = self.end_at(0.0);
        self.next_step = self.next_step.max(self.last_step);
        self.steer(0.0);
        depth_mm
    }

    /// Sets the rotation rate from the present set-point on, and lets the needle move on to the
    /// next step, or to the full depth.
    pub(crate) fn steer(&mut self, rotation_rad_per_mm: f64) {
        self.anchor = self.set_point();
        self.rotation_cmd_rad_per_mm = rotation_rad_per_mm;
        self.profile.go_to(match self.config.mode {
            InsertionMode::Continuous => self.config.depth_mm,
            InsertionMode::Stepwise => self.step_depth_mm(self.next_step),
        });
    }

    /// The present set-point: rotation is locked to depth.
    fn set_point(&self) -> SetPoint {
        let insertion_mm = self.profile.position_mm();
        let turned_rad = self.rotation_cmd_rad_per_mm * (insertion_mm - self.anchor.insertion_mm);
        SetPoint { insertion_mm, rotation_rad: self.anchor.rotation_rad + turned_rad }
    }

    /// The set-point for the next SYNC, in the stage's own coordinates.
    pub(crate) fn advance(&mut self, sync_period: Duration) -> SetPoint {
        self.profile.advance(sync_period);
        self.origin_cmd + self.set_point()
    }
}

/// The number of the last step, which may be shorter than the others.
fn last_step(config: &InsertionConfig) -> u32 {
    (config.depth_mm / config.step_mm - 1e-9).ceil() as u32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    #[test]
    fn a_needle_stands_within_its_tolerance_of_the_set_point() {
        let config = Config::from_sources(&[], &[]).unwrap().session().unwrap().insertion;
        let at = SetPoint { insertion_mm: 0.0, rotation_rad: 0.0 };
        let insertion = Insertion::new(config, at, at);
        assert!(insertion.is_standing(0.04) && insertion.explain_miss(0.04).is_none());
        for off_mm in [0.06, f64::NAN] {
            assert!(!insertion.is_standing(off_mm), "{off_mm}");
            let miss = insertion.explain_miss(off_mm).expect("words");
            assert!(miss.ends_with("(limit 0.050, insertion.arrival_mm)"), "{miss}");
        }
    }

    /// From 5 mm/s the needle brakes over 1.25 mm, with a step of 1 mm on the way; a step there would plan again.
    #[test]
    fn an_insertion_that_ends_early_has_one_step_more_where_it_stands() {
        let sets = ["insertion.speed_mm_per_s=5".to_owned()];
        let config = Config::from_sources(&[], &sets).unwrap().session().unwrap().insertion;
        let at = SetPoint { insertion_mm: 0.0, rotation_rad: 0.0 };
        let mut insertion = Insertion::new(config, at, at);
        insertion.is_seen = true;
        let period = Duration::from_millis(10);
        let (mut ends_mm, mut last_mm) = (None, Vec::new());
        for k in 0..2000_u32 {
            let depth_mm = insertion.profile.position_mm();
            if let Some(due) = insertion.take_due_step(Time::ZERO + period * k, depth_mm) {
                match ends_mm {
                    Some(_) => last_mm.push((due.is_last, depth_mm)),
                    None if due.step == 20 => ends_mm = Some(insertion.end_now()),
                    None => insertion.steer(0.0),
                }
            }
            insertion.advance(period);
        }
        let ends_mm = ends_mm.expect("step 20");
        assert!((21.2..21.3).contains(&ends_mm), "{ends_mm}");
        assert!(matches!(last_mm[0], (true, mm) if (mm - ends_mm).abs() < 2e-3), "{last_mm:?}");
    }

    /// At 1 mm a step the needle stands for longer than it moves at full speed.
    #[test]
    fn the_time_to_go_of_a_stepwise_insertion_counts_its_standstills() {
        let sets =
            ["insertion.mode=\"stepwise\"", "insertion.depth_mm=20.5", "insertion.samples=10"];
        let config = Config::from_sources(&[], &sets.map(str::to_owned)).unwrap();
        let config = config.session().unwrap().insertion;
        let at = SetPoint { insertion_mm: 0.0, rotation_rad: 0.0 };
        let mut insertion = Insertion::new(config, at, at);
        let period = Duration::from_millis(10);
        let mut promised = Vec::new();
        let taken_s = (0_u32..).find_map(|k| {
            let time = Time::ZERO + period * k;
            let depth_mm = insertion.profile.position_mm();
            if k % 3 == 0 {
                insertion.take_measurement(Measurement {
                    acquisition_time: time,
                    stage_insertion_meas_mm: depth_mm,
                    tip_meas: TipPosition::new(Vector3::zeros()).unwrap(),
                    positions: 1,
                });
            }
            let due = insertion.take_due_step(time, depth_mm);
            if due.is_some_and(|due| due.is_last) {
                return Some(time.as_secs_f64());
            }
            if due.is_some() {
                insertion.steer(0.0);
                promised.push(time.as_secs_f64() + insertion.remaining_s());
            }
            insertion.advance(period);
            None
        });
        let taken_s = taken_s.expect("the last step");
        assert_eq!(promised.len(), 21);
        let is_kept = |end_s: &f64| (end_s - taken_s).abs() < 0.05 * taken_s;
        assert!(promised.iter().all(is_kept), "{taken_s} s: {promised:?}");
    }

    /// Depths at every other SYNC: at the end of the step, and away from it.
    #[test]
    fn a_stepwise_needle_that_hunts_about_its_target_is_given_up() {
        let sets = ["insertion.mode=\"stepwise\""].map(str::to_owned);
        let config = Config::from_sources(&[], &sets).unwrap().session().unwrap().insertion;
        let at = SetPoint { insertion_mm: 0.0, rotation_rad: 0.0 };
        let mut insertion = Insertion::new(config, at, at);
        insertion.profile.go_to(1.0);
        let period = Duration::from_millis(10);
        while insertion.profile.position_mm() < 1.0 {
            insertion.advance(period);
        }
        let given_up = |off_mm: f64, insertion: &mut Insertion| {
            (0..600_u32).find(|&k| {
                let time = Time::ZERO + period * k;
                let depth_mm = 1.0 + off_mm * f64::from(k % 2);
                insertion.check_arrival(time, depth_mm).is_err()
            })
        };
        assert_eq!(given_up(0.04, &mut insertion.clone()), None);
        let limit = ARRIVAL_TIMEOUT + insertion.config.settle;
        let syncs = given_up(0.3, &mut insertion).expect("it hunts");
        assert!((limit..limit + 2 * period).contains(&(period * syncs)), "after {syncs} SYNCs");
    }
}
