//! A chart with its layout, in the pixels of the template `chart.svg`.

use crate::math::log10;
use derive_more::Display;
use minijinja::{Value, context};

// Colours by meaning: those of the viewer (`telemetry::recording`), adapted to white paper.
/// The observer's estimate.
pub(super) const ESTIMATE: &str = "#56B4E9";
/// The emulator's truth.
pub(super) const TRUTH: &str = "#009E73";
/// Measurements.
pub(super) const MEASURED: &str = "#E69F00";
/// Commands.
pub(super) const COMMANDED: &str = "#CC79A7";
/// The first, second and third coordinate; black replaces the viewer's yellow.
pub(super) const COORDINATES: [&str; 3] = ["#D55E00", "#000000", "#0072B2"];
/// Faults.
pub(super) const FAULT: &str = "#D55E00";
/// Limits and holds: neither good nor bad.
const NEUTRAL: &str = "#8A8A8A";

/// The plot area within the picture of 560 × 280 pixels; `chart.svg` has the same numbers.
const LEFT: f64 = 60.0;
const RIGHT: f64 = 546.0;
const TOP: f64 = 8.0;
const BOTTOM: f64 = 234.0;
/// The approximate number of labels on each axis.
const X_LABELS: f64 = 10.0;
const Y_LABELS: f64 = 6.0;
/// Margin above and below the curves, relative to their span.
const MARGIN: f64 = 0.08;
/// How far a band may widen the axis, relative to the span of the curves.
const BAND_MARGIN: f64 = 0.5;
/// Larger values come from a damaged file and are left out of the charts.
pub(super) const VALUE_MAX: f64 = 1e12;

/// Points of a curve. A point with an infinite coordinate is drawn at the end of that axis.
pub(super) type Points = Vec<(f64, f64)>;

/// How a layer is drawn, in the chart and in its legend.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Display)]
#[display(rename_all = "lowercase")]
pub(super) enum Shape {
    /// Lines through the points of each piece.
    Line,
    /// Such lines, but broad enough to be visible under another line.
    Broad,
    /// The points alone.
    Points,
    /// A dashed line.
    Level,
    /// Areas with the pieces as their outlines.
    Area,
}

/// The shapes of measured, estimated and commanded values.
const CURVES: [Shape; 3] = [Shape::Line, Shape::Broad, Shape::Points];

/// A layer of a chart, with its name in the legend.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Layer {
    name: &'static str,
    colour: &'static str,
    shape: Shape,
    pub(super) pieces: Vec<Points>,
}

/// A chart: its axes with units, and its layers.
pub(super) struct Chart {
    pub(super) title: &'static str,
    pub(super) x: &'static str,
    pub(super) y: &'static str,
    pub(super) layers: Vec<Layer>,
    /// The range of the y axis; if `None`, it spans the curves.
    pub(super) span: Option<(f64, f64)>,
}

impl Layer {
    pub(super) fn new(
        name: &'static str,
        colour: &'static str,
        shape: Shape,
        pieces: Vec<Points>,
    ) -> Self {
        Layer { name, colour, shape, pieces }
    }

    /// A dashed line across the chart.
    pub(super) fn level(name: &'static str, y: f64) -> Self {
        let across = vec![(f64::NEG_INFINITY, y), (f64::INFINITY, y)];
        Layer::new(name, NEUTRAL, Shape::Level, vec![across])
    }

    /// Bands over intervals of the x axis.
    pub(super) fn intervals(name: &'static str, intervals: Points) -> Self {
        let (low, high) = (f64::NEG_INFINITY, f64::INFINITY);
        let outline = |(from, to)| vec![(from, low), (from, high), (to, high), (to, low)];
        Layer::new(name, NEUTRAL, Shape::Area, intervals.into_iter().map(outline).collect())
    }

    fn is_empty(&self) -> bool {
        self.pieces.iter().all(Vec::is_empty)
    }

    /// Its SVG path.
    fn path(&self, x: &Axis, y: &Axis) -> String {
        let at = |point: &(f64, f64)| format!("{:.1} {:.1}", x.pixel(point.0), y.pixel(point.1));
        let path = |piece: &Points| {
            let points: Vec<String> = piece.iter().map(at).collect();
            match self.shape {
                // Lines of zero length, whose round ends are dots.
                Shape::Points => format!("M{}h0", points.join("h0M")),
                Shape::Area => format!("M{}Z", points.join("L")),
                _ => format!("M{}", points.join("L")),
            }
        };
        self.pieces.iter().filter(|piece| !piece.is_empty()).map(path).collect()
    }
}

