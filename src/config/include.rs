//! Layers that a configuration names instead of holding them: calibration files and the emulated
//! tracker's presets.

use std::path::Path;

use super::error::{ConfigError, Problem};
use super::reader::{FIDUCIALS, REGISTRATION, is_inside};
use super::value::{self, Entries, Entry, Origin};

/// Reads a file that the configuration names; what goes wrong, in words.
pub type ReadFile<'a> = &'a dyn Fn(&Path) -> Result<String, String>;

/// A key that names a file with calibrated values.
struct CalibrationFile {
    key: &'static str,
    /// The command that writes such a file.
    made_by: &'static str,
    /// The keys that such a file holds, and no others.
    holds: &'static [&'static str],
    /// Keys that say the same: they and `key` exclude one another in one source, and given in one
    /// over it they take its place.
    instead_of: &'static [&'static str],
}

const CALIBRATION_FILES: [CalibrationFile; 3] = [
    CalibrationFile {
        key: "tracker.registration_file",
        made_by: "needle-bench calibrate registration",
        holds: &[REGISTRATION],
        instead_of: &[REGISTRATION, FIDUCIALS],
    },
    CalibrationFile {
        key: "tracker.tip_file",
        made_by: "needle-bench calibrate tip",
        holds: &["tracker.tip_offset_mm", "tracker.tip_tilt", "tracker.tip_fit"],
        instead_of: &["tracker.tip_offset_mm", "tracker.tip_tilt"],
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
    },
];

const PRESETS: [(&str, &str); 4] = [
    (
        "electromagnetic-near",
        include_str!("../../bench-config/emulated-trackers/electromagnetic-near.toml"),
    ),
    (
        "electromagnetic-far",
        include_str!("../../bench-config/emulated-trackers/electromagnetic-far.toml"),
    ),
    ("ultrasound", include_str!("../../bench-config/emulated-trackers/ultrasound.toml")),
    ("stereo-camera", include_str!("../../bench-config/emulated-trackers/stereo-camera.toml")),
];
const PRESET_KEY: &str = "emulator.tracker";

/// The preset that the topmost of `layers` names, as layer number `layer`.
pub(super) fn preset(layers: &[Entries], layer: usize) -> Result<Entries, ConfigError> {
    let named = last(layers, PRESET_KEY).and_then(|entry| entry.value.as_str());
    let named = named.and_then(|name| PRESETS.iter().find(|(preset, _)| *preset == name));
    match named {
        Some((name, text)) => Ok(value::parse_file(name, text, layer)?),
        None => Ok(Entries::new()),
    }
}

/// A calibration file that is named and cannot be used.
pub(super) struct Unusable {
    /// The keys that are not known without it.
    pub(super) keys: Vec<&'static str>,
    pub(super) problems: Vec<Problem>,
}

/// Lays what the named calibration files hold into the layers that name them, as if it were
/// written there; the files with which that fails.
pub(super) fn calibrations(layers: &mut [Entries], read: ReadFile<'_>) -> Vec<Unusable> {
    let mut unusable = Vec::new();
    for file in &CALIBRATION_FILES {
        if let Err(problems) = file.lay(layers, read) {
            unusable.push(Unusable { keys: [file.holds, file.instead_of].concat(), problems });
        }
        // What the file holds is in its layer now, or something given above it counts.
        for layer in layers.iter_mut() {
            layer.retain(|(key, entry)| key != file.key || !entry.value.is_str());
        }
    }
    unusable
}

impl CalibrationFile {
    fn lay(&self, layers: &mut [Entries], read: ReadFile<'_>) -> Result<(), Vec<Problem>> {
        let Some(naming) = last(layers, self.key).cloned() else { return Ok(()) };
        let Some(path) = naming.value.as_str() else { return Ok(()) };
        let given = self.instead_of.iter().filter_map(|key| Some((key, last(layers, key)?)));
        if let Some((key, other)) = given.max_by_key(|(_, entry)| entry.layer) {
            if other.is_beside(&naming) {
                let message =
                    format!("{} is given along with {key}: give one of the two", self.key);
                return Err(vec![Problem::at(Some(naming.origin), message)]);
            }
            if other.layer > naming.layer {
                return Ok(());
            }
        }
        // A path is relative to the file that names it, or on the command line to where that is typed.
        let path = match &naming.origin {
            Origin::File { name, .. } => Path::new(name).with_file_name(path),
            Origin::Set => path.into(),
        };
        let name = path.display().to_string();
        let text = read(&path).map_err(|error| {
            let message = format!("{}: {error}; {} --out writes it", self.key, self.made_by);
            vec![Problem::at(Some(naming.origin.clone()), message)]
        })?;
        let entries = value::parse_file(&name, &text, naming.layer)?;
        self.check(&name, &entries)?;
        let names_it =
            |(key, entry): &(String, Entry)| key == self.key && entry.layer == naming.layer;
        if let Some(layer) = layers.iter_mut().find(|layer| layer.iter().any(names_it)) {
            layer.extend(entries);
        }
        Ok(())
    }

    /// A calibration file holds its calibration, whole, and nothing else.
    fn check(&self, name: &str, entries: &Entries) -> Result<(), Vec<Problem>> {
        let holds =
            |key: &str| self.holds.iter().any(|&table| key == table || is_inside(key, table));
        let around = |key: &str| self.holds.iter().any(|table| is_inside(table, key));
        let mut problems: Vec<Problem> = entries
            .iter()
            .filter(|(key, _)| !holds(key) && !around(key))
            .map(|(key, entry)| {
                let message = format!("{key} does not belong in a file for {}", self.key);
                Problem::at(Some(entry.origin.clone()), message)
            })
            .collect();
        let missing =
            self.holds.iter().find(|&&table| !entries.iter().any(|(key, _)| key == table));
        let missing = missing.filter(|_| problems.is_empty()).map(|table| {
            let origin = Origin::File { name: name.to_owned(), line: 1 };
            Problem::at(Some(origin), format!("{table} is missing in a file for {}", self.key))
        });
        problems.extend(missing);
        if problems.is_empty() { Ok(()) } else { Err(problems) }
    }
}

/// The topmost value of `key`.
fn last<'a>(layers: &'a [Entries], key: &str) -> Option<&'a Entry> {
    let entries = layers.iter().rev().flat_map(|layer| layer.iter().rev());
    entries.filter(|(name, _)| name == key).map(|(_, entry)| entry).next()
}
