//! A chart as SVG, drawn by plotters.

use crate::math::log10;
use plotters::chart::ChartBuilder;
use plotters::drawing::{DrawingAreaErrorKind, IntoDrawingArea};
use plotters::element::{Circle, Polygon, Rectangle};
use plotters::prelude::SVGBackend;
use plotters::series::{DashedLineSeries, LineSeries};
use plotters::style::{Color, RGBColor, ShapeStyle};
use std::io;

/// plotters rounds points to whole pixels, so the picture is drawn at twice its displayed size.
const SIZE: (u32, u32) = (1120, 560);
const FONT_PX: u32 = 26;
const LINE_PX: u32 = 3;
const BROAD_PX: u32 = 6;
const POINT_PX: i32 = 4;
/// Margin above and below the curves, relative to their span.
const ROOM: f64 = 0.08;
/// How far a band may widen the axis, relative to the span of the curves.
const BAND_ROOM: f64 = 0.5;

/// Connected points of a curve.
pub(super) type Points = Vec<(f64, f64)>;

/// A layer of a chart.
pub(super) enum Layer {
    /// Lines through the points of each piece.
    Line(Vec<Points>),
    /// The same, but broad enough to be visible under another line.
    Broad(Vec<Points>),
    /// The points alone.
    Points(Points),
    /// Areas between a lower and an upper curve, as `(x, low, high)`.
    Band(Vec<Vec<(f64, f64, f64)>>),
    /// A dashed horizontal line.
    Level(f64),
    /// Intervals of the x axis.
    Stretches(Points),
}

/// A layer with its name in the legend.
pub(super) struct Named {
    pub(super) name: &'static str,
    pub(super) colour: RGBColor,
    pub(super) layer: Layer,
}

/// A chart: its axes with units, and its layers.
pub(super) struct Chart {
    pub(super) title: &'static str,
    pub(super) x: &'static str,
    pub(super) y: &'static str,
    pub(super) layers: Vec<Named>,
    /// The range of the y axis; if `None`, it spans the curves.
    pub(super) span: Option<(f64, f64)>,
}

impl Layer {
    fn is_empty(&self) -> bool {
        match self {
            Layer::Line(pieces) | Layer::Broad(pieces) => pieces.iter().all(Vec::is_empty),
            Layer::Points(points) | Layer::Stretches(points) => points.is_empty(),
            Layer::Band(pieces) => pieces.iter().all(Vec::is_empty),
            Layer::Level(level) => !level.is_finite(),
        }
    }

    /// The points of a curve; a band, a level or a stretch has none.
    fn points(&self) -> impl Iterator<Item = &(f64, f64)> {
        let (pieces, points) = match self {
            Layer::Line(pieces) | Layer::Broad(pieces) => (pieces.as_slice(), [].as_slice()),
            Layer::Points(points) => ([].as_slice(), points.as_slice()),
            Layer::Band(_) | Layer::Level(_) | Layer::Stretches(_) => {
                ([].as_slice(), [].as_slice())
            }
        };
        pieces.iter().flatten().chain(points)
    }

    /// The shape that stands for it in a legend.
    pub(super) fn shape(&self) -> &'static str {
        match self {
            Layer::Line(_) => "line",
            Layer::Broad(_) => "broad",
            Layer::Points(_) => "points",
            Layer::Level(_) => "level",
            Layer::Band(_) | Layer::Stretches(_) => "area",
        }
    }
}

impl Chart {
    /// The layers that are not empty.
    pub(super) fn shown(&self) -> impl Iterator<Item = &Named> {
        self.layers.iter().filter(|named| !named.layer.is_empty())
    }

    /// Whether there is a curve and not only limits.
    pub(super) fn has_curve(&self) -> bool {
        self.layers.iter().any(|named| named.layer.points().next().is_some())
    }

