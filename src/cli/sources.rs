//! Reading configuration files.

use super::Failure;
use crate::config::{Config, Source};
use std::path::Path;

/// The configuration in `path`, or the built-in `fallback` (name, text), or the defaults; with
/// `sets` over it.
pub(super) fn load(
    path: Option<&Path>,
    fallback: Option<(&str, &str)>,
    sets: &[String],
) -> Result<Config, Failure> {
    let (name, text) = match path {
        Some(path) => {
            let text = std::fs::read_to_string(path).map_err(|error| {
                Failure::Configuration(format!("{}: cannot be read: {error}", path.display()))
            })?;
            (path.display().to_string(), text)
        }
        None => match fallback {
            Some((name, text)) => (name.to_owned(), text.to_owned()),
            None => return read(&[], sets),
        },
    };
    read(&[Source { name: &name, text: &text }], sets)
}

fn read(sources: &[Source<'_>], sets: &[String]) -> Result<Config, Failure> {
    Config::from_sources(sources, sets).map_err(|error| Failure::Configuration(error.to_string()))
}
