//! `needle-bench tracker`: lists, watches, records and measures the tracker without a run.

use super::{Listener, listen, source_label};
use crate::archive::tracker_line;
use crate::cli::Failure;
use crate::cli::arguments::{Configured, number_in};
use crate::cli::calibrate::Output;
use crate::cli::calibrate::tracker::{
    POSITION, QUATERNION, RECEIVED, STAMP, fit_and_write, rest_sample,
};
use crate::cli::output::{has_no_reader, print_stderr, print_stdout, refuse_existing};
use crate::config::TrackerSection;
use crate::session::SampleRecord;
use crate::text::{clipped, table};
use crate::tracker::gate::is_same_tool;
use crate::tracker::{AcquisitionClock, Event, Gate, GateCounts, Refusal, Sample, Validity};
use crate::units::Time;
use clap::{Args, Subcommand};
use nalgebra::Vector3;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

#[derive(Debug, Subcommand)]
pub(in crate::cli) enum TrackerCommand {
    /// The tools that the tracker sends, with types and rates.
    List(ListArguments),
    /// One line a second: position, rate, age, refusals; until Ctrl-C.
    Watch(WatchArguments),
    /// Write the tool's positions to a file; until Ctrl-C.
    Record(RecordArguments),
    /// Measure the tracker's noise while the tool is at rest, as `calibrate tracker` does.
    Rest(RestArguments),
}

pub(in crate::cli) fn tracker(command: &TrackerCommand) -> Result<(), Failure> {
    match command {
        TrackerCommand::List(arguments) => list(arguments),
        TrackerCommand::Watch(arguments) => watch(arguments),
        TrackerCommand::Record(arguments) => record(arguments),
        TrackerCommand::Rest(arguments) => rest(arguments),
    }
}

/// Most tools that are listed: a peer with more is faulty or hostile.
const TOOLS_MAX: usize = 64;
/// Most characters of a name or a status that are shown.
const SHOWN_MAX: usize = 40;

#[derive(Debug, Args)]
pub(in crate::cli) struct ListArguments {
    #[command(flatten)]
    configured: Configured,
    /// How long to listen, s.
    #[arg(long, value_name = "SECONDS", default_value_t = 3.0, value_parser = number_in(0.1..=3600.0, "seconds"))]
    seconds: f64,
    /// One JSON object on stdout.
    #[arg(long)]
    json: bool,
}

/// One tool of the stream, and its samples so far.
#[derive(Default)]
struct Tool {
    message_type: Option<String>,
    samples: u64,
    valid: u64,
    /// When the first and the last sample came.
    received: Option<(Time, Time)>,
    /// The validity of the last invalid sample.
    status: Option<Validity>,
}

impl Tool {
    fn take(&mut self, sample: &Sample) {
        self.samples += 1;
        match &sample.validity {
            Validity::Valid => self.valid += 1,
            invalid => self.status = Some(invalid.clone()),
        }
        let now = sample.receive_time;
        self.received = Some((self.received.map_or(now, |(first, _)| first), now));
    }

    /// Samples a second; `None` for fewer than two.
    fn rate_hz(&self) -> Option<f64> {
        let seconds = self.received.map(|(first, last)| last.seconds_after(first))?;
        (seconds > 0.0).then(|| (self.samples - 1) as f64 / seconds)
    }

    fn row(&self, name: &str, is_configured: bool) -> Vec<String> {
        let (samples, invalid) = (self.samples, self.samples - self.valid);
        let status = match &self.status {
            None if samples == 0 => "no positions".to_owned(),
            None => "valid".to_owned(),
            Some(status) => {
                let status = status.to_string();
                format!("{invalid} of {samples} invalid: {}", clipped(&status, SHOWN_MAX))
            }
        };
        let missing = || "-".to_owned();
        vec![
            clipped(name, SHOWN_MAX).into_owned(),
            self.message_type.clone().unwrap_or_else(missing),
            samples.to_string(),
            self.rate_hz().map_or_else(missing, |hz| format!("{hz:.1} Hz")),
            status + if is_configured { ", tracker.tool" } else { "" },
        ]
    }

    fn json(&self, name: &str, is_configured: bool) -> Value {
        json!({
            "tool": name,
            "type": self.message_type,
            "samples": self.samples,
            "valid": self.valid,
            "rate_hz": self.rate_hz(),
            "status": self.status.as_ref().map(Validity::status),
            "is_configured": is_configured,
        })
    }
}

