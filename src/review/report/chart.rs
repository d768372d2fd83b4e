//! A chart, laid out in the pixels of the template `chart.svg`.

use crate::math::log10;
use minijinja::{Value, context};

/// The plot area within the picture of 560 × 280 pixels; `chart.svg` has the same numbers.
const LEFT: f64 = 60.0;
const RIGHT: f64 = 546.0;
const TOP: f64 = 8.0;
const BOTTOM: f64 = 234.0;
/// About so many labels on the axes.
const X_LABELS: f64 = 10.0;
const Y_LABELS: f64 = 6.0;
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
    pub(super) colour: &'static str,
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

    /// How it is drawn, here and in a legend.
    fn shape(&self) -> &'static str {
        match self {
            Layer::Line(_) => "line",
            Layer::Broad(_) => "broad",
            Layer::Points(_) => "points",
            Layer::Level(_) => "level",
            Layer::Band(_) | Layer::Stretches(_) => "area",
        }
    }

    /// Its SVG path.
    fn path(&self, x: &Axis, y: &Axis) -> String {
        let at = |(x_value, y_value)| format!("{:.1} {:.1}", x.at(x_value), y.at(y_value));
        let line = |points: &[(f64, f64)]| {
            let finite = points.iter().filter(|(x, y)| x.is_finite() && y.is_finite());
            let points: Vec<String> = finite.map(|point| at(*point)).collect();
            if points.is_empty() { String::new() } else { format!("M{}", points.join("L")) }
        };
        let area = |outline: Points| line(&outline) + "Z";
        match self {
            Layer::Line(pieces) | Layer::Broad(pieces) => {
                pieces.iter().map(|piece| line(piece)).collect()
            }
            // Lines without a length: their round ends are dots.
            Layer::Points(points) => {
                let dots = points.iter().map(|point| line(&[*point])).filter(|dot| !dot.is_empty());
                dots.map(|dot| dot + "h0").collect()
            }
            Layer::Band(pieces) => {
                let pieces = pieces.iter().filter(|piece| !piece.is_empty()).map(|piece| {
                    let low = piece.iter().map(|&(x, low, _)| (x, low));
                    let high = piece.iter().rev().map(|&(x, _, high)| (x, high));
                    area(low.chain(high).collect())
                });
                pieces.collect()
            }
            Layer::Level(level) => line(&[(x.range.0, *level), (x.range.1, *level)]),
            Layer::Stretches(stretches) => {
                let stretches = stretches.iter().map(|&(from, to)| {
                    let (from, to) = (from.max(x.range.0), to.min(x.range.1));
                    let (low, high) = y.range;
                    area(vec![(from, low), (from, high), (to, high), (to, low)])
                });
                stretches.collect()
            }
        }
    }
}

/// An axis: its range of values, and where its ends are in the picture.
struct Axis {
    range: (f64, f64),
    ends: (f64, f64),
}

impl Axis {
    fn at(&self, value: f64) -> f64 {
        let part = (value - self.range.0) / (self.range.1 - self.range.0);
        self.ends.0 + part * (self.ends.1 - self.ends.0)
    }

    /// The labels and where they are: about `count` of them, at multiples of 1, 2 or 5 times a power of
    /// ten.
    fn labels(&self, count: f64) -> Vec<(String, String)> {
        let (low, high) = self.range;
        let least = (high - low) / count;
        let power = log10(least).floor() as i32;
        let steps = [1.0, 2.0, 5.0, 10.0].map(|factor| factor * 10f64.powi(power));
        let step = steps.into_iter().find(|step| *step >= least).unwrap_or(least);
        let decimals = usize::try_from(-log10(step * 1.001).floor() as i32).unwrap_or(0);
        let multiples = (low / step).ceil() as i64..=(high / step).floor() as i64;
        let label = |multiple| {
            let value = multiple as f64 * step;
            (format!("{:.1}", self.at(value)), format!("{value:.decimals$}"))
        };
        multiples.map(label).collect()
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

    /// What the template `chart.svg` draws.
    pub(super) fn drawing(&self) -> Value {
        let x = Axis { range: self.x_range(), ends: (LEFT, RIGHT) };
        let y_range = self.span.unwrap_or_else(|| self.y_range());
        let y = Axis { range: y_range, ends: (BOTTOM, TOP) };
        let layers = self.shown().map(|&Named { name, colour, ref layer }| {
            context! { name, colour, shape => layer.shape(), path => layer.path(&x, &y) }
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

#[cfg(test)]
mod tests {
    use super::*;

    fn chart(layers: Vec<Layer>) -> Chart {
        let named = |layer| Named { name: "a", colour: "#000000", layer };
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
        assert_eq!(
            nan.shown().map(|named| named.layer.path(&UNIT, &UNIT)).collect::<Vec<_>>(),
            ["", "M0.0 1.0"]
        );
        assert!(!chart(vec![Layer::Level(1.0)]).has_curve());
    }

    /// A pixel a unit.
    const UNIT: Axis = Axis { range: (0.0, 1.0), ends: (0.0, 1.0) };

    #[test]
    fn each_layer_is_a_path() {
        let path = |layer: Layer| layer.path(&UNIT, &UNIT);
        let piece = vec![(0.0, 0.0), (1.0, 4.0)];
        assert_eq!(
            path(Layer::Line(vec![piece.clone(), piece.clone()])),
            "M0.0 0.0L1.0 4.0".repeat(2)
        );
        assert_eq!(path(Layer::Points(piece)), "M0.0 0.0h0M1.0 4.0h0");
        let band = Layer::Band(vec![vec![(0.0, 1.0, 2.0), (1.0, 3.0, 4.0)]]);
        assert_eq!(path(band), "M0.0 1.0L1.0 3.0L1.0 4.0L0.0 2.0Z");
        assert_eq!(path(Layer::Level(0.5)), "M0.0 0.5L1.0 0.5");
        let held = Layer::Stretches(vec![(0.5, f64::INFINITY)]);
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
