//! `report.html`: one run on one self-contained page. It loads no script, font or picture.

mod chart;
mod curves;

use self::chart::Chart;
use super::compare::drive;
use super::figures::{Figure, last_third};
use super::run::{Run, utc};
use super::summary::{positions, record_warnings};
use crate::archive::{EventKind, RunOutcome};
use crate::session::Severity;
use crate::study::TipError;
use crate::text::{fixed, is_unprintable};
use minijinja::value::Serde;
use minijinja::{
    AutoEscape, Environment, Error, UndefinedBehavior, Value, context, escape_formatter,
};

const PAGE: &str = include_str!("page.html");
const CSS: &str = include_str!("page.css");
const CHART: &str = include_str!("chart.svg");

/// The mark by which this program recognises its own pages.
pub const GENERATOR: &str = "<meta name=\"generator\" content=\"needle-bench\">";

/// The page of `run`.
///
/// # Errors
/// A fault in the template `page.html`.
pub fn html(run: &Run) -> Result<String, Error> {
    let mut environment = Environment::new();
    environment.set_undefined_behavior(UndefinedBehavior::Strict);
    environment.add_filter("fixed", fixed);
    environment.add_template("chart.svg", CHART)?;
    environment.set_auto_escape_callback(|_| AutoEscape::Html);
    environment.set_formatter(|out, state, value| match value.is_none() {
        true => Ok(()),
        false => escape_formatter(out, state, value),
    });
    let Run { folder, .. } = run;
    let manifest = &folder.manifest;
    let limits = folder.limits().unwrap_or_default();
    let report = folder.figures();
    let shown = run.shown_figures();
    let rms = format!("RMS over {}", last_third(folder, report.as_ref()));
    let report = report.unwrap_or_default();
    let errors = [(rms.as_str(), report.estimate_rms), ("at the last step", report.final_error)];
    let page = environment.template_from_str(PAGE)?.render(context! {
        generator => Value::from_safe_string(GENERATOR.to_owned()),
        css => Value::from_safe_string(CSS.to_owned()),
        title => format!("{} {}", manifest.name, utc(&manifest.started_utc)),
        is_completed => manifest.outcome == Some(RunOutcome::Completed),
        ending => folder.ending(),
        verdict => manifest.verdict().map(|v| format!("{}: {}", v.verdict, v.reason)),
        manifest => Value::from(Serde(manifest.clone())),
        warnings => record_warnings(run),
        figures => shown.into_iter().map(figure).collect::<Vec<_>>(),
        errors => errors.into_iter().filter_map(error_row).collect::<Vec<_>>(),
        charts => curves::curves(run, &limits).iter().map(Chart::drawing).collect::<Vec<_>>(),
        states => Value::from(Serde(run.states())),
        hazards => hazard_events(run),
        drives => manifest.drives.iter().map(|d| (d.axis.to_string(), drive(d))).collect::<Vec<_>>(),
        positions => positions(&manifest.gates),
        config_toml => folder.config_toml.as_deref().unwrap_or_default(),
    })?;
    // HTML does not allow control characters; other unprintable characters can change how text reads.
    let is_bad = |c: char| is_unprintable(c) && c != '\n' && c != '\t';
    Ok(page.replace(is_bad, "\u{FFFD}"))
}

fn figure(figure: Figure) -> Value {
    let Figure { label, unit, limit, .. } = &figure;
    context! {
        label,
        value => format!("{} {unit}", figure.value_text()),
        limit => limit.map(|_| format!("{} {unit}", figure.limit_text())),
        is_outside => figure.is_outside(),
    }
}

fn error_row((label, error): (&str, Option<TipError>)) -> Option<(String, Vec<String>)> {
    let values = error?.coordinates().into_iter().zip([3, 3, 3, 2, 2, 2]);
    let values = values.map(|(value, decimals)| fixed(Some(value), decimals));
    Some((label.to_owned(), values.collect()))
}

/// The warnings and faults, each with the depth at which it occurred.
fn hazard_events(run: &Run) -> Vec<Value> {
    let depth_mm = run.depth_over_time();
    let events = run.events_from(Severity::Warning).map(|line| {
        let time_s = line.time.as_secs_f64();
        context! {
            time_s,
            insertion_mm => depth_mm(time_s),
            part => line.lane.to_string(),
            is_fault => line.kind == EventKind::Event(Severity::Fault),
            text => line.text.as_ref(),
        }
    });
    events.collect()
}

#[cfg(test)]
mod tests {
    use super::super::run::tests::run;
    use super::*;
    use crate::archive::EventLine;
    use std::borrow::Cow;

    #[test]
    fn hostile_text_is_escaped() {
        let mut run = run();
        let evil = "</style><script src=\"http://x\">alert('1')</script>\u{1b}";
        let manifest = &mut run.folder.manifest;
        manifest.name = evil.to_owned();
        manifest.note = Some(evil.to_owned());
        manifest.operator = Some(evil.to_owned());
        manifest.stop_reason = Some(evil.to_owned());
        manifest.outcome = Some(RunOutcome::Stopped);
        manifest.tracker = evil.to_owned();
        manifest.gates.insert(evil.to_owned(), evil.into());
        run.folder.config_toml = Some(format!("name = {evil:?}"));
        let last = run.events.last().cloned().unwrap();
        let kind = EventKind::Event(Severity::Fault);
        run.events.push(EventLine { text: Cow::Borrowed(evil), kind, ..last });
        let page = html(&run).unwrap();
        assert!(!page.contains("<script"), "{page}");
        assert!(!page.contains('\u{1b}'));
        assert_eq!(page.matches("</style>").count(), 1);
        assert!(
            page.contains("&lt;script src=&quot;http:&#x2f;&#x2f;x&quot;&gt;alert(&#x27;1&#x27;)")
        );
    }

    #[test]
    fn a_page_has_every_part_and_loads_nothing() {
        let page = html(&run()).unwrap();
        for part in ["Warnings", "Figures", "Curves", "States", "Manifest", "Configuration as used"]
        {
            assert!(page.contains(&format!("<h2>{part}</h2>")), "{part}");
        }
        for load in ["http:", "https:", "url(", "@import", "<link", "<script", "<img"] {
            assert!(!page.contains(load), "{load}");
        }
        assert!(page.contains("1300 µs"), "the figure outside its limit");
    }

    #[test]
    fn a_run_without_rows_has_a_page() {
        let mut run = run();
        run.steps = Default::default();
        run.events.clear();
        run.folder.manifest.figures.clear();
        let page = html(&run).unwrap();
        assert!(!page.contains("<h2>Curves</h2>") && page.contains("<h2>Figures</h2>"));
    }
}
