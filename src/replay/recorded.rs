//! What a run folder holds of a run, ready to be given to a session again.

use super::ReplayError;
use crate::archive::{
    Given, Inputs, LoggedFrame, Manifest, RecordedSteps, RunOutcome, steps_csv_header, unix_us_of,
    whole_lines,
};
use crate::canopen::Frame;
use crate::operation::Plan;
use crate::session::{Direction, HELD_UP, Input, Outcome};
use crate::tracker::Sample;
use crate::tracker::ndjson;
use crate::units::Time;

/// The text of the files that a replay reads.
#[derive(Debug, Clone, Copy)]
pub struct Files<'a> {
    /// `inputs.log`.
    pub inputs: &'a str,
    /// `can.log`.
    pub can: &'a str,
    /// `tracker.ndjson`.
    pub tracker: &'a str,
    /// `steps.csv`.
    pub steps: &'a str,
}

/// A recorded run.
#[derive(Debug, Clone)]
pub struct Recorded<'a> {
    pub(super) plan: Plan,
    /// UTC of the run's origin, µs since 1970.
    pub(super) started_unix_us: i64,
    /// How the run ended; `None` of a record that was cut, which ends before its run did.
    pub(super) outcome: Option<Outcome>,
    /// Records that are in no text file.
    pub(super) dropped: u64,
    pub(super) inputs: Inputs<'a>,
    pub(super) received: Vec<Logged<'a>>,
    pub(super) sent: Vec<Logged<'a>>,
    /// Lines of `can.log`.
    pub(super) can_lines: usize,
    /// Samples and their lines.
    pub(super) samples: Vec<(Sample, &'a str)>,
    pub(super) steps: RecordedSteps<'a>,
}

/// A frame of `can.log` with its line.
#[derive(Debug, Clone, Copy)]
pub(super) struct Logged<'a> {
    /// From 1.
    pub(super) line: usize,
    pub(super) text: &'a str,
    pub(super) unix_us: i64,
    pub(super) interface: &'a str,
    pub(super) frame: Frame,
}

impl<'a> Recorded<'a> {
    /// The run that `plan` describes and `manifest` and `files` tell of.
    ///
    /// # Errors
    /// [`ReplayError`] where a file cannot be read.
    pub fn new(
        manifest: &Manifest,
        plan: impl Into<Plan>,
        files: Files<'a>,
    ) -> Result<Self, ReplayError> {
        let started_unix_us = unix_us_of(&manifest.started_utc)
            .ok_or_else(|| ReplayError::Started(manifest.started_utc.clone()))?;
        let (received, sent) = frames(files.can)?;
        let samples = whole_lines(files.tracker).zip(1..);
        let samples = samples.map(|(text, line)| Ok((ndjson::recorded(line, text)?, text)));
        let steps = RecordedSteps::parse(files.steps);
        // An older record lacks the columns that were added at the end since.
        let columns = steps.columns.join(",");
        if !(steps_csv_header() + ",").starts_with(&(columns.clone() + ",")) && !columns.is_empty()
        {
            return Err(ReplayError::Columns(columns));
        }
        Ok(Recorded {
            plan: plan.into(),
            started_unix_us,
            dropped: manifest.dropped.unwrap_or_default().text_files,
            outcome: outcome(manifest),
            inputs: Inputs::parse(files.inputs)?,
            can_lines: received.len() + sent.len(),
            received,
            sent,
            samples: samples.collect::<Result<_, ReplayError>>()?,
            steps,
        })
    }

    /// When `time` is in UTC, as `can.log` has it: µs since 1970.
    pub(super) fn unix_us(&self, time: Time) -> i64 {
        self.started_unix_us.saturating_add(time.as_nanos().div_euclid(1000))
    }

    /// The time of the last entry of the record, in whichever file.
    pub(super) fn end(&self) -> Time {
        let of_can = |logged: &Logged<'_>| {
            let us = logged.unix_us.saturating_sub(self.started_unix_us);
            Time::from_nanos(us.saturating_mul(1000))
        };
        let inputs = self.inputs.given().last().map_or(self.inputs.begun, |(time, _)| time);
        let frames = [&self.received, &self.sent].into_iter().filter_map(|way| way.last());
        let sample = self.samples.last().map(|(sample, _)| sample.receive_time);
        let step = self.steps.rows.last().and_then(|row| self.steps.time(row));
        frames.map(of_can).chain(sample).chain(step).fold(inputs, Time::max)
    }

    /// When frames that were made may have been left unsent, UTC µs: the bus failed, or the bench was
    /// held up.
    pub(super) fn unsent_unix_us(&self) -> Vec<i64> {
        let is_fault = |given: &Given| match given {
            Given::Input(Input::BusFault(_)) => true,
            Given::Input(Input::Stop(reason)) => reason.starts_with(HELD_UP),
            _ => false,
        };
        let faults = self.inputs.given().filter(|(_, given)| is_fault(given));
        faults.map(|(time, _)| self.unix_us(time)).collect()
    }
}

/// How the run ended, where its record holds it to its end: one that was closed afterwards, or
/// whose writer failed, does not.
fn outcome(manifest: &Manifest) -> Option<Outcome> {
    let is_whole = manifest.repaired_utc.is_none() && manifest.counts.is_some();
    manifest.outcome.filter(|_| is_whole).map(|outcome| match outcome {
        RunOutcome::Completed => Outcome::Completed,
        RunOutcome::Stopped => Outcome::Stopped(manifest.stop_reason.clone().unwrap_or_default()),
    })
}

type FramesByWay<'a> = (Vec<Logged<'a>>, Vec<Logged<'a>>);

/// The frames received and those sent.
fn frames(log: &str) -> Result<FramesByWay<'_>, ReplayError> {
    let (mut received, mut sent) = FramesByWay::default();
    for (text, line) in whole_lines(log).zip(1..) {
        let wrong = || ReplayError::Frame { line, text: text.to_owned() };
        let LoggedFrame { unix_us, interface, direction, frame } =
            LoggedFrame::parse(text).ok_or_else(wrong)?;
        let logged = Logged { line, text, unix_us, interface, frame };
        match direction {
            Direction::Received => received.push(logged),
            Direction::Sent => sent.push(logged),
        }
    }
    Ok((received, sent))
}
