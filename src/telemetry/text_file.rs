//! A text file of the record: whole lines or nothing.

use crate::archive::{FileSeal, hex};
use sha2::{Digest, Sha256};
use std::fmt::{Display, Write as _};
use std::fs::File;
use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};

/// What a text file is written to.
pub(super) trait Storage: Write + Send {
    /// Truncates to the first `bytes`.
    fn cut(&mut self, bytes: u64) -> io::Result<()>;
    /// Returns after everything is on the disk.
    fn sync(&mut self) -> io::Result<()>;
}

impl Storage for File {
    fn cut(&mut self, bytes: u64) -> io::Result<()> {
        self.set_len(bytes)
    }

    fn sync(&mut self) -> io::Result<()> {
        self.sync_all()
    }
}

/// Lines that are collected, handed over together, and hashed.
pub(super) struct TextFile<S> {
    name: &'static str,
    path: PathBuf,
    storage: S,
    /// Whole lines that were not handed over yet.
    waiting: String,
    hash: Sha256,
    bytes: u64,
    lines: u64,
}

impl<S: Storage> TextFile<S> {
    /// The file `name` in `dir`, which is empty and kept in `storage`.
    pub(super) fn new(dir: &Path, name: &'static str, storage: S) -> Self {
        let (path, hash) = (dir.join(name), Sha256::new());
        TextFile { name, path, storage, waiting: String::new(), hash, bytes: 0, lines: 0 }
    }

    /// Adds a line, which waits for [`TextFile::hand_over`].
    pub(super) fn line(&mut self, line: impl Display) {
        // Writing to a string does not fail.
        let _ = writeln!(self.waiting, "{line}");
    }

    /// Hands every line to the system: from then on they survive the end of this process.
    /// Partial lines are truncated where possible.
    ///
    /// # Errors
    /// Of writing, with the file's name; the lines that were not taken are lost.
    pub(super) fn hand_over(&mut self) -> Result<(), String> {
        let waiting = std::mem::take(&mut self.waiting);
        let bytes = waiting.as_bytes();
        let (taken, result) = write_until_error(&mut self.storage, bytes);
        let (mut kept, _) = bytes.split_at(taken.min(bytes.len()));
        if result.is_err() {
            let whole = kept.iter().rposition(|byte| *byte == b'\n').map_or(0, |end| end + 1);
            if self.storage.cut(self.bytes + whole as u64).is_ok() {
                kept = &kept[..whole];
            }
        }
        self.hash.update(kept);
        self.bytes += kept.len() as u64;
        self.lines += kept.iter().filter(|byte| **byte == b'\n').count() as u64;
        // Keep its allocation.
        self.waiting = waiting;
        self.waiting.clear();
        result.map_err(|e| self.explain(&e))
    }

    /// Returns when everything handed over is on the disk.
    ///
    /// # Errors
    /// The system's, with the file's name.
    pub(super) fn sync(&mut self) -> Result<(), String> {
        self.storage.sync().map_err(|e| self.explain(&e))
    }

    /// Lines handed over.
    pub(super) fn lines(&self) -> u64 {
        self.lines
    }

    /// The file's name, and what was handed over.
    pub(super) fn seal(&self) -> (String, FileSeal) {
        let sha256 = hex(&self.hash.clone().finalize());
        (self.name.to_owned(), FileSeal { bytes: self.bytes, sha256 })
    }

    fn explain(&self, error: &io::Error) -> String {
        format!("{}: {error}", self.path.display())
    }
}

/// Writes `bytes`; returns how many were taken, and the error that ended it.
fn write_until_error(storage: &mut impl Write, bytes: &[u8]) -> (usize, io::Result<()>) {
    let mut taken = 0;
    while let Some(rest) = bytes.get(taken..).filter(|rest| !rest.is_empty()) {
        match storage.write(rest) {
            Ok(0) => return (taken, Err(ErrorKind::WriteZero.into())),
            Ok(n) => taken += n,
            Err(e) if e.kind() == ErrorKind::Interrupted => {}
            Err(e) => return (taken, Err(e)),
        }
    }
    (taken, Ok(()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::archive::sha256_hex;
    use std::sync::{Arc, Mutex};

    /// A disk of so many bytes, and what is on it.
    #[derive(Clone)]
    struct SmallDisk {
        content: Arc<Mutex<Vec<u8>>>,
        room: usize,
        can_cut: bool,
    }

    impl SmallDisk {
        fn new(room: usize) -> Self {
            SmallDisk { content: Arc::default(), room, can_cut: true }
        }
    }

    impl Write for SmallDisk {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            let mut content = self.content.lock().unwrap();
            let taken = bytes.len().min(self.room - content.len());
            content.extend(&bytes[..taken]);
            if taken > 0 { Ok(taken) } else { Err(ErrorKind::StorageFull.into()) }
        }
        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    impl Storage for SmallDisk {
        fn cut(&mut self, bytes: u64) -> io::Result<()> {
            if !self.can_cut {
                return Err(ErrorKind::ReadOnlyFilesystem.into());
            }
            self.content.lock().unwrap().truncate(bytes as usize);
            Ok(())
        }
        fn sync(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_disk_that_fills_keeps_whole_lines_and_the_seal_is_theirs() {
        for (can_cut, left) in [(true, "first\nsecond\n"), (false, "first\nsecond\nthi")] {
            let disk = SmallDisk { can_cut, ..SmallDisk::new(16) };
            let mut file = TextFile::new(Path::new("run"), "steps.csv", disk.clone());
            file.line("first");
            file.hand_over().unwrap();
            file.line("second");
            file.line("third");
            assert_eq!(file.hand_over().unwrap_err(), "run/steps.csv: no storage space");
            assert_eq!(*disk.content.lock().unwrap(), left.as_bytes());
            assert_eq!(file.lines(), 2);
            let seal = FileSeal { bytes: left.len() as u64, sha256: sha256_hex(left.as_bytes()) };
            assert_eq!(file.seal(), ("steps.csv".to_owned(), seal));
        }
    }
}
