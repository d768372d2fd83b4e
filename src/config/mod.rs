//! The configuration: TOML to validated types.
//!
//! The defaults are `bench-config/virtual.toml`, which is built in. A user's file is laid over it
//! key by key, and each `--set key=value` over that. Every value is then read once, by the section
//! it belongs to, and all that is wrong is reported together.
//!
//! Two layers are named by a key: `emulator.tracker` a preset, laid over the defaults, and
//! `tracker.registration_file` and `tracker.tip_file` calibrated values, which count as written
//! where the file is named. The configuration as used has their content, and needs them no more.
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
mod axes;
mod calibration;
mod can;
mod checks;
mod choice;
mod control;
mod drive;
mod drive_options;
mod emulator;
mod error;
mod evaluation;
mod fault;
mod gates;
mod homing;
mod include;
mod invariant;
mod layers;
mod needle_fit;
mod pose;
mod raw_sdo;
mod reader;
mod record;
mod recording;
mod registration;
mod rule;
mod section;
mod stage;
mod steering;
mod stop;
mod study;
mod suggest;
#[cfg(test)]
mod tests;
mod tracker;
mod value;

pub use can::{CanConfig, CanInterface, Listen};
pub use control::{
    ControlConfig, ControlKind, FeedbackLinearizationSection, NestedSaturationSection,
};
pub use drive::{DriveConfig, Reference};
pub use emulator::{DriveModel, EmulatorConfig, Noise, SEED_MAX, SwitchesConfig, TrackerPreset};
pub use error::{ConfigError, Problem};
pub use evaluation::{EvaluationConfig, EvaluationSettings};
pub use fault::{FaultAxis, FaultConfig, FaultName, FrameName, FrameWay};
pub use gates::GatesConfig;
pub use homing::{InsertionHomingConfig, RotationHomingConfig};
pub use include::ReadFile;
pub use invariant::{InvariantObserverConfig, ProcessNoiseConfig};
pub use needle_fit::NeedleFitConfig;
pub use pose::{AnglesConfig, PoseConfig};
pub use raw_sdo::RawSdo;
pub use reader::Key;
pub use record::{OnFailure, RecordConfig};
pub use recording::{CsvConfig, TimeColumnsConfig};
pub use registration::{
    FiducialConfig, Fiducials, GivenRegistration, Provenance, RegistrationConfig,
    RegistrationFitConfig, TipFitConfig,
};
pub use stage::{CountsPerMm, CountsPerTurn, InsertionAxisConfig, RotationAxisConfig, StageConfig};
pub use steering::{
    Arc, CoupledObserverConfig, FiniteDifferenceConfig, InsertionConfig, InsertionMode,
    NeedleConfig, ObserverConfig, ObserverKind, OutOfReachKind, TorsionConfig,
};
pub use stop::StopConfig;
pub use study::StudyConfig;
pub use suggest::nearest_key;
pub use tracker::{
    ResumeKind, StampKind, TrackerConfig, TrackerKindName, TrackerMode, TrackerRequest,
    TrackerSource, WorkspaceConfig,
};
pub use value::Origin;

use serde::Serialize;
use std::path::Path;

use reader::Reader;
use section::Section;

/// The default configuration, commented: what each key means.
pub const DEFAULT_TOML: &str = include_str!("../../bench-config/virtual.toml");

/// A file laid over the defaults.
#[derive(Debug, Clone, Copy)]
pub struct Source<'a> {
    /// The file's name, for errors.
    pub name: &'a str,
    /// Its text.
    pub text: &'a str,
}

/// A whole configuration, every key of it checked.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Config {
    /// Of the run folder.
    pub name: String,
    /// `X_WP`, the plane frame in the bench frame.
    pub plane: PoseConfig,
    /// `[insertion]`.
    pub insertion: InsertionConfig,
    /// `[needle]`.
    pub needle: NeedleConfig,
    /// `[observer]`.
    pub observer: ObserverConfig,
    /// `[control]`.
    pub control: ControlConfig,
    /// `[can]`.
    pub can: CanConfig,
    /// `[stage]`.
    pub stage: StageConfig,
    /// `[tracker]`.
    pub tracker: TrackerConfig,
    /// `[emulator]`.
    pub emulator: EmulatorConfig,
    /// `[record]`.
    pub record: RecordConfig,
    /// `[evaluation]`.
    pub evaluation: EvaluationConfig,
    /// `[study]`.
    pub study: StudyConfig,
}

