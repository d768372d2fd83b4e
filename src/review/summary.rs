//! One run on one screen.

use super::figures::{Figure, last_third};
use super::run::{Run, utc};
use super::warnings::warnings;
use crate::session::{PROVED, Severity};
use crate::text::{escaped, screen};
use minijinja::context;
use minijinja::value::Serde;
use serde_json::{Map, Value, json};

/// The course of `run`, its figures with their limits, its warnings, and last how it ended.
/// `report` is the path of its page.
///
/// # Errors
/// A fault in the template `run.txt`.
pub fn to_text(run: &Run, report: Option<&str>) -> Result<String, minijinja::Error> {
    let folder = &run.folder;
    let manifest = &folder.manifest;
    let figures = run.figures();
    let known = run.limited_figures().into_iter().filter(|figure| figure.value.is_some());
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
        positions => tracker(&manifest.gates),
        states => minijinja::Value::from(Serde(run.states())),
        rows => known.map(row).collect::<Vec<_>>(),
        third => last_third(folder, &figures),
        rms => figures.estimate_rms.map(|error| error.to_string()),
        final_error => figures.final_error.map(|error| error.to_string()),
        warnings => warnings(run),
        proofs => proofs.map(|line| line.text.to_string()).collect::<Vec<_>>(),
        verdict,
        ending => folder.ending(),
    };
    screen(include_str!("run.txt"), manifest, more)
}

/// `5015 accepted, 12 refused (8 innovation, 4 status)`.
pub(super) fn tracker(gates: &Map<String, Value>) -> Option<String> {
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
    let all: Map<String, Value> = run.all_figures().iter().map(key_value).collect();
    json!({
        "run_dir": run.folder.dir,
        "name": manifest.name,
        "operation": manifest.operation,
        "rehearsal": manifest.rehearsal,
        "started_utc": manifest.started_utc,
        "duration_s": manifest.duration_s,
        "outcome": manifest.outcome,
        "stop_reason": manifest.stop_reason,
        "condition": run.folder.condition_name(),
        "verdict": manifest.verdict(),
        "operator": manifest.operator,
        "phantom": manifest.phantom,
        "note": manifest.note,
        "figures": all,
        "limits": limits,
        "outside": outside.collect::<Vec<_>>(),
        "warnings": warnings(run),
        "states": run.states(),
    })
}

/// A figure's key and value in JSON.
fn key_value(figure: &Figure) -> (String, Value) {
    let value = match figure.value {
        Some(count) if figure.decimals == 0 && figure.unit.is_empty() => json!(count as i64),
        value => json!(value),
    };
    (figure.key.clone(), value)
}

#[cfg(test)]
mod tests {
    use super::super::run::tests::run;
    use super::*;
    use crate::archive::{Verdict, VerdictKind};

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
}
