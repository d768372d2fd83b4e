//! The configuration: TOML to validated types.
//!
//! Each key is declared once, by `keys::section`: its type, range, default and text, and whether
//! hardware must give it. A user's file is read by these declarations, and each `--set key=value`
//! replaces a key of it. All that is wrong is reported together.
//!
//! Two layers are named by a key: `emulator.tracker` a preset, laid under the files, and
//! `tracker.registration_file`, `tracker.tip_file` and `needle.needle_file` calibrated values, which
//! count as written where the file is named. The configuration as used has their content, and needs them no more.
//! `emulator.rehearse` lays what a rehearsal implies beside the preset.
//! A calibrated value that is given over its calibration leaves out where that came from (`fit`).
//!
//! Three things are not laid key by key:
//! - of two alternatives (`needle.radius_mm` and `needle.curvature_per_mm`, `emulator.noise`'s two)
//!   one given above replaces the other below;
//! - `emulator.noise`, the counts per mm or turn and `tracker.registration` are replaced whole:
//!   `noise = {}` means none;
//! - the virtual rig is no default for a real one. With `stage.hardware = true` the drives' nodes,
//!   identities, scales, signs and limits have no defaults, and with any `tracker.source` but
//!   `"emulated"` there is no registration unless one is given.
//!
//! Units are in the keys and are those of the file, degrees among them; methods convert to mm and
//! rad. This module reads no files: the caller hands it their text.

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
mod pose;
mod reader;
mod record;
mod registration;
mod rehearsal;
mod stage;
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
pub use goal::{GoalConfig, GoalKind, ReadMask, WorkspaceConfig};
pub use include::ReadFile;
pub use needle::NeedleConfig;
pub use observer::{ObserverKind, ObserverSection};
pub use pose::PoseConfig;
pub use record::{CalibrationConfig, EvaluationConfig, OnFailure, RecordConfig};
pub use registration::RegistrationConfig;
pub use stage::StageSection;
pub use stop::StopConfig;
pub use study::StudyConfig;
pub use tracker::{TrackerMode, TrackerSection, TrackerSource};

use crate::control::ControlConfig;
use crate::keys::{self, Field, Rule, section};
use crate::session::InsertionConfig;
use reader::{Reader, Tree};
use std::path::Path;
use toml::{Table, Value};

/// The default configuration, commented: what each key means.
#[cfg(test)]
pub(crate) const DEFAULT_TOML: &str = include_str!("../../bench-config/virtual.toml");

/// The number of the layer under the files.
const PRESET: usize = 1;

const HEAD: &str = "\
#:schema schema.json
# The reference of the configuration: every key with what it means, what it may be, and its default.
# `needle-bench check --reference` prints it. `needle-bench run` with no arguments runs it: a virtual
# stage on an in-memory bus, an emulated needle and tracker, virtual time.
#
# Every key can be given on the command line as --set key=value with a TOML value, for example
#   needle-bench run --set insertion.depth_mm=200 --set 'observer.kind=\"finite-difference\"'
# A key left out has the value shown here. Unknown keys are refused.
";

/// A file laid over the defaults.
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
        plane: PoseConfig => pose::IDENTITY;
        /// Where the needle is steered: into the plane, or to a target around obstacles.
        goal: GoalConfig;
        /// How far the needle is inserted, and how.
        insertion: InsertionConfig;
        /// The needle as the bench believes it to be.
        needle: NeedleConfig;
        /// The observers.
        observer: ObserverSection;
        /// The control law.
        control: ControlConfig;
        /// The bus, and the times of CANopen on it.
        can: CanConfig;
        /// The two drives.
        stage: StageSection;
        /// Where tip positions come from.
        tracker: TrackerSection;
        /// The emulated needle and tracker: their own truth, apart from what the bench believes.
        emulator: EmulatorConfig;
        /// How long calibrations count.
        calibration: CalibrationConfig;
        /// Where runs are kept.
        record: RecordConfig;
        /// `needle-bench evaluate`, over recorded insertions.
        evaluation: EvaluationConfig;
        /// `needle-bench study`, and `run --seed`: each trial is drawn from [lowest, highest], in place
        /// of what `[emulator]` says.
        study: StudyConfig;
    }
    beside {
        /// As it was read, with all defaults.
        written: Value = Value::Table(Table::new()),
    }
}

