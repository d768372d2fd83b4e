//! The manifest and the configuration as pages of the recording.

use crate::archive::Manifest;
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
    for (key, value) in &manifest.timing {
        row(key, value);
    }
    page
}

/// The configuration as a block of TOML.
pub(super) fn config(config_toml: &str) -> String {
    format!("# Configuration as used\n\n```toml\n{config_toml}\n```\n")
}
