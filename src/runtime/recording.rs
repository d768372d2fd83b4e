//! Makes `run.rrd` from a closed record: replays the recorded inputs, and logs what the session records then,
//! with the frames and events of the text files.

use super::sink::{Operator, RunReport};
use crate::archive::{CandumpLine, EventKind, EventLine, Lines, Manifest, file, unix_us_of};
use crate::operation::RunConfig;
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

/// Interval between two progress messages to the operator.
const PROGRESS_PERIOD: Duration = Duration::from_secs(2);
/// After this many intervals without progress the disk counts as stalled, and the recording is given up.
const STALLED_PERIODS_MAX: u32 = 8;

/// The data that the recording of a run needs besides the record.
pub struct RecordedRun {
    /// The configuration of the run.
    pub run_config: RunConfig,
    /// The static parts of the scene.
    pub scene: Scene,
    /// The configuration as used.
    pub config_toml: String,
}

/// Makes the [`RecordedRun`] of a manifest.
pub type Describe = Box<dyn FnOnce(&Manifest) -> Result<RecordedRun, Box<dyn Error>> + Send>;

/// The fault of a `run.rrd` that was not made.
fn not_made(why: &dyn Display) -> Option<String> {
    Some(format!("{}: not made: {why}", file::RECORDING))
}

/// Completes the record of a run that has ended with its `run.rrd`.
pub fn complete_record(report: &mut RunReport, describe: Describe, operator: &mut dyn Operator) {
    let (Ok(manifest), Some(run_dir)) = (&mut report.record, &report.run_dir) else { return };
    let end = report.end;
    let fault = make_recording(run_dir, describe, &mut |made| {
        let (made_s, end_s) = (made.as_secs_f64(), end.as_secs_f64());
        let text = format!("making run.rrd: {made_s:.0} s of {end_s:.0} s done");
        operator.event(end, Lane::Session, Severity::Info, &text);
    });
    manifest.faults.extend(fault);
}

/// Makes `run.rrd` from the closed record in `dir`, and notes it in the manifest. Returns the fault if
/// the recording is not made or not complete. `report_progress` is called every two seconds with the time of
/// the run that the recording has reached.
pub fn make_recording(
    dir: &Path,
    describe: Describe,
    report_progress: &mut dyn FnMut(Time),
) -> Option<String> {
    let reached_ns = Arc::new(AtomicI64::new(0));
    let (done_tx, done) = channel();
    let (reached_by_thread, path) = (Arc::clone(&reached_ns), dir.to_path_buf());
    // If a stalled disk blocks the thread indefinitely, it is abandoned.
    let spawned = thread::Builder::new()
        .name("run-rrd".to_owned())
        .spawn(move || done_tx.send(make_and_note(&path, describe, &reached_by_thread)));
    if let Err(error) = spawned {
        return not_made(&error);
    }
    let (mut before_ns, mut stalled_periods) = (0, 0);
    loop {
        match done.recv_timeout(PROGRESS_PERIOD) {
            Ok(fault) => return fault,
            Err(RecvTimeoutError::Disconnected) => return not_made(&"its thread panicked"),
            Err(RecvTimeoutError::Timeout) => {}
        }
        let now_ns = reached_ns.load(Ordering::Relaxed);
        stalled_periods = if now_ns == before_ns { stalled_periods + 1 } else { 0 };
        before_ns = now_ns;
        if stalled_periods == STALLED_PERIODS_MAX {
            let limit_s = (PROGRESS_PERIOD * STALLED_PERIODS_MAX).as_secs();
            return not_made(&format!("no progress for {limit_s} s; is the disk stalled?"));
        }
        report_progress(Time::from_nanos(now_ns));
    }
}

fn make_and_note(dir: &Path, describe: Describe, reached_ns: &AtomicI64) -> Option<String> {
    let _lock = match lock(dir) {
        Ok(Some(lock)) => lock,
        Ok(None) => return not_made(&"another program has this record in hand"),
        Err(error) => return not_made(&error),
    };
    let fault = match make_from_text_files(dir, describe, reached_ns) {
        Ok(fault) => fault,
        Err(error) => not_made(&error),
    };
    match note_recording(dir, fault.clone()) {
        Ok(()) => fault,
        Err(error) => fault.or(Some(error.to_string())),
    }
}

