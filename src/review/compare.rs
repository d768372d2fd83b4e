//! Two runs side by side: differences in their settings, then their figures.

use super::configuration::{Difference, differences};
use super::figures::{Figure, errors};
use super::run::Run;
use super::text::{plain, table};
use crate::archive::{DriveIdentity, Manifest};
use serde_json::{Map, Value, json};

/// The differences between two runs, and their figures.
#[derive(Debug, Clone, PartialEq)]
pub struct Comparison {
    runs: [Heading; 2],
    /// Configuration keys that differ.
    configuration: Vec<Difference>,
    /// Differences in bench, rig and people, from the manifests.
    setting: Vec<Difference>,
    /// The figures of both runs, in pairs.
    figures: Vec<[Figure; 2]>,
    /// Reasons to doubt the comparison.
    cautions: Vec<String>,
}

#[derive(Debug, Clone, PartialEq)]
struct Heading {
    dir: String,
    ending: String,
}

impl Comparison {
    /// Compares `a` with `b`.
    pub fn of(a: &Run, b: &Run) -> Self {
        let of = |run: &Run, what: String| format!("{}: {what}", run.folder.dir);
        let caution = |run: &Run| Some(of(run, run.folder.caution()?));
        let mut cautions: Vec<String> = [a, b].into_iter().filter_map(caution).collect();
        let mut read = |run: &Run| {
            run.folder.keys().unwrap_or_else(|error| {
                cautions.push(of(run, format!("configuration: {error}")));
                Default::default()
            })
        };
        let configuration = differences(&read(a), &read(b));
        let setting = setting(&a.folder.manifest, &b.folder.manifest);
        let heading =
            |run: &Run| Heading { dir: run.folder.dir.clone(), ending: run.folder.ending() };
        Comparison {
            runs: [heading(a), heading(b)],
            configuration,
            setting,
            figures: figures(a, b),
            cautions,
        }
    }

    /// One screen.
    pub fn to_text(&self) -> String {
        let names = ["a", "b"];
        let heads = names.iter().zip(&self.runs);
        let mut lines: Vec<String> =
            heads.map(|(name, run)| format!("{name}  {}: {}", run.dir, run.ending)).collect();
        lines.extend(self.cautions.iter().map(|caution| format!("warning  {caution}")));
        for (title, differences) in
            [("configuration", &self.configuration), ("setting", &self.setting)]
        {
            lines.push(String::new());
            if differences.is_empty() {
                lines.push(format!("{title}: the same"));
                continue;
            }
            lines.push(format!("{title}, where they differ"));
            let side = |value: &Option<String>| value.clone().unwrap_or_else(|| "-".to_owned());
            let rows = differences.iter().map(|Difference { key, a, b }| {
                vec![format!("  {key}"), plain(&format!("{} → {}", side(a), side(b)))]
            });
            lines.extend(table(&rows.collect::<Vec<_>>()));
        }
        lines.push(String::new());
        let cells = |cells: [&str; 5]| cells.map(str::to_owned).to_vec();
        let mut rows = vec![cells(["figures", "a", "b", "b − a", ""])];
        for [a, b] in &self.figures {
            let decimals = a.decimals;
            let difference = difference(a, b).map(|difference| format!("{difference:+.decimals$}"));
            let difference = difference.unwrap_or_else(|| "-".to_owned());
            let label = match a.label == b.label {
                true => format!("  {}", a.label),
                false => format!("  {}; b: {}", a.label, b.label),
            };
            rows.push(cells([&label, &a.value_text(), &b.value_text(), &difference, a.unit]));
        }
        lines.extend(table(&rows));
        lines.join("\n")
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
            "a": { "run_dir": a.dir, "ending": a.ending },
            "b": { "run_dir": b.dir, "ending": b.ending },
            "configuration": differ(&self.configuration),
            "setting": differ(&self.setting),
            "figures": self.figures.iter().map(figure).collect::<Map<_, _>>(),
            "warnings": self.cautions,
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
    let all = |run: &Run| {
        let mut all = run.limited_figures();
        all.extend(errors(&run.folder, &run.figures()));
        all
    };
    let (a, b) = (all(a), all(b));
    let unknown = |figure: &Figure| Figure { value: None, ..figure.clone() };
    let only_b = b.iter().filter(|figure| a.iter().all(|other| other.key != figure.key));
    let pairs = a.iter().map(|figure| {
        let other = b.iter().find(|other| other.key == figure.key);
        [figure.clone(), other.cloned().unwrap_or_else(|| unknown(figure))]
    });
    let pairs = pairs.chain(only_b.map(|figure| [unknown(figure), figure.clone()]));
    pairs.filter(|pair| pair.iter().any(|figure| figure.value.is_some())).collect()
}

/// Differences between the manifests, other than the configuration.
fn setting(a: &Manifest, b: &Manifest) -> Vec<Difference> {
    let [a, b] = [a, b].map(|manifest| {
        let mut said = vec![
            ("version".to_owned(), Some(manifest.version.clone())),
            ("git".to_owned(), manifest.git.clone()),
            ("calibration_sha256".to_owned(), manifest.calibration_sha256.clone()),
            ("bus".to_owned(), Some(manifest.bus.clone())),
            ("tracker".to_owned(), Some(manifest.tracker.clone())),
            ("operator".to_owned(), manifest.operator.clone()),
            ("phantom".to_owned(), manifest.phantom.clone()),
            ("note".to_owned(), manifest.note.clone()),
            ("operation".to_owned(), manifest.operation.clone()),
        ];
        said.extend(manifest.drives.iter().map(|d| (format!("{} drive", d.axis), Some(drive(d)))));
        let said = said.into_iter().filter_map(|(key, value)| Some((key, value?)));
        said.collect()
    });
    differences(&a, &b)
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
        let text = Comparison::of(&run(), &other()).to_text();
        let configuration = text.find("observer.kind  \"invariant\" → \"coupled\"").unwrap();
        let setting = text.find("git  - → abc").unwrap();
        let figures = text.find("off plane").unwrap();
        assert!(configuration < setting && setting < figures, "{text}");
        let line = text.lines().find(|line| line.contains("off plane")).unwrap();
        assert!(line.contains("0.500  0.750  +0.250  mm"), "{line}");
    }

    #[test]
    fn a_run_is_as_itself() {
        let text = Comparison::of(&run(), &run()).to_text();
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
