//! The layout with which a viewer opens the recording.

use super::index::RUN_TIME;
use super::palette;
use super::scene::{PLANE, Reach};
use crate::telemetry::Scene;
use rerun::blueprint::components::{BackgroundKind, Corner2D, PanelState, PlayState, TimeRange};
use rerun::blueprint::datatypes::{self as datatypes_of_views, TextLogColumnKind};
use rerun::blueprint::{
    Blueprint, BlueprintActivation, BlueprintPanel, ContainerLike, Horizontal, SelectionPanel,
    Spatial3DView, StateTimelineView, Tabs, TextDocumentView, TextLogView, TimePanel,
    TimeSeriesView, Vertical,
};
use rerun::datatypes;
use rerun::external::re_log_types::BlueprintActivationCommand;
use rerun::external::re_sdk_types::blueprint::archetypes::{
    Background, EyeControls3D, LineGrid3D, PlotLegend, TextLogColumns, TextLogFormat, TimeAxis,
};
use rerun::log::LogMsg;
use rerun::{
    AsComponents, EntityPath, RecordingStream, RecordingStreamBuilder, RecordingStreamResult,
};

/// Embeds the layout in the recording and makes it the active one: a layout that the viewer kept
/// from another recording would win otherwise.
pub(super) fn send(
    stream: &RecordingStream,
    application: &'static str,
    scene: &Scene,
) -> RecordingStreamResult<()> {
    let mut properties = Properties::default();
    let blueprint = Blueprint::new(root(scene, &mut properties))
        .with_auto_views(false)
        .with_auto_layout(false)
        .with_blueprint_panel(BlueprintPanel::from_state(PanelState::Collapsed))
        .with_selection_panel(SelectionPanel::from_state(PanelState::Collapsed))
        .with_time_panel(
            TimePanel::new()
                .with_state(PanelState::Collapsed)
                .with_timeline(RUN_TIME)
                .with_play_state(PlayState::Following),
        );
    let activation = BlueprintActivation { make_active: true, make_default: true };
    let (carrier, storage) = RecordingStreamBuilder::new(application).enabled(true).memory()?;
    blueprint.send(&carrier, activation)?;
    let mut messages: Vec<LogMsg> = storage.take();
    messages.retain(|message| {
        message.store_id().is_blueprint()
            && !matches!(message, LogMsg::BlueprintActivationCommand(_))
    });
    let Some(blueprint_id) = messages.first().map(|message| message.store_id().clone()) else {
        return Ok(());
    };
    let (extra, storage) = RecordingStreamBuilder::from_store_id(&blueprint_id)
        .enabled(true)
        .send_properties(false)
        .memory()?;
    extra.set_time_sequence("blueprint", 0);
    for (path, property) in properties.0 {
        extra.log(path, property.as_ref())?;
    }
    messages.extend(storage.take().into_iter().filter(|m| matches!(m, LogMsg::ArrowMsg(..))));
    let command = BlueprintActivationCommand {
        blueprint_id,
        make_active: activation.make_active,
        make_default: activation.make_default,
    };
    stream.send_blueprint(messages, command);
    Ok(())
}

/// Properties of views that rerun's typed views do not have: they are logged beside them.
#[derive(Default)]
struct Properties(Vec<(EntityPath, Box<dyn AsComponents>)>);

