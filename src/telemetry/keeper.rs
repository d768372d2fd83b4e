//! The keeper of a run folder: it writes the manifest, syncs the text files to the disk, and checks that
//! the folder is still there and its disk is not full.
//!
//! Written lines survive a crash of the bench, but stay in the operating system's page cache until they are on the
//! disk. So only a sync detects a stalled disk. The keeper syncs four times a second, on its own thread, which may
//! block.

use super::TelemetryError;
use super::folder::{self, check_not_full};
use super::worker::{Backpressure, Sink, Worker};
use crate::archive::{Manifest, file};
use rtrb::{Consumer, Producer, RingBuffer};
use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// The keeper's name in messages.
pub(super) const KEEPER: &str = "run folder";
/// Capacity of the queue of manifests; a run writes one for each drive that it finds.
const QUEUE_MANIFESTS: usize = 8;
const QUEUE_PROBLEMS: usize = 64;

/// A path, and the file or folder that was opened there.
type OpenPath = (PathBuf, File);

/// Starts the thread that checks the run folder `dir`, its text files and its configuration, and writes the
/// manifests from its queue. The consumer gets each problem with the folder once.
///
/// # Errors
/// The folder or a file cannot be opened, or the thread cannot be started.
pub(super) fn keep(dir: &Path) -> Result<(Worker<Manifest>, Consumer<String>), TelemetryError> {
    let (reports, problems) = RingBuffer::new(QUEUE_PROBLEMS);
    let folder = Folder::open(dir, reports)?;
    let worker = Worker::start(KEEPER, QUEUE_MANIFESTS, Backpressure::DropAndCount, folder)?;
    Ok((worker, problems))
}

/// A run folder and the files in it that are checked.
struct Folder {
    dir: OpenPath,
    /// The text files, then the configuration.
    files: Vec<OpenPath>,
    /// The number of checks so far.
    checks: usize,
    /// The problems so far.
    known: BTreeSet<String>,
    reports: Producer<String>,
}

impl Folder {
    fn open(dir: &Path, reports: Producer<String>) -> Result<Self, TelemetryError> {
        let open = |path: PathBuf| match File::open(&path) {
            Ok(file) => Ok((path, file)),
            Err(error) => Err(TelemetryError::file(&path)(error)),
        };
        let names = file::TEXT_FILES.into_iter().chain([file::CONFIG]);
        let files = names.map(|name| open(dir.join(name))).collect::<Result<_, _>>()?;
        let (dir, known) = (open(dir.to_path_buf())?, BTreeSet::new());
        Ok(Folder { dir, files, checks: 0, known, reports })
    }

    /// Syncs one of the text files in turn, and checks the folder, its files and the free space. Returns the
    /// problems.
    fn sync_and_check(&mut self) -> Vec<TelemetryError> {
        let turn = self.files.get(self.checks % file::TEXT_FILES.len());
        self.checks += 1;
        let synced = turn.map(|(path, file)| file.sync_data().map_err(TelemetryError::file(path)));
        let checked = match check_in_place(&self.dir) {
            // Without the folder its files are not checked.
            Err(gone) => vec![Err(gone)],
            Ok(()) => {
                let in_place = self.files.iter().map(check_in_place);
                in_place.chain([check_not_full(&self.dir.0)]).collect()
            }
        };
        synced.into_iter().chain(checked).filter_map(Result::err).collect()
    }

    /// Reports new problems.
    fn report(&mut self, problems: impl IntoIterator<Item = TelemetryError>) {
        for problem in problems.into_iter().map(|problem| format!("{KEEPER}: {problem}")) {
            if self.known.insert(problem.clone()) {
                let _ = self.reports.push(problem);
            }
        }
    }

    /// Writes `manifest`, unless the folder was removed or replaced by another one.
    fn write_manifest(&self, manifest: &Manifest) -> Result<(), TelemetryError> {
        check_in_place(&self.dir)?;
        folder::write_manifest(&self.dir.0, manifest)
    }

    /// Writes the final manifest, with all problems so far and those of a last check.
    fn write_last(&mut self, mut manifest: Manifest) -> Result<(), TelemetryError> {
        let lost: Vec<_> =
            self.files.iter().filter_map(|file| check_in_place(file).err()).collect();
        self.report(lost);
        let added = self.known.iter().filter(|problem| !manifest.faults.contains(problem));
        let added: Vec<String> = added.cloned().collect();
        manifest.faults.extend(added);
        self.write_manifest(&manifest)
    }
}

/// Checks that the open file is still at its path: writing to a removed or renamed file does not fail.
fn check_in_place((path, file): &OpenPath) -> Result<(), TelemetryError> {
    let check = || {
        let (open, found) = (file.metadata()?, fs::symlink_metadata(path)?);
        match (open.dev(), open.ino()) == (found.dev(), found.ino()) {
            true => Ok(()),
            false => Err(io::Error::other("another file has taken its place")),
        }
    };
    check().map_err(TelemetryError::file(path))
}

