//! `steps.csv` as columns of numbers, by name.

use super::lines::without_partial_line;
use crate::table::Table;
use std::collections::BTreeMap;

/// A `steps.csv`, or another table of numbers with a header.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct StepsTable {
    rows: usize,
    columns: BTreeMap<String, Vec<Option<f64>>>,
}

impl StepsTable {
    /// Reads `text`. A partial last line, which a killed bench leaves behind, is omitted. Empty fields are unknown.
    ///
    /// # Errors
    /// A row has not as many fields as the header, or a field is not a number.
    pub fn parse(text: &str) -> Result<Self, String> {
        let table = Table::parse(without_partial_line(text));
        table.check_row_lengths()?;
        let columns = table.columns().map(|column| {
            let numbers = table.rows().iter().map(|row| match row.text(&column) {
                "" => Ok(None),
                _ => row.number(&column).map(Some),
            });
            Ok((column.name.clone(), numbers.collect::<Result<_, _>>()?))
        });
        Ok(StepsTable {
            rows: table.rows().len(),
            columns: columns.collect::<Result<_, String>>()?,
        })
    }

    /// The column `name` from the first row to the last; unknown in every row if there is no such column.
    pub fn column(&self, name: &str) -> Vec<Option<f64>> {
        self.columns.get(name).cloned().unwrap_or_else(|| vec![None; self.rows])
    }

    /// The first place where `step` does not count up by one, in words. This is no error: a writer that cannot keep
    /// up drops rows.
    pub fn miscount(&self) -> Option<String> {
        let steps: Vec<f64> = self.column("step").into_iter().flatten().collect();
        let [before, next] = *steps.windows(2).find(|pair| pair[1] != pair[0] + 1.0)? else {
            return None;
        };
        Some(format!("step {next} follows step {before}: rows are missing, doubled or swapped"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_found_by_name_and_a_cut_line_is_left_out() {
        let table = StepsTable::parse("step,x_mm,y_mm\n0,1.5,\n1,-0.25,NaN\n2,0.").unwrap();
        assert_eq!(table.rows, 2);
        assert_eq!(table.column("x_mm"), [Some(1.5), Some(-0.25)]);
        assert_eq!(table.column("z_mm"), [None, None]);
        let y = table.column("y_mm");
        assert!(y[0].is_none() && y[1].is_some_and(f64::is_nan));
        assert_eq!(StepsTable::parse("").unwrap(), StepsTable::default());
    }

    #[test]
    fn a_value_that_is_not_a_number_is_refused_with_its_line() {
        let error = StepsTable::parse("step,x_mm\n0,1\n1,gone\n").unwrap_err();
        assert_eq!(error, "line 3: x_mm is \"gone\", expected a number");
        let error = StepsTable::parse("step,x_mm\n0,1\n1\n2,3\n").unwrap_err();
        assert_eq!(error, "line 3: 1 fields where the header has 2");
    }

    #[test]
    fn rows_that_are_missing_doubled_or_swapped_are_noticed() {
        let said = |csv: &str| StepsTable::parse(csv).unwrap().miscount();
        assert_eq!(said("step,x_mm\n0,1\n1,2\n2,3\n3,"), None);
        assert_eq!(said(""), None);
        let why = |next, before| {
            Some(format!("step {next} follows step {before}: rows are missing, doubled or swapped"))
        };
        assert_eq!(said("step,x_mm\n0,1\n2,3\n"), why(2, 0));
        assert_eq!(said("step,x_mm\n0,1\n0,1\n1,2\n"), why(0, 0));
        assert_eq!(said("step,x_mm\n0,1\n2,3\n1,2\n"), why(2, 0));
    }
}
