//! The manifest with the run's figures, and the configuration, as pages of the recording.

use crate::archive::Manifest;
use serde_json::{Map, Value};
use std::fmt::Write as _;

/// The manifest as Markdown, the outcome first.
pub(super) fn manifest(manifest: &Manifest) -> String {
    let outcome = match (manifest.outcome, &manifest.stop_reason) {
        (None, _) => "not ended".to_owned(),
        (Some(outcome), None) => outcome.to_string(),
        (Some(outcome), Some(reason)) => format!("{outcome}: {reason}"),
    };
    let mut page = format!("# {}: {outcome}\n\n{TABLE}", manifest.name);
    let mut keys = match serde_json::to_value(manifest) {
        Ok(Value::Object(keys)) => keys,
        _ => Map::new(),
    };
    // The seals are for programs.
    keys.retain(|key, value| !value.is_null() && key != "files");
    for (key, value) in keys.iter().filter(|(_, value)| !value.is_object()) {
        rows(&mut page, key, value);
    }
    for (title, values) in keys.iter().filter_map(|(key, value)| Some((key, value.as_object()?))) {
        let _ = write!(page, "\n## {title}\n\n{TABLE}");
        values.iter().for_each(|(key, value)| rows(&mut page, key, value));
    }
    page
}

const TABLE: &str = "| | |\n|---|---|\n";

/// A value as a row, or as one for each of its parts.
fn rows(page: &mut String, key: &str, value: &Value) {
    let text = match value {
        Value::Object(parts) => {
            return parts
                .iter()
                .for_each(|(part, value)| rows(page, &format!("{key} {part}"), value));
        }
        Value::Array(parts) => {
            let parts = parts.iter().zip(1..);
            return parts.for_each(|(value, n)| rows(page, &format!("{key} {n}"), value));
        }
        // Cells of a Markdown table end at a bar and at a line's end.
        Value::String(text) => text.replace('|', "\\|").replace('\n', " "),
        Value::Number(number) if number.is_f64() => {
            format!("{:.4}", number.as_f64().unwrap_or(f64::NAN))
        }
        Value::Null => "–".to_owned(),
        other => other.to_string(),
    };
    let _ = writeln!(page, "| {key} | {text} |");
}

/// The configuration as a block of TOML.
pub(super) fn config(config_toml: &str) -> String {
    format!("# Configuration as used\n\n```toml\n{config_toml}\n```\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn figures_stand_in_rows() {
        let mut manifest = Manifest::new("virtual", "2026-01-01T00:00:00Z".to_owned());
        manifest.note = Some("a | b".to_owned());
        let figures = json!({ "steps": 3, "final_error": { "x_mm": 0.123456, "y_mm": null } });
        manifest.figures = figures.as_object().cloned().unwrap_or_default();
        let page = super::manifest(&manifest);
        assert!(page.starts_with("# virtual: not ended\n"), "{page}");
        assert!(page.contains("| note | a \\| b |\n"), "{page}");
        let rows = "## figures\n\n| | |\n|---|---|\n| steps | 3 |\n| final_error x_mm | 0.1235 |\n\
                    | final_error y_mm | – |\n";
        assert!(page.contains(rows), "{page}");
    }
}
