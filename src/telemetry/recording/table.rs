//! Tables: named columns of numbers whose rows share their moments.

use super::index::{Index, Moment};
use rerun::components::Scalar;
use rerun::{
    Component as _, ComponentBatch as _, ComponentDescriptor, ComponentIdentifier, RecordingStream,
    RecordingStreamResult, SerializedComponentColumn,
};

/// Rows of numbers at one entity, waiting to be sent.
///
/// All columns go out in one chunk, since a chunk costs about a kilobyte, whatever is in it. A
/// column's name says its unit; the layout has the colours. An unknown value is NaN, which a viewer
/// draws as a gap.
#[derive(Debug)]
pub(super) struct Table {
    path: String,
    names: Vec<String>,
    index: Index,
    columns: Vec<Vec<f64>>,
}

impl Table {
    /// A table at the entity `path` with the columns `names`.
    pub(super) fn new(
        path: impl Into<String>,
        names: impl IntoIterator<Item = impl Into<String>>,
    ) -> Self {
        let names: Vec<String> = names.into_iter().map(Into::into).collect();
        let columns = vec![Vec::new(); names.len()];
        Table { path: path.into(), names, index: Index::default(), columns }
    }

    /// A row: one value for each column, in their order.
    pub(super) fn push(&mut self, moment: Moment, row: &[f64]) {
        debug_assert_eq!(row.len(), self.columns.len(), "{}", self.path);
        self.index.push(moment);
        for (column, &value) in self.columns.iter_mut().zip(row) {
            column.push(if value.is_finite() { value } else { f64::NAN });
        }
    }

    /// Sends the rows that wait.
    pub(super) fn send(&mut self, stream: &RecordingStream) -> RecordingStreamResult<()> {
        if self.index.len() == 0 {
            return Ok(());
        }
        let mut columns: Vec<SerializedComponentColumn> = Vec::with_capacity(self.columns.len());
        for (name, values) in self.names.iter().zip(&mut self.columns) {
            let values: Vec<Scalar> = values.drain(..).map(Scalar::from).collect();
            // Only an empty name is none.
            let Ok(component) = ComponentIdentifier::try_new(name) else { continue };
            let descriptor =
                ComponentDescriptor::partial(component).with_component_type(Scalar::name());
            columns.push(values.try_serialized(descriptor)?.column_of_unit_batches()?);
        }
        stream.send_columns(self.path.as_str(), self.index.columns(), columns)?;
        self.index.clear();
        Ok(())
    }
}
