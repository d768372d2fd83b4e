//! `run.rrd`, made from a closed record: its inputs are given to the same session again, and what
//! leaves the session is logged, with the frames and events of the text files.

use super::sink::{Operator, RunReport};
use crate::archive::{CandumpLine, EventKind, EventLine, Lines, Manifest, file, unix_us_of};
use crate::operation::Plan;
use crate::replay::{Recorded, replay_to};
use crate::session::{Lane, Record, Severity, State};
use crate::telemetry::{Entry, Recording, RunFolder, Scene, TelemetryError, lock, note_recording};
use crate::units::Time;
use std::error::Error;
use std::fmt::Display;
use std::io::{self, ErrorKind};
use std::iter::Peekable;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::thread;
use std::time::Duration;

/// Time between two progress messages to the operator.
const TOLD_EVERY: Duration = Duration::from_secs(2);
/// The recording is given up after this many intervals without progress: the disk is stalled.
const GIVEN_UP_AFTER: u32 = 8;

/// What the recording of a run needs beside the record.
pub struct RecordedRun {
    /// What the run was to do.
    pub plan: Plan,
    /// What stands still.
    pub scene: Scene,
    /// The configuration as used.
    pub config_toml: String,
}

/// Says what the run of a manifest was.
pub type Describe = Box<dyn FnOnce(&Manifest) -> Result<RecordedRun, Box<dyn Error>> + Send>;

/// The fault of a `run.rrd` that was not made.
fn not_made(why: &dyn Display) -> Option<String> {
    Some(format!("{}: not made: {why}", file::RECORDING))
}

/// Completes the record of a run that has ended with its `run.rrd`.
pub fn complete_record(report: &mut RunReport, describe: Describe, operator: &mut dyn Operator) {
    let Ok(finished) = &mut report.record else { return };
    let end = report.end;
    let fault = make_recording(&finished.run_dir, describe, &mut |made| {
        let (made_s, end_s) = (made.as_secs_f64(), end.as_secs_f64());
        let text = format!("making run.rrd: {made_s:.0} s of {end_s:.0} s done");
        operator.event(end, Lane::Session, Severity::Info, &text);
    });
    finished.faults.extend(fault);
}

/// Makes `run.rrd` from the closed record in `dir`, and notes it in the manifest. Returns the fault if
/// it is not made or ends before the run. `tell` is called every two seconds with the run's time that
/// is reached.
pub fn make_recording(
    dir: &Path,
    describe: Describe,
    tell: &mut dyn FnMut(Time),
) -> Option<String> {
    let made = Arc::new(AtomicI64::new(0));
    let (done_tx, done) = channel();
    let (of_thread, path) = (Arc::clone(&made), dir.to_path_buf());
    // The thread is left behind when a stalled disk holds it for ever.
    let spawned = thread::Builder::new()
        .name("run-rrd".to_owned())
        .spawn(move || done_tx.send(make_and_note(&path, describe, &of_thread)));
    if let Err(error) = spawned {
        return not_made(&error);
    }
    let (mut before, mut without_progress) = (0, 0);
    loop {
        match done.recv_timeout(TOLD_EVERY) {
            Ok(fault) => return fault,
            Err(RecvTimeoutError::Disconnected) => return not_made(&"its thread panicked"),
            Err(RecvTimeoutError::Timeout) => {}
        }
        let now = made.load(Ordering::Relaxed);
        without_progress = if now == before { without_progress + 1 } else { 0 };
        before = now;
        if without_progress == GIVEN_UP_AFTER {
            let limit_s = (TOLD_EVERY * GIVEN_UP_AFTER).as_secs();
            return not_made(&format!("no progress for {limit_s} s; is the disk stalled?"));
        }
        tell(Time::from_nanos(now));
    }
}

fn make_and_note(dir: &Path, describe: Describe, made: &AtomicI64) -> Option<String> {
    let _lock = match lock(dir) {
        Ok(Some(lock)) => lock,
        Ok(None) => return not_made(&"another program has this record in hand"),
        Err(error) => return not_made(&error),
    };
    let fault = match make_from_text_files(dir, describe, made) {
        Ok(None) => None,
        Ok(Some(why)) => Some(format!("{} ends before the run: {why}", file::RECORDING)),
        Err(error) => not_made(&error),
    };
    match note_recording(dir, fault.clone()) {
        Ok(()) => fault,
        Err(error) => fault.or(Some(error.to_string())),
    }
}

