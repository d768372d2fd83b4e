//! A run folder opened for reading: its manifest, and whether its files are unchanged.

use super::TelemetryError;
use crate::archive::{FileSeal, Lines, Manifest, file, hex};
use sha2::{Digest, Sha256};
use std::fs::{self, File};
use std::io::{self, BufReader, Read};
use std::path::{Path, PathBuf};

/// The folder of a recorded run, opened for reading. Nothing here writes.
#[derive(Debug, Clone)]
pub struct RunFolder {
    /// The folder's path.
    pub dir: PathBuf,
    /// The manifest, as it was when the folder was opened.
    pub manifest: Manifest,
}

impl RunFolder {
    /// Opens `dir` and reads only its manifest.
    ///
    /// # Errors
    /// [`TelemetryError::NotARun`], or [`TelemetryError::Unusable`] if its manifest cannot be used.
    pub fn open(dir: &Path) -> Result<Self, TelemetryError> {
        let not_a_run =
            |reason: String| TelemetryError::NotARun { path: dir.to_path_buf(), reason };
        if !dir.is_dir() {
            let what = if dir.exists() { "it is a file" } else { "there is nothing of that name" };
            return Err(not_a_run(what.to_owned()));
        }
        let path = dir.join(file::MANIFEST);
        let text = read_text(&path).map_err(|e| not_a_run(format!("{}: {e}", file::MANIFEST)))?;
        match Manifest::from_text(&text) {
            Ok(manifest) => Ok(RunFolder { dir: dir.to_path_buf(), manifest }),
            Err(error) => Err(TelemetryError::unusable(&path, error)),
        }
    }

    /// True once the record was closed, by the bench or by a repair: then its files are sealed.
    pub fn is_closed(&self) -> bool {
        self.manifest.outcome.is_some()
    }

    /// Checks that the sealed files are unchanged, and that in a closed record every text file has a seal. In a
    /// record that was never closed only the configuration is checked. `run.rrd` is not checked
    /// (see [`Self::change`]): it follows from the other files, and nothing is read from it.
    ///
    /// # Errors
    /// [`TelemetryError::Unusable`] with every file that differs, or [`TelemetryError::File`].
    pub fn verify(&self) -> Result<(), TelemetryError> {
        let files = &self.manifest.files;
        let sealed = files.keys().map(String::as_str).filter(|name| *name != file::RECORDING);
        let is_unsealed = |name: &&str| !files.contains_key(*name) && self.dir.join(name).exists();
        let unsealed =
            file::TEXT_FILES.into_iter().filter(|_| self.is_closed()).filter(is_unsealed);
        let config = Some(file::CONFIG).filter(|name| !files.contains_key(*name));
        let mut changes = Vec::new();
        for name in sealed.chain(unsealed).chain(config) {
            changes.extend(self.change(name)?);
        }
        if changes.is_empty() {
            return Ok(());
        }
        let changes = changes.join("; ");
        let reason = format!(
            "{changes}, so this is not the record of that run any more (restore it from a copy)"
        );
        Err(TelemetryError::unusable(&self.dir, reason))
    }

    /// How the file `name` differs from its seal in the manifest; `None` if it is unchanged. A configuration without a
    /// seal is compared by its hash alone.
    ///
    /// # Errors
    /// [`TelemetryError::File`].
    pub fn change(&self, name: &str) -> Result<Option<String>, TelemetryError> {
        let Some(now) = seal_of(&self.dir, name)? else {
            return Ok(Some(format!("{name} is missing")));
        };
        let seal = self.manifest.files.get(name);
        let config_sha256 = Some(&self.manifest.config_sha256).filter(|_| name == file::CONFIG);
        Ok(match (seal, seal.map(|seal| &seal.sha256).or(config_sha256)) {
            (_, None) => Some(format!("{name} has no seal in the manifest")),
            (Some(seal), _) if seal.bytes != now.bytes => Some(format!(
                "{name} had {} bytes when the record was closed and has {} now",
                seal.bytes, now.bytes
            )),
            (_, Some(sha256)) if *sha256 != now.sha256 => {
                Some(format!("{name} was edited: its SHA-256 is not the one in manifest.json"))
            }
            _ => None,
        })
    }

    /// The lines of the file `name`, read one by one.
    ///
    /// # Errors
    /// The file cannot be opened.
    pub fn lines(&self, name: &str) -> io::Result<Lines> {
        open_regular(&self.dir.join(name)).map(|file| Lines::new(BufReader::new(file)))
    }

    /// The text of the file `name`. Bytes that are not UTF-8, as a truncated file may have, are replaced.
    ///
    /// # Errors
    /// [`TelemetryError::File`].
    pub fn text(&self, name: &str) -> Result<String, TelemetryError> {
        let path = self.dir.join(name);
        read_text(&path).map_err(TelemetryError::file(&path))
    }
}