    /// The picture.
    ///
    /// # Errors
    /// An error of plotters.
    pub(super) fn svg(&self) -> Result<String, DrawingAreaErrorKind<io::Error>> {
        let mut svg = String::new();
        self.draw(SVGBackend::with_string(&mut svg, SIZE))?;
        // HTML needs no XML namespace, and the page should contain nothing that looks like a link.
        Ok(svg.replacen(" xmlns=\"http://www.w3.org/2000/svg\"", "", 1))
    }

    fn draw(&self, backend: SVGBackend<'_>) -> Result<(), DrawingAreaErrorKind<io::Error>> {
        let area = backend.into_drawing_area();
        let (x, y) = (self.x_range(), self.span.unwrap_or_else(|| self.y_range()));
        let mut chart = ChartBuilder::on(&area)
            .margin(12)
            .margin_right(28)
            .x_label_area_size(64)
            .y_label_area_size(104)
            .build_cartesian_2d(x.0..x.1, y.0..y.1)?;
        let font = ("sans-serif", FONT_PX);
        let (x_span, y_span) = (x.1 - x.0, y.1 - y.0);
        chart
            .configure_mesh()
            .light_line_style(RGBColor(255, 255, 255).mix(0.0))
            .bold_line_style(RGBColor(0xE3, 0xE3, 0xE3))
            .axis_style(RGBColor(0x60, 0x60, 0x60))
            .x_labels(10)
            .y_labels(7)
            .x_label_formatter(&|value| tick(*value, x_span))
            .y_label_formatter(&|value| tick(*value, y_span))
            .label_style(font)
            .axis_desc_style(font)
            .x_desc(self.x)
            .y_desc(self.y)
            .draw()?;
        for Named { colour, layer, .. } in self.shown() {
            let width = if matches!(layer, Layer::Broad(_)) { BROAD_PX } else { LINE_PX };
            let line = ShapeStyle::from(colour).stroke_width(width);
            match layer {
                Layer::Line(pieces) | Layer::Broad(pieces) => {
                    // plotters does not clip at its axes.
                    for inside in pieces.iter().flat_map(|piece| cut(piece, y)) {
                        chart.draw_series(LineSeries::new(inside, line))?;
                    }
                }
                Layer::Points(points) => {
                    let dot = |&at| Circle::new(at, POINT_PX, colour.mix(0.7).filled());
                    let inside = points.iter().filter(|(_, value)| (y.0..=y.1).contains(value));
                    chart.draw_series(inside.map(dot))?;
                }
                Layer::Band(pieces) => {
                    for piece in pieces.iter().filter(|piece| !piece.is_empty()) {
                        let low = piece.iter().map(|&(x, low, _)| (x, low));
                        let high = piece.iter().rev().map(|&(x, _, high)| (x, high));
                        let outline = cut_area(low.chain(high).collect(), y);
                        chart.draw_series([Polygon::new(outline, colour.mix(0.25))])?;
                    }
                }
                Layer::Level(level) => {
                    let ends = [(x.0, *level), (x.1, *level)];
                    let style = ShapeStyle::from(colour).stroke_width(2);
                    chart.draw_series(DashedLineSeries::new(ends, 14, 10, style))?;
                }
                Layer::Stretches(stretches) => {
                    let stretch = |&(from, to): &(f64, f64)| {
                        let corners = [(from.max(x.0), y.0), (to.min(x.1), y.1)];
                        Rectangle::new(corners, colour.mix(0.25).filled())
                    };
                    chart.draw_series(stretches.iter().map(stretch))?;
                }
            }
        }
        area.present()
    }

    fn points(&self) -> impl Iterator<Item = &(f64, f64)> {
        self.layers.iter().flat_map(|named| named.layer.points())
    }

    fn x_range(&self) -> (f64, f64) {
        padded(range(self.points().map(|(x, _)| *x)), 0.0)
    }

