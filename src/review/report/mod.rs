//! `report.html`: one run on one page that stands alone. No script, no font and no picture is
//! loaded from anywhere.

mod chart;
mod colour;
mod curves;

use self::chart::{Chart, Layer, Named};
use self::colour::css;
use super::compare::drive;
use super::figures::{Figure, last_third};
use super::run::Run;
use super::summary::tracker;
use super::text::{optional, utc};
use super::warnings::doubts;
use crate::archive::{EventKind, Manifest, RunOutcome, is_unprintable};
use crate::session::Severity;
use crate::study::TipError;
use std::fmt::Write as _;

const CSS: &str = include_str!("page.css");

/// By which a page is known as one of ours.
pub const GENERATOR: &str = "<meta name=\"generator\" content=\"needle-bench\">";

/// The page.
pub fn html(run: &Run) -> String {
    let manifest = &run.folder.manifest;
    let limits = run.folder.limits().ok();
    let title = escaped(&format!("{} {}", manifest.name, utc(&manifest.started_utc)));
    let sections = [
        section("Warnings", &list(&doubts(run))),
        section("Figures", &figures(run)),
        section("Curves", &charts(&curves::curves(run, limits.as_ref()))),
        section("States", &states(run)),
        section("Hazard events", &hazards(run)),
        section("Manifest", &manifest_table(manifest)),
        section(
            "Configuration as used",
            &preformatted(run.folder.config_toml.as_deref().unwrap_or_default()),
        ),
    ];
    format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n{GENERATOR}\n<meta \
         name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <title>{title}</title>\n<style>\n{CSS}</style>\n</head>\n<body>\n{}{}</body>\n</html>\n",
        header(manifest, &run.folder.ending(), &title),
        sections.concat()
    )
}

/// `text` as text in HTML, in an attribute too.
fn escaped(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => safe.push_str("&amp;"),
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            '"' => safe.push_str("&quot;"),
            '\'' => safe.push_str("&#39;"),
            // Control characters are not allowed in HTML; the others make text read as it is not.
            c if is_unprintable(c) && c != '\n' && c != '\t' => safe.push('\u{FFFD}'),
            c => safe.push(c),
        }
    }
    safe
}

/// A section; nothing where there is nothing in it.
fn section(title: &str, content: &str) -> String {
    match content {
        "" => String::new(),
        content => format!("<section>\n<h2>{title}</h2>\n{content}</section>\n"),
    }
}

fn header(manifest: &Manifest, ending: &str, title: &str) -> String {
    let class = match manifest.outcome {
        Some(RunOutcome::Completed) => "completed",
        Some(RunOutcome::Stopped) | None => "stopped",
    };
    let mut page = format!("<header>\n<h1>{title}</h1>\n");
    let _ = writeln!(page, "<p class=\"ending {class}\">{}</p>", escaped(ending));
    let verdict = manifest.verdict().map(|v| format!("{}: {}", v.verdict, v.reason));
    for (label, text) in [
        ("Verdict", &verdict),
        ("Note", &manifest.note),
        ("Operator", &manifest.operator),
        ("Phantom", &manifest.phantom),
    ] {
        if let Some(text) = text {
            let _ = writeln!(page, "<p class=\"about\"><b>{label}</b> {}</p>", escaped(text));
        }
    }
    page + "</header>\n"
}

fn list(lines: &[String]) -> String {
    if lines.is_empty() {
        return String::new();
    }
    let items: String = lines.iter().map(|line| format!("<li>{}</li>\n", escaped(line))).collect();
    format!("<ul class=\"warnings\">\n{items}</ul>\n")
}