fn list(arguments: &ListArguments) -> Result<(), Failure> {
    let mut listener = listen(&arguments.configured, true)?;
    let until = listener.now() + Duration::from_secs_f64(arguments.seconds);
    let mut tools: BTreeMap<String, Tool> = BTreeMap::new();
    while let Some(event) = listener.next(until) {
        let name = match &event {
            Event::Sample(sample) => &sample.tool,
            Event::SawTool { tool, .. } => tool,
            _ => continue,
        };
        if tools.len() >= TOOLS_MAX && !tools.contains_key(name) {
            continue;
        }
        let tool = tools.entry(name.clone()).or_default();
        match event {
            Event::Sample(sample) => tool.take(&sample),
            Event::SawTool { message_type, .. } => tool.message_type = Some(message_type),
            _ => {}
        }
    }
    if tools.is_empty() {
        return Err(listener.no_samples());
    }
    let configured = &listener.config.tracker.tool;
    let is_configured = |name: &String| is_same_tool(name, configured);
    if arguments.json {
        let tools: Vec<Value> =
            tools.iter().map(|(name, tool)| tool.json(name, is_configured(name))).collect();
        print_stdout(json!({ "seconds": arguments.seconds, "tools": tools }))?;
    } else {
        let head = ["tool", "type", "samples", "rate", "status"].map(str::to_owned).to_vec();
        let rows = tools.iter().map(|(name, tool)| tool.row(name, is_configured(name)));
        let rows: Vec<Vec<String>> = std::iter::once(head).chain(rows).collect();
        print_stdout(table(&rows).join("\n"))?;
    }
    if !tools.keys().any(is_configured) {
        print_stderr(format_args!(
            "warning: none of them is tracker.tool = \"{configured}\"; set it"
        ));
    }
    Ok(())
}

const LINE_PERIOD: Duration = Duration::from_secs(1);

#[derive(Debug, Args)]
pub(in crate::cli) struct WatchArguments {
    #[command(flatten)]
    configured: Configured,
    /// How long to watch, s; by default until Ctrl-C.
    #[arg(long, value_name = "SECONDS", value_parser = number_in(0.1..=1e6, "seconds"))]
    seconds: Option<f64>,
}

/// The tool's samples, each judged by itself as in a run.
struct Watch {
    gate: Gate,
    /// The frame of the positions.
    frame: &'static str,
    clock: AcquisitionClock,
    counts: GateCounts,
    /// The last position, and when it was measured.
    last: Option<(Time, Vector3<f64>)>,
    /// How often that position has come in a row.
    repeats: u32,
    /// Why the newest sample or message was refused, since the last line.
    refusal: Option<String>,
    /// Messages that could not be read.
    malformed: u64,
    /// Accepted positions since the last line.
    positions: u64,
}

impl Watch {
    /// Positions are in the bench frame if the tracker is registered, else in the tracker's own frame.
    fn new(tracker: &TrackerSection) -> Self {
        let registered = tracker.to_gate().ok();
        let frame = if registered.is_some() { "bench" } else { "tracker, not registered" };
        let gate = registered.unwrap_or_else(|| tracker.to_unregistered_gate());
        Watch {
            gate,
            frame,
            clock: tracker.to_clock(),
            counts: GateCounts::default(),
            last: None,
            repeats: 0,
            refusal: None,
            malformed: 0,
            positions: 0,
        }
    }

    fn take(&mut self, event: &Event) {
        let sample = match event {
            Event::Connected { .. } => return self.clock.reconnected(),
            Event::Sample(sample) => sample,
            Event::Malformed(error) => {
                self.malformed += 1;
                self.refusal = Some(format!("a message cannot be read: {error}"));
                return;
            }
            _ => return,
        };
        let admitted = self.gate.admit(sample).and_then(|position_mm| {
            let time = self.clock.acquisition_time(sample)?;
            // A repeated value is not a new measurement, whatever its stamp.
            if self.last.is_some_and(|(_, last_mm)| last_mm == position_mm) {
                self.repeats += 1;
                return Err(Refusal::repeat(self.repeats));
            }
            self.repeats = 1;
            Ok((time, position_mm))
        });
        self.counts.count(admitted.as_ref().err());
        match admitted {
            Ok(position) => {
                self.last = Some(position);
                self.positions += 1;
            }
            Err(refusal) => self.refusal = Some(refusal.to_string()),
        }
    }

    /// The line at `now` for the last `seconds`.
    fn line(&mut self, now: Time, seconds: f64, listener: &mut Listener) -> String {
        self.position_line(now, seconds).unwrap_or_else(|| {
            let refusal = self.refusal.take().map(|refusal| format!("tracker: {refusal}"));
            let why = refusal.unwrap_or_else(|| listener.explain_missing());
            format!("{:7.1} s  {why}", now.as_secs_f64())
        })
    }

