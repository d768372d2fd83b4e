//! Room on the disk, before a run.

use super::TelemetryError;
use nix::sys::statvfs::statvfs;
use std::fs;
use std::path::Path;

/// Makes the folder `dir` where there is none, and sees that its file system has `free_mb_min` MB
/// (10⁶ bytes) left for this user. A run of 250 mm leaves some 10 MB.
///
/// # Errors
/// [`TelemetryError::NoRoom`], and [`TelemetryError::Folder`] where that cannot be found out.
pub fn check_room(dir: &Path, free_mb_min: u32) -> Result<(), TelemetryError> {
    let failed = |source| TelemetryError::Folder { path: dir.to_path_buf(), source };
    fs::create_dir_all(dir).map_err(failed)?;
    let found = statvfs(dir).map_err(|errno| failed(errno.into()))?;
    let free_mb = free_mb(found.blocks_available(), found.fragment_size());
    if free_mb < u64::from(free_mb_min) {
        return Err(TelemetryError::NoRoom { path: dir.to_path_buf(), free_mb, free_mb_min });
    }
    Ok(())
}

/// `blocks` of `bytes` each, in whole MB.
fn free_mb(blocks: u64, bytes: u64) -> u64 {
    blocks.saturating_mul(bytes) / 1_000_000
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::folder::tests::Scratch;

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
    fn blocks_are_counted_in_mb() {
        assert_eq!(free_mb(25_000, 4096), 102);
        assert_eq!(free_mb(u64::MAX, 4096), u64::MAX / 1_000_000);
    }
}
