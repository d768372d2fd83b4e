//! Where a replay comes out different from the record.

use crate::archive::file;
use std::fmt;

/// The first thing that comes out different.
#[derive(Debug, Clone, PartialEq)]
pub enum Difference {
    /// A value in a row of `steps.csv`.
    Value {
        /// Line of the file, from 1.
        line: usize,
        /// The row's step, as recorded.
        step: String,
        /// The column.
        column: String,
        /// The recorded value; empty where none was.
        recorded: String,
        /// The replayed one.
        replayed: String,
    },
    /// A line of a file; `None` where one side has no more.
    Line {
        /// The file.
        file: &'static str,
        /// Line of the file, from 1.
        line: usize,
        /// The recorded line.
        recorded: Option<String>,
        /// The replayed one.
        replayed: Option<String>,
    },
    /// A file of a record that was cut ends long before the others.
    Ends {
        /// The file.
        file: &'static str,
        /// How long before the record's last entry, s.
        apart_s: f64,
        /// How long it may be, s.
        limit_s: f64,
    },
    /// How the run ended.
    Outcome {
        /// In the manifest's words.
        recorded: String,
        /// The replayed session's.
        replayed: String,
    },
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Difference::Value { line, step, column, recorded, replayed } => {
                let (was, is) = (or_nothing(recorded), or_nothing(replayed));
                let name = file::STEPS;
                write!(
                    f,
                    "{name} line {line}, step {step}, {column}: recorded {was}, replayed {is}"
                )?;
                match (recorded.parse::<f64>(), replayed.parse::<f64>()) {
                    (Ok(was), Ok(is)) => write!(f, " ({:.1e} more)", is - was),
                    _ => Ok(()),
                }
            }
            Difference::Line { file, line, recorded, replayed } => {
                let text =
                    |line: &Option<String>| line.clone().unwrap_or("nothing more".to_owned());
                write!(
                    f,
                    "{file} line {line}: recorded {}, replayed {}",
                    text(recorded),
                    text(replayed)
                )
            }
            Difference::Ends { file, apart_s, limit_s } => write!(
                f,
                "{file} ends {apart_s:.3} s before the record does: a cut leaves its files within \
                 {limit_s:.1} s of each other"
            ),
            Difference::Outcome { recorded, replayed } => {
                write!(f, "outcome: recorded {recorded}, replayed {replayed}")
            }
        }
    }
}

fn or_nothing(value: &str) -> &str {
    if value.is_empty() { "nothing" } else { value }
}
