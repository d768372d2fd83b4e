//! The depths at which an insertion measures and steps. They are the same in every trial.

use crate::emulator::TrackerModel;
use crate::session::{InsertionConfig, InsertionMode, Record, Samples, State, StepRecord};
use crate::units::Time;
use std::ops::RangeInclusive;

/// A position that corrects the observers: one of the tracker's, or the mean of several.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct SampleDue {
    /// Numbers, from 0, of the tracker's positions that are averaged.
    pub(super) numbers: RangeInclusive<u64>,
    /// Depth of the tip when they were measured, mm; for several, their mean depth.
    pub(super) insertion_true_mm: f64,
    /// Depth at which the session assumes that they were measured, mm.
    pub(super) insertion_meas_mm: f64,
}

impl SampleDue {
    /// The number of positions that are averaged.
    pub(super) fn positions(&self) -> u32 {
        u32::try_from(self.numbers.end() - self.numbers.start() + 1).unwrap_or(u32::MAX)
    }
}

/// One step.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct StepDue {
    /// The positions that correct the observers since the step before, in order.
    pub(super) samples: Vec<SampleDue>,
    /// The mean of all positions since the last step that had any, for the handedness watch.
    pub(super) mean: Option<SampleDue>,
    /// Depth of the step, mm.
    pub(super) insertion_mm: f64,
    /// Depth from which the command of the step applies, mm.
    pub(super) command_mm: f64,
}

/// The steps of an insertion, from the records of one whole session on the emulated stage. Commands turn
/// the needle but do not change the insertion, so one session gives the depths of all trials.
#[derive(Debug)]
pub struct Timetable {
    tracker: TrackerModel,
    /// Positions averaged at a step.
    averaged: u32,
    /// True if every position corrects the observers individually.
    takes_all: bool,
    is_inserting: bool,
    /// The assumed acquisition time and the receive time of each position accepted since the step before.
    received: Vec<(Time, Time)>,
    /// Time and measured depth of every SYNC.
    stage: Vec<(Time, f64)>,
    command_mm: f64,
    pub(super) steps: Vec<StepDue>,
}

impl Timetable {
    /// An empty timetable for insertions with this configuration, on a stage with this tracker.
    pub fn new(insertion: &InsertionConfig, tracker: TrackerModel) -> Self {
        let (averaged, takes_all) = match insertion.mode {
            InsertionMode::Continuous => (1, insertion.corrected_by == Samples::All),
            InsertionMode::Stepwise => (insertion.samples, false),
        };
        Timetable {
            tracker,
            averaged,
            takes_all,
            is_inserting: false,
            received: Vec::new(),
            stage: Vec::new(),
            command_mm: 0.0,
            steps: Vec::new(),
        }
    }

    /// Adds one record, in the order of the session.
    pub fn take(&mut self, record: &Record) {
        match record {
            Record::Stage(stage) => {
                self.stage.push((stage.time, stage.measured.insertion_mm));
                self.command_mm = stage.commanded.insertion_mm;
            }
            Record::State { state: State::Inserting, .. } => self.is_inserting = true,
            Record::Sample(sample) if self.is_inserting => {
                let acquired = sample.acquisition_time;
                self.received
                    .extend(acquired.map(|acquired| (acquired, sample.received.receive_time)));
            }
            Record::Step(step) => {
                let samples =
                    if self.takes_all { self.all_samples() } else { self.newest_sample(step) };
                self.steps.push(StepDue {
                    mean: samples.last().map(|sample| self.mean_since_last_step(sample)),
                    samples,
                    insertion_mm: step.insertion_meas_mm,
                    command_mm: self.command_mm,
                });
            }
            _ => {}
        }
    }

    /// Every position accepted since the step before.
    fn all_samples(&mut self) -> Vec<SampleDue> {
        let received = std::mem::take(&mut self.received);
        let due = |(acquired, received)| self.sample_due(received, self.insertion_at(acquired));
        received.into_iter().map(due).collect()
    }

