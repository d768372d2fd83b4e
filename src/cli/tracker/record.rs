//! `needle-bench tracker record`: the tool's positions into a file.

use super::listen::listen;
use crate::archive::tracker_line;
use crate::cli::Failure;
use crate::cli::calibrate::tracker::{POSITION, QUATERNION, RECEIVED, STAMP};
use crate::cli::output::{number_in, tell};
use crate::cli::sources::Configured;
use crate::session::SampleRecord;
use crate::tracker::{Gate, Sample};
use crate::units::Time;
use clap::Args;
use std::fs::File;
use std::io::{self, BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

/// What was written reaches the disk's cache this often.
const FLUSH_PERIOD: Duration = Duration::from_secs(1);

#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// A new file: .csv for valid positions in the columns of `calibrate` and `evaluate` (the stage's
    /// rotation_rad and insertion_mm are not in it); .ndjson for every sample as it was received.
    #[arg(value_parser = file)]
    file: PathBuf,
    #[command(flatten)]
    configured: Configured,
    /// How long to record from the first sample on, s; by default until Ctrl-C.
    #[arg(long, value_name = "SECONDS", value_parser = number_in(0.1..=1e6, "seconds"))]
    seconds: Option<f64>,
}

fn file(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match form(&path) {
        Some(_) => Ok(path),
        None => Err("a name that ends in .csv or .ndjson".to_owned()),
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Form {
    Csv,
    Ndjson,
}

fn form(path: &Path) -> Option<Form> {
    match path.extension()?.to_str()? {
        "csv" => Some(Form::Csv),
        "ndjson" => Some(Form::Ndjson),
        _ => None,
    }
}

/// A recording under way.
struct Recording {
    out: BufWriter<File>,
    form: Form,
    has_orientation: bool,
    flushed: Time,
}

impl Recording {
    /// A new file that begins with `first`.
    fn create(path: &Path, form: Form, first: &Sample) -> io::Result<Self> {
        let mut out = BufWriter::new(File::create_new(path)?);
        let has_orientation = first.orientation.is_some();
        if form == Form::Csv {
            let orientation: &[&str] = if has_orientation { &QUATERNION } else { &[] };
            let columns = [&[RECEIVED, STAMP], &POSITION[..], orientation].concat();
            writeln!(out, "{}", columns.join(","))?;
        }
        Ok(Recording { out, form, has_orientation, flushed: first.receive_time })
    }

    fn take(&mut self, sample: &Sample) -> io::Result<()> {
        match self.form {
            Form::Ndjson => {
                let line = tracker_line(&SampleRecord::received(sample.clone()))?;
                writeln!(self.out, "{line}")?;
            }
            Form::Csv => {
                let position = sample.position_mm.iter().map(f64::to_string);
                let q = sample.orientation.unwrap_or_default();
                let orientation = [q.w, q.i, q.j, q.k].map(|part| part.to_string());
                let shown = if self.has_orientation { &orientation[..] } else { &[] };
                let cells: Vec<String> = [
                    sample.receive_time.as_nanos().to_string(),
                    sample.source_unix_ns.unwrap_or(0).to_string(),
                ]
                .into_iter()
                .chain(position)
                .chain(shown.iter().cloned())
                .collect();
                writeln!(self.out, "{}", cells.join(","))?;
            }
        }
        if sample.receive_time.since(self.flushed) >= FLUSH_PERIOD {
            self.flushed = sample.receive_time;
            self.out.flush()?;
        }
        Ok(())
    }
}

pub(super) fn record(arguments: &Arguments) -> Result<ExitCode, Failure> {
    let path = &arguments.file;
    let form = form(path).unwrap_or(Form::Ndjson);
    let exists = || Failure::in_file(path, "exists, and is not overwritten; name another file");
    if path.exists() {
        return Err(exists());
    }
    let mut listener = listen(&arguments.configured, false)?;
    let (mut recording, mut written, mut invalid) = (None, 0u64, 0u64);
    let failed = |error: io::Error, written: u64| match error.kind() {
        ErrorKind::AlreadyExists => exists(),
        _ => Failure::Environment(format!(
            "{}: recording failed after {written} samples: {error}; make room, or name a file elsewhere",
            path.display()
        )),
    };
    listener.samples(arguments.seconds, |sample| {
        let is_valid = Gate::is_measurement(sample);
        invalid += u64::from(!is_valid);
        if form == Form::Csv && !is_valid {
            return Ok(());
        }
        let recording = match &mut recording {
            Some(recording) => recording,
            none => none.insert(
                Recording::create(path, form, sample).map_err(|error| failed(error, written))?,
            ),
        };
        recording.take(sample).map_err(|error| failed(error, written))?;
        written += 1;
        Ok(())
    })?;
    if let Some(mut recording) = recording {
        recording.out.flush().map_err(|error| failed(error, written))?;
    }
    let left_out = match (form, invalid) {
        (_, 0) => String::new(),
        (Form::Csv, invalid) => format!("; {invalid} invalid ones are not in it"),
        (Form::Ndjson, invalid) => format!(", {invalid} of them invalid"),
    };
    let tool = &listener.config.tracker.tool;
    if written == 0 {
        return Err(Failure::Environment(format!(
            "tracker: all {invalid} samples of \"{tool}\" are invalid, and no file was written; is the tool \
             in view?"
        )));
    }
    tell(format_args!("tracker: {written} samples of \"{tool}\" in {}{left_out}", path.display()));
    Ok(ExitCode::SUCCESS)
}
