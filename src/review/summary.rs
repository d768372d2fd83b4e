//! One run on one screen.

use super::figures::{Figure, last_third};
use super::run::{Run, utc};
use crate::archive::{Dropped, VerdictKind};
use crate::session::{PROVED, Severity};
use crate::text::{escaped, screen};
use minijinja::context;
use minijinja::value::Serde;
use serde_json::{Map, Value, json};

/// The states of `run`, its figures with their limits, its warnings, and how it ended.
/// `report` is the path of its HTML report.
///
/// # Errors
/// A fault in the template `run.txt`.
pub fn to_text(run: &Run, report: Option<&str>) -> Result<String, minijinja::Error> {
    let folder = &run.folder;
    let manifest = &folder.manifest;
    let figures = folder.figures();
    let proofs = run.events_from(Severity::Info).filter(|line| line.text.starts_with(PROVED));
    let verdict = manifest.verdict().map(|verdict| {
        let (reason, given) = (escaped(&verdict.reason), utc(&verdict.given_utc));
        format!("{}, {reason} ({given})", verdict.verdict)
    });
    let more = context! {
        rehearsal => manifest.rehearsal.as_deref(),
        started => utc(&manifest.started_utc),
        record => format!("{}: {}", folder.dir, folder.condition_name()),
        report,
        positions => positions(&manifest.gates),
        states => minijinja::Value::from(Serde(run.states())),
        rows => run.shown_figures().into_iter().map(row).collect::<Vec<_>>(),
        third => last_third(folder, figures.as_ref()),
        rms => figures.as_ref().and_then(|it| it.estimate_rms).map(|error| error.to_string()),
        final_error => figures.as_ref().and_then(|it| it.final_error).map(|error| error.to_string()),
        warnings => warnings(run),
        proofs => proofs.map(|line| line.text.to_string()).collect::<Vec<_>>(),
        verdict,
        ending => folder.ending(),
    };
    screen(include_str!("run.txt"), manifest, more)
}

/// The numbers of tip positions, such as `5015 accepted, 12 refused (8 innovation, 4 status)`.
pub(super) fn positions(gates: &Map<String, Value>) -> Option<String> {
    let accepted = gates.get("accepted")?;
    let by_gate = gates.get("refused").and_then(Value::as_object)?;
    let all: u64 = by_gate.values().filter_map(Value::as_u64).sum();
    let gates: Vec<String> = by_gate.iter().map(|(gate, n)| format!("{n} {gate}")).collect();
    let gates = if gates.is_empty() { String::new() } else { format!(" ({})", gates.join(", ")) };
    Some(format!("{accepted} accepted, {all} refused{gates}"))
}

fn row(figure: Figure) -> [String; 4] {
    let mark = if figure.is_outside() { "  OUTSIDE" } else { "" };
    let limit = figure.limit_text() + mark;
    [figure.label.clone(), figure.value_text(), format!("{:<3}", figure.unit), limit]
}

/// The run as one JSON object, units in its keys.
pub fn to_json(run: &Run) -> Value {
    let manifest = &run.folder.manifest;
    let figures = run.limited_figures();
    let limit = |figure: &Figure| Some((figure.key.clone(), json!(figure.limit?)));
    let limits: Map<String, Value> = figures.iter().filter_map(limit).collect();
    let outside = figures.iter().filter(|figure| figure.is_outside()).map(|figure| &figure.key);
    let value = |figure: &Figure| match figure.value {
        Some(count) if figure.decimals == 0 && figure.unit.is_empty() => json!(count as i64),
        value => json!(value),
    };
    let all = run.all_figures().into_iter().map(|figure| (figure.key.clone(), value(&figure)));
    json!({
        "run_dir": run.folder.dir,
        "name": manifest.name,
        "operation": manifest.operation,
        "rehearsal": manifest.rehearsal,
        "started_utc": manifest.started_utc,
        "duration_s": manifest.duration_s,
        "outcome": manifest.outcome,
        "stop_reason": manifest.stop_reason,
        "plan_status": run.folder.plan_status(),
        "condition": run.folder.condition_name(),
        "verdict": manifest.verdict(),
        "operator": manifest.operator,
        "phantom": manifest.phantom,
        "note": manifest.note,
        "figures": all.collect::<Map<_, _>>(),
        "limits": limits,
        "outside": outside.collect::<Vec<_>>(),
        "warnings": warnings(run),
        "states": run.states(),
    })
}