    /// The position that the step itself used; empty if it had none.
    fn newest_sample(&mut self, step: &StepRecord) -> Vec<SampleDue> {
        let received = std::mem::take(&mut self.received);
        let (Some(age_s), Some(insertion_meas_mm)) =
            (step.tip_meas_age_s, step.tip_meas_insertion_mm)
        else {
            return Vec::new();
        };
        let acquired_s = step.time.as_secs_f64() - age_s;
        let off_s = |&&(acquired, _): &&(Time, Time)| (acquired.as_secs_f64() - acquired_s).abs();
        let newest = received.iter().min_by(|a, b| off_s(a).total_cmp(&off_s(b)));
        Vec::from_iter(newest.map(|&(_, received)| self.sample_due(received, insertion_meas_mm)))
    }

    /// The position received at `received`, or the mean of it and those before it.
    fn sample_due(&self, received: Time, insertion_meas_mm: f64) -> SampleDue {
        // The tracker's true latency; the session may assume another one.
        let sent_s = (received - self.tracker.latency).as_secs_f64();
        let sent = (sent_s / self.tracker.period.as_secs_f64()).round() as u64;
        // A repeated position was measured when it was first sent.
        let number = sent / self.times_sent();
        SampleDue {
            numbers: (number + 1).saturating_sub(u64::from(self.averaged))..=number,
            insertion_true_mm: self.measured_at_mm(number),
            insertion_meas_mm,
        }
    }

    /// The mean of all positions after those of the last step, up to `sample`.
    fn mean_since_last_step(&self, sample: &SampleDue) -> SampleDue {
        let last = *sample.numbers.end();
        let before = self.steps.iter().rev().find_map(|step| step.mean.as_ref());
        let first = before.map_or(last, |mean| (mean.numbers.end() + 1).min(last));
        let depths = (first..=last).map(|number| self.measured_at_mm(number));
        let insertion_true_mm = depths.sum::<f64>() / (last - first + 1) as f64;
        let off_mm = sample.insertion_meas_mm - sample.insertion_true_mm;
        let insertion_meas_mm = (insertion_true_mm + off_mm).max(0.0);
        SampleDue { numbers: first..=last, insertion_true_mm, insertion_meas_mm }
    }

    /// Depth of the tip when the position with this number was measured, mm.
    fn measured_at_mm(&self, number: u64) -> f64 {
        let period_s = self.tracker.period.as_secs_f64();
        self.insertion_at(Time::from_secs_f64((number * self.times_sent()) as f64 * period_s))
    }

    /// How often the tracker sends each position.
    fn times_sent(&self) -> u64 {
        u64::from(self.tracker.repeats) + 1
    }

    /// Depth at `time`, mm, interpolated between two SYNCs; 0 before the first, constant after the last.
    fn insertion_at(&self, time: Time) -> f64 {
        let after = self.stage.partition_point(|&(sync, _)| sync < time);
        let Some(&(from, from_mm)) = after.checked_sub(1).and_then(|at| self.stage.get(at)) else {
            return 0.0;
        };
        let Some(&(to, to_mm)) = self.stage.get(after) else { return from_mm };
        from_mm + (to_mm - from_mm) * (time.seconds_after(from) / to.seconds_after(from))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    #[test]
    fn the_depth_is_interpolated_between_syncs_and_stays_after_the_last() {
        let config = Config::from_sources(&[], &[]).unwrap();
        let (session, stage) = (config.session().unwrap(), config.virtual_stage().unwrap());
        let mut timetable = Timetable::new(&session.insertion, stage.tracker);
        let at = |ms: i64| Time::from_nanos(ms * 1_000_000);
        timetable.stage = vec![(at(10), 0.0), (at(20), 0.5)];
        let depths = [0, 10, 15, 20, 25].map(|ms| timetable.insertion_at(at(ms)));
        assert_eq!(depths, [0.0, 0.0, 0.25, 0.5, 0.5]);
    }
}
