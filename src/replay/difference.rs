//! Where a replay comes out different from the record.

use crate::archive::file;
use thiserror::Error;

/// The first thing that comes out different.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum Difference {
    /// A value in a row of `steps.csv`.
    #[error(
        "{name} line {line}, step {step}, {column}: recorded {}, replayed {}{}",
        or_nothing(.recorded), or_nothing(.replayed), more(.recorded, .replayed), name = file::STEPS
    )]
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
    #[error("{file} line {line}: recorded {}, replayed {}", line_of(.recorded), line_of(.replayed))]
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
    #[error(
        "{file} ends {apart_s:.3} s before the record does: a cut leaves its files within \
         {limit_s:.1} s of each other"
    )]
    Ends {
        /// The file.
        file: &'static str,
        /// How long before the record's last entry, s.
        apart_s: f64,
        /// How long it may be, s.
        limit_s: f64,
    },
    /// How the run ended.
    #[error("outcome: recorded {recorded}, replayed {replayed}")]
    Outcome {
        /// In the manifest's words.
        recorded: String,
        /// The replayed session's.
        replayed: String,
    },
}

/// A line, of which one side may have no more.
fn line_of(text: &Option<String>) -> &str {
    text.as_deref().unwrap_or("nothing more")
}

fn or_nothing(value: &str) -> &str {
    if value.is_empty() { "nothing" } else { value }
}

/// By how much more was replayed, of two numbers.
fn more(recorded: &str, replayed: &str) -> String {
    match (recorded.parse::<f64>(), replayed.parse::<f64>()) {
        (Ok(was), Ok(is)) => format!(" ({:.1e} more)", is - was),
        _ => String::new(),
    }
}
