//! Layers that a configuration names instead of holding them: calibration files and the emulated
//! tracker's presets.

use std::path::Path;

use super::TrackerPreset;
use super::error::{ConfigError, Problem};
use super::reader::{FIDUCIALS, REGISTRATION, Tree, is_inside};
use super::value::{self, Entries, Entry, Origin};
use crate::keys::Field as _;

/// Reads a file that the configuration names; what goes wrong, in words.
pub type ReadFile<'a> = &'a dyn Fn(&Path) -> Result<String, String>;

/// A key that names a file with calibrated values.
struct CalibrationFile {
    key: &'static str,
    /// The command that writes such a file.
    made_by: &'static str,
    /// The keys that such a file holds, and no others.
    holds: &'static [&'static str],
    /// Keys that replace the file if a source above the one that names it gives them. Within one source,
    /// neither they nor what the file holds may stand beside `key`.
    instead_of: &'static [&'static str],
    /// The key in `holds` that says how the values were measured. The preflight judges it.
    fit: &'static str,
}

const CALIBRATION_FILES: [CalibrationFile; 3] = [
    CalibrationFile {
        key: "tracker.registration_file",
        made_by: "needle-bench calibrate registration",
        holds: &[REGISTRATION],
        instead_of: &[REGISTRATION, FIDUCIALS],
        fit: "tracker.registration.fit",
    },
    CalibrationFile {
        key: "tracker.tip_file",
        made_by: "needle-bench calibrate tip",
        holds: &["tracker.tip_offset_mm", "tracker.tip_tilt", "tracker.tip_fit"],
        instead_of: &["tracker.tip_offset_mm", "tracker.tip_tilt"],
        fit: "tracker.tip_fit",
    },
    CalibrationFile {
        key: "needle.needle_file",
        made_by: "needle-bench calibrate needle",
        holds: &[
            "needle.curvature_per_mm",
            "needle.tip_ahead_mm",
            "needle.torsion",
            "needle.fit",
            "evaluation.axis",
            "evaluation.bend_axis",
        ],
        instead_of: &["needle.curvature_per_mm", "needle.radius_mm"],
        fit: "needle.fit",
    },
];

/// Keys of calibration files that may be changed without a change of what was measured.
const NOT_MEASURED: [&str; 2] = ["tracker.registration.sd_mm", "evaluation"];

/// The preset that the topmost of `layers` names, as layer number `layer`.
pub(super) fn preset(layers: &[Entries], layer: usize) -> Result<Entries, ConfigError> {
    let named = last(layers, "emulator.tracker").map(|entry| &entry.value);
    let preset = TrackerPreset::take(named);
    Ok(value::parse_file(&preset.to_string(), preset.toml(), layer)?)
}

/// Calibration files that cannot be used: the keys that are not known without each, and why.
pub(super) type Unusable = Vec<(Vec<&'static str>, ConfigError)>;

/// Lays what the named calibration files hold into the layers that name them, as if it were
/// written there; the files with which that fails.
pub(super) fn calibrations(layers: &mut [Entries], read: ReadFile<'_>) -> Unusable {
    let mut unusable = Vec::new();
    for file in &CALIBRATION_FILES {
        if let Err(error) = file.lay(layers, read) {
            unusable.push(([file.holds, file.instead_of].concat(), error));
        }
        // What the file holds is in its layer now, or something given above it counts.
        for layer in layers.iter_mut() {
            layer.retain(|(key, entry)| key != file.key || !entry.value.is_str());
        }
    }
    unusable
}

/// Removes the `fit` of each calibration of which a source above changes a measured value.
pub(super) fn remove_outdated_fits(tree: &mut Tree) {
    for file in &CALIBRATION_FILES {
        let Some(layer) = tree.get(file.fit).map(|fit| fit.layer) else { continue };
        if tree.iter().any(|(key, entry)| entry.layer > layer && file.measures(key)) {
            tree.retain(|key, _| !is_of(key, &[file.fit]));
        }
    }
}

impl CalibrationFile {
    /// True for the measured values that the file holds, and for those that say the same.
    fn measures(&self, key: &str) -> bool {
        (is_of(key, self.holds) || is_of(key, self.instead_of)) && !is_of(key, &NOT_MEASURED)
    }

    fn lay(&self, layers: &mut [Entries], read: ReadFile<'_>) -> Result<(), ConfigError> {
        let Some(naming) = last(layers, self.key).cloned() else { return Ok(()) };
        let Some(path) = naming.value.as_str() else { return Ok(()) };
        let refusal = |message: String| {
            ConfigError::from(vec![Problem::at(Some(naming.origin.clone()), message)])
        };
        let mut others = self.instead_of.iter().filter_map(|key| last(layers, key));
        if others.any(|other| other.layer > naming.layer && !other.is_beside(&naming)) {
            return Ok(());
        }
        // Of what the file only holds, the later `--set` counts.
        let is_twice = |(key, entry): &&(String, Entry)| {
            is_of(key, self.instead_of) && entry.is_beside(&naming)
                || is_of(key, self.holds) && entry.layer == naming.layer
        };
        if let Some((key, _)) = layers.iter().flatten().find(is_twice) {
            let message = format!("{} is given along with {key}: give one of the two", self.key);
            return Err(refusal(message));
        }
        // A path is relative to the file that names it, or on the command line to where that is typed.
        let path = match &naming.origin {
            Origin::File { name, .. } => Path::new(name).with_file_name(path),
            Origin::Set => path.into(),
        };
        let text = read(&path).map_err(|error| {
            refusal(format!("{}: {error}; {} --out writes it", self.key, self.made_by))
        })?;
        let name = path.display().to_string();
        let entries = value::parse_file(&name, &text, naming.layer)?;
        self.check(&name, &entries)?;
        let is_naming = |layer: &&mut Entries| layer.iter().any(|(_, e)| e.layer == naming.layer);
        if let Some(layer) = layers.iter_mut().find(is_naming) {
            layer.extend(entries);
        }
        Ok(())
    }

    /// A calibration file holds its calibration, whole, and nothing else.
    fn check(&self, name: &str, entries: &Entries) -> Result<(), ConfigError> {
        let mut problems = Vec::new();
        for (key, entry) in entries {
            let is_around = self.holds.iter().any(|table| is_inside(table, key));
            if !is_around && !is_of(key, self.holds) {
                let message = format!("{key} does not belong in a file for {}", self.key);
                problems.push(Problem::at(Some(entry.origin.clone()), message));
            }
        }
        let mut held = self.holds.iter();
        let missing = held.find(|held| !entries.iter().any(|(key, _)| key == *held));
        if let (Some(key), true) = (missing, problems.is_empty()) {
            let origin = Origin::File { name: name.to_owned(), line: 1 };
            let message = format!("{key} is missing in a file for {}", self.key);
            problems.push(Problem::at(Some(origin), message));
        }
        ConfigError::unless_empty(problems)
    }
}

/// True for each of `keys` and what is inside it.
fn is_of(key: &str, keys: &[&str]) -> bool {
    keys.iter().any(|of| key == *of || is_inside(key, of))
}

/// The topmost value of `key`.
fn last<'a>(layers: &'a [Entries], key: &str) -> Option<&'a Entry> {
    let mut entries = layers.iter().rev().flat_map(|layer| layer.iter().rev());
    entries.find(|(name, _)| name == key).map(|(_, entry)| entry)
}
