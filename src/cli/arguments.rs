//! Arguments that several commands share, and the configuration that they name.

use super::output::print_stderr;
use super::{Failure, Result};
use crate::config::{Config, SEED_MAX, Source};
use crate::runtime::{RealTime, enter_real_time};
use clap::Args;
use std::fs::File;
use std::io::Read as _;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::thread;

/// The arguments that name a command's configuration: a file, as the first argument or by `--config`, and keys
/// that override it.
#[derive(Debug, Clone, Default, Args)]
pub(super) struct Configured {
    /// Configuration (TOML); each key that it leaves out is as in bench-config/virtual.toml.
    #[arg(value_name = "CONFIG", conflicts_with = "named")]
    config: Option<PathBuf>,
    /// The configuration, by name.
    #[arg(long = "config", value_name = "CONFIG")]
    named: Option<PathBuf>,
    /// Set a key of the configuration, for example 'insertion.depth_mm=200'.
    #[arg(long, value_name = "KEY=VALUE")]
    pub(super) set: Vec<String>,
}

impl Configured {
    /// The configuration in the file `path`, overridden by the keys `set`.
    pub(super) fn new(path: Option<&Path>, set: Vec<String>) -> Self {
        Configured { config: path.map(Path::to_owned), named: None, set }
    }

    /// The file, if one is named.
    pub(super) fn path(&self) -> Option<&Path> {
        self.config.as_deref().or(self.named.as_deref())
    }

    /// True if a file or a key is given.
    pub(super) fn is_given(&self) -> bool {
        self.path().is_some() || !self.set.is_empty()
    }

    /// The file, if no key overrides it: then it is the whole configuration.
    pub(super) fn whole_path(&self) -> Option<&Path> {
        self.path().filter(|_| self.set.is_empty())
    }

    /// The same configuration; if `rehearse`, rehearsed on the emulated stage.
    pub(super) fn rehearsed(mut self, rehearse: bool) -> Self {
        self.set.extend(rehearse.then(|| "emulator.rehearse=true".to_owned()));
        self
    }

    /// Loads the configuration. If no file is named, loads the built-in `fallback` (name, text) or the defaults.
    pub(super) fn load(&self, fallback: Option<(&str, &str)>) -> Result<Config> {
        self.read(fallback).map(|(config, _)| config)
    }

    /// Loads the configuration and its warnings, and prints the warnings.
    pub(super) fn load_with_warnings(&self) -> Result<(Config, Vec<String>)> {
        let (config, warnings) = self.read(None)?;
        for warning in &warnings {
            print_stderr(format_args!("warning: {warning}"));
        }
        Ok((config, warnings))
    }

    /// `config`, which these arguments gave, as a record or another folder needs it: each mask with its absolute
    /// path and, if `crc32` computes one, its checksum. Without a file, the path of a mask is relative to the working
    /// directory.
    pub(super) fn completed(
        &self,
        config: &Config,
        crc32: impl Fn(&Path) -> Option<u32>,
    ) -> Config {
        let file = self.path().unwrap_or(Path::new("command-line"));
        let file = std::path::absolute(file).unwrap_or_else(|_| file.to_owned());
        config.recorded_beside(&file, crc32)
    }

    fn read(&self, fallback: Option<(&str, &str)>) -> Result<(Config, Vec<String>)> {
        let source = match self.path() {
            Some(path) => Some((path.display().to_string(), text_of(path)?)),
            None => fallback.map(|(name, text)| (name.to_owned(), text.to_owned())),
        };
        let source = source.as_ref().map(|(name, text)| Source { name, text });
        let read_calibration =
            |path: &Path| read_text(path).map_err(|error| format!("{} {error}", path.display()));
        Ok(Config::with_warnings(source.as_slice(), &self.set, &read_calibration)?)
    }
}

/// The text of a file that the arguments name.
pub(super) fn text_of(path: &Path) -> Result<String> {
    read_text(path).map_err(|error| Failure::bad_input(path, error))
}

/// Largest file that the arguments may name, bytes: about an hour of a tracker at 250 Hz.
const TEXT_MAX: u64 = 300_000_000;

