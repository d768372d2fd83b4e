//! Recorded runs: their folders, their plans, and the insertions in them.

use super::arguments::{Configured, text_of};
use super::mask::{mask_reader, no_warning};
use super::output::print_stderr;
use super::perform::scene;
use super::stage::Motion;
use super::{Failure, Result};
use crate::archive::{Dropped, Manifest, TrackerTimes, file, proof, unix_us_of};
use crate::config::{CanInterface, Config, GoalKind, Source};
use crate::operation::RunConfig;
use crate::preflight::Earlier;
use crate::review::{differences, keys, parse_frame, positions_at_sync};
use crate::runtime::{Describe, RecordedRun};
use crate::stage::SetPoint;
use crate::study::{RecordedRow, Recording};
use crate::telemetry::RunFolder;
use crate::text::shell_word;
use crate::tracker::{Registration, Sample, check_recorded, ndjson};
use crate::units::Time;
use clap::Args;
use std::io;
use std::path::{Path, PathBuf};

/// The default of `record.dir`.
pub(super) const RUNS: &str = "runs";

/// The default configuration of recorded insertions: the needle and the sensor's mount of the public
/// recordings.
const RECORDINGS_TOML: (&str, &str) =
    ("bench-config/recordings.toml", include_str!("../../bench-config/recordings.toml"));

/// Smallest distance between two rows of a run, mm: a hold gives one row, and 40 positions a second at 2 mm/s are
/// all used.
const ROWS_APART_MM: f64 = 0.04;

/// The runs in `dir`, the newest first by their manifests: a folder may be a copy, or renamed.
pub(super) fn newest_first(dir: &Path) -> impl Iterator<Item = RunFolder> + use<> {
    let folders = folders_in(dir).unwrap_or_default().into_iter();
    let mut runs: Vec<RunFolder> = folders.filter_map(|it| RunFolder::open(&it).ok()).collect();
    // The folders are sorted by name, and this sort keeps that order of runs that started at the same time.
    runs.sort_by(|a, b| a.manifest.started_utc.cmp(&b.manifest.started_utc));
    runs.into_iter().rev()
}

/// The folders in `dir`, by name.
pub(super) fn folders_in(dir: &Path) -> io::Result<Vec<PathBuf>> {
    let paths = dir.read_dir()?.map(|entry| entry.map(|entry| entry.path()));
    let mut folders = paths.collect::<io::Result<Vec<_>>>()?;
    folders.retain(|path| path.is_dir());
    folders.sort();
    Ok(folders)
}

/// A line that names the newest run on a bus (not on the emulated stage in memory): `command`, then `--config` and
/// the file of that run. Empty without such a run.
pub(super) fn last_run_on_a_bus(command: &str) -> String {
    let memory = CanInterface::Memory.to_string();
    newest_first(Path::new(RUNS))
        .filter(|run| run.manifest.bus != memory)
        .map(|run| run.dir.join(file::CONFIG))
        .find(|config| config.is_file())
        .map_or(String::new(), |config| {
            format!("\nthe last run on a bus: {command}--config {}", shell_word(config.display()))
        })
}

/// The newest run on the bus of `config` that `is_wanted`, and those keys changed since then that
/// `is_compared` selects.
pub(super) fn earlier_run(
    config: &Config,
    is_wanted: impl Fn(&Manifest) -> bool,
    is_compared: impl Fn(&str) -> bool,
) -> Option<Earlier> {
    let bus = config.bus().to_string();
    let mut runs = newest_first(Path::new(&config.record.dir));
    let run = runs.find(|run| run.manifest.bus == bus && is_wanted(&run.manifest))?;
    let before = keys(&run.text(file::CONFIG).ok()?).ok()?;
    let now = keys(&config.to_toml().ok()?).ok()?;
    let changed = differences(&before, &now).into_keys();
    Some(Earlier {
        started_utc: run.manifest.started_utc.clone(),
        proof: run.text(file::EVENTS).ok().and_then(|events| proof(&events)),
        changed: changed.filter(|key| is_compared(key)).collect(),
    })
}

/// Opens the record of a run in the folder `path`, and its configuration. Refuses a record that was changed.
pub(super) fn open(path: &Path) -> Result<(RunFolder, Config)> {
    let folder = RunFolder::open(path)?;
    folder.verify()?;
    let text = folder.text(file::CONFIG)?;
    let source = Source { name: file::CONFIG, text: &text };
    Ok((folder, Config::from_sources(&[source], &[])?))
}

