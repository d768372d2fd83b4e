//! `steps.csv` as numbers, by the names of its columns.

use super::steps_csv::RecordedSteps;
use thiserror::Error;

/// A `steps.csv`, or another table of numbers with a header.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct StepsTable {
    columns: Vec<String>,
    rows: Vec<Vec<Option<f64>>>,
}

/// A field that is no number.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("line {line}, {column}: \"{field}\" is not a number")]
pub struct StepsTableError {
    /// Line of the file, from 1.
    pub line: usize,
    /// The column.
    pub column: String,
    /// What stands there.
    pub field: String,
}

impl StepsTable {
    /// Reads `text`. A last line without an end, which a kill leaves, is left out; empty fields are
    /// unknown, and so are those that a short line lacks.
    ///
    /// # Errors
    /// The first field that is no number.
    pub fn parse(text: &str) -> Result<Self, StepsTableError> {
        let recorded = RecordedSteps::parse(text);
        let columns: Vec<String> = recorded.columns.into_iter().map(str::to_owned).collect();
        let rows = recorded.rows.into_iter().zip(2..).map(|(row, line)| {
            let field = |(n, column): (usize, &String)| match row.get(n).copied().unwrap_or("") {
                "" => Ok(None),
                field => field.parse().map(Some).map_err(|_| StepsTableError {
                    line,
                    column: column.clone(),
                    field: field.to_owned(),
                }),
            };
            columns.iter().enumerate().map(field).collect()
        });
        let rows = rows.collect::<Result<_, _>>()?;
        Ok(StepsTable { columns, rows })
    }

    /// The column `name` from the first row to the last, unknown throughout where there is none.
    pub fn column(&self, name: &str) -> Vec<Option<f64>> {
        let at = self.columns.iter().position(|column| column == name);
        let field = |row: &Vec<Option<f64>>| at.and_then(|at| row.get(at).copied().flatten());
        self.rows.iter().map(field).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_found_by_name_and_a_cut_line_is_left_out() {
        let table = StepsTable::parse("step,x_mm,y_mm\n0,1.5,\n1,-0.25,NaN\n2,0.").unwrap();
        assert_eq!(table.rows.len(), 2);
        assert_eq!(table.column("x_mm"), [Some(1.5), Some(-0.25)]);
        assert_eq!(table.column("z_mm"), [None, None]);
        let y = table.column("y_mm");
        assert!(y[0].is_none() && y[1].is_some_and(f64::is_nan));
        assert!(StepsTable::parse("").unwrap().rows.is_empty());
    }

    #[test]
    fn what_is_no_number_is_named() {
        let error = StepsTable::parse("step,x_mm\n0,1\n1,gone\n").unwrap_err();
        assert_eq!(error.to_string(), "line 3, x_mm: \"gone\" is not a number");
    }
}
