//! Reads columns of finite numbers from CSV text with a header line.

use nalgebra::{Quaternion, Rotation3, UnitQuaternion};
use thiserror::Error;

/// Columns of an orientation, all four or none.
const QUATERNION: [&str; 4] = ["qw", "qx", "qy", "qz"];

/// Why a table was refused.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum TableError {
    /// The header lacks a column.
    #[error("no column \"{column}\"; the header must have {}", expected.join(","))]
    Column {
        /// The column.
        column: &'static str,
        /// All required columns.
        expected: Vec<&'static str>,
    },
    /// A field is missing, not a number, or not finite.
    #[error("line {line}: {column} is \"{field}\", expected a finite number")]
    Field {
        /// Line in the file, from 1.
        line: usize,
        /// The column.
        column: &'static str,
        /// The field's text.
        field: String,
    },
    /// A quaternion is zero, or too large to have a direction.
    #[error("line {line}: qw,qx,qy,qz have the norm {norm}: no orientation")]
    NoOrientation {
        /// Line in the file, from 1.
        line: usize,
        /// The quaternion's norm.
        norm: f64,
    },
}

/// A table with its header read; columns that are not asked for are ignored.
#[derive(Debug, Clone)]
pub struct Table<'a> {
    header: Vec<&'a str>,
    /// Line number from 1, fields.
    rows: Vec<(usize, Vec<&'a str>)>,
}

impl<'a> Table<'a> {
    /// Splits `csv` into header and rows, with or without a byte order mark; empty lines are
    /// skipped.
    pub fn new(csv: &'a str) -> Self {
        let fields = |line: &'a str| line.split(',').map(str::trim).collect::<Vec<_>>();
        let mut lines = csv.trim_start_matches('\u{feff}').lines().enumerate();
        let header = lines.next().map(|(_, line)| fields(line)).unwrap_or_default();
        let rows = lines
            .filter(|(_, line)| !line.trim().is_empty())
            .map(|(index, line)| (index + 1, fields(line)))
            .collect();
        Table { header, rows }
    }

    /// The `columns` of every row, in the order of `columns`.
    ///
    /// # Errors
    /// A missing column, or a field that is not a finite number, with its line.
    pub fn numbers<const N: usize>(
        &self,
        columns: [&'static str; N],
    ) -> Result<Vec<[f64; N]>, TableError> {
        let mut places = [0; N];
        for (place, column) in places.iter_mut().zip(columns) {
            let found = self.header.iter().position(|&name| name == column);
            *place =
                found.ok_or_else(|| TableError::Column { column, expected: columns.to_vec() })?;
        }
        let number = |line: usize, fields: &[&str], place: usize, column: &'static str| {
            let field = fields.get(place).copied().unwrap_or_default();
            let value = field.parse().ok().filter(|value: &f64| value.is_finite());
            value.ok_or_else(|| TableError::Field { line, column, field: field.to_owned() })
        };
        self.rows
            .iter()
            .map(|(line, fields)| {
                let mut row = [0.0; N];
                for ((value, place), column) in row.iter_mut().zip(places).zip(columns) {
                    *value = number(*line, fields, place, column)?;
                }
                Ok(row)
            })
            .collect()
    }

    /// The orientation of every row, from the columns `qw,qx,qy,qz`; `None` without these columns.
    ///
    /// # Errors
    /// Some of the columns without the others, a field that is not a finite number, or a quaternion
    /// without a direction.
    pub fn rotations(&self) -> Result<Option<Vec<Rotation3<f64>>>, TableError> {
        if !QUATERNION.iter().any(|column| self.header.contains(column)) {
            return Ok(None);
        }
        let quaternions = self.numbers(QUATERNION)?;
        let rotation = |((line, _), [w, x, y, z]): (&(usize, _), [f64; 4])| {
            let quaternion = Quaternion::new(w, x, y, z);
            let norm = quaternion.norm();
            if !(norm.is_finite() && norm > 1e-6) {
                return Err(TableError::NoOrientation { line: *line, norm });
            }
            Ok(UnitQuaternion::new_normalize(quaternion).to_rotation_matrix())
        };
        self.rows.iter().zip(quaternions).map(rotation).collect::<Result<_, _>>().map(Some)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_found_by_name_in_any_order() {
        let table = Table::new("\u{feff}b, other ,a\n2,x,1\n\n4,y,3\r\n");
        assert_eq!(table.numbers(["a", "b"]), Ok(vec![[1.0, 2.0], [3.0, 4.0]]));
        assert_eq!(Table::new("a\n").numbers(["a"]), Ok(vec![]));
    }

    #[test]
    fn refuses_by_line_and_column() {
        let message = |csv: &str| Table::new(csv).numbers(["a", "b"]).unwrap_err().to_string();
        assert_eq!(message(""), "no column \"a\"; the header must have a,b");
        assert_eq!(
            message("a,b\n1,2\n\n3,inf\n"),
            "line 4: b is \"inf\", expected a finite number"
        );
        assert_eq!(message("a,b\n1\n"), "line 2: b is \"\", expected a finite number");
    }

    #[test]
    fn orientations_are_all_there_or_none() {
        let rotations = |csv: &str| Table::new(csv).rotations().map_err(|error| error.to_string());
        assert_eq!(rotations("a\n1\n"), Ok(None));
        assert_eq!(rotations("qw,qx,qy,qz\n2,0,0,0\n"), Ok(Some(vec![Rotation3::identity()])));
        assert!(rotations("qw,qx\n").unwrap_err().contains("no column \"qy\""));
        for (row, norm) in [("0,0,0,0", "0"), ("1e308,1e308,0,0", "inf")] {
            let message = rotations(&format!("qw,qx,qy,qz\n1,0,0,0\n\n{row}\n")).unwrap_err();
            let expected = format!("line 4: qw,qx,qy,qz have the norm {norm}: no orientation");
            assert_eq!(message, expected);
        }
    }
}
