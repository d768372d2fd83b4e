//! Runs the session of a recorded run again, with the recorded inputs.

use super::comparison::Comparison;
use super::inputs::{Next, RecordedInputs};
use super::recorded::Recorded;
use crate::archive::{STEP_COLUMNS, StepRow, file, is_truth_column, steps_csv_header};
use crate::emulator::Truth;
use crate::operation::RunConfig;
use crate::session::{
    Input, Machine, ObserverConfig, Outcome, Output, Record, Session, StepRecord,
};
use crate::study::{FigureReport, RunFigures};
use crate::units::Time;

/// The files of a truncated record end within this long of each other, s: 0.2 s if the bench was killed, and
/// 1.25 s more if the machine lost power, since they are synced in turn. A file that ends earlier was truncated
/// by something else.
const APART_MAX_S: f64 = 1.5;

/// Where a truncated record ends.
#[derive(Debug, Clone, PartialEq)]
pub struct Truncation {
    /// The time of its last entry, in any of its files.
    pub end: Time,
    /// The file that ends first.
    pub file: &'static str,
    /// The time of the first entry that this file lacks.
    pub file_end: Time,
    /// Rows of `steps.csv` after the last input that could be replayed.
    pub rows_beyond: usize,
}

impl Truncation {
    /// The difference, if a file ends earlier than a kill or a loss of power explains.
    fn difference(&self) -> Option<String> {
        let (file, apart_s) = (self.file, self.end.seconds_after(self.file_end));
        (apart_s > APART_MAX_S).then(|| {
            format!(
                "{file} ends {apart_s:.3} s before the record does: after a kill or a loss of power \
                 the files end within {APART_MAX_S:.1} s of each other"
            )
        })
    }
}

/// The result of a replay.
#[derive(Debug, Clone)]
pub struct Replayed {
    /// The first difference from the record, if there is one.
    pub difference: Option<String>,
    /// Rows of `steps.csv` compared.
    pub rows: usize,
    /// Frames sent compared.
    pub frames: usize,
    /// Samples compared.
    pub samples: usize,
    /// Where a truncated record ends.
    pub truncation: Option<Truncation>,
    /// How the session ended; `None` if a truncated record ends before it.
    pub outcome: Option<Outcome>,
    /// Length of the session's own time line, s.
    pub duration_s: f64,
    /// The replayed rows of `steps.csv`, with the recorded truth.
    pub steps: Vec<String>,
    /// The figures of the recorded observer.
    pub figures: FigureReport,
    /// The figures of the what-if observer, if there is one.
    pub what_if: Option<FigureReport>,
}

impl Replayed {
    /// The replayed `steps.csv`.
    pub fn steps_csv(&self) -> String {
        let header = steps_csv_header();
        let rows = [&header].into_iter().chain(&self.steps);
        rows.flat_map(|row| [row, "\n"]).collect()
    }
}

/// Runs the session of `recorded` with the recorded inputs, and compares its output with the record.
///
/// A `what_if` observer runs alongside as a shadow, on the same accepted measurements. [`Replayed::steps`]
/// then holds its estimates instead of those of the recorded observer. The comparison still uses the
/// recorded observer.
///
/// # Errors
/// Records were dropped, the session refuses its configuration, or the files do not belong together.
pub fn replay(
    recorded: &Recorded<'_>,
    what_if: Option<ObserverConfig>,
) -> Result<Replayed, String> {
    match recorded.manifest.dropped.unwrap_or_default().text_files {
        0 => replay_to(recorded, what_if, &mut |_, _| Ok(())),
        dropped => Err(format!(
            "{dropped} records were dropped while this run was recorded (manifest.json, \
             dropped.text_files): so inputs of the session may be missing, and no replay can be \
             exact"
        )),
    }
}

/// Takes a record of the replayed session; the record of a step comes with the recorded truth. An error ends the
/// replay.
type TakeRecord<'a> = &'a mut dyn FnMut(Record, Option<Truth>) -> Result<(), String>;