    /// The same, if there was a position.
    fn position_line(&mut self, now: Time, seconds: f64) -> Option<String> {
        let (time, p_mm) = self.last?;
        let at = now.as_secs_f64();
        let rate_hz = std::mem::take(&mut self.positions) as f64 / seconds;
        let refusal = self.refusal.take().map(|refusal| format!("; {refusal}")).unwrap_or_default();
        let malformed = match self.malformed {
            0 => String::new(),
            count => format!(", {count} not readable"),
        };
        Some(format!(
            "{at:7.1} s  x {:.2} y {:.2} z {:.2} mm ({})  {rate_hz:.1} Hz  age {:.3} s  {}{malformed}{refusal}",
            p_mm.x,
            p_mm.y,
            p_mm.z,
            self.frame,
            now.seconds_after(time),
            self.counts
        ))
    }
}

fn watch(arguments: &WatchArguments) -> Result<(), Failure> {
    let mut listener = listen(&arguments.configured, false)?;
    let mut watch = Watch::new(&listener.config.tracker);
    let start = listener.now();
    let end = arguments.seconds.map_or(Time::NEVER, |s| start + Duration::from_secs_f64(s));
    let mut last_line = start;
    while !listener.is_over() && listener.now() < end && !has_no_reader(&io::stdout()) {
        let due = (last_line + LINE_PERIOD).min(end);
        while let Some(event) = listener.next(due) {
            watch.take(&event);
        }
        let now = listener.now();
        if now >= due || watch.positions > 0 {
            print_stdout(watch.line(now, now.seconds_after(last_line).max(1e-3), &mut listener))?;
        }
        last_line = now;
    }
    if has_no_reader(&io::stdout()) {
        return Ok(());
    }
    watch.last.map(|_| ()).ok_or_else(|| listener.no_samples())
}

/// Interval between two flushes of a recording.
const FLUSH_PERIOD: Duration = Duration::from_secs(1);

#[derive(Debug, Args)]
pub(in crate::cli) struct RecordArguments {
    /// A new file: .csv for valid positions in the columns of `calibrate` and `evaluate` (the stage's
    /// rotation_rad and insertion_mm are not in it); .ndjson for every sample as it was received.
    #[arg(value_parser = recording_path)]
    file: PathBuf,
    #[command(flatten)]
    configured: Configured,
    /// How long to record from the first sample on, s; by default until Ctrl-C.
    #[arg(long, value_name = "SECONDS", value_parser = number_in(0.1..=1e6, "seconds"))]
    seconds: Option<f64>,
}

fn recording_path(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match path.extension().and_then(OsStr::to_str) {
        Some("csv" | "ndjson") => Ok(path),
        _ => Err("a name that ends in .csv or .ndjson".to_owned()),
    }
}

/// A recording in progress.
struct Recording {
    out: BufWriter<File>,
    /// The number of columns of a CSV file, with or without an orientation; `None` for NDJSON.
    columns: Option<usize>,
    flushed: Time,
}

impl Recording {
    /// A new file that begins with `first`.
    fn create(path: &Path, is_csv: bool, first: &Sample) -> io::Result<Self> {
        let mut out = BufWriter::new(File::create_new(path)?);
        let names = [&[RECEIVED, STAMP], &POSITION[..], &QUATERNION].concat();
        let missing = if first.orientation.is_some() { 0 } else { QUATERNION.len() };
        let columns = is_csv.then_some(names.len() - missing);
        if let Some(columns) = columns {
            writeln!(out, "{}", names[..columns].join(","))?;
        }
        Ok(Recording { out, columns, flushed: first.receive_time })
    }

    fn take(&mut self, sample: &Sample) -> io::Result<()> {
        let line = match self.columns {
            None => tracker_line(&SampleRecord::received(sample.clone()))?,
            Some(columns) => {
                let stamp = sample.source_unix_ns.unwrap_or(0);
                let times = [sample.receive_time.as_nanos(), stamp].map(|ns| ns.to_string());
                let position = sample.position_mm.iter().map(f64::to_string);
                // Empty if this sample has none: no orientation is made up.
                let quaternion = match sample.orientation {
                    Some(q) => [q.w, q.i, q.j, q.k].map(|part| part.to_string()),
                    None => Default::default(),
                };
                let cells = times.into_iter().chain(position).chain(quaternion);
                cells.take(columns).collect::<Vec<_>>().join(",")
            }
        };
        writeln!(self.out, "{line}")?;
        if sample.receive_time.since(self.flushed) >= FLUSH_PERIOD {
            self.flushed = sample.receive_time;
            self.out.flush()?;
        }
        Ok(())
    }
}