impl Config {
    /// The defaults with `sources` laid over them in order, then `sets` (`key=value`).
    ///
    /// # Errors
    /// All that is wrong: TOML that cannot be read; or unknown keys, wrong kinds, values out of
    /// range and contradictions. A calibration file that is named, since there is no file to read.
    pub fn from_sources(sources: &[Source<'_>], sets: &[String]) -> Result<Self, ConfigError> {
        let read = |path: &Path| Err(format!("{} cannot be read here", path.display()));
        Self::with_warnings(sources, sets, &read).map(|(config, _)| config)
    }

    /// The same, with the calibration files that the configuration names read by `read`, which says in
    /// words what goes wrong; a path in a source is relative to that source's folder. And a warning for
    /// each section of a law or an observer that is given and not chosen, since it has no effect, and for
    /// an observer that does not hold with the law.
    ///
    /// # Errors
    /// Those of [`Config::from_sources`]; a calibration file that cannot be read or is none.
    pub fn with_warnings(
        sources: &[Source<'_>],
        sets: &[String],
        read: ReadFile<'_>,
    ) -> Result<(Self, Vec<String>), ConfigError> {
        let mut layers = layers(sources, sets)?;
        let unusable = include::calibrations(&mut layers, read);
        let (mut config, mut tree) = Config::checked(reader::merge(layers.clone()), unusable)?;
        if config.emulator.rehearse {
            let implied = rehearsal::layer(&config);
            layers[0].extend(value::parse_file("rehearsal", &implied, PRESET)?);
            (config, tree) = Config::checked(reader::merge(layers), Vec::new())?;
        }
        let warnings = warnings::all(&config, &tree);
        Ok((config, warnings))
    }

    /// The configuration that `tree` gives, and the tree with all defaults. The files in `unusable` were
    /// to be laid into it.
    fn checked(mut tree: Tree, unusable: include::Unusable) -> Result<(Self, Tree), ConfigError> {
        include::remove_outdated_fits(&mut tree);
        let mut reader = Reader::new(tree);
        unusable.into_iter().for_each(|(keys, error)| reader.fail_all(keys, error));
        let config = Config::of(reader.read(Self::KEYS));
        checks::check(&config, &mut reader);
        Ok((config, reader.finish()?))
    }

    /// The configuration that is written so: every key of it checked, with all defaults.
    fn of(written: Value) -> Self {
        Config { written: written.clone(), ..Config::take(Some(&written)) }
    }

    /// The value written at `key`.
    fn at(&self, key: &str) -> Option<&Value> {
        key.split('.').try_fold(&self.written, |table, name| table.get(name))
    }

    /// The number at `key` in the key's own unit; NaN where there is none.
    fn number(&self, key: &str) -> f64 {
        match self.at(key) {
            Some(Value::Integer(integer)) => *integer as f64,
            value => f64::take(value),
        }
    }

    /// The reference of all keys, which is a configuration as well: that of the defaults.
    pub fn reference() -> String {
        format!("{HEAD}{}", keys::toml_reference(Config::KEYS))
    }

    /// A JSON Schema of the configuration, for editors that complete and check TOML.
    pub fn json_schema() -> serde_json::Value {
        keys::json_schema(Config::KEYS, "needle-bench configuration")
    }

    /// The whole configuration as TOML, which reads back to the same.
    ///
    /// # Errors
    /// None for a configuration that was read.
    pub fn to_toml(&self) -> Result<String, toml::ser::Error> {
        toml::to_string(&self.written)
    }
}

/// The preset that the others name, the files, then the command line, each a layer over the one
/// before.
fn layers(sources: &[Source<'_>], sets: &[String]) -> Result<Vec<value::Entries>, ConfigError> {
    let files = sources.iter().zip(PRESET + 1..);
    let files = files.map(|(s, layer)| value::parse_file(s.name, s.text, layer));
    let sets = sets.iter().zip(PRESET + 1 + sources.len()..);
    let sets = sets.map(|(set, layer)| value::parse_set(set, layer));
    let (mut layers, mut problems) = (Vec::new(), Vec::new());
    for layer in files.chain(sets) {
        match layer {
            Ok(layer) => layers.push(layer),
            Err(wrong) => problems.extend(wrong),
        }
    }
    ConfigError::unless_empty(problems)?;
    layers.insert(0, include::preset(&layers, PRESET)?);
    Ok(layers)
}

/// It becomes part of a folder's name.
fn is_run_name(name: &str) -> bool {
    (1..=64).contains(&name.len())
        && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"._-".contains(&byte))
}