/// Makes the recording. Returns its fault if it is not complete.
fn make_from_text_files(
    dir: &Path,
    describe: Describe,
    reached_ns: &AtomicI64,
) -> Result<Option<String>, Box<dyn Error>> {
    let folder = RunFolder::open(dir)?;
    let manifest = &folder.manifest;
    let open = |name: &str| match folder.lines(name) {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(Lines::new(io::empty())),
        opened => opened,
    };
    let RecordedRun { run_config, scene, config_toml } = describe(manifest)?;
    let mut log = Log {
        reached_ns,
        recording: Recording::create(dir, manifest, &config_toml, &scene)?,
        failed: None,
        frames: frames(open(file::CAN)?, manifest),
        events: events(open(file::EVENTS)?),
    };
    // A bench that was killed at once has recorded nothing.
    let is_run = manifest.counts.is_some_and(|counts| counts.can_frames + counts.steps > 0);
    let mut difference = is_run.then(|| format!("{} has no inputs", file::INPUTS));
    if open(file::INPUTS)?.next().is_some() {
        let recorded = Recorded { manifest, run_config, open: &open };
        let replayed = replay_to(&recorded, None, &mut |record, truth| {
            if let Some(time) = time_of(&record) {
                log.text_until(time);
                log.take(time, Entry { record, truth });
            }
            // After a failed write, the rest of the replay would be useless.
            log.failed.as_ref().map_or(Ok(()), |error| Err(error.to_string()))
        });
        difference = match replayed {
            Ok(replayed) => replayed.difference,
            Err(error) => Some(error.to_string()),
        };
    }
    log.text_until(Time::NEVER);
    let unread = unread(&mut log.frames).or_else(|| unread(&mut log.events));
    match log.failed {
        Some(error) => return Err(error.into()),
        None => log.recording.finish()?,
    }
    let short = difference.map(|why| format!("{} ends before the run: {why}", file::RECORDING));
    Ok(short.or(unread))
}

/// The recording, and the frames and events of the text files that are to be logged to it.
struct Log<'a> {
    recording: Recording,
    /// The time of the run that the recording has reached, ns.
    reached_ns: &'a AtomicI64,
    failed: Option<TelemetryError>,
    frames: TimedRecords,
    events: TimedRecords,
}

impl Log<'_> {
    fn take(&mut self, time: Time, entry: Entry) {
        self.reached_ns.fetch_max(time.as_nanos(), Ordering::Relaxed);
        if self.failed.is_none() {
            self.failed = self.recording.take(entry).err();
        }
    }

    /// Logs the frames and events up to `time`.
    fn text_until(&mut self, time: Time) {
        loop {
            let events_first = next_time(&mut self.events) <= next_time(&mut self.frames);
            let earlier = if events_first { &mut self.events } else { &mut self.frames };
            if next_time(earlier) > time || self.failed.is_some() {
                return;
            }
            let Some(Ok((time, record))) = earlier.next_if(Result::is_ok) else { return };
            self.take(time, Entry { record, truth: None });
        }
    }
}

type TimedRecord = (Time, Record);

/// The records of a text file, in the order of the file. A line that cannot be read gives an error: the fault of a
/// recording that lacks this line and those after it.
type TimedRecords = Peekable<Box<dyn Iterator<Item = Result<TimedRecord, String>>>>;

/// The records in `lines` of `file`; `parse` gives none for a line without one.
fn timed_records(
    file: &'static str,
    lines: Lines,
    parse: impl Fn(&str) -> Option<TimedRecord> + 'static,
) -> TimedRecords {
    let fault = move |error| format!("{} lacks the rest of {file}: {error}", file::RECORDING);
    let records = lines.filter_map(move |line| match line {
        Ok(line) => parse(&line).map(Ok),
        Err(error) => Some(Err(fault(error))),
    });
    let records: Box<dyn Iterator<Item = _>> = Box::new(records);
    records.peekable()
}

