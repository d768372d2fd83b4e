//! `needle-bench tracker record`: the positions of the configured tool, in a file.

use super::listen;
use crate::archive::tracker_line;
use crate::cli::arguments::{Configured, number_in};
use crate::cli::calibrate::tracker::{POSITION, QUATERNION, RECEIVED, STAMP};
use crate::cli::output::{print_stderr, refuse_unwritable};
use crate::cli::{Failure, Result};
use crate::session::SampleRecord;
use crate::tracker::Sample;
use crate::units::Time;
use clap::Args;
use std::ffi::OsStr;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

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
struct SampleFile {
    out: BufWriter<File>,
    is_csv: bool,
    flushed: Time,
}

impl SampleFile {
    /// A new file, begun at `now`.
    fn create(path: &Path, is_csv: bool, now: Time) -> io::Result<Self> {
        let mut out = BufWriter::new(File::create_new(path)?);
        if is_csv {
            let names = [&[RECEIVED, STAMP], &POSITION[..], &QUATERNION].concat();
            writeln!(out, "{}", names.join(","))?;
        }
        Ok(SampleFile { out, is_csv, flushed: now })
    }

    fn take(&mut self, sample: &Sample) -> io::Result<()> {
        let line = match self.is_csv {
            false => tracker_line(&SampleRecord::received(sample.clone()))?,
            true => {
                let stamp = sample.source_unix_ns.unwrap_or(0);
                let times = [sample.receive_time.as_nanos(), stamp].map(|ns| ns.to_string());
                let position = sample.position_mm.iter().map(f64::to_string);
                // Empty if this sample has no orientation.
                let quaternion = match sample.orientation {
                    Some(q) => [q.w, q.i, q.j, q.k].map(|part| part.to_string()),
                    None => Default::default(),
                };
                let cells = times.into_iter().chain(position).chain(quaternion);
                cells.collect::<Vec<_>>().join(",")
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

pub(super) fn record(arguments: &RecordArguments) -> Result<()> {
    let path = &arguments.file;
    let is_csv = path.extension().is_some_and(|ending| ending == "csv");
    refuse_unwritable(Some(path))?;
    let mut listener = listen(&arguments.configured, false)?;
    let gate = listener.config.tracker.to_unregistered_gate();
    let (mut recording, mut written, mut invalid) = (None, 0u64, 0u64);
    let failed = |error: io::Error, written: u64| {
        Failure::environment(format_args!(
            "{}: recording failed after {written} samples: {error}; make room, or name a file elsewhere",
            path.display()
        ))
    };
    listener.for_each_sample(arguments.seconds, |sample| {
        let is_valid = gate.check_content(sample).is_ok();
        invalid += u64::from(!is_valid);
        if is_csv && !is_valid {
            return Ok(());
        }
        let taken = match &mut recording {
            Some(recording) => SampleFile::take(recording, sample),
            None => SampleFile::create(path, is_csv, sample.receive_time)
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::tracker::watch::tests::sample;

    /// A tracker may send an orientation with some positions only.
    #[test]
    fn an_orientation_that_was_not_sent_is_not_recorded() {
        let path = std::env::temp_dir().join(format!("needle-record-{}.csv", std::process::id()));
        let turned = sample("");
        let without = Sample { orientation: None, ..turned.clone() };
        let mut recording = SampleFile::create(&path, true, turned.receive_time).unwrap();
        recording.take(&without).unwrap();
        recording.take(&turned).unwrap();
        recording.out.flush().unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        std::fs::remove_file(&path).unwrap();
        let rows: Vec<&str> = text.lines().skip(1).collect();
        assert_eq!(rows, ["5,0,1,2,3,,,,", "5,0,1,2,3,1,0,0,0"]);
    }
}
