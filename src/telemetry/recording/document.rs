//! The manifest, with the run's figures, as a page of the recording.

use super::Logged;
use crate::archive::Manifest;
use rerun::components::Text;
use rerun::{DynamicArchetype, RecordingStream, TextDocument};
use serde_json::Value;
use std::fmt::Write as _;

/// Logs the manifest as a page, and the outcome as a property.
pub(super) fn log_manifest(stream: &RecordingStream, manifest: &Manifest) -> Logged {
    let outcome = manifest.outcome.map_or("not ended".to_owned(), |outcome| outcome.to_string());
    stream.log_static("manifest", &TextDocument::from_markdown(page(manifest, &outcome)))?;
    let run = [
        ("version", &manifest.version),
        ("config_sha256", &manifest.config_sha256),
        ("bus", &manifest.bus),
        ("tracker", &manifest.tracker),
        ("outcome", &outcome),
    ];
    let run = run.into_iter().fold(DynamicArchetype::new("run"), |run, (name, text)| {
        run.with_component::<Text>(name, [Text::from(text.as_str())])
    });
    stream.send_property("run", &run)
}

/// The manifest as Markdown, the `outcome` first.
fn page(manifest: &Manifest, outcome: &str) -> String {
    let reason =
        manifest.stop_reason.as_ref().map_or(String::new(), |reason| format!(": {reason}"));
    let mut page = format!("# {}: {outcome}{reason}\n\n| | |\n|---|---|\n", manifest.name);
    let keys = serde_json::to_value(manifest).unwrap_or_default();
    // The seals of the files are of no use to a reader.
    for (key, value) in keys.as_object().into_iter().flatten().filter(|(key, _)| *key != "files") {
        add_rows(&mut page, key, value);
    }
    page
}

/// Adds a row for a value, or a row for each of its parts.
fn add_rows(page: &mut String, key: &str, value: &Value) {
    let text = match value {
        Value::Object(parts) => {
            let add_part =
                |(part, value): (&String, _)| add_rows(page, &format!("{key} {part}"), value);
            return parts.iter().for_each(add_part);
        }
        Value::Array(parts) => {
            let add_element = |(value, n)| add_rows(page, &format!("{key} {n}"), value);
            return parts.iter().zip(1..).for_each(add_element);
        }
        Value::String(text) => cell(text),
        Value::Number(number) if number.is_f64() => {
            format!("{:.4}", number.as_f64().unwrap_or(f64::NAN))
        }
        Value::Null => "–".to_owned(),
        other => other.to_string(),
    };
    let _ = writeln!(page, "| {key} | {text} |");
}

/// `text` for a cell of a Markdown table, in which a bar or a newline would end the cell.
pub(super) fn cell(text: &str) -> String {
    text.replace('|', "\\|").replace('\n', " ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn each_figure_of_a_manifest_has_a_row() {
        let mut manifest = Manifest::new("virtual", "2026-01-01T00:00:00Z".to_owned());
        manifest.note = Some("a | b".to_owned());
        let figures = json!({ "steps": 3, "final_error": { "x_mm": 0.123456, "y_mm": null } });
        manifest.figures = figures.as_object().cloned().unwrap_or_default();
        let page = page(&manifest, "not ended");
        assert!(page.starts_with("# virtual: not ended\n"), "{page}");
        assert!(page.contains("| note | a \\| b |\n"), "{page}");
        let rows = "| figures steps | 3 |\n| figures final_error x_mm | 0.1235 |\n\
                    | figures final_error y_mm | – |\n";
        assert!(page.contains(rows), "{page}");
    }
}
