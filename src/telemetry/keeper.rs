//! The keeper of a run folder: writes the manifest, has the text files put on the disk itself, and
//! sees that the folder is still there and its disk not full.
//!
//! What a writer hands over survives the death of the bench, but waits in the system's memory for
//! the disk: a disk that takes nothing shows only to one who asks. The keeper asks four times
//! a second, on a thread of its own, which may wait as long as it likes.

use super::room::check_not_full;
use super::vitals::Vitals;
use super::{TelemetryError, folder, seal_file};
use crate::archive::Manifest;
use std::fs::{self, File};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread;
use std::time::{Duration, Instant};

/// The keeper's name in messages.
pub(super) const KEEPER: &str = "run folder";
/// Between two looks at the folder, at each of which one of the files, in turn, is put on the disk:
/// with five of them a loss of power costs a second and a quarter.
const LOOK_EVERY: Duration = Duration::from_millis(250);

/// A file of the folder by its name, for looking after it while another writes.
pub(super) type Kept = (&'static str, File);

enum Order {
    Write(Box<Manifest>),
    Close(Box<Manifest>, Vec<&'static str>),
}

/// A run folder's keeper, seen from its owner.
pub(super) struct Keeper {
    orders: Sender<Order>,
    closed: Receiver<Result<(), TelemetryError>>,
    pub(super) vitals: Arc<Vitals>,
}

impl Keeper {
    /// Keeps the run folder `dir` and `files` in it, by name.
    ///
    /// # Errors
    /// [`TelemetryError::WriterFailed`] when no thread can be started.
    pub(super) fn start(dir: PathBuf, files: Vec<Kept>) -> Result<Self, TelemetryError> {
        let (orders, taken) = channel();
        let (done, closed) = channel();
        let vitals = Arc::new(Vitals::default());
        let of_thread = Arc::clone(&vitals);
        thread::Builder::new()
            .name("run-folder".to_owned())
            .spawn(move || done.send(keep(&dir, &files, &taken, &of_thread)))
            .map_err(|e| TelemetryError::WriterFailed { writer: KEEPER, reason: e.to_string() })?;
        Ok(Keeper { orders, closed, vitals })
    }

    /// Has `manifest` written, in its own time.
    pub(super) fn write(&self, manifest: &Manifest) {
        let _ = self.orders.send(Order::Write(Box::new(manifest.clone())));
    }

    /// Seals the files named in `read_back`, by their content, and writes the last manifest.
    ///
    /// # Errors
    /// [`TelemetryError::File`] where that fails, and [`TelemetryError::WriterSilent`] where it is
    /// not done by `deadline`.
    pub(super) fn close(
        &self,
        manifest: Manifest,
        read_back: Vec<&'static str>,
        deadline: Instant,
    ) -> Result<(), TelemetryError> {
        let asked = Instant::now();
        let limit = deadline.saturating_duration_since(asked);
        let _ = self.orders.send(Order::Close(Box::new(manifest), read_back));
        self.closed.recv_timeout(limit).unwrap_or_else(|_| {
            Err(TelemetryError::WriterSilent {
                writer: KEEPER,
                silent_s: asked.elapsed().as_secs_f64(),
                limit_s: limit.as_secs_f64(),
            })
        })
    }
}

/// The keeper's loop: until the record is closed, or abandoned.
fn keep(
    dir: &Path,
    files: &[Kept],
    orders: &Receiver<Order>,
    vitals: &Vitals,
) -> Result<(), TelemetryError> {
    let mut in_turn = files.iter().cycle();
    loop {
        let order = orders.recv_timeout(LOOK_EVERY);
        vitals.beat();
        let kept = match order {
            Ok(Order::Write(manifest)) => {
                folder::write_manifest(dir, &manifest).and_then(|()| folder::reserve_manifest(dir))
            }
            Ok(Order::Close(mut manifest, read_back)) => {
                for name in read_back {
                    // One that cannot be read has no seal, and its writer's fault is in the manifest.
                    let seal = seal_file(&dir.join(name));
                    manifest.files.extend(seal.ok().map(|seal| (name.to_owned(), seal)));
                }
                return folder::write_manifest(dir, &manifest);
            }
            Err(RecvTimeoutError::Timeout) => look_after(dir, files, in_turn.next()),
            Err(RecvTimeoutError::Disconnected) => return Ok(()),
        };
        if let Err(error) = kept {
            vitals.fail(error.to_string());
        }
        vitals.beat();
    }
}

/// Sees that `files` are still those of the folder and that there is room, and puts the one whose
/// turn it is on the disk.
fn look_after(dir: &Path, files: &[Kept], turn: Option<&Kept>) -> Result<(), TelemetryError> {
    let failed = |name: &str| {
        let path = dir.join(name);
        move |source| TelemetryError::File { path, source }
    };
    for (name, file) in files {
        is_in_place(file, &dir.join(name)).map_err(failed(name))?;
    }
    check_not_full(dir)?;
    turn.map_or(Ok(()), |(name, file)| file.sync_data().map_err(failed(name)))
}

/// A file whose folder is removed or renamed can be written for ever, and is found by nobody.
fn is_in_place(file: &File, path: &Path) -> io::Result<()> {
    let (ours, there) = (file.metadata()?, fs::symlink_metadata(path)?);
    if (ours.dev(), ours.ino()) == (there.dev(), there.ino()) {
        return Ok(());
    }
    Err(io::Error::other("another file has taken its place"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::archive::file;
    use crate::telemetry::folder::tests::Scratch;

    #[test]
    fn a_folder_that_is_gone_is_noticed() {
        let scratch = Scratch::new("keeper");
        let path = scratch.0.join(file::STEPS);
        let files = vec![(file::STEPS, File::create(&path).unwrap())];
        look_after(&scratch.0, &files, files.first()).unwrap();
        fs::remove_file(&path).unwrap();
        let said = look_after(&scratch.0, &files, files.first()).unwrap_err().to_string();
        assert!(said.contains("steps.csv: No such file"), "{said}");
        fs::write(&path, "").unwrap();
        let said = look_after(&scratch.0, &files, files.first()).unwrap_err().to_string();
        assert!(said.ends_with("steps.csv: another file has taken its place"), "{said}");
    }
}
