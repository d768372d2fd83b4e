//! The manifest with the run's figures, and the configuration, as pages of the recording.

use crate::archive::Manifest;
use serde_json::Value;
use std::fmt::Write as _;

/// The manifest as Markdown, the outcome first.
pub(super) fn manifest(manifest: &Manifest) -> String {
    let outcome = match (manifest.outcome, &manifest.stop_reason) {
        (None, _) => "not ended".to_owned(),
        (Some(outcome), None) => outcome.to_string(),
        (Some(outcome), Some(reason)) => format!("{outcome}: {reason}"),
    };
    let mut page = format!("# {}: {outcome}\n\n| | |\n|---|---|\n", manifest.name);
    let mut row = |key: &str, value: &dyn std::fmt::Display| {
        // Cells of a Markdown table end at a bar and at a line's end.
        let value = value.to_string().replace('|', "\\|").replace('\n', " ");
        let _ = writeln!(page, "| {key} | {value} |");
    };
    let unknown = || "unknown".to_owned();
    row("started", &manifest.started_utc);
    row("ended", &manifest.ended_utc.clone().unwrap_or_else(unknown));
    row(
        "duration on the run's time line",
        &manifest.duration_s.map_or_else(unknown, |s| format!("{s:.3} s")),
    );
    row("bus", &manifest.bus);
    for drive in &manifest.drives {
        let identity = format!(
            "node {}, vendor {:#010x}, product {:#010x}, revision {}, serial {}",
            drive.node,
            drive.vendor_id,
            drive.product_code,
            drive.revision.map_or_else(unknown, |r| format!("{r:#010x}")),
            drive.serial.map_or_else(unknown, |s| s.to_string()),
        );
        row(&format!("{} drive", drive.axis), &identity);
    }
    row("tracker", &manifest.tracker);
    row("seed", &manifest.seed.map_or_else(|| "none".to_owned(), |s| s.to_string()));
    row("version", &manifest.version);
    row("git", &manifest.git.clone().unwrap_or_else(unknown));
    row("config SHA-256", &manifest.config_sha256);
    for (key, value) in [("operator", &manifest.operator), ("phantom", &manifest.phantom)] {
        if let Some(value) = value {
            row(key, value);
        }
    }
    if let Some(note) = &manifest.note {
        row("note", note);
    }
    for (title, map) in [
        ("Figures", &manifest.figures),
        ("Tracker samples", &manifest.gates),
        ("Timing", &manifest.timing),
    ] {
        if !map.is_empty() {
            let _ = write!(page, "\n## {title}\n\n| | |\n|---|---|\n");
            map.iter().for_each(|(key, value)| rows(&mut page, key, value));
        }
    }
    page
}

/// A figure as a row, or as one for each of its parts.
fn rows(page: &mut String, key: &str, value: &Value) {
    let _ = match value {
        Value::Object(parts) => {
            parts.iter().for_each(|(part, value)| rows(page, &format!("{key} {part}"), value));
            Ok(())
        }
        Value::Number(number) => match number.as_f64() {
            Some(value) if !number.is_i64() && !number.is_u64() => {
                writeln!(page, "| {key} | {value:.4} |")
            }
            _ => writeln!(page, "| {key} | {number} |"),
        },
        Value::Null => writeln!(page, "| {key} | – |"),
        other => writeln!(page, "| {key} | {other} |"),
    };
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
        let rows = "## Figures\n\n| | |\n|---|---|\n| steps | 3 |\n| final_error x_mm | 0.1235 |\n\
                    | final_error y_mm | – |\n";
        assert!(page.contains(rows), "{page}");
    }
}