fn figures(run: &Run) -> String {
    let known = run.limited_figures().into_iter().filter(|figure| figure.value.is_some());
    let rows: String = known.map(|figure| figure_row(&figure)).collect();
    let report = run.figures();
    let rms = format!("RMS over {}", last_third(&run.folder, &report));
    let errors: String = [(rms.as_str(), report.estimate_rms), ("at the end", report.final_error)]
        .into_iter()
        .filter_map(|(label, error)| Some(error_row(label, &error?)))
        .collect();
    let errors = match errors.as_str() {
        "" => errors,
        rows => format!(
            "<table>\n<tr><th>Estimate − truth</th><th>x mm</th><th>y mm</th><th>z mm</th>\
             <th>yaw deg</th><th>pitch deg</th><th>roll deg</th></tr>\n{rows}</table>\n"
        ),
    };
    format!("<table>\n<tr><th>Figure</th><th></th><th>Limit</th></tr>\n{rows}</table>\n{errors}")
}

fn error_row(label: &str, error: &TipError) -> String {
    let cells: String = error
        .coordinates()
        .iter()
        .zip([3, 3, 3, 2, 2, 2])
        .map(|(value, decimals)| format!("<td class=\"number\">{value:.decimals$}</td>"))
        .collect();
    format!("<tr><td>{label}</td>{cells}</tr>\n")
}

fn figure_row(figure: &Figure) -> String {
    let (class, mark) = if figure.is_outside() { (" outside", " outside") } else { ("", "") };
    let decimals = figure.decimals;
    let limit = figure.bound.map(|bound| {
        let (sign, limit) = bound.signed();
        format!("{sign} {limit:.decimals$} {}{mark}", figure.unit)
    });
    format!(
        "<tr><td>{}</td><td class=\"number{class}\">{} {}</td><td class=\"number{class}\">{}</td></tr>\n",
        escaped(&figure.label),
        optional(figure.value, decimals),
        figure.unit,
        limit.unwrap_or_default()
    )
}

fn charts(charts: &[Chart]) -> String {
    let figures: String = charts.iter().map(figure).collect();
    if figures.is_empty() { figures } else { format!("<div class=\"charts\">\n{figures}</div>\n") }
}

/// A chart with its title and legend.
fn figure(chart: &Chart) -> String {
    let keys: String = chart.shown().filter(|named| !named.name.is_empty()).map(key).collect();
    let picture = chart.svg().unwrap_or_else(|error| {
        format!("<p>This chart could not be drawn: {}</p>\n", escaped(&error.to_string()))
    });
    let title = chart.title;
    format!("<figure>\n<figcaption><b>{title}</b>{keys}</figcaption>\n{picture}</figure>\n")
}

/// An entry of a legend: what is drawn, small.
fn key(Named { name, colour, layer }: &Named) -> String {
    let colour = css(*colour);
    let shape = match layer {
        Layer::Line(_) => format!("<path d=\"M0 5H20\" stroke=\"{colour}\" stroke-width=\"2\"/>"),
        Layer::Broad(_) => {
            format!("<path d=\"M0 5H20\" stroke=\"{colour}\" stroke-width=\"5\"/>")
        }
        Layer::Level(_) => format!(
            "<path d=\"M0 5H20\" stroke=\"{colour}\" stroke-width=\"2\" stroke-dasharray=\"5 3\"/>"
        ),
        Layer::Points(_) => format!("<circle cx=\"10\" cy=\"5\" r=\"3.5\" fill=\"{colour}\"/>"),
        Layer::Band(_) | Layer::Stretches(_) => {
            format!("<rect width=\"20\" height=\"10\" fill=\"{colour}\" fill-opacity=\"0.3\"/>")
        }
    };
    format!("<span class=\"key\"><svg viewBox=\"0 0 20 10\">{shape}</svg>{name}</span>")
}

fn states(run: &Run) -> String {
    let rows: String = run
        .states()
        .iter()
        .map(|change| {
            format!(
                "<tr><td class=\"number\">{:.3} s</td><td class=\"number\">{}</td><td>{}</td></tr>\n",
                change.time_s,
                change.insertion_mm.map(|mm| format!("{mm:.2} mm")).unwrap_or_default(),
                escaped(&change.state)
            )
        })
        .collect();
    if rows.is_empty() {
        return rows;
    }
    format!(
        "<table>\n<tr><th>Time</th><th>Depth, to a step</th><th>State</th></tr>\n{rows}</table>\n"
    )
}

