//! The configuration: TOML to validated types.
//!
//! Each key is declared once, by `keys::section`: its type, range, default and text, and whether
//! hardware must give it. A user's file is read by these declarations, and each `--set key=value`
//! replaces one of its keys. All errors are reported together.
//!
//! The sources are layers; a higher layer overrides a lower one key by key. From the lowest:
//! - the declared defaults;
//! - the preset that `emulator.tracker` names, and with `emulator.rehearse` the values that a rehearsal
//!   derives from the rest;
//! - the files, in order;
//! - each `--set`.
//!
//! `tracker.registration_file`, `tracker.tip_file` and `needle.needle_file` name files with calibrated values.
//! Their content counts as if it were written in place of that key; the configuration of a run folder has
//! the content and not the key. If a higher layer overrides a calibrated value, the record of the
//! calibration (`fit`) is dropped.
//!
//! Three things are not overridden key by key:
//! - of two alternatives (a radius and a curvature, `uniform_mm` and `sd_mm` of `emulator.noise`, `at_mm` and
//!   `at_s` of a fault) the one in a higher layer removes the one in a lower layer;
//! - `emulator.noise`, the counts per mm or turn and `tracker.registration` are replaced as a whole:
//!   `noise = {}` means none;
//! - a real rig does not get the defaults of the virtual one. With `stage.hardware = true` the drives'
//!   nodes, identities, scales, signs and limits have no defaults, and with any `tracker.source` but
//!   `"emulated"` there is no registration unless one is given.
//!
//! The name of a key ends with the unit of its value, which may be degrees or ms. A field that is declared `as`
//! another key is converted to mm, rad or s. This module reads no files: the caller passes their text.

mod assemble;
mod axis_checks;
mod can;
mod checks;
mod emulator;
mod error;
mod goal;
mod include;
mod needle;
mod observer;
mod reader;
mod record;
mod registration;
mod rehearsal;
mod stop;
mod study;
#[cfg(test)]
mod tests;
mod tracker;
mod value;
mod warnings;

pub use can::{CanConfig, CanInterface, Listen};
pub use emulator::{EmulatorConfig, SEED_MAX, TrackerPreset};
pub use error::{ConfigError, nearest_key};
pub use goal::{GoalConfig, GoalKind, ReadMask};
pub use include::ReadFile;
pub use needle::NeedleConfig;
pub use observer::{ObserverKind, ObserverSection};
pub use record::{CalibrationConfig, EvaluationConfig, OnFailure, RecordConfig};
pub use registration::RegistrationConfig;
pub use stop::StopConfig;
pub use study::StudyConfig;
pub use tracker::{TrackerMode, TrackerSection, TrackerSource};

use crate::control::ControlConfig;
use crate::geometry::Pose;
use crate::keys::{self, Field, Rule, section};
use crate::session::InsertionConfig;
use crate::stage::StageConfig;
use reader::{Reader, Tree};
use std::path::Path;
use toml::{Table, Value};
use value::Entries;

/// The default configuration, commented: what each key means.
#[cfg(test)]
pub(crate) const DEFAULT_TOML: &str = include_str!("../../bench-config/virtual.toml");

/// No displacement and no rotation, as a default.
const IDENTITY: &str =
    "{ x_mm = 0.0, y_mm = 0.0, z_mm = 0.0, yaw_deg = 0.0, pitch_deg = 0.0, roll_deg = 0.0 }";
/// The layer of presets and of a rehearsal's derived values: above the defaults, below the files.
const PRESET: usize = 1;

const HEAD: &str = "\
#:schema schema.json
# The reference of the configuration: every key with its meaning, its allowed values and its default.
# `needle-bench check --reference` prints it. `needle-bench run` with no arguments runs it: a virtual
# stage on an in-memory bus, an emulated needle and tracker, virtual time.
#
# Every key can be given on the command line as --set key=value with a TOML value, for example
#   needle-bench run --set insertion.depth_mm=200 --set 'observer.kind=\"finite-difference\"'
# A key that is not given has the value shown here. Unknown keys are refused.
";