    /// The range of the curves from `x_from` on, with some room: a y axis that earlier values do not
    /// stretch.
    pub(super) fn span_from(&self, x_from: f64) -> Option<(f64, f64)> {
        let late = self.points().filter(|(x, _)| *x >= x_from);
        let late = range(late.map(|(_, y)| *y));
        late.map(|range| padded(Some(range), ROOM))
    }

    /// The range of the curves and levels, widened for the bands, which may be far wider.
    fn y_range(&self) -> (f64, f64) {
        let layers = || self.layers.iter().map(|named| &named.layer);
        let level =
            |layer: &Layer| if let Layer::Level(level) = layer { Some(*level) } else { None };
        let curves = self.points().map(|(_, y)| *y).chain(layers().filter_map(level));
        let (low, high) = padded(range(curves), ROOM);
        let room = (high - low) * BAND_ROOM;
        let bands = layers().filter_map(|layer| match layer {
            Layer::Band(pieces) => Some(pieces.iter().flatten()),
            _ => None,
        });
        let bands = range(bands.flatten().flat_map(|(_, low, high)| [*low, *high]));
        let (band_low, band_high) = bands.unwrap_or((low, high));
        (low.min(band_low.max(low - room)), high.max(band_high.min(high + room)))
    }
}

/// The parts of the line through `piece` within `range`, cut where the line leaves it.
fn cut(piece: &[(f64, f64)], range: (f64, f64)) -> Vec<Points> {
    let mut parts = vec![Points::new()];
    let is_inside = |(_, y): (f64, f64)| (range.0..=range.1).contains(&y);
    let mut before = None;
    for &point in piece {
        let mut crossings = before.map_or(Vec::new(), |before| crossings(before, point, range));
        if is_inside(point) {
            crossings.push(point);
        } else if !before.is_some_and(is_inside) {
            // The segment goes from outside to outside, possibly through the range.
            parts.push(Points::new());
        }
        if let Some(part) = parts.last_mut() {
            part.append(&mut crossings);
        }
        if !is_inside(point) {
            parts.push(Points::new());
        }
        before = Some(point);
    }
    parts.retain(|part| !part.is_empty());
    parts
}

/// The points where the line from `a` to `b` crosses the limits of `range`, in the line's order.
fn crossings(a: (f64, f64), b: (f64, f64), range: (f64, f64)) -> Points {
    let at = |level: f64| {
        let part = (level - a.1) / (b.1 - a.1);
        (part > 0.0 && part < 1.0).then_some((a.0 + part * (b.0 - a.0), level))
    };
    let levels = if a.1 <= b.1 { [range.0, range.1] } else { [range.1, range.0] };
    levels.into_iter().filter_map(at).collect()
}

/// The part of the area inside `outline` that lies within `range`.
fn cut_area(outline: Points, range: (f64, f64)) -> Points {
    let above = |outline: Points, level: f64, sign: f64| {
        let is_inside = |(_, y): (f64, f64)| sign * (y - level) >= 0.0;
        let mut inside = Points::new();
        let mut before = outline.last().copied();
        for point in outline {
            if let Some(before) = before.filter(|before| is_inside(*before) != is_inside(point)) {
                inside.extend(crossings(before, point, (level, f64::INFINITY)));
            }
            if is_inside(point) {
                inside.push(point);
            }
            before = Some(point);
        }
        inside
    };
    above(above(outline, range.0, 1.0), range.1, -1.0)
}

/// Larger values come from a damaged file and are left out of the charts.
pub(super) const VALUE_MAX: f64 = 1e12;

/// The smallest and the largest of `values`; `None` without values.
fn range(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    let valid = values.filter(|value| value.abs() < VALUE_MAX);
    valid.fold(None, |range, value| {
        let (low, high) = range.unwrap_or((value, value));
        Some((value.min(low), value.max(high)))
    })
}

/// `range` with a margin of `room` times its span on both sides; never empty.
fn padded(range: Option<(f64, f64)>, room: f64) -> (f64, f64) {
    let (low, high) = range.unwrap_or((0.0, 1.0));
    let span = high - low;
    let room = if span > 0.0 { span * room } else { low.abs().max(1.0) * 0.5 };
    (low - room, high + room)
}

