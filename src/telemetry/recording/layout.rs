//! The layout with which a viewer opens the recording. `layout.toml` says what it shows, where, and in which
//! colours.

use super::content::{APPLICATION, INSERTION_DEPTH, RUN_TIME, STEP};
use super::space::{Sheet, TRAILS};
use super::{Logged, palette};
use crate::telemetry::Scene;
use crate::text::screen;
use minijinja::context;
use rerun::blueprint::components::{
    BackgroundKind, ContainerKind, Corner2D, LinkAxis, PanelState, PlayState, RootContainer,
    TimeRange, VisibleTimeRange,
};
use rerun::blueprint::datatypes::{TextLogColumn, TextLogColumnKind};
use rerun::blueprint::{VisualizableArchetype as _, Visualizer, VisualizerComponentMapping};
use rerun::datatypes::{self, TimeRangeBoundary, Uuid};
use rerun::external::re_log_types::BlueprintActivationCommand;
use rerun::external::re_sdk_types::blueprint::archetypes as blueprint;
use rerun::{RecordingStream, RecordingStreamBuilder, SeriesLines, SeriesPoints};
use serde::Deserialize;
use std::collections::{BTreeMap, BTreeSet};
use std::error::Error;

/// The viewer's path for the properties that linked views share.
const SHARED: &str = "view/5c0dca6a-e63f-9cf7-f657-2602590474cc";
/// rerun's class of a plot.
const PLOT: &str = "TimeSeries";
/// Size of a dot, in UI points.
const DOT: f32 = 1.8;

/// A part of the layout: a container or a view.
#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Part {
    /// `horizontal`, `vertical` or `tabs`; or rerun's class of a view. A plot, with `series`, has none.
    class: String,
    name: String,
    /// The parts inside a container, and their shares of its size.
    inside: Vec<Part>,
    shares: Vec<f32>,
    /// The series of a plot.
    series: Vec<Series>,
    /// The entities shown by a view that is not a plot.
    shows: Vec<String>,
    /// The entity in whose frame a 3-D view is drawn.
    origin: String,
    /// The position of a 3-D view's eye and the point that it looks at, mm.
    eye: [[f32; 3]; 2],
}

/// A column of a table, and how it is drawn.
#[derive(Debug, Deserialize)]
struct Series {
    table: String,
    column: String,
    name: String,
    colour: String,
    /// Width of the line, in UI points; `None` for dots.
    #[serde(default)]
    width: Option<f32>,
}

/// The layout for `scene`, with a view of the needle around `sheet`.
fn parts(scene: &Scene, sheet: &Sheet) -> Result<Part, Box<dyn Error>> {
    let [across, middle] = sheet.middle_mm();
    let limits = scene.stage.rotation.limits;
    let [min, max] = [limits.min, limits.max].map(f64::to_degrees);
    let values = context! {
        truth => scene.truth,
        goal => scene.goal.is_some(),
        shadows => scene.shadows.clone(),
        rotation_limits => format!("{min:.0} to {max:.0}"),
        length => sheet.z_mm[1] - sheet.z_mm[0],
        across,
        middle,
    };
    Ok(toml::from_str(&screen(include_str!("layout.toml"), &values, context! {})?)?)
}

/// Embeds the layout in the recording and activates it. Otherwise the viewer would use the layout that it
/// kept from another recording.
pub(super) fn send(stream: &RecordingStream, scene: &Scene, sheet: &Sheet) -> Logged {
    let failed = |error| tracing::error!("layout.toml: {error}; the recording has no layout");
    let Ok(parts) = parts(scene, sheet).map_err(failed) else { return Ok(()) };
    let builder = RecordingStreamBuilder::new(APPLICATION).blueprint().enabled(true);
    let (layout, storage) = builder.memory()?;
    let logged = log(&layout, &parts);
    let messages = storage.take();
    // The storage keeps the stream alive, so the stream must be closed here.
    layout.disconnect();
    logged?;
    let Some(first) = messages.first() else { return Ok(()) };
    let command = BlueprintActivationCommand::make_active(first.store_id().clone());
    stream.send_blueprint(messages, command);
    Ok(())
}

