//! What the layout shows, where, and in which colours.

use super::content::{INSERTION_DEPTH, RUN_TIME, STEP};
use super::layout::Properties;
use super::motion::{LIMITS, MOTION, STAGE};
use super::now::NOW;
use super::palette::{
    BACKGROUND, COMMANDED, COORDINATES as COORDINATE_COLOURS, ESTIMATE, ESTIMATE_BOUND, FAULT,
    GOOD, LIMIT, MEASURED, TRUTH,
};
use super::samples::{GATE_LANE, SAMPLE_RATES, SAMPLES};
use super::scene::{PLANE, Reach};
use super::space::{ESTIMATED_TIP, TRAILS};
use super::steps::{COORDINATES, REDUCED, SHADOWS, STEPS, TARGET_BAND, column};
use crate::telemetry::Scene;
use rerun::blueprint::components::{
    BackgroundKind, Corner2D, LinkAxis, TimeRange, VisibleTimeRange,
};
use rerun::blueprint::datatypes::{TextLogColumn, TextLogColumnKind};
use rerun::blueprint::{
    ContainerLike, Horizontal, Spatial3DView, StateTimelineView, Tabs, TextDocumentView,
    TextLogView, TimeSeriesView, Vertical, VisualizableArchetype, Visualizer,
    VisualizerComponentMapping,
};
use rerun::datatypes::{self, TimeRangeBoundary};
use rerun::external::re_sdk_types::blueprint::archetypes::{
    Background, EyeControls3D, LineGrid3D, PlotLegend, TextLogColumns, TextLogFormat, TimeAxis,
    VisibleTimeRanges,
};
use rerun::{AsComponents, Color, SeriesLines, SeriesPoints};

/// The close-up shows this much around the tip, mm.
const CLOSE_UP_MM: f32 = 3.0;

/// A column of a table as it is drawn.
struct Series {
    table: String,
    visualizer: Visualizer,
}

impl Series {
    /// A line of this width, in points of the screen.
    fn line(table: &str, column: &str, name: &str, colour: Color, width: f32) -> Self {
        let style =
            SeriesLines::new().with_names([name]).with_colors([colour]).with_widths([width]);
        Self::of(table, column, &style)
    }

    fn dots(table: &str, column: &str, name: &str, colour: Color) -> Self {
        let style =
            SeriesPoints::new().with_names([name]).with_colors([colour]).with_marker_sizes([1.8]);
        Self::of(table, column, &style)
    }

    fn limit(column: &str) -> Self {
        Self::line(LIMITS, column, "limit", LIMIT, 1.0)
    }

    fn of(table: &str, column: &str, style: &impl VisualizableArchetype) -> Self {
        let values =
            VisualizerComponentMapping::new_source_component("Scalars:scalars", column.to_owned());
        let visualizer = style.visualizer().with_mappings([values.into()]);
        Series { table: table.to_owned(), visualizer }
    }
}

/// Makes the views of one scene.
struct Views<'a> {
    scene: &'a Scene,
    reach: &'a Reach,
    properties: &'a mut Properties,
}

/// The whole layout: the needle, the states and the events to the left, everything else in tabs. The
/// needle is looked at within `reach`.
pub(super) fn root(scene: &Scene, reach: &Reach, properties: &mut Properties) -> Horizontal {
    // The whole run, not the last minute of it.
    let whole = TimeAxis::new().with_view_range(TimeRange(datatypes::TimeRange::EVERYTHING));
    properties.set_shared([property("TimeAxis", whole)]);
    let mut views = Views { scene, reach, properties };
    let left = Vertical::new([
        views.needle(),
        views.close_up(),
        views.lanes("states", "/states/**"),
        TextDocumentView::new("states at the cursor").with_contents([format!("/{NOW}")]).into(),
        views.text("events", &["/events/**", "- /events/samples"]),
    ])
    .with_row_shares([2.6, 1.6, 3.6, 2.3, 1.6]);
    let mut tabs: Vec<ContainerLike> =
        vec![views.steering().into(), views.stage().into(), views.tracker().into()];
    if scene.truth {
        tabs.push(views.errors_of_the_estimate().into());
    }
    if !scene.shadows.is_empty() {
        tabs.push(views.other_observers().into());
    }
    tabs.extend([
        views.text("CAN", &["/can"]),
        TextDocumentView::new("manifest and figures").with_contents(["/manifest"]).into(),
        TextDocumentView::new("configuration").with_contents(["/config"]).into(),
    ]);
    Horizontal::new([left.into(), Tabs::new(tabs).into()]).with_column_shares([5.0, 6.0])
}