/// A label of an axis with this span, with as many digits as its labels need to differ.
fn tick(value: f64, span: f64) -> String {
    let decimals = (1.0 - log10(span / 5.0).floor()).clamp(0.0, 9.0) as usize;
    let text = format!("{value:.decimals$}");
    let text =
        if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    // A value that rounds to zero has no sign.
    if text.trim_matches(['-', '0', '.']).is_empty() { "0".to_owned() } else { text.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart(layers: Vec<Layer>) -> Chart {
        let colour = RGBColor(0, 0, 0);
        let named = |layer| Named { name: "a", colour, layer };
        Chart {
            title: "t",
            x: "x (mm)",
            y: "y (mm)",
            layers: layers.into_iter().map(named).collect(),
            span: None,
        }
    }

    #[test]
    fn axes_span_what_is_drawn_and_bands_widen_them_by_half_at_most() {
        let line = || Layer::Line(vec![vec![(0.0, -1.0), (10.0, 1.0)]]);
        let close =
            |(a, b): (f64, f64), (c, d): (f64, f64)| (a - c).abs() < 1e-9 && (b - d).abs() < 1e-9;
        let lone = chart(vec![line()]);
        assert_eq!(lone.x_range(), (0.0, 10.0));
        assert!(close(lone.y_range(), (-1.16, 1.16)), "{:?}", lone.y_range());
        let wide = chart(vec![line(), Layer::Band(vec![vec![(0.0, -1.2, 180.0)]])]);
        assert!(close(wide.y_range(), (-1.2, 1.16 + 1.16)), "{:?}", wide.y_range());
        let limited = chart(vec![line(), Layer::Level(9.0)]);
        assert!(close(limited.y_range(), (-1.8, 9.8)), "{:?}", limited.y_range());
    }

    #[test]
    fn values_that_are_no_numbers_do_no_harm() {
        let nan = chart(vec![
            Layer::Points(vec![(f64::NAN, 0.0), (1.0, f64::INFINITY)]),
            Layer::Line(vec![vec![(0.0, 1.0)], Vec::new()]),
            Layer::Level(f64::NAN),
        ]);
        assert_eq!(nan.shown().count(), 2);
        assert!(nan.svg().unwrap().contains("</svg>"));
        assert!(!chart(vec![Layer::Level(1.0)]).has_curve());
    }

    /// Curves end at the axis limit, at the depth where they cross it.
    #[test]
    fn curves_are_cut_and_never_clamped() {
        let line = [(0.0, 0.0), (1.0, 4.0), (2.0, 4.0), (3.0, 0.0), (4.0, -4.0), (5.0, 4.0)];
        let parts = cut(&line, (-1.0, 1.0));
        assert_eq!(
            parts,
            [
                vec![(0.0, 0.0), (0.25, 1.0)],
                vec![(2.75, 1.0), (3.0, 0.0), (3.25, -1.0)],
                vec![(4.375, -1.0), (4.625, 1.0)],
            ]
        );
        let area = vec![(0.0, 0.0), (2.0, 0.0), (2.0, 4.0), (0.0, 0.0)];
        let cut = cut_area(area, (-1.0, 1.0));
        assert_eq!(cut, [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.5, 1.0), (0.0, 0.0)]);
        assert!(cut_area(vec![(0.0, 2.0), (1.0, 3.0)], (-1.0, 1.0)).is_empty());
    }

    #[test]
    fn labels_have_the_digits_that_they_need() {
        assert_eq!(tick(150.0, 250.0), "150");
        assert_eq!(tick(-0.000_000_1, 2.0), "0");
        assert_eq!(tick(0.25, 1.0), "0.25");
        assert_eq!(tick(1.5e-7, 1e-6), "0.00000015");
        assert_eq!(tick(-40.0, 100.0), "-40");
    }
}
