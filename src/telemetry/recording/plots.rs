//! Scalar series: rows of numbers that share their moments, sent in columns.

use super::index::{Index, Moment};
use rerun::{Color, RecordingStream, RecordingStreamResult, Scalars, SeriesLines, SeriesPoints};
use std::borrow::Cow;

/// How a series is drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Mark {
    /// A line of this width, in points of the screen.
    Line(f32),
    /// A dot of this radius for every value.
    Dots(f32),
}

/// One series: where it is kept, what it is called (with its unit) and how it looks.
#[derive(Debug, Clone)]
pub(super) struct Plot {
    path: Cow<'static, str>,
    name: Cow<'static, str>,
    colour: Color,
    mark: Mark,
}

impl Plot {
    pub(super) fn line(
        path: impl Into<Cow<'static, str>>,
        name: impl Into<Cow<'static, str>>,
        colour: Color,
    ) -> Self {
        Plot { path: path.into(), name: name.into(), colour, mark: Mark::Line(1.5) }
    }

    /// Seen on both sides of a line that lies on it.
    pub(super) fn wide(mut self) -> Self {
        self.mark = Mark::Line(4.0);
        self
    }

    pub(super) fn thin(mut self) -> Self {
        self.mark = Mark::Line(0.75);
        self
    }

    pub(super) fn dots(mut self) -> Self {
        self.mark = Mark::Dots(2.0);
        self
    }

    fn log_style(&self, stream: &RecordingStream) -> RecordingStreamResult<()> {
        let (path, name) = (self.path.as_ref(), self.name.as_ref());
        match self.mark {
            Mark::Line(width) => stream.log_static(
                path,
                &SeriesLines::new()
                    .with_colors([self.colour])
                    .with_names([name])
                    .with_widths([width]),
            ),
            Mark::Dots(radius) => stream.log_static(
                path,
                &SeriesPoints::new()
                    .with_colors([self.colour])
                    .with_names([name])
                    .with_marker_sizes([radius]),
            ),
        }
    }
}

/// Series whose values come together.
///
/// An unknown value is NaN, which the viewer draws as a gap. A series without a single value does
/// not appear at all.
pub(super) struct Plots {
    series: Vec<Series>,
    index: Index,
}

struct Series {
    plot: Plot,
    shown: bool,
    values: Vec<f64>,
}

impl Plots {
    pub(super) fn new(plots: impl IntoIterator<Item = Plot>) -> Self {
        let series =
            plots.into_iter().map(|plot| Series { plot, shown: false, values: Vec::new() });
        Plots { series: series.collect(), index: Index::default() }
    }

    /// A row: one value for each series, in their order.
    pub(super) fn push(&mut self, moment: Moment, row: &[f64]) {
        debug_assert_eq!(row.len(), self.series.len());
        self.index.push(moment);
        for (series, &value) in self.series.iter_mut().zip(row) {
            series.values.push(if value.is_finite() { value } else { f64::NAN });
        }
    }

    /// Sends the rows that wait.
    pub(super) fn send(&mut self, stream: &RecordingStream) -> RecordingStreamResult<()> {
        if self.index.len() == 0 {
            return Ok(());
        }
        let moments = self.index.columns();
        self.index.clear();
        for series in &mut self.series {
            let values = std::mem::take(&mut series.values);
            if !series.shown {
                if values.iter().all(|v| v.is_nan()) {
                    continue;
                }
                series.plot.log_style(stream)?;
                series.shown = true;
            }
            let columns = Scalars::new(values).columns_of_unit_batches()?;
            stream.send_columns(series.plot.path.as_ref(), moments.clone(), columns)?;
        }
        Ok(())
    }
}
