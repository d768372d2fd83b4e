//! Numbers, times and tables as text.

use crate::archive::{Manifest, RunOutcome};

/// `value` with `decimals`; an infinite value means that it was never reached.
pub(super) fn number(value: f64, decimals: usize) -> String {
    if value == f64::INFINITY { "never".to_owned() } else { format!("{value:.decimals$}") }
}

/// `value`, or a dash.
pub(super) fn optional(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| "-".to_owned(), |value| number(value, decimals))
}

/// `2026-03-01 14:30:00 UTC` from `2026-03-01T14:30:00.123456Z`; other text is unchanged.
pub(super) fn utc(rfc3339: &str) -> String {
    match (rfc3339.get(..10), rfc3339.get(10..11), rfc3339.get(11..19)) {
        (Some(date), Some("T"), Some(time)) => format!("{date} {time} UTC"),
        _ => rfc3339.to_owned(),
    }
}

/// How a run ended, with the reason if it was stopped.
pub(super) fn ending(manifest: &Manifest) -> String {
    match (manifest.outcome, &manifest.stop_reason) {
        (None, _) => "not closed: the bench was ended before the run was".to_owned(),
        (Some(RunOutcome::Completed), _) => "completed".to_owned(),
        (Some(RunOutcome::Stopped), Some(reason)) => format!("stopped: {}", plain(reason)),
        (Some(RunOutcome::Stopped), None) => "stopped".to_owned(),
    }
}

/// `text` on one line, without control characters.
pub fn plain(text: &str) -> String {
    text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect()
}

/// `n things`, or `1 thing`.
pub(super) fn count(n: usize, thing: &str) -> String {
    if n == 1 { format!("1 {thing}") } else { format!("{n} {thing}s") }
}

/// Lines from rows of cells. Each column is as wide as its widest cell. The first and the last
/// column are aligned left, the others right.
pub(super) fn table(rows: &[Vec<String>]) -> Vec<String> {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |column: usize| {
        rows.iter().filter_map(|row| row.get(column)).map(|cell| cell.chars().count()).max()
    };
    let widths: Vec<usize> = (0..columns).map(|column| width(column).unwrap_or(0)).collect();
    let line = |row: &Vec<String>| {
        let cells = row.iter().zip(&widths).enumerate().map(|(column, (cell, width))| {
            if column == 0 || column + 1 == columns {
                format!("{cell:<width$}")
            } else {
                format!("{cell:>width$}")
            }
        });
        cells.collect::<Vec<_>>().join("  ").trim_end().to_owned()
    };
    rows.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_people_read() {
        assert_eq!(utc("2026-03-01T14:30:00.123456Z"), "2026-03-01 14:30:00 UTC");
        assert_eq!(utc("yesterday"), "yesterday");
        assert_eq!(number(f64::INFINITY, 1), "never");
        assert_eq!(optional(Some(0.15), 1), "0.1");
        assert_eq!(plain("a\n\u{1b}[1mb"), "a  [1mb");
        assert_eq!((count(1, "run"), count(2, "run")), ("1 run".to_owned(), "2 runs".to_owned()));
    }

    #[test]
    fn columns_are_as_wide_as_their_widest_cell() {
        let rows = [["a", "1.0", "x y"], ["long", "100.0", ""]];
        let rows = rows.map(|row| row.map(str::to_owned).to_vec());
        assert_eq!(table(&rows), ["a       1.0  x y", "long  100.0"]);
    }
}
