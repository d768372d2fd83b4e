//! The calibration files that a configuration names.

use std::path::Path;

use super::error::{ConfigError, Problem};
use super::reader::{FIDUCIALS, REGISTRATION, Tree, is_inside};
use super::value::{self, Entries, Entry, Origin};

/// Reads a file that the configuration names. The error says in words what went wrong.
pub type ReadFile<'a> = &'a dyn Fn(&Path) -> Result<String, String>;

/// A key that names a file with calibrated values.
struct CalibrationFile {
    key: &'static str,
    /// The command that writes such a file.
    made_by: &'static str,
    /// The keys in such a file; it has all of them and no others.
    holds: &'static [&'static str],
    /// If a source of higher precedence gives one of these keys, the file is ignored. One source may not give `key`
    /// together with one of these, or with a key that the file contains.
    instead_of: &'static [&'static str],
    /// The key in `holds` that says when and from which data the values were computed; the preflight checks it.
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

/// Keys of calibration files that are not measured values: overriding one keeps the `fit`.
const NOT_MEASURED: [&str; 2] = ["tracker.registration.sd_mm", "evaluation"];

/// Calibration files that cannot be used: for each, the keys whose values are therefore unknown, and the error.
pub(super) type Unusable = Vec<(Vec<&'static str>, ConfigError)>;

/// Adds the content of the named calibration files to the layers that name them, as if it were written
/// there. Returns the files that cannot be used.
pub(super) fn add_calibrations(entries: &mut Entries, read: ReadFile<'_>) -> Unusable {
    let mut unusable = Vec::new();
    for file in &CALIBRATION_FILES {
        match file.content(entries, read) {
            Ok(content) => entries.extend(content),
            Err(error) => unusable.push(([file.holds, file.instead_of].concat(), error)),
        }
        // Now the layers contain the file's content, or a higher layer replaces it.
        entries.retain(|(key, entry)| key != file.key || !entry.value.is_str());
    }
    unusable
}

/// Removes the `fit` of each calibration if a higher layer overrides one of its measured values.
pub(super) fn remove_outdated_fits(tree: &mut Tree) {
    for file in &CALIBRATION_FILES {
        let Some(layer) = tree.get(file.fit).map(|fit| fit.layer) else { continue };
        let is_measured = |key: &str| {
            (is_among(key, file.holds) || is_among(key, file.instead_of))
                && !is_among(key, &NOT_MEASURED)
        };
        if tree.iter().any(|(key, entry)| entry.layer > layer && is_measured(key)) {
            tree.retain(|key, _| !is_among(key, &[file.fit]));
        }
    }
}

impl CalibrationFile {
    /// The content of the file, in the layer that names it; nothing if a higher layer replaces it.
    fn content(&self, entries: &Entries, read: ReadFile<'_>) -> Result<Entries, ConfigError> {
        let Some(naming) = highest_entry(entries, self.key) else { return Ok(Vec::new()) };
        let Some(path) = naming.value.as_str() else { return Ok(Vec::new()) };
        let refusal = |message: String| ConfigError::at(Some(naming.origin.clone()), message);
        let mut others = self.instead_of.iter().filter_map(|key| highest_entry(entries, key));
        if others.any(|other| other.layer > naming.layer && !other.is_same_source(naming)) {
            return Ok(Vec::new());
        }
        // All `--set` together are one source. But for a key that the file merely contains, the later `--set` wins.
        let is_twice = |(key, entry): &&(String, Entry)| {
            is_among(key, self.instead_of) && entry.is_same_source(naming)
                || is_among(key, self.holds) && entry.layer == naming.layer
        };
        if let Some((key, _)) = entries.iter().find(is_twice) {
            let message = format!("{} is given along with {key}: give one of the two", self.key);
            return Err(refusal(message));
        }
        // A path is relative to the file that names it, or for `--set` to the working directory.
        let path = match &naming.origin {
            Origin::File { name, .. } => Path::new(name).with_file_name(path),
            Origin::Set => path.into(),
        };
        let text = read(&path).map_err(|error| {
            refusal(format!("{}: {error}; {} --out writes it", self.key, self.made_by))
        })?;
        let name = path.display().to_string();
        let content = value::parse_file(&name, &text, naming.layer)?;
        self.check(&name, &content)?;
        Ok(content)
    }

    /// Checks that a calibration file has all of its keys and no others.
    fn check(&self, name: &str, entries: &Entries) -> Result<(), ConfigError> {
        let is_foreign = |key: &str| {
            !is_among(key, self.holds) && !self.holds.iter().any(|held| is_inside(held, key))
        };
        let foreign = entries.iter().filter(|(key, _)| is_foreign(key)).map(|(key, entry)| {
            let message = format!("{key} does not belong in a file for {}", self.key);
            Problem::at(Some(entry.origin.clone()), message)
        });
        ConfigError::unless_empty(foreign.collect())?;
        let is_missing = |held: &&&str| !entries.iter().any(|(key, _)| key == **held);
        let Some(key) = self.holds.iter().find(is_missing) else { return Ok(()) };
        let message = format!("{key} is missing in a file for {}", self.key);
        Err(ConfigError::at(Some(Origin::File { name: name.to_owned(), line: 1 }), message))
    }
}

/// True for each of `keys` and every key inside it.
fn is_among(key: &str, keys: &[&str]) -> bool {
    keys.iter().any(|outer| key == *outer || is_inside(key, outer))
}

/// The value of `key` in the highest layer that has it.
pub(super) fn highest_entry<'a>(entries: &'a Entries, key: &str) -> Option<&'a Entry> {
    let named = entries.iter().filter(|(name, _)| name == key);
    named.map(|(_, entry)| entry).max_by_key(|entry| entry.layer)
}
