//! The session of a recorded run, given what it was given.

use super::comparison::Comparison;
use super::cut::Cut;
use super::difference::Difference;
use super::error::ReplayError;
use super::recorded::Recorded;
use crate::archive::{Given, STEP_COLUMNS, StepRow, file, is_of_truth, steps_csv_header};
use crate::emulator::Truth;
use crate::operation::Plan;
use crate::session::{
    Input, Machine, ObserverConfig, Outcome, Output, Record, Session, StepRecord,
};
use crate::study::{FigureReport, RunFigures};
use crate::tracker::Event;
use crate::units::Time;

/// What a replay came to.
#[derive(Debug, Clone)]
pub struct Replayed {
    /// The first difference from the record; `None` where there is none.
    pub difference: Option<Difference>,
    /// Rows of `steps.csv` compared.
    pub rows: usize,
    /// Frames sent compared.
    pub frames: usize,
    /// Samples compared.
    pub samples: usize,
    /// Of a record that was cut: where it ends.
    pub cut: Option<Cut>,
    /// How the session ended; `None` where a record that was cut ends before it.
    pub outcome: Option<Outcome>,
    /// The time line from its first input to its last.
    pub span: (Time, Time),
    /// The replayed rows of `steps.csv`, the truth in them as recorded.
    pub steps: Vec<String>,
    /// The figures of the recorded observer.
    pub figures: FigureReport,
    /// The figures of the observer that was asked about, where one was.
    pub what_if: Option<FigureReport>,
}

impl Replayed {
    /// The replayed `steps.csv`.
    pub fn steps_csv(&self) -> String {
        let header = steps_csv_header();
        let rows = [&header].into_iter().chain(&self.steps);
        rows.flat_map(|row| [row, "\n"]).collect()
    }

    /// How long the session's own time line is, s.
    pub fn duration_s(&self) -> f64 {
        self.span.1.seconds_after(self.span.0)
    }
}

/// Gives `recorded`'s session what it was given, and compares what leaves it with the record.
///
/// With `what_if` that observer runs alongside on the same believed measurements, as a shadow of the
/// one that steered, and its estimates take the place of that one's in the steps that are given
/// back; what is compared is the recorded observer's all the same.
///
/// # Errors
/// [`ReplayError`] where records were dropped, the session refuses its configuration or the files do
/// not fit together.
pub fn replay(
    recorded: &Recorded<'_>,
    what_if: Option<ObserverConfig>,
) -> Result<Replayed, ReplayError> {
    match recorded.dropped {
        0 => replay_to(recorded, what_if, &mut |_, _| {}),
        dropped => Err(ReplayError::Dropped(dropped)),
    }
}

/// What takes the records that leave a replayed session, steps with their truth as recorded.
pub type TakeRecord<'a> = &'a mut dyn FnMut(Record, Option<Truth>);

/// As [`replay`], with every record that leaves the session handed to `take`, up to the first
/// difference. Where records were dropped that is as far as the replay is the run.
///
/// # Errors
/// [`ReplayError`] where the session refuses its configuration or the files do not fit together.
pub fn replay_to(
    recorded: &Recorded<'_>,
    what_if: Option<ObserverConfig>,
    take: TakeRecord<'_>,
) -> Result<Replayed, ReplayError> {
    let mut plan = recorded.plan.clone();
    match (&mut plan, what_if) {
        (Plan::Insertion(config), what_if) => config.shadows.extend(what_if),
        (Plan::Operation(_), Some(_)) => return Err(ReplayError::NoObserver),
        (Plan::Operation(_), None) => {}
    }
    let begun = recorded.inputs.begun;
    let mut replay = Replay {
        recorded,
        session: plan.begin(begun)?,
        comparison: Comparison::new(recorded),
        take,
        asks: what_if.is_some(),
        steps: Vec::new(),
        figures: RunFigures::default(),
        what_if: RunFigures::default(),
        frames: 0,
        samples: 0,
    };
    replay.drain(None);
    let mut end = begun;
    for (line, (time, given)) in (2..).zip(recorded.inputs.given()) {
        let Some(input) = replay.input(line, time, given)? else { break };
        replay.session.handle(time, input.clone());
        replay.drain(Some(&input));
        end = time;
    }
    replay.finish((begun, end))
}

struct Replay<'a> {
    recorded: &'a Recorded<'a>,
    session: Session,
    comparison: Comparison<'a>,
    take: TakeRecord<'a>,
    /// The last shadow is the observer that is asked about.
    asks: bool,
    steps: Vec<String>,
    figures: RunFigures,
    what_if: RunFigures,
    /// Received frames and samples given so far.
    frames: usize,
    samples: usize,
}

