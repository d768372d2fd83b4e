//! What is wrong with a configuration, one line each.

use std::fmt;

use super::value::Origin;

/// How many problems are printed at most.
const SHOWN_MAX: usize = 10;

/// One thing wrong with a configuration: where, which key, which value, what is allowed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    /// Where the offending value was given; `None` for a key that nobody gave.
    pub origin: Option<Origin>,
    /// The whole line, with the place in front.
    pub message: String,
}

impl Problem {
    /// `message` begins with the key it is about.
    pub(super) fn at(origin: Option<Origin>, message: impl fmt::Display) -> Self {
        let place = origin.as_ref().map(Origin::to_string).unwrap_or_default();
        Problem { message: format!("{place}{message}"), origin }
    }

    pub(super) fn syntax(origin: Origin, message: String) -> Self {
        Problem { origin: Some(origin), message }
    }

    pub(super) fn unknown_key(origin: Origin, key: &str, hint: &str) -> Self {
        let message = match origin {
            Origin::File { .. } => format!("{origin}unknown key \"{key}\"; {hint}"),
            Origin::Set => format!("{origin}{key}: unknown key; {hint}"),
        };
        Problem { origin: Some(origin), message }
    }
}

/// A configuration that cannot be used: everything found wrong with it, in the order found.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub struct ConfigError {
    /// At least one.
    pub problems: Vec<Problem>,
}

impl ConfigError {
    /// The problems, if there are any.
    pub(super) fn unless_empty(problems: Vec<Problem>) -> Result<(), Self> {
        if problems.is_empty() { Ok(()) } else { Err(ConfigError { problems }) }
    }

    /// One problem that has no place in a file.
    pub(super) fn of(message: impl fmt::Display) -> Self {
        ConfigError { problems: vec![Problem::at(None, message)] }
    }
}

impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, problem) in self.problems.iter().take(SHOWN_MAX).enumerate() {
            let newline = if i == 0 { "" } else { "\n" };
            write!(f, "{newline}{}", problem.message)?;
        }
        match self.problems.len().saturating_sub(SHOWN_MAX) {
            0 => Ok(()),
            more => write!(f, "\nand {more} more"),
        }
    }
}
