//! The keeper of a run folder: it writes the manifest, syncs the text files to the disk, and checks that
//! the folder is still there and its disk is not full.
//!
//! Lines that a writer handed over survive the end of the bench, but wait in the system's memory for the
//! disk: a stalled disk is detected only by a sync. The keeper syncs four times a second, on a thread of
//! its own, which may block.

use super::TelemetryError;
use super::folder::{self, check_not_full, is_at};
use super::worker::{Backpressure, Sink, Worker};
use crate::archive::{Manifest, file};
use rtrb::{Consumer, Producer, RingBuffer};
use std::collections::BTreeSet;
use std::fs::File;
use std::path::PathBuf;
use std::time::Duration;

/// The keeper's name in messages.
pub(super) const KEEPER: &str = "run folder";
/// Manifests that wait to be written: one for each drive that is found.
const QUEUE_MANIFESTS: usize = 8;
const QUEUE_TROUBLES: usize = 64;

/// An open file or folder, and its path.
pub(super) type Kept = (PathBuf, File);

/// Keeps the run folder `dir` and `files` in it, the text files first, on a thread of its own, which writes
/// each manifest that it is given. Troubles with the folder are reported to the receiver, each once.
///
/// # Errors
/// The folder cannot be opened, or no thread can be started.
pub(super) fn keep(
    dir: PathBuf,
    files: Vec<Kept>,
) -> Result<(Worker<Box<Manifest>>, Consumer<String>), TelemetryError> {
    let (told, troubles) = RingBuffer::new(QUEUE_TROUBLES);
    let folder = Folder::open(dir, files, told)?;
    let worker = Worker::start(KEEPER, QUEUE_MANIFESTS, Backpressure::DropAndCount, || Ok(folder))?;
    Ok((worker, troubles))
}

/// A run folder and the files in it that are checked.
struct Folder {
    dir: Kept,
    files: Vec<Kept>,
    /// The number of checks so far.
    checks: usize,
    /// Troubles so far.
    known: BTreeSet<String>,
    told: Producer<String>,
}

impl Folder {
    fn open(
        dir: PathBuf,
        files: Vec<Kept>,
        told: Producer<String>,
    ) -> Result<Self, TelemetryError> {
        let opened = File::open(&dir).map_err(TelemetryError::file(&dir))?;
        Ok(Folder { dir: (dir, opened), files, checks: 0, known: BTreeSet::new(), told })
    }

    /// Syncs one of the text files, the next at each check, and checks the folder, its files and the
    /// free space. Returns the troubles.
    fn look_after(&mut self) -> Vec<TelemetryError> {
        let turn = self.files.iter().cycle().nth(self.checks % file::LINES.len());
        self.checks += 1;
        let synced = turn.map(|(path, file)| file.sync_data().map_err(TelemetryError::file(path)));
        let checked = match is_in_place(&self.dir) {
            // Without the folder, its files are not checked.
            Err(gone) => vec![Err(gone)],
            Ok(()) => {
                let in_place = self.files.iter().map(is_in_place);
                in_place.chain([check_not_full(&self.dir.0)]).collect()
            }
        };
        synced.into_iter().chain(checked).filter_map(Result::err).collect()
    }

    /// Reports the troubles that are new.
    fn tell(&mut self, troubles: impl IntoIterator<Item = TelemetryError>) {
        for trouble in troubles.into_iter().map(|trouble| format!("{KEEPER}: {trouble}")) {
            if self.known.insert(trouble.clone()) {
                let _ = self.told.push(trouble);
            }
        }
    }

    /// Writes `manifest`, and reserves room for the next one.
    fn write_manifest(&self, manifest: &Manifest) -> Result<(), TelemetryError> {
        is_in_place(&self.dir)?;
        folder::write_manifest(&self.dir.0, manifest)?;
        folder::reserve_manifest(&self.dir.0)
    }

    /// Writes the last manifest, but never into another folder that has taken this one's place. It has
    /// all troubles so far, and those of a last check.
    fn write_last(&mut self, mut manifest: Manifest) -> Result<(), TelemetryError> {
        is_in_place(&self.dir)?;
        let lost: Vec<_> = self.files.iter().filter_map(|kept| is_in_place(kept).err()).collect();
        self.tell(lost);
        let added = self.known.iter().filter(|trouble| !manifest.faults.contains(trouble));
        let added: Vec<String> = added.cloned().collect();
        manifest.faults.extend(added);
        folder::write_manifest(&self.dir.0, &manifest)
    }
}

/// Writing to a file or folder that was removed or renamed does not fail.
fn is_in_place((path, file): &Kept) -> Result<(), TelemetryError> {
    is_at(file, path).map_err(TelemetryError::file(path))
}

impl Sink for Folder {
    type Item = Box<Manifest>;
    const ITEMS: &'static str = "manifests";
    /// Each check syncs one of the five text files, so a loss of power costs 1.25 s.
    const TICK: Duration = Duration::from_millis(250);