/// The plan, scene and configuration of a run of `config`, which `make_recording` needs beside the record.
pub(super) fn describe(config: Config) -> Describe {
    Box::new(move |manifest| {
        let run_config =
            recorded_run_config(manifest, &config).map_err(|failure| failure.to_string())?;
        let scene = scene(&config, manifest.operation.is_some())?;
        Ok(RecordedRun { run_config, scene, config_toml: config.to_toml()? })
    })
}

/// The settings of the run of `manifest`, from its configuration and arguments.
pub(super) fn recorded_run_config(manifest: &Manifest, config: &Config) -> Result<RunConfig> {
    let Some(name) = &manifest.operation else {
        let session = config.session_reading(&mask_reader(None, no_warning))?;
        return Ok(RunConfig::Insertion(Box::new(session)));
    };
    // The record says `prove-handedness` for `prove --handedness`.
    let command = name.split('-').next().unwrap_or_default();
    let motion = Motion::of(&format!("{command} {}", manifest.arguments.join(" ")));
    let motion = motion.map_err(|_| {
        Failure::configuration(format_args!(
            "the record does not say what `stage {name}` was to do; replay it with the bench that \
             recorded it"
        ))
    })?;
    motion.plan(config)
}

/// What stage and tracker measured in a recorded run.
pub(super) struct RunMeasurements {
    folder: RunFolder,
    pub(super) config: Config,
    /// Where the stage was at each SYNC.
    pub(super) stage: Vec<(Time, SetPoint)>,
    /// What the tracker sent of the tip.
    pub(super) samples: Vec<RecordedSample>,
}

/// A sample of a recorded run.
pub(super) struct RecordedSample {
    /// Its line in the file, from 1.
    line: usize,
    /// When the tip was there, if the sample was accepted.
    acquisition_time: Option<Time>,
    pub(super) received: Sample,
}

/// Reads what stage and tracker measured in the run in the folder `path`, which any version may have recorded.
pub(super) fn read_run(path: &Path) -> Result<RunMeasurements> {
    let (folder, config) = open(path)?;
    if let Some(Dropped { text_files: dropped @ 1.., .. }) = folder.manifest.dropped {
        let why = format!("{dropped} records were dropped while it was recorded, so it has gaps");
        return Err(Failure::bad_input(path, why));
    }
    let started_utc = &folder.manifest.started_utc;
    let started_us = unix_us_of(started_utc).ok_or_else(|| {
        Failure::bad_input(path, format_args!("{}: {started_utc:?} is no time", file::MANIFEST))
    })?;
    let lines = |name: &str| {
        let failed = |error: io::Error| match error.kind() {
            io::ErrorKind::NotFound => Failure::bad_input(&path.join(name), error),
            _ => Failure::io(&path.join(name), error),
        };
        folder.lines(name).and_then(Iterator::collect::<io::Result<Vec<_>>>).map_err(failed)
    };
    let (frames, samples) = (lines(file::CAN)?, lines(file::TRACKER)?);
    let frames = frames.iter().filter_map(|line| parse_frame(line));
    let stage = positions_at_sync(frames, started_us, &config.to_stage()?);
    let target = config.goal.tool.as_deref().filter(|_| config.goal.kind == GoalKind::Target);
    let sample = |(line, text): (usize, &String)| {
        let times = TrackerTimes::parse(text)?;
        (!target.is_some_and(|tool| times.is_of(tool))).then_some(RecordedSample {
            line,
            acquisition_time: times.acquisition_time_ns.map(Time::from_nanos),
            received: ndjson::recorded(line as u64, text).ok()?,
        })
    };
    let samples = (1..).zip(&samples).filter_map(sample).collect();
    Ok(RunMeasurements { folder, config, stage, samples })
}

/// Where the stage was at `time`, interpolated between two SYNCs; `None` before the first and after the last.
pub(super) fn position_at(stage: &[(Time, SetPoint)], time: Time) -> Option<SetPoint> {
    let after = stage.partition_point(|(at, _)| *at <= time);
    let ((t0, a), (t1, b)) = (stage.get(after.checked_sub(1)?)?, stage.get(after)?);
    let part = time.seconds_after(*t0) / t1.seconds_after(*t0);
    Some(*a + (*b - *a) * part)
}

