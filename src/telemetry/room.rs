//! Room on the disk, before a run.

use super::TelemetryError;
use nix::sys::statvfs::statvfs;
use std::fs;
use std::io;
use std::path::Path;

const BYTES_PER_MB: u64 = 1_000_000;
/// With less than this, some seconds of a run, a disk counts as full.
const FULL_BYTES: u64 = 256_000;

/// Makes the folder `dir` if there is none, and checks that its file system has `free_mb_min` MB
/// (10⁶ bytes) free for this user. A run of 250 mm takes about 10 MB.
///
/// # Errors
/// [`TelemetryError::NoRoom`], or [`TelemetryError::Folder`] if the check fails.
pub fn check_room(dir: &Path, free_mb_min: u32) -> Result<(), TelemetryError> {
    let free = fs::create_dir_all(dir).and_then(|()| free_bytes(dir));
    let free_mb = free.map_err(TelemetryError::folder(dir))?.map(|bytes| bytes / BYTES_PER_MB);
    match free_mb {
        Some(free_mb) if free_mb < u64::from(free_mb_min) => {
            Err(TelemetryError::NoRoom { path: dir.to_path_buf(), free_mb, free_mb_min })
        }
        _ => Ok(()),
    }
}

/// Checks that there is room for what a run writes until the next check.
///
/// # Errors
/// [`TelemetryError::Full`], or [`TelemetryError::File`] if the check fails.
pub(super) fn check_not_full(dir: &Path) -> Result<(), TelemetryError> {
    match free_bytes(dir).map_err(TelemetryError::file(dir))? {
        Some(free) if free < FULL_BYTES => {
            Err(TelemetryError::Full { path: dir.to_path_buf(), free_kb: free / 1000 })
        }
        _ => Ok(()),
    }
}

/// Free space for this user where `dir` is or will be, MB; `None` if the file system does not count it.
///
/// # Errors
/// The system's.
pub fn free_mb(dir: &Path) -> io::Result<Option<u64>> {
    let there = dir.ancestors().find(|dir| dir.is_dir()).unwrap_or(Path::new("."));
    Ok(free_bytes(there)?.map(|bytes| bytes / BYTES_PER_MB))
}

/// Free bytes for this user on the file system of `path`; `None` if it does not count its blocks, as some
/// network file systems.
fn free_bytes(path: &Path) -> io::Result<Option<u64>> {
    let found = statvfs(path)?;
    let free = found.blocks_available().saturating_mul(found.fragment_size());
    Ok((found.blocks() > 0).then_some(free))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::tests::Scratch;

    #[test]
    fn too_little_room_is_refused_with_what_there_is() {
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