    fn take(&mut self, manifest: Box<Manifest>) -> Result<(), String> {
        let trouble = self.write_manifest(&manifest).err();
        self.tell(trouble);
        Ok(())
    }

    fn tick(&mut self) -> Result<(), String> {
        let troubles = self.look_after();
        self.tell(troubles);
        Ok(())
    }

    fn close(&mut self, manifest: &Manifest, _: &dyn Fn()) -> Result<(), String> {
        self.write_last(manifest.clone()).map_err(|error| error.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::tests::Scratch;
    use std::fs;
    use std::path::Path;
    use std::thread;
    use std::time::Instant;

    fn folder(dir: &Path) -> Folder {
        let path = dir.join(file::STEPS);
        let file = File::create(&path).unwrap();
        Folder::open(dir.to_path_buf(), vec![(path, file)], RingBuffer::new(1).0).unwrap()
    }

    fn said(folder: &mut Folder) -> Vec<String> {
        folder.look_after().iter().map(ToString::to_string).collect()
    }

    #[test]
    fn a_file_that_is_gone_is_noticed() {
        let scratch = Scratch::new("keeper");
        let mut folder = folder(&scratch.0);
        assert_eq!(said(&mut folder), Vec::<String>::new());
        let path = scratch.0.join(file::STEPS);
        fs::remove_file(&path).unwrap();
        assert!(
            said(&mut folder)[0].contains("steps.csv: No such file"),
            "{:?}",
            said(&mut folder)
        );
        fs::write(&path, "").unwrap();
        let replaced = "steps.csv: another file has taken its place";
        assert!(said(&mut folder)[0].ends_with(replaced), "{:?}", said(&mut folder));
        let manifest = Manifest::new("x", String::new());
        folder.write_last(manifest).unwrap();
        let manifest = fs::read_to_string(scratch.0.join(file::MANIFEST)).unwrap();
        let troubles = Manifest::from_text(&manifest).unwrap().faults;
        assert!(troubles[0].ends_with(replaced), "{troubles:?}");
        assert!(troubles.iter().eq(&folder.known), "{troubles:?}");
    }

    /// For example another run's folder.
    #[test]
    fn what_stands_in_the_folders_place_is_not_written_to() {
        let scratch = Scratch::new("keeper-moved");
        let dir = scratch.0.join("run");
        fs::create_dir(&dir).unwrap();
        let mut folder = folder(&dir);
        fs::rename(&dir, scratch.0.join("moved")).unwrap();
        assert!(said(&mut folder)[0].contains("run: No such file"), "{:?}", said(&mut folder));
        fs::create_dir(&dir).unwrap();
        fs::write(dir.join(file::MANIFEST), "another's").unwrap();
        let replaced = "run: another file has taken its place";
        assert!(said(&mut folder)[0].ends_with(replaced), "{:?}", said(&mut folder));
        let manifest = Manifest::new("x", String::new());
        for refused in [
            folder.write_manifest(&manifest).unwrap_err(),
            folder.write_last(manifest).unwrap_err(),
        ] {
            assert!(refused.to_string().ends_with(replaced), "{refused}");
        }
        assert_eq!(fs::read_to_string(dir.join(file::MANIFEST)).unwrap(), "another's");
    }

    #[test]
    fn a_manifest_that_is_dropped_is_called_one() {
        let scratch = Scratch::new("keeper-dropped");
        let (mut keeper, _) = keep(scratch.0.clone(), Vec::new()).unwrap();
        while keeper.dropped == 0 {
            keeper.give(Box::default());
        }
        let news = std::iter::from_fn(|| keeper.news(Instant::now()));
        let said: Vec<String> = news.map(|news| format!("{news:?}")).collect();
        assert!(
            said.concat().contains("run folder: 1 manifests lost, its queue is full"),
            "{said:?}"
        );
    }

    #[test]
    fn each_trouble_is_told_once() {
        let scratch = Scratch::new("keeper-troubles");
        let dir = scratch.0.join("run");
        fs::create_dir(&dir).unwrap();
        let path = dir.join(file::STEPS);
        let file = File::create(&path).unwrap();
        let (keeper, mut troubles) = keep(dir.clone(), vec![(path, file)]).unwrap();
        let mut next = || {
            let end = Instant::now() + Duration::from_secs(60);
            loop {
                match troubles.pop() {
                    Ok(trouble) => break trouble,
                    Err(_) => assert!(Instant::now() < end, "no trouble"),
                }
                thread::yield_now();
            }
        };
        fs::remove_file(dir.join(file::STEPS)).unwrap();
        assert!(next().contains("steps.csv: No such file"));
        fs::rename(&dir, scratch.0.join("moved")).unwrap();
        assert!(next().contains("run: No such file"));
        let beats = keeper.vitals.beats();
        while keeper.vitals.beats() < beats + 3 {
            thread::yield_now();
        }
        assert!(troubles.is_empty());
    }
}
