//! Tables: named columns of numbers whose rows share their moments.

use rerun::components::Scalar;
use rerun::{
    Component as _, ComponentBatch as _, ComponentDescriptor, ComponentIdentifier, EntityPath,
    RecordingStream, RecordingStreamResult,
};

/// Columns of numbers at one entity.
///
/// A column's name says its unit; the layout has the colours. An unknown value is NaN, which a viewer
/// draws as a gap.
#[derive(Debug)]
pub(super) struct Table {
    path: EntityPath,
    columns: Vec<ComponentDescriptor>,
}

impl Table {
    /// A table at the entity `path` with the columns `names`.
    pub(super) fn new(path: &str, names: impl IntoIterator<Item = impl AsRef<str>>) -> Self {
        // Only an empty name is refused.
        let identifiers =
            names.into_iter().filter_map(|name| ComponentIdentifier::try_new(name.as_ref()).ok());
        let columns = identifiers.map(|identifier| {
            ComponentDescriptor::partial(identifier).with_component_type(Scalar::name())
        });
        Table { path: EntityPath::from(path), columns: columns.collect() }
    }

    /// Logs a row: one value for each column, in their order.
    pub(super) fn log(&self, stream: &RecordingStream, row: &[f64]) -> RecordingStreamResult<()> {
        debug_assert_eq!(row.len(), self.columns.len(), "{}", self.path);
        let cells = self.columns.iter().zip(row).map(|(column, &value)| {
            let value = if value.is_finite() { value } else { f64::NAN };
            [Scalar::from(value)].try_serialized(column.clone())
        });
        stream.log(self.path.clone(), &cells.collect::<Result<Vec<_>, _>>()?)
    }
}