/// The text of a configuration file.
#[derive(Debug, Clone, Copy)]
pub struct Source<'a> {
    /// The file's name, for errors.
    pub name: &'a str,
    /// Its text.
    pub text: &'a str,
}

section! {
    /// A whole configuration, every key of it checked.
    pub struct Config {
        /// Name of the run folder: `runs/<UTC>-<name>`.
        name: String [Rule::Text("1 to 64 letters, digits, '.', '_' or '-'", is_run_name)] = "virtual";
        /// Pose of the plane frame P in the bench frame W. The needle is steered into P's y-z plane, x = 0.
        plane: Pose => IDENTITY;
        /// Where the needle is steered: into the plane, or to a target around obstacles.
        goal: GoalConfig;
        /// How far the needle is inserted, and how.
        insertion: InsertionConfig;
        /// The bench's model of the needle.
        needle: NeedleConfig;
        /// The observers.
        observer: ObserverSection;
        /// The control law.
        control: ControlConfig;
        /// The bus, and the times of CANopen on it.
        can: CanConfig;
        /// The two drives.
        stage: StageConfig;
        /// Where tip positions come from.
        tracker: TrackerSection;
        /// The emulated drives, needle and tracker: how they really are, whatever the bench assumes.
        emulator: EmulatorConfig;
        /// How long calibrations are valid.
        calibration: CalibrationConfig;
        /// Where runs are kept.
        record: RecordConfig;
        /// `needle-bench evaluate`, over recorded insertions.
        evaluation: EvaluationConfig;
        /// `needle-bench study`, and `run --seed`: the values of each trial are drawn from [lowest, highest], and
        /// replace those of `[emulator]`.
        study: StudyConfig;
    }
    beside {
        /// The whole configuration as TOML, with all defaults.
        toml: Value = Value::Table(Table::new()),
    }
}

