//! The console's screen, drawn on a frame of any size.

use super::screen::{Drive, Screen};
use crate::canopen::cia402::DriveState;
use crate::session::{Severity, State};
use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::symbols::Marker;
use ratatui::text::Line;
use ratatui::widgets::{Axis, Block, Chart, Clear, Dataset, Gauge, GraphType, Paragraph};
use std::cmp::Reverse;

/// Below this width the panels are one column.
const WIDE_MIN: u16 = 72;
const HELP: &str = "\
space  hold: the needle brakes, both axes stay enabled
r      resume, with a fresh tip only
s      single step, then hold
+ -    speed, in tenths of the configured one
q      stop the run (also Ctrl-C); after it: leave
w      after the run: withdraw the needle; y confirms
?      this help";

pub(super) fn render(screen: &Screen, frame: &mut Frame<'_>) {
    let area = frame.area();
    let is_wide = area.width >= WIDE_MIN;
    let panel_rows = if is_wide { 5 } else { 4 };
    // On a low terminal the plots are left out first, then the panels, then the events.
    let plot_rows = area.height.saturating_sub(4 + panel_rows + 4).min(16);
    let plot_rows = if plot_rows < 6 { 0 } else { plot_rows };
    let panel_rows = if area.height < 4 + panel_rows { 0 } else { panel_rows };
    let rows = [1, 1, 1, plot_rows, panel_rows];
    let [head, depth, pose, plots, panels, events, keys] = Layout::vertical(
        rows.map(Constraint::Length)
            .into_iter()
            .chain([Constraint::Fill(1), Constraint::Length(1)]),
    )
    .areas(area);
    render_head(screen, frame, head);
    render_depth(screen, frame, depth);
    frame.render_widget(Line::from(pose_line(screen)), pose);
    if plots.height > 0 {
        render_plots(screen, frame, plots);
    }
    render_panels(screen, frame, panels, is_wide);
    render_events(screen, frame, events);
    frame.render_widget(Line::from(key_line(screen, area.width)).style(Modifier::REVERSED), keys);
    if screen.has_help {
        let height = (HELP.lines().count() as u16 + 2).min(area.height);
        let width = 60.min(area.width);
        let (x, y) = ((area.width - width) / 2, (area.height - height) / 2);
        let middle = Rect { x, y, width, height };
        frame.render_widget(Clear, middle);
        frame.render_widget(Paragraph::new(HELP).block(Block::bordered().title("keys")), middle);
    }
}

fn render_head(screen: &Screen, frame: &mut Frame<'_>, area: Rect) {
    let state = screen.progress.state;
    let colour = match state {
        State::Stopped => Color::Red,
        _ if screen.faults > 0 => Color::Red,
        _ if state.is_held() => Color::Yellow,
        State::Inserting | State::Stepping | State::Completed => Color::Green,
        _ => Color::Cyan,
    };
    let name = match state {
        State::Holding => "HELD BY TRACKER".to_owned(),
        _ => state.as_str().to_uppercase(),
    };
    let style = Style::new().fg(Color::Black).bg(colour);
    let notes = [&screen.why, &screen.answer].into_iter().filter(|text| !text.is_empty());
    let notes: Vec<&str> = notes.map(String::as_str).collect();
    let text = format!(" {name}  {}", notes.join(" | "));
    frame.render_widget(Line::from(text).style(style), area);
}

fn render_depth(screen: &Screen, frame: &mut Frame<'_>, area: Rect) {
    let progress = &screen.progress;
    let part = Some(progress.insertion_meas_mm / progress.depth_mm).filter(|part| part.is_finite());
    let part = part.map_or(0.0, |part| part.clamp(0.0, 1.0));
    let is_over = matches!(progress.state, State::Stopping | State::Stopped | State::Completed);
    let to_go = progress.remaining_s.filter(|_| !is_over).map_or("-".to_owned(), minutes);
    let label = format!(
        "{:.1} of {:.1} mm  {:.2} mm/s  {to_go} to go{}",
        progress.insertion_meas_mm, progress.depth_mm, progress.speed_mm_per_s, screen.target
    );
    let gauge = Gauge::default().gauge_style(Color::Blue).ratio(part).label(label);
    frame.render_widget(gauge, area);
}

