//! Tables: named columns of numbers whose rows share their moments.

use rerun::components::Scalar;
use rerun::{
    Component as _, ComponentBatch as _, ComponentDescriptor, ComponentIdentifier, RecordingStream,
    RecordingStreamResult,
};

/// A value in a row, with the name of its column. The name says the unit; the layout has the colours.
pub(super) type NamedValue<N> = (N, f64);

/// Logs a row of the table at the entity `path`. An unknown value is NaN, which a viewer draws as a
/// gap.
pub(super) fn log_row<N: AsRef<str>>(
    stream: &RecordingStream,
    path: &str,
    row: impl IntoIterator<Item = NamedValue<N>>,
) -> RecordingStreamResult<()> {
    let cells = row.into_iter().filter_map(|(name, value)| {
        // Only an empty name is refused.
        let column = ComponentIdentifier::try_new(name.as_ref()).ok()?;
        let column = ComponentDescriptor::partial(column).with_component_type(Scalar::name());
        let value = if value.is_finite() { value } else { f64::NAN };
        Some([Scalar::from(value)].try_serialized(column))
    });
    stream.log(path, &cells.collect::<Result<Vec<_>, _>>()?)
}
