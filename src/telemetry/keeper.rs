//! The keeper of a run folder: it writes the manifest, syncs the text files to the disk, and checks that
//! the folder is still there and its disk is not full.
//!
//! What a writer hands over survives the end of the bench, but waits in the system's memory for the
//! disk: a stalled disk is detected only by a sync. The keeper syncs four times a second, on a thread of
//! its own, which may block.

use super::folder::Identity;
use super::room::check_not_full;
use super::vitals::Vitals;
use super::{TelemetryError, folder};
use crate::archive::{Manifest, file};
use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread;
use std::time::{Duration, Instant};

/// The keeper's name in messages.
pub(super) const KEEPER: &str = "run folder";
/// Interval of the checks. Each check syncs one of the five text files, in turn, so a loss of power
/// costs 1.25 s.
const LOOK_EVERY: Duration = Duration::from_millis(250);

/// A file of the folder by its name, to check while the writer writes to it.
pub(super) type Kept = (&'static str, File);

enum Order {
    Write(Box<Manifest>),
    Close(Box<Manifest>),
}

/// A handle to the thread of a keeper.
pub(super) struct Keeper {
    orders: Sender<Order>,
    closed: Receiver<Result<Vec<String>, TelemetryError>>,
    troubles: Receiver<String>,
    pub(super) vitals: Arc<Vitals>,
}

impl Keeper {
    /// Keeps the run folder `dir` and `files` in it, by name.
    ///
    /// # Errors
    /// [`TelemetryError::File`] when the folder cannot be opened, and
    /// [`TelemetryError::WriterFailed`] when no thread can be started.
    pub(super) fn start(dir: PathBuf, files: Vec<Kept>) -> Result<Self, TelemetryError> {
        let (orders, taken) = channel();
        let (done, closed) = channel();
        let (told, troubles) = channel();
        let vitals = Arc::new(Vitals::default());
        let of_thread = Arc::clone(&vitals);
        let kept = Folder::open(dir, files)?;
        thread::Builder::new()
            .name("run-folder".to_owned())
            .spawn(move || done.send(keep(&kept, &taken, &told, &of_thread)))
            .map_err(|e| TelemetryError::WriterFailed { writer: KEEPER, reason: e.to_string() })?;
        Ok(Keeper { orders, closed, troubles, vitals })
    }

    /// Lets the keeper write `manifest`, without waiting for it.
    pub(super) fn write(&self, manifest: &Manifest) {
        let _ = self.orders.send(Order::Write(Box::new(manifest.clone())));
    }

    /// The next trouble with the folder; each is reported once.
    pub(super) fn trouble(&self) -> Option<TelemetryError> {
        let reason = self.troubles.try_recv().ok()?;
        Some(TelemetryError::Amiss { writer: KEEPER, reason })
    }

    /// Writes the last manifest, with the troubles that were not reported yet, and returns these.
    ///
    /// # Errors
    /// [`TelemetryError::File`] if the folder is not in its place or the manifest cannot be written, and
    /// [`TelemetryError::WriterSilent`] if it is not written by `deadline`.
    pub(super) fn close(
        &self,
        manifest: Manifest,
        deadline: Instant,
    ) -> Result<Vec<String>, TelemetryError> {
        let asked = Instant::now();
        let limit = deadline.saturating_duration_since(asked);
        let _ = self.orders.send(Order::Close(Box::new(manifest)));
        self.closed.recv_timeout(limit).unwrap_or_else(|_| {
            Err(TelemetryError::WriterSilent {
                writer: KEEPER,
                silent_s: asked.elapsed().as_secs_f64(),
                limit_s: limit.as_secs_f64(),
            })
        })
    }
}

/// The keeper's loop, until the record is closed or abandoned.
fn keep(
    folder: &Folder,
    orders: &Receiver<Order>,
    told: &Sender<String>,
    vitals: &Vitals,
) -> Result<Vec<String>, TelemetryError> {
    let mut in_turn = folder.files.iter().filter(|(name, _)| file::LINES.contains(name)).cycle();
    let (mut known, mut all) = (BTreeSet::new(), Vec::new());
    loop {
        let order = orders.recv_timeout(LOOK_EVERY);
        vitals.beat();
        let troubles = match order {
            Ok(Order::Write(manifest)) => {
                folder.write_manifest(&manifest).err().into_iter().collect()
            }
            Ok(Order::Close(manifest)) => return folder.close(*manifest, all),
            Err(RecvTimeoutError::Timeout) => folder.look_after(in_turn.next()),
            Err(RecvTimeoutError::Disconnected) => return Ok(Vec::new()),
        };
        for trouble in troubles {
            if known.insert(kind(&trouble)) {
                let _ = told.send(trouble.to_string());
                all.push(trouble);
            }
        }
        vitals.beat();
    }
}

/// Troubles of one kind are reported once, whatever number of kB is left.
fn kind(trouble: &TelemetryError) -> String {
    match trouble {
        TelemetryError::Full { .. } => "full".to_owned(),
        other => other.to_string(),
    }
}

/// A run folder and the files in it that are checked.
struct Folder {
    dir: PathBuf,
    identity: Identity,
    files: Vec<Kept>,
}

impl Folder {
    fn open(dir: PathBuf, files: Vec<Kept>) -> Result<Self, TelemetryError> {
        let found = fs::metadata(&dir).map_err(TelemetryError::file(&dir))?;
        Ok(Folder { identity: Identity::of(&found), dir, files })
    }

    /// Syncs the file whose `turn` it is, and checks the folder, its files and the free space. Returns
    /// the troubles.
    fn look_after(&self, turn: Option<&Kept>) -> Vec<TelemetryError> {
        let synced = turn.map(|(name, file)| self.named(name, file.sync_data()));
        let in_place = match self.is_in_place() {
            // Without the folder, its files are not checked.
            Err(gone) => vec![Err(gone)],
            Ok(()) => self.files.iter().map(|kept| self.holds(kept)).collect(),
        };
        let is_there = in_place.iter().any(Result::is_ok);
        let room = is_there.then(|| check_not_full(&self.dir));
        synced.into_iter().chain(in_place).chain(room).filter_map(Result::err).collect()
    }

    /// Writing to a folder that was removed or renamed does not fail.
    fn is_in_place(&self) -> Result<(), TelemetryError> {
        self.identity.is_at(&self.dir).map_err(TelemetryError::file(&self.dir))
    }

    fn holds(&self, (name, file): &Kept) -> Result<(), TelemetryError> {
        let found = file.metadata();
        self.named(name, found.and_then(|file| Identity::of(&file).is_at(&self.dir.join(name))))
    }

    fn named(&self, name: &str, result: io::Result<()>) -> Result<(), TelemetryError> {
        result.map_err(TelemetryError::file(&self.dir.join(name)))
    }

    /// Writes `manifest`, and reserves room for the next one.
    fn write_manifest(&self, manifest: &Manifest) -> Result<(), TelemetryError> {
        self.is_in_place()?;
        folder::write_manifest(&self.dir, manifest)?;
        folder::reserve_manifest(&self.dir)
    }

    /// Writes the last manifest, but never into another folder that has taken this one's place. Returns
    /// the troubles that the manifest did not have: `troubles` so far, and those of a last check.
    fn close(
        &self,
        mut manifest: Manifest,
        mut troubles: Vec<TelemetryError>,
    ) -> Result<Vec<String>, TelemetryError> {
        self.is_in_place()?;
        troubles.extend(self.files.iter().filter_map(|kept| self.holds(kept).err()));
        let mut new = Vec::new();
        for trouble in troubles.iter().map(ToString::to_string) {
            if !manifest.faults.iter().any(|fault| fault.contains(&trouble)) {
                manifest.faults.push(trouble.clone());
                new.push(trouble);
            }
        }
        folder::write_manifest(&self.dir, &manifest)?;
        Ok(new)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::tests::Scratch;
    use std::path::Path;

    fn folder(dir: &Path) -> Folder {
        let files = vec![(file::STEPS, File::create(dir.join(file::STEPS)).unwrap())];
        Folder::open(dir.to_path_buf(), files).unwrap()
    }

    fn said(folder: &Folder) -> Vec<String> {
        folder.look_after(folder.files.first()).iter().map(ToString::to_string).collect()
    }

    #[test]
    fn a_file_that_is_gone_is_noticed() {
        let scratch = Scratch::new("keeper");
        let folder = folder(&scratch.0);
        assert_eq!(said(&folder), Vec::<String>::new());
        let path = scratch.0.join(file::STEPS);
        fs::remove_file(&path).unwrap();
        assert!(said(&folder)[0].contains("steps.csv: No such file"), "{:?}", said(&folder));
        fs::write(&path, "").unwrap();
        let replaced = "steps.csv: another file has taken its place";
        assert!(said(&folder)[0].ends_with(replaced), "{:?}", said(&folder));
        let manifest = Manifest::new("x", String::new());
        let troubles = folder.close(manifest, Vec::new()).unwrap();
        assert!(troubles[0].ends_with(replaced), "{troubles:?}");
        let manifest = fs::read_to_string(scratch.0.join(file::MANIFEST)).unwrap();
        assert_eq!(Manifest::from_text(&manifest).unwrap().faults, troubles);
    }

    /// For example another run's folder.
    #[test]
    fn what_stands_in_the_folders_place_is_not_written_to() {
        let scratch = Scratch::new("keeper-moved");
        let dir = scratch.0.join("run");
        fs::create_dir(&dir).unwrap();
        let folder = folder(&dir);
        fs::rename(&dir, scratch.0.join("moved")).unwrap();
        assert!(said(&folder)[0].contains("run: No such file"), "{:?}", said(&folder));
        fs::create_dir(&dir).unwrap();
        fs::write(dir.join(file::MANIFEST), "another's").unwrap();
        let replaced = "run: another file has taken its place";
        assert!(said(&folder)[0].ends_with(replaced), "{:?}", said(&folder));
        let manifest = Manifest::new("x", String::new());
        for refused in [
            folder.write_manifest(&manifest).unwrap_err(),
            folder.close(manifest, Vec::new()).unwrap_err(),
        ] {
            assert!(refused.to_string().ends_with(replaced), "{refused}");
        }
        assert_eq!(fs::read_to_string(dir.join(file::MANIFEST)).unwrap(), "another's");
    }

    #[test]
    fn each_trouble_is_told_once() {
        let scratch = Scratch::new("keeper-troubles");
        let dir = scratch.0.join("run");
        fs::create_dir(&dir).unwrap();
        let file = File::create(dir.join(file::STEPS)).unwrap();
        let keeper = Keeper::start(dir.clone(), vec![(file::STEPS, file)]).unwrap();
        let next = || keeper.troubles.recv_timeout(Duration::from_secs(60)).unwrap();
        fs::remove_file(dir.join(file::STEPS)).unwrap();
        assert!(next().contains("steps.csv: No such file"));
        fs::rename(&dir, scratch.0.join("moved")).unwrap();
        assert!(next().contains("run: No such file"));
        let beats = keeper.vitals.beats();
        while keeper.vitals.beats() < beats + 6 {
            thread::yield_now();
        }
        assert!(keeper.trouble().is_none());
    }
}