impl Config {
    /// The defaults, overridden by `sources` in order, and then by `sets` (`key=value`).
    ///
    /// # Errors
    /// Every error found: invalid TOML; or unknown keys, wrong types, values out of range and contradictions. A
    /// key that names a calibration file is an error too, since no file is read.
    pub fn from_sources(sources: &[Source<'_>], sets: &[String]) -> Result<Self, ConfigError> {
        let read = |path: &Path| Err(format!("{} cannot be read here", path.display()));
        Self::with_warnings(sources, sets, &read).map(|(config, _)| config)
    }

    /// Like [`Config::from_sources`], but reads the calibration files that the configuration names with `read`.
    /// A path in a source is relative to that source's folder. Also returns the warnings, for example for a
    /// section that has no effect because its control law or observer is not chosen.
    ///
    /// # Errors
    /// Those of [`Config::from_sources`], or a calibration file cannot be read or has other content.
    pub fn with_warnings(
        sources: &[Source<'_>],
        sets: &[String],
        read: ReadFile<'_>,
    ) -> Result<(Self, Vec<String>), ConfigError> {
        let mut entries = entries(sources, sets)?;
        let unusable = include::add_calibrations(&mut entries, read);
        let (mut config, mut tree) = Config::checked(reader::merge(entries.clone()), unusable)?;
        if config.emulator.rehearse {
            let implied = rehearsal::layer(&config).map_err(|error| error.to_string())?;
            entries.extend(value::parse_file("rehearsal", &implied, PRESET)?);
            (config, tree) = Config::checked(reader::merge(entries), Vec::new())?;
        }
        let warnings = warnings::all(&config, &tree);
        Ok((config, warnings))
    }

    /// The configuration in `tree`, and the tree with all defaults. `unusable` are the calibration files that
    /// could not be merged into it.
    fn checked(mut tree: Tree, unusable: include::Unusable) -> Result<(Self, Tree), ConfigError> {
        include::remove_outdated_fits(&mut tree);
        let mut reader = Reader::new(tree);
        unusable.into_iter().for_each(|(keys, error)| reader.fail_all(keys, error));
        let config = reader.read();
        checks::check(&config, &mut reader);
        Ok((config, reader.finish()?))
    }

    /// The configuration in `toml`, which was checked and has all defaults. Some sections need values of others
    /// beside their own keys: this function copies them.
    fn of(toml: Value) -> Self {
        let mut config = Config { toml: toml.clone(), ..Config::take(Some(&toml)) };
        // Fiducials that determine no registration are refused by the checks.
        let registration_sd_mm = config.registration_sd_mm().unwrap_or_default();
        let Config { stage, can, observer, insertion, emulator, .. } = &mut config;
        (stage.bus, stage.listen_first) = (can.bus, can.bus.heartbeat_timeout());
        insertion.corrected_by = observer.samples;
        observer.invariant.start = observer.start;
        observer.invariant.registration_sd_mm = registration_sd_mm;
        observer.coupled.start = observer.start;
        observer.coupled.position_sd_mm = observer.invariant.position_sd_mm;
        emulator.fault.iter_mut().for_each(|fault| fault.bench = Some(can.bus.bench_node));
        config
    }

    /// The value at the dotted `key`.
    fn value_at(&self, key: &str) -> Option<&Value> {
        key.split('.').try_fold(&self.toml, |table, name| table.get(name))
    }

    /// True if the dotted `key`, or a key of that section, has another value than its default. A printed
    /// configuration has all defaults.
    fn is_changed(&self, key: &str) -> bool {
        let default = keys::find(Self::KEYS, key).and_then(|key| key.default_value());
        match self.value_at(key) {
            Some(Value::Table(section)) if default.is_none() => {
                section.keys().any(|name| self.is_changed(&format!("{key}.{name}")))
            }
            value => value != default.as_ref(),
        }
    }

    /// The number at the dotted `key`, in the key's own unit; NaN if it is not given.
    fn number(&self, key: &str) -> f64 {
        match self.value_at(key) {
            Some(Value::Integer(integer)) => *integer as f64,
            value => f64::take(value),
        }
    }

    /// The reference of all keys, which is also a valid configuration: the defaults.
    pub fn reference() -> String {
        format!("{HEAD}{}", keys::toml_reference(Config::KEYS))
    }

    /// A JSON Schema of the configuration, for editors that complete and check TOML.
    pub fn json_schema() -> serde_json::Value {
        keys::json_schema(Config::KEYS, "needle-bench configuration")
    }

    /// The whole configuration as TOML, which reads back to the same. For hardware, defaults of `[emulator]` that
    /// a rehearsal derives are left out, so that it can still derive them.
    ///
    /// # Errors
    /// None for a configuration that was read.
    pub fn to_toml(&self) -> Result<String, toml::ser::Error> {
        let mut toml = self.toml.clone();
        if !self.is_emulated()
            && let Some(emulator) = toml.get_mut("emulator").and_then(Value::as_table_mut)
        {
            emulator.retain(|key, _| {
                !rehearsal::derives(key, self) || self.is_changed(&format!("emulator.{key}"))
            });
        }
        toml::to_string(&toml)
    }
}

/// The entries of all layers: the files, the command line, and the preset that these name.
fn entries(sources: &[Source<'_>], sets: &[String]) -> Result<Entries, ConfigError> {
    let files = sources.iter().zip(PRESET + 1..);
    let files = files.map(|(s, layer)| value::parse_file(s.name, s.text, layer));
    let sets = sets.iter().zip(PRESET + 1 + sources.len()..);
    let sets = sets.map(|(set, layer)| value::parse_set(set, layer));
    let (mut entries, mut problems) = (Vec::new(), Vec::new());
    for source in files.chain(sets) {
        match source {
            Ok(more) => entries.extend(more),
            Err(error) => problems.extend(error.problems),
        }
    }
    ConfigError::unless_empty(problems)?;
    let named = include::highest_entry(&entries, "emulator.tracker").map(|entry| &entry.value);
    let preset = TrackerPreset::take(named);
    entries.extend(value::parse_file(&preset.to_string(), preset.toml(), PRESET)?);
    Ok(entries)
}

/// True if `name` is valid as part of a folder's name.
fn is_run_name(name: &str) -> bool {
    (1..=64).contains(&name.len())
        && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"._-".contains(&byte))
}