/// Like [`replay`], but accepts dropped records, and passes every record of the session to `take`, up to the
/// first difference. The replay equals the run only up to the first dropped record.
///
/// # Errors
/// The session refuses its configuration, the files do not belong together, or `take` fails.
pub fn replay_to(
    recorded: &Recorded<'_>,
    what_if: Option<ObserverConfig>,
    take: TakeRecord<'_>,
) -> Result<Replayed, String> {
    let mut run_config = recorded.run_config.clone();
    match (&mut run_config, what_if) {
        (RunConfig::Insertion(config), what_if) => config.shadows.extend(what_if),
        (RunConfig::Operation(..), Some(_)) => {
            return Err("an operation of the stage has no observer to ask about".to_owned());
        }
        (RunConfig::Operation(..), None) => {}
    }
    let mut inputs = RecordedInputs::open(recorded)?;
    let mut end = inputs.begun();
    let mut replay = Replay {
        session: run_config.begin(end),
        comparison: Comparison::open(recorded)?,
        take,
        has_what_if: what_if.is_some(),
        steps: Vec::new(),
        figures: RunFigures::default(),
        what_if: RunFigures::default(),
    };
    replay.drain(None)?;
    while let Some(next) = inputs.next()? {
        match next {
            Next::Input(time, input) => {
                replay.session.handle(time, input.clone());
                replay.drain(Some(&input))?;
                end = time;
            }
            Next::Missing(time, file) if replay.comparison.is_truncated() => {
                replay.comparison.note_end(file, time);
                break;
            }
            Next::Missing(_, file) => {
                return Err(inputs.mismatch(&format!("has one more than {file}")));
            }
        }
    }
    if let Some(logged) = inputs.received.peek()
        && !replay.comparison.is_truncated()
    {
        return Err(format!(
            "the files are not of one run: {} line {} was given to no session",
            file::CAN,
            logged.line
        ));
    }
    replay.finish(recorded, inputs.begun(), end)
}

struct Replay<'a> {
    session: Session,
    comparison: Comparison<'a>,
    take: TakeRecord<'a>,
    /// The last shadow is the what-if observer.
    has_what_if: bool,
    steps: Vec<String>,
    figures: RunFigures,
    what_if: RunFigures,
}

impl Replay<'_> {
    /// Takes the output of the session in answer to `input`.
    fn drain(&mut self, input: Option<&Input>) -> Result<(), String> {
        while let Some(output) = self.session.poll() {
            match output {
                Output::Transmit { time, frame } => {
                    self.comparison.check_sent(time, &frame, input)?
                }
                Output::Record(record) => self.record(record)?,
            }
        }
        Ok(())
    }

    fn record(&mut self, record: Record) -> Result<(), String> {
        let mut truth = None;
        match &record {
            Record::Sample(sample) | Record::Target(sample) => {
                self.comparison.check_sample(sample)?;
            }
            Record::Stage(stage) => {
                self.figures.take_feedback(stage);
                self.what_if.take_feedback(stage);
            }
            Record::Step(step) => truth = self.step(step.as_ref().clone())?,
            _ => {}
        }
        match self.comparison.difference {
            None => (self.take)(record, truth),
            Some(_) => Ok(()),
        }
    }

    /// Compares `step` and adds its row and figures; returns the recorded truth at it.
    fn step(&mut self, mut step: StepRecord) -> Result<Option<Truth>, String> {
        let what_if = if self.has_what_if { step.decision.shadows.pop() } else { None };
        let recorded = self.comparison.check_step(&step)?.unwrap_or_default();
        let truth = self.comparison.columns.truth(&recorded);
        self.figures.take_step(&step, truth.as_ref());
        if let Some((_, estimate)) = what_if {
            step.decision.estimate = estimate;
            self.what_if.take_step(&step, truth.as_ref());
        }
        let row = StepRow::new(&step, None).to_string();
        self.steps.push(with_recorded_truth(&row, &recorded));
        Ok(truth)
    }

    /// Completes the replay of the inputs from `begun` to `end`.
    fn finish(
        mut self,
        recorded: &Recorded<'_>,
        begun: Time,
        end: Time,
    ) -> Result<Replayed, String> {
        let outcome = self.session.outcome().cloned();
        let is_truncated = self.comparison.is_truncated();
        let Comparison { rows, samples, sent, .. } = &self.comparison;
        let (rows, frames, samples) = (rows.taken, sent.taken, samples.taken);
        self.comparison.close(outcome.as_ref())?;
        let Comparison { difference, rows: mut beyond, columns, first_end, .. } = self.comparison;
        let mut truncation = None;
        if is_truncated {
            let (file_end, file) = first_end.unwrap_or((end, file::INPUTS));
            while beyond.take()?.is_some() {}
            let rows_beyond = beyond.taken - rows;
            let end = recorded.end(&columns)?;
            truncation = Some(Truncation { end, file, file_end, rows_beyond });
        }
        let difference =
            difference.or_else(|| truncation.as_ref().and_then(Truncation::difference));
        Ok(Replayed {
            difference,
            rows,
            frames,
            samples,
            truncation,
            outcome,
            duration_s: end.seconds_after(begun),
            steps: self.steps,
            figures: self.figures.report(),
            what_if: self.has_what_if.then(|| self.what_if.report()),
        })
    }
}

/// The row `replayed` with the truth copied as text from `recorded`, since a replay does not compute it.
fn with_recorded_truth(replayed: &str, recorded: &str) -> String {
    let mut recorded = recorded.split(',');
    let values =
        replayed.split(',').zip(&STEP_COLUMNS).map(|(replayed, (column, _))| {
            match recorded.next() {
                Some(recorded) if is_truth_column(column) => recorded,
                _ => replayed,
            }
        });
    values.collect::<Vec<_>>().join(",")
}