/// Opens the regular file `path`.
///
/// # Errors
/// The file cannot be opened, or is a pipe or a device, which might never end.
pub fn open_regular(path: &Path) -> io::Result<File> {
    if !fs::metadata(path)?.is_file() {
        return Err(io::Error::other("not a regular file"));
    }
    File::open(path)
}

/// The text of the file `path`; bytes that are not UTF-8 are replaced.
fn read_text(path: &Path) -> io::Result<String> {
    let mut bytes = Vec::new();
    open_regular(path)?.read_to_end(&mut bytes)?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

/// Size and SHA-256 of the file `name` in `dir` as it is now; `None` if it does not exist.
///
/// # Errors
/// [`TelemetryError::File`].
pub(super) fn seal_of(dir: &Path, name: &str) -> Result<Option<FileSeal>, TelemetryError> {
    let path = dir.join(name);
    match seal_file(&path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        sealed => sealed.map(Some).map_err(TelemetryError::file(&path)),
    }
}

fn seal_file(path: &Path) -> io::Result<FileSeal> {
    let (mut file, mut buffer) = (open_regular(path)?, [0; 1 << 16]);
    let (mut hash, mut bytes) = (Sha256::new(), 0);
    while let read @ 1.. = file.read(&mut buffer)? {
        hash.update(&buffer[..read]);
        bytes += read as u64;
    }
    Ok(FileSeal { bytes, sha256: hex(&hash.finalize()) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::archive::sha256_hex;
    use crate::session::Outcome;
    use crate::telemetry::tests::Scratch;
    use crate::telemetry::write_manifest;

    /// A closed run of one file beside its configuration.
    fn run(dir: &Path) {
        let config = "name = \"x\"\n";
        fs::write(dir.join(file::CONFIG), config).unwrap();
        fs::write(dir.join(file::STEPS), "step\n0\n").unwrap();
        let mut manifest = Manifest::new("x", "2023-11-14T22:13:20.000000Z".to_owned());
        manifest.config_sha256 = sha256_hex(config.as_bytes());
        manifest.set_outcome(&Outcome::Completed);
        let seal = seal_file(&dir.join(file::STEPS)).unwrap();
        manifest.files.insert(file::STEPS.to_owned(), seal);
        write_manifest(dir, &manifest).unwrap();
    }

    #[test]
    fn an_unchanged_run_is_verified() {
        let scratch = Scratch::new("run-folder-whole");
        run(&scratch.0);
        let folder = RunFolder::open(&scratch.0).unwrap();
        assert!(folder.is_closed());
        folder.verify().unwrap();
        assert_eq!(folder.text(file::STEPS).unwrap(), "step\n0\n");
    }

    #[test]
    fn every_change_of_a_closed_run_is_named() {
        let scratch = Scratch::new("run-folder-changed");
        let dir = &scratch.0;
        let said = || RunFolder::open(dir).unwrap().verify().unwrap_err().to_string();
        run(dir);
        fs::write(dir.join(file::STEPS), "step\n1\n").unwrap();
        assert!(said().contains("steps.csv was edited"), "{}", said());
        fs::write(dir.join(file::STEPS), "step\n").unwrap();
        assert!(said().contains("steps.csv had 7 bytes when the record was closed and has 5 now"));
        fs::remove_file(dir.join(file::STEPS)).unwrap();
        fs::write(dir.join(file::CONFIG), "name = \"y\"\n").unwrap();
        assert!(said().contains("steps.csv is missing; config.toml was edited"), "{}", said());
        fs::remove_file(dir.join(file::CONFIG)).unwrap();
        assert!(said().contains("steps.csv is missing; config.toml is missing"), "{}", said());
    }

    #[test]
    fn a_text_file_without_a_seal_is_refused() {
        let scratch = Scratch::new("run-folder-unsealed");
        let dir = &scratch.0;
        run(dir);
        fs::write(dir.join(file::CAN), "").unwrap();
        let said = RunFolder::open(dir).unwrap().verify().unwrap_err().to_string();
        assert!(said.contains("can.log has no seal in the manifest"), "{said}");
    }

    #[test]
    fn a_path_that_is_not_a_run_folder_is_refused_with_the_reason() {
        let scratch = Scratch::new("run-folder-none");
        let said = |path: &Path| RunFolder::open(path).unwrap_err().to_string();
        assert!(said(&scratch.0).contains("not a run folder: manifest.json: No such file"));
        let gone = scratch.0.join("gone");
        assert!(said(&gone).ends_with("gone: not a run folder: there is nothing of that name"));
        fs::write(scratch.0.join("f"), "").unwrap();
        assert!(said(&scratch.0.join("f")).ends_with("not a run folder: it is a file"));
        fs::write(scratch.0.join(file::MANIFEST), "{").unwrap();
        assert!(said(&scratch.0).contains("manifest.json: not a run's manifest: EOF"));
    }
}