/// The text of the file `path`, or why it cannot be read.
fn read_text(path: &Path) -> Result<String, String> {
    if path.is_dir() {
        return Err("cannot be read: it is a folder; name a file in it".to_owned());
    }
    let mut bytes = Vec::new();
    let read = File::open(path).and_then(|file| file.take(TEXT_MAX + 1).read_to_end(&mut bytes));
    read.map_err(|error| format!("cannot be read: {error}"))?;
    if bytes.len() as u64 > TEXT_MAX {
        let mb = TEXT_MAX / 1_000_000;
        return Err(format!("has more than {mb} MB: is it the file that was meant? or cut it up"));
    }
    let valid_len = std::str::from_utf8(&bytes).map_or_else(|error| error.valid_up_to(), str::len);
    // A text file has no zero byte, although UTF-8 allows it.
    let zero = bytes[..valid_len].iter().position(|byte| *byte == 0);
    let end = zero.unwrap_or(valid_len);
    match bytes.get(end) {
        None => Ok(String::from_utf8_lossy(&bytes).into_owned()),
        Some(byte) => Err(format!(
            "cannot be read: not a text file (byte {} is {byte:#04x}); name a text file",
            end + 1
        )),
    }
}

/// The operator's notes on a run, for its record.
#[derive(Debug, Clone, Default, Args)]
pub(super) struct About {
    /// Who runs it, for the record; by default record.operator of the configuration.
    #[arg(long, value_name = "NAME")]
    pub(super) operator: Option<String>,
    /// What the needle is inserted into, for the record; by default record.phantom.
    #[arg(long, value_name = "TEXT")]
    pub(super) phantom: Option<String>,
    /// A note on this run, for the record.
    #[arg(long, value_name = "TEXT")]
    pub(super) note: Option<String>,
}

/// `--realtime` and `--cpu`, of every command that moves the stage.
#[derive(Debug, Default, Clone, Copy, Args)]
pub(super) struct RealTimeArguments {
    /// Give the SYNC thread a real-time priority (SCHED_FIFO) and a processor of its own, and
    /// lock all memory; refused where this process has no right to.
    #[arg(long, global = true)]
    realtime: bool,
    /// The processor of the SYNC thread, by default the last one that this process may use.
    #[arg(long, value_name = "NUMBER", requires = "realtime", global = true)]
    cpu: Option<usize>,
}

impl RealTimeArguments {
    /// Refuses `--realtime`, if it was given, for the reason `why`.
    pub(super) fn refuse_if_given(self, why: &str) -> Result<()> {
        match self.realtime {
            false => Ok(()),
            true => Err(Failure::configuration(format_args!("--realtime: {why}"))),
        }
    }

    /// Checks that this process may take real-time priority. Tries it on a thread that then ends: threads created
    /// later must not inherit the priority.
    pub(super) fn check_permission(self) -> Result<()> {
        let tried = thread::spawn(move || self.enter()).join();
        tried.map_err(|_| Failure::environment("--realtime: the trial ended in a panic"))?.map(drop)
    }

    /// Calls `run`, which may [`enter`](Self::enter) real time, on a thread of its own: the priority ends with the
    /// thread. What comes after a run, and the threads that it starts, must not have the priority.
    pub(super) fn run_isolated<T: Send>(self, run: impl FnOnce() -> T + Send) -> T {
        if !self.realtime {
            return run();
        }
        let result = thread::scope(|scope| scope.spawn(run).join());
        result.unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    }

    /// Gives this thread, the SYNC thread, its real-time priority if asked. Call it after all other
    /// threads have started.
    pub(super) fn enter(self) -> Result<Option<RealTime>> {
        let entered = self.realtime.then(|| enter_real_time(self.cpu)).transpose();
        entered.map_err(Failure::environment)
    }
}

/// A parser of numbers in `range`, for clap.
pub(super) fn number_in(
    range: RangeInclusive<f64>,
    unit: &'static str,
) -> impl Fn(&str) -> Result<f64, String> + Clone {
    move |text| match text.parse() {
        Ok(number) if range.contains(&number) => Ok(number),
        _ => Err(format!("{} to {} {unit}", range.start(), range.end())),
    }
}

/// Parses a seed, for clap.
pub(super) fn parse_seed(text: &str) -> Result<u64, String> {
    let seed = text.parse().ok().filter(|seed| *seed <= SEED_MAX);
    seed.ok_or_else(|| format!("a whole number from 0 to {SEED_MAX}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The priority ends with the thread.
    #[test]
    fn a_real_time_run_has_a_thread_of_its_own() {
        let ran_on = |realtime| {
            RealTimeArguments { realtime, cpu: None }.run_isolated(|| thread::current().id())
        };
        let this = thread::current().id();
        assert_ne!(ran_on(true), this);
        assert_eq!(ran_on(false), this);
    }
}
