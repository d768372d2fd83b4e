//! One run on one screen.

use super::figures::{Figure, errors, last_third};
use super::run::{Run, StateChange};
use super::text::{count, plain, utc};
use super::warnings::{shortened, warnings};
use crate::archive::Manifest;
use crate::session::{PROVED, Severity};
use crate::text::table;
use serde_json::{Map, Value, json};

/// Largest numbers of warnings and states on the screen.
const WARNINGS_MAX: usize = 10;
const STATES_MAX: usize = 8;

/// The course of `run`, its figures with their limits, its warnings, and last how it ended.
/// `report` is the path of its page.
pub fn to_text(run: &Run, report: Option<&str>) -> String {
    let manifest = &run.folder.manifest;
    let mut lines = heading(manifest);
    lines.extend(manifest.rehearsal.as_ref().map(|bus| {
        format!("rehearsal   emulated drives and tracker; {} was not opened", plain(bus))
    }));
    lines.push(format!("record      {}: {}", run.folder.dir, run.folder.condition_name()));
    lines.extend(report.map(|report| format!("report      {report}")));
    lines.extend(tracker(&manifest.gates).map(|said| format!("tracker     {said}")));
    let states = run.states();
    if !states.is_empty() {
        lines.push(format!("states      {}", course(&states)));
    }
    lines.push(String::new());
    let shown = run.limited_figures().into_iter().filter(|figure| figure.value.is_some());
    lines.extend(table(&shown.map(|figure| row(&figure)).collect::<Vec<_>>()));
    let report = run.figures();
    if let Some(rms) = report.estimate_rms {
        let third = last_third(&run.folder, &report);
        lines.push(format!("estimate    {rms} RMS over {third}"));
    }
    if let Some(error) = report.final_error {
        lines.push(format!("at the end  {error}"));
    }
    lines.push(String::new());
    let warnings = warnings(run);
    lines.extend(
        shortened(&warnings, WARNINGS_MAX).iter().map(|line| format!("warning     {line}")),
    );
    if warnings.is_empty() {
        lines.push("no warnings".to_owned());
    }
    let proofs = run.events_from(Severity::Info).filter(|line| line.text.starts_with(PROVED));
    lines.extend(proofs.map(|line| line.text.to_string()));
    if let Some(verdict) = manifest.verdict() {
        let (given, reason) = (utc(&verdict.given_utc), plain(&verdict.reason));
        lines.push(format!("verdict     {}, {reason} ({given})", verdict.verdict));
    }
    lines.push(run.folder.ending());
    lines.join("\n")
}

/// Name, time, people and equipment of the run.
fn heading(manifest: &Manifest) -> Vec<String> {
    let Manifest { name, started_utc, operator, phantom, note, version, bus, tracker, .. } =
        manifest;
    let mut first = format!("{name:<11} {}", utc(started_utc));
    first.extend(manifest.duration_s.map(|s| format!(", {s:.1} s")));
    first.extend(operator.iter().map(|operator| format!(", by {}", plain(operator))));
    first.extend(phantom.iter().map(|phantom| format!(", into {}", plain(phantom))));
    let git = manifest.git.as_deref().unwrap_or("git state unknown");
    let seed = manifest.seed.map(|seed| format!(", seed {seed}")).unwrap_or_default();
    let mut lines = vec![first];
    lines.extend(note.iter().map(|note| format!("note        {}", plain(note))));
    lines.push(format!("bench       {version} ({git}), bus {bus}, tracker {tracker}{seed}"));
    lines
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

/// `0.0 s preparing, 2.0 s inserting, 3.5 s holding at 1.5 mm`.
fn course(states: &[StateChange]) -> String {
    let one = |StateChange { time_s, insertion_mm, state }: &StateChange| {
        let depth = insertion_mm.map(|mm| format!(" at {mm:.1} mm")).unwrap_or_default();
        format!("{time_s:.1} s {state}{depth}")
    };
    let mut shown: Vec<String> = states.iter().take(STATES_MAX).map(one).collect();
    let more = states.len().saturating_sub(STATES_MAX);
    if more > 0 {
        shown.push(format!("and {} more", count(more, "change")));
    }
    shown.join(", ")
}

fn row(figure: &Figure) -> Vec<String> {
    let mark = if figure.is_outside() { "  OUTSIDE" } else { "" };
    let limit = figure.limit_text() + mark;
    vec![figure.label.clone(), figure.value_text(), format!("{:<3}", figure.unit), limit]
}

/// The run as one JSON object, units in its keys.
pub fn to_json(run: &Run) -> Value {
    let manifest = &run.folder.manifest;
    let figures = run.limited_figures();
    let limit = |figure: &Figure| Some((figure.key.clone(), json!(figure.limit?)));
    let limits: Map<String, Value> = figures.iter().filter_map(limit).collect();
    let outside = figures.iter().filter(|figure| figure.is_outside()).map(|figure| &figure.key);
    let errors = errors(&run.folder, &run.figures());
    let all: Map<String, Value> = figures.iter().chain(&errors).map(key_value).collect();
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
        insta::assert_snapshot!(to_text(&run, Some("runs/a/report.html")));
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
