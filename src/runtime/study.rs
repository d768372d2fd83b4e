//! Runs the trials of a study, on all processors.

use super::virtual_time::{TipSource, run_unwatched};
use crate::emulator::{TrackerModel, Truth, VirtualStage, VirtualStageConfig, WhiteNoise};
use crate::geometry::Pose;
use crate::session::{Goal, Outcome, Record, Session, SessionConfig};
use crate::study::{Prior, Timetable, TrialResult, TrialScorer, insert};
use crate::units::Time;
use nalgebra::Vector3;
use rayon::iter::{IntoParallelRefIterator, ParallelIterator};
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, Ordering};

/// Noise of the insertion that makes the timetable: negligible, but no two positions are equal, since the
/// bench refuses positions that repeat.
const TIMETABLE_NOISE: WhiteNoise = WhiteNoise::Gaussian(1e-6);

/// A Monte Carlo study of insertions.
pub struct Study<'a> {
    /// The configuration of the bench.
    pub session: SessionConfig,
    /// The name of the tracked tip.
    pub tool: &'a str,
    /// The random draws.
    pub prior: Prior,
    /// Draws the emulated stage, needle and tracker of the trial with the given seed.
    pub stage: &'a (dyn Fn(u64) -> Result<VirtualStageConfig, String> + Sync),
    /// Draws the target of the trial with the given seed.
    pub goal: &'a (dyn Fn(u64) -> Result<DrawnGoal, String> + Sync),
}

/// A target with the path to it; `None` for an insertion in the plane; an error with the reason if the target cannot
/// be reached.
pub(super) type DrawnGoal = Result<Option<Goal>, String>;

/// Called after each trial, by several threads.
pub(super) type TrialDone<'a> = &'a (dyn Fn() -> ControlFlow<()> + Sync);

impl Study<'_> {
    /// Runs the trials with these seeds, in parallel, and calls `done` after each. Once that breaks, no trial
    /// begins any more. The results are in the order of the seeds.
    ///
    /// # Errors
    /// The session or the emulator refuses its configuration.
    pub fn run(&self, seeds: &[u64], done: TrialDone<'_>) -> Result<Vec<TrialResult>, String> {
        let Some(&first) = seeds.first() else { return Ok(Vec::new()) };
        self.trials(seeds, &self.timetable(first)?, done)
    }

    /// As [`Study::run`], with a timetable that was made before.
    ///
    /// # Errors
    /// As [`Study::run`].
    pub fn trials(
        &self,
        seeds: &[u64],
        timetable: &Timetable,
        done: TrialDone<'_>,
    ) -> Result<Vec<TrialResult>, String> {
        self.run_trials(seeds, done, |session, stage, score| {
            let take = |step: &_, truth: &_| score.take(step, truth);
            insert(&session, &stage, timetable, take)
        })
    }

    /// As [`Study::run`], but through whole sessions, with drives and CAN frames: three times slower if every
    /// position counts.
    ///
    /// # Errors
    /// As [`Study::run`].
    pub fn run_through_sessions(
        &self,
        seeds: &[u64],
        done: TrialDone<'_>,
    ) -> Result<Vec<TrialResult>, String> {
        self.run_trials(seeds, done, |session, stage, score| {
            self.whole_session(session, stage, |record, truth| {
                if let (Record::Step(step), Some(truth)) = (record, truth) {
                    score.take(&step, &truth);
                }
            })
        })
    }

    /// Runs the trials with these seeds, each by `insert` unless its target is out of reach.
    fn run_trials(
        &self,
        seeds: &[u64],
        done: TrialDone<'_>,
        insert: impl Fn(SessionConfig, VirtualStageConfig, &mut TrialScorer) -> Outcome + Sync,
    ) -> Result<Vec<TrialResult>, String> {
        let is_over = AtomicBool::new(false);
        let trial = |&seed: &u64| {
            if is_over.load(Ordering::Relaxed) {
                return Ok(None);
            }
            let stage = self.draw_stage(seed)?;
            let goal = (self.goal)(seed).map_err(|reason| refused_trial(seed, &reason))?;
            let result = match goal {
                Err(why) => TrialResult::refused(seed, stage, &self.prior, &why),
                Ok(goal) => {
                    let mut score =
                        TrialScorer::new(seed, stage.clone(), &self.prior, goal.as_ref());
                    let session = SessionConfig { goal, ..self.session.clone() };
                    let outcome = insert(session, stage, &mut score);
                    score.finish(outcome)
                }
            };
            is_over.fetch_or(done().is_break(), Ordering::Relaxed);
            Ok(Some(result))
        };
        seeds.par_iter().filter_map(|seed| trial(seed).transpose()).collect()
    }

    fn draw_stage(&self, seed: u64) -> Result<VirtualStageConfig, String> {
        (self.stage)(seed).map_err(|reason| refused_trial(seed, &reason))
    }

    /// The times of the steps of all trials. They come from a whole session with a needle that needs no
    /// steering, on the stage of the trial with this seed.
    ///
    /// # Errors
    /// As [`Study::run`], or that session was stopped.
    pub fn timetable(&self, seed: u64) -> Result<Timetable, String> {
        let stage = self.draw_stage(seed)?;
        let tracker = TrackerModel { noise: TIMETABLE_NOISE, correlated: None, ..stage.tracker };
        // The needle of the bench's own model, so that no gate refuses a position.
        let stage = VirtualStageConfig {
            needle: self.session.needle,
            torsion: self.session.needle_torsion,
            start: Pose {
                rotation: self.session.handedness.start.to_rotation(),
                translation: Vector3::zeros(),
            },
            target: None,
            tracker,
            ..stage
        };
        let mut timetable = Timetable::new(&self.session.insertion, tracker);
        let take = |record, _| timetable.take(&record);
        match self.whole_session(self.session.clone(), stage, take) {
            Outcome::Completed => Ok(timetable),
            Outcome::Stopped(reason) => {
                Err(format!("an insertion from the plane, without noise, was stopped: {reason}"))
            }
        }
    }

    fn whole_session(
        &self,
        session: SessionConfig,
        stage: VirtualStageConfig,
        take: impl FnMut(Record, Option<Truth>),
    ) -> Outcome {
        let stage = VirtualStage::new(stage, Time::ZERO);
        let target = session.goal.as_ref().and_then(|goal| goal.tool.as_ref());
        let target = target.map(|tool| tool.gate.tool.clone());
        let mut session = Session::new(session, Time::ZERO);
        let tips = TipSource::Emulated { tool: self.tool.to_owned(), target };
        run_unwatched(&mut session, stage, tips, take)
    }
}