/// An axis: its range of values, and the pixels of its ends.
struct Axis {
    range: (f64, f64),
    ends: (f64, f64),
}

impl Axis {
    /// The pixel of `value`.
    fn pixel(&self, value: f64) -> f64 {
        let (low, high) = self.range;
        let value = if value.is_infinite() { value.clamp(low, high) } else { value };
        let fraction = (value - low) / (high - low);
        self.ends.0 + fraction * (self.ends.1 - self.ends.0)
    }

    /// About `count` labels, each with its pixel, at multiples of 1, 2 or 5 times a power of ten.
    fn labels(&self, count: f64) -> Vec<(String, String)> {
        let (low, high) = self.range;
        let step_min = (high - low) / count;
        let power = log10(step_min).floor() as i32;
        let steps = [1.0, 2.0, 5.0, 10.0].map(|factor| factor * 10f64.powi(power));
        let step = steps.into_iter().find(|step| *step >= step_min).unwrap_or(step_min);
        let decimals = usize::try_from(-log10(step * 1.001).floor() as i32).unwrap_or(0);
        let multiples = (low / step).ceil() as i64..=(high / step).floor() as i64;
        let label = |multiple| {
            let value = multiple as f64 * step;
            (format!("{:.1}", self.pixel(value)), format!("{value:.decimals$}"))
        };
        multiples.map(label).collect()
    }
}

impl Chart {
    pub(super) fn new(
        title: &'static str,
        x: &'static str,
        y: &'static str,
        layers: Vec<Layer>,
    ) -> Self {
        Chart { title, x, y, layers, span: None }
    }

    /// True if there is a curve and not only limits.
    pub(super) fn has_curve(&self) -> bool {
        self.points(&CURVES).next().is_some()
    }

    /// What the template `chart.svg` draws.
    pub(super) fn drawing(&self) -> Value {
        let x = Axis { range: self.x_range(), ends: (LEFT, RIGHT) };
        let y_range = self.span.unwrap_or_else(|| self.y_range());
        let y = Axis { range: y_range, ends: (BOTTOM, TOP) };
        let layers = self.layers.iter().filter(|layer| !layer.is_empty()).map(|layer| {
            let (name, colour, shape) = (layer.name, layer.colour, layer.shape.to_string());
            context! { name, colour, shape, path => layer.path(&x, &y) }
        });
        context! {
            title => self.title,
            x => self.x,
            y => self.y,
            x_labels => x.labels(X_LABELS),
            y_labels => y.labels(Y_LABELS),
            layers => layers.collect::<Vec<_>>(),
        }
    }

    /// The points of the layers of these shapes.
    fn points(&self, shapes: &[Shape]) -> impl Iterator<Item = (f64, f64)> {
        let layers = self.layers.iter().filter(|layer| shapes.contains(&layer.shape));
        layers.flat_map(|layer| layer.pieces.iter().flatten().copied())
    }

    fn x_range(&self) -> (f64, f64) {
        padded(range(self.points(&CURVES).map(|(x, _)| x)), 0.0)
    }

    /// A range of the y axis for the part of the curves from `x_from` on, with a margin.
    pub(super) fn span_from(&self, x_from: f64) -> Option<(f64, f64)> {
        let late = self.points(&CURVES).filter(|(x, _)| *x >= x_from);
        range(late.map(|(_, y)| y)).map(|range| padded(Some(range), MARGIN))
    }

    /// The range of the curves and levels, widened for the bands, which may be far wider.
    fn y_range(&self) -> (f64, f64) {
        let levels = self.points(&[Shape::Level]);
        let (low, high) = padded(range(self.points(&CURVES).chain(levels).map(|(_, y)| y)), MARGIN);
        let margin = (high - low) * BAND_MARGIN;
        let bands = range(self.points(&[Shape::Area]).map(|(_, y)| y));
        let (band_low, band_high) = bands.unwrap_or((low, high));
        (low.min(band_low.max(low - margin)), high.max(band_high.min(high + margin)))
    }
}