/// The time of the next record; [`Time::NEVER`] at the end, or where it cannot be read.
fn next_time(records: &mut TimedRecords) -> Time {
    match records.peek() {
        Some(Ok((time, _))) => *time,
        _ => Time::NEVER,
    }
}

/// The fault of a recording without the rest of `records`, which cannot be read.
fn unread(records: &mut TimedRecords) -> Option<String> {
    records.peek()?.as_ref().err().cloned()
}

/// The time of `record`; `None` for a record that the text files hold completely.
fn time_of(record: &Record) -> Option<Time> {
    match record {
        Record::Sample(sample) | Record::Target(sample) => Some(sample.received.receive_time),
        Record::Stage(stage) => Some(stage.time),
        Record::Step(step) => Some(step.time),
        Record::Drive { time, .. } => Some(*time),
        _ => None,
    }
}

/// The records in `can.log`.
fn frames(lines: Lines, manifest: &Manifest) -> TimedRecords {
    let started_unix_us = unix_us_of(&manifest.started_utc).unwrap_or_default();
    timed_records(file::CAN, lines, move |line| {
        let line = CandumpLine::parse(line)?;
        let (time, direction, frame) = (line.time(started_unix_us), line.direction, line.frame);
        Some((time, Record::Can { time, direction, frame }))
    })
}

/// The records in `events.log`.
fn events(lines: Lines) -> TimedRecords {
    timed_records(file::EVENTS, lines, |line| {
        let EventLine { time, lane, kind, text } = EventLine::parse(line)?;
        let record = match kind {
            EventKind::State => Record::State { time, state: State::named(lane, &text)? },
            EventKind::Event(severity) => {
                Record::Event { time, lane, severity, text: text.into_owned() }
            }
        };
        Some((time, record))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use crate::session::Outcome;
    use crate::telemetry::tests::{CONFIG_TOML, Scratch, manifest, scene};
    use crate::telemetry::{Backpressure, Recorder};
    use std::path::PathBuf;

    /// A closed record with one event and no inputs, like that of a run that was killed at once; its run folder
    /// and the time of the event.
    fn record_of_one_event(name: &str) -> (Scratch, PathBuf, Time) {
        let scratch = Scratch::new(name);
        let mut recorder =
            Recorder::create(&scratch.0, manifest(), CONFIG_TOML.to_owned(), Backpressure::Block)
                .unwrap();
        let (time, text) = (Time::from_secs_f64(7.0), "late".to_owned());
        let (lane, severity) = (Lane::Session, Severity::Warning);
        let record = Record::Event { time, lane, severity, text };
        recorder.record(Entry { record, truth: None });
        let run_dir = recorder.run_dir.clone();
        recorder.finish(|manifest| manifest.set_outcome(&Outcome::Completed)).unwrap();
        (scratch, run_dir, time)
    }

    fn describe() -> Describe {
        Box::new(|_| {
            let run_config =
                RunConfig::Insertion(Box::new(Config::from_sources(&[], &[])?.session()?));
            Ok(RecordedRun { run_config, scene: scene(), config_toml: CONFIG_TOML.to_owned() })
        })
    }

    /// The frames and events of a run that does not replay take long too, which must not look like a stalled disk.
    #[test]
    fn events_of_a_run_without_inputs_count_as_progress() {
        let (_scratch, run_dir, time) = record_of_one_event("progress");
        let reached_ns = AtomicI64::new(0);
        let fault = make_from_text_files(&run_dir, describe(), &reached_ns).unwrap();
        assert_eq!((fault, reached_ns.load(Ordering::Relaxed)), (None, time.as_nanos()));
    }

    #[test]
    fn unreadable_lines_are_a_fault_of_the_recording() {
        let (_scratch, run_dir, _) = record_of_one_event("unreadable");
        let events = run_dir.join(file::EVENTS);
        std::fs::remove_file(&events).unwrap();
        // This file opens, and reading its first bytes fails, as from a bad sector.
        std::os::unix::fs::symlink("/proc/self/mem", &events).unwrap();
        let fault = make_from_text_files(&run_dir, describe(), &AtomicI64::new(0)).unwrap();
        let expected = "run.rrd lacks the rest of events.log: Input/output error (os error 5)";
        assert_eq!(fault.as_deref(), Some(expected));
    }
}