impl Views<'_> {
    fn steering(&mut self) -> Vertical {
        let reduced = [
            ("x, off the plane [mm]", 0),
            ("pitch, out of the plane [deg]", 4),
            ("roll of the bevel [deg]", 5),
        ];
        let mut plots: Vec<ContainerLike> =
            reduced.into_iter().map(|(title, n)| self.coordinate(title, n)).collect();
        if self.scene.goal.is_some() {
            plots.push(self.target());
        }
        let shares = [1.5, 1.0, 1.0, 1.2];
        Vertical::new(plots).with_row_shares(shares).with_name("steering")
    }

    /// In a tab of their own: a plot that is too low for a label at each step of its axis has none.
    fn errors_of_the_estimate(&mut self) -> Vertical {
        let position = self.errors("position error, estimate - true [mm]", STEPS, 0..3);
        let angle = self.errors("angle error, estimate - true [deg]", STEPS, 3..6);
        Vertical::new([position, angle]).with_name("errors")
    }

    /// The error at the target that each step predicts.
    fn target(&mut self) -> ContainerLike {
        let band = |column| Series::line(STEPS, column, "± 2 sd", ESTIMATE_BOUND, 1.2);
        let mut series: Vec<Series> = TARGET_BAND.map(band).into();
        series.push(Series::line(STEPS, "target_error_pred_mm", "predicted", ESTIMATE, 1.8));
        self.plot("error at the target, if nothing more is corrected [mm]", series)
    }

    /// A coordinate with its bounds and, where there are any, truth and measurement.
    fn coordinate(&mut self, title: &str, n: usize) -> ContainerLike {
        let line = |provenance: &str, name, colour, width| {
            Series::line(STEPS, &column(n, provenance), name, colour, width)
        };
        let mut series = vec![
            line("low", "estimate ± 2 sd", ESTIMATE_BOUND, 1.2),
            line("high", "estimate ± 2 sd", ESTIMATE_BOUND, 1.2),
        ];
        if n < 3 {
            series.push(Series::dots(STEPS, &column(n, "meas"), "measured", MEASURED));
        }
        if self.scene.truth {
            series.push(line("true", "true", TRUTH, 1.8));
        }
        series.push(line("est", "estimate", ESTIMATE, 1.8));
        self.plot(title, series)
    }

    fn errors(
        &mut self,
        title: &str,
        table: &str,
        of: impl Iterator<Item = usize>,
    ) -> ContainerLike {
        let line = |n: usize| {
            let (name, unit) = COORDINATES[n];
            let name = format!("{name} error [{unit}]");
            Series::line(table, &column(n, "error"), &name, COORDINATE_COLOURS[n % 3], 1.5)
        };
        let series = of.map(line).collect();
        self.plot(title, series)
    }

    fn stage(&mut self) -> Vertical {
        let command = Series::line(STEPS, "rotation_cmd_deg_per_mm", "commanded", COMMANDED, 1.8);
        let limits = ["rotation_cmd_min_deg_per_mm", "rotation_cmd_max_deg_per_mm"];
        let series = limits.map(Series::limit).into_iter().chain([command]).collect();
        let command = self.plot("rotation command [deg/mm]", series);
        let axis = |views: &mut Self, axis: &str, unit: &str| {
            let name = |quantity: &str, unit: &str| format!("{axis}{quantity}_{unit}");
            let rate = format!("{unit}_per_s");
            let followed = |table, quantity: &str, unit: &str| {
                let commanded = name(&format!("{quantity}_cmd"), unit);
                let measured = name(&format!("{quantity}_meas"), unit);
                [
                    Series::line(table, &commanded, "commanded", COMMANDED, 3.5),
                    Series::line(table, &measured, "measured", MEASURED, 1.5),
                ]
            };
            let limit = |quantity: &str, unit: &str| Series::limit(&name(quantity, unit));
            let mut position: Vec<Series> = followed(STAGE, "", unit).into();
            let mut title = format!("{axis} [{unit}]");
            if axis == "insertion" {
                position.extend([limit("_min", unit), limit("_max", unit)]);
            } else {
                // Many turns: lines there would leave nothing to see of the rest.
                let limits = views.scene.stage.rotation.limits;
                let [min, max] = [limits.min, limits.max].map(f64::to_degrees);
                title = format!("{axis} [{unit}], limits {min:.0} to {max:.0}");
            }
            let speed = followed(MOTION, "_speed", &rate).into_iter();
            let mut speed: Vec<Series> = speed.chain([limit("_speed_max", &rate)]).collect();
            if axis == "rotation" {
                speed.push(limit("_speed_min", &rate));
            }
            let lag =
                Series::line(MOTION, &name("_lag", unit), "commanded - measured", MEASURED, 1.5);
            let lag = vec![lag, limit("_lag_min", unit), limit("_lag_max", unit)];
            Vertical::new([
                views.plot(&title, position),
                views.plot(&format!("{axis} speed [{unit}/s]"), speed),
                views.plot(&format!("{axis} lag, worst of 0.1 s [{unit}]"), lag),
            ])
        };
        let (insertion, rotation) = (axis(self, "insertion", "mm"), axis(self, "rotation", "deg"));
        let axes = Horizontal::new([insertion.into(), rotation.into()]);
        Vertical::new([command, axes.into()])
            .with_row_shares([1.0, 3.0])
            .with_name("command and stage")
    }

    fn tracker(&mut self) -> Vertical {
        let innovation = |n: usize| {
            let name = format!("{} innovation [mm]", COORDINATES[n].0);
            Series::line(STEPS, &column(n, "innovation"), &name, COORDINATE_COLOURS[n], 1.5)
        };
        let innovation = (0..3).map(innovation).collect();
        let age = vec![
            Series::dots(SAMPLES, "delay_ms", "acquisition to reception", COMMANDED),
            Series::line(STEPS, "tip_meas_age_ms", "age at the step", MEASURED, 1.8),
            Series::limit("tip_meas_age_max_ms"),
        ];
        let rates = vec![
            Series::line(SAMPLE_RATES, "accepted_per_s", "accepted", GOOD, 1.8),
            Series::line(SAMPLE_RATES, "refused_per_s", "refused", FAULT, 1.8),
        ];
        Vertical::new([
            self.plot("innovation, measured - predicted [mm]", innovation),
            self.plot("age of measurements [ms]", age),
            self.plot("samples a second", rates),
            self.lanes("gate that refused", &format!("/states/{GATE_LANE}")),
            self.text("refused samples", &["/events/samples"]),
        ])
        .with_row_shares([1.5, 1.2, 1.0, 0.7, 1.2])
        .with_name("tracker")
    }

    /// The observers that run alongside, beside the one that steers.
    fn other_observers(&mut self) -> Vertical {
        let colours = [MEASURED, COMMANDED, COORDINATE_COLOURS[1], COORDINATE_COLOURS[2]];
        let mut plots: Vec<ContainerLike> = Vec::new();
        for n in REDUCED {
            let (name, unit) = COORDINATES[n];
            let shadows = self.scene.shadows.iter().zip(colours.iter().cycle());
            let mut series: Vec<Series> = shadows
                .map(|(shadow, &colour)| {
                    let table = format!("{SHADOWS}/{shadow}");
                    Series::line(&table, &column(n, "est"), shadow, colour, 1.5)
                })
                .collect();
            if self.scene.truth {
                series.push(Series::line(STEPS, &column(n, "true"), "true", TRUTH, 1.8));
            }
            let steering = "the one that steers";
            series.push(Series::line(STEPS, &column(n, "est"), steering, ESTIMATE, 1.8));
            plots.push(self.plot(&format!("{name} [{unit}]"), series));
        }
        if self.scene.truth {
            for shadow in self.scene.shadows.clone() {
                let table = format!("{SHADOWS}/{shadow}");
                let title = format!("{shadow}: position error, estimate - true [mm]");
                plots.push(self.errors(&title, &table, 0..3));
                let title = format!("{shadow}: angle error, estimate - true [deg]");
                plots.push(self.errors(&title, &table, 3..6));
            }
        }
        Vertical::new(plots).with_name("other observers")
    }

    fn plot(&mut self, title: &str, series: Vec<Series>) -> ContainerLike {
        let mut tables: Vec<String> = series.iter().map(|series| series.table.clone()).collect();
        tables.sort();
        tables.dedup();
        let mut view =
            TimeSeriesView::new(title).with_contents(tables.iter().map(|t| format!("/{t}")));
        for Series { table, visualizer } in series {
            view = view.with_override(table.as_str(), visualizer);
        }
        let legend = PlotLegend::new().with_corner(Corner2D::RightTop);
        self.properties.set(view, [shared_time_axis(), property("PlotLegend", legend)])
    }

    /// Lanes of states. With an axis of its own the view keeps the time range with which it was opened,
    /// and shows no more of a run that goes on.
    fn lanes(&mut self, name: &str, contents: &str) -> ContainerLike {
        let view = StateTimelineView::new(name).with_contents([contents]);
        self.properties.set(view, [shared_time_axis()])
    }

    /// Lines of text say themselves where they come from.
    fn text(&mut self, name: &str, contents: &[&str]) -> ContainerLike {
        let view = TextLogView::new(name).with_contents(contents.iter().copied());
        let columns = TextLogColumns::new().with_text_log_columns(
            [TextLogColumnKind::LogLevel, TextLogColumnKind::Body]
                .map(|kind| TextLogColumn { visible: true.into(), kind }),
        );
        let format = TextLogFormat::new().with_monospace_body(true);
        let properties = [property("TextLogColumns", columns), property("TextLogFormat", format)];
        self.properties.set(view, properties)
    }

    fn needle(&mut self) -> ContainerLike {
        let [across_mm, middle_mm] = self.reach.middle_mm().map(|mm| mm as f32);
        let length_mm = (self.reach.z_mm[1] - self.reach.z_mm[0]) as f32;
        // From the side, so that the insertion goes from left to right.
        let eye = EyeControls3D::new()
            .with_position([0.36 * length_mm, across_mm + 0.55 * length_mm, middle_mm])
            .with_look_target([0.0, across_mm, middle_mm])
            .with_eye_up([1.0, 0.0, 0.0]);
        self.space("needle in the plane's frame", PLANE, eye)
    }

    /// The estimated tip from near, with its bevel and its 95 % ellipsoid. In the tip's own frame,
    /// since an eye can follow only what is there when the view is opened.
    fn close_up(&mut self) -> ContainerLike {
        let eye = EyeControls3D::new()
            .with_position([0.7 * CLOSE_UP_MM, 0.7 * CLOSE_UP_MM, -CLOSE_UP_MM])
            .with_look_target([0.0, 0.0, 0.0])
            .with_eye_up([1.0, 0.0, 0.0]);
        self.space("tip from near, with the 95 % ellipsoid of its position", ESTIMATED_TIP, eye)
    }

    fn space(&mut self, title: &str, origin: &str, eye: EyeControls3D) -> ContainerLike {
        let grid = LineGrid3D::new().with_visible(false);
        let background = Background::new(BackgroundKind::SolidColor).with_color(BACKGROUND);
        let view = Spatial3DView::new(title).with_origin(origin);
        let view = view.with_contents([format!("/{PLANE}/**")]);
        let trails = TRAILS.map(|path| {
            let whole = VisibleTimeRanges::new([RUN_TIME, STEP, INSERTION_DEPTH].map(up_to_cursor));
            (
                format!("ViewContents/overrides/{path}/visualizers"),
                Box::new(whole) as Box<dyn AsComponents>,
            )
        });
        let properties = [
            property("EyeControls3D", eye),
            property("LineGrid3D", grid),
            property("Background", background),
        ];
        self.properties.set(view, properties.into_iter().chain(trails))
    }
}

/// Everything on `timeline` from the beginning to the cursor.
fn up_to_cursor(timeline: &str) -> VisibleTimeRange {
    VisibleTimeRange(datatypes::VisibleTimeRange {
        timeline: timeline.into(),
        range: datatypes::TimeRange {
            start: TimeRangeBoundary::Infinite,
            end: TimeRangeBoundary::CursorRelative(datatypes::TimeInt(0)),
        },
    })
}

/// The time axis that plots and lanes have in common: whoever moves one moves all.
fn shared_time_axis() -> (String, Box<dyn AsComponents>) {
    property("TimeAxis", TimeAxis::new().with_link(LinkAxis::LinkToGlobal))
}

fn property(name: &str, property: impl AsComponents + 'static) -> (String, Box<dyn AsComponents>) {
    (name.to_owned(), Box::new(property))
}