/// Why the recording ends before the run, where it does.
fn make_from_text_files(
    dir: &Path,
    describe: Describe,
    made: &AtomicI64,
) -> Result<Option<String>, Box<dyn Error>> {
    let folder = RunFolder::open(dir)?;
    let manifest = folder.manifest();
    let open = |name: &str| match folder.lines(name) {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(Lines::new(io::empty())),
        opened => opened,
    };
    let RecordedRun { plan, scene, config_toml } = describe(manifest)?;
    let mut log = Log {
        made,
        recording: Recording::create(dir, manifest, &config_toml, &scene)?,
        failed: None,
        frames: frames(open(file::CAN)?, manifest).peekable(),
        events: events(open(file::EVENTS)?).peekable(),
    };
    let mut why = None;
    // Killed at once, a bench has given its session nothing.
    if open(file::INPUTS)?.next().is_some() {
        let recorded = Recorded { manifest, plan, open: &open };
        let replayed = replay_to(&recorded, None, &mut |record, truth| {
            if let Some(time) = time_of(&record) {
                log.text_until(time);
                log.take(time, Entry { record, truth });
            }
        });
        why = match replayed {
            Ok(replayed) => replayed.difference,
            Err(error) => Some(error.to_string()),
        };
    }
    log.text_until(Time::NEVER);
    match log.failed {
        Some(error) => return Err(error.into()),
        None => log.recording.finish()?,
    }
    Ok(why)
}

/// The recording, and what the text files hold for it: frames and events in their order.
struct Log<'a> {
    recording: Recording,
    /// The run's time that is reached, ns.
    made: &'a AtomicI64,
    failed: Option<TelemetryError>,
    frames: Peekable<TimedRecords>,
    events: Peekable<TimedRecords>,
}

/// The records of a text file, with their times.
type TimedRecords = Box<dyn Iterator<Item = (Time, Record)>>;

impl Log<'_> {
    fn take(&mut self, time: Time, entry: Entry) {
        self.made.fetch_max(time.as_nanos(), Ordering::Relaxed);
        if self.failed.is_none() {
            self.failed = self.recording.take(entry).err();
        }
    }

    /// Logs the frames and events up to `time`.
    fn text_until(&mut self, time: Time) {
        loop {
            let times = [&mut self.frames, &mut self.events]
                .map(|lines| lines.peek().map_or(Time::NEVER, |(time, _)| *time));
            let lines = if times[1] <= times[0] { &mut self.events } else { &mut self.frames };
            let next = lines.next_if(|(line_time, _)| *line_time <= time);
            let Some((time, record)) = next else { return };
            self.take(time, Entry::from(record));
        }
    }
}

/// When `record` was; `None` for the records that the text files hold whole.
fn time_of(record: &Record) -> Option<Time> {
    match record {
        Record::Sample(sample) | Record::Target(sample) => Some(sample.received.receive_time),
        Record::Stage(stage) => Some(stage.time),
        Record::Step(step) => Some(step.time),
        Record::Drive { time, .. } => Some(*time),
        _ => None,
    }
}

/// The records of the lines of `can.log`.
fn frames(lines: Lines, manifest: &Manifest) -> TimedRecords {
    let started_unix_us = unix_us_of(&manifest.started_utc).unwrap_or_default();
    Box::new(lines.map_while(Result::ok).filter_map(move |line| {
        let line = CandumpLine::parse(&line)?;
        let (time, direction, frame) = (line.time(started_unix_us), line.direction, line.frame);
        Some((time, Record::Can { time, direction, frame }))
    }))
}

/// The records of the lines of `events.log`.
fn events(lines: Lines) -> TimedRecords {
    Box::new(lines.map_while(Result::ok).filter_map(|line| {
        let EventLine { time, lane, kind, text } = EventLine::parse(&line)?;
        let record = match kind {
            EventKind::State => Record::State { time, state: State::named(lane, &text)? },
            EventKind::Event(severity) => {
                Record::Event { time, lane, severity, text: text.into_owned() }
            }
        };
        Some((time, record))
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use crate::session::Outcome;
    use crate::telemetry::tests::{CONFIG_TOML, manifest, scene};
    use crate::telemetry::{Backpressure, Recorder};

    /// A run that was killed at once, or that does not replay: its frames and events take long as well, and
    /// must not be taken for a stalled disk.
    #[test]
    fn what_the_text_files_alone_hold_is_progress() {
        let parent = std::env::temp_dir().join(format!("needle-bench-made-{}", std::process::id()));
        let mut recorder =
            Recorder::create(&parent, manifest(), CONFIG_TOML.to_owned(), Backpressure::Block)
                .unwrap();
        let (time, text) = (Time::from_secs_f64(7.0), "late".to_owned());
        let (lane, severity) = (Lane::Session, Severity::Warning);
        recorder.record(Entry::from(Record::Event { time, lane, severity, text }));
        let finished = recorder.finish(|manifest| manifest.set_outcome(&Outcome::Completed));
        let made = AtomicI64::new(0);
        let describe: Describe = Box::new(|_| {
            let plan = Plan::from(Config::from_sources(&[], &[])?.session()?);
            Ok(RecordedRun { plan, scene: scene(), config_toml: CONFIG_TOML.to_owned() })
        });
        let why = make_from_text_files(&finished.unwrap().run_dir, describe, &made).unwrap();
        assert_eq!((why, made.load(Ordering::Relaxed)), (None, time.as_nanos()));
        std::fs::remove_dir_all(parent).unwrap();
    }
}