fn refused_trial(seed: u64, reason: &str) -> String {
    format!("trial with seed {seed}: {reason}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use crate::session::{PlaneOutOfReach, StepRecord};

    /// The steps of the trial with this seed, with a whole session and without one.
    fn both_ways(config: &Config, seed: u64) -> [Vec<(StepRecord, Truth)>; 2] {
        let stage = |seed| {
            config
                .drawn(seed)
                .and_then(|drawn| drawn.virtual_stage())
                .map_err(|error| error.to_string())
        };
        let mut session = config.session_without_goal().unwrap();
        session.insertion.plane_out_of_reach = PlaneOutOfReach::Insert;
        let tool = &config.tracker.tool;
        let goal = |seed| {
            config
                .drawn(seed)
                .and_then(|drawn| drawn.to_goal(&|_, _, _| Err(String::new())))
                .map_err(|error| error.to_string())
        };
        let prior = config.prior();
        let study = Study { session, tool, prior, stage: &stage, goal: &goal };
        let goal = goal(seed).unwrap().unwrap();
        let session = SessionConfig { goal, ..study.session.clone() };
        let (mut whole, mut short) = (Vec::new(), Vec::new());
        let take = |record, truth: Option<Truth>| {
            if let (Record::Step(step), Some(truth)) = (record, truth) {
                whole.push((*step, truth));
            }
        };
        let outcome = study.whole_session(session.clone(), stage(seed).unwrap(), take);
        assert_eq!(outcome, Outcome::Completed);
        let timetable = study.timetable(seed).unwrap();
        let take = |step: &StepRecord, truth: &Truth| short.push((step.clone(), *truth));
        let outcome = insert(&session, &stage(seed).unwrap(), &timetable, take);
        assert_eq!(outcome, Outcome::Completed);
        [whole, short]
    }

    /// The largest distance over all steps between the true tips, and between the estimated tips, mm.
    fn distances(config: &Config, seed: u64) -> [f64; 2] {
        let [whole, short] = both_ways(config, seed);
        assert_eq!(whole.len(), short.len());
        let mut largest = [0.0f64; 2];
        for ((step, truth), (short_step, short_truth)) in whole.iter().zip(&short) {
            assert_eq!(step.tip_meas_mm.is_some(), short_step.tip_meas_mm.is_some());
            let estimate = |step: &StepRecord| step.decision.estimate.unwrap().x_pb.translation;
            let apart = [
                truth.x_pb.translation - short_truth.x_pb.translation,
                estimate(step) - estimate(short_step),
            ];
            for (largest, apart) in largest.iter_mut().zip(apart) {
                *largest = largest.max(apart.norm());
            }
        }
        largest
    }

    /// A configuration of short insertions from anywhere in a half circle of rolls.
    fn config(sets: &[&str]) -> Config {
        let always = ["insertion.depth_mm=20", "study.roll_deg=[-60, 60]"];
        let sets: Vec<String> = [&always, sets].concat().into_iter().map(str::to_owned).collect();
        Config::from_sources(&[], &sets).unwrap()
    }

    /// The encoders round to 0.0002 mm and 0.005°. The cases include late positions, with and without their
    /// latency configured, and a shaft with torsion.
    #[test]
    fn a_trial_agrees_with_a_whole_session_within_the_encoders_resolution() {
        let smooth = [
            "observer.kind=coupled",
            "observer.coupled.gains=placed",
            "control.kind=feedback-linearization",
        ];
        let twisting = ["emulator.torsion.half_width_deg=8", "emulator.torsion.offset_deg=3"];
        let stepwise =
            ["insertion.mode=stepwise", "insertion.samples=2", "insertion.settle_s=0.05"];
        let late = ["emulator.tracker_latency_ms=175", "tracker.latency_ms=175"];
        let misled = ["emulator.tracker_latency_ms=175", "insertion.speed_mm_per_s=1"];
        for (case, sets) in [&[][..], &stepwise, &late, &misled, &twisting].into_iter().enumerate()
        {
            // Without noise the first positions would be identical, and the gate would refuse them.
            for noise in ["emulator.noise={ sd_mm = 1e-6 }", "emulator.noise={ uniform_mm = 1.0 }"]
            {
                let config = config(&[&smooth[..], &[noise], sets].concat());
                let [true_mm, estimated_mm] = distances(&config, 3);
                let apart = format!("case {case}, {noise}: {true_mm} {estimated_mm}");
                assert!(true_mm < 2e-4 && estimated_mm < 2e-4, "{apart}");
            }
        }
    }

    /// A bank of hypotheses and a law that chooses the nearer side can amplify the rounding.
    #[test]
    fn a_trial_with_the_default_steering_agrees_with_a_session_within_0_02_mm() {
        let [true_mm, estimated_mm] = distances(&config(&[]), 3);
        assert!(true_mm < 0.02 && estimated_mm < 0.02, "{true_mm} {estimated_mm}");
    }
}
