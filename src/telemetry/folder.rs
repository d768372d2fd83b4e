//! Run folders, named `<UTC>-<name>`: creating a new one, its lock, its manifest, and the space on its disk.

use super::TelemetryError;
use crate::archive::{Manifest, compact, file, unix_us_of};
use nix::errno::Errno;
use nix::fcntl::{FcntlArg, fcntl};
use nix::libc::{F_UNLCK, F_WRLCK, SEEK_SET, flock};
use nix::sys::statvfs::statvfs;
use std::fs::{self, File, OpenOptions};
use std::io::ErrorKind::{AlreadyExists, InvalidInput, Unsupported};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

/// The largest number that distinguishes runs with the same name and second.
const COLLISIONS_MAX: u32 = 1000;

/// Creates a new folder for the run of `manifest` in `parent`, and `parent` itself if it does not exist. The
/// configuration has checked that the run's name is valid in a folder's name.
///
/// `create_dir` fails on an existing folder, so two processes never get the same one.
///
/// # Errors
/// The folder cannot be created.
pub(super) fn create(parent: &Path, manifest: &Manifest) -> Result<PathBuf, TelemetryError> {
    fs::create_dir_all(parent).map_err(TelemetryError::folder(parent))?;
    let started_unix_us = unix_us_of(&manifest.started_utc).unwrap_or_default();
    let base = format!("{}-{}", compact(started_unix_us), manifest.name);
    let mut path = parent.join(&base);
    for n in 2..=COLLISIONS_MAX {
        match fs::create_dir(&path) {
            Err(error) if error.kind() == AlreadyExists => {
                path = parent.join(format!("{base}-{n}"))
            }
            Err(error) => return Err(TelemetryError::folder(&path)(error)),
            Ok(()) => return Ok(path),
        }
    }
    Err(TelemetryError::folder(&path)(AlreadyExists.into()))
}

/// Space reserved for the final manifest, which must be written even if the disk is full, in addition to the
/// size of the current one. The final manifest has more figures and faults.
const RESERVE_BYTES: usize = 16 << 10;

/// Writes the manifest of the run folder `dir` atomically: a reader sees the old one or the new one, also if
/// the bench is killed meanwhile. While the record is open, reserves the space that the final manifest needs.
///
/// # Errors
/// [`TelemetryError::File`].
pub fn write_manifest(dir: &Path, manifest: &Manifest) -> Result<(), TelemetryError> {
    let path = dir.join(file::MANIFEST);
    let write = || -> io::Result<()> {
        let text = manifest.to_text()?;
        let new = dir.join(file::NEW_MANIFEST);
        // Overwrites the reserved space, so that a full disk does not matter.
        let mut file = OpenOptions::new().write(true).create(true).truncate(false).open(&new)?;
        file.write_all(text.as_bytes())?;
        file.set_len(text.len() as u64)?;
        file.sync_all()?;
        fs::rename(&new, &path)?;
        if manifest.outcome.is_none() {
            fs::write(&new, vec![b' '; text.len() + RESERVE_BYTES])?;
        }
        // The rename reaches the disk when the folder is synced, which some file systems do not support.
        match File::open(dir)?.sync_all() {
            Err(error) if matches!(error.kind(), InvalidInput | Unsupported) => Ok(()),
            synced => synced,
        }
    };
    write().map_err(TelemetryError::file(&path))
}

/// A write lock on a whole file, for an open-file-description lock (F_OFD_SETLK). Unlike with `File::try_lock`, a
/// process can query the lock without taking it (F_OFD_GETLK).
const WRITE_LOCK: flock =
    flock { l_type: F_WRLCK as i16, l_whence: SEEK_SET as i16, l_start: 0, l_len: 0, l_pid: 0 };

/// Marks the run folder `dir` as being written, by a lock on its configuration file that lasts while the returned
/// file is open. Returns `None` if another process holds the lock. A file system without locks gets no mark.
///
/// # Errors
/// [`TelemetryError::File`] if the configuration file cannot be opened.
pub fn lock(dir: &Path) -> Result<Option<File>, TelemetryError> {
    let path = dir.join(file::CONFIG);
    let opened = OpenOptions::new().read(true).write(true).open(&path);
    let config = opened.map_err(TelemetryError::file(&path))?;
    Ok(match fcntl(&config, FcntlArg::F_OFD_SETLK(&WRITE_LOCK)) {
        Err(Errno::EAGAIN | Errno::EACCES) => None,
        _ => Some(config),
    })
}