/// Logs the whole layout.
fn log(layout: &RecordingStream, parts: &Part) -> Logged {
    layout.set_time_sequence("blueprint", 0);
    let root = Uuid::random();
    log_part(layout, parts, root)?;
    let viewport = blueprint::ViewportBlueprint::new()
        .with_root_container(RootContainer(root))
        .with_auto_layout(false)
        .with_auto_views(false);
    layout.log("viewport", &viewport)?;
    let collapsed = blueprint::PanelBlueprint::new().with_state(PanelState::Collapsed);
    layout.log("blueprint_panel", &collapsed)?;
    layout.log("selection_panel", &collapsed)?;
    let time_panel = blueprint::TimePanelBlueprint::new()
        .with_state(PanelState::Collapsed)
        .with_timeline(RUN_TIME)
        .with_play_state(PlayState::Following);
    layout.log("time_panel", &time_panel)?;
    // Shows the whole run, not only its last minute.
    let whole =
        blueprint::TimeAxis::new().with_view_range(TimeRange(datatypes::TimeRange::EVERYTHING));
    layout.log(format!("{SHARED}/TimeAxis"), &whole)
}

/// Logs a part under `id`, and the parts inside it; returns its path.
fn log_part(layout: &RecordingStream, part: &Part, id: Uuid) -> Logged<String> {
    let class = match part.class.as_str() {
        "horizontal" | "vertical" | "tabs" => return log_container(layout, part, id),
        "" => PLOT,
        class => class,
    };
    let path = format!("/view/{id}");
    let tables = part.series.iter().map(|series| format!("/{}", series.table));
    let shows = tables.chain(part.shows.iter().cloned()).collect::<BTreeSet<_>>();
    let view = blueprint::ViewBlueprint::new(class)
        .with_display_name(part.name.as_str())
        .with_space_origin(format!("/{}", part.origin));
    layout.log(path.as_str(), &view)?;
    layout.log(format!("{path}/ViewContents"), &blueprint::ViewContents::new(shows))?;
    if [PLOT, "StateTimeline"].contains(&class) {
        // All plots and lanes share one time axis. With its own axis, a view of lanes would keep the time
        // range with which it was opened, and never show the rest of a running insertion.
        let axis = blueprint::TimeAxis::new().with_link(LinkAxis::LinkToGlobal);
        layout.log(format!("{path}/TimeAxis"), &axis)?;
    }
    match class {
        PLOT => {
            let legend = blueprint::PlotLegend::new().with_corner(Corner2D::RightTop);
            layout.log(format!("{path}/PlotLegend"), &legend)?;
            log_series(layout, part, &path)?;
        }
        "TextLog" => {
            // Each line names its own source.
            let columns = [TextLogColumnKind::LogLevel, TextLogColumnKind::Body];
            let columns = columns.map(|kind| TextLogColumn { visible: true.into(), kind });
            let columns = blueprint::TextLogColumns::new().with_text_log_columns(columns);
            layout.log(format!("{path}/TextLogColumns"), &columns)?;
            let format = blueprint::TextLogFormat::new().with_monospace_body(true);
            layout.log(format!("{path}/TextLogFormat"), &format)?;
        }
        "3D" => log_space(layout, part, &path)?,
        _ => {}
    }
    Ok(path)
}

fn log_container(layout: &RecordingStream, part: &Part, id: Uuid) -> Logged<String> {
    let kind = match part.class.as_str() {
        "horizontal" => ContainerKind::Horizontal,
        "vertical" => ContainerKind::Vertical,
        _ => ContainerKind::Tabs,
    };
    let inside = part.inside.iter().map(|part| log_part(layout, part, Uuid::random()));
    let inside = inside.collect::<Logged<Vec<_>>>()?;
    let mut container = blueprint::ContainerBlueprint::new(kind).with_contents(inside);
    if !part.name.is_empty() {
        container = container.with_display_name(part.name.as_str());
    }
    let shares = part.shares.iter().copied();
    let container = match kind {
        _ if part.shares.is_empty() => container,
        ContainerKind::Horizontal => container.with_col_shares(shares),
        _ => container.with_row_shares(shares),
    };
    let path = format!("/container/{id}");
    layout.log(path.as_str(), &container)?;
    Ok(path)
}