fn record(arguments: &RecordArguments) -> Result<(), Failure> {
    let path = &arguments.file;
    let is_csv = path.extension().is_some_and(|ending| ending == "csv");
    refuse_existing(Some(path))?;
    let mut listener = listen(&arguments.configured, false)?;
    let (mut recording, mut written, mut invalid) = (None, 0u64, 0u64);
    let failed = |error: io::Error, written: u64| {
        Failure::environment(format_args!(
            "{}: recording failed after {written} samples: {error}; make room, or name a file elsewhere",
            path.display()
        ))
    };
    listener.for_each_sample(arguments.seconds, |sample| {
        let is_valid = Gate::is_measurement(sample);
        invalid += u64::from(!is_valid);
        if is_csv && !is_valid {
            return Ok(());
        }
        let taken = match &mut recording {
            Some(recording) => Recording::take(recording, sample),
            None => Recording::create(path, is_csv, sample)
                .and_then(|new| recording.insert(new).take(sample)),
        };
        taken.map_err(|error| failed(error, written))?;
        written += 1;
        Ok(())
    })?;
    if let Some(mut recording) = recording {
        recording.out.flush().map_err(|error| failed(error, written))?;
    }
    let tool = &listener.config.tracker.tool;
    if written == 0 {
        return Err(Failure::environment(format_args!(
            "tracker: all {invalid} samples of \"{tool}\" are invalid, and no file was written; is the tool \
             in view?"
        )));
    }
    let left_out = match (is_csv, invalid) {
        (_, 0) => String::new(),
        (true, invalid) => format!("; {invalid} invalid ones were left out"),
        (false, invalid) => format!(", {invalid} of them invalid"),
    };
    print_stderr(format_args!(
        "tracker: {written} samples of \"{tool}\" in {}{left_out}",
        path.display()
    ));
    Ok(())
}

#[derive(Debug, Args)]
pub(in crate::cli) struct RestArguments {
    #[command(flatten)]
    configured: Configured,
    /// How long the tool rests, s; Ctrl-C ends it sooner.
    #[arg(long, value_name = "SECONDS", default_value_t = 60.0, value_parser = number_in(5.0..=3600.0, "seconds"))]
    seconds: f64,
    #[command(flatten)]
    output: Output,
}

fn rest(arguments: &RestArguments) -> Result<(), Failure> {
    arguments.output.refuse_existing()?;
    let mut listener = listen(&arguments.configured, false)?;
    let source = source_label(&listener.config);
    print_stderr(format_args!(
        "tracker: hold \"{}\" still for {} s",
        listener.config.tracker.tool, arguments.seconds
    ));
    let mut samples = Vec::new();
    listener.for_each_sample(Some(arguments.seconds), |sample| {
        samples.push(rest_sample(sample));
        Ok(())
    })?;
    fit_and_write(&samples, &source, None, &arguments.output)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    fn sample(tool: &str) -> Sample {
        Sample {
            receive_time: Time::from_nanos(5),
            source_unix_ns: None,
            tool: tool.to_owned(),
            position_mm: Vector3::new(1.0, 2.0, 3.0),
            orientation: Some(Default::default()),
            validity: Validity::Valid,
        }
    }

    #[test]
    fn a_position_that_is_repeated_is_counted() {
        let tracker = Config::from_sources(&[], &[]).unwrap().tracker;
        let mut watch = Watch::new(&tracker);
        watch.gate = tracker.to_unregistered_gate();
        for _ in 0..3 {
            watch.take(&Event::Sample(sample(&tracker.tool)));
        }
        assert_eq!((watch.positions, watch.counts.refused()), (1, 2));
        let why = watch.refusal.expect("repeats are refused");
        assert!(why.contains("to the bit, 3 in a row"), "{why}");
    }

    #[test]
    fn a_message_that_cannot_be_read_is_shown_beside_a_position() {
        let tracker = Config::from_sources(&[], &[]).unwrap().tracker;
        let mut watch = Watch::new(&tracker);
        watch.gate = tracker.to_unregistered_gate();
        watch.take(&Event::Sample(sample(&tracker.tool)));
        watch.take(&Event::Malformed("line 2: garbage".to_owned()));
        let line = watch.position_line(Time::from_nanos(5), 1.0).expect("a position was seen");
        let end =
            "1 accepted, 0 refused, 1 not readable; a message cannot be read: line 2: garbage";
        assert!(line.ends_with(end), "{line}");
    }

    /// A tracker may send an orientation with some positions only.
    #[test]
    fn an_orientation_that_was_not_sent_is_not_recorded() {
        let path = std::env::temp_dir().join(format!("needle-record-{}.csv", std::process::id()));
        let turned = sample("");
        let mut recording = Recording::create(&path, true, &turned).unwrap();
        recording.take(&turned).unwrap();
        recording.take(&Sample { orientation: None, ..turned }).unwrap();
        recording.out.flush().unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        std::fs::remove_file(&path).unwrap();
        let rows: Vec<&str> = text.lines().skip(1).collect();
        assert_eq!(rows, ["5,0,1,2,3,1,0,0,0", "5,0,1,2,3,,,,"]);
    }
}