/// A time in minutes and seconds, such as `1:58`.
pub(in crate::cli) fn minutes(s: f64) -> String {
    // The cast saturates.
    let s = s.round() as u64;
    format!("{}:{:02}", s / 60, s % 60)
}

fn pose_line(screen: &Screen) -> String {
    let Some((pose, sd)) = &screen.pose else { return " no estimate yet".to_owned() };
    let plus_minus = |n: usize, scale: f64, decimals: usize| match sd {
        Some(sd) => format!(" ± {:.decimals$}", 2.0 * sd[n] * scale),
        None => String::new(),
    };
    let deg = f64::to_degrees(1.0);
    format!(
        " x {:+.2}{} mm   pitch {:+.1}{}°   roll {:+.0}{}°   (2σ)",
        pose[0],
        plus_minus(0, 1.0, 2),
        pose[4] * deg,
        plus_minus(4, deg, 1),
        pose[5] * deg,
        plus_minus(5, deg, 0),
    )
}

/// Plots x over depth, and the needle from above (x over z) and from the side (y over z).
fn render_plots(screen: &Screen, frame: &mut Frame<'_>, area: Rect) {
    let [x_over_depth, above, side] = Layout::horizontal([Constraint::Fill(1); 3]).areas(area);
    let points = |x: usize, y: usize| -> Vec<(f64, f64)> {
        screen.path.iter().map(|point| (point[x], point[y])).collect()
    };
    let depth_mm = screen.progress.depth_mm;
    plot(frame, x_over_depth, "x mm over depth", &points(0, 1), [0.0, depth_mm], 1.0);
    let z = screen.path.first().map_or(0.0, |point| point[3]);
    for (area, title, n) in [(above, "from above: x", 1), (side, "from the side: y", 2)] {
        plot(frame, area, title, &points(3, n), [z, z + depth_mm], 5.0);
    }
}

fn plot(
    frame: &mut Frame<'_>,
    area: Rect,
    title: &str,
    points: &[(f64, f64)],
    along: [f64; 2],
    span_min: f64,
) {
    let across = points.iter().map(|(_, y)| *y);
    let low = across.clone().fold(-span_min, f64::min).floor();
    let high = across.fold(span_min, f64::max).ceil();
    let plane = [(along[0], 0.0), (along[1], 0.0)];
    let line = |data, colour| {
        Dataset::default()
            .marker(Marker::Braille)
            .graph_type(GraphType::Line)
            .style(Style::new().fg(colour))
            .data(data)
    };
    let axis = |bounds: [f64; 2]| {
        Axis::default().bounds(bounds).labels(bounds.map(|bound| format!("{bound:.0}")))
    };
    let chart = Chart::new(vec![line(&plane, Color::DarkGray), line(points, Color::Green)])
        .block(Block::bordered().title(title))
        .x_axis(axis(along))
        .y_axis(axis([low, high]))
        .legend_position(None);
    frame.render_widget(chart, area);
}

fn render_panels(screen: &Screen, frame: &mut Frame<'_>, area: Rect, is_wide: bool) {
    let (tracker, stage, bus) = (tracker_lines(screen), drive_lines(screen), bus_lines(screen));
    if !is_wide {
        let lines = [&tracker[0][..], &stage[0], &stage[1], &bus[0]].join("\n");
        return frame.render_widget(Paragraph::new(lines), area);
    }
    let columns = Layout::horizontal([27, 27, 24].map(Constraint::Fill)).areas::<3>(area);
    let panels = [("tracker", tracker), ("drives", stage), ("bus, record", bus)];
    for ((title, lines), area) in panels.into_iter().zip(columns) {
        let panel = Paragraph::new(lines.join("\n")).block(Block::bordered().title(title));
        frame.render_widget(panel, area);
    }
}

fn tracker_lines(screen: &Screen) -> [String; 3] {
    let age = screen.progress.tip_age_s.map_or("-".to_owned(), |age_s| format!("{age_s:.2}"));
    let setup = &screen.setup;
    let noise = screen.innovation_mm().map_or("-".to_owned(), |mm| format!("{mm:.2}"));
    // The most frequent first: there may not be room for all.
    let mut refused: Vec<_> = screen.refused.iter().collect();
    refused.sort_by_key(|(_, count)| Reverse(**count));
    let refused = refused.into_iter().map(|(gate, count)| format!("{count} {gate}"));
    let refused = refused.collect::<Vec<_>>().join(", ");
    let refused = if refused.is_empty() { "none".to_owned() } else { refused };
    [
        format!("{}/s tip {age} s (< {:.2})", screen.samples_per_s(), setup.tip_age_max_s),
        format!("noise {noise} mm (set {:.2})", setup.noise_sd_mm),
        format!("refused {refused}"),
    ]
}

