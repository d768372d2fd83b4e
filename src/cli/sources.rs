//! Reads the files that the arguments name.

use super::Failure;
use crate::config::{Config, Source};
use clap::Args;
use std::path::{Path, PathBuf};

/// The configuration of a command: its first argument or `--config`, and keys set over it.
#[derive(Debug, Clone, Default, Args)]
pub(super) struct Configured {
    /// Configuration (TOML); each key that it leaves out is as in bench-config/virtual.toml.
    #[arg(value_name = "CONFIG", conflicts_with = "named")]
    config: Option<PathBuf>,
    /// The configuration, by name.
    #[arg(long = "config", value_name = "CONFIG")]
    named: Option<PathBuf>,
    /// Set a key of the configuration, for example 'insertion.depth_mm=200'.
    #[arg(long, value_name = "KEY=VALUE")]
    pub(super) set: Vec<String>,
}

impl Configured {
    /// The file, if one is named.
    pub(super) fn path(&self) -> Option<&Path> {
        self.config.as_deref().or(self.named.as_deref())
    }

    /// The configuration, as [`load`] reads it.
    pub(super) fn load(&self, fallback: Option<(&str, &str)>) -> Result<Config, Failure> {
        load(self.path(), fallback, &self.set)
    }
}

/// The configuration of a command that takes any number of files, `named` or the TOML file among
/// `files`; and the other files.
///
/// # Errors
/// When there are two configurations, or no other file.
pub(super) fn configuration_among<'a>(
    files: &'a [PathBuf],
    named: Option<&'a Path>,
) -> Result<(Option<&'a Path>, Vec<PathBuf>), Failure> {
    let is_toml = |file: &&PathBuf| file.extension().is_some_and(|ending| ending == "toml");
    let (configurations, others): (Vec<_>, Vec<_>) = files.iter().partition(is_toml);
    let mut configurations =
        named.into_iter().chain(configurations.iter().map(|file| file.as_path()));
    let configuration = configurations.next();
    match (configuration.zip(configurations.next()), others.is_empty()) {
        (Some((one, other)), _) => Err(Failure::Configuration(format!(
            "two configurations, {} and {}: give one",
            one.display(),
            other.display()
        ))),
        (None, true) => Err(Failure::Configuration(
            "no recorded insertion is named: give run folders or CSV files".to_owned(),
        )),
        (None, false) => Ok((configuration, others.into_iter().cloned().collect())),
    }
}

/// The configuration in `path`, else the built-in `fallback` (name, text), else the defaults;
/// `sets` override it.
pub(super) fn load(
    path: Option<&Path>,
    fallback: Option<(&str, &str)>,
    sets: &[String],
) -> Result<Config, Failure> {
    load_with_warnings(path, fallback, sets).map(|(config, _)| config)
}

/// The same, with a warning for each section without effect.
pub(super) fn load_with_warnings(
    path: Option<&Path>,
    fallback: Option<(&str, &str)>,
    sets: &[String],
) -> Result<(Config, Vec<String>), Failure> {
    let (name, text) = match path {
        Some(path) => (path.display().to_string(), text_of(path)?),
        None => match fallback {
            Some((name, text)) => (name.to_owned(), text.to_owned()),
            None => return read(&[], sets),
        },
    };
    read(&[Source { name: &name, text: &text }], sets)
}

/// `sets`, and the key of a rehearsal where one is asked for.
pub(super) fn rehearsed(sets: &[String], rehearse: bool) -> Vec<String> {
    let key = rehearse.then(|| "emulator.rehearse=true".to_owned());
    sets.iter().cloned().chain(key).collect()
}

/// The text of a file that the arguments name.
pub(super) fn text_of(path: &Path) -> Result<String, Failure> {
    text(path).map_err(|error| Failure::in_file(path, error))
}

/// The text of the file `path`, or why it cannot be read.
fn text(path: &Path) -> Result<String, String> {
    if path.is_dir() {
        return Err("cannot be read: it is a folder; name a file in it".to_owned());
    }
    let bytes = std::fs::read(path).map_err(|error| format!("cannot be read: {error}"))?;
    let no_text = |at: usize, byte: Option<&u8>| {
        let byte = byte.copied().unwrap_or_default();
        format!(
            "cannot be read: not a text file (byte {} is {byte:#04x}); name a text file",
            at + 1
        )
    };
    // A text file has no zero byte, although UTF-8 allows it.
    if let Some(at) = bytes.iter().position(|byte| *byte == 0) {
        return Err(no_text(at, None));
    }
    String::from_utf8(bytes).map_err(|error| {
        let at = error.utf8_error().valid_up_to();
        no_text(at, error.as_bytes().get(at))
    })
}

fn read(sources: &[Source<'_>], sets: &[String]) -> Result<(Config, Vec<String>), Failure> {
    let calibration =
        |path: &Path| text(path).map_err(|error| format!("{} {error}", path.display()));
    Config::with_warnings(sources, sets, &calibration).map_err(Failure::configuration)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_toml_file_among_insertions_is_the_configuration() {
        let among = |files: &[&str], named: Option<&str>| {
            let files: Vec<PathBuf> = files.iter().map(PathBuf::from).collect();
            match configuration_among(&files, named.map(Path::new)) {
                Ok((config, others)) => format!("{config:?} {others:?}"),
                Err(Failure::Configuration(why) | Failure::Environment(why)) => why,
            }
        };
        let both = r#"Some("rig.toml") ["a.csv", "runs/b"]"#;
        assert_eq!(among(&["a.csv", "rig.toml", "runs/b"], None), both);
        assert_eq!(among(&["a.csv", "runs/b"], Some("rig.toml")), both);
        assert_eq!(among(&["a.csv"], None), r#"None ["a.csv"]"#);
        let two = "two configurations, a.toml and b.toml: give one";
        assert_eq!(among(&["b.toml", "c.csv"], Some("a.toml")), two);
        assert!(among(&["a.toml"], None).starts_with("no recorded insertion is named"));
    }
}
