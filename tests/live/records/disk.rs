//! Small file systems for one test each.

use crate::support::needed::skip;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// A small file system, mounted until this is dropped.
pub(crate) struct Disk(pub(crate) PathBuf);

impl Disk {
    /// Capacity of a disk in memory.
    pub(crate) const BYTES: usize = 1 << 20;

    /// Mounts a disk in memory; `None` without the permission to mount.
    pub(crate) fn in_memory(path: PathBuf) -> Option<Self> {
        let options = format!("size={},mode=777", Self::BYTES);
        Self::mount(path, &["-t", "tmpfs", "-o", &options, "none"])
    }

    /// Mounts a disk that can be frozen, with its blocks in the file `image`; `None` without the permission to
    /// mount.
    pub(crate) fn in_file(path: PathBuf, image: &Path) -> Option<Self> {
        File::create(image).unwrap().set_len(64 << 20).unwrap();
        run("mkfs.ext4", &["-q"], image);
        let disk = Self::mount(path, &["-o", "loop", image.to_str().unwrap()])?;
        // ext4 makes this folder, which is not a run folder.
        fs::remove_dir(disk.0.join("lost+found")).unwrap();
        Some(disk)
    }

    fn mount(path: PathBuf, arguments: &[&str]) -> Option<Self> {
        fs::create_dir_all(&path).unwrap();
        let mut mount = Command::new("mount");
        mount.args(arguments).arg(&path).stderr(Stdio::null());
        if mount.status().unwrap().success() {
            return Some(Disk(path));
        }
        skip("permission to mount a file system", "run the tests as root");
        None
    }

    /// Blocks every write to the disk until the result is dropped.
    pub(crate) fn freeze(&self) -> Frozen<'_> {
        run("fsfreeze", &["-f"], &self.0);
        Frozen(self)
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        run("umount", &[], &self.0);
    }
}

/// A disk that blocks every write until this is dropped. It must be dropped before the writing process, because a
/// process that waits for a disk cannot be killed.
pub(crate) struct Frozen<'a>(&'a Disk);

impl Drop for Frozen<'_> {
    fn drop(&mut self) {
        run("fsfreeze", &["-u"], &self.0.0);
    }
}

fn run(program: &str, arguments: &[&str], path: &Path) {
    let status = Command::new(program).args(arguments).arg(path).status().unwrap();
    assert!(status.success(), "{program} {}: {status}", path.display());
}
