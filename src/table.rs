//! CSV tables with a header line, read by column name. An error names the line, what it contains and what was
//! expected.

use crate::text::clipped;
use csv::{ReaderBuilder, StringRecord, Trim};
use nalgebra::{Quaternion, Rotation3, UnitQuaternion};

/// The columns of an orientation, a quaternion: a table has all four or none.
const QUATERNION: [&str; 4] = ["qw", "qx", "qy", "qz"];
/// An error shows at most this many characters of the file.
const SHOWN_MAX: usize = 80;

/// A table as text. Spaces around a field, a byte order mark and blank lines are ignored.
#[derive(Debug, Clone)]
pub struct Table {
    header: StringRecord,
    rows: Vec<Row>,
}

/// A row of a [`Table`].
#[derive(Debug, Clone)]
pub struct Row {
    /// Line in the file, from 1.
    pub line: usize,
    fields: StringRecord,
}

/// A column that a [`Table`] has.
#[derive(Debug, Clone)]
pub struct Column {
    index: usize,
    /// Its name in the header.
    pub name: String,
}

impl Table {
    /// Reads the header and the rows of `csv`.
    pub fn parse(csv: &str) -> Self {
        let mut reader = ReaderBuilder::new()
            .has_headers(false)
            .flexible(true)
            .trim(Trim::All)
            .from_reader(csv.as_bytes());
        // No error is possible: text in memory is UTF-8, and rows may be of any length.
        let records = reader.records().map_while(Result::ok);
        // The csv crate counts the blank lines before a record as part of that record.
        let (mut line, mut counted) = (1, 0);
        let mut rows = records.map(|fields| {
            let from = fields.position().map_or(0, |position| position.byte() as usize);
            let blank = csv.as_bytes()[from..].iter().take_while(|byte| b"\r\n".contains(byte));
            let start = from + blank.count();
            line += csv[counted..start].matches('\n').count();
            counted = start;
            Row { line, fields }
        });
        let header = rows.next().map(|row| row.fields).unwrap_or_default();
        let is_blank = |row: &Row| row.fields.len() == 1 && row.fields[0].is_empty();
        let rows = rows.filter(|row| !is_blank(row)).collect();
        Table { header, rows }
    }

    /// The columns.
    pub fn columns(&self) -> impl Iterator<Item = Column> + '_ {
        let column = |(index, name): (usize, &str)| Column { index, name: name.to_owned() };
        self.header.iter().enumerate().map(column)
    }

    /// The column `name`.
    ///
    /// # Errors
    /// The header does not have it, or has it twice.
    pub fn column(&self, name: &str) -> Result<Column, String> {
        let mut columns = self.columns().filter(|column| column.name == name);
        match (columns.next(), columns.next()) {
            (Some(column), None) => Ok(column),
            (Some(_), Some(_)) => Err(format!("line 1: column \"{name}\" twice")),
            (None, _) if self.header.is_empty() => {
                Err(format!("the file is empty; column \"{name}\" is needed"))
            }
            (None, _) => {
                let columns = self.header.iter().collect::<Vec<_>>().join(", ");
                let has_semicolons = self.header.len() == 1 && columns.contains(';');
                let hint = if has_semicolons { "; separate columns by commas" } else { "" };
                let columns = clipped(&columns, SHOWN_MAX);
                Err(format!("line 1: no column \"{name}\"; there are {columns}{hint}"))
            }
        }
    }

    /// The rows.
    pub fn rows(&self) -> &[Row] {
        &self.rows
    }

    /// Checks that each row has as many fields as the header.
    ///
    /// # Errors
    /// The first row that has not.
    pub fn check_row_lengths(&self) -> Result<(), String> {
        let columns = self.header.len();
        match self.rows.iter().find(|row| row.fields.len() != columns) {
            None => Ok(()),
            Some(Row { line, fields }) => {
                Err(format!("line {line}: {} fields where the header has {columns}", fields.len()))
            }
        }
    }

    /// The finite numbers of the columns `names` in every row, in the order of `names`.
    ///
    /// # Errors
    /// A column is missing, a row has not as many fields as the header, or a field is not a finite number.
    pub fn numbers<const N: usize>(&self, names: [&str; N]) -> Result<Vec<[f64; N]>, String> {
        self.check_row_lengths()?;
        let columns = self.columns_of(names)?;
        self.rows.iter().map(|row| row.finite_numbers(&columns)).collect()
    }

    fn columns_of<const N: usize>(&self, names: [&str; N]) -> Result<Vec<Column>, String> {
        names.iter().map(|name| self.column(name)).collect()
    }

    /// The orientation in every row, from the columns `qw,qx,qy,qz`; `None` in every row if the table has none of
    /// them, or if they are empty in every row.
    ///
    /// # Errors
    /// The table has only some of the columns, only some rows have an orientation, a field is not a finite number, or
    /// a quaternion cannot be normalised.
    pub fn rotations(&self) -> Result<Vec<Option<Rotation3<f64>>>, String> {
        if !self.header.iter().any(|name| QUATERNION.contains(&name)) {
            return Ok(vec![None; self.rows.len()]);
        }
        let columns = self.columns_of(QUATERNION)?;
        let is_empty = |row: &Row| columns.iter().all(|column| row.text(column).is_empty());
        if self.rows.iter().all(is_empty) {
            return Ok(vec![None; self.rows.len()]);
        }
        let rotation = |row: &Row| {
            if is_empty(row) {
                return Err(format!(
                    "line {}: no orientation (qw,qx,qy,qz), but other rows have one",
                    row.line
                ));
            }
            let [w, x, y, z] = row.finite_numbers(&columns)?;
            let quaternion = Quaternion::new(w, x, y, z);
            let norm = quaternion.norm();
            if !(norm.is_finite() && norm > 1e-6) {
                return Err(format!(
                    "line {}: qw,qx,qy,qz have the norm {norm}: no orientation",
                    row.line
                ));
            }
            Ok(Some(UnitQuaternion::new_normalize(quaternion).to_rotation_matrix()))
        };
        self.check_row_lengths()?;
        self.rows.iter().map(rotation).collect()
    }
}