/// True if another process holds the lock of the run folder `dir`. The query takes no lock, which could prevent a
/// starting run from taking its own.
pub fn is_being_written(dir: &Path) -> bool {
    let Ok(config) = File::open(dir.join(file::CONFIG)) else { return false };
    let mut found = WRITE_LOCK;
    let looked = fcntl(&config, FcntlArg::F_OFD_GETLK(&mut found));
    looked.is_ok() && i32::from(found.l_type) != F_UNLCK
}

/// A disk with less free space than this counts as full, kB (1000 bytes). It is enough for some seconds of a run.
const FULL_KB: u64 = 256;

/// Creates the folder `dir` if it does not exist, and checks that its file system has `free_mb_min` MB
/// (10⁶ bytes) free for this user. A run of 250 mm takes about 10 MB.
///
/// # Errors
/// Too little space, or the check fails.
pub fn check_room(dir: &Path, free_mb_min: u32) -> Result<(), TelemetryError> {
    let free = fs::create_dir_all(dir).and_then(|()| free_mb(dir));
    match free.map_err(TelemetryError::folder(dir))? {
        Some(free_mb) if free_mb < u64::from(free_mb_min) => {
            let path = dir.display();
            Err(TelemetryError::Recording(format!(
                "record.dir {path}: {free_mb} MB free, record.free_mb_min asks for {free_mb_min}; free \
                 some, or set another record.dir"
            )))
        }
        _ => Ok(()),
    }
}

/// Checks that the disk of `dir` has space for what a run writes until the next check.
///
/// # Errors
/// The disk is full, or the check fails.
pub(super) fn check_not_full(dir: &Path) -> Result<(), TelemetryError> {
    match free_bytes(dir).map_err(TelemetryError::file(dir))? {
        Some(free) if free < 1000 * FULL_KB => Err(TelemetryError::Recording(format!(
            "{}: under {FULL_KB} kB free: the disk is full",
            dir.display()
        ))),
        _ => Ok(()),
    }
}

/// Free space for this user on the file system of `dir`, which need not exist yet, MB (10⁶ bytes). `None` if the
/// file system does not report it.
///
/// # Errors
/// The system's error.
pub fn free_mb(dir: &Path) -> io::Result<Option<u64>> {
    Ok(free_bytes(existing(dir))?.map(|bytes| bytes / 1_000_000))
}

/// Creates a file in `dir`, or in the folder that `dir` would be created in, and removes it.
///
/// # Errors
/// The system's error: nothing can be written there.
pub fn try_to_write(dir: &Path) -> io::Result<()> {
    let path = existing(dir).join(format!(".needle-bench-{}", std::process::id()));
    File::create(&path)?;
    fs::remove_file(&path)
}

/// `dir`, or the nearest folder above it that exists.
fn existing(dir: &Path) -> &Path {
    dir.ancestors().find(|dir| dir.is_dir()).unwrap_or(Path::new("."))
}