impl Replay<'_> {
    /// The input of a line of `inputs.log`; `None` where a record that was cut does not hold it.
    fn input(
        &mut self,
        line: usize,
        time: Time,
        given: Given,
    ) -> Result<Option<Input>, ReplayError> {
        let mixed =
            |what: String| ReplayError::Mixed(format!("{} line {line} {what}", file::INPUTS));
        let lacks = |comparison: &mut Comparison<'_>, name| match self.recorded.outcome {
            None => {
                comparison.ends(name, time);
                Ok(None)
            }
            Some(_) => Err(mixed(format!("has one more than {name}"))),
        };
        match given {
            Given::Input(input) => Ok(Some(input)),
            Given::Frame => {
                let Some(logged) = self.recorded.received.get(self.frames) else {
                    return lacks(&mut self.comparison, file::CAN);
                };
                let (stamp_us, given_us) = (logged.unix_us, self.recorded.unix_us(time));
                if stamp_us != given_us {
                    let apart_us = stamp_us.abs_diff(given_us);
                    let what =
                        format!("and {} line {} are {apart_us} us apart", file::CAN, logged.line);
                    return Err(mixed(what));
                }
                self.frames += 1;
                Ok(Some(Input::Frame(logged.frame)))
            }
            Given::Sample => {
                let Some((sample, _)) = self.recorded.samples.get(self.samples) else {
                    return lacks(&mut self.comparison, file::TRACKER);
                };
                self.samples += 1;
                if sample.receive_time > time {
                    let late_s = sample.receive_time.seconds_after(time);
                    let what = format!(
                        "was given {late_s} s before {} line {}",
                        file::TRACKER,
                        self.samples
                    );
                    return Err(mixed(what));
                }
                Ok(Some(Input::Tracker(Event::Sample(sample.clone()))))
            }
        }
    }

    /// Takes what leaves the session in answer to `input`.
    fn drain(&mut self, input: Option<&Input>) {
        while let Some(output) = self.session.poll() {
            match output {
                Output::Transmit { time, frame } => self.comparison.sent(time, &frame, input),
                Output::Record(record) => self.record(record),
            }
        }
    }

    fn record(&mut self, record: Record) {
        let truth = match &record {
            Record::Sample(sample) => {
                self.comparison.sample(sample);
                None
            }
            Record::Stage(stage) => {
                self.figures.follow(stage);
                self.what_if.follow(stage);
                None
            }
            Record::Step(step) => self.step(step.as_ref().clone()),
            _ => None,
        };
        if self.comparison.difference.is_none() {
            (self.take)(record, truth);
        }
    }

    /// The truth at `step`, as recorded.
    fn step(&mut self, mut step: StepRecord) -> Option<Truth> {
        let asked = if self.asks { step.shadows.pop() } else { None };
        let truth = self.comparison.step(&step);
        self.figures.take(&step, truth.as_ref());
        if let Some((_, estimate)) = asked {
            step.estimate = estimate;
            self.what_if.take(&step, truth.as_ref());
        }
        let row = StepRow { step: &step, truth: None }.to_string();
        self.steps.push(self.with_recorded_truth(&row));
        truth
    }

    /// `row`, the next, with the truth as text from the recorded one: it is not made anew.
    fn with_recorded_truth(&self, row: &str) -> String {
        let steps = &self.recorded.steps;
        let Some(recorded) = steps.rows.get(self.steps.len()) else { return row.to_owned() };
        let values = row.split(',').zip(&STEP_COLUMNS).enumerate();
        let values = values.map(|(n, (replayed, (column, _)))| match recorded.get(n) {
            Some(recorded) if is_of_truth(column) => recorded,
            _ => replayed,
        });
        values.collect::<Vec<_>>().join(",")
    }

    fn finish(mut self, span: (Time, Time)) -> Result<Replayed, ReplayError> {
        let outcome = self.session.outcome().cloned();
        let left = self.recorded.received.get(self.frames);
        if let (Some(_), Some(logged)) = (&self.recorded.outcome, left) {
            let what = format!("{} line {} was given to no session", file::CAN, logged.line);
            return Err(ReplayError::Mixed(what));
        }
        self.comparison.close(outcome.as_ref());
        let Comparison { difference, rows, frames, samples, ended, .. } = self.comparison;
        let cut = self.recorded.outcome.is_none().then(|| {
            let (file_end, file) = ended.unwrap_or((span.1, file::INPUTS));
            let rows_beyond = self.recorded.steps.rows.len().saturating_sub(rows);
            Cut { end: self.recorded.end(), file, file_end, rows_beyond }
        });
        let difference = difference.or_else(|| cut.as_ref().and_then(Cut::difference));
        Ok(Replayed {
            difference,
            rows,
            frames,
            samples,
            cut,
            outcome,
            span,
            steps: self.steps,
            figures: self.figures.report(),
            what_if: self.asks.then(|| self.what_if.report()),
        })
    }
}