impl Row {
    /// The text in `column`; empty if the row is too short.
    pub fn text(&self, column: &Column) -> &str {
        self.fields.get(column.index).unwrap_or_default()
    }

    /// The number in `column`, which may be NaN or infinite.
    ///
    /// # Errors
    /// The field is not a number.
    pub fn number(&self, column: &Column) -> Result<f64, String> {
        self.text(column).parse().map_err(|_| self.error(column, "number"))
    }

    fn finite_numbers<const N: usize>(&self, columns: &[Column]) -> Result<[f64; N], String> {
        let mut numbers = [0.0; N];
        for (number, column) in numbers.iter_mut().zip(columns) {
            let finite = self.number(column).ok().filter(|number| number.is_finite());
            *number = finite.ok_or_else(|| self.error(column, "finite number"))?;
        }
        Ok(numbers)
    }

    /// The error for a field in `column` that does not contain what was `expected`.
    pub fn error(&self, column: &Column, expected: &str) -> String {
        let (line, name) = (self.line, &column.name);
        let field = clipped(self.text(column), SHOWN_MAX);
        format!("line {line}: {name} is {field:?}, expected a {expected}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_found_by_name_in_any_order() {
        let table = Table::parse("\u{feff}b,\"oth,er\", a\r\n2,x,1\r\n\n  \n4,y,3\n");
        assert_eq!(table.numbers(["a", "b"]), Ok(vec![[1.0, 2.0], [3.0, 4.0]]));
        assert_eq!(table.column("oth,er").map(|column| column.index), Ok(1));
        assert_eq!(Table::parse("a\n").numbers(["a"]), Ok(vec![]));
    }

    #[test]
    fn errors_name_the_line_and_the_column() {
        let message = |csv: &str| Table::parse(csv).numbers(["a", "b"]).unwrap_err();
        assert_eq!(message(""), "the file is empty; column \"a\" is needed");
        assert_eq!(message("x,a\n"), "line 1: no column \"b\"; there are x, a");
        let semicolons = "line 1: no column \"a\"; there are a;b; separate columns by commas";
        assert_eq!(message("a;b\n1;2\n"), semicolons);
        for end in ["\n", "\r\n"] {
            let csv = ["a,b", "", "1,2", "", "", "3,inf"].join(end);
            assert_eq!(message(&csv), "line 6: b is \"inf\", expected a finite number");
        }
        assert_eq!(message("a,b\n1,\n"), "line 2: b is \"\", expected a finite number");
        assert_eq!(message("a,b\n1,2\n1\n"), "line 3: 1 fields where the header has 2");
        // A decimal comma moves the numbers behind it to other columns.
        assert_eq!(message("a,b\n1,2\n1,2,3\n"), "line 3: 3 fields where the header has 2");
        assert_eq!(message("a,b,a\n1,2,3\n"), "line 1: column \"a\" twice");
    }

    #[test]
    fn messages_about_long_cells_stay_short() {
        let long = "x".repeat(10_000);
        for csv in [format!("{long}\n"), format!("a\n{long}\n"), format!("a\n\"{long}\n1\n")] {
            let message = Table::parse(&csv).numbers(["a"]).unwrap_err();
            assert!(message.chars().count() <= 200, "{message}");
        }
    }

    #[test]
    fn an_orientation_needs_four_columns_and_a_norm() {
        let rotations = |csv: &str| Table::parse(csv).rotations();
        assert_eq!(rotations("a\n1\n"), Ok(vec![None]));
        assert_eq!(rotations("qw,qx,qy,qz\n2,0,0,0\n"), Ok(vec![Some(Rotation3::identity())]));
        assert_eq!(rotations("qw,qx,qy,qz\n,,,\n"), Ok(vec![None]));
        let twice = format!("{0},{0}\n1,0,0,0,1,0,0,0\n", QUATERNION.join(","));
        assert_eq!(rotations(&twice).unwrap_err(), "line 1: column \"qw\" twice");
        assert!(rotations("qw,qx\n").unwrap_err().contains("no column \"qy\""));
        let message = rotations("qw,qx,qy,qz\n1,0,0,0\n,,,\n").unwrap_err();
        let expected = "line 3: no orientation (qw,qx,qy,qz), but other rows have one";
        assert_eq!(message, expected);
        for (row, norm) in [("0,0,0,0", "0"), ("1e308,1e308,0,0", "inf")] {
            let message = rotations(&format!("qw,qx,qy,qz\n1,0,0,0\n\n{row}\n")).unwrap_err();
            let expected = format!("line 4: qw,qx,qy,qz have the norm {norm}: no orientation");
            assert_eq!(message, expected);
        }
    }
}