/// The events that were warnings or worse, with where they came.
fn hazards(run: &Run) -> String {
    let rows: String = run
        .events_from(Severity::Warning)
        .map(|line| {
            let time_s = line.time.as_secs_f64();
            let is_fault = line.kind == EventKind::Event(Severity::Fault);
            let (class, kind) =
                if is_fault { (" class=\"outside\"", "fault") } else { ("", "warning") };
            let depth = run.insertion_mm_at(time_s).map(|mm| format!("{mm:.2} mm"));
            format!(
                "<tr><td class=\"number\">{time_s:.3} s</td><td class=\"number\">{}</td>\
                 <td>{}</td><td{class}>{kind}</td><td class=\"text\">{}</td></tr>\n",
                depth.unwrap_or_default(),
                line.lane,
                escaped(&line.text)
            )
        })
        .collect();
    if rows.is_empty() {
        return rows;
    }
    format!(
        "<table>\n<tr><th>Time</th><th>Depth, to a step</th><th>Part</th><th></th><th>Event</th></tr>\n\
         {rows}</table>\n"
    )
}

/// The manifest, but for what stands above.
fn manifest_table(manifest: &Manifest) -> String {
    let mut page = "<table>\n".to_owned();
    let mut row = |key: &str, value: String| {
        let (key, value) = (escaped(key), escaped(&value));
        let _ = writeln!(page, "<tr><td>{key}</td><td class=\"text\">{value}</td></tr>");
    };
    let unknown = || "unknown".to_owned();
    row("version", manifest.version.clone());
    row("git", manifest.git.clone().unwrap_or_else(unknown));
    row("configuration SHA-256", manifest.config_sha256.clone());
    row("calibration SHA-256", manifest.calibration_sha256.clone().unwrap_or_else(unknown));
    row("bus", manifest.bus.clone());
    for one in &manifest.drives {
        row(&format!("{} drive", one.axis), drive(one));
    }
    row("tracker", manifest.tracker.clone());
    manifest.seed.iter().for_each(|seed| row("seed", seed.to_string()));
    row("started", manifest.started_utc.clone());
    row("ended", manifest.ended_utc.clone().unwrap_or_else(unknown));
    row("duration", manifest.duration_s.map_or_else(unknown, |s| format!("{s:.3} s")));
    tracker(&manifest.gates).into_iter().for_each(|said| row("tracker positions", said));
    for (key, value) in &manifest.timing {
        row(key, value.to_string());
    }
    for (name, seal) in &manifest.files {
        row(name, format!("{} bytes, SHA-256 {}", seal.bytes, seal.sha256));
    }
    for verdict in &manifest.verdicts {
        let given = utc(&verdict.given_utc);
        row("verdict", format!("{}, {} ({given})", verdict.verdict, verdict.reason));
    }
    page + "</table>\n"
}

fn preformatted(text: &str) -> String {
    format!("<pre>{}</pre>\n", escaped(text))
}

#[cfg(test)]
mod tests {
    use super::super::run::tests::run;
    use super::*;
    use crate::archive::EventLine;
    use std::borrow::Cow;

    #[test]
    fn hostile_text_stays_text() {
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
        let page = html(&run);
        assert!(!page.contains("<script"), "{page}");
        assert!(!page.contains('\u{1b}'));
        assert_eq!(page.matches("</style>").count(), 1);
        assert!(page.contains("&lt;script src=&quot;http://x&quot;&gt;alert(&#39;1&#39;)"));
    }

    #[test]
    fn a_page_has_every_part_and_loads_nothing() {
        let page = html(&run());
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
        let page = html(&run);
        assert!(!page.contains("<h2>Curves</h2>") && page.contains("<h2>Figures</h2>"));
    }
}