/// Logs how the columns of a plot are drawn.
fn log_series(layout: &RecordingStream, part: &Part, path: &str) -> Logged {
    let mut visualizers: BTreeMap<&str, Vec<Visualizer>> = BTreeMap::new();
    for Series { table, column, name, colour, width } in &part.series {
        let (names, colours) = ([name.as_str()], [palette::named(colour)]);
        let lines = SeriesLines::new().with_names(names).with_colors(colours);
        let dots = SeriesPoints::new().with_names(names).with_colors(colours);
        let visualizer = match width {
            Some(width) => lines.with_widths([*width]).visualizer(),
            None => dots.with_marker_sizes([DOT]).visualizer(),
        };
        let values =
            VisualizerComponentMapping::new_source_component("Scalars:scalars", column.clone());
        let of_table = visualizers.entry(table).or_default();
        of_table.push(visualizer.with_mappings([values.into()]));
    }
    for (table, visualizers) in visualizers {
        let path = format!("{path}/ViewContents/overrides/{table}/visualizers");
        for visualizer in &visualizers {
            let path = format!("{path}/{}", visualizer.id);
            let instruction =
                blueprint::VisualizerInstruction::new(visualizer.visualizer_type.clone())
                    .with_component_map(visualizer.mappings.clone());
            layout.log(path.as_str(), &instruction)?;
            layout.log(path, &visualizer.overrides)?;
        }
        let ids = visualizers.into_iter().map(|visualizer| visualizer.id);
        layout.log(path, &blueprint::ActiveVisualizers::new(ids))?;
    }
    Ok(())
}

/// Logs the properties of a 3-D view.
fn log_space(layout: &RecordingStream, part: &Part, path: &str) -> Logged {
    let [place, target] = part.eye;
    let eye = blueprint::EyeControls3D::new()
        .with_position(place)
        .with_look_target(target)
        .with_eye_up([1.0, 0.0, 0.0]);
    layout.log(format!("{path}/EyeControls3D"), &eye)?;
    layout.log(format!("{path}/LineGrid3D"), &blueprint::LineGrid3D::new().with_visible(false))?;
    let background =
        blueprint::Background::new(BackgroundKind::SolidColor).with_color(palette::BACKGROUND);
    layout.log(format!("{path}/Background"), &background)?;
    // Trails are shown from the beginning to the cursor.
    let ranges =
        blueprint::VisibleTimeRanges::new([RUN_TIME, STEP, INSERTION_DEPTH].map(|timeline| {
            VisibleTimeRange(datatypes::VisibleTimeRange {
                timeline: timeline.into(),
                range: datatypes::TimeRange {
                    start: TimeRangeBoundary::Infinite,
                    end: TimeRangeBoundary::CursorRelative(datatypes::TimeInt(0)),
                },
            })
        }));
    for trail in TRAILS {
        layout.log(format!("{path}/ViewContents/overrides/{trail}/visualizers"), &ranges)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::tests;

    /// A colour without a meaning would be drawn grey.
    #[test]
    fn every_layout_is_valid_and_its_colours_are_known() {
        fn colours(part: &Part) -> Vec<&str> {
            let own = part.series.iter().map(|series| series.colour.as_str());
            own.chain(part.inside.iter().flat_map(colours)).collect()
        }
        for truth in [true, false] {
            let scene = Scene { truth, ..tests::scene() };
            let parts = parts(&scene, &Sheet::of(&scene)).expect("a layout");
            let mut colours = colours(&parts);
            assert!(!colours.is_empty());
            colours.retain(|colour| palette::named(colour) == palette::NEUTRAL);
            assert!(colours.is_empty(), "unknown: {colours:?}");
        }
    }
}
