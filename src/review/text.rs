//! Times, endings and counts as text.

use crate::archive::{Manifest, RunOutcome};

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_people_read() {
        assert_eq!(utc("2026-03-01T14:30:00.123456Z"), "2026-03-01 14:30:00 UTC");
        assert_eq!(utc("yesterday"), "yesterday");
        assert_eq!(plain("a\n\u{1b}[1mb"), "a  [1mb");
        assert_eq!((count(1, "run"), count(2, "run")), ("1 run".to_owned(), "2 runs".to_owned()));
    }
}