/// The smallest and the largest of the finite `values`; `None` without one.
fn range(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    values.filter(|value| value.is_finite()).fold(None, |range, value| {
        let (low, high) = range.unwrap_or((value, value));
        Some((value.min(low), value.max(high)))
    })
}

/// `range` with a `margin`, relative to its span, on both sides; never empty.
fn padded(range: Option<(f64, f64)>, margin: f64) -> (f64, f64) {
    let (low, high) = range.unwrap_or((0.0, 1.0));
    let span = high - low;
    let margin = if span > 0.0 { span * margin } else { low.abs().max(1.0) * 0.5 };
    (low - margin, high + margin)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layer(shape: Shape, pieces: Vec<Points>) -> Layer {
        Layer::new("a", "#000000", shape, pieces)
    }

    fn chart(layers: Vec<Layer>) -> Chart {
        Chart::new("t", "x (mm)", "y (mm)", layers)
    }

    #[test]
    fn axes_span_what_is_drawn_and_bands_widen_them_by_half_at_most() {
        let line = || layer(Shape::Line, vec![vec![(0.0, -1.0), (10.0, 1.0)]]);
        let close =
            |(a, b): (f64, f64), (c, d): (f64, f64)| (a - c).abs() < 1e-9 && (b - d).abs() < 1e-9;
        let held = Layer::intervals("held", vec![(2.0, f64::INFINITY)]);
        let lone = chart(vec![line(), held]);
        assert_eq!(lone.x_range(), (0.0, 10.0));
        assert!(close(lone.y_range(), (-1.16, 1.16)), "{:?}", lone.y_range());
        let band = layer(Shape::Area, vec![vec![(0.0, -1.2), (0.0, 180.0)]]);
        let wide = chart(vec![line(), band]);
        assert!(close(wide.y_range(), (-1.2, 1.16 + 1.16)), "{:?}", wide.y_range());
        let limited = chart(vec![line(), Layer::level("limit", 9.0)]);
        assert!(close(limited.y_range(), (-1.8, 9.8)), "{:?}", limited.y_range());
        assert!(!chart(vec![Layer::level("limit", 1.0)]).has_curve());
    }

    /// An axis with one pixel per unit.
    const UNIT: Axis = Axis { range: (0.0, 1.0), ends: (0.0, 1.0) };

    #[test]
    fn each_layer_is_a_path() {
        let path = |layer: Layer| layer.path(&UNIT, &UNIT);
        let piece = vec![(0.0, 0.0), (1.0, 4.0)];
        let twice = vec![piece.clone(), Vec::new(), piece.clone()];
        assert_eq!(path(layer(Shape::Line, twice)), "M0.0 0.0L1.0 4.0".repeat(2));
        assert_eq!(path(layer(Shape::Points, vec![piece])), "M0.0 0.0h0M1.0 4.0h0");
        let band = layer(Shape::Area, vec![vec![(0.0, 1.0), (1.0, 3.0), (1.0, 4.0), (0.0, 2.0)]]);
        assert_eq!(path(band), "M0.0 1.0L1.0 3.0L1.0 4.0L0.0 2.0Z");
        assert_eq!(path(Layer::level("limit", 0.5)), "M0.0 0.5L1.0 0.5");
        let held = Layer::intervals("held", vec![(0.5, f64::INFINITY)]);
        assert_eq!(path(held), "M0.5 0.0L0.5 1.0L1.0 1.0L1.0 0.0Z");
    }

    #[test]
    fn labels_are_round_numbers_with_the_digits_that_they_need() {
        let labels = |low, high| {
            let axis = Axis { range: (low, high), ends: (0.0, 100.0) };
            axis.labels(5.0).into_iter().map(|(_, label)| label).collect::<Vec<_>>()
        };
        assert_eq!(labels(0.0, 250.0), ["0", "50", "100", "150", "200", "250"]);
        assert_eq!(labels(-0.15, 0.4), ["0.0", "0.2", "0.4"]);
        assert_eq!(labels(-1e-7, 2e-7), ["-0.0000001", "0.0000000", "0.0000001", "0.0000002"]);
        assert_eq!(UNIT.labels(2.0)[1], ("0.5".to_owned(), "0.5".to_owned()));
    }
}
