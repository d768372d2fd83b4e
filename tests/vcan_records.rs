//! A record on a file system that is truly full: one of 2 MB, mounted for the test, which needs
//! the rights that `vcan/run.sh` has.
#![cfg(target_os = "linux")]

mod support {
    pub(crate) mod drives;
    #[allow(dead_code, reason = "not every test needs all of it")]
    pub(crate) mod programs;
    pub(crate) mod vcan;
}

use needle_bench::archive::{EventLine, RunOutcome, file};
use needle_bench::telemetry::RunFolder;
use std::path::{Path, PathBuf};
use std::process::Command;
use support::drives::assert_the_drives_stand;
use support::programs::{self, Scratch, alone, stage};
use support::vcan;

/// A small file system, mounted as long as it is held.
struct Disk(PathBuf);

fn as_root(command: &str, path: &Path) {
    let command = format!("{command} {}", path.display());
    let script = format!("[ $(id -u) = 0 ] && exec {command}; exec sudo -n {command}");
    let status = Command::new("sh").args(["-c", &script]).status().unwrap();
    assert!(status.success(), "{command}: {status}");
}

impl Disk {
    fn mount(path: PathBuf) -> Self {
        std::fs::create_dir_all(&path).unwrap();
        as_root("mount -t tmpfs -o size=2m,mode=777 none", &path);
        Disk(path)
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        as_root("umount", &self.0);
    }
}

#[test]
fn a_full_disk_stops_the_run_safely_and_its_record_is_closed() {
    if !vcan::asked_for() {
        return;
    }
    let _alone = alone();
    let scratch = Scratch::new("full");
    let disk = Disk::mount(scratch.path("runs"));
    let _stage = stage(&[]);

    // It is seen before the run, where that is asked for.
    let refused = scratch.bench(&[], &[]).end();
    refused.assert_status(3);
    let said = "MB free, record.free_mb_min asks for 100; free some, or set another record.dir";
    assert!(refused.stderr.contains(said), "{}", refused.stderr);

    let bench = scratch.bench(&[], &["record.free_mb_min=0"]).end();
    bench.assert_status(1);
    let reason = bench.last_line();
    assert!(reason.starts_with("stopped: record: "), "{reason}");
    assert_the_drives_stand(&[]);
    let run_dir = scratch.run_dir();
    let run = RunFolder::open(&run_dir).unwrap();
    run.verify().unwrap();
    let manifest = run.manifest();
    println!("{reason}; {:?} of {:?} dropped", manifest.dropped, manifest.counts);
    assert_eq!(manifest.outcome, Some(RunOutcome::Stopped));
    assert!(manifest.faults.iter().any(|fault| fault.contains("No space left")), "{manifest:?}");
    assert!(manifest.counts.unwrap().steps > 3);
    let events = programs::read(&run_dir.join(file::EVENTS));
    assert!(events.lines().all(|line| EventLine::parse(line).is_some()), "{events}");
    drop(disk);
}
