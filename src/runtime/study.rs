//! A study's trials, on all threads.

use super::virtual_time::{Tips, run_unwatched};
use crate::emulator::{Noise, TrackerModel, Truth, VirtualStage, VirtualStageConfig};
use crate::geometry::Pose;
use crate::needle::Torsion;
use crate::session::{Outcome, Record, Session, SessionConfig, SessionError};
use crate::study::{Prior, Timetable, TimetableBuilder, TrialResult, TrialScore, insert};
use crate::units::Time;
use rayon::iter::{IntoParallelRefIterator, ParallelIterator};
use thiserror::Error;

/// Noise of the insertion that is the timetable's: as good as none, and no two positions alike,
/// since a tracker that says the same over and over is not believed.
const TIMETABLE_NOISE: Noise = Noise::Gaussian(1e-6);

/// Insertions to be made again and again.
pub struct Study<'a> {
    /// What the bench is told.
    pub session: SessionConfig,
    /// The name of the tracked tip.
    pub tool: &'a str,
    /// What nobody knows before a trial.
    pub prior: Prior,
    /// The emulated stage, needle and tracker of the trial with the seed given, or why there can be
    /// none.
    pub stage: &'a (dyn Fn(u64) -> Result<VirtualStageConfig, String> + Sync),
}

/// Why there is no study.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum StudyError {
    /// The session refuses what it is told.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// A trial cannot be drawn.
    #[error("trial with seed {seed}: {reason}")]
    Trial {
        /// Its seed.
        seed: u64,
        /// Why.
        reason: String,
    },
    /// The insertion that tells when steps are taken came to no end.
    #[error("an insertion in the plane, without noise, was stopped: {0}")]
    NoTimetable(String),
}

impl Study<'_> {
    /// Makes the trials with these seeds, in parallel; `done` is called after each. The results are
    /// in the order of the seeds, whatever thread made them.
    ///
    /// # Errors
    /// [`StudyError`] where the session or the emulator refuses its configuration.
    pub fn run(
        &self,
        seeds: &[u64],
        done: &(dyn Fn() + Sync),
    ) -> Result<Vec<TrialResult>, StudyError> {
        let Some(&first) = seeds.first() else { return Ok(Vec::new()) };
        let timetable = self.timetable(first)?;
        let trial = |&seed: &u64| {
            let stage = self.drawn(seed)?;
            let mut score = TrialScore::new(seed, &self.session, stage.clone(), &self.prior);
            let take = |step: &_, truth: &_| score.take(step, truth);
            let outcome = insert(&self.session, &stage, &timetable, take);
            done();
            Ok(score.finish(outcome.map_err(SessionError::from)?))
        };
        seeds.par_iter().map(trial).collect()
    }

    /// The same through whole sessions, drives and CAN frames included: a hundred times slower.
    ///
    /// # Errors
    /// As [`Study::run`].
    pub fn run_through_sessions(
        &self,
        seeds: &[u64],
        done: &(dyn Fn() + Sync),
    ) -> Result<Vec<TrialResult>, StudyError> {
        let trial = |&seed: &u64| {
            let stage = self.drawn(seed)?;
            let mut score = TrialScore::new(seed, &self.session, stage.clone(), &self.prior);
            let outcome = self.whole_session(stage, &mut |record, truth| {
                if let Record::Step(step) = record {
                    score.take(&step, &truth);
                }
            })?;
            done();
            Ok(score.finish(outcome))
        };
        seeds.par_iter().map(trial).collect()
    }

    fn drawn(&self, seed: u64) -> Result<VirtualStageConfig, StudyError> {
        (self.stage)(seed).map_err(|reason| StudyError::Trial { seed, reason })
    }

    /// The times of all trials, from a whole session with a needle that needs no steering.
    fn timetable(&self, seed: u64) -> Result<Timetable, StudyError> {
        let stage = self.drawn(seed)?;
        let tracker = TrackerModel { noise: TIMETABLE_NOISE, ..stage.tracker };
        let stage = VirtualStageConfig {
            needle: self.session.needle,
            torsion: Torsion::default(),
            start: Pose::identity(),
            tracker,
            ..stage
        };
        let mut builder = TimetableBuilder::new(self.session.insertion.mode, tracker);
        let outcome = self.whole_session(stage, &mut |record, _| builder.take(&record))?;
        match outcome {
            Outcome::Completed => Ok(builder.finish()),
            Outcome::Stopped(reason) => Err(StudyError::NoTimetable(reason)),
        }
    }

    fn whole_session(
        &self,
        stage: VirtualStageConfig,
        take: &mut dyn FnMut(Record, Truth),
    ) -> Result<Outcome, SessionError> {
        let session = Session::new(self.session.clone(), Time::ZERO)?;
        let stage = VirtualStage::new(stage, Time::ZERO);
        let tips = Tips::Emulated { tool: self.tool.to_owned() };
        Ok(run_unwatched(session, stage, tips, take))
    }
}