/// Free bytes for this user on the file system of `path`; `None` if it does not report them, like some network
/// file systems.
fn free_bytes(path: &Path) -> io::Result<Option<u64>> {
    let found = statvfs(path)?;
    let free = found.blocks_available().saturating_mul(found.fragment_size());
    Ok((found.blocks() > 0).then_some(free))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::Outcome;
    use crate::telemetry::tests::Scratch;
    use std::sync::atomic::AtomicBool;
    use std::sync::atomic::Ordering::Relaxed;
    use std::thread;

    #[test]
    fn runs_of_one_second_get_different_folders() {
        let scratch = Scratch::new("folder");
        let parent = scratch.0.join("runs");
        let made: Vec<String> = (0..3)
            .map(|_| {
                create(&parent, &Manifest::new("virtual", "2023-11-14T22:13:20.000000Z".to_owned()))
                    .unwrap()
            })
            .map(|p| p.file_name().unwrap().to_str().unwrap().to_owned())
            .collect();
        let base = "20231114T221320Z-virtual";
        assert_eq!(made, [base.to_owned(), format!("{base}-2"), format!("{base}-3")]);
    }

    #[test]
    fn a_manifest_replaces_the_one_before() {
        let scratch = Scratch::new("manifest");
        let path = scratch.0.join("manifest.json");
        fs::write(&path, "the manifest of the start").unwrap();
        let mut manifest = Manifest::new("virtual", String::new());
        write_manifest(&scratch.0, &manifest).unwrap();
        let reserved = scratch.0.join(file::NEW_MANIFEST);
        let bytes = fs::metadata(&path).unwrap().len() + RESERVE_BYTES as u64;
        assert_eq!(fs::metadata(reserved).unwrap().len(), bytes);
        manifest.set_outcome(&Outcome::Completed);
        write_manifest(&scratch.0, &manifest).unwrap();
        let text = fs::read_to_string(&path).unwrap();
        assert_eq!(Manifest::from_text(&text).unwrap(), manifest);
        assert_eq!(fs::read_dir(&scratch.0).unwrap().count(), 1);
    }

    #[test]
    fn a_folder_is_locked_by_one_at_a_time() {
        let scratch = Scratch::new("lock");
        assert!(lock(&scratch.0).unwrap_err().to_string().contains("config.toml: No such file"));
        fs::write(scratch.0.join(file::CONFIG), "").unwrap();
        let held = lock(&scratch.0).unwrap();
        assert!(held.is_some() && lock(&scratch.0).unwrap().is_none());
        drop(held);
        assert!(lock(&scratch.0).unwrap().is_some());
    }

    /// A run gets its lock however often others check for one.
    #[test]
    fn a_check_for_a_lock_takes_no_lock() {
        let scratch = Scratch::new("look");
        fs::write(scratch.0.join(file::CONFIG), "").unwrap();
        let is_over = AtomicBool::new(false);
        thread::scope(|scope| {
            scope.spawn(|| {
                while !is_over.load(Relaxed) {
                    is_being_written(&scratch.0);
                }
            });
            let refused = (0..20_000).filter(|_| lock(&scratch.0).unwrap().is_none()).count();
            is_over.store(true, Relaxed);
            assert_eq!(refused, 0);
        });
        let held = lock(&scratch.0).unwrap();
        assert!(is_being_written(&scratch.0));
        drop(held);
        assert!(!is_being_written(&scratch.0));
    }

    #[test]
    fn a_parent_that_is_a_file_is_an_error_with_its_path() {
        let scratch = Scratch::new("parent-is-file");
        let file = scratch.0.join("runs");
        fs::write(&file, "").unwrap();
        let error = create(&file, &Manifest::default()).unwrap_err().to_string();
        assert!(error.contains(file.to_str().unwrap()), "{error}");
    }

    #[test]
    fn a_folder_that_cannot_be_written_is_found_without_a_trace() {
        let scratch = Scratch::new("writable");
        try_to_write(&scratch.0).unwrap();
        try_to_write(&scratch.0.join("runs/today")).unwrap();
        assert_eq!(fs::read_dir(&scratch.0).unwrap().count(), 0);
        // No user can create a file there, not even root.
        assert!(try_to_write(Path::new("/proc/runs")).is_err());
    }

    #[test]
    fn too_little_room_is_refused_with_the_free_megabytes() {
        let scratch = Scratch::new("room");
        let dir = scratch.0.join("runs");
        check_room(&dir, 0).unwrap();
        assert!(dir.is_dir());
        let said = check_room(&dir, u32::MAX).unwrap_err().to_string();
        let path = dir.display();
        assert!(said.starts_with(&format!("record.dir {path}: ")), "{said}");
        let asked = " MB free, record.free_mb_min asks for 4294967295; free some";
        assert!(said.contains(asked), "{said}");
    }

    #[test]
    fn a_disk_that_has_room_is_not_full() {
        let scratch = Scratch::new("room-full");
        check_not_full(&scratch.0).unwrap();
        let gone = scratch.0.join("gone");
        assert!(check_not_full(&gone).unwrap_err().to_string().contains("gone: "));
        // A file system without blocks is not full.
        check_not_full(Path::new("/proc")).unwrap();
    }
}
