//! Two runs side by side: differences in their settings, then their figures.

use super::figures::Figure;
use super::run::Run;
use crate::archive::{DriveIdentity, Manifest};
use crate::text::{escaped, screen};
use minijinja::context;
use serde::Serialize;
use serde_json::{Map, json};
use std::collections::BTreeMap;
use toml::Value;

/// The keys of a manifest that describe bench, rig and people, except for the drives.
const SETTING: [&str; 9] = [
    "version",
    "git",
    "calibration_sha256",
    "bus",
    "tracker",
    "operator",
    "phantom",
    "note",
    "operation",
];

/// The differences between two runs, and their figures.
#[derive(Debug, Clone, PartialEq)]
pub struct Comparison {
    /// For each run its folder and how it ended.
    runs: [(String, String); 2],
    /// Configuration keys that differ.
    configuration: Differences,
    /// Differences in bench, rig and people, from the manifests.
    setting: Differences,
    /// The figures of both runs, in pairs.
    figures: Vec<[Figure; 2]>,
    /// Reasons for caution with the comparison.
    warnings: Vec<String>,
}

impl Comparison {
    /// Compares `a` with `b`.
    pub fn of(a: &Run, b: &Run) -> Self {
        let mut warnings = Vec::new();
        let mut keys = Vec::new();
        for Run { folder, unreadable, .. } in [a, b] {
            warnings.extend(folder.caution().map(|caution| format!("{}: {caution}", folder.dir)));
            warnings.extend(unreadable.iter().cloned());
            keys.push(folder.keys().unwrap_or_else(|error| {
                warnings.push(format!("{}: configuration: {error}", folder.dir));
                Keys::new()
            }));
        }
        Comparison {
            runs: [a, b].map(|run| (run.folder.dir.clone(), run.folder.ending())),
            configuration: differences(&keys[0], &keys[1]),
            setting: differences(&setting(&a.folder.manifest), &setting(&b.folder.manifest)),
            figures: figures(a, b),
            warnings,
        }
    }

    /// One screen.
    ///
    /// # Errors
    /// A fault in the template `compare.txt`.
    pub fn to_text(&self) -> Result<String, minijinja::Error> {
        let or_dash = |value: &Option<String>| value.clone().unwrap_or_else(|| "-".to_owned());
        let row = |(key, Difference { a, b }): (&String, &Difference)| {
            [format!("  {key}"), escaped(&format!("{} → {}", or_dash(a), or_dash(b))).into_owned()]
        };
        let rows = |all: &Differences| all.iter().map(row).collect::<Vec<_>>();
        let figures = self.figures.iter().map(|[a, b]| {
            let difference = difference(a, b).map(|value| format!("{value:+.*}", a.decimals));
            let label = match a.label == b.label {
                true => format!("  {}", a.label),
                false => format!("  {}; b: {}", a.label, b.label),
            };
            [label, a.value_text(), b.value_text(), or_dash(&difference), a.unit.to_owned()]
        });
        let more = context! {
            differences => [("configuration", rows(&self.configuration)), ("setting", rows(&self.setting))],
            rows => figures.collect::<Vec<_>>(),
        };
        screen(include_str!("compare.txt"), &self.to_json(), more)
    }

    /// One JSON object, units in its keys.
    pub fn to_json(&self) -> serde_json::Value {
        let figure = |[a, b]: &[Figure; 2]| {
            let values = json!({ "a": a.value, "b": b.value, "b_minus_a": difference(a, b) });
            (a.key.clone(), values)
        };
        let [a, b] = &self.runs;
        json!({
            "a": { "run_dir": a.0, "ending": a.1 },
            "b": { "run_dir": b.0, "ending": b.1 },
            "configuration": self.configuration,
            "setting": self.setting,
            "figures": self.figures.iter().map(figure).collect::<Map<_, _>>(),
            "warnings": self.warnings,
        })
    }
}

/// The value of `b` minus that of `a`; `None` if they cannot be compared, such as a true and an estimated
/// distance.
fn difference(a: &Figure, b: &Figure) -> Option<f64> {
    let difference = b.value? - a.value?;
    (a.label == b.label).then_some(difference)
}

/// The figures of both runs in pairs, in the order of the first run. A figure that neither run has is left out.
fn figures(a: &Run, b: &Run) -> Vec<[Figure; 2]> {
    let (a, b) = (a.all_figures(), b.all_figures());
    let unknown = |figure: &Figure| Figure { value: None, ..figure.clone() };
    let only_b = b.iter().filter(|figure| a.iter().all(|other| other.key != figure.key));
    let pairs = a.iter().map(|figure| {
        let other = b.iter().find(|other| other.key == figure.key);
        [figure.clone(), other.cloned().unwrap_or_else(|| unknown(figure))]
    });
    let pairs = pairs.chain(only_b.map(|figure| [unknown(figure), figure.clone()]));
    pairs.filter(|pair| pair.iter().any(|figure| figure.value.is_some())).collect()
}

/// The parts of a manifest that describe bench, rig, people and drives.
fn setting(manifest: &Manifest) -> Keys {
    let all = serde_json::to_value(manifest).unwrap_or_default();
    let given = SETTING.into_iter().filter_map(|key| Some((key, all[key].as_str()?)));
    let given = given.map(|(key, value)| (key.to_owned(), value.to_owned()));
    let drives = manifest.drives.iter().map(|d| (format!("{} drive", d.axis), drive(d)));
    given.chain(drives).collect()
}

