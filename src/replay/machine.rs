//! The session of a recorded run, given what it was given.

use super::comparison::Comparison;
use super::inputs::{Next, RecordedInputs};
use super::recorded::Recorded;
use crate::archive::{STEP_COLUMNS, StepRow, file, is_truth_column, steps_csv_header};
use crate::emulator::Truth;
use crate::operation::Plan;
use crate::session::{
    Input, Machine, ObserverConfig, Outcome, Output, Record, Session, StepRecord,
};
use crate::study::{FigureReport, RunFigures};
use crate::units::Time;

/// The files of a record that was cut end at different times: those of a killed bench within 0.2 s,
/// those of a machine that lost power within a second and a quarter more, in which each is put on
/// the disk in its turn. One that ends earlier than this was not cut with the others.
const APART_MAX_S: f64 = 1.5;

/// Where a record ends that was cut.
#[derive(Debug, Clone, PartialEq)]
pub struct Cut {
    /// Its last entry, in whichever file.
    pub end: Time,
    /// The file that ends first.
    pub file: &'static str,
    /// The time of what that file does not hold any more.
    pub file_end: Time,
    /// Rows of `steps.csv` that come after what the session could be given.
    pub rows_beyond: usize,
}

impl Cut {
    /// The difference, if a file lacks more than a cut takes.
    fn difference(&self) -> Option<String> {
        let (file, apart_s) = (self.file, self.end.seconds_after(self.file_end));
        (apart_s > APART_MAX_S).then(|| {
            format!(
                "{file} ends {apart_s:.3} s before the record does: a cut leaves its files within \
                 {APART_MAX_S:.1} s of each other"
            )
        })
    }
}

/// The result of a replay.
#[derive(Debug, Clone)]
pub struct Replayed {
    /// The first difference from the record; `None` where there is none.
    pub difference: Option<String>,
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
/// Where records were dropped, the session refuses its configuration or the files do
/// not fit together.
pub fn replay(
    recorded: &Recorded<'_>,
    what_if: Option<ObserverConfig>,
) -> Result<Replayed, String> {
    match recorded.manifest.dropped.unwrap_or_default().text_files {
        0 => replay_to(recorded, what_if, &mut |_, _| {}),
        dropped => Err(format!(
            "{dropped} records were dropped while this run was recorded (manifest.json, \
             dropped.text_files): what the session was given is not whole, and no replay of it can \
             be exact"
        )),
    }
}

/// Takes the records that leave a replayed session, steps with their truth as recorded.
type TakeRecord<'a> = &'a mut dyn FnMut(Record, Option<Truth>);

/// As [`replay`], with every record that leaves the session handed to `take`, up to the first
/// difference. Where records were dropped that is as far as the replay is the run.
///
/// # Errors
/// Where the session refuses its configuration or the files do not fit together.
pub fn replay_to(
    recorded: &Recorded<'_>,
    what_if: Option<ObserverConfig>,
    take: TakeRecord<'_>,
) -> Result<Replayed, String> {
    let mut plan = recorded.plan.clone();
    match (&mut plan, what_if) {
        (Plan::Insertion(config), what_if) => config.shadows.extend(what_if),
        (Plan::Operation(_), Some(_)) => {
            return Err("an operation of the stage has no observer to ask about".to_owned());
        }
        (Plan::Operation(_), None) => {}
    }
    let mut inputs = RecordedInputs::open(recorded)?;
    let mut end = inputs.begun();
    let mut replay = Replay {
        session: plan.begin(end).map_err(|error| format!("{}: {error}", file::CONFIG))?,
        comparison: Comparison::open(recorded)?,
        take,
        asks: what_if.is_some(),
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
            Next::Lacking(time, file) if replay.comparison.is_cut() => {
                replay.comparison.ends(file, time);
                break;
            }
            Next::Lacking(_, file) => {
                return Err(inputs.mixed(&format!("has one more than {file}")));
            }
        }
    }
    if let Some(logged) = inputs.left_over()
        && !replay.comparison.is_cut()
    {
        return Err(format!(
            "the files are not of one run: {} line {} was given to no session",
            file::CAN,
            logged.line
        ));
    }
    replay.finish(recorded, (inputs.begun(), end))
}

struct Replay<'a> {
    session: Session,
    comparison: Comparison<'a>,
    take: TakeRecord<'a>,
    /// The last shadow is the observer that is asked about.
    asks: bool,
    steps: Vec<String>,
    figures: RunFigures,
    what_if: RunFigures,
}

impl Replay<'_> {
    /// Takes what leaves the session in answer to `input`.
    fn drain(&mut self, input: Option<&Input>) -> Result<(), String> {
        while let Some(output) = self.session.poll() {
            match output {
                Output::Transmit { time, frame } => self.comparison.sent(time, &frame, input)?,
                Output::Record(record) => self.record(record)?,
            }
        }
        Ok(())
    }

    fn record(&mut self, record: Record) -> Result<(), String> {
        let truth = match &record {
            Record::Sample(sample) | Record::Target(sample) => {
                self.comparison.sample(sample)?;
                None
            }
            Record::Stage(stage) => {
                self.figures.take_feedback(stage);
                self.what_if.take_feedback(stage);
                None
            }
            Record::Step(step) => self.step(step.as_ref().clone())?,
            _ => None,
        };
        if self.comparison.difference.is_none() {
            (self.take)(record, truth);
        }
        Ok(())
    }

    /// The truth at `step`, as recorded.
    fn step(&mut self, mut step: StepRecord) -> Result<Option<Truth>, String> {
        let asked = if self.asks { step.decision.shadows.pop() } else { None };
        let recorded = self.comparison.step(&step)?.unwrap_or_default();
        let truth = self.comparison.columns.truth(&recorded);
        self.figures.take_step(&step, truth.as_ref());
        if let Some((_, estimate)) = asked {
            step.decision.estimate = estimate;
            self.what_if.take_step(&step, truth.as_ref());
        }
        let row = StepRow::new(&step, None).to_string();
        self.steps.push(with_recorded_truth(&row, &recorded));
        Ok(truth)
    }

    fn finish(mut self, recorded: &Recorded<'_>, span: (Time, Time)) -> Result<Replayed, String> {
        let outcome = self.session.outcome().cloned();
        let is_cut = self.comparison.is_cut();
        let Comparison { rows, samples, sent, .. } = &self.comparison;
        let (rows, frames, samples) = (rows.taken, sent.taken, samples.taken);
        self.comparison.close(outcome.as_ref())?;
        let Comparison { difference, rows: mut beyond, columns, ended, .. } = self.comparison;
        let mut cut = None;
        if is_cut {
            let (file_end, file) = ended.unwrap_or((span.1, file::INPUTS));
            while beyond.take()?.is_some() {}
            let rows_beyond = beyond.taken - rows;
            cut = Some(Cut { end: recorded.end(&columns)?, file, file_end, rows_beyond });
        }
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

/// The row `replayed` with the truth as text from `recorded`: it is not made anew.
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
