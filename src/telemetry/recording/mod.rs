//! The run for rerun's viewer: `run.rrd`, made when the run is over, and a live view while it goes on.
//! Nothing outside this module names rerun.
//!
//! Both log the same content. Angles are in degrees here: people read this, programs read `steps.csv`.
//!
//! A file has 1.2 MB for the layout, and at 10 ms SYNC, with two observers alongside, 3 to 4 MB a
//! metre of insertion at 2 mm/s, 6 MB at 1 mm/s.

mod can;
mod content;
mod document;
mod file;
mod layout;
pub(super) mod live;
mod motion;
mod now;
mod palette;
mod samples;
mod scene;
mod space;
mod states;
mod steps;

pub use self::file::Recording;

use rerun::components::Scalar;
use rerun::{
    Component as _, ComponentBatch as _, ComponentDescriptor, ComponentIdentifier, RecordingStream,
    RecordingStreamResult,
};

/// The result of logging, or of what logs on its way.
type Logged<T = ()> = RecordingStreamResult<T>;

/// A value in a row, with the name of its column. The name says the unit; the layout has the colours.
type NamedValue<N> = (N, f64);

/// Logs a row of a table at the entity `path`: named columns of numbers whose rows share their moments. An
/// unknown value is NaN, which a viewer draws as a gap.
fn log_row<N: AsRef<str>>(
    stream: &RecordingStream,
    path: &str,
    row: impl IntoIterator<Item = NamedValue<N>>,
) -> Logged {
    let cells = row.into_iter().filter_map(|(name, value)| {
        // Only an empty name is refused.
        let column = ComponentIdentifier::try_new(name.as_ref()).ok()?;
        let column = ComponentDescriptor::partial(column).with_component_type(Scalar::name());
        let value = if value.is_finite() { value } else { f64::NAN };
        Some([Scalar::from(value)].try_serialized(column))
    });
    stream.log(path, &cells.collect::<Result<Vec<_>, _>>()?)
}