/// Recorded insertions, and the configuration to judge them by.
#[derive(Debug, Args)]
pub(super) struct Insertions {
    /// Recorded insertions: run folders, or CSV with insertion_mm,rotation_rad,x_mm,y_mm,z_mm,qw,qx,qy,qz
    /// (`evaluate` does without orientations, `calibrate` needs three insertions). A TOML file among them is
    /// the configuration.
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Needle, observers, noises and sensor mount; by default bench-config/recordings.toml.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Set a key of the configuration, for example 'needle.curvature_per_mm=0.012'.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

/// One recorded insertion.
pub(super) struct Insertion {
    pub(super) path: PathBuf,
    /// The text that it was read from.
    pub(super) text: String,
    pub(super) recording: Recording,
    /// The record of a rehearsal, on emulated drives with an emulated tracker.
    pub(super) is_rehearsal: bool,
}

impl Insertions {
    /// Reads the configuration, with the key `extra_key` over it, and the insertions. Refuses an insertion that is
    /// named twice, and one whose tip does not travel as far as the needle is inserted.
    pub(super) fn read(&self, extra_key: Option<String>) -> Result<(Config, Vec<Insertion>)> {
        let (configuration, files) = self.split_files()?;
        let set = self.set.iter().cloned().chain(extra_key).collect();
        let config = Configured::new(configuration, set);
        let config = config.load(Some(RECORDINGS_TOML))?;
        let mut insertions: Vec<Insertion> = Vec::new();
        for &path in &files {
            let insertion = read_insertion(path)?;
            let rows = insertion.recording.rows.iter();
            let rows: Vec<_> =
                rows.map(|row| (row.insertion_meas_mm, row.position_meas_mm)).collect();
            check_recorded(&rows).map_err(|error| Failure::bad_input(path, error))?;
            let is_same = |other: &&Insertion| other.recording.is_same(&insertion.recording);
            if let Some(first) = insertions.iter().find(is_same) {
                let first = first.path.display();
                let error =
                    format!("the same recording as {first}: it would count twice, give each once");
                return Err(Failure::bad_input(path, error));
            }
            insertions.push(insertion);
        }
        if let (None, Some(run)) = (configuration, files.iter().find(|path| path.is_dir())) {
            print_stderr(format_args!(
                "warning: judged with the needle, noises and mount of bench-config/recordings.toml; for those of \
                 the run itself: --config {}",
                run.join(file::CONFIG).display()
            ));
        }
        if config.tracker.tip_offset_mm != [0.0; 3] && !files.iter().all(|path| path.is_dir()) {
            print_stderr(
                "warning: positions in a CSV file are taken as the tip's: tracker.tip_offset_mm is not added",
            );
        }
        Ok((config, insertions))
    }

