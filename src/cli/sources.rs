//! Reading the files that the arguments name.

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
        Some(path) => (path.display().to_string(), text_of(path)?),
        None => match fallback {
            Some((name, text)) => (name.to_owned(), text.to_owned()),
            None => return read(&[], sets),
        },
    };
    read(&[Source { name: &name, text: &text }], sets)
}

/// The text of a file that the arguments name.
pub(super) fn text_of(path: &Path) -> Result<String, Failure> {
    std::fs::read_to_string(path).map_err(|error| {
        Failure::Configuration(format!("{}: cannot be read: {error}", path.display()))
    })
}

fn read(sources: &[Source<'_>], sets: &[String]) -> Result<Config, Failure> {
    let calibration = |path: &Path| {
        std::fs::read_to_string(path)
            .map_err(|error| format!("{} cannot be read: {error}", path.display()))
    };
    Config::from_sources_and_files(sources, sets, &calibration)
        .map_err(|error| Failure::Configuration(error.to_string()))
}