/// A drive's identity in one line.
pub(super) fn drive(drive: &DriveIdentity) -> String {
    let DriveIdentity { node, vendor_id, product_code, .. } = drive;
    let mut text = format!("node {node}, vendor {vendor_id:#010x}, product {product_code:#010x}");
    text.extend(drive.revision.map(|revision| format!(", revision {revision:#010x}")));
    text.extend(drive.serial.map(|serial| format!(", serial {serial}")));
    text
}

/// Every key of a configuration with its value in TOML. Tables in arrays are numbered:
/// `emulator.fault[0].kind`.
pub(super) type Keys = BTreeMap<String, String>;

/// The two values of a key; `None` if missing.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Difference {
    /// In the first configuration.
    pub a: Option<String>,
    /// In the second.
    pub b: Option<String>,
}

/// The keys with different values in two configurations.
pub(super) type Differences = BTreeMap<String, Difference>;

/// The keys of `toml`.
///
/// # Errors
/// Invalid TOML, with its line.
pub fn keys(toml: &str) -> Result<Keys, toml::de::Error> {
    let mut keys = Keys::new();
    flatten(String::new(), &Value::Table(toml.parse()?), &mut keys);
    Ok(keys)
}

/// Adds the `value` at `path` to `keys`: a table key by key, an array with tables element by element.
fn flatten(path: String, value: &Value, keys: &mut Keys) {
    match value {
        Value::Table(table) => {
            for (name, value) in table {
                let key = if path.is_empty() { name.clone() } else { format!("{path}.{name}") };
                flatten(key, value, keys);
            }
        }
        Value::Array(values) if values.iter().any(Value::is_table) => {
            for (n, value) in values.iter().enumerate() {
                flatten(format!("{path}[{n}]"), value, keys);
            }
        }
        other => drop(keys.insert(path, other.to_string())),
    }
}

/// The keys whose values differ between `a` and `b`.
pub fn differences(a: &Keys, b: &Keys) -> Differences {
    let sides = a
        .keys()
        .chain(b.keys())
        .map(|key| (key.clone(), Difference { a: a.get(key).cloned(), b: b.get(key).cloned() }));
    sides.filter(|(_, difference)| difference.a != difference.b).collect()
}

#[cfg(test)]
mod tests {
    use super::super::run::Condition;
    use super::super::run::tests::run;
    use super::*;

    fn other() -> Run {
        let mut run = run();
        run.folder.dir = "runs/b".to_owned();
        let toml = run.folder.config_toml.as_mut().unwrap();
        *toml = toml.replace("kind = \"invariant\"", "kind = \"coupled\"");
        run.folder.manifest.git = Some("abc".to_owned());
        run.folder.manifest.figures.insert("off_plane_rms_mm".to_owned(), 0.75.into());
        run
    }

    #[test]
    fn the_configuration_comes_first_and_then_the_figures() {
        let text = Comparison::of(&run(), &other()).to_text().unwrap();
        let configuration = text.find("observer.kind  \"invariant\" → \"coupled\"").unwrap();
        let setting = text.find("git  - → abc").unwrap();
        let figures = text.find("off plane").unwrap();
        assert!(configuration < setting && setting < figures, "{text}");
        let line = text.lines().find(|line| line.contains("off plane")).unwrap();
        assert!(line.contains("0.500  0.750  +0.250  mm"), "{line}");
    }

    #[test]
    fn a_run_has_no_difference_from_itself() {
        let text = Comparison::of(&run(), &run()).to_text().unwrap();
        assert!(text.contains("configuration: the same\n\nsetting: the same\n"), "{text}");
    }

    #[test]
    fn json_has_both_values_and_their_difference() {
        let mut open = other();
        open.folder.condition = Condition::Open;
        open.unreadable
            .push("runs/b/steps.csv: line 3: 1 fields where the header has 20".to_owned());
        let json = Comparison::of(&run(), &open).to_json();
        assert_eq!(json["configuration"]["observer.kind"]["b"], "\"coupled\"");
        assert_eq!(json["figures"]["off_plane_rms_mm"]["b_minus_a"], 0.25);
        assert_eq!(
            json["warnings"][0],
            "runs/b: the record is not closed; if its bench has ended, close it: needle-bench review runs/b --repair"
        );
        assert_eq!(json["warnings"][1], open.unreadable[0]);
    }

    #[test]
    fn differences_are_listed_key_by_key() {
        let a = "name = \"a\"\n[needle]\nradius_mm = 122.0\n[needle.torsion]\noffset_deg = 0.0\n";
        let b = "name = \"a\"\n[needle]\nradius_mm = 121.5\n[needle.torsion]\noffset_deg = 0.0\n\
                 [[emulator.fault]]\nkind = \"silent\"\nat_mm = 10.0\n";
        let said = differences(&keys(a).unwrap(), &keys(b).unwrap()).into_iter();
        let said: Vec<_> = said.map(|(key, Difference { a, b })| (key, a, b)).collect();
        let some = |text: &str| Some(text.to_owned());
        assert_eq!(
            said,
            [
                ("emulator.fault[0].at_mm".to_owned(), None, some("10.0")),
                ("emulator.fault[0].kind".to_owned(), None, some("\"silent\"")),
                ("needle.radius_mm".to_owned(), some("122.0"), some("121.5")),
            ]
        );
    }

    #[test]
    fn a_configuration_has_no_difference_from_itself() {
        let keys = keys(crate::config::DEFAULT_TOML).unwrap();
        assert!(keys.len() > 100);
        assert!(differences(&keys, &keys).is_empty());
    }
}
