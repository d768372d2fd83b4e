//! Warnings about a run: reasons to doubt its figures.

use super::figures::Figure;
use super::run::{Run, utc};
use crate::archive::{Dropped, VerdictKind};
use crate::session::Severity;
use crate::text::escaped;
use serde_json::Value;

/// The warnings of `run`, the most serious first; its events with their times come last.
pub fn warnings(run: &Run) -> Vec<String> {
    let mut all = doubts(run);
    all.extend(run.events_from(Severity::Warning).map(|line| {
        let time_s = line.time.as_secs_f64();
        let depth = run.insertion_mm_at(time_s).map(|mm| format!(" at {mm:.1} mm"));
        format!("{time_s:.3} s{}, {}: {}", depth.unwrap_or_default(), line.lane, line.text)
    }));
    all
}

/// The doubts about `run` other than its events, the most serious first.
pub(super) fn doubts(run: &Run) -> Vec<String> {
    let manifest = &run.folder.manifest;
    let mut all = Vec::new();
    all.extend(run.folder.caution());
    if let Some(verdict) = manifest.verdict().filter(|v| v.verdict == VerdictKind::Invalid) {
        all.push(format!("invalid: {}", escaped(&verdict.reason)));
    }
    if let Some(repaired) = &manifest.repaired_utc {
        all.push(format!("closed by a repair on {}, after the bench had ended", utc(repaired)));
    }
    all.extend(run.unreadable.iter().cloned());
    if let Err(error) = run.folder.limits() {
        all.push(format!(
            "the limits are unknown, because the configuration cannot be read: {error}"
        ));
    }
    if let Some(Dropped { text_files, recording, .. }) = manifest.dropped
        && text_files + recording > 0
    {
        all.push(format!(
            "not recorded: {text_files} records of the text files, {recording} of run.rrd"
        ));
    }
    all.extend(manifest.faults.iter().map(|fault| format!("record: {fault}")));
    for figure in run.limited_figures().iter().filter(|figure| figure.is_outside()) {
        let Figure { label, unit, .. } = figure;
        all.push(format!("{label}: {} {unit}, to be {}", figure.value_text(), figure.limit_text()));
    }
    for (key, what) in [
        ("syncs_late", "SYNC was sent late"),
        ("syncs_skipped", "SYNC was skipped"),
        ("feedback_missed", "SYNC was not answered by both drives"),
        ("frames_dropped", "frame was lost before the bench took it"),
    ] {
        if let Some(times) = manifest.timing.get(key).and_then(Value::as_u64).filter(|n| *n > 0) {
            all.push(format!("{what}: {times} times"));
        }
    }
    if manifest.git.as_deref().is_some_and(|git| git.ends_with("-dirty")) {
        all.push("the bench was built from uncommitted changes".to_owned());
    }
    all
}

#[cfg(test)]
mod tests {
    use super::super::run::Condition;
    use super::super::run::tests::run;
    use super::*;

    #[test]
    fn a_good_run_has_its_events_alone() {
        let mut run = run();
        run.folder.manifest.timing.clear();
        assert_eq!(
            warnings(&run),
            ["3.500 s at 1.5 mm, tracker: last tip 0.51 s old (limit 0.50)"]
        );
    }

    #[test]
    fn what_makes_a_run_doubtful_is_said() {
        let mut run = run();
        run.folder.condition = Condition::Open;
        run.folder.manifest.git = Some("abc-dirty".to_owned());
        run.folder.manifest.dropped = Some(Dropped { text_files: 3, ..Dropped::default() });
        run.folder.config_toml = Some("depth = 1".to_owned());
        let said = warnings(&run);
        assert!(
            said[0]
                .ends_with("if its bench has ended, close it: needle-bench review runs/a --repair")
        );
        assert!(
            said[1]
                .starts_with("the limits are unknown, because the configuration cannot be read: ")
        );
        assert!(said[2].starts_with("not recorded: 3 records of the text files"));
        assert!(said.contains(&"SYNC was skipped: 2 times".to_owned()), "{said:?}");
        assert!(said.contains(&"the bench was built from uncommitted changes".to_owned()));
    }

    /// The defaults have limits, but these need not be the run's limits.
    #[test]
    fn without_its_configuration_a_run_has_no_limits() {
        let mut run = run();
        assert!(run.limited_figures().iter().any(|figure| figure.limit.is_some()));
        run.folder.config_toml = None;
        let of_configuration = ["off_plane_rms_mm", "following_error_mm_max", "insertion_mm"];
        let figures = run.limited_figures();
        let mut figures = figures.iter().filter(|f| of_configuration.contains(&f.key.as_str()));
        assert!(figures.all(|figure| figure.limit.is_none()));
        let said = "the limits are unknown, because the configuration cannot be read: config.toml is missing";
        assert!(warnings(&run).contains(&said.to_owned()), "{:?}", warnings(&run));
    }
}