    /// The configuration, named by `--config` or as the TOML file among the files; and the other files.
    fn split_files(&self) -> Result<(Option<&Path>, Vec<&Path>)> {
        let is_toml = |file: &&Path| file.extension().is_some_and(|ending| ending == "toml");
        let (mut configurations, files): (Vec<_>, Vec<_>) =
            self.files.iter().map(PathBuf::as_path).partition(is_toml);
        configurations.splice(0..0, self.config.as_deref());
        match configurations[..] {
            [first, second, ..] => Err(Failure::configuration(format_args!(
                "two configurations, {} and {}: give one",
                first.display(),
                second.display()
            ))),
            _ if files.is_empty() => Err(Failure::configuration(
                "no recorded insertion is named: give run folders or CSV files",
            )),
            _ => Ok((configurations.first().copied(), files)),
        }
    }
}

/// Reads the insertion in `path`, a CSV file or a run folder.
fn read_insertion(path: &Path) -> Result<Insertion> {
    if !path.is_dir() {
        let text = text_of(path)?;
        let recording = Recording::parse(&text).map_err(|error| Failure::bad_input(path, error))?;
        return Ok(Insertion { path: path.to_owned(), text, recording, is_rehearsal: false });
    }
    let RunMeasurements { folder, config, stage, samples } = read_run(path)?;
    let rows = rows(&stage, &config.tracker.to_registration()?, samples);
    if rows.is_empty() {
        let why = "no position was accepted while the needle was inserted";
        return Err(Failure::bad_input(path, why));
    }
    Ok(Insertion {
        path: path.to_owned(),
        text: folder.text(file::TRACKER)?,
        recording: Recording { rows },
        is_rehearsal: folder.manifest.rehearsal.is_some(),
    })
}

/// Rows of the tip on the bench and of the stage at that time. An accepted sample gives a row only if the needle
/// is deeper by [`ROWS_APART_MM`] than at the row before.
fn rows(
    stage: &[(Time, SetPoint)],
    registration: &Registration,
    samples: Vec<RecordedSample>,
) -> Vec<RecordedRow> {
    let (mut rows, mut start_mm) = (Vec::<RecordedRow>::new(), None);
    for RecordedSample { line, acquisition_time, received } in samples {
        let Some(measured) = acquisition_time.and_then(|time| position_at(stage, time)) else {
            continue;
        };
        let start_mm = *start_mm.get_or_insert(measured.insertion_mm);
        let before_mm = rows.last().map_or(start_mm, |row| row.insertion_meas_mm);
        if rows.len() < 2 && measured.insertion_mm < start_mm + ROWS_APART_MM {
            // The tip may move while the bench waits: the insertion begins at its last position before the motion.
            rows.clear();
        } else if measured.insertion_mm < before_mm + ROWS_APART_MM {
            continue;
        }
        let Ok(position_meas_mm) = registration.tip_mm(&received) else { continue };
        rows.push(RecordedRow {
            line,
            insertion_meas_mm: measured.insertion_mm,
            rotation_meas_rad: measured.rotation_rad,
            position_meas_mm,
            sensor_orientation: registration.rotation(&received),
        });
    }
    rows
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
    use nalgebra::Vector3;

    /// Refused samples have lines in the file too, so a row's number is not its place among the rows.
    #[test]
    fn a_row_has_the_number_of_its_line() {
        let at = |s: f64, insertion_mm: f64| {
            (Time::from_secs_f64(s), SetPoint { insertion_mm, rotation_rad: 0.0 })
        };
        let receive_time = Time::from_secs_f64(1.0);
        let received = Sample { receive_time, ..Sample::valid("Tip", Vector3::zeros()) };
        let registration = Registration::new(Pose::identity());
        let sample = RecordedSample { line: 4, acquisition_time: Some(receive_time), received };
        let rows = rows(&[at(0.0, 0.0), at(2.0, 4.0)], &registration, vec![sample]);
        assert_eq!((rows[0].line, rows[0].insertion_meas_mm), (4, 2.0));
    }

    /// The tip is moved by 5 mm before the needle is inserted.
    #[test]
    fn an_insertion_begins_at_the_last_position_before_it() {
        let at = |s: f64, insertion_mm: f64| {
            (Time::from_secs_f64(s), SetPoint { insertion_mm, rotation_rad: 0.0 })
        };
        let stage = [at(0.0, 0.0), at(2.0, 0.0), at(3.0, 1.0)];
        let sample = |line: usize, s: f64, x_mm: f64| RecordedSample {
            line,
            acquisition_time: Some(Time::from_secs_f64(s)),
            received: Sample::valid("Tip", Vector3::x() * x_mm),
        };
        // Then a position each 0.03 mm.
        let begun = (3..=22).map(|n| sample(n, 2.0 + 0.03 * (n - 2) as f64, 5.0));
        let samples = [sample(1, 0.5, 0.0), sample(2, 1.5, 5.0)].into_iter().chain(begun);
        let rows = rows(&stage, &Registration::new(Pose::identity()), samples.collect());
        assert_eq!((rows[0].line, rows[0].position_meas_mm.x, rows.len()), (3, 5.0, 10));
    }

    #[test]
    fn a_toml_file_among_insertions_is_the_configuration() {
        let among = |files: &[&str], named: Option<&str>| {
            let files = files.iter().map(PathBuf::from).collect();
            let insertions = Insertions { files, config: named.map(PathBuf::from), set: vec![] };
            match insertions.split_files() {
                Ok((config, others)) => format!("{config:?} {others:?}"),
                Err(failure) => failure.to_string(),
            }
        };
        let both = r#"Some("rig.toml") ["a.csv", "runs/b"]"#;
        assert_eq!(among(&["a.csv", "rig.toml", "runs/b"], None), both);
        assert_eq!(among(&["a.csv", "runs/b"], Some("rig.toml")), both);
        assert_eq!(among(&["a.csv"], None), r#"None ["a.csv"]"#);
        let two = "two configurations, a.toml and b.toml: give one";
        assert_eq!(among(&["b.toml", "c.csv"], Some("a.toml")), two);
        assert!(among(&["a.toml"], None).starts_with("no recorded insertion is named"));
    }
}