impl Properties {
    fn set(
        &mut self,
        view: impl Into<ContainerLike>,
        properties: impl IntoIterator<Item = (&'static str, Box<dyn AsComponents>)>,
    ) -> ContainerLike {
        let view = view.into();
        if let ContainerLike::View(view) = &view {
            let path = view.blueprint_path();
            self.0.extend(
                properties
                    .into_iter()
                    .map(|(name, property)| (path.join(&EntityPath::from(name)), property)),
            );
        }
        view
    }

    fn series(&mut self, name: &str, contents: &[&str]) -> ContainerLike {
        let view = TimeSeriesView::new(name).with_contents(contents.iter().copied());
        // The whole run, not the last minute of it.
        let axis = TimeAxis::new().with_view_range(TimeRange(datatypes::TimeRange::EVERYTHING));
        let legend = PlotLegend::new().with_corner(Corner2D::RightTop);
        self.set(view, [("TimeAxis", boxed(axis)), ("PlotLegend", boxed(legend))])
    }

    /// Lines of text say themselves where they come from.
    fn text(&mut self, name: &str, contents: &[&str]) -> ContainerLike {
        let view = TextLogView::new(name).with_contents(contents.iter().copied());
        let columns = TextLogColumns::new().with_text_log_columns(
            [TextLogColumnKind::LogLevel, TextLogColumnKind::Body]
                .map(|kind| datatypes_of_views::TextLogColumn { visible: true.into(), kind }),
        );
        let format = TextLogFormat::new().with_monospace_body(true);
        self.set(view, [("TextLogColumns", boxed(columns)), ("TextLogFormat", boxed(format))])
    }
}

fn boxed(property: impl AsComponents + 'static) -> Box<dyn AsComponents> {
    Box::new(property)
}

fn root(scene: &Scene, p: &mut Properties) -> Horizontal {
    let steering = Vertical::new([
        p.series("x, off the plane [mm]", &["/state/x_mm/**"]),
        p.series("pitch, out of the plane [deg]", &["/state/pitch_deg/**"]),
        p.series("roll of the bevel [deg]", &["/state/roll_deg/**"]),
        p.series(
            "position error, estimate - true [mm]",
            &["/error/x_mm", "/error/y_mm", "/error/z_mm"],
        ),
        p.series(
            "angle error, estimate - true [deg]",
            &["/error/yaw_deg", "/error/pitch_deg", "/error/roll_deg"],
        ),
    ])
    .with_row_shares([1.5, 1.0, 1.0, 1.2, 1.2])
    .with_name("steering");
    let command = Vertical::new([
        p.series("rotation command [deg/mm]", &["/command/**"]),
        p.series("insertion [mm]", &["/stage/insertion_mm/**"]),
        p.series("rotation [deg]", &["/stage/rotation_deg/**"]),
        p.series("insertion, commanded - measured [mm]", &["/stage/lag/insertion_mm"]),
        p.series("rotation, commanded - measured [deg]", &["/stage/lag/rotation_deg"]),
    ])
    .with_name("command and stage");
    let tracker = Vertical::new([
        p.series("innovation, measured - predicted [mm]", &["/tracker/innovation/**"]),
        p.series("age of measurements [ms]", &["/tracker/age_ms", "/tracker/delay_ms"]),
    ])
    .with_name("tracker");
    let tabs = Tabs::new([
        steering.into(),
        command.into(),
        tracker.into(),
        p.series("other observers: errors", &["/shadow/**"]),
        p.text("CAN", &["/can"]),
        TextDocumentView::new("manifest").with_contents(["/manifest"]).into(),
        TextDocumentView::new("configuration").with_contents(["/config"]).into(),
    ]);
    let left = Vertical::new([
        needle_view(scene, p),
        StateTimelineView::new("states").with_contents(["/states/**"]).into(),
        p.text("events", &["/events/**"]),
    ])
    .with_row_shares([5.0, 2.4, 1.1]);
    Horizontal::new([left.into(), tabs.into()]).with_column_shares([5.0, 6.0])
}

fn needle_view(scene: &Scene, p: &mut Properties) -> ContainerLike {
    let reach = Reach::of(scene);
    let middle_mm = (0.5 * (reach.z_mm[0] + reach.z_mm[1])) as f32;
    let size_mm = (reach.z_mm[1] - reach.z_mm[0]).max(reach.y_mm[1] - reach.y_mm[0]) as f32;
    let eye = EyeControls3D::new()
        .with_position([0.6 * size_mm, 0.25 * size_mm, middle_mm - 0.55 * size_mm])
        .with_look_target([0.0, 0.0, middle_mm])
        .with_eye_up([1.0, 0.0, 0.0]);
    let grid = LineGrid3D::new().with_visible(false);
    let background = Background::new(BackgroundKind::SolidColor).with_color(palette::BACKGROUND);
    let view = Spatial3DView::new("needle in the plane's frame").with_origin(PLANE);
    p.set(
        view,
        [
            ("EyeControls3D", boxed(eye)),
            ("LineGrid3D", boxed(grid)),
            ("Background", boxed(background)),
        ],
    )
}