/// The warnings of `run`, the most serious first; its events with their times come last.
fn warnings(run: &Run) -> Vec<String> {
    let mut all = record_warnings(run);
    let depth_mm = run.depth_over_time();
    all.extend(run.events_from(Severity::Warning).map(|line| {
        let time_s = line.time.as_secs_f64();
        let depth = depth_mm(time_s).map(|mm| format!(" at {mm:.1} mm"));
        format!("{time_s:.3} s{}, {}: {}", depth.unwrap_or_default(), line.lane, line.text)
    }));
    all
}

/// The warnings of `run` other than its events, the most serious first.
pub(super) fn record_warnings(run: &Run) -> Vec<String> {
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
        all.push(format!(
            "{label}: {} {unit}, must be {}",
            figure.value_text(),
            figure.limit_text()
        ));
    }
    for (key, what) in [
        ("syncs_late", "SYNCs sent late"),
        ("syncs_skipped", "SYNCs skipped"),
        ("feedback_missed", "SYNCs not answered by both drives"),
        ("frames_dropped", "frames lost before the bench took them"),
    ] {
        if let Some(times) = manifest.timing.get(key).and_then(Value::as_u64).filter(|n| *n > 0) {
            all.push(format!("{what}: {times}"));
        }
    }
    if manifest.git.as_deref().is_some_and(|git| git.ends_with("-dirty")) {
        all.push("the bench was built from uncommitted changes".to_owned());
    }
    all
}

#[cfg(test)]
mod tests {
    use super::super::run::tests::run;
    use super::*;
    use crate::archive::Verdict;
    use crate::review::run::Condition;

    #[test]
    fn a_run_on_one_screen() {
        let mut run = run();
        let manifest = &mut run.folder.manifest;
        let gates = json!({ "accepted": 5015, "refused": { "innovation": 8, "status": 4 } });
        manifest.gates = gates.as_object().unwrap().clone();
        manifest.operator = Some("J. Doe".to_owned());
        manifest.phantom = Some("gelatin 10 %".to_owned());
        manifest.note = Some("third try".to_owned());
        manifest.verdicts.push(Verdict {
            verdict: VerdictKind::Invalid,
            reason: "wrong gain".to_owned(),
            given_utc: "2023-11-15T08:00:00.000000Z".to_owned(),
        });
        insta::assert_snapshot!(to_text(&run, Some("runs/a/report.html")).unwrap());
    }

    #[test]
    fn json_has_units_in_its_keys() {
        let json = to_json(&run());
        assert_eq!(json["figures"]["off_plane_rms_mm"], 0.5);
        assert_eq!(json["figures"]["final_error.roll_deg"], Value::Null);
        assert_eq!(json["limits"]["off_plane_rms_mm"], 1.0);
        assert_eq!(json["outside"], json!(["sync_late_us_max"]));
        assert_eq!(json["states"][2]["insertion_mm"], 1.5);
        assert_eq!(json["verdict"], Value::Null);
    }

    #[test]
    fn a_good_run_has_only_its_events_as_warnings() {
        let mut run = run();
        run.folder.manifest.timing.clear();
        assert_eq!(
            warnings(&run),
            ["3.500 s at 1.5 mm, tracker: last tip 0.51 s old (limit 0.50)"]
        );
    }

    #[test]
    fn every_reason_to_doubt_a_run_is_a_warning() {
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
        assert!(said.contains(&"SYNCs skipped: 2".to_owned()), "{said:?}");
        assert!(said.contains(&"the bench was built from uncommitted changes".to_owned()));
    }

    /// The limits of the default configuration need not be those of the run.
    #[test]
    fn without_its_configuration_a_run_has_no_limits() {
        let mut run = run();
        assert!(run.limited_figures().iter().any(|figure| figure.limit.is_some()));
        run.folder.config_toml = None;
        let of_configuration = ["off_plane_rms_mm", "following_error_mm_max", "insertion_mm"];
        let mut figures = run.limited_figures();
        figures.retain(|figure| of_configuration.contains(&figure.key.as_str()));
        assert_eq!(figures.len(), 3);
        assert!(figures.iter().all(|figure| figure.limit.is_none()));
        let said = "the limits are unknown, because the configuration cannot be read: config.toml is missing";
        assert!(warnings(&run).contains(&said.to_owned()), "{:?}", warnings(&run));
    }
}
