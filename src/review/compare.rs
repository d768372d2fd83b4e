//! Two runs side by side: differences in their settings, then their figures.

use super::configuration::{Difference, Keys, differences};
use super::figures::Figure;
use super::run::Run;
use crate::archive::{DriveIdentity, Manifest};
use crate::text::{escaped, screen};
use minijinja::context;
use serde_json::{Map, Value, json};

/// What a manifest says of bench, rig and people, beside the drives.
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
    /// The folders, and how their runs ended.
    runs: [(String, String); 2],
    /// Configuration keys that differ.
    configuration: Vec<Difference>,
    /// Differences in bench, rig and people, from the manifests.
    setting: Vec<Difference>,
    /// The figures of both runs, in pairs.
    figures: Vec<[Figure; 2]>,
    /// Reasons to doubt the comparison.
    warnings: Vec<String>,
}

impl Comparison {
    /// Compares `a` with `b`.
    pub fn of(a: &Run, b: &Run) -> Self {
        let mut warnings = Vec::new();
        let mut keys = Vec::new();
        for Run { folder, .. } in [a, b] {
            warnings.extend(folder.caution().map(|caution| format!("{}: {caution}", folder.dir)));
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
        let side = |value: &Option<String>| value.clone().unwrap_or_else(|| "-".to_owned());
        let row = |Difference { key, a, b }: &Difference| {
            vec![format!("  {key}"), escaped(&format!("{} → {}", side(a), side(b))).into_owned()]
        };
        let rows = |all: &[Difference]| all.iter().map(row).collect::<Vec<_>>();
        let figures = self.figures.iter().map(|[a, b]| {
            let difference = difference(a, b).map(|by| format!("{by:+.*}", a.decimals));
            let label = match a.label == b.label {
                true => format!("  {}", a.label),
                false => format!("  {}; b: {}", a.label, b.label),
            };
            [label, a.value_text(), b.value_text(), side(&difference), a.unit.to_owned()]
        });
        let more = context! {
            differences => [("configuration", rows(&self.configuration)), ("setting", rows(&self.setting))],
            rows => figures.collect::<Vec<_>>(),
        };
        screen(include_str!("compare.txt"), &self.to_json(), more)
    }

    /// One JSON object, units in its keys.
    pub fn to_json(&self) -> Value {
        let differ = |all: &[Difference]| -> Map<String, Value> {
            let each =
                |Difference { key, a, b }: &Difference| (key.clone(), json!({ "a": a, "b": b }));
            all.iter().map(each).collect()
        };
        let figure = |[a, b]: &[Figure; 2]| {
            let values = json!({ "a": a.value, "b": b.value, "b_minus_a": difference(a, b) });
            (a.key.clone(), values)
        };
        let [a, b] = &self.runs;
        json!({
            "a": { "run_dir": a.0, "ending": a.1 },
            "b": { "run_dir": b.0, "ending": b.1 },
            "configuration": differ(&self.configuration),
            "setting": differ(&self.setting),
            "figures": self.figures.iter().map(figure).collect::<Map<_, _>>(),
            "warnings": self.warnings,
        })
    }
}

/// `None` for figures of different kinds, such as a true and an estimated distance.
fn difference(a: &Figure, b: &Figure) -> Option<f64> {
    let difference = b.value? - a.value?;
    (a.label == b.label).then_some(difference)
}

/// The figures of both runs, in the order of the first; unknown figures are left out.
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

/// What a manifest says of bench, rig and people, other than the configuration.
fn setting(manifest: &Manifest) -> Keys {
    let all = serde_json::to_value(manifest).unwrap_or_default();
    let said = SETTING.into_iter().filter_map(|key| Some((key, all[key].as_str()?)));
    let said = said.map(|(key, value)| (key.to_owned(), value.to_owned()));
    let drives = manifest.drives.iter().map(|d| (format!("{} drive", d.axis), drive(d)));
    said.chain(drives).collect()
}

/// A drive's identity in one line.
pub(super) fn drive(drive: &DriveIdentity) -> String {
    let DriveIdentity { node, vendor_id, product_code, .. } = drive;
    let mut text = format!("node {node}, vendor {vendor_id:#010x}, product {product_code:#010x}");
    text.extend(drive.revision.map(|revision| format!(", revision {revision:#010x}")));
    text.extend(drive.serial.map(|serial| format!(", serial {serial}")));
    text
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
    fn a_run_is_as_itself() {
        let text = Comparison::of(&run(), &run()).to_text().unwrap();
        assert!(text.contains("configuration: the same\n\nsetting: the same\n"), "{text}");
    }

    #[test]
    fn json_has_both_and_the_difference() {
        let mut open = other();
        open.folder.condition = Condition::Open;
        let json = Comparison::of(&run(), &open).to_json();
        assert_eq!(json["configuration"]["observer.kind"]["b"], "\"coupled\"");
        assert_eq!(json["figures"]["off_plane_rms_mm"]["b_minus_a"], 0.25);
        assert_eq!(
            json["warnings"][0],
            "runs/b: the record is not closed; if its bench has ended, close it: needle-bench review runs/b --repair"
        );
    }
}