impl Sink for Folder {
    type Item = Manifest;
    const ITEMS: &'static str = "manifests";
    /// Each tick syncs one of the five text files, so a loss of power costs up to 1.25 s.
    const TICK: Duration = Duration::from_millis(250);

    fn take(&mut self, manifest: Manifest) -> Result<(), String> {
        let problem = self.write_manifest(&manifest).err();
        self.report(problem);
        Ok(())
    }

    fn tick(&mut self) -> Result<(), String> {
        let problems = self.sync_and_check();
        self.report(problems);
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
    use std::sync::atomic::Ordering::Relaxed;
    use std::thread;
    use std::time::Instant;

    fn create_files(dir: &Path) {
        for name in file::TEXT_FILES.into_iter().chain([file::CONFIG]) {
            File::create(dir.join(name)).unwrap();
        }
    }

    fn folder(dir: &Path) -> Folder {
        create_files(dir);
        Folder::open(dir, RingBuffer::new(1).0).unwrap()
    }

    fn faults(folder: &mut Folder) -> Vec<String> {
        folder.sync_and_check().iter().map(ToString::to_string).collect()
    }

    #[test]
    fn a_file_that_is_gone_or_replaced_is_a_fault() {
        let scratch = Scratch::new("keeper");
        let mut folder = folder(&scratch.0);
        assert_eq!(faults(&mut folder), Vec::<String>::new());
        let path = scratch.0.join(file::STEPS);
        fs::remove_file(&path).unwrap();
        assert!(
            faults(&mut folder)[0].contains("steps.csv: No such file"),
            "{:?}",
            faults(&mut folder)
        );
        fs::write(&path, "").unwrap();
        let replaced = "steps.csv: another file has taken its place";
        assert!(faults(&mut folder)[0].ends_with(replaced), "{:?}", faults(&mut folder));
        let manifest = Manifest::new("x", String::new());
        folder.write_last(manifest).unwrap();
        let manifest = fs::read_to_string(scratch.0.join(file::MANIFEST)).unwrap();
        let problems = Manifest::from_text(&manifest).unwrap().faults;
        assert!(problems[0].ends_with(replaced), "{problems:?}");
        assert!(problems.iter().eq(&folder.known), "{problems:?}");
    }

    #[test]
    fn another_folder_in_the_place_of_the_run_folder_is_not_written_to() {
        let scratch = Scratch::new("keeper-moved");
        let dir = scratch.0.join("run");
        fs::create_dir(&dir).unwrap();
        let mut folder = folder(&dir);
        fs::rename(&dir, scratch.0.join("moved")).unwrap();
        assert!(faults(&mut folder)[0].contains("run: No such file"), "{:?}", faults(&mut folder));
        fs::create_dir(&dir).unwrap();
        fs::write(dir.join(file::MANIFEST), "another's").unwrap();
        let replaced = "run: another file has taken its place";
        assert!(faults(&mut folder)[0].ends_with(replaced), "{:?}", faults(&mut folder));
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
    fn dropped_manifests_are_reported_as_manifests() {
        let scratch = Scratch::new("keeper-dropped");
        create_files(&scratch.0);
        let (mut keeper, _) = keep(&scratch.0).unwrap();
        while keeper.dropped == 0 {
            keeper.send(Manifest::default());
        }
        let news = std::iter::from_fn(|| keeper.news(Instant::now()));
        let said: Vec<String> = news.map(|news| format!("{news:?}")).collect();
        assert!(
            said.concat().contains("run folder: manifests lost: 1, its queue is full"),
            "{said:?}"
        );
    }

    #[test]
    fn each_problem_is_reported_once() {
        let scratch = Scratch::new("keeper-problems");
        let dir = scratch.0.join("run");
        fs::create_dir(&dir).unwrap();
        create_files(&dir);
        let (keeper, mut problems) = keep(&dir).unwrap();
        let mut next = || {
            let end = Instant::now() + Duration::from_secs(60);
            loop {
                match problems.pop() {
                    Ok(problem) => break problem,
                    Err(_) => assert!(Instant::now() < end, "no problem"),
                }
                thread::yield_now();
            }
        };
        fs::remove_file(dir.join(file::STEPS)).unwrap();
        assert!(next().contains("steps.csv: No such file"));
        fs::rename(&dir, scratch.0.join("moved")).unwrap();
        assert!(next().contains("run: No such file"));
        let beats = keeper.status.beats.load(Relaxed);
        while keeper.status.beats.load(Relaxed) < beats + 3 {
            thread::yield_now();
        }
        assert!(problems.is_empty());
    }
}