fn drive_lines(screen: &Screen) -> [String; 3] {
    let drive = |drive: &Drive, scale: f64, unit: &str| {
        let state = drive.state.map_or("-", short_name);
        let (position, error) = (drive.position * scale, drive.following_error * scale);
        format!("{position:.2} {unit} {error:+.2} {state}")
    };
    let [insertion, rotation] = &screen.drives;
    // The newest of both drives.
    let emergency =
        screen.drives.iter().filter_map(|drive| drive.emergency).max_by_key(|(at, _)| *at);
    let emergency = emergency.map_or_else(|| "none".to_owned(), |(_, emcy)| emcy.to_string());
    [
        drive(insertion, 1.0, "mm"),
        drive(rotation, f64::to_degrees(1.0), "°"),
        format!("EMCY {emergency}"),
    ]
}

/// A name that fits into a panel: "switch on disabled" must not be clipped to "switch on".
fn short_name(state: DriveState) -> &'static str {
    match state {
        DriveState::NotReadyToSwitchOn => "not ready",
        DriveState::SwitchOnDisabled => "disabled",
        DriveState::ReadyToSwitchOn => "ready",
        DriveState::SwitchedOn => "on",
        DriveState::OperationEnabled => "enabled",
        DriveState::QuickStopActive => "quick stop",
        DriveState::FaultReactionActive => "FAULT stop",
        DriveState::Fault => "FAULT",
    }
}

fn bus_lines(screen: &Screen) -> [String; 3] {
    let (frames, bits) = screen.bus_load();
    let late_ms = screen.progress.sync_late_max.as_secs_f64() * 1e3;
    let record = match (&screen.record_trouble, screen.dropped) {
        (Some(trouble), _) => trouble.clone(),
        (None, 0) => "ok".to_owned(),
        (None, dropped) => format!("ok, {dropped} unseen"),
    };
    [
        format!("SYNC {late_ms:.1} ms, skip {}", screen.progress.syncs_skipped),
        format!("{frames}/s, {:.0} kbit/s", bits as f64 * 1e-3),
        format!("{:.1} MB {record}", screen.record_bytes as f64 * 1e-6),
    ]
}

fn render_events(screen: &Screen, frame: &mut Frame<'_>, area: Rect) {
    let skipped = screen.events.len().saturating_sub(usize::from(area.height));
    let lines = screen.events.iter().skip(skipped).map(|(severity, text)| {
        Line::from(text.as_str()).style(match severity {
            Severity::Info => Color::Reset,
            Severity::Warning => Color::Yellow,
            Severity::Fault => Color::Red,
        })
    });
    frame.render_widget(Paragraph::new(lines.collect::<Vec<_>>()), area);
}

/// The keys, in as many words as fit into `width`.
fn key_line(screen: &Screen, width: u16) -> String {
    match &screen.withdrawal {
        Some(Ok(how)) if screen.is_over && screen.asks_to_withdraw => {
            return format!(" withdraw the needle {how}?   y yes   any other key no");
        }
        Some(Ok(_)) if screen.is_over => {
            return " the run is over:   q leave   w withdraw the needle".to_owned();
        }
        Some(Err(why)) if screen.is_over => return format!(" q leave   no withdrawal: {why}"),
        _ => {}
    }
    if matches!(screen.progress.state, State::Stopped | State::Completed) {
        return " the run is over; its record is being closed".to_owned();
    }
    let step_mm = screen.setup.step_mm;
    let lines = [
        &format!(" space hold   r resume   s step {step_mm} mm   + - speed   q stop   ? help"),
        "space hold r resume s step + - speed q stop ? help",
        "space hold r resume s step + - q stop ?",
    ];
    let fitting = lines.into_iter().find(|line| line.len() <= usize::from(width));
    fitting.unwrap_or("space r s + - q ?").to_owned()
}