impl Config {
    /// The defaults with `sources` laid over them in order, then `sets` (`key=value`).
    ///
    /// # Errors
    /// All that is wrong: TOML that cannot be read; or unknown keys, wrong kinds, values out of
    /// range and contradictions. A calibration file that is named, since there is no file to read.
    pub fn from_sources(sources: &[Source<'_>], sets: &[String]) -> Result<Self, ConfigError> {
        Self::from_sources_and_files(sources, sets, &|path| {
            Err(format!("{} cannot be read here", path.display()))
        })
    }

    /// The same, with the calibration files that the configuration names read by `read`, which
    /// says in words what goes wrong. A path in a source is relative to that source's folder.
    ///
    /// # Errors
    /// Those of [`Config::from_sources`]; a calibration file that cannot be read or is none.
    pub fn from_sources_and_files(
        sources: &[Source<'_>],
        sets: &[String],
        read: ReadFile<'_>,
    ) -> Result<Self, ConfigError> {
        Self::read_all(sources, sets, read).map(|(config, _)| config)
    }

    /// Every key with the values it takes and its default, in the order of the file.
    pub fn keys() -> Vec<Key> {
        let no_files = |_: &Path| Err(String::new());
        Self::read_all(&[], &[], &no_files).map(|(_, keys)| keys).unwrap_or_default()
    }

    /// The whole configuration as TOML, which reads back to the same.
    ///
    /// # Errors
    /// None for a configuration that was read; a number put in by a program may not be TOML.
    pub fn to_toml(&self) -> Result<String, toml::ser::Error> {
        toml::to_string(self)
    }

    fn read_all(
        sources: &[Source<'_>],
        sets: &[String],
        read: ReadFile<'_>,
    ) -> Result<(Self, Vec<Key>), ConfigError> {
        let mut layers = layers(sources, sets)?;
        include::calibrations(&mut layers, read)?;
        let mut reader = Reader::new(layers::merge(layers));
        let config = Self::read(&mut reader.root());
        checks::check(&config, &mut reader);
        Ok((config, reader.finish()?))
    }

    fn read(s: &mut Section<'_>) -> Self {
        Config {
            name: s.text("name", "1 to 64 letters, digits, '.', '_' or '-'", is_run_name),
            plane: s.section("plane", PoseConfig::read_frame),
            insertion: s.section("insertion", InsertionConfig::read),
            needle: s.section("needle", NeedleConfig::read),
            observer: s.section("observer", ObserverConfig::read),
            control: s.section("control", ControlConfig::read),
            can: s.section("can", CanConfig::read),
            stage: s.section("stage", StageConfig::read),
            tracker: s.section("tracker", TrackerConfig::read),
            emulator: s.section("emulator", EmulatorConfig::read),
            record: s.section("record", RecordConfig::read),
            evaluation: s.section("evaluation", EvaluationConfig::read),
            study: s.section("study", StudyConfig::read),
        }
    }
}

/// The defaults, the preset that the others name, the files, then the command line, each a layer
/// over the one before.
fn layers(sources: &[Source<'_>], sets: &[String]) -> Result<Vec<value::Entries>, ConfigError> {
    const PRESET: usize = 1;
    let defaults = Source { name: "virtual.toml", text: DEFAULT_TOML };
    let defaults = value::parse_file(defaults.name, defaults.text, 0);
    let files = sources.iter().zip(PRESET + 1..);
    let files = files.map(|(s, layer)| value::parse_file(s.name, s.text, layer));
    let sets = sets.iter().zip(PRESET + 1 + sources.len()..);
    let sets =
        sets.map(|(set, layer)| value::parse_set(set, layer).map_err(|problem| vec![problem]));
    let (mut layers, mut problems) = (Vec::new(), Vec::new());
    for layer in std::iter::once(defaults).chain(files).chain(sets) {
        match layer {
            Ok(layer) => layers.push(layer),
            Err(wrong) => problems.extend(wrong),
        }
    }
    if !problems.is_empty() {
        return Err(ConfigError { problems });
    }
    layers.insert(PRESET, include::preset(&layers, PRESET)?);
    Ok(layers)
}

/// It becomes part of a folder's name.
fn is_run_name(name: &str) -> bool {
    (1..=64).contains(&name.len())
        && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"._-".contains(&byte))
}
